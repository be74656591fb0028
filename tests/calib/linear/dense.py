"""All rows of a problem at a state as one dense matrix, and what follows from it by plain algebra.

It knows nothing of layouts, sums or eliminations: rows are those of scans, blocks and priors, each
put where its unknowns stand.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field

import gtsam
import numpy as np

from calib.problem import Problem
from calib.problem.unknowns import Role, Unknown
from calib.residuals.beams import Association
from calib.residuals.tracker import TrackedBody

from .. import rigs

Values = Mapping[str, np.ndarray]


def away(unknown: Unknown, value: np.ndarray) -> np.ndarray:
    """How far a value is from what was known before, as gtsam's priors say."""
    if unknown.kind == "pose":
        return gtsam.Pose3.Logmap(gtsam.Pose3(np.linalg.inv(unknown.mean) @ value))
    return value - unknown.mean


@dataclass
class Dense:
    """Whitened rows A (m, U) and minus their residuals b (m,), of what kind each is, and which are
    those of ``scan NUMBER``, ``block NUMBER`` and ``prior:UNKNOWN``.

    Args:
        problem: what is estimated, surfaces' unknowns included.
        values: the state.
        associations: per scan, what its beams meet.
        held: blocks beyond the problem's, each standing for its unknowns' priors.
    """

    problem: Problem
    values: Values
    associations: Sequence[Association]
    held: Collection[object] = ()
    A: np.ndarray = field(init=False)
    b: np.ndarray = field(init=False)
    kind: np.ndarray = field(init=False)
    cluster: list[tuple[int, object, int] | None] = field(init=False)
    rows_of: dict[str, slice] = field(init=False)

    def __post_init__(self) -> None:
        unknowns = self.problem.variables
        ends = np.cumsum([0, *(u.dim for u in unknowns.values())])
        self.at = {n: np.arange(i, k) for n, i, k in zip(unknowns, ends, ends[1:], strict=False)}
        self.sigma = np.concatenate([u.sigma for u in unknowns.values()])
        self._parts: list[tuple[np.ndarray, np.ndarray, str, list]] = []
        self.rows_of = {}
        for number in range(len(self.problem.scans)):
            self._beams(number)
        for i, block in enumerate([*self.problem.blocks, *self.held]):
            residual, d = block.evaluate(self.values, True)
            kind = "body" if isinstance(block, TrackedBody) else "other"
            name = f"{kind}:{','.join(block.variables)}"
            by = dict(d)
            self._add(-residual, by, name, of=f"block {i}")
        without = {name for block in self.held for name in block.variables}
        for name, unknown in unknowns.items():
            if name not in without:
                self._prior(name, unknown)
        self.A = np.vstack([A for A, _, _, _ in self._parts])
        self.b = np.concatenate([b for _, b, _, _ in self._parts])
        self.kind = np.concatenate([np.full(len(b), kind) for _, b, kind, _ in self._parts])
        self.cluster = [c for _, _, _, cluster in self._parts for c in cluster]

    def _add(
        self, b: np.ndarray, by: Mapping, kind: str, cluster: list | None = None, of: str = ""
    ) -> None:
        first = sum(len(each) for _, each, _, _ in self._parts)
        self.rows_of[of or kind] = slice(first, first + len(b))
        A = np.zeros((len(b), len(self.sigma)))
        for name, d in by.items():
            A[:, self.at[name]] += d
        self._parts.append((A, b, kind, cluster or [None] * len(b)))

    def _prior(self, name: str, unknown: Unknown) -> None:
        def residual(values: Values) -> np.ndarray:
            return away(unknown, values[name])

        J = np.eye(unknown.dim)
        if unknown.kind != "vector":
            J = rigs.differences(residual, self.values, name, unknown.kind)
        root = rigs.whitening(unknown)
        b = -root @ residual(self.values)
        self._add(b, {name: root @ J}, f"prior:{name}")

    def _beams(self, number: int) -> None:
        """The rows of a stop, and which stop, mesh and surface (or plane) each errs with."""
        scan, association = self.problem.scans[number], self.associations[number]
        rows = scan.rows(self.values, association)
        weight, residual = rows.weight_m2, rows.residual_m
        root = np.sqrt(weight)
        placed = scan.stops.in_reference(scan.stops.rig.lidar_frame, self.values)
        by = {name: rows.by_twist @ d[0] for name, d in placed.d.items()} | dict(rows.dense)
        for c in rows.sparse:
            touched = np.flatnonzero(c.index >= 0)
            full = np.zeros((len(root), self.problem.variables[c.variable].dim))
            full[touched, c.components[c.index[touched]]] = c.value[touched]
            by[c.variable] = by.get(c.variable, 0.0) + full
        met = rows.view["surface" if "surface" in rows.view.columns else "plane"]
        cluster = [(number, scan.room, int(part)) for part in met]
        weighted = {name: root[:, None] * d for name, d in by.items()}
        self._add(-root * residual, weighted, "beams", cluster, of=f"scan {number}")
        if rows.spread is not None:
            self._add(
                -rows.spread.residual, rows.spread.columns, "beams", cluster, f"spread {number}"
            )

    # ------------------------------------------------------------------------- what follows from it

    def some(self, wanted: Callable[[str], bool]) -> tuple[np.ndarray, np.ndarray]:
        """Rows of the kinds wanted, in units of the priors' sigmas, and their right side."""
        chosen = np.array([wanted(kind) for kind in self.kind], bool)
        return self.A[chosen] * self.sigma, self.b[chosen]

    @property
    def step(self) -> np.ndarray:
        """The Gauss-Newton step (U,) of all unknowns."""
        return self.covariance @ (self.A.T @ self.b)

    @property
    def covariance(self) -> np.ndarray:
        """(U, U) of all unknowns."""
        size = np.linalg.norm(self.A, axis=0)
        unit = self.A / size
        return np.linalg.inv(unit.T @ unit) / np.outer(size, size)

    def columns(self, names: Collection[str]) -> np.ndarray:
        return np.concatenate([self.at[name] for name in names])

    def touched_by_stop(self, name: str) -> set[int]:
        """Numbers of the stops, scanned or tracked, whose place it has a part in."""
        stops: dict[object, int] = {}
        found = set()
        for scan in self.problem.scans:
            number = stops.setdefault((scan.recording.folder, scan.index), len(stops))
            found |= {number} if name in scan.stops.variables else set()
        for block in self.problem.blocks:
            for key in getattr(block, "stop_names", ()):
                number = stops.setdefault(key, len(stops))
                found |= {number} if name in block.variables else set()
        return found

    def inner(self, kept: Collection[str] = ()) -> list[str]:
        """Unknowns that belong to one stop alone, or to surfaces."""
        own = (Role.PLACE, Role.JOINTS)
        return [
            name
            for name, unknown in self.problem.variables.items()
            if unknown.role is Role.SURFACE
            or (unknown.role in own and len(self.touched_by_stop(name)) == 1 and name not in kept)
        ]
