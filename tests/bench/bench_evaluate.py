"""What evaluating a recording costs: against its ray casts and its input and output.

    python tests/bench/bench_evaluate.py [--rows 1000000]

Eight stops of an OS0-128 in the simulated lab, its mesh 50,000 triangles, at a state as started.
The other side reads every scan, casts its beams once, and writes the same tables of points. Both
sides run in one process on one thread; times are CPU seconds. Peak memory is that of Python's own
allocations, over what one stop's table takes.
"""

from __future__ import annotations

import argparse
import tempfile
import tracemalloc
from collections.abc import Iterator, Sequence
from pathlib import Path

from workload import recorded, threads, timed

from calib import outputs
from calib import problem as problems
from calib.evaluation import evaluate_stop, tabled, write_evaluation
from calib.evaluation.tally import Evaluated
from calib.problem import Problem
from calib.problem.model import Model, Source
from chains import se3
from sensors.lidar import beams
from sensors.recording import write_table


def each(problem: Problem, copies: int = 1) -> Iterator[Evaluated]:
    """Every stop, evaluated where it starts; the recording so many times over."""
    for _ in range(copies):
        for scan in problem.scans:
            yield evaluate_stop(scan, problem.initial)


def ours(problem: Problem, folder: Path, copies: int = 1) -> None:
    """A whole evaluation, written."""
    with outputs.folder(folder, outputs.EVALUATION) as draft:
        stops = outputs.kept(draft, {}).each(
            "stops", copies * len(problem.scans), lambda _: map(tabled, each(problem, copies))
        )
        write_evaluation(stops, draft, {})


def theirs(problem: Problem, tables: Sequence[dict], folder: Path) -> None:
    """Every scan read, its beams cast, a table written."""
    folder.mkdir(exist_ok=True)
    reference = problem.sources[0].reference
    for scan, table in zip(problem.scans, tables, strict=True):
        T = scan.pose(problem.initial)
        ray = beams(scan.recording.scan(scan.index).xyz_m, scan.lidar.beam_origin_m)
        reference.cast(se3.apply(T, ray.origin_m), ray.direction @ T[:3, :3].T, nthreads=1)
        write_table(folder / f"{scan.name}.parquet", table)


def peak(problem: Problem, folder: Path, copies: int) -> float:
    """Peak memory, bytes, of evaluating the recording so many times over."""
    tracemalloc.start()
    try:
        ours(problem, folder, copies)
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def main() -> None:
    """Both, as ratios."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rows", type=int, default=1_000_000)
    parser.add_argument("--repeats", type=int, default=3, help="of each, for the median")
    wanted = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary, threads(1):
        folder = Path(temporary)
        source = Source.open(recorded(folder, wanted.rows, stops=8))
        problem = problems.build([source], Model())
        ours(problem, folder / "ours")  # builds the ray caster's scene
        tables = [done.points for done in each(problem)]
        size = sum(column.nbytes for column in tables[0].values())
        ours_s = timed(lambda: ours(problem, folder / "ours"), wanted.repeats)[1]
        theirs_s = timed(lambda: theirs(problem, tables, folder / "theirs"), wanted.repeats)[1]
        ratio = ours_s / theirs_s
        print(f"evaluate / casts, reading and writing {ours_s:8.2f} s {theirs_s:8.2f} s", end="")
        print(f"   ratio {ratio:5.2f}   goal <= 1.5")
        once, thrice = (peak(problem, folder / "ours", copies) / size for copies in (1, 3))
        print(f"peak memory / a stop's table: {once:.1f}, of three times the stops {thrice:.1f}")


if __name__ == "__main__":
    main()
