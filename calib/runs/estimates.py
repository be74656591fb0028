"""What a run found, as plain rows: how far every link lies from its drawing, and every effect."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from calib.effects.rig import DOF
from calib.results.solution import EffectEstimate, FrameEstimate, ShapeEstimate
from calib.rig import Rig, load_rig
from calib.runs.run import Run
from chains import se3
from chains.errors import InputError

DOF_UNITS = ("rad",) * 3 + ("m",) * 3


@dataclass(frozen=True)
class VariableEstimate:
    """A frame or an effect of a run, parameter by parameter.

    Args:
        variable: its name; ``rig/name`` where it belongs to one of several rigs.
        parent: of a frame, the frame that it stands in; None for an effect.
        parameters: (n,) names.
        units: (n,) of estimate and sigma.
        estimate: (n,) of an effect; of a frame the twist ``log(T_cad^-1 T)`` in its own axes, NaN
            where no CAD says where it should be.
        sigma: (n,); 0 is held.
        told: (n,) bool, False where the data could not tell.
        shape: of an effect, where its shape was estimated.
    """

    variable: str
    parent: str | None
    parameters: tuple[str, ...]
    units: tuple[str, ...]
    estimate: np.ndarray
    sigma: np.ndarray
    told: np.ndarray
    shape: ShapeEstimate | None = None


def variable_estimates(run: Run) -> list[VariableEstimate]:
    """Frames, then effects; what all recordings share comes first.

    CAD is read from the recordings where they still are.
    """
    rigs = _rigs(run)
    solution = run.solution
    sigma = dict(zip(solution.names, np.sqrt(np.diag(solution.covariance)), strict=True))
    untold = solution.not_estimated
    parts = {"": solution.shared} | {f"{name}/": part for name, part in solution.recordings.items()}
    out = []
    for prefix, part in parts.items():
        chosen = [r for r in rigs if not prefix or r.name == prefix[:-1]]
        for name, frame in part.frames.items():
            out.append(_frame(prefix + name, frame, drawn(name, chosen), sigma, untold))
    for prefix, part in parts.items():
        out += [_effect(prefix + name, effect, untold) for name, effect in part.effects.items()]
    return out


def comparison(runs: Sequence[Run]) -> dict[str, Any]:
    """Errors and parameters of runs side by side: every list has an entry per run, null for none.

    A frame's parameters say how far it lies from CAD, in its own axes; all are in m and rad. Where
    each does not fit is as its summary has it.
    """
    return {
        "runs": [str(run.folder) for run in runs],
        "models": [
            {k: run.model[k] for k in ("effects", "fixed")}
            | {"prior": str(run.prior) if run.prior else None}
            for run in runs
        ],
        **{
            error: {
                kind: [run.summary.get(error, {}).get(kind) for run in runs]
                for kind in _kinds(runs, error)
            }
            for error in ("rms_mm", "mean_mm", "std_mm", "rms_mrad")
        },
        **{key: [run.summary.get(key) for run in runs] for key in ("rms_all_mm", "rejected_share")},
        "misfit": {
            kind: [run.summary.get("misfit", {}).get(kind) for run in runs]
            for kind in _kinds(runs, "misfit")
        },
        "converged": [run.converged for run in runs],
        "left_out": [run.left_out for run in runs],
        "set_aside": [run.set_aside for run in runs],
        "misfit_by": [run.summary.get("misfit_by") for run in runs],
        "parameters": _side_by_side([variable_estimates(run) for run in runs]),
    }


def _rigs(run: Run) -> list[Rig]:
    rigs = []
    for folder in run.recordings:
        try:
            rigs.append(load_rig(folder))
        except InputError:
            # The recording has been moved or changed since; the run stands without it.
            continue
    return rigs


def drawn(frame: str, rigs: Iterable[Rig]) -> np.ndarray | None:
    """T_parent_child (4, 4) of a frame as the first of these rigs that has it draws it in rig.yaml;
    None where none does."""
    for rig in rigs:
        if frame in rig.frame_sigma:
            return rig.tree.edges[rig.tree.edge_names.index(frame)].T_parent_child
    return None


def _told(
    variable: str, parameters: Sequence[str], not_estimated: Iterable[Mapping[str, str]]
) -> np.ndarray:
    """(n,) False for what is listed as `variable`, `variable.a` or `variable (a, b, d … f)`."""
    told = np.ones(len(parameters), bool)
    for entry in not_estimated:
        name = entry["name"]
        if name == variable:
            told[:] = False
        elif name.removeprefix(f"{variable}.") in parameters:
            told[parameters.index(name.removeprefix(f"{variable}."))] = False
        elif name.startswith(f"{variable} ("):
            known = "|".join(map(re.escape, sorted(parameters, key=len, reverse=True)))
            listed = rf"({known})(?: … ({known}))?(?:, |\)$)"
            for first, last in re.findall(listed, name[len(variable) + 2 :]):
                told[parameters.index(first) : parameters.index(last or first) + 1] = False
    return told


def _frame(
    variable: str,
    frame: FrameEstimate,
    T_cad: np.ndarray | None,
    sigma: Mapping[str, float],
    untold: Iterable[Mapping[str, str]],
) -> VariableEstimate:
    moved = np.full(6, np.nan)
    if T_cad is not None:
        moved = se3.log(se3.inverse(T_cad) @ frame.T_parent_child)
    return VariableEstimate(
        variable=variable,
        parent=frame.parent,
        parameters=DOF,
        units=DOF_UNITS,
        estimate=moved,
        sigma=np.array([sigma.get(f"{variable}.{dof}", 0.0) for dof in DOF]),
        told=_told(variable, DOF, untold),
    )


def _effect(
    variable: str, effect: EffectEstimate, untold: Iterable[Mapping[str, str]]
) -> VariableEstimate:
    return VariableEstimate(
        variable=variable,
        parent=None,
        parameters=effect.names,
        units=effect.units,
        estimate=effect.estimate,
        sigma=effect.sigma,
        told=_told(variable, effect.names, untold),
        shape=effect.shape,
    )


def _kinds(runs: Sequence[Run], error: str) -> list[str]:
    return list(dict.fromkeys(kind for run in runs for kind in run.summary.get(error, {})))


def _side_by_side(runs: Sequence[Sequence[VariableEstimate]]) -> dict[str, dict[str, Any]]:
    """Variable -> parameter -> unit, and estimate and sigma per run."""
    out: dict[str, dict[str, Any]] = {}
    for i, rows in enumerate(runs):
        for row in rows:
            variable = out.setdefault(row.variable, {})
            for parameter, *numbers in zip(
                row.parameters, row.units, row.estimate, row.sigma, strict=True
            ):
                empty = {key: [None] * len(runs) for key in ("estimate", "sigma")}
                entry = variable.setdefault(parameter, {"unit": numbers[0], **empty})
                entry["estimate"][i], entry["sigma"][i] = map(float, numbers[1:])
    return out
