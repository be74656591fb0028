"""How soon the workbench shows a large run: 90 stops of 131,072 beams, made by tiling a small one.

    python tests/bench/bench_view.py [--stops 90] [--beams 131072] [--folder DIR] [--shots DIR]

The page is opened in a headless Chromium that draws in software; a browser with a GPU is faster.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from calib.runs.run import Run
from calib.view.scene import Scene
from sensors.documents import read_yaml, write_yaml
from sensors.recording import RecordedStops, read_table, write_table
from tests.browser import SOFTWARE_GL, browser_page
from tests.calib.viewed import small_run


def tiled(folder: Path, stops: int, beams: int) -> Path:
    """A run of so many stops and beams; its room and rig are those of a small one."""
    run = small_run(folder)
    recording, names = folder / "rec", []
    with open(recording / "stops.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    for k in range(stops):
        old = rows[k % len(rows)]["stop"]
        names.append((old, f"S{k:03d}"))
    for old in {old for old, _ in names}:
        for path in (recording / "scans", run.folder / "residuals.parquet"):
            _tile(path / f"{old}.parquet", beams)
    state = run.state()
    for old, new in names:
        for path in (recording / "scans", run.folder / "residuals.parquet"):
            shutil.copy(path / f"{old}.parquet", path / f"{new}.parquet")
        for key in [key for key in state if f"@{old}" in key]:
            state[key.replace(f"@{old}", f"@{new}")] = state[key]
    np.savez(run.folder / "state.npz", **{f"state/{key}": value for key, value in state.items()})
    by_name = {row["stop"]: row for row in rows}
    with open(recording / "stops.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(by_name[old] | {"stop": new} for old, new in names)
    for path in (recording / "scans", run.folder / "residuals.parquet"):
        for old in by_name:
            (path / f"{old}.parquet").unlink()
    model = read_yaml(run.folder / "model.yaml")[0]
    model["recordings"][0]["sha256"] = RecordedStops.open(recording, (), ()).digest()
    write_yaml(run.folder / "model.yaml", model)
    return run.folder


def _tile(path: Path, count: int) -> None:
    """Make a table as long as that; floats are shaken a little, as copies would pack too well."""
    rng, table = np.random.default_rng(0), read_table(path)
    tiles = -(-count // len(next(iter(table.values()))))
    columns = {n: np.tile(v, tiles)[:count] for n, v in table.items()}
    for name, values in columns.items():
        if values.dtype.kind == "f" and name not in ("weight", "count"):
            columns[name] = (values * (1 + 1e-4 * rng.standard_normal(count))).astype(values.dtype)
    write_table(path, columns)


def opened(run: Path, beams: int, shots: Path | None) -> dict[str, float]:
    """Seconds from the command, and from the browser's request, to what a person sees."""
    program = "from calib.cli import main; main()"
    command = [sys.executable, "-c", program, "view", str(run), "--no-open", "--json"]
    found, began = {}, time.monotonic()
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        with browser_page(1400, 900, *SOFTWARE_GL) as watched:
            text = ""
            while "}" not in text:
                text += process.stdout.readline()
            found["command to address"] = time.monotonic() - began
            for visit in ("first visit", "second visit"):
                asked = time.monotonic()
                watched.page.goto(json.loads(text)["url"])
                watched.page.locator("canvas").first.wait_for(timeout=120_000)
                found[f"{visit}: to the canvas"] = time.monotonic() - asked
                watched.page.get_by_text(f"{beams:,} beams").wait_for(timeout=120_000)
                found[f"{visit}: to the first points"] = time.monotonic() - asked
                if visit == "first visit":
                    found["command to the first points"] = time.monotonic() - began
                    found["of that, the server's own time"] = _busy_s(process.pid)
            if shots:
                watched.page.wait_for_timeout(5000)
                watched.page.screenshot(path=shots / "large.png", timeout=120_000)
            watched.assert_clean()
    finally:
        process.send_signal(signal.SIGINT)
        process.wait(30)
    return found


def _busy_s(process: int) -> float:
    """CPU seconds that a process has taken, as the system counts them (Linux)."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def parts(run: Path) -> dict[str, float]:
    """Seconds that the server's own steps take, libraries loaded."""
    found, began = {}, time.perf_counter()
    scene = Scene.of(Run.open(run))
    found["recording read and checked"] = time.perf_counter() - began
    began = time.perf_counter()
    points = scene.points(0, scene.stops(0)[-1])
    points.drawn()
    found["one stop's points"] = time.perf_counter() - began
    began = time.perf_counter()
    points.picked(points.drawn(), points.eye_m, [1.0, 0.2, 0.1])
    found["one click"] = time.perf_counter() - began
    return found


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--stops", type=int, default=90)
    parser.add_argument("--beams", type=int, default=131_072)
    parser.add_argument("--folder", type=Path, help="keep the run there, or take the one there")
    parser.add_argument("--shots", type=Path)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = given.folder or Path(scratch)
        run = folder / "run"
        if not run.exists():
            folder.mkdir(parents=True, exist_ok=True)
            run = tiled(folder, given.stops, given.beams)
        size_mb = sum(path.stat().st_size for path in folder.rglob("*.parquet")) / 1e6
        print(f"{given.stops} stops of {given.beams:,} beams, {size_mb:.0f} MB of tables")
        for name, seconds in (parts(run) | opened(run, given.beams, given.shots)).items():
            print(f"{name:36} {seconds:7.2f} s")


if __name__ == "__main__":
    main()
