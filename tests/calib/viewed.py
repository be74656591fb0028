"""Runs to lay on the workbench: a small one, and others made from it without a fit."""

import json
import shutil
from pathlib import Path

from calib.runs.calibrate import calibrate
from calib.runs.run import Run
from calib.simulation import Spec, simulate
from sensors.documents import read_yaml, write_json, write_yaml

SMALL = {
    "lidar": "ouster_os0_128_rev6",
    "locations": 2,
    "stops_per_location": 2,
    "column_step": 128,
    "occluded_share": 0,
}


def small_run(folder: Path, **changes: object) -> Run:
    """A fitted run of a few hundred beams at four stops, in ``folder/run``; nothing held out."""
    simulate(Spec(**{**SMALL, **changes}), folder / "rec", 3, {})
    return calibrate([folder / "rec"], folder / "run", hold_out="none")


def hidden(folder: Path) -> None:
    """A run whose model lacks what was hidden in its recording, in ``folder/run``."""
    simulate("tiny", folder / "rec", 1, {"incidence_angle_bias": 2.0})
    calibrate([folder / "rec"], folder / "run")


def grown(run: Run, out: Path, effect: str, held_out_mm: float) -> Run:
    """A copy of a run that says that it grew from that one by an effect."""
    shutil.copytree(run.folder, out)
    model = read_yaml(out / "model.yaml")[0]
    model |= {"grown_from": str(run.folder.resolve()), "effects": [*model["effects"], effect]}
    write_yaml(out / "model.yaml", model)
    summary = json.loads((out / "summary.json").read_text())
    summary["rms_mm"]["held_out"] = held_out_mm
    write_json(out / "summary.json", summary)
    return Run.open(out)


def candidate(name: str, step: int | None = None, dressed_up: bool = False) -> dict:
    """A candidate of a diagnosis, as diagnosis.json has it."""
    return {
        "effect": name.partition("@")[0],
        "add": name,
        "p_adjusted": 1e-7,
        "step": step,
        "dressed_up": dressed_up,
        "held_out_rms_mm": {"before": 7.71 if step else None, "after": 1.42 if step else None},
        "unabsorbed_rms_mm": 0.44,
    }


def blunder(token: str) -> dict:
    """A blunder of a diagnosis, as diagnosis.json has it."""
    return {
        "without": token,
        "size": 0.00292,
        "sigma": 0.00025,
        "unit": "m",
        "axis": "x",
        "wrong_sign": None,
        "belongs_to": None,
        "indistinguishable_from": [],
        "sentence": f"{token} is 2.92 ± 0.25 mm off in x, against everything else.",
    }


def diagnosed(folder: Path, **changes: object) -> dict:
    """Write a diagnosis into a run folder: one effect found, another not, a formula, two curves."""
    curve = {"centres": [[0.2, 0.6, 1.0]], "band_mm": [0.1, 0.1, 0.1]}
    found = {
        "verdict": "missing_effect",
        "heading": "an effect is missing",
        "too_few_stops": False,
        "weak_directions": [],
        "blunders": [],
        "groups": [],
        "command": None,
        "sentences": ["incidence_angle_bias is missing."],
        "candidates": [candidate("range_scale"), candidate("incidence_angle_bias", step=1)],
        "unexplained": [{"formula": {"name": "empirical_range", "basis": ["range"]}}],
        "curves": [
            curve | {"covariates": ["range_m"], "mean_mm": [0.3, 0.0, -0.9]},
            curve | {"covariates": ["incidence_rad"], "mean_mm": [0.0, None, 0.2]},
            curve | {"covariates": ["range_m", "incidence_rad"], "mean_mm": [[0.0]]},
        ],
    } | changes
    write_json(folder / "diagnosis.json", found)
    return found
