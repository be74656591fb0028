"""One LiDAR of the study: its recordings, the states that each method puts it in, their points."""

from __future__ import annotations

import csv
import json
import shutil
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from calib import outputs
from calib import problem as problems
from calib.evaluation import evaluate_stop
from calib.evaluation.tally import Evaluated
from calib.problem import Problem
from calib.problem.model import Model, Source
from calib.results import holdout
from calib.results.errors import Errors, row_errors
from calib.runs.reopen import model_of
from calib.runs.run import Run
from calib.solve.estimate import Start, values_of
from calib.solve.fit import Progress, solve

from . import sequence

Values = dict[str, np.ndarray]
Columns = dict[str, np.ndarray]

# The study's own filter of Table 6 and Fig. 9.
STEEP_RAD = np.radians(70.0)
DIM_SHARE = 0.1  # of the returns, those of lowest intensity


@dataclass(frozen=True)
class State:
    """Where a method puts everything: a problem of the whole recording, and its values."""

    problem: Problem
    values: Values

    def evaluated(self, names: Iterable[str], tell: Progress) -> Iterable[Evaluated]:
        """Each of these stops, evaluated."""
        chosen = set(names)
        scans = [scan for scan in self.problem.scans if scan.name in chosen]
        for i, scan in enumerate(scans):
            tell("evaluating", i, len(scans))
            yield evaluate_stop(scan, self.values)

    def held_out(self, names: Iterable[str]) -> Errors:
        """Range residuals of these stops' inliers, as a fit judges what it never saw."""
        chosen = set(names)
        scans = [scan for scan in self.problem.scans if scan.name in chosen]
        each = (scan.associate(self.values, near_edges=True) for scan in scans)
        pairs = zip(scans, each, strict=True)
        return sum((row_errors(s.rows(self.values, met)) for s, met in pairs), Errors())


@dataclass(frozen=True)
class Case:
    """A LiDAR's recordings.

    Args:
        sensor: the study's name of it.
        folder: of its scanned recording; its truth lies beside it.
        circles, moving: recordings of the same arm, one joint turning, and while it moves.
        work: folder for what is made of them.
    """

    sensor: str
    folder: Path
    circles: Source
    moving: Source
    work: Path

    @cached_property
    def source(self) -> Source:
        """The scanned recording."""
        return Source.open(self.folder)

    @cached_property
    def truth(self) -> dict[str, Any]:
        """What is true of it."""
        path = self.folder.with_name(f"{self.folder.name}.truth.json")
        return json.loads(path.read_text(encoding="utf-8"))

    @cached_property
    def left_out(self) -> np.ndarray:
        """(K,) bool, the stops that no method may learn from: about a fifth of the locations."""
        return holdout.folds([self.source], "location")[0][0]

    def stops(self, left_out: bool | None = None) -> list[str]:
        """Names of all stops, or of those left out, or of the others."""
        names = np.array(self.source.recording.stops)
        return names.tolist() if left_out is None else names[self.left_out == left_out].tolist()

    @cached_property
    def learnt_from(self) -> Path:
        """A recording of the stops that methods may learn from."""
        return _with_stops(self.folder, self.work / "learnt_from", set(self.stops(False)))

    @cached_property
    def problem(self) -> Problem:
        """The default model on the whole recording."""
        return problems.build([self.source], Model())

    @cached_property
    def lengths_m(self) -> np.ndarray:
        """The arm's lengths (E,) beyond the URDF's, from circles."""
        return sequence.lengths_from_circles(self.circles)

    def on_paper(self) -> State:
        """CAD and URDF at their word, poses by base markers and arm."""
        values = sequence.from_paper(self.problem)
        return State(self.problem, sequence.by_arm(self.source, self.problem, values))

    def placed(self, by_tracker: bool = True) -> State:
        """The study's sequence before any range offset: lengths from circles, poses by markers."""
        values = sequence.from_paper(self.problem, self.lengths_m)
        stand = sequence.by_tracker if by_tracker else sequence.by_arm
        return State(self.problem, stand(self.source, self.problem, values))

    def fitted(self, run: Run, tell: Progress) -> State:
        """A run's calibration, its stops where it put them, the others where tracker and arm do."""
        model = model_of(run)
        trained = problems.build([Source.open(self.learnt_from)], model)
        estimate = solve(trained, progress=tell, start=Start(run.state()))
        unseen = problems.build([self.source], model, [self.left_out], trained.meetings)
        others, _ = holdout.placed(unseen, trained, estimate)
        whole = problems.build([self.source], model, meetings=trained.meetings)
        return State(whole, values_of(whole, {**estimate.values, **others.values}))


def gather(stops: Iterable[Evaluated], left_out: Iterable[str] = ()) -> Columns:
    """The points (N,) of evaluated stops in one table.

    Beside the columns of points: `surface`, -1 where it is not flat; `stop` and `location` by name;
    and whether the stop was `left_out`.
    """
    out, tables = set(left_out), []
    for done in stops:
        size = len(done.surface)
        told = {"stop": done.stop, "location": done.location, "left_out": done.stop in out}
        each = {name: np.full(size, value) for name, value in told.items()}
        tables.append({**done.points, **each, "surface": done.surface})
    return {name: np.concatenate([table[name] for table in tables]) for name in tables[0]}


def well_seen(points: Mapping[str, np.ndarray]) -> np.ndarray:
    """(N,) bool: under 70 degrees, and not of the tenth with the lowest intensity."""
    dim = np.quantile(points["intensity"], DIM_SHARE)
    return (points["incidence_rad"] < STEEP_RAD) & (points["intensity"] > dim)


def _with_stops(recording: Path, out: Path, names: set[str]) -> Path:
    """A copy of a recording that has only the stops of these names."""
    with outputs.folder(out, outputs.RECORDING, [recording]) as copy:
        shutil.copytree(
            recording, copy, dirs_exist_ok=True, ignore=shutil.ignore_patterns("scans", "stops.csv")
        )
        (copy / "scans").mkdir()
        for name in names:
            shutil.copy(recording / "scans" / f"{name}.parquet", copy / "scans")
        with (
            (recording / "stops.csv").open(newline="", encoding="utf-8") as read,
            (copy / "stops.csv").open("w", newline="", encoding="utf-8") as write,
        ):
            table = csv.reader(read)
            header = next(table)
            kept = [row for row in table if row[header.index("stop")] in names]
            csv.writer(write, lineterminator="\n").writerows([header, *kept])
    return out
