"""Beams: measured range against the range to the surface that the beam meets.

``r = measured - effects - t``, where ``t = n.(s - o) / n.u`` is the distance along the beam (origin
o, direction u) to the plane with normal n through s: that of the triangle hit, or one found in the
scans. With hit point h, everything that moves the beam or the surface moves r by

    d r = [h x n, n] / (n.u)  d(pose twist, lidar axes)
    d r = -1, -n.(z x h) / (n.u), -t n.e / (n.u)  d(range, azimuth, elevation error)
    d r = -n / (n.u)  d(surface point)
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from calib.effects import LazyColumn, OneHot, View
from calib.forward import Derivatives, Stops, Values
from calib.residuals.rows import Group, gram, split, square_root, tukey_cost, tukey_curvature
from calib.residuals.spread import SpreadRows
from chains import se3
from sensors.lidar import Beams


@dataclass(frozen=True)
class Columns:
    """Derivative of the rows by some components of one vector variable, one non-zero per row.

    Args:
        variable: whose.
        index: (N,) which entry of `components` a row depends on; -1 for none.
        value: (N,) the derivative.
        components: (size,) indices into the variable.
    """

    variable: str
    index: np.ndarray
    value: np.ndarray
    components: np.ndarray


@dataclass(frozen=True)
class Association:
    """What each beam meets, to be kept while a fit settles.

    Args:
        part: (N,) triangle or plane; -1 for nothing.
        patches: kind of patch -> (N,) patch of the surface, -1 for none; empty if not kept.
    """

    part: np.ndarray
    patches: Mapping[str, np.ndarray] = field(default_factory=dict)


@dataclass(frozen=True)
class Surface:
    """What each beam meets, and what is known of it.

    Args:
        predicted_m: (N,) distance from the beam's origin.
        normal: (N, 3) unit, facing the sensor, reference frame; zero where there is nothing.
        usable: (N,) False where nothing was hit, or a depth edge or grazing hit spoils the beam.
        columns: name -> (N, ...), or a function that gives it: label, surface, patch, plane, ...
        unknown: derivative of the residual by what of the surface is itself unknown.
    """

    predicted_m: np.ndarray
    normal: np.ndarray
    usable: np.ndarray
    columns: Mapping[str, LazyColumn]
    unknown: Sequence[Columns] = ()


@dataclass(frozen=True)
class Rows:
    """The rows of one stop at one state: residuals, their honest sigma, and their derivatives.

    Args:
        residual_m, sigma_m, weight: (N,); weight is robust, 0 to 1.
        reference_sigma_m: (N,) error of the reference along the beam, beyond `sigma_m`: carried by
            the surface's own unknowns where the model has them.
        scale: how many sigmas wide the bulk of the rows is, at least 1.
        by_twist: (N, 6) derivative by the lidar's right increment.
        dense: variable -> (N, P) derivatives.
        sparse: derivatives with one non-zero per row.
        view: what effects looked at.
        usable: (N,) False where the beam met nothing fit to compare with; its weight is 0.
        spread: rows of the scatter within the hold, where an effect speaks of it.
    """

    residual_m: np.ndarray
    sigma_m: np.ndarray
    weight: np.ndarray
    reference_sigma_m: np.ndarray
    scale: float
    by_twist: np.ndarray
    dense: Mapping[str, np.ndarray]
    sparse: Sequence[Columns]
    view: View
    usable: np.ndarray
    spread: SpreadRows | None = None

    @property
    def cost(self) -> float:
        """Half the robust chi-square."""
        return tukey_cost(self.residual_m / self.sigma_m, self.scale)


@dataclass(frozen=True)
class Part:
    """Columns of compressed rows that belong to some components of one variable."""

    variable: str
    columns: np.ndarray
    components: np.ndarray


@dataclass(frozen=True)
class PoseRows:
    """The six rows in which a stop's beams speak of its pose, as the graph sees them.

    They are quadratic about the state of linearisation in the lidar's twist and linear in the
    unknowns of beams and surfaces; the chain behind the twist stays fully nonlinear.

    Args:
        name: for messages.
        stops: the geometry of the stop (K = 1).
        frame: the lidar's frame.
        T0_lidar_reference: (4, 4) inverse of the pose of linearisation.
        by_twist: (6, 6), constant: (6,), by_part: (6, n) columns of the parts.
        parts: what those columns are.
        at: values of the parts' variables at linearisation.
    """

    name: str
    stops: Stops
    frame: str
    T0_lidar_reference: np.ndarray
    by_twist: np.ndarray
    constant: np.ndarray
    by_part: np.ndarray
    parts: Sequence[Part]
    at: Values

    kind = "beams"
    rows = 6

    @property
    def variables(self) -> tuple[str, ...]:
        where = (self.stops.reference,) if self.stops.reference else ()
        return (*self.stops.variables, *where, *self.at)

    def evaluate(self, values: Values, derivatives: bool) -> tuple[np.ndarray, Derivatives | None]:
        """Whitened rows and their derivatives."""
        placed = self.stops.in_reference(self.frame, values)
        twist = se3.log(self.T0_lidar_reference @ placed.T[0])
        residual = self.constant + self.by_twist @ twist
        residual = residual + _moved(self.by_part, self.parts, self.at, values)
        if not derivatives:
            return residual, None
        by_pose = self.by_twist @ se3.right_jacobian_inverse(twist)
        d = {name: by_pose @ columns[0] for name, columns in placed.d.items()}
        return residual, d | _by_variable(self.by_part, self.parts, self.at)


@dataclass(frozen=True)
class SharedRows:
    """What all stops' beams say of their shared unknowns, beyond each stop's six pose rows.

    Args:
        constant: (m,) and by_part: (m, n) columns of the parts.
        parts: what those columns are.
        at: values of the parts' variables at linearisation.
    """

    constant: np.ndarray
    by_part: np.ndarray
    parts: Sequence[Part]
    at: Values

    name = "beams of all stops"
    kind = "beams"

    @property
    def variables(self) -> tuple[str, ...]:
        return tuple(self.at)

    @property
    def rows(self) -> int:
        return len(self.constant)

    def evaluate(self, values: Values, derivatives: bool) -> tuple[np.ndarray, Derivatives | None]:
        """Whitened rows and their derivatives; linear."""
        residual = self.constant + _moved(self.by_part, self.parts, self.at, values)
        return residual, _by_variable(self.by_part, self.parts, self.at) if derivatives else None


@dataclass(frozen=True)
class CompressedScan:
    """A stop's rows in compressed form: at most P + 1 with the same cost and linearisation.

    Args:
        pose: the six rows that know the stop's pose.
        rest: (1 + n, 1 + n) Gram matrix of all others, [residual | columns of the parts]; it speaks
            of shared unknowns only, so the stops' simply add up.
        spread: the same, over [residual | columns] of its own parts, of the scatter.
    """

    pose: PoseRows
    rest: np.ndarray
    spread: tuple[np.ndarray, Sequence[Part], Values] | None = None


class SharedSum:
    """Adds up what stops say of their shared unknowns, so that no stop need be kept."""

    def __init__(self) -> None:
        self._at: dict[str, np.ndarray] = {}
        self._first: dict[str, int] = {}
        self._total = np.zeros((1, 1))

    def add(self, scan: CompressedScan) -> None:
        """Add one stop's."""
        self._add(scan.rest, scan.pose.parts, scan.pose.at)
        if scan.spread is not None:
            self._add(*scan.spread)

    def _add(self, matrix: np.ndarray, parts: Sequence[Part], at: Values) -> None:
        for name, value in at.items():
            if name not in self._at:
                self._at[name], self._first[name] = value, len(self._total)
                self._total = np.pad(self._total, (0, len(value)))
        columns = [self._first[p.variable] + p.components for p in parts]
        columns = np.concatenate([[0], *columns]).astype(int)
        self._total[np.ix_(columns, columns)] += matrix

    def rows(self) -> list[SharedRows]:
        """The sum as rows; none where there are no shared unknowns."""
        if not self._at:
            return []
        root = square_root(self._total)
        parts = [
            Part(name, self._first[name] - 1 + np.arange(len(v)), np.arange(len(v)))
            for name, v in self._at.items()
        ]
        return [SharedRows(root[:, 0], root[:, 1:], parts, self._at)]


def _moved(by_part: np.ndarray, parts: Sequence[Part], at: Values, values: Values) -> np.ndarray:
    out = np.zeros(len(by_part))
    for part in parts:
        moved = (values[part.variable] - at[part.variable])[part.components]
        out += by_part[:, part.columns] @ moved
    return out


def _by_variable(by_part: np.ndarray, parts: Sequence[Part], at: Values) -> Derivatives:
    d = {name: np.zeros((len(by_part), len(value))) for name, value in at.items()}
    for part in parts:
        d[part.variable][:, part.components] = by_part[:, part.columns]
    return d


def twist_derivative(hit: np.ndarray, n: np.ndarray) -> np.ndarray:
    """d residual by the lidar's right increment (N, 6).

    Args:
        hit: (N, 3) hit point, lidar axes.
        n: (N, 3) normal over n.u, lidar axes.
    """
    out = np.empty((len(n), 6))
    out[:, 0] = hit[:, 1] * n[:, 2] - hit[:, 2] * n[:, 1]
    out[:, 1] = hit[:, 2] * n[:, 0] - hit[:, 0] * n[:, 2]
    out[:, 2] = hit[:, 0] * n[:, 1] - hit[:, 1] * n[:, 0]
    out[:, 3:] = n
    return out


def beam_derivative(
    beams: Beams, t: np.ndarray, hit: np.ndarray, n: np.ndarray, turns: bool
) -> np.ndarray:
    """d residual by range, azimuth and elevation error (N, 3); arguments as above, t (N,) m.

    As n.u = 1 here, ``n.e = (n_z - u_z) / hypot(u_x, u_y)`` for the elevation's unit vector e.
    Without `turns`, where no effect turns a beam, the angles' columns are not computed but zero.
    """
    u = beams.direction
    if not turns:
        return np.broadcast_to([-1.0, 0.0, 0.0], (len(t), 3))
    flat = np.maximum(np.hypot(u[:, 0], u[:, 1]), 1e-12)
    by_azimuth = n[:, 0] * hit[:, 1] - n[:, 1] * hit[:, 0]
    by_elevation = t * (u[:, 2] - n[:, 2]) / flat
    return np.stack([np.full(len(t), -1.0), by_azimuth, by_elevation], axis=1)


def site_error(basis: np.ndarray | OneHot, theta: np.ndarray) -> np.ndarray:
    """``basis @ theta``: the error at the site, (N or 1, D)."""
    if isinstance(basis, OneHot):
        # Index -1 finds the zero appended.
        return basis.values * np.append(theta, 0.0)[basis.index][:, None]
    return basis @ theta


def turns_beams(basis: np.ndarray | OneHot) -> bool:
    """Whether an effect at BEAM has any part in azimuth or elevation."""
    values = basis.values if isinstance(basis, OneHot) else basis
    return bool(np.any(values[:, 1:]))


def effect_columns(
    variable: str, basis: np.ndarray | OneHot, by_site: np.ndarray
) -> np.ndarray | Columns:
    """Derivative of the rows by an effect's parameters: ``d r / d site @ basis``."""
    if isinstance(basis, OneHot):
        value = np.einsum("nd,nd->n", by_site, basis.values)
        return Columns(variable, basis.index, value, np.arange(basis.size))
    return np.einsum(
        "nd,ndp->np", by_site, np.broadcast_to(basis, (len(by_site), *basis.shape[1:]))
    )


def unknown_columns(rows: Rows) -> tuple[list[Part], list[Group]]:
    """The columns of a stop's rows by unknowns of beams and surfaces: dense ones, then sparse.

    Returns:
        The parts, with columns counted from 0, and the sparse columns that this stop touches.
    """
    parts, column = [], 0
    for variable, block in rows.dense.items():
        width = block.shape[1]
        parts.append(Part(variable, np.arange(column, column + width), np.arange(width)))
        column += width
    groups = []
    for c in rows.sparse:
        used = np.bincount(c.index + 1, minlength=len(c.components) + 1) > 0
        used[0] = False  # index -1: none
        renumbered = np.cumsum(used) - 1
        group = Group(renumbered[c.index + 1], c.value, int(renumbered[-1]) + 1)
        at = np.arange(column, column + group.size)
        parts.append(Part(c.variable, at, c.components[used[1:]]))
        groups.append(group)
        column += group.size
    return parts, groups


def compress(
    name: str,
    rows: Rows,
    stops: Stops,
    frame: str,
    T_reference_lidar: np.ndarray,
    values: Values,
    newton: bool,
) -> CompressedScan:
    """Whiten, weight and compress a stop's rows, linearised at the state `values`.

    With `newton` the rows' curvature takes the place of their weight, at the same gradient: fewer
    steps to the optimum, but not its covariance.
    """
    parts, groups = unknown_columns(rows)
    weight, residual = rows.weight, rows.residual_m
    if newton:
        weight = np.where(rows.usable, tukey_curvature(residual / rows.sigma_m, rows.scale), 0.0)
        residual = residual * (rows.weight / np.maximum(weight, 1e-300))
    dense = np.hstack([rows.by_twist, residual[:, None], *rows.dense.values()])
    total = gram(dense, groups, weight / np.square(rows.sigma_m))
    top, rest = split(total, 6)
    at = {v: np.array(values[v]) for v in dict.fromkeys(p.variable for p in parts)}
    T0 = se3.inverse(T_reference_lidar)
    pose = PoseRows(name, stops, frame, T0, top[:, :6], top[:, 6], top[:, 7:], parts, at)
    return CompressedScan(pose, rest, _spread_sum(rows, values))


def _spread_sum(rows: Rows, values: Values) -> tuple[np.ndarray, list[Part], Values] | None:
    if rows.spread is None:
        return None
    columns = rows.spread.columns
    whole = np.hstack([rows.spread.residual[:, None], *columns.values()])
    parts = [Part(name, np.zeros(0, int), np.arange(c.shape[1])) for name, c in columns.items()]
    return whole.T @ whole, parts, {name: np.array(values[name]) for name in columns}
