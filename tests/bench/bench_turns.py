"""To find how a LiDAR is turned: a few beams choose orientations, against all beams asked of all.

    python -m tests.bench.bench_turns

Rooms with and without clutter by `tests/worlds`, each with its LiDAR turned three ways; both sides
in one process, in turns. Prints the ratio of CPU times, and whether both find the same.
"""

from __future__ import annotations

import tempfile
import time
from itertools import product
from pathlib import Path
from unittest.mock import patch

import numpy as np
from scipy.spatial.transform import Rotation

from calib.problem import build
from calib.problem.model import Model, Source
from calib.solve.otherwise import orientations
from calib.solve.otherwise.orientations import best_turn, by_turning_frame
from calib.solve.otherwise.sampled import SCANS_ASKED, Sampled, maps

from ..worlds import World, write

SEEDS, CLUTTER, WAYS = (11, 12, 13), (0.0, 0.1, 0.3), 3
RIGHT_RAD = 0.2  # from 0.3 rad away passes over the scans find the optimum
SIDES = {
    "few choose": {"CHOSEN": orientations.CHOSEN},
    "all of all": {"CHOSEN": 10**6, "CHOOSING_BEAMS": SCANS_ASKED},
}


def main() -> None:
    seconds = dict.fromkeys(SIDES, 0.0)
    right = dict.fromkeys(SIDES, 0)
    alike, rng = 0, np.random.default_rng(1)
    for seed, clutter in product(SEEDS, CLUTTER):
        world = World(seed, locations=4, stops=3, beams=600, clutter=clutter)
        with tempfile.TemporaryDirectory() as folder:
            scans = scans_of(world, Path(folder) / "rec")
            for turned in Rotation.random(WAYS, rng=rng).as_matrix():
                off = [Sampled(each.scan, each.T @ maps(turned[None])[0]) for each in scans]
                found = {}
                for side, other in SIDES.items():
                    with patch.multiple(orientations, **other):
                        began = time.process_time()
                        found[side] = best_turn(off)
                        seconds[side] += time.process_time() - began
                    left = Rotation.from_matrix(turned @ found[side]).magnitude()
                    right[side] += bool(left < RIGHT_RAD)
                alike += np.array_equal(*found.values())
    count = len(SEEDS) * len(CLUTTER) * WAYS
    for side in SIDES:
        print(f"{side:12} {seconds[side] / count:6.2f} s each, right {right[side]} of {count}")
    few, every = seconds.values()
    print(f"ratio {every / few:.1f}; the same orientation in {alike} of {count}")


def scans_of(world: World, folder: Path) -> list[Sampled]:
    """The scans of a world, read and placed where they were taken."""
    write(world, folder)
    problem = build([Source.open(folder)], Model())
    ((_, scans),) = by_turning_frame(problem, problem.initial).items()
    for each in scans:
        each.scan.store.read(each.scan.index)
    return scans


if __name__ == "__main__":
    main()
