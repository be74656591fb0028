"""Sixty of a real arm's poses, chosen or drawn: how well do they predict all others?

    python -m tests.bench.bench_plan_real DATA

DATA is the folder of `examples/06_what_is_missing_in_a_ur10.py`. From a fit of 15 poses, 60 of
2,500 are chosen by the volume of the errors (D), by the mean variance (A), by each of the
observability indices of the literature (O1 to O5; see `observability`), by what is left once the
worst pose is lost, by how well the tool's place is predicted, or drawn; the model of lengths, zeros
and tilts is fitted to them, and held against 2,000 poses that nobody chose from. How well the same
model is known from them is printed as well: the mean over parameters of sigma over that of all
2,500.
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
from calib.planning.criteria import (
    Criterion,
    PredictionVariance,
    Variance,
    Volume,
    chosen,
    observability,
)
from calib.planning.information import Information
from calib.planning.reliability import Reliable
from calib.planning.room.workspace import moved_anywhere
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


class Index(Criterion):
    """One of the observability indices of some components (n,)."""

    def __init__(self, known: Information, of: np.ndarray, name: str) -> None:
        self.start, self.at, self.name = known.data + known.paper, of, name

    def of(self, M: np.ndarray) -> np.ndarray:
        """Of designs (n,), from their information (n, S, S); all have as many stops."""
        C = np.linalg.inv(M)[:, self.at[:, None], self.at]
        s = 1.0 / np.sqrt(np.maximum(np.linalg.eigvalsh(C), 1e-300))
        return observability(s, 1)[self.name]


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
    many = series.fit(pool, "many")
    print(f"all {CANDIDATES}: {error_mm(many, held_out):.3f} mm")

    def told(rows: np.ndarray, name: str) -> tuple[float, float]:
        """Held-out error, mm, and how many times wider than of all poses sigmas are."""
        run = series.fit(rows, name)
        sigma = (np.sqrt(np.diag(each.solution.graph)) for each in (run, many))
        return error_mm(run, held_out), float(np.mean(next(sigma) / next(sigma)))

    ways = {"D": Volume(known, at), "A": Variance(known, at, np.ones(len(at)))}
    ways |= {name: Index(known, at, name) for name in ("O1", "O2", "O3", "O4", "O5")}
    ways["reliability"] = Reliable(known, at, each[:0])
    ways["workspace"] = PredictionVariance(known, moved_anywhere(planner.scene, known, poses))
    for name, by in ways.items():
        best = chosen(by, each, STOPS, lambda done, total: None, exchange=False)
        error, wider = told(pool[best], name)
        print(f"{STOPS} by {name}: {error:.3f} mm, sigmas {wider:.2f} times", flush=True)
    drawn = [told(rng.choice(pool, STOPS, replace=False), f"drawn {k}") for k in range(DRAWS)]
    error, wider = np.transpose(drawn)
    print(
        f"{STOPS} drawn: {error.min():.3f} to {error.max():.3f} mm, median {np.median(error):.3f}, "
        f"sigmas {wider.min():.2f} to {wider.max():.2f} times"
    )


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        main(Path(sys.argv[1]), Path(folder))
