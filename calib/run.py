"""A run: the folder that a fit leaves behind, and the solution in it."""

from __future__ import annotations

import importlib.metadata
import platform
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from chains import se3
from chains.errors import InputError
from sensors.documents import read_yaml

SOLUTION, MODEL, SUMMARY, COVARIANCE, RESIDUALS = (
    "solution.yaml",
    "model.yaml",
    "summary.json",
    "covariance.npz",
    "residuals.parquet",
)


@dataclass(frozen=True)
class FrameEstimate:
    """T_parent_child (4, 4), with the sigma of its origin in the parent's axes (3,) m and of its
    orientation about the child's axes (3,) rad; 0 is exact."""

    parent: str
    T_parent_child: np.ndarray
    sigma_m: np.ndarray
    sigma_rad: np.ndarray


@dataclass(frozen=True)
class EffectEstimate:
    """An effect's parameters (P,), with their sigma; 0 is held."""

    unit: str
    names: tuple[str, ...]
    estimate: np.ndarray
    sigma: np.ndarray


@dataclass(frozen=True)
class Part:
    """Frames and effects of the shared hardware, or of one rig."""

    frames: dict[str, FrameEstimate] = field(default_factory=dict)
    effects: dict[str, EffectEstimate] = field(default_factory=dict)


@dataclass(frozen=True)
class Solution:
    """What a fit found.

    Args:
        shared: what holds for all recordings.
        recordings: rig name -> what belongs to it alone; empty where there is one rig.
        not_estimated: a `name` and a `why` for what the data could not tell.
        names: (P,) calibration parameters, ``variable.parameter``.
        covariance: (P, P) joint covariance, m and rad.
    """

    shared: Part
    recordings: dict[str, Part]
    not_estimated: list[dict[str, str]]
    names: tuple[str, ...]
    covariance: np.ndarray

    def part(self, rig: str | None) -> Part:
        """All frames and effects that hold for one rig."""
        own = self.recordings.get(rig, Part()) if rig else Part()
        return Part(self.shared.frames | own.frames, self.shared.effects | own.effects)

    def document(self) -> dict[str, Any]:
        """As written to solution.yaml."""
        out = _part_document(self.shared) | {"not_estimated": self.not_estimated}
        if self.recordings:
            out["recordings"] = {name: _part_document(p) for name, p in self.recordings.items()}
        return out


@dataclass(frozen=True)
class Run:
    """A run folder, read."""

    folder: Path
    model: dict[str, Any]
    summary: dict[str, Any]
    solution: Solution

    @classmethod
    def open(cls, folder: Path | str) -> Run:
        """Read a run.

        Raises:
            InputError: the folder is no run, or a part of it is missing or of another version.
        """
        folder = Path(folder)
        if not (folder / MODEL).is_file():
            raise InputError(
                f"{folder}: no run there ({MODEL} is missing); make one with 'rigcal fit'"
            )
        for name in (SOLUTION, SUMMARY, COVARIANCE):
            if not (folder / name).is_file():
                raise InputError(f"{folder / name} is missing; the run is incomplete, fit it again")
        try:
            return cls(
                folder, _yaml(folder / MODEL), _json(folder / SUMMARY), read_solution(folder)
            )
        except (KeyError, TypeError, ValueError) as error:
            if isinstance(error, InputError):
                raise
            raise InputError(
                f"{folder}: written by another version of rigcal, or edited ({error}); fit it again"
            ) from None

    @property
    def recordings(self) -> list[Path]:
        """Where the recordings were that this run was fitted to."""
        return [Path(r["path"]) for r in self.model["recordings"]]


def read_solution(folder: Path) -> Solution:
    """The solution of a run folder."""
    data = _yaml(folder / SOLUTION)
    with np.load(folder / COVARIANCE) as stored:
        names, covariance = tuple(stored["names"].tolist()), stored["covariance"]
    recordings = {n: _read_part(p) for n, p in data.get("recordings", {}).items()}
    return Solution(_read_part(data), recordings, data["not_estimated"], names, covariance)


def versions() -> dict[str, str]:
    """Of what made a run: for provenance."""
    names = ("rigcal", "gtsam", "numpy", "scipy")
    found = {n: importlib.metadata.version(n) for n in names}
    return found | {"python": platform.python_version()}


def frame_document(frame: FrameEstimate) -> dict[str, Any]:
    """A frame as the contract writes it."""
    return {
        "parent": frame.parent,
        "xyz_m": frame.T_parent_child[:3, 3],
        "quat_wxyz": se3.to_quat_wxyz(frame.T_parent_child),
        "sigma_m": frame.sigma_m,
        "sigma_rad": frame.sigma_rad,
    }


def effect_document(effect: EffectEstimate) -> dict[str, Any]:
    """An effect's parameters as the contract writes them."""
    return {
        "unit": effect.unit,
        "names": effect.names,
        "estimate": effect.estimate,
        "sigma": effect.sigma,
    }


def _part_document(part: Part) -> dict[str, Any]:
    return {
        "frames": {n: frame_document(f) for n, f in part.frames.items()},
        "effects": {n: effect_document(e) for n, e in part.effects.items()},
    }


def _read_part(data: Mapping[str, Any]) -> Part:
    frames = {
        name: FrameEstimate(
            f["parent"],
            se3.from_xyz_quat(np.array(f["xyz_m"], float), np.array(f["quat_wxyz"], float)),
            np.array(f["sigma_m"], float),
            np.array(f["sigma_rad"], float),
        )
        for name, f in data["frames"].items()
    }
    effects = {
        name: EffectEstimate(
            e["unit"],
            tuple(e["names"]),
            np.array(e["estimate"], float),
            np.array(e["sigma"], float),
        )
        for name, e in data["effects"].items()
    }
    return Part(frames, effects)


def _yaml(path: Path) -> Any:
    return read_yaml(path)[0]


def _json(path: Path) -> Any:
    import json

    return json.loads(path.read_text(encoding="utf-8"))
