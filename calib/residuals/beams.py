"""Beams: measured range against the range to the surface that the beam meets.

``r = measured - effects - t``, where ``t = n.(s - o) / n.u`` is the distance along the beam (origin
o, direction u) to the plane with normal n through s: that of the triangle hit, or one found in the
scans. With hit point h, everything that moves the beam or the surface moves r by

    d r = [h x n, n] / (n.u)  d(pose twist, lidar axes)
    d r = -1, -n.(z x h) / (n.u), -t n.e / (n.u)  d(range, azimuth, elevation error)
    d r = -n / (n.u)  d(surface point)
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from calib.effects import LazyColumn, OneHot, View
from calib.residuals.robust import tukey_cost, tukey_weight
from calib.residuals.spread import SpreadRows
from sensors.lidar import Beams
from sensors.recording import Scan


@dataclass(frozen=True)
class Columns:
    """Derivative of the rows by some components of one vector unknown, one non-zero per row.

    Args:
        variable: whose.
        index: (N,) which entry of `components` a row depends on; -1 for none.
        value: (N,) the derivative.
        components: (size,) indices into the unknown.
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
        from_middle_m: kind of part that may tilt -> (N, 2) how far from its middle each beam ends,
            along two axes of the surface; empty if not kept.
    """

    part: np.ndarray
    patches: Mapping[str, np.ndarray] = field(default_factory=dict)
    from_middle_m: Mapping[str, np.ndarray] = field(default_factory=dict)

    def only(self, some: np.ndarray) -> Association:
        """What some of the beams (n,) meet."""
        patches = {n: each[some] for n, each in self.patches.items()}
        away_m = {n: each[some] for n, each in self.from_middle_m.items()}
        return Association(self.part[some], patches, away_m)


@dataclass(frozen=True, eq=False)
class CellNumbers:
    """Which component of an unknown of the surfaces moves, or tilts, each part of a kind.

    Args:
        column: the kind: surface, region or patch.
        number: (L + 1,) of each part; -1 for those that it does not move, the last one too.
        axis: along which it tilts them, as of `Association.from_middle_m`; None where it moves them
            as a whole.
    """

    column: str
    number: np.ndarray
    axis: int | None = None

    @classmethod
    def of(cls, column: str, parts: np.ndarray, axis: int | None = None) -> CellNumbers:
        """Of parts (P,), ascending, that are moved by one component after another."""
        number = np.full(int(parts.max(initial=-1)) + 2, -1, np.int32)
        number[parts] = np.arange(len(parts))
        return cls(column, number, axis)

    @cached_property
    def components(self) -> np.ndarray:
        """(P,) those of the unknown."""
        return np.arange(int(self.number.max(initial=-1)) + 1)

    def of_beams(self, part: np.ndarray) -> np.ndarray:
        """Of the parts (N,) that beams meet; -1 where they meet none."""
        return self.number[np.minimum(part, len(self.number) - 1)]

    def columns(self, name: str, part: np.ndarray, association: Association) -> Columns:
        """How far beams find the surface along its normal, by the unknown of that name.

        Args:
            name: the unknown.
            part: (N,) the part of the kind that each beam meets; -1 for none.
            association: what they meet, with where in their parts.
        """
        along = np.ones(len(part))
        if self.axis is not None:
            along = association.from_middle_m[self.column][:, self.axis]
        return Columns(name, self.of_beams(part), along, self.components)


@dataclass(frozen=True)
class Surface:
    """What each beam meets, and what is known of it.

    Args:
        predicted_m: (N,) distance from the beam's origin; infinite where nothing is met.
        cosine: (N,) of incidence; 0 there.
        slope: (N, 3) the normal over its product with the beam's direction, lidar axes; 0 there.
        usable: (N,) False where nothing was hit, or a depth edge or grazing hit spoils the beam.
        columns: name -> (N, ...), or a function that gives it: label, surface, patch, plane, ...
        unknown: gives the derivatives of the residual by what of the surface is itself unknown, for
            beams that reach so far (N,) m.
    """

    predicted_m: np.ndarray
    cosine: np.ndarray
    slope: np.ndarray
    usable: np.ndarray
    columns: Mapping[str, LazyColumn]
    unknown: Callable[[np.ndarray], Sequence[Columns]]


@dataclass(frozen=True)
class Rows:
    """The rows of one stop at one state: residuals, their honest sigma, and their derivatives.

    Args:
        residual_m, sigma_m, weight: (N,); weight is robust, 0 to 1.
        reference_sigma_m: (N,) error of the reference along the beam, beyond `sigma_m`: carried by
            the surface's own unknowns where the model has them.
        scale: how many sigmas wide the bulk of the rows is, at least 1.
        view: what effects looked at.
        usable: (N,) False where the beam met nothing fit to compare with; its weight is 0.
        derive: gives `by_twist`, `dense` and `sparse`; many look at the residuals alone.
        spread: rows of the scatter within the hold, where an effect speaks of it.
    """

    residual_m: np.ndarray
    sigma_m: np.ndarray
    weight: np.ndarray
    reference_sigma_m: np.ndarray
    scale: float
    view: View
    usable: np.ndarray
    derive: Callable[[], tuple[np.ndarray, Mapping[str, np.ndarray], Sequence[Columns]]]
    spread: SpreadRows | None = None

    @cached_property
    def _derivatives(self) -> tuple[np.ndarray, Mapping[str, np.ndarray], Sequence[Columns]]:
        return self.derive()

    @property
    def by_twist(self) -> np.ndarray:
        """(N, 6) derivative by the lidar's right increment."""
        return self._derivatives[0]

    @property
    def dense(self) -> Mapping[str, np.ndarray]:
        """Unknown -> (N, P) derivatives."""
        return self._derivatives[1]

    @property
    def sparse(self) -> Sequence[Columns]:
        """Derivatives with one non-zero per row."""
        return self._derivatives[2]

    @property
    def median_m(self) -> float:
        """Median size of the residuals of usable rows."""
        return float(np.median(np.abs(self.residual_m[self.usable])))

    @property
    def cost(self) -> float:
        """Half the robust chi-square."""
        return tukey_cost(self.residual_m / self.sigma_m, self.scale)

    def scaled(self, scale: float) -> Rows:
        """The same rows, weighed as if their bulk were so many sigmas wide."""
        weight = tukey_weight(self.residual_m / self.sigma_m, scale)
        return replace(self, scale=scale, weight=np.where(self.usable, weight, 0.0))

    def heavier(self, times: np.ndarray) -> Rows:
        """The same rows, each as heavy as so many (N,) of its like."""
        spread = None if self.spread is None else self.spread.heavier(times)
        return replace(self, weight=self.weight * times, spread=spread)

    @property
    def weight_m2(self) -> np.ndarray:
        """Weight over variance (N,), 1/m2."""
        return self.weight / np.square(self.sigma_m)


def beam_derivative(beams: Beams, t: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """d residual by range, azimuth and elevation error (N, 3).

    With s the normal over its product with the direction u, ``s.e = (s_z - u_z) / hypot(u_x, u_y)``
    for the elevation's unit vector e.

    Args:
        beams: N beams.
        t: (N,) m, predicted.
        slope: (N, 3) s, lidar axes.
    """
    u = beams.direction
    hit = beams.origin_m + t[:, None] * u
    flat = np.maximum(np.hypot(u[:, 0], u[:, 1]), 1e-12)
    by_azimuth = slope[:, 0] * hit[:, 1] - slope[:, 1] * hit[:, 0]
    by_elevation = t * (u[:, 2] - slope[:, 2]) / flat
    return np.stack([np.full(len(t), -1.0), by_azimuth, by_elevation], axis=1)


def site_error(basis: np.ndarray | OneHot, theta: np.ndarray) -> np.ndarray:
    """``basis @ theta``: the error at the site, (N or 1, D)."""
    if not theta.any():
        return np.zeros((1, basis.values.shape[1] if isinstance(basis, OneHot) else basis.shape[1]))
    if isinstance(basis, OneHot):
        # Index -1 finds the zero appended.
        return basis.values * np.append(theta, 0.0)[basis.index][:, None]
    return basis @ theta


def turns_beams(basis: np.ndarray | OneHot) -> bool:
    """Whether an effect at BEAM has any part in azimuth or elevation."""
    values = basis.values if isinstance(basis, OneHot) else basis
    values = values[:1] if values.strides[0] == 0 else values  # one row stands for all
    return bool(np.any(values[:, 1:]))


def range_columns(variable: str, basis: np.ndarray | OneHot, rows: int) -> np.ndarray | Columns:
    """Derivative of the rows by the parameters of an effect that turns no beam."""
    if isinstance(basis, OneHot):
        return Columns(variable, basis.index, -basis.values[:, 0], np.arange(basis.size))
    return np.broadcast_to(-basis[:, 0], (rows, basis.shape[2]))


def effect_columns(
    variable: str, basis: np.ndarray | OneHot, by_site: np.ndarray
) -> np.ndarray | Columns:
    """Derivative of the rows by an effect's parameters: ``d r / d site @ basis``."""
    if isinstance(basis, OneHot):
        value = np.einsum("nd,nd->n", by_site, basis.values)
        return Columns(variable, basis.index, value, np.arange(basis.size))
    basis = np.broadcast_to(basis, (len(by_site), *basis.shape[1:]))
    return np.einsum("nd,ndp->np", by_site, basis)


def zero_at(lost: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Values (N, ...) with 0 at the lost rows."""
    out = np.array(values)
    out[lost] = 0.0
    return out


def growth_columns(basis: np.ndarray | OneHot, rows: int) -> np.ndarray:
    """Derivative (rows, P) of the log sigma by the parameters of an effect on the noise."""
    if not isinstance(basis, OneHot):
        return np.broadcast_to(basis[:, 0], (rows, basis.shape[2]))
    out = np.zeros((rows, basis.size + 1))  # the last stands for index -1: none
    out[np.arange(rows), basis.index] = basis.values[:, 0]
    return out[:, :-1]


@dataclass(frozen=True)
class Ranges:
    """What one stop's beams measured, against the surface that they met.

    Args:
        T_reference_lidar: (4, 4).
        scan: all N points of the stop.
        view: columns (N,) of the points, ranges and incidence as predicted for the beams as read.
        hit: (H,) indices of the points whose beam meets the surface.
        surface_m: (H, 3) where it does, corrected beams, in the reference's frame.
        direction, normal: (H, 3) of the corrected beams and of the surface, facing them, unit.
        raw_m: (H,) measured - predicted range, nothing corrected.
        corrected_m: (H,) the same, after what the model corrects of beams and surface.
    """

    T_reference_lidar: np.ndarray
    scan: Scan
    view: View
    hit: np.ndarray
    surface_m: np.ndarray
    direction: np.ndarray
    normal: np.ndarray
    raw_m: np.ndarray
    corrected_m: np.ndarray
