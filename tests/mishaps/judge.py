"""What rigcal says of a recording, by its commands, and how far from the truth that is."""

from __future__ import annotations

import io
import json
import signal
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from scipy.spatial.transform import Rotation

from calib.cli import main
from sensors.documents import read_yaml

from .kinds import Done

DOFS = ("rx", "ry", "rz", "tx", "ty", "tz")  # of a frame, as runs list them
NAMED = 0.05  # p_adjusted below which a blunder counts as named


class TooLong(BaseException):
    """No fault of the program that it could catch: its time is over."""


@contextmanager
def at_most(seconds: float) -> Iterator[list[bool]]:
    """Ends what takes more CPU seconds, in the main thread; gives a list that then has an entry.

    What is ended inside compiled code may report that as an error of its own.
    """
    over: list[bool] = []

    def end(signum: int, frame: object) -> None:
        over.append(True)
        raise TooLong

    before = signal.signal(signal.SIGPROF, end)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield over
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)


@dataclass(frozen=True)
class Said:
    """What a command said.

    Args:
        code: its exit code; None where it ran out of time.
        document: what it printed with --json; empty where that is none.
        complaint: what it printed on stderr.
        seconds: of this process that it took.
    """

    code: int | None
    document: dict[str, Any]
    complaint: str
    seconds: float

    @property
    def refused(self) -> bool:
        """Whether the input was refused in one sentence."""
        one = self.complaint.startswith("rigcal: ") and self.complaint.count("\n") == 1
        return self.code == 2 and one


def rigcal(*words: object, limit_s: float = 600) -> Said:
    """Run a command in this process."""
    out, err = io.StringIO(), io.StringIO()
    begin, code = time.process_time(), None
    argv = ["rigcal", *map(str, words), "--json"]
    with patch.object(sys, "argv", argv), redirect_stdout(out), redirect_stderr(err):
        try:
            with at_most(limit_s) as over:
                main()
        except SystemExit as exit_:
            code = None if over else int(exit_.code or 0)
        except TooLong:
            pass
    seconds = time.process_time() - begin
    try:
        document = json.loads(out.getvalue())
    except ValueError:
        document = {}
    return Said(code=code, document=document, complaint=err.getvalue(), seconds=seconds)


def asked(
    recording: Path, run: Path, limit_s: float = 600, at_any_rate: bool = True
) -> dict[str, Any]:
    """What check, fit and diagnose say of a recording, as far as they come.

    Args:
        recording: a folder.
        run: the folder that the fit makes.
        limit_s: of each command, CPU seconds.
        at_any_rate: a fit that has not converged is diagnosed as well.

    Returns:
        `outcome`: "refused", "fault", "endless", "not converged" or the verdict; `sentence`, `odd`
        (of check), `blunders` (names, most certain first, each with what it may be taken for),
        `names` (of effects and covariates), `rivals` (effect -> what it may be as well), `notes`
        (names of what does no harm), `misfit`, `detectable`, `unseen`, `seconds` (check, fit,
        diagnose), `codes` of their exits.
    """
    checked = rigcal("check", recording, limit_s=limit_s)
    fit = rigcal("fit", recording, "-o", run, "--hold-out", "none", limit_s=limit_s)
    said = [checked, fit]
    found = {
        "notes": [],
        "odd": checked.document.get("odd", []) + checked.document.get("problems", []),
        "misfit": fit.document.get("misfit", {}),
        "blunders": [],
        "names": [],
        "rivals": {},
        "detectable": {},
        "unseen": {},
    }
    fitted = fit.code in (0, 3) and bool(fit.document)
    loose = fit.code == 3 or (fitted and not fit.document["converged"])
    outcome = "not converged" if loose else None
    if fitted and (at_any_rate or not loose):
        said.append(rigcal("diagnose", run, "--no-refits", limit_s=limit_s))
        diagnosis = said[-1].document
        found |= {"blunders": blunders(diagnosis), "names": names(diagnosis)}
        found |= {"notes": notes(diagnosis), "rivals": rivals(diagnosis)}
        found["detectable"] = detectable(diagnosis)
        found["unseen"] = unseen(diagnosis)
        outcome = outcome or diagnosis.get("verdict")
    last = said[-1]
    if fit.refused:
        outcome = "refused"
    elif None in (fit.code, last.code):
        outcome = "endless"
    elif outcome is None or last.code not in (0, 2, 3):
        outcome = "fault"
    return found | {
        "outcome": outcome,
        "sentence": last.complaint.strip(),
        "seconds": [round(s.seconds, 2) for s in said],
        "codes": [s.code for s in said],
    }


# -------------------------------------------------------------------------------- what was named


def token(blunder: Mapping[str, Any]) -> str:
    """A blunder's name, as `rigcal fit --without` takes it."""
    if blunder.get("without"):
        return str(blunder["without"])
    kind, name, stop = (str(blunder.get(key) or "") for key in ("kind", "name", "stop"))
    if kind in ("frame", "surface"):
        return f"{'cad' if kind == 'frame' else 'mesh'}:{name}"
    if kind == "rings":
        return "rings"
    return f"{stop}:{name or kind}" if stop else name


def blunders(diagnosis: Mapping[str, Any]) -> list[list[str]]:
    """Of a diagnosis: the name of each blunder that it is sure of, then what it may be as well."""
    listed = [b for b in diagnosis.get("blunders", []) if b.get("p_adjusted", 1) < NAMED]
    return [[token(b), *map(str, b.get("indistinguishable_from", []))] for b in listed]


def names(diagnosis: Mapping[str, Any]) -> list[str]:
    """Of a diagnosis: effects that it would add, covariates that structure hangs on."""
    effects = [c["effect"] for c in diagnosis.get("candidates", []) if c.get("step")]
    loose = [name for each in diagnosis.get("unexplained", []) for name in each["covariates"]]
    thrown = list((diagnosis.get("rejected") or {}).get("covariates", []))
    return [*effects, *loose, *thrown]


def rivals(diagnosis: Mapping[str, Any]) -> dict[str, list[str]]:
    """Of a diagnosis: each effect that it would add -> what the data cannot tell from it."""
    steps = [c for c in diagnosis.get("candidates", []) if c.get("step")]
    return {c["effect"]: list(map(str, c["indistinguishable_from"])) for c in steps}


def notes(diagnosis: Mapping[str, Any]) -> list[str]:
    """Of a diagnosis: what is told and does no harm, as beams that hit what is not in the mesh, or
    rings that are numbered from the other end, whose offsets then have those numbers."""
    clutter = (diagnosis.get("rejected") or {}).get("clutter", {})
    numbered = any(said.startswith("Rings of") for said in diagnosis.get("sentences", ()))
    return [*(f"{stop}:scan" for stop in clutter.get("stops", [])), *(["rings"] * numbered)]


def detectable(diagnosis: Mapping[str, Any]) -> dict[str, float]:
    """Of a diagnosis: ``NAME UNIT`` -> the smallest size of a blunder that it would find."""
    return {
        f"{name} {unit}": float(size)
        for name, by_unit in diagnosis.get("detectable", {}).items()
        for unit, size in by_unit.items()
        if np.isfinite(size) and size > 0
    }


def unseen(diagnosis: Mapping[str, Any]) -> dict[str, float]:
    """Of a diagnosis: token of a group -> by how many sigmas a mishap that it would not find could
    move an estimate."""
    groups = (each for each in diagnosis.get("groups", ()) if each["unseen"])
    return {each["token"]: float(each["unseen"]["sigmas"]) for each in groups}


def matches(name: str, patterns: Sequence[str] | frozenset[str]) -> bool:
    """Whether a name is one of these."""
    return any(fnmatch(name, pattern) for pattern in patterns)


# ------------------------------------------------------------------------------ how far it is off


def solution(run: Path) -> dict[str, Any]:
    """solution.yaml."""
    return read_yaml(run / "solution.yaml")[0]


def _untold(found: Mapping[str, Any]) -> list[str]:
    """Names, ``link`` or ``link.parameter``, of what the data could not tell."""
    out = []
    for each in found["not_estimated"]:
        whole, _, some = each["name"].partition(" (")
        parts = [part.split(" … ") for part in some.rstrip(")").split(", ")] if some else []
        for first, *last in parts:
            if last and first not in DOFS:  # of many parameters, rings say
                out.append(whole)
            elif last:
                inside = DOFS[DOFS.index(first) : DOFS.index(last[0]) + 1]
                out += [f"{whole}.{dof}" for dof in inside]
            else:
                out.append(f"{whole}.{first}")
        if not parts:
            out.append(whole)
    return out


@dataclass(frozen=True)
class Error:
    """Distance of an estimate from the truth, its sigma, and whether the run says that the data
    tell it."""

    size: float
    sigma: float
    told: bool

    @property
    def sigmas(self) -> float:
        """Distance in sigmas."""
        return self.size / self.sigma


def off(run: Path, truth: Mapping[str, Any], done: Done | None = None) -> dict[str, Error]:
    """How far every estimate, ``link.parameter``, is from the truth.

    Args:
        run: a fit.
        truth: ``frames`` -> name -> T_parent_child (4, 4), ``effects`` -> name -> parameter ->
            value, or the values of all parameters in their order.
        done: what has changed the truth.
    """
    found, done = solution(run), done or Done()
    untold, out = set(_untold(found)), {}
    for name, T in truth["frames"].items():
        frame = found["frames"].get(name)
        if frame is None or name in done.unsure:
            continue
        R = Rotation.from_quat(frame["quat_wxyz"], scalar_first=True)
        turn = (R.inv() * Rotation.from_matrix(np.array(T)[:3, :3])).as_rotvec()
        shift = np.array(frame["xyz_m"]) - np.array(T)[:3, 3]
        for letter, error, key in (("t", shift, "sigma_m"), ("r", turn, "sigma_rad")):
            # Axes of the parent here, of the child there: what is untold of one, is of all.
            told = not untold & {name, *(f"{name}.{letter}{axis}" for axis in "xyz")}
            for axis, e, sigma in zip("xyz", error, frame[key], strict=True):
                if sigma:
                    out[f"{name}.{letter}{axis}"] = Error(abs(float(e)), sigma, told)
    for name, parameters in truth["effects"].items():
        effect = found["effects"].get(name)
        if effect is None or name in done.unsure:
            continue
        each = zip(effect["names"], effect["estimate"], effect["sigma"], strict=True)
        if not isinstance(parameters, Mapping):
            parameters = dict(zip(effect["names"], parameters, strict=True))
        for parameter, estimate, sigma in each:
            if sigma and parameter in parameters:
                true = parameters[parameter] + done.shifts.get((name, parameter), 0.0)
                full = f"{name}.{parameter}"
                out[full] = Error(abs(estimate - true), sigma, not untold & {name, full})
    return out


def largest(errors: Mapping[str, Error], sigmas: Mapping[str, float] | None = None) -> float:
    """The largest of the distances of what the data tell, in sigmas: their own, or others'."""
    sizes = (
        error.size / (sigmas[name] if sigmas else error.sigma)
        for name, error in errors.items()
        if error.told and (not sigmas or name in sigmas)
    )
    return max(sizes, default=0.0)


def as_truth(run: Path) -> dict[str, Any]:
    """A fit's estimates as if they were true, to compare another's with."""
    found = solution(run)
    frames = {}
    for name, frame in found["frames"].items():
        frames[name] = T = np.eye(4)
        T[:3, :3] = Rotation.from_quat(frame["quat_wxyz"], scalar_first=True).as_matrix()
        T[:3, 3] = frame["xyz_m"]
    effects = {
        name: dict(zip(e["names"], e["estimate"], strict=True))
        for name, e in found["effects"].items()
    }
    return {"frames": frames, "effects": effects}


def read_truth(path: Path) -> dict[str, Any]:
    """A truth.json, of either simulator, as `off` takes it."""
    said = json.loads(path.read_text(encoding="utf-8"))
    frames = dict(said.get("frames", {}))
    if "T_faro_opti" in said:
        frames["faro"] = np.linalg.inv(np.array(said["T_faro_opti"]))
    if "dlen" in said:
        joints = [f"joint_{i}" for i in range(1, len(said["dlen"]))]
        zeros = said.get("joint_offset", said.get("zero"))
        rings = said.get("ring_range_offset", [])
        effects = {
            "arm_link_length": dict(zip([*joints, "joint_tip"], said["dlen"], strict=True)),
            "arm_joint_offset": dict(zip(joints, zeros, strict=True)),
            "ring_range_offset": {f"ring_{i:03d}": x for i, x in enumerate(rings)},
        }
    else:
        effects = said["effects"]
    return {"frames": frames, "effects": effects}
