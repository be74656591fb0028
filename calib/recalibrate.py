"""Recalibration: what an earlier run knew is the prior, and what has moved since is found."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from calib.effects import FrameOffset
from calib.fit import Estimate, Progress, solve
from calib.graph import Variable
from calib.prior import JointPrior, difference
from calib.problem import Problem
from calib.run import Solution
from chains import se3
from chains.errors import InputError

ALARM = 0.01  # chance that anything is called moved when nothing has
TOLD = 0.9  # of the earlier variance left: less than that, and the new data say something


@dataclass(frozen=True)
class Link:
    """One link (a frame or an effect) then and now.

    Args:
        name: the variable.
        moved: whether it moved by more than the two uncertainties allow.
        p_value: of the change, if it had not; None where the new data say nothing of it.
        change: (n,) now minus then, per parameter, m or rad.
        sigma: (n,) of the estimate now.
        parameters: (n,) names.
        units: (n,).
    """

    name: str
    moved: bool
    p_value: float | None
    change: np.ndarray
    sigma: np.ndarray
    parameters: tuple[str, ...]
    units: tuple[str, ...]


def earlier(problem: Problem, solution: Solution) -> JointPrior:
    """An earlier solution as a joint prior over those variables that the problem has too.

    Raises:
        InputError: the two have nothing in common.
    """
    position = {name: i for i, name in enumerate(solution.names)}
    held, means, rows = [], {}, []
    for name in problem.calibration:
        variable = problem.variables[name]
        index = [position.get(f"{name}.{dof}") for dof in variable.dofs]
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
    return JointPrior(held, means, solution.covariance[np.ix_(rows, rows)])


def solve_from(
    problem: Problem, prior: JointPrior, progress: Progress
) -> tuple[Estimate, list[Link]]:
    """Estimate with an earlier solution as prior, releasing link by link what has moved.

    With nothing moved, an update changes a link by ``d ~ N(0, S_then - S_now)``. The link whose
    change is least likely is released to its CAD prior and the fit repeated, until none is beyond
    chance (1 % over all links).
    """
    released: dict[str, float] = {}
    while True:
        estimate = solve(problem, prior, progress=progress)
        tests = {v.name: _change_test(v, prior, estimate) for v in prior.held}
        found = {name: p for name, p in tests.items() if p is not None}
        worst = min(found, key=found.get, default=None)
        if worst is None or found[worst] > ALARM / len(found) or len(prior.held) == 1:
            break
        released[worst] = found[worst]
        prior = prior.without(worst)
    names = [n for n in problem.calibration if n in prior.means]
    return estimate, [
        _link(
            problem.variables[n],
            prior.means[n],
            estimate,
            released.get(n, tests.get(n)),
            n in released,
        )
        for n in names
    ]


def _change_test(variable: Variable, prior: JointPrior, estimate: Estimate) -> float | None:
    then = _block(prior.held, prior.covariance, variable.name)
    now = _estimate_block(estimate, variable)
    root = np.linalg.inv(np.linalg.cholesky(then))
    left, axes = np.linalg.eigh(root @ now @ root.T)
    d = difference(variable, prior.means[variable.name], estimate.values[variable.name])
    told = left < TOLD
    if not told.any():
        return None
    z2 = np.square(axes.T @ root @ d)[told] / (1.0 - left[told])
    return float(chi2.sf(z2.sum(), told.sum()))


def _link(
    variable: Variable, mean: np.ndarray, estimate: Estimate, p_value: float | None, moved: bool
) -> Link:
    return Link(
        variable.name,
        moved,
        p_value,
        difference(variable, mean, estimate.values[variable.name]),
        np.sqrt(np.diag(_estimate_block(estimate, variable))),
        variable.dofs,
        variable.units,
    )


def _block(variables: Sequence[Variable], covariance: np.ndarray, name: str) -> np.ndarray:
    start = 0
    for v in variables:
        if v.name == name:
            return covariance[start : start + v.dim, start : start + v.dim]
        start += v.dim
    raise KeyError(name)


def _estimate_block(estimate: Estimate, variable: Variable) -> np.ndarray:
    return _block(estimate.variables, estimate.covariance, variable.name)


def _earlier_value(problem: Problem, variable: Variable, solution: Solution) -> np.ndarray | None:
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
            return effect.estimate[term.free] if effect else None
    frame = solution.shared.frames.get(variable.name)
    return frame.T_parent_child if frame else None
