"""extrinsics.yaml: every frame in four notations, every effect, their sigmas, and where from."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np

from calib.exporters.fitted import Fitted
from calib.exporters.written import Written, commented, warnings, write_text
from calib.results.solution import (
    EffectEstimate,
    FrameEstimate,
    Part,
    ShapeEstimate,
    effect_document,
    frame_document,
)
from calib.runs.reopen import effects_that_may_run
from calib.runs.run import RING_NAME, Run
from chains import se3
from chains.errors import InputError
from sensors.documents import Document, Marks, Number, read_yaml, validate, yaml_text

FILE = "extrinsics.yaml"
EXTRINSICS_FORMAT = "rigcal extrinsics 1"
EXTRINSICS_UNITS = {
    "length": "m",
    "angle": "rad",
    "suffixes": "a key ending in _m is in m, in _rad in rad",
}
EXTRINSICS_CONVENTIONS = {
    "T_parent_child": ["p_parent = T_parent_child p_child", "4 x 4, row by row"],
    "one_pose": ["T_parent_child", "xyz_m with quat_wxyz", "xyz_m with rpy_rad"],
    "xyz_m": "origin of the child, in the parent's axes",
    "quat_wxyz": "unit quaternion w, x, y, z with w >= 0, Hamilton's",
    "rpy_rad": "as in URDF: about the parent's fixed x, then y, then z",
    "sigma_m": "one standard deviation of the origin, in the parent's axes; 0 was held",
    "sigma_rad": "one standard deviation of a small turn about the child's axes; 0 was held",
    "effects": "geometry: true = nominal + effect; instruments: measured = true + effect",
    "rings": "measured = true + offset",
    "recordings": "what belongs to one rig alone, by its name; all else holds for every rig",
}


def write_extrinsics(fitted: Fitted, folder: Path) -> Written:
    """Write extrinsics.yaml of a run into a folder, whole or not at all; it holds everything."""
    run = fitted.run
    solution = run.solution
    formulas = {effect.name: effect.formula for effect in effects_that_may_run(run)[0]}
    data = {
        "format": EXTRINSICS_FORMAT,
        "units": EXTRINSICS_UNITS,
        "conventions": EXTRINSICS_CONVENTIONS,
        "provenance": _provenance(run),
        **_part_document(solution.shared, formulas),
        "not_estimated": solution.not_estimated,
        "recordings": {
            rig: _part_document(part, formulas) for rig, part in solution.recordings.items()
        },
    }
    write_text(folder / FILE, commented(warnings(run)) + yaml_text(data))
    return Written([folder / FILE])


def read_extrinsics(path: Path | str) -> tuple[Part, dict[str, Part]]:
    """Read extrinsics.yaml back: what all rigs share, and what belongs to one of several.

    Raises:
        InputError: the file is missing or none of its kind, or a frame's notations disagree.
    """
    data, marks = read_yaml(path)
    if not isinstance(data, dict) or data.get("format") != EXTRINSICS_FORMAT:
        raise InputError(
            f"{path}: 'format: {EXTRINSICS_FORMAT}' is missing, so this is no export of rigcal"
        )
    file = validate(_File, data, path, marks)
    shared = _read_part(file, path, marks, ())
    recordings = {
        rig: _read_part(part, path, marks, ("recordings", rig))
        for rig, part in file.recordings.items()
    }
    return shared, recordings


def _provenance(run: Run) -> dict[str, Any]:
    model = run.model
    return {
        "run": run.folder.resolve().name,
        "recordings": model["recordings"],
        "model": {key: model[key] for key in ("effects", "fixed", "prior")},
        "left_out": run.left_out,
        "set_aside": run.set_aside,
        "converged": run.converged,
        "residual": run.summary["residual"],
        "rms_mm": run.summary["rms_mm"],
        "versions": model["versions"],
    }


def _part_document(part: Part, formulas: Mapping[str, str]) -> dict[str, Any]:
    by_ring = {name for name, e in part.effects.items() if all(map(RING_NAME.fullmatch, e.names))}
    return {
        "frames": {name: _frame_document(frame) for name, frame in part.frames.items()},
        "effects": {
            name: {"formula": formulas.get(name, ""), **effect_document(effect)}
            for name, effect in part.effects.items()
            if name not in by_ring
        },
        "rings": {
            name: _ring_document(part.effects[name]) for name in part.effects if name in by_ring
        },
    }


def _frame_document(frame: FrameEstimate) -> dict[str, Any]:
    document = frame_document(frame)
    sigmas = {key: document.pop(key) for key in ("sigma_m", "sigma_rad")}
    T = frame.T_parent_child
    return {**document, "rpy_rad": se3.to_rpy(T), "T_parent_child": T, **sigmas}


def _ring_document(effect: EffectEstimate) -> dict[str, Any]:
    offset, sigma = _ring_columns(effect.unit)
    rows = zip(effect.names, effect.estimate, effect.sigma, strict=True)
    table = [{"ring": int(RING_NAME.fullmatch(n)[1]), offset: e, sigma: s} for n, e, s in rows]
    return {"unit": effect.unit, "table": table}


def _ring_columns(unit: str) -> tuple[str, str]:
    suffix = {"m": "_m", "rad": "_rad"}.get(unit, "")
    return f"offset{suffix}", f"sigma{suffix}"


# ---------------------------------------------------------------------------------------- reading

_Triple = tuple[Number, Number, Number]
_Row = tuple[Number, Number, Number, Number]


class _Frame(Document):
    parent: str
    xyz_m: _Triple
    quat_wxyz: _Row
    rpy_rad: _Triple
    T_parent_child: tuple[_Row, _Row, _Row, _Row]
    sigma_m: _Triple
    sigma_rad: _Triple


class _Shape(Document):
    name: str
    value: Number
    sigma: Number


class _Effect(Document):
    formula: str
    unit: str
    names: tuple[str, ...]
    estimate: tuple[Number, ...]
    sigma: tuple[Number, ...]
    shape: _Shape | None = None


class _Rings(Document):
    unit: str
    table: tuple[dict[str, Number], ...]


class _Part(Document):
    frames: dict[str, _Frame]
    effects: dict[str, _Effect]
    rings: dict[str, _Rings]


class _File(_Part):
    format: Literal[EXTRINSICS_FORMAT]
    units: dict[str, str]
    conventions: dict[str, Any]
    provenance: dict[str, Any]
    not_estimated: tuple[dict[str, str], ...]
    recordings: dict[str, _Part]


def _read_part(part: _Part, path: Path | str, marks: Marks, at: tuple[str, ...]) -> Part:
    frames = {}
    for name, frame in part.frames.items():
        T = se3.from_xyz_quat(np.array(frame.xyz_m), np.array(frame.quat_wxyz))
        told = (np.array(frame.T_parent_child), se3.from_xyz_rpy(T[:3, 3], np.array(frame.rpy_rad)))
        if not all(np.allclose(T, other, rtol=0, atol=1e-9) for other in told):
            line = marks[(*at, "frames", name)]
            raise InputError(
                f"{path}:{line}: frame {name}: xyz_m, quat_wxyz, rpy_rad and T_parent_child do not "
                f"say the same; change all of them or none"
            )
        sigmas = np.array(frame.sigma_m), np.array(frame.sigma_rad)
        frames[name] = FrameEstimate(frame.parent, T, *sigmas)
    effects = {
        name: EffectEstimate(
            unit=e.unit,
            names=e.names,
            estimate=np.array(e.estimate),
            sigma=np.array(e.sigma),
            shape=e.shape and ShapeEstimate(**e.shape.model_dump()),
        )
        for name, e in part.effects.items()
    }
    for name, rings in part.rings.items():
        effects[name] = _read_rings(rings, f"{path}:{marks[(*at, 'rings', name)]}: {name}")
    return Part(frames, effects)


def _read_rings(rings: _Rings, where: str) -> EffectEstimate:
    offset, sigma = _ring_columns(rings.unit)
    keys = {"ring", offset, sigma}
    for row in rings.table:
        if set(row) != keys:
            raise InputError(
                f"{where}: a row has {', '.join(row)}; each has ring, {offset}, {sigma}"
            )
    return EffectEstimate(
        rings.unit,
        tuple(f"ring_{int(row['ring']):03d}" for row in rings.table),
        np.array([row[offset] for row in rings.table]),
        np.array([row[sigma] for row in rings.table]),
    )
