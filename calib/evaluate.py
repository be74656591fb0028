"""How accurate and how precise a LiDAR is: every return against the surface that its beam meets.

Per direction of a stop, with D the ranges of its n returns and D_true that of the surface:

    signed error = mean(D - D_true)        accuracy = mean|D - D_true|        precision = std(D)

Averaged holds give the mean e and standard deviation of D - D_true, not the returns themselves;
over normal returns, which scatter by s about their own mean, the mean of their sizes is that of a
folded normal (Leone et al. 1961),

    accuracy = s sqrt(2 / pi) exp(-e^2 / 2 s^2) + e erf(e / (s sqrt 2)).

Means and spreads are over returns: a direction counts as often as it was seen, and its returns
scatter by s about e, so a hold says the same raw or averaged.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from calib import problem as problems
from calib.calibrate import reopened
from calib.fit import Progress, values_of
from calib.forward import Values
from calib.model import Model
from calib.residuals.scan import Ranges, ScanStop
from calib.residuals.surfaces import MeshSurface
from calib.run import MODEL, Run
from chains.errors import InputError
from sensors.documents import replace_folder, write_json, write_yaml
from sensors.recording import write_table

EVALUATION, POINTS, MEANING = "evaluation.json", "points.parquet", "_columns.yaml"
COLUMNS = {
    "x_m y_m z_m": "mean return of the direction, in the reference's frame, corrected",
    "ring column": "of the direction, from 0",
    "count": "returns of the hold that the other columns are means of",
    "distance_m incidence_rad": "of the surface, from and against the beam",
    "label reference_intensity": "of the surface that the beam meets",
    "intensity": "as the LiDAR gives it",
    "signed_error_m": "mean of measured - true range, corrected by the model",
    "accuracy_m": "mean of its size",
    "precision_m": "standard deviation of a return",
    "raw_signed_error_m raw_accuracy_m": "the same, before correction",
}
# Width of a bin, in the unit of its name, and how to get there from the points' column.
BINS = {
    "ring": ("ring", 1.0, 1.0),
    "incidence_deg": ("incidence_rad", 5.0, np.degrees(1.0)),
    "distance_m": ("distance_m", 0.5, 1.0),
    "label": ("label", 1.0, 1.0),
}
NEAREST = 4096  # points of a stop whose nearest point of the mesh is sought: each costs many rays

Columns = dict[str, np.ndarray]


@dataclass(frozen=True)
class Evaluated:
    """One stop, evaluated.

    Args:
        rig, location, stop: whose it is.
        sensor: the LiDAR's model.
        points: the `COLUMNS` (H,) of the directions with a hit.
        nearest: rows (M,) of some of them; nearest_m: (M,) how far their mean return lies from the
            surface, negative before it as the sensor sees it; raw_nearest_m: uncorrected.
    """

    rig: str
    location: str
    stop: str
    sensor: str
    points: Columns
    nearest: np.ndarray
    nearest_m: np.ndarray
    raw_nearest_m: np.ndarray


def evaluate_stop(scan: ScanStop, values: Values) -> Evaluated:
    """Evaluate one stop, its rig standing where a state says."""
    ranges = scan.ranges(values)
    some = np.linspace(0, len(ranges.hit) - 1, min(NEAREST, len(ranges.hit))).astype(int)
    recording, rig = scan.recording, scan.stops.rig
    return Evaluated(
        rig.name,
        str(recording.location[scan.index]),
        scan.name,
        rig.lidar.name,
        _points(ranges),
        some,
        *(_nearest(scan, ranges, some, e[some]) for e in (ranges.corrected_m, ranges.raw_m)),
    )


def accuracy(error_m: np.ndarray, spread_m: np.ndarray) -> np.ndarray:
    """Mean size (N,) of normal errors with these means and standard deviations, as above."""
    from scipy.special import erf

    spread = np.where(spread_m > 0, spread_m, 1e-12)  # NaN, too: of one return, its own size
    z = error_m / (spread * np.sqrt(2.0))
    return spread * np.sqrt(2.0 / np.pi) * np.exp(-(z**2)) + error_m * erf(z)


def _points(ranges: Ranges) -> Columns:
    view, scan, hit = ranges.view, ranges.scan, ranges.hit
    spread_m, nothing = scan.range_std_m[hit], np.full(len(view["ring"]), np.nan)
    about_mean_m = spread_m * np.sqrt(1.0 - 1.0 / scan.count[hit])
    at = ranges.surface_m + ranges.corrected_m[:, None] * ranges.direction
    columns = {f"{axis}_m": at[:, k] for k, axis in enumerate("xyz")}
    columns |= {"ring": scan.ring[hit], "column": scan.column[hit], "count": scan.count[hit]}
    columns |= {
        "distance_m": view["range_m"][hit],
        "incidence_rad": view["incidence_rad"][hit],
        "label": (view["label"] if "label" in view.columns else np.zeros(len(nothing)))[hit],
        "reference_intensity": view.columns.get("reference_intensity", nothing)[hit],
        "intensity": scan.intensity[hit],
        "signed_error_m": ranges.corrected_m,
        "accuracy_m": accuracy(ranges.corrected_m, about_mean_m),
        "precision_m": spread_m,
        "raw_signed_error_m": ranges.raw_m,
        "raw_accuracy_m": accuracy(ranges.raw_m, about_mean_m),
    }
    whole = ("ring", "column", "label")
    return {n: c.astype(np.uint16 if n in whole else np.float32) for n, c in columns.items()}


def _nearest(scan: ScanStop, ranges: Ranges, some: np.ndarray, error_m: np.ndarray) -> np.ndarray:
    """Distance (M,) of mean returns from the surface: the nearest of a mesh, else their plane."""
    ahead_m = error_m[:, None] * ranges.direction[some]
    if isinstance(scan.meeting, MeshSurface):
        distance = scan.meeting.reference.distance_m(ranges.surface_m[some] + ahead_m)
        return np.copysign(distance, error_m)
    return -np.einsum("ni,ni->n", ahead_m, ranges.normal[some])


class Tally:
    """Means and spreads over returns of many stops, as sums: no stop need be kept.

    Args:
        raw: whether of the returns before correction.
    """

    def __init__(self, raw: bool = False) -> None:
        self.prefix = "raw_" if raw else ""
        self._whole = np.zeros(6)
        self._nearest = np.zeros(6)
        self._by: dict[str, dict[int, np.ndarray]] = {name: {} for name in BINS}

    def add(self, done: Evaluated) -> None:
        """Add a stop."""
        points = done.points
        error_m, accuracy_m = (
            points[f"{self.prefix}{name}_m"].astype(float) for name in ("signed_error", "accuracy")
        )
        count, spread_m = points["count"].astype(float), points["precision_m"].astype(float)
        sums = _sums(count, error_m, accuracy_m, spread_m)
        self._whole += sums.sum(axis=0)
        for name, (column, width, scale) in BINS.items():
            bins, index = np.unique(
                np.floor(points[column].astype(float) * scale / width).astype(int),
                return_inverse=True,
            )
            added = np.zeros((len(bins), sums.shape[1]))
            np.add.at(added, index, sums)
            for value, row in zip(bins.tolist(), added, strict=True):
                self._by[name][value] = self._by[name].get(value, 0.0) + row
        some = done.nearest
        away_m = done.raw_nearest_m if self.prefix else done.nearest_m
        across_m = spread_m[some] * np.cos(points["incidence_rad"][some])
        self._nearest += _sums(count[some], away_m, np.abs(away_m), across_m).sum(axis=0)

    def document(self, labels: Mapping[int, str]) -> dict[str, Any]:
        """What evaluation.json holds; lengths in mm, angles in degrees, bins by their middle."""
        whole, nearest = _row(self._whole), _row(self._nearest)
        return {
            "returns": whole["n"],
            "corrected": not self.prefix,
            "signed_error_mm": {"mean": whole["mean_mm"], "std": whole["std_mm"]},
            "accuracy_mm": whole["accuracy_mm"],
            "precision_mm": whole["precision_mm"],
            "cloud_to_mesh_mm": {"mean": nearest["mean_mm"], "std": nearest["std_mm"]},
            "by": {name: self._rows(name, labels) for name in BINS},
        }

    def _rows(self, name: str, labels: Mapping[int, str]) -> list[dict[str, Any]]:
        width, found = BINS[name][1], sorted(self._by[name].items())
        if name == "label":
            return [{"value": k, "name": labels.get(k, ""), **_row(row)} for k, row in found]
        middle = 0.0 if name == "ring" else 0.5
        return [{"value": (k + middle) * width, **_row(row)} for k, row in found]


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
        "std_mm": 1e3 * np.sqrt(max(0.0, squares / n - mean**2)),
        "accuracy_mm": 1e3 * sizes / n,
        "precision_mm": 1e3 * spread / known if known else None,
    }


def _each(scans: Sequence[ScanStop], values: Values, progress: Progress) -> Iterator[Evaluated]:
    for i, scan in enumerate(scans):
        progress("evaluating", i, len(scans))
        yield evaluate_stop(scan, values)


def evaluate(
    run: Run,
    out: Path | str | None = None,
    raw: bool = False,
    progress: Progress = lambda what, done, total: None,
) -> dict[str, Any]:
    """Evaluate a run's recordings, every stop where its fit put it.

    Args:
        run: the run; its model's effects of beams and reference are the corrections.
        out: the folder to write evaluation.json and points.parquet/ to; the run's own if None.
        raw: whether evaluation.json speaks of the returns before correction.
        progress: called with what is being done, and how far it is.

    Returns:
        What evaluation.json holds.

    Raises:
        InputError: the run's recordings are not what they were, or hold no scans.
    """
    sources = [reopened(recording, run) for recording in run.model["recordings"]]
    problem = problems.build(sources, Model.read(run.model, run.folder / MODEL))
    if not problem.scans:
        raise InputError(
            f"{run.folder}: its recordings hold no scans, so there is no LiDAR to evaluate"
        )
    values = values_of(problem, run.state())
    stops = _each(problem.scans, values, progress)
    return write_evaluation(stops, Path(out or run.folder), raw, sources[0].rig.labels)


def write_evaluation(
    stops: Iterable[Evaluated], folder: Path, raw: bool, labels: Mapping[int, str]
) -> dict[str, Any]:
    """Write evaluated stops as they come, and sum them up; one is in memory at a time.

    Args:
        stops: any number of them, evaluated.
        folder: where evaluation.json and points.parquet/ go; earlier ones are replaced.
        raw: as of `evaluate`.
        labels: their names, where they have any.

    Returns:
        What evaluation.json holds.
    """
    folder.mkdir(parents=True, exist_ok=True)
    tally = Tally(raw)
    with replace_folder(folder / POINTS, MEANING, "table of points") as points:
        write_yaml(points / MEANING, COLUMNS)
        for done in stops:
            tally.add(done)
            place = points / f"sensor={done.sensor}/location={done.location}/stop={done.stop}"
            place.mkdir(parents=True, exist_ok=True)
            write_table(place / f"{done.rig}.parquet", done.points)
        document = tally.document(labels)
        write_json(folder / EVALUATION, document)
    return document
