"""How long a report of a large run takes, how large its page is, and how much memory it needs.

    python tests/bench/bench_report.py [--stops 90] [--rows 131072] [--fit]

A run on few beams is fitted; then every beam of its scans and residuals is repeated, a little off
each time, until a stop has as many rows as wanted. The report is made twice, of the run alone,
where what was before is taken from CAD, beam by beam, and each in a process of its own, whose peak
is the operating system's (Linux alone). With --fit the large recording is fitted too.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from bench_memory import own_peak_mb

from calib.report import report
from calib.runs.calibrate import calibrate
from calib.runs.run import MODEL, RESIDUALS, Run
from calib.simulation import Spec, simulate
from sensors.documents import read_yaml, write_yaml
from sensors.recording import RecordedStops, read_table, write_table

COLUMN_STEP = 64  # 16 columns of 128 rings: what is truly fitted
SHAKEN = {"x": 1e-3, "y": 1e-3, "z": 1e-3, "residual_m": 5e-4, "azimuth_rad": 0.1, "range_m": 0.01}


def grown(path: Path, rows: int, rng: np.random.Generator) -> None:
    """Repeat a table's rows up to so many; no two are alike."""
    table = read_table(path)
    have = len(next(iter(table.values())))
    chosen = np.arange(rows) % have
    out = {name: column[chosen] for name, column in table.items()}
    for name in SHAKEN.keys() & out.keys():
        off = rng.normal(0.0, SHAKEN[name], rows)
        out[name] = (out[name] + off).astype(table[name].dtype)
    out["column"] = (np.arange(rows) // 128).astype(table["column"].dtype)
    write_table(path, out)


def large_run(folder: Path, stops: int, rows: int) -> tuple[Path, Path]:
    """A recording of so many rows per stop, and a run on it."""
    locations = max(1, stops // 10)
    spec = Spec(locations=locations, stops_per_location=stops // locations, column_step=COLUMN_STEP)
    recording, run = folder / "recording", folder / "run"
    simulate(spec, recording, seed=1)
    calibrate([recording], run)
    rng = np.random.default_rng(0)
    for path in (*(recording / "scans").iterdir(), *(run / RESIDUALS).iterdir()):
        grown(path, rows, rng)
    model, _ = read_yaml(run / MODEL)
    names = Run.open(run).recordings
    model["recordings"][0]["sha256"] = RecordedStops.open(names[0], (), ()).digest()
    write_yaml(run / MODEL, model)
    return recording, run


def alone(*arguments: str) -> str:
    """What this script prints when it runs by itself."""
    command = [sys.executable, __file__, *arguments]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


def main() -> None:
    """Make a large run and report it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--stops", type=int, default=90)
    parser.add_argument("--rows", type=int, default=128 * 1024, help="of each stop")
    parser.add_argument("--fit", action="store_true", help="time the fit as well")
    parser.add_argument("--report", type=Path, help=argparse.SUPPRESS)
    wanted = parser.parse_args()
    if wanted.report:
        report([Run.open(wanted.report)], wanted.report.with_suffix(".html"))
        print(f"{time.process_time():.0f} s of CPU, {own_peak_mb():.0f} MB at most")
        return
    with tempfile.TemporaryDirectory() as folder:
        recording, run = large_run(Path(folder), wanted.stops, wanted.rows)
        print(f"{wanted.stops} stops x {wanted.rows} rows", flush=True)
        told = alone("--report", str(run)).strip()
        size_mb = run.with_suffix(".html").stat().st_size / 1e6
        print(f"report: {told}; the page has {size_mb:.1f} MB (goal: under 15)", flush=True)
        if wanted.fit:
            began = time.process_time()
            calibrate([recording], Path(folder) / "again")
            print(f"fit: {time.process_time() - began:.0f} s of CPU", flush=True)


if __name__ == "__main__":
    main()
