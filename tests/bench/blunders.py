"""One thing wrong in a recording: is it named, and is anything ever wrong and calm?

    python -m tests.bench.blunders [--quick] [--rigs all,"no arm"] [--kinds "*scan*"]
                                   [--times 3,10] [--worlds 3] [--nulls 6] [--jobs 2]
                                   [-o FILE --resume]

Every mishap of `tests.mishaps` is done to a good recording of every rig that has what it needs, at
1, 3 and 10 times the size that the diagnosis of the good recording says it can detect (or a usual
size, where it does not say), and `rigcal check`, `fit` and `diagnose` are asked. FILE gets a line
of JSON per case as it is done; with ``--resume`` those that it holds are not run again. Recordings
by the independent simulator lie beside the repository; rigs named "own ..." do without.
"""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
import traceback
import zlib
from collections.abc import Collection, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import track
from threadpoolctl import threadpool_limits

from sensors.documents import plain

from ..mishaps import MISHAPS, TIMES, Done, Scene
from ..mishaps.judge import as_truth, asked, largest, matches, off, read_truth
from .blunders_table import NOTHING, show
from .blunders_worlds import RIGS, made

QUICK_RIG = "own all"
QUICK = (
    "mount body shifted at one stop",
    "sensor shifted at one stop",
    "two scans exchanged",
    "one joint misread at one stop",
    "a sphere misplaced",
    "CAD of the sensor of wrong sign",
    "rows of zeros where nothing was seen",
    "quaternions of either sign",
)
LIMIT_S = 60  # CPU, of a command; a good fit takes 2 s, a diagnosis that finds a formula 20
WORST = 5  # estimates that are kept of a case


@dataclass(frozen=True)
class Case:
    """A mishap, and what it is done to.

    Args:
        rig: of `RIGS`.
        number: of its recordings.
        kind: of `MISHAPS`, or `NOTHING`.
        times: the detectable size.
    """

    rig: str
    number: int
    kind: str = NOTHING
    times: int = 0

    @property
    def name(self) -> str:
        """Unique."""
        return f"{self.rig}/{self.number}/{self.kind} x{self.times}"


def cases(
    rigs: Sequence[str], kinds: str, worlds: int, features: Mapping[str, set[str]]
) -> Iterator[Case]:
    """Every mishap that a rig has the instruments for, each size in the same recording.

    Args:
        rigs, kinds: names of rigs, and a pattern of kinds.
        worlds: how many recordings of a rig there are; a kind is done to one of them.
        features: of each rig.
    """
    for rig in rigs:
        for mishap in MISHAPS.values():
            if fnmatch(mishap.name, kinds) and mishap.needs <= features[rig]:
                number = zlib.crc32(f"{rig} {mishap.name}".encode()) % worlds
                yield from (Case(rig, number, mishap.name, times) for times in mishap.times)


def run(case: Case, worlds: Path, null: Mapping[str, Any]) -> dict[str, Any]:
    """What is said of a case, and how far the calibration is from the truth.

    Args:
        case: what to run.
        worlds: where good recordings are kept.
        null: the result of the good recording, empty for that itself.
    """
    good = made(case.rig, case.number, _place(worlds, case))
    with threadpool_limits(1), tempfile.TemporaryDirectory(dir=worlds) as folder:
        recording = shutil.copytree(good, Path(folder) / "recording")
        # The same stop, body and way at every size.
        seed = zlib.crc32(f"{case.rig} {case.kind}".encode())
        scene = Scene(recording, np.random.default_rng(seed), null.get("detectable", {}))
        done = MISHAPS[case.kind].apply(scene, case.times) if case.kind in MISHAPS else None
        found = asked(recording, Path(folder) / "run", LIMIT_S)
        folders = {str(recording): "REC", folder: ""}
        errors = _errors(Path(folder) / "run", read_truth(Path(f"{good}.truth.json")), null, done)
        return (
            _without(folders, found)
            | errors
            | {
                "case": case.name,
                "rig": case.rig,
                "number": case.number,
                "kind": case.kind,
                "times": case.times,
                "right": sorted(done.right) if done else [],
                "group": sorted(done.group) if done else [],
                "without_it": {key: null[key] for key in ("outcome", "names", "odd") if null},
                "could_move": _could_move(null, done.right) if done else 0.0,
            }
        )


def _could_move(null: Mapping[str, Any], right: Collection[str]) -> float:
    """By how many sigmas the diagnosis of the good recording says that such a mishap could move an
    estimate, unseen."""
    unseen = null.get("unseen", {})
    return max((far for token, far in unseen.items() if matches(token, right)), default=0.0)


def _errors(
    run: Path, truth: dict[str, Any], null: Mapping[str, Any], done: Done | None
) -> dict[str, Any]:
    """Distances of a run's estimates from the truth, and from those of the good recording."""
    if not (run / "solution.yaml").is_file():
        return {"off": [], "told_off": 0.0, "moved": 0.0}
    errors = off(run, truth, done)
    worst = sorted(errors, key=lambda name: -errors[name].sigmas)[:WORST]
    said = {
        "off": [[name, errors[name].sigmas, errors[name].told] for name in worst],
        "told_off": largest(errors),
    }
    if null:
        return said | {"moved": largest(off(run, null["estimates"], done), null["sigmas"])}
    sigmas = {name: error.sigma for name, error in errors.items()}
    return said | {"moved": 0.0, "estimates": plain(as_truth(run)), "sigmas": sigmas}


def _without(folders: Mapping[str, str], found: Mapping[str, Any]) -> dict[str, Any]:
    """Sentences without the folders of this moment, so that two can be compared."""
    text = json.dumps(plain(found))
    for folder, name in folders.items():
        text = text.replace(folder, name)
    return json.loads(text)


def _place(worlds: Path, case: Case) -> Path:
    return worlds / f"{case.rig.replace(' ', '_')}_{case.number}"


def main() -> None:
    """Run what is asked for, and print the table."""
    wanted = _arguments()
    with tempfile.TemporaryDirectory() as folder:
        worlds = Path(folder)
        known = read(wanted.out) if wanted.resume and wanted.out else {}
        if wanted.out and not wanted.resume:
            wanted.out.write_text("", encoding="utf-8")
        nulls = [Case(rig, n) for rig in wanted.rigs for n in range(wanted.nulls)]
        features = {}
        for null in nulls:  # one after another: each is made here, and only read from then on
            scene = Scene(
                made(null.rig, null.number, _place(worlds, null)), np.random.default_rng()
            )
            features.setdefault(null.rig, scene.features())
        chosen = list(cases(wanted.rigs, wanted.kinds, min(wanted.worlds, wanted.nulls), features))
        chosen = [c for c in chosen if c.times in wanted.times]
        if wanted.quick:
            chosen = [c for c in chosen if c.kind in QUICK]
        _finish("nothing wrong", nulls, known, worlds, wanted)
        _finish("mishaps", chosen, known, worlds, wanted)
        show([known[c.name] for c in (*nulls, *chosen) if c.name in known])


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a dozen cases of one rig")
    parser.add_argument("--rigs", default=",".join(RIGS), help="with commas; all if not given")
    parser.add_argument("--kinds", default="*", help="a pattern")
    sizes = ",".join(map(str, TIMES))
    parser.add_argument("--times", default=sizes, help="the detectable sizes, with commas")
    parser.add_argument("--worlds", type=int, default=3, help="good recordings that are spoilt")
    parser.add_argument("--nulls", type=int, default=6, help="good recordings of each rig")
    parser.add_argument("--jobs", type=int, choices=(1, 2), default=1)
    parser.add_argument("-o", dest="out", type=Path, help="a line of JSON per case is added here")
    parser.add_argument("--resume", action="store_true", help="keep what the file has")
    wanted = parser.parse_args()
    wanted.rigs = [QUICK_RIG] if wanted.quick else wanted.rigs.split(",")
    wanted.times = [3, 10] if wanted.quick else [int(x) for x in wanted.times.split(",")]
    if wanted.quick:
        wanted.nulls = wanted.worlds = 2
    if unknown := set(wanted.rigs) - set(RIGS):
        parser.error(f"no such rig: {', '.join(sorted(unknown))}")
    return wanted


def read(path: Path) -> dict[str, dict[str, Any]]:
    """Results that a file holds, by case; those of cases that failed are left out."""
    if not path.exists():
        return {}
    lines = map(json.loads, path.read_text(encoding="utf-8").splitlines())
    return {line["case"]: line for line in lines if "error" not in line}


def _finish(
    what: str,
    wanted: Sequence[Case],
    known: dict[str, dict[str, Any]],
    worlds: Path,
    choices: argparse.Namespace,
) -> None:
    """Run the cases that are not known, and add what came out to those that are."""
    left = [c for c in wanted if c.name not in known]
    tasks = [(c, worlds, known.get(Case(c.rig, c.number).name, {})) for c in left]
    with ProcessPoolExecutor(choices.jobs) as pool:
        results = pool.map(_guarded, tasks)
        for result in track(results, what, len(left)):
            known[result["case"]] = result
            if choices.out:
                with choices.out.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(result) + "\n")


def _guarded(task: tuple[Case, Path, Mapping[str, Any]]) -> dict[str, Any]:
    try:
        return run(*task)
    except Exception:
        return {"case": task[0].name, "error": traceback.format_exc()}


if __name__ == "__main__":
    main()
