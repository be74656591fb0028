"""Sixty of a real arm's poses, chosen or drawn: how well do they predict all others?

    python -m tests.bench.bench_plan_real DATA

DATA is the folder of `examples/06_what_is_missing_in_a_ur10.py`. From a fit of 15 poses, 60 of
2,500 are chosen by the volume of the errors (D) and by the mean variance (A), or drawn; the model
of lengths, zeros and tilts is fitted to them, and held against 2,000 poses that nobody chose from.
"""

from __future__ import annotations

import shutil
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

import calib
from calib import problem as problems
from calib.linear.parallel import one_blas_thread
from calib.planning import planner_of
from calib.planning.criteria import Variance, Volume, chosen
from calib.planning.stops import Poses
from calib.problem.model import Source
from calib.results.errors import body_errors

sys.path.insert(0, str(Path(__file__).parents[2] / "examples"))
from ur10_tmac import recording

GEOMETRY = ("arm_link_length", "arm_joint_offset", "arm_axis_tilt")
FIRST, STOPS, CANDIDATES, HELD_OUT, DRAWS = 15, 60, 2500, 2000, 6


@dataclass(frozen=True)
class Series:
    """All poses, and a folder for recordings of some of them."""

    given: Path
    table: pd.DataFrame
    made: Path

    def some(self, rows: np.ndarray, name: str) -> Path:
        """The recording of some poses."""
        folder = self.made / name
        shutil.copytree(self.given, folder)
        self.table.iloc[np.sort(rows)].to_csv(folder / "stops.csv", index=False)
        return folder

    def fit(self, rows: np.ndarray, name: str) -> calib.Run:
        """The geometry, fitted to some poses."""
        recorded = self.some(rows, name)
        return calib.fit([recorded], f"{recorded} run", calib.Model(GEOMETRY), hold_out="none")


def error_mm(run: calib.Run, folder: Path) -> float:
    """Root mean square of what a run predicts of poses."""
    problem, state = problems.build([Source.open(folder)], calib.Model.read(run.model)), run.state()
    values = {name: state.get(name, value) for name, value in problem.initial.items()}
    return body_errors(problem.blocks, values, None).rms_mm


@one_blas_thread
def main(data: Path, made: Path) -> None:
    """Print a line for each way."""
    given = recording(data, "A", made / "all")
    series, rng = (
        Series(given, pd.read_csv(given / "stops.csv"), made),
        np.random.default_rng(0),
    )
    unseen = rng.choice(len(series.table), HELD_OUT, replace=False)
    rest = np.setdiff1d(np.arange(len(series.table)), unseen)
    held_out, pool = series.some(unseen, "held out"), rng.choice(rest, CANDIDATES, replace=False)
    start = series.fit(rng.choice(rest, FIRST, replace=False), "first")
    print(f"{FIRST} first: {error_mm(start, held_out):.3f} mm")
    planner = planner_of(start, "all")
    location, T = next(iter(planner.places.items()))
    joints = series.table[list(planner.scene.source.rig.joint_names)].to_numpy()[pool]
    poses = Poses(np.full(len(pool), location), joints, np.repeat(T[None], len(pool), 0))
    each, known = planner.look(poses, STOPS), planner.lasting
    at = known.at(planner.scene.calibration)
    ways = {"D": Volume(known, at), "A": Variance(known, at, np.ones(len(at)))}
    for name, by in ways.items():
        best = chosen(by, each, STOPS, lambda done, total: None, exchange=False)
        print(f"{STOPS} by {name}: {error_mm(series.fit(pool[best], name), held_out):.3f} mm")
    drawn = [
        error_mm(series.fit(rng.choice(pool, STOPS, replace=False), f"drawn {k}"), held_out)
        for k in range(DRAWS)
    ]
    print(f"{STOPS} drawn: {min(drawn):.3f} to {max(drawn):.3f} mm, median {np.median(drawn):.3f}")
    print(f"all {CANDIDATES}: {error_mm(series.fit(pool, 'many'), held_out):.3f} mm")


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        main(Path(sys.argv[1]), Path(folder))
