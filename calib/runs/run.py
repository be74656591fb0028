"""A run: the folder that a fit leaves behind, and the solution in it."""

from __future__ import annotations

import hashlib
import importlib.metadata
import os
import platform
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from calib import outputs
from calib.effects import Trust, trusted
from calib.problem.prior import CommonErrors
from calib.results.solution import (
    EffectEstimate,
    FrameEstimate,
    Part,
    ShapeEstimate,
    Solution,
    units_of,
)
from calib.rig.suspect import listed
from calib.runs.stored import FIT_AGAIN, read_arrays, read_json, read_model, read_summary
from chains import remote, se3
from chains.errors import InputError
from sensors.documents import read_yaml

SOLUTION, MODEL, SUMMARY, COVARIANCE, RESIDUALS, STATE, DIAGNOSIS = (
    "solution.yaml",
    "model.yaml",
    "summary.json",
    "covariance.npz",
    "residuals.parquet",
    "state.npz",
    "diagnosis.json",
)
_OF_DIAGNOSIS = {"verdict", "heading", "too_few_stops", "sentences", "candidates"}
_OF_DIAGNOSIS |= {"unexplained", "weak_directions", "curves", "blunders", "groups", "command"}
_OF_CANDIDATE = {"effect", "add", "p_adjusted", "step", "dressed_up", "held_out_rms_mm"}
_OF_CANDIDATE |= {"unabsorbed_rms_mm"}
_OF_CURVE = {"covariates", "centres", "mean_mm", "band_mm"}
RING_NAME = re.compile(r"ring_(\d+)")  # a parameter of a ring
_OF_STATE, _OF_MET = "state/", "met/"  # before every name in that file: numpy reserves a few
FOUND_WRONG = {  # verdicts by which numbers are not to be used as they are
    "missing_effect": "its diagnosis says that the model lacks an effect",
    "bad_data": "its diagnosis says that something in the recording is wrong",
}
NOT_CONVERGED = "NOT CONVERGED: the fit did not end at an optimum; its numbers are not to be used"


@dataclass(frozen=True, repr=False)
class Run:
    """A run folder, read.

    Args:
        folder: where it is.
        model, summary, solution: its files.
        trust: the Python files of effects that may run, where its model names them.
    """

    folder: Path
    model: dict[str, Any]
    summary: dict[str, Any]
    solution: Solution
    trust: Trust = field(default_factory=dict)

    @classmethod
    def open(cls, folder: Path | str, trust: Trust | Iterable[str | Path] = ()) -> Run:
        """Read a run. No code of it is run, now or later, but what `trust` names.

        Args:
            folder: where it is.
            trust: Python files of effects, or their sha256; as ``--trust`` takes them.

        Raises:
            InputError: the folder is no run, or a part of it is missing or of another version; or
                something to trust is neither file nor hash.
        """
        may_run = trust if isinstance(trust, Mapping) else trusted(trust)
        folder = Path(folder)
        outputs.settle(folder)
        if not (folder / MODEL).is_file():
            raise InputError(
                f"{folder}: no run there ({MODEL} is missing); make one with 'rigcal fit'"
            )
        for name in (SOLUTION, SUMMARY, COVARIANCE):
            if not (folder / name).is_file():
                raise InputError(f"{folder / name} is missing; the run is incomplete, fit it again")
        model, summary = read_model(folder / MODEL), read_summary(folder / SUMMARY)
        return cls(folder, model, summary, read_solution(folder), trust=may_run)

    def __repr__(self) -> str:
        return f"Run('{self.folder}')"

    @property
    def recordings(self) -> list[Path]:
        """Where the recordings were that this run was fitted to."""
        return [remote.place(r["path"]) for r in self.model["recordings"]]

    @property
    def grown_from(self) -> Path | None:
        """Where the run is that this one grew from; None of a first one."""
        return self._other("grown_from")

    @property
    def prior(self) -> Path | None:
        """Where the run is whose solution stood for CAD; None where CAD did."""
        return self._other("prior")

    def _other(self, key: str) -> Path | None:
        """Another run, which is named by its way from this one's folder."""
        way = self.model.get(key)
        return Path(os.path.normpath(self.folder.resolve() / way)) if way else None

    @property
    def inputs(self) -> list[Path]:
        """Folders that are read with it: its recordings, and the run that was its prior."""
        return [*self.recordings, *([self.prior] if self.prior else [])]

    @property
    def effects(self) -> tuple[str, ...]:
        """Names of its model's effects; of one in a Python file, its class."""
        return tuple(_effect_name(effect) for effect in self.model["effects"])

    @property
    def unseen_m2(self) -> list[float]:
        """Mean square [m2] of each stop that was held out; none of a run that does not tell."""
        each = self.summary.get("held_out_each_mm") or ()
        return [np.nan if mm is None else 1e-6 * mm**2 for mm in each]

    @property
    def converged(self) -> bool:
        """Whether the fit ended at an optimum."""
        return bool(self.summary["converged"])

    @property
    def empirical(self) -> tuple[str, ...]:
        """Those of its effects that only describe what was measured, and say where."""
        formulas = (e for e in self.model["effects"] if not isinstance(e, str))
        return tuple(_effect_name(e) for e in formulas if e.get("seen"))

    @property
    def doubts(self) -> list[str]:
        """Why the fit may not be what it should be, a sentence each."""
        out = [] if self.converged else [NOT_CONVERGED]
        out += self.prior_found_wrong
        if self.set_aside:
            out.append(f"Set aside, as they contradict everything else: {self.listed_aside}.")
        return out

    @property
    def warning(self) -> list[str]:
        """What is to stand above everything that is shown of the run, a sentence each."""
        return [*self.doubts, *self.omissions, *self.extrapolated]

    @property
    def prior_found_wrong(self) -> list[str]:
        """What speaks against the run that was its prior, and against its own; sentences."""
        return list(self.summary.get("prior_found_wrong", ()))

    @property
    def found_wrong(self) -> list[str]:
        """What its diagnosis found that speaks against its numbers as they are, as a sentence; none
        where it found nothing of the kind, or there is none that can be read."""
        try:
            found = self.diagnosis() or {"verdict": ""}
        except InputError:
            return []
        if found["verdict"] not in FOUND_WRONG:
            return []
        return [f"{self.folder.name}: {FOUND_WRONG[found['verdict']]}: {self.finding(found)}"]

    def finding(self, diagnosis: Mapping[str, Any]) -> str:
        """The first sentence of a diagnosis, but for those that stand above all that is shown."""
        sentences, above = diagnosis["sentences"], self.warning
        return next((each for each in sentences if each not in above), sentences[0])

    @property
    def rests_on(self) -> list[str]:
        """Digests of all measurements that its estimate rests on, those of its prior included; see
        `calib.recalibration.twice`. None of a run of an earlier version."""
        found = read_arrays(self.folder / COVARIANCE).get("rests_on", np.zeros(0, "S64"))
        return [each.decode() for each in found.tolist()]

    @property
    def before_use(self) -> list[str]:
        """What is to stand above what takes numbers from the run for other programs."""
        return [*self.warning, *self.found_wrong]

    @property
    def omissions(self) -> list[str]:
        """What was left out of its recordings, as a sentence; none where nothing was."""
        return [f"Left out: {', '.join(self.left_out)}"] if self.left_out else []

    @property
    def extrapolated(self) -> list[str]:
        """Effects that only describe, used beyond where they were seen; a sentence each."""
        return list(self.summary.get("extrapolated", ()))

    @property
    def odd_rings(self) -> list[str]:
        """Rings that are numbered otherwise than the table of their LiDAR; a clause each."""
        return [each["sentence"] for each in self.summary.get("rings", ())]

    @property
    def set_aside(self) -> list[str]:
        """Scans, and bodies at stops, that the fit could not use."""
        return list(self.summary.get("set_aside", ()))

    @property
    def listed_aside(self) -> str:
        """The first few of them, and how many more there are."""
        return listed(self.set_aside, 6)

    @property
    def left_out(self) -> list[str]:
        """What was left out of its recordings."""
        return list(self.model.get("without", ()))

    @property
    def beams(self) -> int | None:
        """How many beams of each scan it used at most; all where None."""
        return self.model.get("beams")

    @property
    def trusting(self) -> list[str]:
        """The options by which a command trusts the Python files of its effects."""
        effects = (e for e in self.model["effects"] if not isinstance(e, str))
        files = dict.fromkeys(e["python"] for e in effects if "python" in e)
        return [part for file in files for part in ("--trust", str(file))]

    def refuse_unconverged(self, force: bool | None) -> None:
        """Raise InputError for a fit that did not converge, unless its numbers are wanted still;
        None where nobody can say that they are."""
        if not (self.converged or force):
            anyway = "" if force is None else ", --force uses them anyway"
            raise InputError(
                f"{self.folder} has NOT CONVERGED, so its numbers are not to be used; "
                f"'rigcal diagnose {self.folder}' looks for what is wrong{anyway}"
            )

    def diagnosis(self) -> dict[str, Any] | None:
        """What `rigcal diagnose` found, as diagnosis.json has it; None before that.

        Raises:
            InputError: the file is broken, or of another version.
        """
        path = self.folder / DIAGNOSIS
        if not path.is_file():
            return None
        try:
            document = read_json(path)
            whole = [(_OF_CANDIDATE, c) for c in document["candidates"]]
            whole += [(_OF_CURVE, c) for c in document["curves"]]
            if all(each.keys() >= keys for keys, each in [(_OF_DIAGNOSIS, document), *whole]):
                return document
        except (ValueError, TypeError, KeyError, AttributeError):
            pass
        raise InputError(
            f"{path} is no diagnosis of this version; diagnose the run again with "
            f"'rigcal diagnose {self.folder}'"
        )

    def state(self) -> dict[str, np.ndarray]:
        """Where the fit stood, as `fit.Estimate.state` gives it.

        Raises:
            InputError: the run has none.
        """
        return self._stored(_OF_STATE)

    def met(self) -> dict[str, np.ndarray]:
        """What beams met: ``RECORDING/STOP``, both as numbers, and the triangle of each beam.

        Raises:
            InputError: as of `state`.
        """
        return self._stored(_OF_MET)

    def _stored(self, prefix: str) -> dict[str, np.ndarray]:
        path = self.folder / STATE
        if not path.is_file():
            raise InputError(
                f"{path} is missing: the run was made by an earlier version; fit it again"
            )
        stored = read_arrays(path).items()
        return {name.removeprefix(prefix): x for name, x in stored if name.startswith(prefix)}


def read_solution(folder: Path) -> Solution:
    """The solution of a run folder.

    Raises:
        InputError: its file, or that of its covariance, is broken or of another version.
    """
    path, beside = folder / SOLUTION, folder / COVARIANCE
    data, stored = read_yaml(path)[0], read_arrays(beside)
    names, covariance = stored.get("names", np.zeros(1)), stored.get("covariance", np.zeros(0))
    graph = stored.get("graph", covariance)
    shape = 2 * names.shape if names.ndim == 1 else None
    if any(x.shape != shape or x.dtype.kind != "f" for x in (covariance, graph)):
        raise InputError(f"{beside} is no covariance of a run; {FIT_AGAIN}")
    try:
        common = CommonErrors.read(stored, len(names))
    except ValueError as error:
        raise InputError(f"{beside}: {error}; {FIT_AGAIN}") from None
    try:
        shared = _read_part(data)
        recordings = {n: _read_part(p) for n, p in data.get("recordings", {}).items()}
        keys = {key.name: key for key in units_of(shared, recordings)}
        return Solution(
            shared=shared,
            recordings=recordings,
            not_estimated=[{"name": e["name"], "why": e["why"]} for e in data["not_estimated"]],
            keys=tuple(keys[name] for name in names.tolist()),
            covariance=covariance,
            graph=graph,
            common=common,
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(
            f"{path} is no solution of this version of rigcal, or was edited ({error}); {FIT_AGAIN}"
        ) from None


def write_state(
    folder: Path, state: Mapping[str, np.ndarray], met: Mapping[str, np.ndarray]
) -> None:
    """Put where a fit stood, and what its beams met, into its run folder; see `Run`."""
    values = {f"{_OF_STATE}{name}": value for name, value in state.items()}
    np.savez_compressed(folder / STATE, **values, **{f"{_OF_MET}{n}": x for n, x in met.items()})


def versions() -> dict[str, str]:
    """Of what made a run, and on what kind of machine: for provenance."""
    names = ("rigcal", "gtsam", "numba", "numpy", "pyarrow", "scipy")
    numbers = {n: importlib.metadata.version(n) for n in names} | {"open3d": _open3d()}
    machine = f"{platform.system()} {platform.machine()}"
    return numbers | {"python": platform.python_version(), "platform": machine}


def _open3d() -> str:
    """Its version; it comes under two names."""
    for name in ("open3d-cpu", "open3d"):
        try:
            return importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return ""


def solution_digest(folder: Path) -> str:
    """The SHA-256 (hex) of what a run gives to one that takes it as its prior."""
    sha = hashlib.sha256()
    for name in (SOLUTION, COVARIANCE):
        sha.update((folder / name).read_bytes())
    return sha.hexdigest()


def _effect_name(document: str | Mapping[str, Any]) -> str:
    if isinstance(document, str):
        return document
    shape = document.get("shape")
    return str(document["name"]) + (f"@{shape:.6g}" if shape is not None else "")


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
            unit=e["unit"],
            names=tuple(e["names"]),
            estimate=np.array(e["estimate"], float),
            sigma=np.array(e["sigma"], float),
            shape=ShapeEstimate(**e["shape"]) if "shape" in e else None,
        )
        for name, e in data["effects"].items()
    }
    return Part(frames, effects)
