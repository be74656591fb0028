"""The whole loop as a user waits for it, this checkout against another, in one table.

    git worktree add ../before 30e7e03
    python tests/bench/bench_loop.py --against ../before [--presets tiny default] [--rows 1000000]

Every verb is a process of its own, on all cores, imports and all; both sides take turns on the same
recordings, in one environment. Then, of the last preset, where the time of a fit and a diagnosis
goes, and what an iteration costs against its ray casts.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from bench_speed import casts, heading
from loop_parts import PARTS, REST, STARTING
from workload import Work, held, recorded, threads

from calib.diagnosis.verdict import worth_adding
from calib.runs.run import Run
from chains import se3

HERE = Path(__file__).resolve().parents[2]
MAIN = "from calib.cli import main; main()"
HIDDEN = "incidence_angle_bias"  # what an explanation finds; added where nothing is worth adding
GOALS = {"fit": ">= 5", "diagnose": ">= 8", "add": ">= 5", "explain": ">= 8"}  # of the default
SIDES = ("ours", "theirs")
Side = tuple[Path, Path]  # a checkout, and the folder that it writes into
LINE = "{:16} {:10} {:>9} {:>9} {:>7} {:>9} {:>9} {:>7}   {:7} {}"


def rigcal(checkout: Path, folder: Path, *words: object) -> tuple[float, float]:
    """Run a command in a folder as a user does: its seconds by the clock, and of CPU."""
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    subprocess.run(
        [sys.executable, "-c", MAIN, *map(str, words)],
        cwd=folder,
        env=_with(checkout),
        stdout=subprocess.DEVNULL,
        check=True,
    )
    wall, after = time.perf_counter() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
    return wall, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def _with(checkout: Path) -> dict[str, str]:
    return os.environ | {"PYTHONPATH": str(checkout)}


def turns(sides: Sequence[Side], repeats: int, *words: object) -> np.ndarray:
    """Medians of clock and CPU of a command on each side, (sides, 2)."""
    seconds: list[list[tuple[float, float]]] = [[] for _ in sides]
    for _ in range(repeats):
        for mine, (checkout, folder) in zip(seconds, sides, strict=True):
            shutil.rmtree(folder / "ladder", ignore_errors=True)  # it would be taken up again
            mine.append(rigcal(checkout, folder, *words))
    return np.median(seconds, axis=1)


def sides_of(against: Path, folder: Path) -> list[Side]:
    """Both checkouts, with a folder each."""
    for name in SIDES:
        (folder / name).mkdir(parents=True)
    return [(c, folder / name) for c, name in zip((HERE, against), SIDES, strict=True)]


def loop(preset: str, hide: str, against: Path, folder: Path, repeats: int) -> None:
    """All verbs on a preset."""
    sides = sides_of(against, folder)
    # By the other side: a recording of a newer format is refused by an older one.
    rigcal(against, folder, "simulate", preset, "-o", "plain")
    rigcal(against, folder, "simulate", preset, "-o", "hiding", "--hide", hide)

    def line(told: str, verb: str, *words: object) -> None:
        seconds = turns(sides, repeats, verb, *words)
        goal = GOALS.get(verb, "") if preset == "default" else ""
        row(Path(preset).stem, verb, seconds, goal, told and agreement(folder, told))

    line("run", "fit", "../plain", "-o", "run")
    line("run/diagnosis.json", "diagnose", "run")
    found = json.loads((folder / "ours/run/diagnosis.json").read_text(encoding="utf-8"))
    effect = (worth_adding(found["candidates"]) or [HIDDEN])[0]
    line("grown", "add", "run", effect, "-o", "grown")
    line("ladder/explanation.json", "explain", "../hiding", "-o", "ladder")
    line("", "report", "run", "-o", "page.html")


def large(rows: int, against: Path, folder: Path, repeats: int) -> None:
    """A fit of many rows; the other side's once, as it takes minutes."""
    ours, theirs = sides_of(against, folder)
    recording = recorded(folder, rows, stops=8)
    rig = recording / "rig.yaml"
    rig.write_text(rig.read_text().removeprefix("format: 1\n"))  # older versions know no number
    words = ("fit", recording, "-o", "run")
    each = [turns([ours], repeats, *words), turns([theirs], 1, *words)]
    row(f"{rows} rows", "fit", np.concatenate(each), "", agreement(folder, "run"))


def row(preset: str, verb: str, seconds: np.ndarray, goal: str, told: str) -> None:
    """A line of the table, of (2, 2) seconds."""
    wall, cpu = ([f"{a:.2f}", f"{b:.2f}", f"{b / a:.2f}"] for a, b in seconds.T)
    print(LINE.format(preset, verb, *wall, *cpu, goal, told).rstrip(), flush=True)


def agreement(folder: Path, part: str) -> str:
    """How far the estimates of both sides' runs differ, or whether their findings do."""
    ours, theirs = (folder / name / part for name in SIDES)
    if not part.endswith(".json"):
        return f"{differs(ours, theirs):.3g} sigma apart"
    a, b = (_findings(json.loads(path.read_text(encoding="utf-8"))) for path in (ours, theirs))
    return "same verdict" if a == b else "ANOTHER VERDICT"


def _findings(document: dict[str, Any]) -> tuple[Any, ...]:
    """The verdict, and which effects were found or added, of a diagnosis or an explanation."""
    steps = [c["effect"] for c in document.get("candidates", ()) if c["step"]]
    return document["verdict"], sorted(steps), [r["added"] for r in document.get("ladder", ())]


def differs(a: Path, b: Path) -> float:
    """The largest difference of two runs' estimates, in sigmas."""
    found, (a, b) = [], (Run.open(run).solution.shared for run in (a, b))
    for name, frame in a.frames.items():
        away = se3.log(se3.inverse(frame.T_parent_child) @ b.frames[name].T_parent_child)
        found.append((away, np.concatenate([frame.sigma_rad, frame.sigma_m])))
    for name, effect in a.effects.items():
        found.append((b.effects[name].estimate - effect.estimate, effect.sigma))
    away, sigma = np.hstack(found)
    return float(np.max(np.abs(away[sigma > 0]) / sigma[sigma > 0]))


def profile(folder: Path, repeats: int) -> None:
    """A fit and a diagnosis by their parts, and an iteration against its casts."""
    verbs, recording = ("fit", "diagnose"), folder / "plain"
    found = {verb: _parts(verb, recording, folder / "profiled") for verb in verbs}
    print(f"\n{folder.name}, CPU s on one thread" + "".join(f"{v:>10}" for v in verbs))
    for part in (STARTING, *PARTS, REST):
        print(f"  {part:28}" + "".join(f"{found[v].get(part, 0.0):10.2f}" for v in verbs))
    print(f"  {'all':28}" + "".join(f"{sum(found[v].values()):10.2f}" for v in verbs) + "\n")
    heading()
    with threads(1):
        casts(Work.of(held(recording)), repeats)


def _parts(verb: str, recording: Path, run: Path) -> dict[str, float]:
    script = [sys.executable, Path(__file__).with_name("loop_parts.py")]
    return json.loads(subprocess.check_output([*script, verb, recording, run], env=_with(HERE)))


def main() -> None:
    """Run both sides and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--against", type=Path, default=HERE, help="another checkout")
    parser.add_argument("--presets", nargs="*", default=["tiny", "default"])
    parser.add_argument("--hide", default=f"{HIDDEN}=3", help="what is to be explained")
    parser.add_argument("--rows", type=int, default=0, help="of one large fit more; 0 for none")
    parser.add_argument("--repeats", type=int, default=3, help="of each, for the median")
    wanted = parser.parse_args()
    against = wanted.against.resolve()
    names = ("clock, s", "against", "ratio", "CPU, s", "against", "ratio", "goal", "agreement")
    print(LINE.format("what", "verb", *names))
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        for preset in wanted.presets:
            loop(preset, wanted.hide, against, folder / Path(preset).stem, wanted.repeats)
        if wanted.rows:
            large(wanted.rows, against, folder / "large", wanted.repeats)
        for preset in wanted.presets[-1:]:
            profile(folder / Path(preset).stem, wanted.repeats)


if __name__ == "__main__":
    main()
