"""What nobody has named: is its formula found? Hidden range errors that no catalogue lists.

    python -m tests.bench.formulas [--count 50] [--rigs arm,head,planes] [--times 1,0.4]
                                   [--nulls 100] [--beams 2000] [--jobs 1] [--seed 0]
                                   [--rungs 4] [--keep TABLES] [-o FILE --resume]

Every case is a recording of `tests.worlds`, which shares no code with the program, with a formula
of `formulas_effects` added to its ranges; it is fitted, diagnosed, and what the diagnosis proposes
is added, as a user would, until it proposes nothing. Judged: covariates, held-out error, form,
seconds; and how often a formula is proposed where nothing is hidden. Recordings of the independent
simulator whose formula is known come last. FILE gets a line of JSON per case.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import traceback
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from rich.progress import track
from threadpoolctl import threadpool_limits

from sensors.documents import plain

from .blunders import read
from .formulas_effects import covariates, value
from .formulas_judge import (
    MOST,
    RUN,
    at_floor,
    climbed,
    covariates_right,
    errors,
    form,
    formulas,
    in_texts,
    looks_at,
    named,
    oracle,
    rows_of,
)
from .formulas_size import rms
from .formulas_table import show
from .formulas_worlds import RIGS, Case, cases, written

SHARED = Path(__file__).resolve().parents[3] / "shared" / "data" / "recordings"
# Recordings of the independent simulator, and their formulas, of the parameters in truth.json.
KNOWN = {
    "known_ring_by_temperature": (
        "x_temp_ring",
        "{0} * (temperature_c - 27) / 4 * (2 * ring / {1} - 1)",
    ),
    "known_sector": ("x_sector", "{0} * (azimuth_rad > {1}) * (azimuth_rad < {1} + 0.7)"),
}


def run(case: Case, keep: Path | None = None, most: int = MOST) -> dict[str, Any]:
    """What the program finds of a case, and how right that is.

    Args:
        case: which.
        keep: a folder that gets CASE.parquet, the residuals of the first fit, and CASE.json.
        most: as of `judged`.
    """
    with threadpool_limits(1), tempfile.TemporaryDirectory() as folder:
        made = written(case, Path(folder) / "case")
        about = {
            "case": case.name,
            "rig": case.rig,
            "lidar": case.world.lidar,
            "times": case.times,
            "scatter_mm": 1e3 * case.scatter_m,
            "beams": len(made.beams),
            "size_mm": 1e3 * made.size_m,
        }
        beams = made.beams.assign(error_m=made.error_m)
        result = about | judged(made.folder, Path(folder), list(case.formulas), beams, most)
        if keep is not None and result["held_out_mm"]:
            _keep(keep, result, rows_of(Path(folder) / RUN, pd.read_csv(made.folder / "stops.csv")))
        return result


def _keep(folder: Path, result: Mapping[str, Any], rows: pd.DataFrame) -> None:
    """For `formulas_baselines`."""
    folder.mkdir(parents=True, exist_ok=True)
    rows.to_parquet(folder / f"{result['case']}.parquet", index=False)
    floor_mm = 1e3 * rms(rows["sigma_m"])
    about = {name: result[name] for name in ("case", "rig", "hidden", "wanted")}
    (folder / f"{result['case']}.json").write_text(json.dumps(about | {"floor_mm": floor_mm}))


def run_known(name: str, most: int = MOST) -> dict[str, Any]:
    """The same of a recording of the independent simulator."""
    recording = SHARED / name
    key, text = KNOWN[name]
    truth = json.loads(Path(f"{recording}.truth.json").read_text())
    formula = text.format(*truth["params"][key])
    stops = pd.read_csv(recording / "stops.csv")
    beams = pd.concat(
        pd.read_parquet(recording / "scans" / f"{stop}.parquet").assign(stop=stop)
        for stop in stops["stop"]
    )
    beams = beams.merge(stops[["stop", "temperature_c"]], on="stop")
    beams["azimuth_rad"] = np.arctan2(beams["y"], beams["x"])
    beams["error_m"] = value(formula, {n: beams[n].to_numpy() for n in beams})
    about = {"case": name, "rig": "known", "lidar": truth["sensor"], "beams": len(beams)}
    with threadpool_limits(1), tempfile.TemporaryDirectory() as folder:
        return about | judged(recording, Path(folder), [formula], beams, most)


def judged(
    recording: Path, folder: Path, hidden: Sequence[str], beams: pd.DataFrame, most: int = MOST
) -> dict[str, Any]:
    """Run the program on a recording, and hold what it finds against the truth.

    Args:
        recording: a folder.
        folder: where runs go.
        hidden: formulas.
        beams: as of `formulas_judge.form`.
        most: rungs; with none, only what is to be had is told.
    """
    ladder = climbed(recording, folder, most)
    found, stops = formulas(ladder), pd.read_csv(recording / "stops.csv")
    wanted = [covariates(formula) for formula in hidden]
    steps = [errors(each) for each in ladder.runs if (each / "summary.json").exists()]
    best = oracle(ladder.runs[0], hidden, folder) if hidden and steps else {}
    result = {
        "hidden": list(hidden),
        "wanted": sorted(frozenset().union(*wanted)),
        "found": [sorted(looks_at([each])) for each in found],
        "in_texts": [sorted(in_texts(each)) for each in found],
        "says": [each.get("says") for each in found],
        "basis": [each["formula"]["basis"] for each in found],
        "p_value": [each.get("p_value") for each in found],
        "alike": [[other["says"] for other in each.get("alike") or ()] for each in found],
        "named": named(ladder),
        "verdicts": [said["verdict"] for said in ladder.said],
        "blunders": [said["blunders"] for said in ladder.said],
        "formulas": [said["formulas"] for said in ladder.said],
        "stopped": ladder.stopped,
        "held_out_mm": [step["held_out_mm"] for step in steps],
        "floor_mm": [step["floor_mm"] for step in steps],
        "rejected": [step["rejected"] for step in steps],
        "oracle": best,
        "fit_s": ladder.fit_s,
        "search_s": [said["cpu_s"] for said in ladder.said],
        "covariates_right": covariates_right(found, wanted, named(ladder)),
        "at_floor": bool(steps) and at_floor(steps[-1], best or steps[0]),
    }
    if hidden and ladder.rungs and len(ladder.runs) == 1 + len(ladder.rungs):
        result["form"] = form(ladder.runs[-1], found, stops, beams, named(ladder))
    return plain(result)


def main() -> None:
    """Run what is asked for, and print the table."""
    asked = _arguments()
    done = read(asked.out) if asked.resume and asked.out else {}
    if asked.out and not asked.resume:
        asked.out.write_text("", encoding="utf-8")
    known = [name for name in KNOWN if (SHARED / name).is_dir()] if asked.known else []
    listed = cases(asked.count, asked.nulls, asked.rigs, asked.times, asked.seed)
    listed = [replace(case, beams=asked.beams) for case in listed]
    if asked.only:
        listed = [case for case in listed if case.name in asked.only]
    jobs = {**{case.name: case for case in listed}, **{name: name for name in known}}
    left = [job for name, job in jobs.items() if name not in done]
    for result in track(finished(left, asked.jobs, asked.keep, asked.rungs), "formulas", len(left)):
        done[result["case"]] = result
        if asked.out:
            with asked.out.open("a", encoding="utf-8") as file:
                file.write(json.dumps(result) + "\n")
    show([done[name] for name in jobs])


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=50, help="hidden ones, of each size")
    parser.add_argument("--nulls", type=int, default=100, help="where nothing is hidden")
    parser.add_argument("--rigs", default=",".join(RIGS), help="with commas")
    parser.add_argument("--times", default="1,0.4", help="sizes in sigmas of a shot, with commas")
    parser.add_argument("--beams", type=int, default=2000, help="of a stop, about")
    parser.add_argument("--rungs", type=int, default=MOST, help="at most; 0: only the truth added")
    parser.add_argument("--only", default="", help="names of cases, with commas")
    parser.add_argument("--no-known", dest="known", action="store_false")
    parser.add_argument("--jobs", type=int, choices=(1, 2), default=1)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path, help="a folder for the residuals of first fits")
    parser.add_argument("-o", dest="out", type=Path, help="a line of JSON per case is added here")
    parser.add_argument("--resume", action="store_true", help="keep what the file has")
    asked = parser.parse_args()
    asked.rigs, asked.only = asked.rigs.split(","), [n for n in asked.only.split(",") if n]
    asked.times = [float(each) for each in asked.times.split(",")] if asked.count else []
    if unknown := [rig for rig in asked.rigs if rig not in RIGS]:
        parser.error(f"no such rig: {', '.join(unknown)}; there are {', '.join(RIGS)}")
    return asked


def finished(
    jobs: Sequence[Case | str], count: int, keep: Path | None, most: int
) -> Iterator[dict[str, Any]]:
    """Results as they come."""
    guarded = partial(_guarded, keep=keep, most=most)
    if count == 1:
        yield from map(guarded, jobs)
        return
    with ProcessPoolExecutor(count) as pool:
        yield from pool.map(guarded, jobs)


def _guarded(job: Case | str, keep: Path | None, most: int) -> dict[str, Any]:
    try:
        return run_known(job, most) if isinstance(job, str) else run(job, keep, most)
    except Exception:
        name = job if isinstance(job, str) else job.name
        return {"case": name, "error": traceback.format_exc()}


if __name__ == "__main__":
    main()
