"""What two runs both estimate of the hardware, read from their folders alone."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from calib.effects import CATALOGUE
from calib.effects.rig import DOF
from calib.problem.unknowns import Key, Unknown, pose_unknown, vector_unknown
from calib.residuals.robust import huber_weight
from calib.results.solution import EffectEstimate, FrameEstimate, Solution
from calib.runs.run import RESIDUALS, Run
from chains import se3
from chains.errors import InputError
from sensors.recording import read_table

PRIORS = "_prior.parquet"


class Covariances(NamedTuple):
    """Covariances (P, P) of what both estimate: of rows that err alone, and as reported."""

    graph: np.ndarray
    reported: np.ndarray


@dataclass(frozen=True)
class Pair:
    """Two runs over the P parameters that both estimate.

    Args:
        held: the unknowns, as CAD knew them when the second was fitted.
        then, now: their values; of a frame as a twist from the CAD of the second.
        first, second: how well each run knows them.
        is_frame: (P,) bool, whether CAD of ``rig.yaml`` says what a parameter should be.
    """

    held: list[Unknown]
    then: dict[str, np.ndarray]
    now: dict[str, np.ndarray]
    first: Covariances
    second: Covariances
    is_frame: np.ndarray

    @classmethod
    def of(cls, a: Run, b: Run) -> Pair:
        """Read what two runs have in common.

        Raises:
            InputError: they have nothing in common, or the second is incomplete.
        """
        places = [{key: i for i, key in enumerate(r.solution.keys)} for r in (a, b)]
        earlier, later = _estimates(a.solution), _estimates(b.solution)
        held, then, now, rows, is_frame = [], {}, {}, [], []
        for unknown, theta in unknowns_of(b):
            if unknown.name not in earlier or not set(unknown.keys) <= places[0].keys():
                continue
            both = earlier[unknown.name], later[unknown.name]
            held.append(unknown)
            then[unknown.name], now[unknown.name] = _values(unknown, theta, *both)
            rows += [[place[key] for place in places] for key in unknown.keys]
            is_frame += [isinstance(both[1], FrameEstimate)] * unknown.dim
        if not held:
            raise InputError(
                f"{a.folder} and {b.folder} have no frame or effect in common; give two runs of "
                "the same rig"
            )
        known = [
            Covariances(
                *(
                    matrix[np.ix_(at, at)]
                    for matrix in (run.solution.graph, run.solution.covariance)
                )
            )
            for run, at in zip((a, b), np.array(rows).T, strict=True)
        ]
        return cls(
            held=held,
            then=then,
            now=now,
            first=known[0],
            second=known[1],
            is_frame=np.array(is_frame),
        )

    @property
    def change(self) -> np.ndarray:
        """(P,) second minus first, as tangents."""
        each = (u.difference(self.then[u.name], self.now[u.name]) for u in self.held)
        return np.concatenate(list(each))


def unknowns_of(run: Run) -> Iterator[tuple[Unknown, np.ndarray]]:
    """What a run estimated of the hardware, and how far each parameter is from CAD (dim,).

    Values on paper that are far off had less weight in the fit; that is found again.

    Raises:
        InputError: the run has no table of them.
    """
    path = run.folder / RESIDUALS / PRIORS
    if not path.is_file():
        raise InputError(f"{path} is missing; the run is incomplete, fit {run.folder} again")
    table = read_table(path)
    keys = map(Key, table["unknown"].tolist(), table["parameter"].tolist())
    rows = {key: i for i, key in enumerate(keys)}
    owners: dict[str, list[Key]] = {}
    for key in run.solution.keys:
        owners.setdefault(key.unknown, []).append(key)
    vectors = {o: [rows[k] for k in own] for o, own in owners.items() if set(own) <= rows.keys()}
    norms = np.array([np.linalg.norm(table["whitened"][at]) for at in vectors.values()])
    weights = huber_weight(norms, np.array([len(at) for at in vectors.values()]))
    weight = dict(zip(vectors, weights.tolist(), strict=True))
    rigs = ["", *(f"{rig}/" for rig in run.solution.recordings)]
    of_members = {f"{rig}{e.name}" for rig in rigs for e in CATALOGUE if e.of_members}
    for name, own in owners.items():
        if name in vectors:
            at = vectors[name]
            unknown = vector_unknown(
                name,
                table["sigma"][at],
                dofs=table["parameter"][at].tolist(),
                units=table["unit"][at].tolist(),
                of_members=name in of_members,
                weight=weight[name],
            )
            yield unknown, table["residual"][at]
        elif name in run.solution.shared.frames and len(own) == len(DOF):
            yield pose_unknown(name, run.solution.shared.frames[name].T_parent_child), np.zeros(6)
        else:
            raise InputError(f"{path} has no row of {own[0].name}; fit {run.folder} again")


def _estimates(solution: Solution) -> dict[str, FrameEstimate | EffectEstimate]:
    """Every frame and effect, by the name of its unknown."""
    parts = {"": solution.shared} | {f"{rig}/": part for rig, part in solution.recordings.items()}
    return {
        prefix + name: each
        for prefix, part in parts.items()
        for name, each in (*part.frames.items(), *part.effects.items())
    }


def _values(
    unknown: Unknown,
    theta: np.ndarray,
    a: FrameEstimate | EffectEstimate,
    b: FrameEstimate | EffectEstimate,
) -> tuple[np.ndarray, np.ndarray]:
    """An unknown's value in either run, given that of the second (dim,) from CAD."""
    if unknown.kind == "pose":
        return a.T_parent_child, b.T_parent_child
    if isinstance(a, FrameEstimate):
        at, xi = [DOF.index(dof) for dof in unknown.dofs], np.zeros(6)
        xi[at] = theta
        T_cad = b.T_parent_child @ se3.exp(-xi)
        return se3.log(se3.inverse(T_cad) @ a.T_parent_child)[at], theta
    return a.estimate[[a.names.index(dof) for dof in unknown.dofs]], theta
