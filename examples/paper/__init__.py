"""The study that rigcal grew from, in one call: its recordings, methods, tables and figures.

Its recordings could not be had, so the simulator stands in for them. Every method learns from the
same stops and is judged by the same others.
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from calib import outputs
from calib.evaluation import tabled, write_evaluation
from calib.problem.model import Source
from calib.runs.calibrate import calibrate, grow, grown_model
from calib.runs.diagnose import diagnose
from calib.runs.reopen import reopened
from calib.runs.run import Run
from calib.simulation import simulate
from calib.solve.fit import Progress
from chains.errors import InputError
from sensors.documents import write_json

from . import figures, tables
from .case import Case, Columns, State, gather, well_seen
from .conditions import FULL, QUICK, Scale, seed_of
from .page import write_page
from .sequence import RINGS, offsets_by_ring, spheres_mm
from .shape import shape

__all__ = ["FULL", "QUICK", "Scale", "study"]

ON_PAPER, SEQUENCE, GRAPH = "on paper", "the study's sequence", "joint graph"


def study(
    out: Path | str,
    scale: Scale = FULL,
    workers: int = 1,
    progress: Progress = lambda what, done, total: None,
) -> dict[str, Any]:
    """Make the recordings, calibrate in every way, and write ``study.md``, its figures and numbers.

    What an interrupted call has fitted is taken up again.

    Args:
        out: folder for ``study.md``, ``study.json``, ``figures/``, and in a folder per LiDAR its
            recordings, runs and evaluated points.
        scale: how much is simulated.
        workers: LiDARs that are worked on at once, each in a process of its own if several.
        progress: called with what is being done, and how far it is; of several processes, when a
            LiDAR is done.

    Returns:
        What ``study.json`` holds; lengths in mm, angles in mrad.

    Raises:
        InputError: `out` holds something else under one of these names.
    """
    out = Path(out)
    done = dict(_each(scale, out, workers, progress))
    each = {sensor: done[sensor] for sensor in scale.sensors}
    results: dict[str, Any] = {"sensors": {sensor: one.row for sensor, one in each.items()}}
    seen = {sensor: one.points for sensor, one in each.items()}
    rings = {sensor: one.rings for sensor, one in each.items()}
    labels = next(iter(each.values())).labels
    captions = figures.draw(seen, labels, rings, out / "figures")
    results["shape"] = shape(results, seen, rings)
    write_json(out / "study.json", results)
    write_page(out / "study.md", results, captions, scale)
    return results


@dataclass(frozen=True)
class _One:
    """All of one LiDAR: its numbers, its points at the study's poses, each ring's offset (rings,) m
    by who says so, and the names of the materials."""

    row: dict[str, Any]
    points: Columns
    rings: dict[str, np.ndarray]
    labels: dict[int, str]


def _each(scale: Scale, out: Path, workers: int, progress: Progress) -> Iterator[tuple[str, _One]]:
    """Every LiDAR of the study as it is done."""
    if workers == 1:
        for sensor in scale.sensors:
            yield sensor, _one(sensor, scale, out, progress)
        return
    # Forked processes would share Open3D's threads, which do not survive that.
    with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn")) as pool:
        jobs = {pool.submit(_one, sensor, scale, out): sensor for sensor in scale.sensors}
        for done, job in enumerate(as_completed(jobs)):
            progress(jobs[job], done, len(jobs))
            yield jobs[job], job.result()


def _one(
    sensor: str,
    scale: Scale,
    out: Path,
    progress: Progress = lambda what, done, total: None,
) -> _One:
    """One LiDAR: recorded, calibrated in every way, judged."""

    def tell(what: str, done: int, total: int) -> None:
        progress(f"{sensor}: {what}", done, total)

    return _judged(_recorded(sensor, scale, out / sensor, tell), sensor in scale.explained, tell)


def _recorded(sensor: str, scale: Scale, folder: Path, tell: Progress) -> Case:
    """A LiDAR's three recordings."""
    seed = seed_of(sensor)
    simulate(scale.scanned(sensor), folder / "recording", seed, progress=tell)
    simulate(scale.one_joint(), folder / "circles", seed)
    simulate(scale.moving(), folder / "moving", seed)
    circles, moving = (Source.open(folder / name) for name in ("circles", "moving"))
    return Case(
        sensor=sensor, folder=folder / "recording", circles=circles, moving=moving, work=folder
    )


def _judged(case: Case, explained: bool, tell: Progress) -> _One:
    """Every number of one LiDAR."""
    before = case.placed()
    row, points = tables.cloud_to_mesh(before.evaluated(case.stops(), tell))
    points["left_out"] = np.isin(points["stop"], case.stops(True))
    learnt = well_seen(points) & ~points["left_out"]
    known = (points[c][learnt] for c in ("ring", "raw_signed_error_m", "count"))
    sequence = State(before.problem, offsets_by_ring(before.values, *known))
    labels = case.source.rig.labels
    with outputs.folder(case.work / "sequence", outputs.EVALUATION) as folder:
        stops = outputs.kept(folder, {}).each(
            "stops",
            len(case.stops()),
            lambda _: map(tabled, sequence.evaluated(case.stops(), tell)),
        )
        write_evaluation(stops, folder, labels)

    fitted = {name: case.fitted(run, tell) for name, run in _runs(case, explained, tell).items()}
    states = {ON_PAPER: case.on_paper(), SEQUENCE: sequence, **fitted}
    judged = {name: tables.judged(case, state, tell) for name, state in states.items()}
    last = list(fitted.values())[-1]
    by_arm = gather(case.placed(by_tracker=False).evaluated(case.stops(), tell))
    by_graph = gather(last.evaluated(case.stops(), tell))
    graphs = {name: judged[name][1] for name in fitted}
    result = {
        "table_3": tables.two_ways(case, states),
        "table_4": tables.planes(case, points, by_arm, by_graph),
        "table_5": row,
        "table_6": tables.offsets(points, graphs, sequence.values[RINGS]),
        "methods": {name: line for name, (line, _) in judged.items()},
        "spheres_mm": spheres_mm(case.source),
        "stops": {"learnt_from": len(case.stops(False)), "judged": len(case.stops(True))},
    }
    true_m = np.array(case.truth["effects"][RINGS])
    return _One(result, points, {"true": true_m, "graph": last.values[RINGS]}, labels)


def _runs(case: Case, explained: bool, tell: Progress) -> dict[str, Run]:
    """The joint graph, and the graph with what its diagnosis found missing: method -> run."""
    run = _kept(case.work / "graph")
    if run is None:
        run = calibrate([case.learnt_from], case.work / "graph", hold_out="none", progress=tell)
    if not explained:
        return {GRAPH: run}
    grown = _kept(case.work / "grown")
    if grown is None:
        missing = diagnose(run, tell, refits=False).worth_adding
        if not missing:
            return {GRAPH: run}
        grown = grow(run, grown_model(run, missing), case.work / "grown", tell)
    added = [name for name in grown.effects if name not in run.effects]
    return {GRAPH: run, f"{GRAPH} + {', '.join(added)}": grown}


def _kept(folder: Path) -> Run | None:
    """The run that an earlier call made here, if its recording is still the same."""
    try:
        run = Run.open(folder)
        reopened(run)
    except InputError:
        return None
    return run
