"""What the residuals of a run do along every covariate: exact sums over all rows, stop by stop.

No more than one stop is in memory. The band of a mean counts clusters, not rows: rows of one stop,
and rows on one surface, err together; see `calib.linear.binned`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from calib.linear.binned import BinnedSums

MOST_BINS, AZIMUTHS = 30, 180  # at most
COARSE, COARSE_RINGS = 48, 32  # parts of a turn, and groups of rings, of a small map of one stop
Z_EDGES = np.linspace(-5.0, 5.0, 101)
PLACE_COLUMNS = ("surface", "plane", "label")


@dataclass(frozen=True)
class Axis:
    """A covariate cut into bins.

    Args:
        name: column.
        edges: (B - 1,) ascending values between the bins; the first and last bin are open.
        names: of the bins, where each stands for one thing; else empty.
    """

    name: str
    edges: np.ndarray
    names: tuple[str, ...] = ()

    @classmethod
    def of_values(cls, name: str, values: np.ndarray, bins: int = MOST_BINS) -> Axis:
        """Bins of about equal count; a bin for each value where they are few."""
        values = values[np.isfinite(values)]
        distinct = np.unique(values)
        if len(distinct) <= bins:
            return cls(name, (distinct[1:] + distinct[:-1]) / 2)
        return cls(name, np.unique(np.quantile(values, np.arange(1, bins) / bins)))

    @classmethod
    def of_things(cls, name: str, numbers: Sequence[int], names: Sequence[str] = ()) -> Axis:
        """A bin for each of some ascending whole numbers."""
        numbers = np.asarray(numbers, float)
        return cls(name, (numbers[1:] + numbers[:-1]) / 2, tuple(names))

    @property
    def bins(self) -> int:
        return len(self.edges) + 1


@dataclass(frozen=True)
class StopResiduals:
    """The residuals of one stop.

    Args:
        columns: (N,) per point, as `residual_table` has them.
        stop: covariate -> the stop's value.
        room: number of the mesh that its beams met; surfaces are counted within it.
        sigma_angle_rad, sigma_reference_m: of the stop's LiDAR and mesh.
    """

    columns: Mapping[str, np.ndarray]
    stop: Mapping[str, float]
    room: int = 0
    sigma_angle_rad: float = 0.0
    sigma_reference_m: float = 0.0


@dataclass(frozen=True)
class ResidualCurve:
    """Residuals by the bins (B,) of a covariate: robustly weighted mean and spread.

    Args:
        axis: the bins.
        count: rows that the fit did not throw out.
        at: mean of the covariate.
        mean_m, std_m: of the residual; NaN in an empty bin.
        band_m: half the width of the 95 % band of the mean, NaN where a bin has one cluster.
    """

    axis: Axis
    count: np.ndarray
    at: np.ndarray
    mean_m: np.ndarray
    std_m: np.ndarray
    band_m: np.ndarray

    @property
    def rms_m(self) -> float:
        """How much of the residual depends on this covariate: rms over rows of the bins' means,
        what their bands would give by chance taken off."""
        known = np.isfinite(self.mean_m) & np.isfinite(self.band_m)
        if not known.any():
            return 0.0
        chance = np.square(self.band_m[known] / 1.96)
        square = np.average(np.square(self.mean_m[known]) - chance, weights=self.count[known])
        return float(np.sqrt(max(square, 0.0)))


class _Sums:
    """Sums over the rows of each bin of one axis."""

    def __init__(self, axis: Axis) -> None:
        self.axis = axis
        self.rows = np.zeros((3, axis.bins))  # count, w r^2, covariate
        self.binned = BinnedSums(axis.bins)

    def add(
        self, x: np.ndarray, residual: np.ndarray, weight: np.ndarray, place: np.ndarray
    ) -> None:
        """Take in one stop's rows; `place` numbers its surfaces among those of all stops."""
        known = np.isfinite(x)
        if not known.all():
            x, residual, weight, place = (v[known] for v in (x, residual, weight, place))
        bins = self.axis.bins
        b = np.searchsorted(self.axis.edges, x)
        each = (None, weight * np.square(residual), x)
        self.rows += [np.bincount(b, values, bins) for values in each]
        self.binned.add(b, residual, weight, place)

    def curve(self) -> ResidualCurve:
        """What the sums say."""
        count, squares, x = self.rows
        with np.errstate(invalid="ignore", divide="ignore"):
            found, clusters = self.binned.mean()
            spread = squares / self.binned.weight - found.mean**2
            return ResidualCurve(
                axis=self.axis,
                count=count.astype(int),
                at=x / count,
                mean_m=found.mean,
                std_m=np.sqrt(np.maximum(spread, 0.0)),
                band_m=found.each(clusters),
            )


@dataclass(frozen=True)
class Statistics:
    """What the residuals of a run do.

    Args:
        curves: covariate -> its curve.
        map_m: (rings, azimuths) mean residual, azimuth from -pi to pi; NaN where no beam went.
        z: (100,) how many rows have so many sigmas, in the bins of `Z_EDGES`.
        rows, kept: how many rows there are, and how many the fit did not throw out.
        variance_m2: what a row's sigma is made of: range noise, angle noise, reference.
        thrown: (rings, azimuths) share of the rows that the fit threw out; NaN where no beam went.
        thrown_m: their residuals.
    """

    curves: Mapping[str, ResidualCurve]
    map_m: np.ndarray
    z: np.ndarray
    rows: int
    kept: int
    variance_m2: Mapping[str, float]
    thrown: np.ndarray
    thrown_m: np.ndarray


def residual_statistics(
    tables: Iterable[StopResiduals], axes: Iterable[Axis], rings: int, azimuths: int = AZIMUTHS
) -> Statistics:
    """One pass over the residuals of a run.

    Args:
        tables: its stops.
        axes: the covariates to look at; one that a table lacks gets nothing from it.
        rings: how many rings the LiDARs have at most.
        azimuths: how many parts of a turn the map has.
    """
    sums, places = [_Sums(axis) for axis in axes], {}
    cells, beams, thrown_m = np.zeros((2, rings * azimuths)), np.zeros((2, rings * azimuths)), []
    z, counts, variance = np.zeros(len(Z_EDGES) - 1), np.zeros(2, int), np.zeros(3)
    for table in tables:
        kept = table.columns["weight"] > 0
        counts += len(kept), int(kept.sum())
        cell = _cell(table.columns, rings, azimuths)
        beams += [np.bincount(c, minlength=rings * azimuths) for c in (cell, cell[~kept])]
        thrown_m.append(table.columns["residual_m"][~kept])
        columns = {name: column[kept] for name, column in table.columns.items()}
        residual, weight = (columns[n].astype(float) for n in ("residual_m", "weight"))
        place = _numbered(columns, table.room, places)
        for each in sums:
            x = columns.get(each.axis.name, table.stop.get(each.axis.name))
            if x is not None:
                x = np.broadcast_to(np.asarray(x, float), residual.shape)
                each.add(x, residual, weight, place)
        cells += [np.bincount(cell[kept], v, rings * azimuths) for v in (weight, weight * residual)]
        z += np.histogram(residual / columns["sigma_m"], Z_EDGES)[0]
        variance += _variance(columns, table)
    with np.errstate(invalid="ignore", divide="ignore"):
        shown, thrown = ((c[1] / c[0]).reshape(rings, azimuths) for c in (cells, beams))
    parts = dict(zip(("range noise", "angle noise", "reference"), variance, strict=True))
    return Statistics(
        curves={s.axis.name: s.curve() for s in sums if s.rows[0].any()},
        map_m=shown,
        z=z,
        rows=int(counts[0]),
        kept=int(counts[1]),
        variance_m2={name: value / max(counts[1], 1) for name, value in parts.items()},
        thrown=thrown,
        thrown_m=np.concatenate([np.zeros(0), *thrown_m]),
    )


@dataclass(frozen=True)
class StopMaps:
    """A stop that was held out: before, in the fit of all stops, and in a fit without it.

    Args:
        name: of the stop.
        map_m: of each (rings, azimuths) mean residual; NaN where no beam went.
        rms_m: of each the rms over its beams that were not thrown out.
    """

    name: str
    map_m: tuple[np.ndarray, ...]
    rms_m: tuple[float, ...]


def stop_map(
    columns: Mapping[str, np.ndarray], rings: int, azimuths: int
) -> tuple[np.ndarray, float]:
    """Of one stop's residuals the mean (rings, azimuths) and the rms, as `StopMaps` has them."""
    kept = columns["weight"] > 0
    residual = columns["residual_m"][kept].astype(float)
    cell = _cell(columns, rings, azimuths)[kept]
    with np.errstate(invalid="ignore", divide="ignore"):
        mean, count = (np.bincount(cell, v, rings * azimuths) for v in (residual, None))
        shown = (mean / count).reshape(rings, azimuths)
    return shown, float(np.sqrt(np.mean(np.square(residual)))) if len(residual) else 0.0


@dataclass(frozen=True)
class StopMap:
    """One stop, coarsely.

    Args:
        name: of the stop.
        map_m: (rings or groups of rings, azimuths) mean residual; NaN where no beam went.
        rms_m: rms over its beams that were not thrown out.
        held_out: whether of a fit without it.
    """

    name: str
    map_m: np.ndarray
    rms_m: float
    held_out: bool


def coarse_map(
    columns: Mapping[str, np.ndarray], rings: int, azimuths: int
) -> tuple[np.ndarray, float]:
    """As `stop_map`, neighbouring rings together where they are more than `COARSE_RINGS`."""
    together = -(-rings // COARSE_RINGS)
    grouped = dict(columns) | {"ring": columns["ring"] // together}
    return stop_map(grouped, -(-rings // together), azimuths)


def _cell(columns: Mapping[str, np.ndarray], rings: int, azimuths: int) -> np.ndarray:
    """(N,) which cell of the map of ring and azimuth each row is in."""
    turn = ((columns["azimuth_rad"] / (2 * np.pi) + 0.5) * azimuths).astype(int)
    return columns["ring"] * azimuths + np.clip(turn, 0, azimuths - 1)


def _numbered(columns: Mapping[str, np.ndarray], room: int, among: dict[Any, int]) -> np.ndarray:
    """(N,) which place each row looks at, numbered among those of all stops."""
    kind = next(name for name in PLACE_COLUMNS if name in columns)
    distinct, local = np.unique(columns[kind], return_inverse=True)
    numbers = [among.setdefault((room, p), len(among)) for p in distinct.tolist()]
    return np.array(numbers, int)[local]


def _variance(columns: Mapping[str, np.ndarray], table: StopResiduals) -> np.ndarray:
    """Sums of (noise, angle, reference) variances m2, as the rows' sigmas hold them."""
    incidence = columns["incidence_rad"].astype(float)
    angle = np.square(table.sigma_angle_rad * columns["range_m"] * np.tan(incidence)).sum()
    reference = np.square(table.sigma_reference_m / np.cos(incidence)).sum()
    whole = np.square(columns["sigma_m"].astype(float)).sum()
    return np.array([max(whole - angle - reference, 0.0), angle, reference])
