"""Recordings of perfect hardware but for one effect, and the state in which they were made."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from calib import effects
from calib.effects import Effect, View, find
from calib.forward import Term, place
from calib.problem import Problem, build
from calib.problem.model import Model, Source
from calib.problem.places import standing
from calib.residuals.targets import HangingTarget
from calib.rig import Rig
from calib.simulation import Spec
from chains import se3

from .simulated import changed, made

# Enough of everything that an effect may need: labels, masses, targets, a quarter of an hour.
FLAWLESS = Spec(
    lidar="hesai_pandarxt32",
    locations=3,
    stops_per_location=4,
    column_step=125,
    noise=0,
    build_error=0,
    mesh_error_m=0,
    mixed_pixel_share=0,
    occluded_share=0,
)
STANDING = {effect.name for effect in effects.CATALOGUE if effect.needs_standing}
STEEPEST_RAD = np.radians(80)


def coarse(rig: Rig) -> Rig:
    """The rig with a LiDAR that rounds range to 2 cm, far beyond its noise."""
    return replace(rig, lidar=replace(rig.lidar, quantum_m=0.02))


def as_needed(rig: Rig, effect: Effect) -> Rig:
    """The rig, or where an effect is about such, one that stands still at each location."""
    return replace(rig, moves="location") if effect.needs_standing else rig


def hide(folder: Path, name: str, size: float = 1.0, **fields: object) -> tuple[Source, dict]:
    """A recording with one effect hidden in flawless hardware, and its truth."""
    stands = name.partition("@")[0] in STANDING
    fields = {"base_moves": "location"} | fields if stands else fields
    return made(folder, changed(FLAWLESS, **fields), **{name: size})


def every_column(folder: Path, **fields: object) -> tuple[Source, dict]:
    """A recording of flawless hardware with all columns that effects may look at, and its truth."""
    nothing = dict.fromkeys(("range_offset", "arm_payload_sag", "arm_torque_sag"), 0.0)
    return made(folder, changed(FLAWLESS, **fields), **nothing)


def stops_of(source: Source, **columns: np.ndarray) -> View:
    count = len(source.recording.stops)
    return View(source.rig, count, {**source.columns, **columns}, source.recording.joints)


def placed(source: Source, name: str, theta: object, frame: str = "lidar") -> np.ndarray:
    """T_root_frame (K, 4, 4) under one effect."""
    theta = np.atleast_1d(np.asarray(theta, float))
    term = Term(find(name), name, np.arange(len(theta)))
    joints, columns = source.recording.joints, source.columns
    return place(source.rig, [term], joints, columns, "root", None).in_root(frame, {name: theta}).T


def at_truth(source: Source, truth: dict, name: str) -> tuple[Problem, dict, np.ndarray]:
    """The problem of one effect, its values where the recording was made, and the effect's own."""
    problem = build([source], Model((effects.find(name),)))
    T_opti_faro = np.linalg.inv(truth["T_faro_opti"])
    values = dict(problem.initial)
    values[source.rig.reference_frame] = T_opti_faro
    where = dict(zip(source.recording.stops, standing(source), strict=True))
    for stop, at in truth["stops"].items():
        values[f"root@{where[stop]}"] = T_opti_faro @ np.array(at["T_faro_root"])
    for target in (b for b in problem.blocks if isinstance(b, HangingTarget) and name in b.tracked):
        values[target.gravity] = -T_opti_faro[:3, 2]
        (sphere,) = se3.apply(T_opti_faro, target.faro_m[None])
        values[target.marker] = sphere - target.below_m * values[target.gravity]
    term = next(t for t in problem.terms[0] if t.variable == name)
    theta = np.array(truth["effects"][name])[term.free]
    return problem, {**values, name: theta}, theta


def residuals(problem: Problem, values: dict) -> tuple[np.ndarray, np.ndarray]:
    """Range residuals of all beams but grazing ones, m, and whitened ones of trackers and rods."""
    beams = []
    for scan in problem.scans:
        rows = scan.rows(values)
        beams.append(rows.residual_m[rows.usable & (rows.view["incidence_rad"] < STEEPEST_RAD)])
    others = [block.evaluate(values, False)[0] for block in problem.blocks]
    return np.concatenate(beams), np.concatenate(others)
