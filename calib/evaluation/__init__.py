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

import re
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from calib import outputs
from calib.evaluation.tally import FLAT_M, Columns, Evaluated, Tally
from calib.forward import Values
from calib.linear.parallel import one_blas_thread, over_stops
from calib.residuals.beams import Ranges
from calib.residuals.scan import ScanStop
from calib.residuals.surfaces import Meeting, MeshSurface
from calib.runs.reopen import identity, problem_of, reopened, state_of
from calib.runs.run import Run
from calib.solve.estimate import values_of
from calib.solve.fit import Progress
from chains.errors import InputError
from sensors.documents import write_json, write_yaml
from sensors.recording import table_bytes

EVALUATION_FILE, POINTS_FILE, MEANING_FILE = "evaluation.json", "points.parquet", "_columns.yaml"
POINT_COLUMNS = {
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
_APART = re.compile(r"[%/\\=]")  # what would end a part of a path, or its key
# Points of a stop whose nearest point of the mesh is sought: each costs many rays.
NEAREST_SOUGHT = 1024


def _part(name: str) -> str:
    """A name as a part of a path, where readers of such folders find it again."""
    return _APART.sub(lambda found: f"%{ord(found[0]):02X}", name)


def evaluate_stop(scan: ScanStop, values: Values) -> Evaluated:
    """Evaluate one stop, its rig standing where a state says."""
    ranges = scan.ranges(values)
    some = np.linspace(0, len(ranges.hit) - 1, min(NEAREST_SOUGHT, len(ranges.hit))).astype(int)
    rig = scan.stops.rig
    return Evaluated(
        rig=rig.name,
        location=str(scan.recording.location[scan.index]),
        stop=scan.name,
        sensor=rig.lidar.name,
        points=_points(ranges),
        surface=_flat(scan.meeting, ranges),
        direction=ranges.direction,
        nearest=some,
        nearest_m=_nearest(scan, ranges, some, ranges.corrected_m[some]),
        raw_nearest_m=_nearest(scan, ranges, some, ranges.raw_m[some]),
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
    stated = "reference_intensity" in view.columns
    at = ranges.surface_m + ranges.corrected_m[:, None] * ranges.direction
    columns = {f"{axis}_m": at[:, k] for k, axis in enumerate("xyz")}
    columns |= {"ring": scan.ring[hit], "column": scan.column[hit], "count": scan.count[hit]}
    columns |= {
        "distance_m": view["range_m"][hit],
        "incidence_rad": view["incidence_rad"][hit],
        "label": (view["label"] if "label" in view.columns else np.zeros(len(nothing)))[hit],
        "reference_intensity": (view["reference_intensity"] if stated else nothing)[hit],
        "intensity": scan.intensity[hit],
        "signed_error_m": ranges.corrected_m,
        "accuracy_m": accuracy(ranges.corrected_m, about_mean_m),
        "precision_m": spread_m,
        "raw_signed_error_m": ranges.raw_m,
        "raw_accuracy_m": accuracy(ranges.raw_m, about_mean_m),
    }
    whole = ("ring", "column", "label")
    return {n: c.astype(np.uint16 if n in whole else np.float32) for n, c in columns.items()}


def _flat(meeting: Meeting, ranges: Ranges) -> np.ndarray:
    """Which flat surface (H,) the beams meet, -1 for none; planes found in scans are all flat."""
    if not isinstance(meeting, MeshSurface):
        return np.asarray(ranges.view["plane"])[ranges.hit]
    surface = np.asarray(ranges.view["surface"])[ranges.hit]
    return np.where(meeting.roughness_m[surface] < FLAT_M, surface, -1)


def _nearest(scan: ScanStop, ranges: Ranges, some: np.ndarray, error_m: np.ndarray) -> np.ndarray:
    """Distance (M,) of mean returns from the surface: the nearest of a mesh, else their plane."""
    ahead_m = error_m[:, None] * ranges.direction[some]
    if isinstance(scan.meeting, MeshSurface):
        distance = scan.meeting.reference.distance_m(ranges.surface_m[some] + ahead_m)
        return np.copysign(distance, error_m)
    return -np.einsum("ni,ni->n", ahead_m, ranges.normal[some])


def tabled(done: Evaluated, raw: bool = False) -> outputs.Finished:
    """A stop as it is written: its path under ``points.parquet`` and its sums, and its points.

    Args:
        done: the stop.
        raw: whether its sums are of the returns before correction.
    """
    tally = Tally(raw)
    tally.add(done)
    names = {"sensor": done.sensor, "location": done.location, "stop": done.stop}
    folders = [f"{key}={_part(name)}" for key, name in names.items()]
    path = "/".join([*folders, f"{done.rig}.parquet"])
    return {"path": path, "sums": tally.sums()}, table_bytes(done.points)


def _of_stop(values: Values, raw: bool, scan: ScanStop) -> outputs.Finished:
    return tabled(evaluate_stop(scan, values), raw)


@one_blas_thread
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
    if out is None:
        place = outputs.entries(run.folder, outputs.RUN)
    else:
        place = outputs.folder(out, outputs.EVALUATION, [run.folder, *run.inputs])
    with place as folder:
        sources = [source.of_beams(None) for source in reopened(run)]
        problem = problem_of(run, sources)
        if not problem.scans:
            raise InputError(
                f"{run.folder}: its recordings hold no scans, so there is no LiDAR to evaluate"
            )
        scans, values = problem.scans, values_of(problem, state_of(run, problem))
        work = partial(_of_stop, values, raw)
        stops = outputs.kept(folder, {**identity(run), "raw": raw}).each(
            "stops to evaluate",
            len(scans),
            lambda some: over_stops(work, [scans[i] for i in some]),
            partial(progress, "evaluating"),
        )
        return write_evaluation(stops, folder, sources[0].rig.labels, raw, run.before_use)


def evaluate_all(
    runs: Sequence[Run],
    out: Path | str | None = None,
    raw: bool = False,
    progress: Progress = lambda what, done, total: None,
) -> dict[str, dict[str, Any]]:
    """Evaluate several runs as `evaluate` does one, each into ``out/<its name>`` if `out` is given.

    Returns:
        What each evaluation.json holds, by the run's folder.

    Raises:
        InputError: as `evaluate`; or two runs would be written to one folder.
    """
    names = [run.folder.resolve().name for run in runs]
    for name in names if out and len(runs) > 1 else ():
        if names.count(name) > 1:
            raise InputError(f"{out}: two runs are called {name}; evaluate them one by one")
    places = [out if len(runs) == 1 or out is None else Path(out) / name for name in names]
    pairs = list(zip(runs, places, strict=True))
    for run, place in pairs if out else ():  # before the first is written
        outputs.refuse(place, outputs.EVALUATION, [run.folder, *run.inputs])
    return {str(run.folder): evaluate(run, place, raw, progress) for run, place in pairs}


def write_evaluation(
    stops: Iterable[outputs.KeptPart],
    folder: Path,
    labels: Mapping[int, str],
    raw: bool = False,
    warnings: Sequence[str] = (),
) -> dict[str, Any]:
    """Write evaluated stops as they come, and sum them up; one is in memory at a time.

    Args:
        stops: any number of them, as `tabled` has each.
        folder: where evaluation.json and points.parquet/ go; neither is there yet.
        labels: their names, where they have any.
        raw: as of `evaluate`.
        warnings: what is to stand above everything that is shown of the run.

    Returns:
        What evaluation.json holds.
    """
    points = folder / POINTS_FILE
    points.mkdir(parents=True)
    tally = Tally(raw)
    write_yaml(points / MEANING_FILE, POINT_COLUMNS)
    for stop in stops:
        tally.include(stop.told["sums"])
        stop.put(points / stop.told["path"])
    document = {"warnings": list(warnings), **tally.document(labels)}
    write_json(folder / EVALUATION_FILE, document)
    return document
