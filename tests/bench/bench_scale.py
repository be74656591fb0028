"""How time and memory grow with rows and with stops, from recording to verdict.

    python tests/bench/bench_scale.py [--columns 64,16,4,1] [--stops 8,16,32]
                                      [--many 30,100,300] [--workers 1,2]

Recordings of the preset `default` are made in a temporary folder, then `rigcal fit` and `rigcal
diagnose` are run on each, one process after another. Three series: more beams in each of 8 stops
(every so many-th column of an OS0-128 is kept), more stops at full resolution, and many stops of
some 1,000 beams. A line of a series gives seconds on the clock and peak memory (VmHWM, Linux
alone). Below it stand the power of rows with which CPU seconds grow, those of 8 stops of 128 beams
taken off for the start, and megabytes a stop. The last table compares numbers of threads on the
largest recording of the second series. Ratios are of one run on one machine.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from bench_memory import own_peak_mb
from rich.console import Console
from rich.table import Table

from calib.simulation import Spec, simulate

COLUMNS = 1024  # of an OS0-128 per turn, of 128 beams each
OWN = "--of-this-process"
EVERY = 128  # of the columns, in the series of many stops
FEW = 8  # stops in the series of more beams


@dataclass(frozen=True)
class Cost:
    """Of one process: seconds on the clock and of all its threads, and its peak memory."""

    wall_s: float
    cpu_s: float
    peak_mb: float


def cost(arguments: Sequence[str | Path]) -> Cost:
    """Run rigcal with such arguments in a process of its own.

    Raises:
        RuntimeError: it failed.
    """
    command = [sys.executable, __file__, OWN, *map(str, arguments)]
    start = time.perf_counter()
    done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True)
    wall_s = time.perf_counter() - start
    *said, last = done.stderr.splitlines()
    if done.returncode:
        raise RuntimeError("\n".join(said))
    return Cost(wall_s, *json.loads(last))


def of_this_process() -> None:
    """Run rigcal here, and print what it cost as the last line."""
    from calib.cli import main

    sys.argv = ["rigcal", *sys.argv[2:]]
    try:
        main()
    finally:
        print(f"\n{json.dumps([time.process_time(), own_peak_mb()])}", file=sys.stderr)


def exponent(sizes: Sequence[float], costs: Sequence[float], start: float) -> float:
    """With which power of a size a cost above that of the start grows, least squares in
    logarithms."""
    above = np.array(costs, float) - start
    return float(np.polyfit(np.log(sizes), np.log(above), 1)[0])


def recorded(folder: Path, stops: int, every: int) -> Path:
    """A recording of so many stops, with every so many-th column."""
    out = folder / f"{stops}_{every}"
    if not out.exists():
        places = max(2, stops // 4)
        spec = Spec(locations=places, stops_per_location=stops // places, column_step=every)
        simulate(spec, out, seed=3)
    return out


def both(recording: Path, *options: str) -> tuple[Cost, Cost]:
    """What the fit of a recording costs, and the diagnosis."""
    run = recording.with_name(f"{recording.name}-run")
    fit = cost(["fit", recording, "-o", run, *options])
    return fit, cost(["diagnose", run, *options])


def series(
    console: Console,
    what: str,
    folder: Path,
    sizes: Iterable[tuple[int, int]],
    start: tuple[Cost, Cost],
) -> None:
    """A table of recordings of (stops, every so many-th column)."""
    table = Table("stops", "rows", "fit s", "MB", "diagnose s", "MB ", title=what)
    found, rows, stops = [], [], []
    for count, every in sizes:
        fit, diagnosis = both(recorded(folder, count, every))
        found.append((fit, diagnosis))
        stops.append(count)
        rows.append(count * 128 * (COLUMNS // every))
        cells = (fit.wall_s, fit.peak_mb, diagnosis.wall_s, diagnosis.peak_mb)
        table.add_row(f"{count}", f"{rows[-1]:,}", *(f"{x:,.1f}" for x in cells))
    console.print(table)
    every_cost = zip(("fit", "diagnose"), zip(*found, strict=True), start, strict=True)
    for name, costs, least in every_cost:
        power = exponent(rows, [c.cpu_s for c in costs], least.cpu_s)
        line = f"{name}: CPU grows with rows to the power {power:.2f}"
        if len(set(stops)) > 1:
            more = (costs[-1].peak_mb - costs[0].peak_mb) / (stops[-1] - stops[0])
            line += f", memory by {more:.1f} MB a stop"
        console.print(line)


def numbers(text: str) -> list[int]:
    """Of a list with commas."""
    return [int(part) for part in text.split(",")]


def main() -> None:
    """Print all tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--columns", type=numbers, default=[64, 16, 4, 1])
    parser.add_argument("--stops", type=numbers, default=[8, 16, 32])
    parser.add_argument("--many", type=numbers, default=[30, 100, 300])
    parser.add_argument("--workers", type=numbers, default=[1, 2])
    wanted = parser.parse_args()
    console = Console(width=100)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        start = both(recorded(folder, FEW, COLUMNS))
        console.print(f"the start: fit {start[0].cpu_s:.1f} s, diagnose {start[1].cpu_s:.1f} s")
        series(console, "more beams a stop", folder, [(FEW, c) for c in wanted.columns], start)
        series(console, "more stops", folder, [(s, 1) for s in wanted.stops], start)
        series(console, "many stops", folder, [(s, EVERY) for s in wanted.many], start)
        table = Table("threads", "fit s", "ratio", "diagnose s", "ratio ", title="threads")
        first: tuple[Cost, Cost] | None = None
        for count in wanted.workers:
            found = both(recorded(folder, wanted.stops[-1], 1), "--workers", str(count))
            first = first or found
            pairs = zip(found, first, strict=True)
            cells = [f(c, one) for c, one in pairs for f in (_seconds, _ratio)]
            table.add_row(str(count), *cells)
        console.print(table)


def _seconds(cost: Cost, first: Cost) -> str:
    return f"{cost.wall_s:.1f}"


def _ratio(cost: Cost, first: Cost) -> str:
    return f"{first.wall_s / cost.wall_s:.2f}"


if __name__ == "__main__":
    of_this_process() if sys.argv[1:2] == [OWN] else main()
