"""One pass over all rows: the normal equations of model and candidates, and who says what.

At the solution of a fit every row is linear in what the model estimates and in what it does not:
``b = J d + Z g + noise``, whitened. The tests need two things of a million such rows: the Gram
matrix of ``[J | Z]``, and the gradient ``[J | Z]^T b`` of each cluster of rows that err together.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from scipy.sparse import csr_array, vstack

from calib.problem import Problem
from calib.residuals.beams import Rows, unknown_columns
from calib.residuals.rows import Group, gram
from calib.residuals.scan import ScanStop
from calib.residuals.tracker import TrackedBody
from calib.solve.fit import Estimate, Progress
from calib.solve.graph import Block, Graph

# What paper says of the hardware is no evidence against a candidate: its sigmas are widened so much
# that what only they would tell apart counts as a gauge.
WIDENED = 100.0
PLACES = ("surface", "plane")  # beams that meet the same one share its error


@dataclass(frozen=True)
class Linear:
    """Normal equations of U unknowns about a solution, and their right side by clusters of rows.

    Args:
        candidates: variables that the model does not have.
        at: variable -> its columns among the unknowns.
        information: (U, U) Gram matrix of all whitened rows, the model's priors included.
        gradient: (C, U) sparse, of each cluster; their sum is the whole gradient.
        stop: (C,) which stop the rows of a cluster belong to, -1 for none.
        place: (C,) which part of the room they look at, -1 for none.
        weight_m2: sum of the beams' weights over their variances [1/m2]; without beams that of the
            tracked positions.
    """

    candidates: tuple[str, ...]
    at: dict[str, slice]
    information: np.ndarray
    gradient: csr_array
    stop: np.ndarray
    place: np.ndarray
    weight_m2: float


def linearise(
    wide: Problem, estimate: Estimate, candidates: Sequence[str], progress: Progress
) -> Linear:
    """Linearise a problem that holds candidates beside the model, at the model's solution.

    Args:
        wide: the model's problem with the candidates' variables added.
        estimate: the model's solution.
        candidates: variables that the model does not have; they have no prior here.
        progress: called with what is being done, how many stops are done, and of how many.
    """
    return Sums(wide, estimate, candidates).walk(progress, "testing what is missing").total()


class Walk(ABC):
    """Visits all rows, linearised at a model's solution, cluster by cluster.

    Args:
        wide, estimate, candidates: as of `linearise`.
    """

    def __init__(self, wide: Problem, estimate: Estimate, candidates: Sequence[str]) -> None:
        variables = list((wide.variables | estimate.graph.variables).values())
        self.wide, self.estimate, self.candidates = wide, estimate, tuple(candidates)
        self.values = {n: wide.variables[n].mean for n in candidates} | estimate.values
        self.graph = Graph(variables, wide.blocks, frozenset(candidates))
        ends = np.cumsum([0, *(v.dim for v in variables)]).tolist()
        self.unknowns = ends[-1]
        self.at = {v.name: slice(i, k) for v, i, k in zip(variables, ends, ends[1:], strict=False)}
        self._stops: dict[object, int] = {}
        self._places: dict[object, int] = {}
        self._known_to: dict[str, set[int]] = {}
        self._tracked_m2 = 0.0

    @abstractmethod
    def beams(self, beams: LocalRows) -> None:
        """Take in a stop's beams."""

    @abstractmethod
    def others(
        self, A: np.ndarray, b: np.ndarray, columns: np.ndarray, stop: np.ndarray, place: np.ndarray
    ) -> None:
        """Take in whitened rows (m, n) over some columns, with the stop and place of each."""

    def walk(self, progress: Progress, what: str) -> Self:
        """Visit beams, then trackers and targets, then priors."""
        scans = self.wide.scans
        for i, scan in enumerate(scans):
            progress(what, i, len(scans))
            terms = self.estimate.scans[i].terms
            surfaces = [t for t in terms if t.variable not in self.wide.variables]
            room = next((t.variable.partition("/")[0] for t in surfaces), None)
            whole = replace(scan, terms=[*scan.terms, *surfaces])
            rows = whole.rows(self.values, self.estimate.associations[i])
            local = self._local(whole, rows, room or str(scan.recording.folder))
            self.beams(local)
            if rows.spread is not None:
                columns = np.concatenate([self._columns(n) for n in rows.spread.columns])
                A = np.hstack(list(rows.spread.columns.values()))
                stop, place = np.full(len(A), local.stop), local.places[local.cluster]
                self.others(A, -rows.spread.residual, columns, stop, place)
        priors = []
        for block, by, b in self.graph.linear_rows(self.values):
            if block is None:
                priors.append((*by.items(), b))
            else:
                self._block(block, by, b)
        for (name, A), b in priors:
            scale = 1.0 / WIDENED if name in self.wide.calibration else 1.0
            self.others(scale * A, scale * b, self._columns(name), *self._prior_clusters(name))
        return self

    def _local(self, scan: ScanStop, rows: Rows, room: str) -> LocalRows:
        parts, groups = unknown_columns(rows)
        placed = scan.stops.in_reference(scan.stops.rig.lidar_frame, self.values)
        columns = [*map(self._columns, placed.d)]
        columns += [self._columns(p.variable)[p.components] for p in parts]
        kind = next(name for name in PLACES if name in rows.view.columns)
        found, cluster = np.unique(rows.view[kind], return_inverse=True)
        stop = _number(self._stops, (scan.recording.folder, scan.index))
        for name in scan.stops.variables:
            self._known_to.setdefault(name, set()).add(stop)
        return LocalRows(
            np.hstack([rows.by_twist, *rows.dense.values()]),
            groups,
            rows.weight / np.square(rows.sigma_m),
            -rows.residual_m,
            np.hstack([d[0] for d in placed.d.values()]),
            np.concatenate(columns),
            cluster,
            stop,
            np.array([_number(self._places, (room, p)) for p in found.tolist()]),
        )

    def _block(self, block: Block, by: Mapping[str, np.ndarray], b: np.ndarray) -> None:
        """Rows of a tracked body, which err with their stops, or of a target."""
        stop = place = np.full(len(b), -1)
        if isinstance(block, TrackedBody):
            numbers = [_number(self._stops, name) for name in block.stop_names]
            stop = np.repeat(numbers, len(b) // len(numbers))
            self._tracked_m2 += len(numbers) / block.sigma_m**2
        else:
            place = np.full(len(b), _number(self._places, block.name))
        for name in by:
            self._known_to.setdefault(name, set()).update(np.unique(stop).tolist())
        columns = np.concatenate([self._columns(name) for name in by])
        self.others(np.hstack(list(by.values())), b, columns, stop, place)

    def _prior_clusters(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Stop and place of a prior's rows: of the one stop, or the surface, whose error it
        bounds; any other row stands alone."""
        known = self._known_to.get(name, set())
        room, _, kind = name.partition("/reference_")
        dofs = self.graph.variables[name].dofs
        nowhere = np.full(len(dofs), -1)
        if len(known) == 1 and -1 not in known:
            return np.full(len(dofs), *known), nowhere
        if kind:
            parts = np.array([int(dof.rpartition("_")[2]) for dof in dofs])
            surfaces = self.wide.meetings[int(room)].surface_of(kind, parts).tolist()
            return nowhere, np.array([_number(self._places, (room, s)) for s in surfaces])
        return nowhere, np.array([_number(self._places, (name, dof)) for dof in dofs])

    def _columns(self, variable: str) -> np.ndarray:
        return np.arange(self.at[variable].start, self.at[variable].stop)


@dataclass(frozen=True)
class LocalRows:
    """The beams of one stop over [twist | dense | sparse] columns.

    Args:
        dense: (N, 6 + d) derivatives by the lidar's twist and by unknowns.
        groups: columns of which each row touches one.
        weight: (N,) robust weight over variance, 1/m2.
        b: (N,) minus the residual, m.
        chain: (6, n) derivative of the twist by what places the lidar.
        columns: (n + d + sparse,) which unknowns those are, and the other columns.
        cluster: (N,) which of the places a row meets.
        stop: number of the stop.
        places: (G,) numbers of the places.
    """

    dense: np.ndarray
    groups: Sequence[Group]
    weight: np.ndarray
    b: np.ndarray
    chain: np.ndarray
    columns: np.ndarray
    cluster: np.ndarray
    stop: int
    places: np.ndarray

    def chained(self, rows: np.ndarray) -> np.ndarray:
        """Rows over [twist | others] as rows over `columns`."""
        return np.hstack([rows[:, :6] @ self.chain, rows[:, 6:]])

    def along(self, directions: np.ndarray) -> np.ndarray:
        """The rows (N, q) along directions (U, q) in all unknowns."""
        mine = directions[self.columns]
        twist, rest = self.chain @ mine[: self.chain.shape[1]], mine[self.chain.shape[1] :]
        dense = self.dense.shape[1] - 6
        out = self.dense @ np.vstack([twist, rest[:dense]])
        start = dense
        for g in self.groups:
            theirs = rest[start : start + g.size]
            value = np.where(g.index >= 0, g.value, 0.0)
            out += value[:, None] * theirs[np.maximum(g.index, 0)]
            start += g.size
        return out


class Sums(Walk):
    """Adds rows up to normal equations."""

    def __init__(self, wide: Problem, estimate: Estimate, candidates: Sequence[str]) -> None:
        super().__init__(wide, estimate, candidates)
        self._information = np.zeros((self.unknowns, self.unknowns))
        self._gradients: list[csr_array] = []
        self._clusters: list[np.ndarray] = []
        self._weight_m2 = 0.0

    def total(self) -> Linear:
        """What was added up."""
        stop, place = np.concatenate(self._clusters, axis=1)
        gradient = csr_array(vstack(self._gradients))
        weight_m2 = self._weight_m2 or self._tracked_m2
        return Linear(self.candidates, self.at, self._information, gradient, stop, place, weight_m2)

    def beams(self, beams: LocalRows) -> None:
        local = beams.chained(gram(beams.dense, list(beams.groups), beams.weight))
        self._information[np.ix_(beams.columns, beams.columns)] += beams.chained(local.T)
        gradient = beams.chained(_by_cluster(beams))
        self._add(gradient, beams.columns, np.full(len(gradient), beams.stop), beams.places)
        self._weight_m2 += float(beams.weight.sum())

    def others(
        self, A: np.ndarray, b: np.ndarray, columns: np.ndarray, stop: np.ndarray, place: np.ndarray
    ) -> None:
        self._information[np.ix_(columns, columns)] += A.T @ A
        (stop, place), cell = np.unique([stop, place], axis=1, return_inverse=True)
        pick = csr_array((b, cell, np.arange(len(b) + 1)), shape=(len(b), len(stop)))
        self._add(pick.T @ A, columns, stop, place)

    def _add(
        self, gradient: np.ndarray, columns: np.ndarray, stop: np.ndarray, place: np.ndarray
    ) -> None:
        found = csr_array(gradient)
        found = csr_array(
            (found.data, columns[found.indices], found.indptr),
            shape=(len(stop), self.unknowns),
        )
        self._gradients.append(found)
        self._clusters.append(np.stack([stop, place]))


def _number(among: dict[object, int], key: object) -> int:
    return among.setdefault(key, len(among))


def _by_cluster(beams: LocalRows) -> np.ndarray:
    """``[dense | groups]^T W b`` of each cluster of rows, (G, columns)."""
    rows, count = len(beams.b), len(beams.places)
    b = beams.weight * beams.b
    pick = csr_array((b, beams.cluster, np.arange(rows + 1)), shape=(rows, count))
    out = [pick.T @ beams.dense]
    for g in beams.groups:
        flat = np.where(g.index >= 0, beams.cluster * g.size + g.index, 0)
        value = np.where(g.index >= 0, g.value * b, 0.0)
        out.append(np.bincount(flat, value, count * g.size).reshape(count, g.size))
    return np.hstack(out)
