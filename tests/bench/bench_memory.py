"""How much memory a fit takes: of a stop that is done, little stays; of one evaluated, nothing.

    python tests/bench/bench_memory.py [--stops 4] [--rows 131072]

The store of scans is left out. Each fit, evaluation and application
runs in a process of its own, which takes stops one by one; its peak is the operating system's
(VmHWM, Linux alone).
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from unittest import mock

import numpy as np
from workload import BEAMS, recorded, threads

import calib
from calib.linear.linearise import lidars
from calib.linear.rows import StopRows, StopSums
from calib.problem import Problem, build
from calib.problem.model import Model, Source
from calib.residuals import store
from calib.solve.fit import preview, solve

MB = 1e6


def problem(recording: Path, stops: int) -> Problem:
    """The default model on the first stops of a recording."""
    source = Source.open(recording)
    return build([source], Model(), [np.arange(len(source.recording.stops)) < stops])


def sums_mb(recording: Path) -> float:
    """What the sums of one stop's rows take."""
    found = preview(problem(recording, 1))
    (scan,), (association,) = found.scans, found.associations
    (placed,) = lidars(found.scans, found.values)
    rows = StopRows.of(scan, found.linear.layout, found.values, placed, association)
    return size(rows.sums()) / MB


def size(sums: StopSums) -> int:
    """Bytes of one stop's sums."""
    return sum(array.nbytes for array in vars(sums).values() if isinstance(array, np.ndarray))


def peak_mb(what: str, folder: Path, stops: int = 0) -> float:
    """Peak of a process that fits so many stops of a recording; or evaluates a run, or applies it
    to its recording."""
    command = [sys.executable, __file__, f"--{what}", str(folder), "--stops", str(stops)]
    return float(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def own_peak_mb() -> float:
    """Peak of this process so far."""
    status = Path("/proc/self/status").read_text(encoding="ascii")
    line = next(line for line in status.splitlines() if line.startswith("VmHWM"))
    return float(line.split()[1]) * 1024 / MB


def fitted(folder: Path, rows: int, stops: int) -> Path:
    """A run of so many stops, each of so many beams."""
    recording = recorded(folder, stops * rows, stops)
    return calib.fit(recording, folder / "run", hold_out="none").folder


def asked(wanted: argparse.Namespace) -> None:
    """What this process alone is to do."""
    with threads(1), mock.patch.object(store, "KEPT_BYTES", 0):
        if wanted.fit:
            solve(problem(wanted.fit, wanted.stops))
            return
        run, out = calib.Run.open(wanted.evaluate or wanted.apply), tempfile.mkdtemp()
        if wanted.evaluate:
            calib.evaluate(run, Path(out, "out"))
        else:
            calib.apply(run, run.recordings, Path(out, "out"))
        shutil.rmtree(out)


def main() -> None:
    """Fit K and 3 K stops and print what each took; evaluate both, and apply both."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--stops", type=int, default=4)
    parser.add_argument("--rows", type=int, default=BEAMS, help="of each stop")
    for name in ("--fit", "--evaluate", "--apply"):
        parser.add_argument(name, type=Path, help=argparse.SUPPRESS)
    wanted = parser.parse_args()
    if wanted.fit or wanted.evaluate or wanted.apply:
        asked(wanted)
        print(own_peak_mb())
        return
    few, many = wanted.stops, 3 * wanted.stops
    with tempfile.TemporaryDirectory() as folder:
        recording = recorded(Path(folder), many * wanted.rows, many)
        a, b = peak_mb("fit", recording, few), peak_mb("fit", recording, many)
        print(f"fit, {few} stops: {a:.0f} MB at most; {many} stops: {b:.0f} MB")
        own = sums_mb(recording)
        print(f"a stop more: {(b - a) / (many - few):.1f} MB; its sums: {own:.1f} MB", end="")
        print(f"   goal <= {own + 1:.1f}")
        runs = [fitted(Path(folder, str(k)), wanted.rows, k) for k in (few, many)]
        for what in ("evaluate", "apply"):
            a, b = (peak_mb(what, run) for run in runs)
            print(f"{what}, {few} stops: {a:.0f} MB at most; {many} stops: {b:.0f} MB", end="")
            print(f"; a stop more: {(b - a) / (many - few):.2f} MB   goal <= 1.0")


if __name__ == "__main__":
    main()
