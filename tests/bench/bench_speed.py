"""How fast a fit is: against other ways to the same answer, and against its own casts.

    python tests/bench/bench_speed.py [--rows 1000000]

The default model on eight stops of an OS0-128 in the simulated lab, its mesh 50,000 triangles, its
errors unknowns as in every fit. Both sides run in one process on one thread, on scans in memory;
times are CPU seconds, but for the line of two threads.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np
from point_factors import PointFactors
from sparse_rows import SparseRows, frozen, optimum
from workload import Work, held, one_thread, recorded, timed

from calib.linear.parallel import workers
from chains import se3
from sensors.lidar import beams

POINTS = 20_000  # with a factor each; their cost is linear in their number, and scaled to all rows
SCIPY_ROWS = 100_000  # more would take scipy half an hour


def rays(work: Work) -> list[tuple[np.ndarray, np.ndarray]]:
    """Origins and directions of every stop's beams at the start, reference frame."""
    found = []
    for scan in work.problem.scans:
        T = scan.pose(work.start)
        ray = beams(scan.recording.scan(scan.index).xyz_m, scan.lidar.beam_origin_m)
        found.append((se3.apply(T, ray.origin_m), ray.direction @ T[:3, :3].T))
    return found


def factor_per_point(work: Work, repeats: int) -> None:
    """A step with one factor per point against ours: linearised and solved."""
    some = work.thinned(POINTS)
    ours = timed(work.frozen_step, repeats)[1]
    for given, how in ((False, "computed by each"), (True, "given to all")):
        points = PointFactors(some, given)
        points.step()  # builds the graph, which further steps use again
        per_point = timed(points.step, repeats)[1] * work.rows / some.rows
        what = f"step: point factors, rows {how}, x {work.rows / some.rows:.1f} / ours"
        report(what, work.rows, per_point, ours, ">= 1000")


def sparse_least_squares(work: Work) -> None:
    """The way to the optimum against scipy's."""
    some = work.thinned(min(work.rows, SCIPY_ROWS))
    some = frozen(some)
    sparse = SparseRows(some)
    x, scipy_s = timed(sparse.optimum)
    values, ours = timed(lambda: optimum(some))
    what = f"to the optimum: scipy, {sparse.distance(x, values):.2g} sigma off / ours"
    report(what, some.rows, scipy_s, ours, ">= 30")


def casts(work: Work, repeats: int) -> None:
    """A whole step against the casts in it."""
    reference, beams_there = work.source.reference, rays(work)
    cast = timed(lambda: [reference.cast(*ray, nthreads=1) for ray in beams_there], repeats)[1]
    report("step: whole / its casts", work.rows, timed(work.whole_step, repeats)[1], cast, "<= 1.5")


def threads(work: Work, repeats: int) -> None:
    """A whole step on one thread against one on two; by the clock, so of a machine at rest."""
    with workers(2):
        two = timed(work.whole_step, repeats, time.perf_counter)[1]
    one = timed(work.whole_step, repeats, time.perf_counter)[1]
    report("step: whole, on one thread / on two", work.rows, one, two, ">= 1.7")


def report(what: str, rows: int, a_s: float, b_s: float, goal: str) -> None:
    """A line of the table."""
    print(f"{what:60} {rows:9d} {a_s:9.3f} {b_s:9.3f} {a_s / b_s:8.1f}   {goal}", flush=True)


def heading() -> None:
    """The first line of the table."""
    print("{:60} {:>9} {:>9} {:>9} {:>8}   goal".format("a / b", "rows", "a, s", "b, s", "a / b"))


def main() -> None:
    """Run all and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rows", type=int, default=1_000_000)
    parser.add_argument("--repeats", type=int, default=5, help="of each, for the median")
    wanted = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, one_thread():
        work = Work.of(held(recorded(Path(folder), wanted.rows, stops=8)))
        heading()
        casts(work, wanted.repeats)
        threads(work, wanted.repeats)
        factor_per_point(work, wanted.repeats)
        sparse_least_squares(work)


if __name__ == "__main__":
    main()
