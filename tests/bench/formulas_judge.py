"""What the program finds of a hidden formula, run as a user would, held against the truth."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from calib.diagnosis.verdict import worth_adding
from calib.effects.own.expression import Expression

from ..mishaps.judge import blunders, rigcal, solution
from .formulas_effects import covariates, same, value
from .formulas_size import Absorbs, rms

MOST = 4  # rungs: two that are hidden, one that was wrong, and one that is too much
LIMIT_S = 600  # CPU, of a command
WITHIN = 0.1  # of the floor, and of the effect's rms
SIGMAS = 2.0
THROWN = 0.01  # of the beams; of the window of `known_sector` it is a tenth
RUN = "run0"  # the first fit
KEPT = ("covariates", "formula", "says", "p_value", "alike")
KEY = ["stop", "ring", "column"]
# What effects of the catalogue are of the range, each of any size, as their pages say.
CATALOGUE = {
    "temperature_drift": ("temperature_c",),
    "azimuth_range_harmonic": tuple(
        f"{f}({m} * azimuth_rad)" for m in range(1, 5) for f in ("sin", "cos")
    ),
    "intensity_range_walk": ("log(intensity)",),
    "incidence_angle_bias": ("1 / cos(incidence_rad)",),
    "range_scale": ("range_m",),
}
BY_CHANCE = "_scatter"  # how names end of what scatters by chance


@dataclass
class Ladder:
    """What was found, added and left, rung by rung.

    Args:
        runs: fits, first to last.
        rungs: of each rung after the first the names of the ``effects`` that it adds: those
            ``named`` by the catalogue, and ``formulas``, of each what is `KEPT`.
        said: per diagnosis its verdict, blunders, how many formulas it has, and seconds.
        fit_s: CPU seconds of the first fit.
        stopped: why no further rung was tried.
    """

    runs: list[Path]
    fit_s: float
    rungs: list[dict[str, Any]] = field(default_factory=list)
    said: list[dict[str, Any]] = field(default_factory=list)
    stopped: str = ""


def climbed(recording: Path, folder: Path, most: int = MOST) -> Ladder:
    """Fit, then diagnose and add what it proposes, until it proposes nothing."""
    run = folder / RUN
    first = rigcal("fit", recording, "-o", run, limit_s=LIMIT_S)
    ladder = Ladder([run], first.seconds)
    if first.code != 0:
        ladder.stopped = f"fit: {complaint(first)}"
        return ladder
    while len(ladder.rungs) < most:
        begin = time.perf_counter()
        told = rigcal("diagnose", ladder.runs[-1], limit_s=LIMIT_S)
        document = told.document
        seconds = {"cpu_s": told.seconds, "wall_s": time.perf_counter() - begin}
        verdict = document.get("verdict") or complaint(told)
        loose = sum(bool(each.get("formula")) for each in document.get("unexplained", []))
        told_of = {"verdict": verdict, "blunders": blunders(document), "formulas": loose}
        ladder.said.append(told_of | seconds)
        rung = proposed(document)
        if not rung:
            ladder.stopped = "nothing more"
            return ladder
        run = folder / f"run{len(ladder.runs)}"
        grown = rigcal("add", ladder.runs[-1], *rung["effects"], "-o", run, limit_s=LIMIT_S)
        ladder.rungs.append(rung)
        if grown.code != 0:
            ladder.stopped = f"add {', '.join(rung['effects'])}: {complaint(grown)}"
            return ladder
        ladder.runs.append(run)
    ladder.stopped = "too many"
    return ladder


def oracle(fitted: Path, hidden: Sequence[str], folder: Path) -> dict[str, Any]:
    """What is to be had: the hidden formulas themselves, added to a fit.

    Returns:
        As `errors`; empty where that fit fails.
    """
    file, run = folder / "truth.yaml", folder / "oracle"
    effects = [
        {"name": f"truth_{i}", "site": "range", "unit": "m", "sigma": 0.1, "basis": text}
        for i, text in enumerate(hidden)
    ]
    file.write_text(json.dumps(effects))  # YAML holds JSON
    if rigcal("add", fitted, file, "-o", run, limit_s=LIMIT_S).code != 0:
        return {}
    return errors(run)


def complaint(said: Any) -> str:
    """Why a command failed."""
    return said.complaint.strip().splitlines()[-1][:300] if said.complaint.strip() else "endless"


def proposed(diagnosis: Mapping[str, Any]) -> dict[str, Any]:
    """What a user would add: effects of the catalogue that are worth it, and all formulas."""
    named = worth_adding(diagnosis.get("candidates", []))
    named = list(named) if diagnosis.get("verdict") == "missing_effect" else []
    told = [each for each in diagnosis.get("unexplained", []) if each.get("formula")]
    kept = [{key: each.get(key) for key in KEPT} for each in told]
    names = [each["formula"]["name"] for each in told]
    return {"effects": [*named, *names], "named": named, "formulas": kept} if named + names else {}


def formulas(ladder: Ladder) -> list[dict[str, Any]]:
    """All formulas that were added."""
    return [each for rung in ladder.rungs for each in rung["formulas"]]


def named(ladder: Ladder) -> list[str]:
    """What was added by the catalogue's names."""
    return [name for rung in ladder.rungs for name in rung["named"]]


def looks_at(found: Sequence[Mapping[str, Any]]) -> frozenset[str]:
    """All covariates of formulas, those that are one thing by one name."""
    return same(name for each in found for name in each["covariates"])


def in_texts(each: Mapping[str, Any]) -> frozenset[str]:
    """The covariates that a formula's texts look at, which are those that it says, one hopes."""
    texts = each["formula"]["basis"]
    return same(n for text in texts for n in Expression(text, each["formula"]["name"]).names)


def covariates_right(
    found: Sequence[Mapping[str, Any]],
    hidden: Sequence[frozenset[str]],
    names: Sequence[str] = (),
) -> bool:
    """Whether what formulas, and effects of the catalogue beside them, say that ranges hang on is
    what was hidden, no more and no less; and each formula looks at one of what was hidden, or at
    all of it. Names of what scatters by chance say nothing of that."""
    every = frozenset().union(*hidden)
    told = [name for name in names if not name.endswith(BY_CHANCE)]
    if not set(told) <= set(CATALOGUE):
        return False
    beside = frozenset().union(*(covariates(text) for name in told for text in CATALOGUE[name]))
    mine = all(in_texts(each) in (*hidden, every) for each in found)
    return looks_at(found) | beside == every and mine


def errors(run: Path) -> dict[str, float | None]:
    """Held-out error and the floor of a run, mm, and the share of the beams that it leaves out."""
    said = json.loads((run / "summary.json").read_text())
    rms_mm = said["rms_mm"]
    return {
        "held_out_mm": rms_mm["held_out"],
        "floor_mm": rms_mm["noise_floor"],
        "rejected": said["rejected_share"],
    }


def at_floor(last: Mapping[str, Any], best: Mapping[str, Any]) -> bool:
    """Whether a run's held-out error is within a tenth of the floor, and not because it throws
    away what is hidden, as a window of azimuth: no more beams than with the truth, to `THROWN`."""
    near = last["held_out_mm"] is not None and last["held_out_mm"] < (1 + WITHIN) * last["floor_mm"]
    return near and last["rejected"] < best["rejected"] + THROWN


def fitted(run: Path, told: Sequence[Mapping[str, Any]], stops: pd.DataFrame) -> pd.DataFrame:
    """What formulas of a run add to ranges, at its beams.

    Returns:
        ``stop``, ``ring``, ``column``; ``fitted_m`` and its ``sigma_m``, estimates taken as
        independent.
    """
    table = rows_of(run, stops)
    columns = {name: table[name].to_numpy() for name in table}
    found, total, variance = solution(run)["effects"], 0.0, 0.0
    for each in told:
        document = each["formula"]
        if document["site"] != "range":
            continue
        said = found[document["name"]]
        for text, estimate, sigma in zip(
            document["basis"], said["estimate"], said["sigma"], strict=True
        ):
            basis = Expression(text, document["name"]).value(columns.__getitem__)
            total = total + estimate * basis
            variance = variance + (sigma * basis) ** 2
    table = table[KEY].copy()
    table["fitted_m"], table["sigma_m"] = total, np.sqrt(variance)
    return table


def rows_of(run: Path, stops: pd.DataFrame) -> pd.DataFrame:
    """The residual table of a run, every covariate of its stops beside."""
    folder = run / "residuals.parquet"
    parts = [
        pd.read_parquet(file).assign(stop=file.stem)
        for file in sorted(folder.glob("[!_]*.parquet"))
    ]
    rows = pd.concat(parts, ignore_index=True)
    stops = stops.assign(elapsed_s=stops["time_s"] - stops["time_s"].min())
    more = [c for c in stops.select_dtypes("number") if c not in rows]
    return rows.merge(stops[["stop", *more]], on="stop", how="left")


def form(
    run: Path,
    told: Sequence[Mapping[str, Any]],
    stops: pd.DataFrame,
    beams: pd.DataFrame,
    names: Sequence[str] = (),
) -> dict[str, Any]:
    """Whether formulas are the truth over the data's range, after what the model absorbs.

    Args:
        run: the last of a ladder.
        told: its formulas.
        stops: stops.csv.
        beams: `KEY`, what `Absorbs.of` takes, and ``error_m``, the truth.
        names: effects of the catalogue that the run has beside, which are taken to be as large as
            makes the most of them.

    Returns:
        ``effect_mm``, ``off_mm`` and ``sigma_mm``, rms; ``right``.
    """
    both = fitted(run, told, stops).merge(beams, on=KEY, how="inner", validate="1:1")
    absorbs = Absorbs.of(both)
    true = absorbs.off(both["error_m"].to_numpy(float))
    off = absorbs.off(both["fitted_m"].to_numpy(float)) - true
    columns = {name: both[name].to_numpy() for name in both}
    texts = [text for name in names for text in CATALOGUE.get(name, ())]
    if texts:
        beside = absorbs.off(np.stack([value(text, columns) for text in texts], axis=1))
        off = off - beside @ np.linalg.lstsq(beside, off, rcond=1e-9)[0]
    off_m = rms(off)
    sigma_m, effect_m = rms(both["sigma_m"]), rms(true)
    found = {"effect_mm": effect_m, "off_mm": off_m, "sigma_mm": sigma_m}
    right = bool(told) and off_m < max(SIGMAS * sigma_m, WITHIN * effect_m)
    return {name: round(1e3 * x, 4) for name, x in found.items()} | {"right": bool(right)}
