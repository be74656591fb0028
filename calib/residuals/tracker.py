"""Tracked bodies: what the tracker says of a body against where the chain puts it."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from calib.forward import Derivatives, Stops, Values
from calib.residuals.groups import Group
from chains import se3


@dataclass(frozen=True)
class TrackedBody:
    """One body at K stops that share every variable.

    ``r_rot = log(R_predicted^T R_measured)`` and ``r_pos = R_predicted^T (t_measured -
    t_predicted)``, each over its sigma. Rows of stops where the body was not seen are left out by
    the caller; a body seen as a point has the position rows only.

    Args:
        name: for messages.
        stops: the K stops.
        body: the body's frame.
        measured: (K, 4, 4) T_world_body; the rotation is not used for a point.
        sigma_m, sigma_rad: of one measurement, per axis.
        is_point: True when the tracker gives no orientation.
        bases: variable -> (K or 1, 6, P), what the tracker adds to the body's pose, per unit.
        stop_names: (K,) recording and number of each stop: rows of one err together.
        groups: (K,) the names of those rows.
        weight: (K,) robust weight of each stop's rows, 0 where set aside; 1 where None.
        scatter: unit, "m" or "rad" -> how widely it scatters beyond what its sigmas were at first.
    """

    name: str
    stops: Stops
    body: str
    measured: np.ndarray
    sigma_m: float
    sigma_rad: float
    is_point: bool
    bases: dict[str, np.ndarray]
    stop_names: Sequence[tuple[Path, int]] = ()
    groups: tuple[Group, ...] = ()
    weight: np.ndarray | None = None
    scatter: Mapping[str, float] = field(default_factory=lambda: {"m": 0.0, "rad": 0.0})

    kind = "tracker"

    @property
    def variables(self) -> tuple[str, ...]:
        return (*self.stops.variables, *self.bases)

    @property
    def rows(self) -> int:
        return len(self.measured) * (3 if self.is_point else 6)

    def scattering(self, unit: str, sd: float) -> TrackedBody:
        """The block with another spread beyond the sigma in this unit."""
        sigma = getattr(self, f"sigma_{unit}")
        wider = np.sqrt(sigma**2 - self.scatter[unit] ** 2 + sd**2)
        changed = {f"sigma_{unit}": float(wider), "scatter": {**self.scatter, unit: sd}}
        return replace(self, **changed)

    def setting_aside(self, tokens: Collection[str]) -> TrackedBody:
        """The block with these stops' rows, and no others, set aside; see `Group.token`."""
        now = np.ones(len(self.groups)) if self.weight is None else self.weight
        gone = np.array([group.token in tokens for group in self.groups])
        weight = np.where(gone, 0.0, np.where(now > 0, now, 1.0))
        return replace(self, weight=None if (weight == 1.0).all() else weight)

    def seen(self, values: Values) -> np.ndarray:
        """T_world_body (K, 4, 4) that the tracker should see."""
        added = sum((basis @ values[name] for name, basis in self.bases.items()), np.zeros((1, 6)))
        return self.stops.in_world(self.body, values, False).T @ se3.exp(added)

    def evaluate(self, values: Values, derivatives: bool) -> tuple[np.ndarray, Derivatives | None]:
        """Whitened rows, stop by stop [rotation, position], and their derivatives."""
        placed = self.stops.in_world(self.body, values, derivatives)
        d_seen = {name: np.asarray(d) for name, d in placed.d.items()}
        seen = placed.T
        if self.bases:
            added = sum(basis @ values[name] for name, basis in self.bases.items())
            seen = seen @ se3.exp(added)
            if derivatives:
                back = se3.adjoint(se3.inverse(se3.exp(added)))
                d_seen = {name: back @ d for name, d in d_seen.items()}
                d_seen |= {n: se3.right_jacobian(added) @ b for n, b in self.bases.items()}
        rows, by_twist = _pose_error(seen, self.measured)
        weight = 1.0 / np.repeat([self.sigma_rad, self.sigma_m], 3)
        keep = slice(3, 6) if self.is_point else slice(0, 6)
        if self.weight is not None:
            weight = weight * np.sqrt(self.weight)[:, None]
        residual = (rows * weight)[:, keep].ravel()
        if not derivatives:
            return residual, None
        by_twist = (by_twist * weight[..., None])[:, keep]
        return residual, {n: (by_twist @ d).reshape(len(residual), -1) for n, d in d_seen.items()}


@dataclass(frozen=True)
class BodiesTogether:
    """Blocks of one body at single stops, evaluated in one go.

    Args:
        blocks: as they are in the problem.
        whole: all of them as one block, see `Stops.together`.
    """

    blocks: Sequence[TrackedBody]
    whole: TrackedBody

    @classmethod
    def of(cls, blocks: Sequence[TrackedBody]) -> list[BodiesTogether]:
        """Blocks, grouped by what they share."""
        groups: dict[object, list[TrackedBody]] = {}
        for block in blocks:
            shared = tuple(n for n in block.variables if n not in block.stops.own)
            like = (block.body, block.is_point, id(block.stops.rig), len(block.measured), shared)
            groups.setdefault((*like, block.stops.noise is None), []).append(block)
        return [cls(found, _whole(found)) for found in groups.values()]

    def evaluate(self, values: Values) -> Iterator[tuple[np.ndarray, Derivatives]]:
        """Rows and derivatives of each block, as `TrackedBody.evaluate` gives them."""
        own = {
            name: np.concatenate([np.repeat(values[v][None], len(b.measured), 0) for v, b in pairs])
            for name, pairs in self._own().items()
        }
        residual, d = self.whole.evaluate({**values, **own}, True)
        count = len(self.blocks)
        rows = residual.reshape(count, -1)
        by = {name: x.reshape(count, rows.shape[1], -1) for name, x in d.items()}
        for k, block in enumerate(self.blocks):
            named = dict(zip(self.whole.stops.own, block.stops.own, strict=True))
            yield rows[k], {named.get(name, name): x[k] for name, x in by.items()}

    def _own(self) -> dict[str, list[tuple[str, TrackedBody]]]:
        names = self.whole.stops.own
        return {n: [(b.stops.own[i], b) for b in self.blocks] for i, n in enumerate(names)}


def _whole(blocks: Sequence[TrackedBody]) -> TrackedBody:
    first = blocks[0]
    bases = {
        n: np.concatenate(
            [np.broadcast_to(b.bases[n], (len(b.measured), *x.shape[1:])) for b in blocks]
        )
        for n, x in first.bases.items()
    }
    weights = [np.ones(len(b.measured)) if b.weight is None else b.weight for b in blocks]
    return replace(
        first,
        stops=Stops.together([b.stops for b in blocks]),
        measured=np.concatenate([b.measured for b in blocks]),
        bases=bases,
        weight=None if all(b.weight is None for b in blocks) else np.concatenate(weights),
    )


def _pose_error(predicted: np.ndarray, measured: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """[rotation, position] error in the predicted body's axes (K, 6), and its derivative by the
    predicted pose's right increment (K, 6, 6)."""
    R_t = predicted[:, :3, :3].mT
    rotation = se3.so3_log(R_t @ measured[:, :3, :3])
    position = np.matvec(R_t, measured[:, :3, 3] - predicted[:, :3, 3])
    d = np.zeros((len(measured), 6, 6))
    d[:, :3, :3] = -se3.so3_left_jacobian_inverse(rotation)
    d[:, 3:, :3] = se3.skew(position)
    d[:, 3:, 3:] = -np.eye(3)
    return np.concatenate([rotation, position], axis=1), d
