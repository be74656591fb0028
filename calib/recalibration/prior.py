"""An earlier run's solution as a prior."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.linalg import block_diag

from calib.effects import FrameOffset, Site
from calib.problem import Problem
from calib.problem.model import Model, Source
from calib.problem.prior import JointPrior
from calib.problem.spread import names_of
from calib.problem.unknowns import Unknown
from calib.results.solution import Solution
from calib.rig.suspect import listed
from chains import se3
from chains.errors import InputError


def earlier(
    problem: Problem,
    solution: Solution,
    rests_on: Iterable[str] = (),
    among: Collection[str] | None = None,
) -> JointPrior:
    """An earlier solution as a joint prior over those variables that the problem has too.

    Args:
        problem: of newer recordings.
        solution: the earlier one.
        rests_on: digests of the measurements that it rests on.
        among: variables that are asked for; all where None.

    Raises:
        InputError: the two have nothing in common.
    """
    position = {key: i for i, key in enumerate(solution.keys)}
    held, means, rows = [], {}, []
    for name in (n for n in problem.calibration if among is None or n in among):
        variable = problem.variables[name]
        index = [position.get(key) for key in variable.keys]
        mean = _earlier_value(problem, variable, solution)
        if None not in index and mean is not None:
            held.append(variable)
            means[name] = mean
            rows += index
    if not held:
        raise InputError(
            "--prior: that run and these recordings have no frame or effect in common; give a run "
            "of the same rig"
        )
    covariance = solution.covariance[np.ix_(rows, rows)]
    return JointPrior(
        held,
        means,
        covariance,
        rests_on=frozenset(rests_on),
        spreads=dict(_earlier_spreads(problem, solution)),
        common=solution.common.at(np.array(rows)) if solution.common else None,
    )


def starting_from(model: Model, solution: Solution, sources: Iterable[Source]) -> Model:
    """A model whose frames of the reference start where an earlier run has them, if no recording
    tells where they are."""
    known, out = solution.shared.frames, {}
    for name in (s.rig.reference_frame for s in sources if s.rig.reference_frame in known):
        T = known[name].T_parent_child
        out[name] = (*T[:3, 3].tolist(), *se3.to_quat_wxyz(T).tolist())
    return replace(model, starts=out)


def untold(prior: JointPrior, run: Path | str) -> list[str]:
    """That a prior, of this run, does not say which errors it may share with newer recordings; a
    clause, or none."""
    if prior.common is not None:
        return []
    return [
        f"--prior {run}, or a run before it, was made by an earlier version, which did not write "
        "down how its estimate goes with errors of the mesh and of spheres; they count as if they "
        "were other errors in these recordings, until that run is fitted again"
    ]


def _earlier_spreads(
    problem: Problem, solution: Solution
) -> Iterator[tuple[str, tuple[float, float]]]:
    """Key of each spread that the earlier run estimated too, what it was, and the sigma of that;
    none of joint readings, whose spreads are estimated together, from these recordings alone."""
    for source, terms in zip(problem.sources, problem.terms, strict=True):
        known = solution.part(source.rig.name).effects
        drawn = (t for t in terms if t.effect.by_chance and t.effect.site is not Site.JOINTS)
        for term in (t for t in drawn if t.effect.name in known):
            effect = known[term.effect.name]
            for key, spread in names_of(problem, term).items():
                if spread.name in effect.names:
                    at = effect.names.index(spread.name)
                    yield key, (float(effect.estimate[at]), float(effect.sigma[at]))


def change(prior: JointPrior, values: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Now minus then of all that the prior holds (P,), as one tangent at its means; and how that
    goes (P, P) with a tangent at the values now, of which covariances are: a frame that is turned
    far has other axes."""
    changes, by = [], []
    for v in prior.held:
        changes.append(v.difference(prior.means[v.name], values[v.name]))
        pose = v.kind == "pose"
        by.append(se3.right_jacobian_inverse(changes[-1]) if pose else np.eye(v.dim))
    return np.concatenate(changes), block_diag(*by)


def _earlier_value(problem: Problem, variable: Unknown, solution: Solution) -> np.ndarray | None:
    for source, terms in zip(problem.sources, problem.terms, strict=True):
        part = solution.part(source.rig.name)
        for term in terms:
            if term.variable != variable.name:
                continue
            if isinstance(term.effect, FrameOffset):
                frame = part.frames.get(term.effect.name)
                if frame is None:
                    return None
                tree = source.rig.tree
                T_cad = tree.edges[tree.edge_names.index(term.effect.name)].T_parent_child
                return se3.log(se3.inverse(T_cad) @ frame.T_parent_child)[term.free]
            effect = part.effects.get(term.effect.name)
            names = tuple(p.name for p in term.effect.params(source.rig))
            if effect and effect.names != names:
                of_one = sorted(set(effect.names) ^ set(names)) or ["in another order"]
                raise InputError(
                    f"--prior: {term.effect.name} has other parameters in that run than in "
                    f"{source.recording.folder} ({listed(of_one)}), so LiDAR, arm or labels are "
                    "others; give a run of the same hardware, or none"
                )
            return effect.estimate[term.free] if effect else None
    frame = solution.shared.frames.get(variable.name)
    return frame.T_parent_child if frame else None
