"""How time and memory grow with rows and with stops, from recording to verdict; by each executor.

    python tests/bench/bench_scale.py [--columns 64,16,4] [--stops 8,16] [--many 30,100]
                                      [--shared 16] [--repeats 1] [--models]

Recordings of the preset `default` are made in a temporary folder, then `rigcal fit` and `rigcal
diagnose` are run on each, one program after another. Three series: more beams in each of 8 stops
(every so many-th column of an OS0-128 is kept), more stops at full resolution, and many stops of
some 1,000 beams. A line of a series gives seconds on the clock and peak memory (VmHWM, Linux
alone). Below it stand the power of rows with which CPU seconds grow, those of 8 stops of 128 beams
taken off for the start, and megabytes a stop.

`--models` asks what a model costs, with 8 stops of some 8,000 beams: by LiDARs of 32, 64 and 128
rings, by effects of the catalogue beside the default ones, and in a room of few surfaces and of
many; CPU seconds.

The last table shares the stops of one recording at full resolution among threads, processes and,
where distributed is installed, the workers of a Dask cluster: seconds on the clock, how many times
faster than one thread, CPU seconds of the program and of its workers, the most memory that it and
any worker take, and what travels for a stop. Each way is tried as often as `--repeats`, in turns,
and the fastest counts, as a busy machine only adds. All ratios are of one run on one machine.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import re
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from bench_memory import own_peak_mb
from rich.console import Console
from rich.table import Table

from calib.effects import DEFAULT
from calib.simulation import Spec, simulate

COLUMNS = 1024  # of an OS0-128 per turn, of 128 beams each
OWN = "--of-this-process"
SURFACE_PARTS = {f"state/0/reference_{part}" for part in ("surface", "region", "patch")}
EVERY = 128  # of the columns, in the series of many stops
FEW = 8  # stops in the series of more beams
# LiDAR, every how many-th column for some 8,000 beams; the last is that of the other tables.
LIDARS = (("hesai_pandarxt32", 8), ("hesai_pandarqt64", 5), ("ouster_os0_128_rev7", 16))
EFFECTS = (
    "incidence_angle_bias",
    "intensity_range_walk",
    "range_scale",
    "azimuth_range_harmonic",
    "encoder_eccentricity",
    "elevation_scale",
    "beam_origin_offset",
    "spin_axis_wobble",
    "arm_gravity_sag",
    "arm_joint_eccentricity",
    "arm_joint_scale",
    "base_flex",
    "mount_bending",
    "warmup_drift",
    "label_range_offset",
    "arm_link_bending",
)


@dataclass(frozen=True)
class Cost:
    """Of one program: seconds on the clock and of all its threads, its peak memory; CPU seconds of
    its workers and the peak of the largest; and kB that a stop sends to them and back."""

    wall_s: float
    cpu_s: float
    peak_mb: float
    workers_s: float
    worker_mb: float
    sent_kb: str = ""


def cost(arguments: Sequence[str | Path], threads: int | None = None) -> Cost:
    """Run rigcal with such arguments in a process of its own.

    Args:
        arguments: of the command.
        threads: how many at most; all cores where None.

    Raises:
        RuntimeError: it failed.
    """
    command = [sys.executable, __file__, OWN, str(threads or ""), "-v", *map(str, arguments)]
    start = time.perf_counter()
    done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True)
    wall_s = time.perf_counter() - start
    *said, last = done.stderr.splitlines()
    if done.returncode:
        raise RuntimeError("\n".join(said))
    sent = re.search(r"each (\d+) kB down and (\d+) kB up", done.stderr)
    names = ("cpu_s", "peak_mb", "workers_s", "worker_mb")
    told = dict(zip(names, json.loads(last), strict=True))
    return Cost(wall_s=wall_s, **told, sent_kb=" + ".join(sent.groups()) if sent else "")


def of_this_process() -> None:
    """Run rigcal here, and print what it cost as the last line."""
    from calib.cli import main
    from calib.linear.parallel import workers

    threads, *arguments = sys.argv[2:]
    sys.argv = ["rigcal", *arguments]
    try:
        with workers(int(threads) if threads else None):
            main()
    finally:
        ended = resource.getrusage(resource.RUSAGE_CHILDREN)
        of_workers = ended.ru_utime + ended.ru_stime, ended.ru_maxrss * 1024 / 1e6
        print(f"\n{json.dumps([time.process_time(), own_peak_mb(), *of_workers])}", file=sys.stderr)


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


def both(recording: Path, *options: str, threads: int | None = None) -> tuple[Cost, Cost]:
    """What the fit of a recording costs, and the diagnosis."""
    run = recording.with_name(f"{recording.name}-run")
    fit = cost(["fit", recording, "-o", run, *options], threads)
    return fit, cost(["diagnose", run, *options], threads)


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


def models(console: Console, folder: Path) -> None:
    """The table of what a model has."""
    columns = ("unknowns of all stops", "parts of surfaces", "fit CPU s", "diagnose CPU s")
    table = Table("", *columns, title="models")
    *_, (wide, every) = LIDARS
    tried = [(lidar, lidar, step, "lab", 0) for lidar, step in LIDARS]
    tried += [(f"{count} effects more", wide, every, "lab", count) for count in (4, 8, 16)]
    tried.append(("a bare room", wide, every, "box", 0))
    for name, lidar, step, room, count in tried:
        out = folder / f"{lidar}_{room}"
        if not out.exists():
            spec = Spec(
                lidar=lidar, room=room, column_step=step, locations=2, stops_per_location=FEW // 2
            )
            simulate(spec, out, seed=3)
        more = ["--effects", ",".join([*DEFAULT, *EFFECTS[:count]])] if count else []
        run = folder / f"{out.name}-{count}"
        fit = cost(["fit", out, "-o", run, *more])
        with np.load(run / "covariance.npz") as known, np.load(run / "state.npz") as state:
            unknowns = len(known["names"])
            parts = sum(len(state[n]) for n in state.files if n in SURFACE_PARTS)
        diagnosis = cost(["diagnose", run])
        seconds = (f"{each.cpu_s:.1f}" for each in (fit, diagnosis))
        table.add_row(name, f"{unknowns}", f"{parts}", *seconds)
    console.print(table)


@contextmanager
def ways() -> Iterator[dict[str, Callable[[Path], tuple[Cost, Cost]]]]:
    """How stops may be shared, by name; a Dask cluster runs meanwhile, where it can."""
    found = {
        "1 thread": partial(both, threads=1),
        "2 threads": partial(both, threads=2),
        "2 processes": lambda recording: both(recording, "--workers", "2"),
    }
    if importlib.util.find_spec("distributed") is None:
        yield found
        return
    from distributed import LocalCluster

    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        address = cluster.scheduler_address
        found["2 Dask workers"] = lambda recording: both(recording, "--scheduler", address)
        yield found


def executors(console: Console, recording: Path, repeats: int) -> None:
    """The table of executors."""
    with ways() as known:
        tried: dict[str, list[tuple[Cost, Cost]]] = {name: [] for name in known}
        for _ in range(repeats):
            for name, run in known.items():
                tried[name].append(run(recording))
    for k, command in enumerate(("fit", "diagnose")):
        columns = ("s", "ratio", "CPU s", "of workers", "MB", "a worker", "kB a stop, down + up")
        table = Table("executor", *columns, title=f"{command}, {recording.name} stops_columns")
        first = None
        for name, costs in tried.items():
            best = min((each[k] for each in costs), key=lambda found: found.wall_s)
            first = first or best
            cells = [best.wall_s, first.wall_s / best.wall_s, best.cpu_s, best.workers_s]
            memory = [best.peak_mb, best.worker_mb]
            numbers = [*(f"{x:.1f}" for x in cells), *(f"{x:,.0f}" for x in memory)]
            table.add_row(name, *numbers, best.sent_kb)
        console.print(table)


def numbers(text: str) -> list[int]:
    """Of a list with commas."""
    return [int(part) for part in text.split(",") if part]


def main() -> None:
    """Print all tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--columns", type=numbers, default=[64, 16, 4])
    parser.add_argument("--stops", type=numbers, default=[8, 16])
    parser.add_argument("--many", type=numbers, default=[30, 100])
    parser.add_argument("--shared", type=int, default=16, help="stops that executors share")
    parser.add_argument("--repeats", type=int, default=1)
    parser.add_argument("--models", action="store_true", help="what a model costs, too")
    wanted = parser.parse_args()
    console = Console(width=110)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if wanted.columns or wanted.stops or wanted.many:
            both(recorded(folder, FEW, COLUMNS))  # compiles what is compiled once
            start = both(recorded(folder, FEW, COLUMNS))
            console.print(f"the start: fit {start[0].cpu_s:.1f} s, diagnose {start[1].cpu_s:.1f} s")
        for what, sizes in (
            ("more beams a stop", [(FEW, c) for c in wanted.columns]),
            ("more stops", [(s, 1) for s in wanted.stops]),
            ("many stops", [(s, EVERY) for s in wanted.many]),
        ):
            if sizes:
                series(console, what, folder, sizes, start)
        if wanted.models:
            models(console, folder)
        if wanted.shared:
            executors(console, recorded(folder, wanted.shared, 1), wanted.repeats)


if __name__ == "__main__":
    of_this_process() if sys.argv[1:2] == [OWN] else main()
