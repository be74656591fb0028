"""Means, spreads and histograms over returns of many stops, as sums: no stop need be kept."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

Columns = dict[str, np.ndarray]

# Width of a bin, in the unit of its name, and how to get there from the points' column.
BIN_WIDTHS = {
    "ring": ("ring", 1.0, 1.0),
    "incidence_deg": ("incidence_rad", 5.0, np.degrees(1.0)),
    "distance_m": ("distance_m", 0.5, 1.0),
    "label": ("label", 1.0, 1.0),
}
STEP_M, REACH_M = 0.0005, 0.2  # of the histograms; what lies beyond is counted at their ends
ON_PLANE_M = 0.05  # further off its plane a return is of something else
FLAT_M = 0.003  # a surface whose triangles' corners scatter less about one plane is flat
PLANES = 12  # of the largest number of returns
UPPER = np.triu_indices(3)


@dataclass(frozen=True)
class Evaluated:
    """One stop, evaluated.

    Args:
        rig, location, stop: whose it is.
        sensor: the LiDAR's model.
        points: columns (H,), `calib.evaluation.COLUMNS`, of the directions with a hit.
        surface: (H,) which flat surface each lies on, -1 for none.
        direction: (H, 3) of the beams, in the reference's frame, unit.
        nearest: rows (M,) of some of them; nearest_m: (M,) how far their mean return lies from the
            surface, negative before it as the sensor sees it; raw_nearest_m: uncorrected.
    """

    rig: str
    location: str
    stop: str
    sensor: str
    points: Columns
    surface: np.ndarray
    direction: np.ndarray
    nearest: np.ndarray
    nearest_m: np.ndarray
    raw_nearest_m: np.ndarray


class Tally:
    """What many stops' returns add up to.

    Args:
        raw: whether of the returns before correction.
    """

    def __init__(self, raw: bool = False) -> None:
        self.prefix = "raw_" if raw else ""
        self._whole, self._within = np.zeros((2, 6))
        self._directions_beyond = 0
        self._nearest = np.zeros(6)
        self._by: dict[str, np.ndarray] = {name: np.zeros((0, 6)) for name in BIN_WIDTHS}
        self._errors = np.zeros(2 * round(REACH_M / STEP_M))
        self._spreads = np.zeros(round(REACH_M / STEP_M))
        self._planes: dict[str, dict[int, np.ndarray]] = {}
        self._label: dict[tuple[str, int], int] = {}

    def add(self, done: Evaluated) -> None:
        """Add a stop."""
        points = done.points
        error_m, accuracy_m = (
            points[f"{self.prefix}{name}_m"].astype(float) for name in ("signed_error", "accuracy")
        )
        count, spread_m = points["count"].astype(float), points["precision_m"].astype(float)
        sums = _sums(count, error_m, accuracy_m, spread_m)
        near = np.abs(error_m) < REACH_M
        self._whole += sums.sum(axis=0)
        self._within += sums[near].sum(axis=0)
        self._directions_beyond += int((~near).sum())
        for name, (column, width, scale) in BIN_WIDTHS.items():
            at = np.floor(points[column].astype(float) * (scale / width)).astype(int)
            self._by[name] = _added(self._by[name], _by_bin(at, sums))
        self._errors += _histogram(error_m + REACH_M, len(self._errors))
        self._spreads += _histogram(spread_m[np.isfinite(spread_m)], len(self._spreads))
        some = done.nearest
        away_m = done.raw_nearest_m if self.prefix else done.nearest_m
        across_m = spread_m[some] * np.cos(points["incidence_rad"][some])
        self._nearest += _sums(count[some], away_m, np.abs(away_m), across_m).sum(axis=0)
        self._add_planes(done, error_m, count, spread_m)

    def sums(self) -> dict[str, Any]:
        """All of them as JSON holds them."""
        planes = {
            rig: [[s, self._label[rig, s], *sums.tolist()] for s, sums in mine.items()]
            for rig, mine in self._planes.items()
        }
        return {
            "whole": self._whole.tolist(),
            "within": self._within.tolist(),
            "directions_beyond": self._directions_beyond,
            "nearest": self._nearest.tolist(),
            "by": {name: table.tolist() for name, table in self._by.items()},
            "errors": self._errors.tolist(),
            "spreads": self._spreads.tolist(),
            "planes": planes,
        }

    def include(self, sums: Mapping[str, Any]) -> None:
        """Add what another's `sums` told."""
        self._whole += sums["whole"]
        self._within += sums["within"]
        self._directions_beyond += sums["directions_beyond"]
        self._nearest += sums["nearest"]
        self._errors += sums["errors"]
        self._spreads += sums["spreads"]
        for name, table in sums["by"].items():
            self._by[name] = _added(self._by[name], np.reshape(table, (-1, 6)))
        for rig, planes in sums["planes"].items():
            mine = self._planes.setdefault(rig, {})
            for s, label, *moments in planes:
                mine[s] = mine.get(s, 0.0) + np.array(moments)
                self._label[rig, s] = label

    def _add_planes(
        self, done: Evaluated, error_m: np.ndarray, count: np.ndarray, spread_m: np.ndarray
    ) -> None:
        """Moments of the returns on every flat surface, about the reference's origin."""
        points = done.points
        rows = np.flatnonzero((done.surface >= 0) & (np.abs(error_m) < ON_PLANE_M))
        if not len(rows):
            return
        xyz = np.stack([points[f"{axis}_m"][rows] for axis in "xyz"], axis=1).astype(float)
        if self.prefix:  # the points' own columns are corrected
            back = (error_m - points["signed_error_m"])[rows]
            xyz += back[:, None] * done.direction[rows]
        n = count[rows]
        within = n * np.square(
            np.nan_to_num(spread_m[rows]) * np.cos(points["incidence_rad"][rows])
        )
        second = xyz[:, UPPER[0]] * xyz[:, UPPER[1]] * n[:, None]
        moments = np.column_stack([n, n[:, None] * xyz, second, within])
        surface = done.surface[rows]
        planes = _by_bin(surface, moments)
        label = np.zeros(len(planes), int)
        label[surface] = points["label"][rows]
        mine = self._planes.setdefault(done.rig, {})
        for s in np.flatnonzero(planes[:, 0]).tolist():
            mine[s] = mine.get(s, 0.0) + np.append(planes[s], 1.0)
            self._label[done.rig, s] = int(label[s])

    def document(self, labels: Mapping[int, str]) -> dict[str, Any]:
        """What evaluation.json holds; lengths in mm, angles in degrees, bins by their middle."""
        whole, nearest = _row(self._whole), _row(self._nearest)
        low_m, middle_m, high_m = _quantiles(self._errors, (0.15865, 0.5, 0.84135)).tolist()
        return {
            "returns": whole["n"],
            "corrected": not self.prefix,
            "signed_error_mm": {
                "mean": whole["mean_mm"],
                "std": whole["std_mm"],
                "median": 1e3 * (middle_m - REACH_M),
                "half_68": 1e3 * (high_m - low_m) / 2,
                "far": self._far(),
            },
            "accuracy_mm": whole["accuracy_mm"],
            "precision_mm": whole["precision_mm"],
            "cloud_to_mesh_mm": {"mean": nearest["mean_mm"], "std": nearest["std_mm"]},
            "by": {name: self._rows(name, labels) for name in BIN_WIDTHS},
            "histograms": {
                "signed_error_mm": _counts(self._errors, -REACH_M),
                "precision_mm": _counts(self._spreads, 0.0),
            },
            "planes": self._thickness(labels),
        }

    def _far(self) -> dict[str, Any] | None:
        """What lies beyond the histogram, which a few returns that a mesh does not explain may make
        mean and standard deviation of all; None where nothing does."""
        if not self._directions_beyond:
            return None
        rest = _row(self._within) if self._within[0] else {"mean_mm": None, "std_mm": None}
        return {
            "beyond_mm": 1e3 * REACH_M,
            "directions": self._directions_beyond,
            "returns": round(self._whole[0] - self._within[0]),
            "mean_without_mm": rest["mean_mm"],
            "std_without_mm": rest["std_mm"],
        }

    def _rows(self, name: str, labels: Mapping[int, str]) -> list[dict[str, Any]]:
        width = BIN_WIDTHS[name][1]
        filled = [(k, row) for k, row in enumerate(self._by[name]) if row[0]]
        if name == "label":
            return [{"value": k, "name": labels.get(k, ""), **_row(row)} for k, row in filled]
        middle = 0.0 if name == "ring" else 0.5
        return [{"value": (k + middle) * width, **_row(row)} for k, row in filled]

    def _thickness(self, labels: Mapping[int, str]) -> list[dict[str, Any]]:
        """Standard deviation of returns across the plane that fits them best, most seen first."""
        planes = [
            {
                "rig": rig,
                "surface": s,
                "label": labels.get(self._label[rig, s], str(self._label[rig, s])),
                "n": round(moments[0]),
                "stops": round(moments[-1]),
                "thickness_mm": 1e3 * thickness(moments[:-1]),
            }
            for rig, mine in self._planes.items()
            for s, moments in mine.items()
        ]
        return sorted(planes, key=lambda plane: -plane["n"])[:PLANES]


def thickness(moments: np.ndarray) -> float:
    """Standard deviation, m, across the best plane of returns with these sums (11,): their number,
    the sums of x, of x x' (its 6 different entries), and of the variances across the plane that
    their means hide."""
    n, mean, within = moments[0], moments[1:4] / moments[0], moments[10]
    spread = np.zeros((3, 3))
    spread[UPPER] = moments[4:10] / n
    spread = spread + np.triu(spread, 1).T - np.outer(mean, mean)
    return float(np.sqrt(max(0.0, np.linalg.eigvalsh(spread)[0]) + within / n))


def _by_bin(at: np.ndarray, sums: np.ndarray) -> np.ndarray:
    """Sums (B, C) of the rows (N, C) of each bin (N,), as the product with a table of ones."""
    from scipy.sparse import csr_array

    rows = np.arange(len(at) + 1)
    of_bin = csr_array((np.ones(len(at)), at, rows), shape=(len(at), int(at.max(initial=-1)) + 1))
    return of_bin.T @ sums


def _added(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The sum of two tables by bin, of which either may end sooner."""
    short, long = sorted((a, b), key=len)
    out = long.copy()
    out[: len(short)] += short
    return out


def _histogram(values_m: np.ndarray, size: int) -> np.ndarray:
    at = np.clip(np.floor(values_m / STEP_M), 0, size - 1).astype(int)
    return np.bincount(at, minlength=size)


def _quantiles(counts: np.ndarray, shares: tuple[float, ...]) -> np.ndarray:
    """Quantiles, m from the histogram's left end, evenly spread within a bin."""
    total = np.append(0.0, np.cumsum(counts))
    return np.interp(np.array(shares) * total[-1], total, STEP_M * np.arange(len(total)))


def _counts(counts: np.ndarray, left_m: float) -> dict[str, Any]:
    """A histogram of directions: the width of its bins, where the first begins, their counts."""
    used = np.flatnonzero(counts)
    first, last = (used[0], used[-1] + 1) if len(used) else (0, 0)
    left_mm = 1e3 * (left_m + first * STEP_M)
    return {
        "width": 1e3 * STEP_M,
        "left": left_mm,
        "directions": counts[first:last].astype(int).tolist(),
    }


def _sums(
    count: np.ndarray, error_m: np.ndarray, accuracy_m: np.ndarray, spread_m: np.ndarray
) -> np.ndarray:
    """(N, 6): returns, their errors, squares and sizes; spreads, and whether known."""
    known = np.isfinite(spread_m)
    spread = np.where(known, spread_m, 0.0)
    squares = count * error_m**2 + (count - 1.0) * spread**2
    return np.stack([count, count * error_m, squares, count * accuracy_m, spread, known], axis=1)


def _row(sums: np.ndarray) -> dict[str, Any]:
    n, total, squares, sizes, spread, known = sums.tolist()
    mean = total / n
    return {
        "n": round(n),
        "mean_mm": 1e3 * mean,
        "std_mm": 1e3 * float(np.sqrt(max(0.0, squares / n - mean**2))),
        "accuracy_mm": 1e3 * sizes / n,
        "precision_mm": 1e3 * spread / known if known else None,
    }
