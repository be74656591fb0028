"""Arms of many kinds under a tracker, one effect hidden in each: is it named, and named first?

    python -m tests.bench.arm_effects [--arms ur10,scara] [--kinds "*sag"] [--size 1] [--poses 300]
                                      [--jobs 2] [-o FILE --resume]

Geometry is off in ways that no name describes (each link by a twist of 1 mm and 1 mrad in all six
ways, joints by 2 mrad), and one thing more is wrong, of `arm_worlds_hidden`, so much that the
change of what the tracker sees is `--size` times its noise. Each is imported, fitted and diagnosed
as a user would. FILE gets a line of JSON per case; with ``--resume`` those it holds are kept.
"""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table
from threadpoolctl import threadpool_limits

from calib.runs.add import add
from calib.runs.calibrate import calibrate
from calib.runs.diagnose import diagnose
from chains.errors import InputError
from sensors.documents import plain

from ..calib.arm_worlds import bent, exp, noise, save
from ..chains.arms import TABLES
from .arm_worlds_hidden import KINDS, Session, scaled

SEED = 1600
JOINT_RAD = 2e-5  # of a reading: an encoder of 18 bits
NEAR = 1.10  # times what is expected, up to which a held-out error is as it should be
Case = tuple[str, str, float, int]  # arm, kind, size, poses


def written(folder: Path, case: Case) -> None:
    """The case's recording."""
    arm, kind, size, poses = case
    rng = np.random.default_rng([SEED, list(TABLES).index(arm), list(KINDS).index(kind)])
    world = bent(folder, arm, rng)
    session = Session.drawn(world, rng, poses)
    T = scaled(KINDS[kind].hide(world, session, rng), size)
    read = session.joints + JOINT_RAD * rng.normal(size=session.joints.shape)
    columns = {"time_s": session.time_s, "temperature_c": session.temperature_c}
    if "payload_kg" in KINDS[kind].needs:
        columns["payload_kg"] = session.payload_kg
    if "torque" in KINDS[kind].needs:
        pairs = zip(world.joints, session.torque.T, strict=True)
        columns |= {f"{joint}.torque": each for joint, each in pairs}
    save(folder, world, read, T * exp(noise(rng, poses)), columns, JOINT_RAD)


def asked(case: Case) -> dict[str, Any]:
    """What fit and diagnosis say of a case, and what is left once what they name is added."""
    with threadpool_limits(1), tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "rec").mkdir()
        written(folder / "rec", case)
        began = time.process_time()
        try:
            run = calibrate([folder / "rec"], folder / "run")
            fitted = time.process_time()
            said = diagnose(run)
            seconds = [fitted - began, time.process_time() - fitted]
            before = errors = run.summary["rms_mm"]
            if said.worth_adding:
                errors = add(run, said.worth_adding, folder / "grown").summary["rms_mm"]
        except InputError as error:
            return {"case": case, "fault": str(error)}
        except Exception:  # a fault of the program is a result like any other
            return {"case": case, "fault": traceback.format_exc()}
        finally:
            shutil.rmtree(folder, ignore_errors=True)
    confirmed = [c for c in said.candidates if c["step"]]
    return plain(
        {
            "case": case,
            "verdict": said.verdict,
            "names": [c["effect"] for c in sorted(confirmed, key=lambda c: c["step"])],
            "rivals": {c["effect"]: c["indistinguishable_from"] for c in confirmed},
            "blunders": [b["name"] for b in said.blunders],
            "formulas": list(said.formulas),
            "sentences": list(said.sentences)[:3],
            "held_out_mm": [before["held_out"], errors["held_out"], errors["noise_floor"]],
            "seconds": seconds,
        }
    )


def outcome(result: dict[str, Any]) -> str:
    """Named first, in the group of what was named first, missed, or something else was named."""
    if "fault" in result:
        return "fault"
    right, names = KINDS[result["case"][1]].right, result["names"]
    calm = result["verdict"] == "adequate"
    if not right:
        return "right" if calm else "false"
    if names and names[0] in right:
        return "right"
    if names and right & {n for rival in names[:1] for n in result["rivals"][rival]}:
        return "group"
    if right & set(names):
        return "later"
    return "missed" if calm else "other"


def cases(asked_for: argparse.Namespace) -> Iterator[Case]:
    """Of each arm each kind that it has the joints for."""
    arms = asked_for.arms.split(",") if asked_for.arms else list(TABLES)
    for kind in (k for k in KINDS if fnmatch(k, asked_for.kinds)):
        for arm in arms:
            turns = any(row[0] != "P" for row in TABLES[arm])
            if turns or kind not in ("eccentricity", "gear", "payload offset"):
                yield arm, kind, asked_for.size, asked_for.poses


def show(results: Sequence[dict[str, Any]]) -> None:
    """A line for each kind, and every case that did not come out right."""
    table = Table("hidden", "arms", "first", "group", "later", "other", "missed", "fault", box=None)
    for kind in KINDS:
        mine = [r for r in results if r["case"][1] == kind]
        if mine:
            of = Counter(outcome(r) for r in mine)
            told = (of["right"], of["group"], of["later"], of["other"] + of["false"])
            table.add_row(kind, *map(str, (len(mine), *told, of["missed"], of["fault"])))
    console = Console(width=150)
    console.print(table)
    fine = [r for r in results if "fault" not in r]
    near = [r["held_out_mm"][1] <= NEAR * r["held_out_mm"][2] for r in fine]
    console.print(f"held out within a tenth of what is expected: {sum(near)} of {len(near)}")
    seconds = np.array([r["seconds"] for r in fine])
    console.print(f"CPU seconds, median: fit {np.median(seconds[:, 0]):.1f}, diagnose ", end="")
    console.print(f"{np.median(seconds[:, 1]):.1f}; most {seconds.max():.1f}")
    for r in results:
        if (how := outcome(r)) not in ("right", "group"):
            told = r.get("fault") or f"{r['verdict']}: {r['names']} {r['blunders']} {r['formulas']}"
            console.print(f"{how:7} {r['case'][1]} of {r['case'][0]}: {told}", highlight=False)


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    options.add_argument("--arms", help="with commas; all if not given")
    options.add_argument("--kinds", default="*", help="a pattern")
    options.add_argument("--size", type=float, default=1.0, help="in the tracker's noise")
    options.add_argument("--poses", type=int, default=300)
    options.add_argument("--jobs", type=int, default=2)
    options.add_argument("-o", dest="out", type=Path, help="a line of JSON per case is added here")
    options.add_argument("--resume", action="store_true", help="keep what the file has")
    given = options.parse_args()
    kept = [json.loads(line) for line in given.out.open()] if given.resume else []
    have = {tuple(r["case"]) for r in kept}
    todo = [case for case in cases(given) if case not in have]
    with ProcessPoolExecutor(given.jobs) as pool:
        for result in track(pool.map(asked, todo), total=len(todo), description="arms"):
            kept.append(json.loads(json.dumps(result)))
            if given.out:
                with given.out.open("a") as file:
                    file.write(json.dumps(result) + "\n")
    show(kept)


if __name__ == "__main__":
    main()
