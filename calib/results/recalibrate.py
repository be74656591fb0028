"""Recalibration: what an earlier run knew is the prior, and what has moved since is found."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.special import chdtrc

from calib.effects import FrameOffset
from calib.problem import Problem
from calib.problem.model import Model
from calib.problem.prior import JointPrior
from calib.problem.unknowns import Unknown
from calib.results.intervals import Intervals, intervals
from calib.results.solution import Solution
from calib.solve.estimate import Estimate
from calib.solve.fit import Progress, shapes_freed, solve
from chains import se3
from chains.errors import InputError

ALARM = 0.01  # chance that anything is called moved when nothing has
# Of the earlier variance left: less than that, and the new data say something. A choice: they took
# 5 % off the earlier sigma.
LEFT_VARIANCE = 0.9


@dataclass(frozen=True)
class Link:
    """One link (a frame or an effect) then and now.

    Args:
        name: the variable.
        moved: whether it moved by more than the two uncertainties allow.
        p_value: of the change, if it had not; None where the new data say nothing of it.
        change: (n,) now minus then, per parameter, m or rad.
        sigma: (n,) of the change where it moved, else of the estimate now.
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
    position = {key: i for i, key in enumerate(solution.keys)}
    held, means, rows = [], {}, []
    for name in problem.calibration:
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
    return JointPrior(held, means, solution.covariance[np.ix_(rows, rows)])


def as_let_go(prior: JointPrior, links: Iterable[Mapping[str, Any]]) -> JointPrior:
    """An earlier solution, less sure of those links that had moved.

    Args:
        prior: that solution.
        links: what became of each, as `summary.json` has it.
    """
    for link in links:
        prior = prior.loosened(link["name"]) if link["moved"] else prior
    return prior


class RefittedPrior(NamedTuple):
    """What a joint prior holds, fitted to newer data.

    ``change`` (P,) is now minus then; ``graph`` and ``covariance`` (P, P) say how well it is known
    now, as rows that err alone have it and as its intervals have it.
    """

    change: np.ndarray
    graph: np.ndarray
    covariance: np.ndarray


def solve_from(
    problem: Problem, model: Model, prior: JointPrior, progress: Progress
) -> tuple[Estimate, Estimate, Intervals, list[Link]]:
    """Estimate with an earlier solution as prior, letting go link by link of what has moved; the
    same with its shapes among the unknowns, the intervals of that, and what became of each link;
    see `let_go` and `shapes_freed`."""
    found: list[tuple[Estimate, Estimate, Intervals]] = []

    def fit(prior: JointPrior) -> RefittedPrior:
        estimate = solve(problem, prior, progress=progress)
        freed = shapes_freed(estimate, model, prior)
        known = intervals(freed, progress)
        found.append((estimate, freed, known))
        held = known.of([v.name for v in prior.held])
        return RefittedPrior(_change(prior, estimate), held.graph, held.covariance)

    links = let_go(prior, fit)
    return *found[-1], links


def let_go(prior: JointPrior, fit: Callable[[JointPrior], RefittedPrior]) -> list[Link]:
    """What became of each link since an earlier solution.

    The link that explains the contradiction between prior and data best is taken to have moved by
    as much as CAD was unsure of it, and the fit repeated, until none is beyond chance (1 % over all
    links).

    Args:
        prior: the earlier solution.
        fit: from it, or from the same where links were let go, to the newer data.
    """
    moved: dict[str, _Test] = {}
    while True:
        now = fit(prior)
        tests = _tests(prior, now)
        found = {n: test for n, test in tests.items() if test is not None and n not in moved}
        worst = min(found, key=found.get, default=None)
        if worst is None or found[worst].p > ALARM / len(tests):
            break
        moved[worst] = found[worst]
        prior = prior.loosened(worst)
    tests |= moved
    return [_link(v, prior, now, tests[v.name], v.name in moved) for v in prior.held]


def _tests(prior: JointPrior, now: RefittedPrior) -> dict[str, _Test | None]:
    """Per link, a test of its not having moved; None where the data cannot tell.

    Baarda's test of a group of observations, which the prior's means m of covariance S are. With
    nothing moved, ``d = now - m ~ N(0, V)``, ``V = S - S_now`` and what rows that err together add
    to S_now; with P = S^-1, link k alone having moved shows in ``T = (P d)_k^T [(P V P)_kk]^-1
    (P d)_k``, chi2-distributed if it has not. Links are strongly correlated, so the change of each
    by itself would accuse the wrong one.

    Baarda 1968, A testing procedure for use in geodetic networks.
    """
    scale = np.sqrt(np.diag(prior.covariance))
    P = np.linalg.inv(prior.covariance / np.outer(scale, scale))
    known = (2.0 * now.graph - now.covariance) / np.outer(scale, scale)
    force = P @ (now.change / scale)
    spread = P - P @ known @ P
    blocks = blocks_of(prior.held)
    return {name: _test(force[k], spread[k, k], P[k, k]) for name, k in blocks.items()}


class _Test(NamedTuple):
    """The less likely, the smaller: by p, and by the statistic where p is 0 in floating point."""

    p: float
    minus_statistic: float


def _test(force: np.ndarray, spread: np.ndarray, precision: np.ndarray) -> _Test | None:
    """Of a force ~ N(0, spread), along the axes that anything but the prior holds."""
    root = np.linalg.inv(np.linalg.cholesky(precision))
    told, axes = np.linalg.eigh(root @ spread @ root.T)
    use = told > 1.0 - LEFT_VARIANCE
    if not use.any():
        return None
    statistic = float((np.square(axes.T @ root @ force)[use] / told[use]).sum())
    return _Test(float(chdtrc(use.sum(), statistic)), -statistic)


def _link(
    variable: Unknown,
    prior: JointPrior,
    now: RefittedPrior,
    test: _Test | None,
    moved: bool,
) -> Link:
    """The link, with the move that explains all changes best where it is the one that moved.

    With x = m + error + move, error ~ N(0, S) and move ~ N(0, D_k) of each link k that moved, after
    the fit ``move_k = G (x - m)``, ``G = D_k (S + D)^-1``, of ``G S_now G^T + D_k - G D_k``.

    Args:
        variable: the link.
        prior: as it then was.
        now: all that it holds, fitted.
        test: of the link.
        moved: whether it did.
    """
    k, change, covariance = blocks_of(prior.held)[variable.name], now.change, now.covariance
    if moved:
        D = np.diag(np.square(variable.sigma))
        scale = np.sqrt(np.diag(prior.covariance))
        P = np.linalg.inv(prior.covariance / np.outer(scale, scale)) / np.outer(scale, scale)
        G = D @ P[k]
        change = G @ change
        covariance = G @ covariance @ G.T + D - G[:, k] @ D
    else:
        change, covariance = change[k], covariance[k, k]
    return Link(
        name=variable.name,
        moved=moved,
        p_value=test.p if test else None,
        change=change,
        sigma=np.sqrt(np.diag(covariance)),
        parameters=variable.dofs,
        units=variable.units,
    )


def _change(prior: JointPrior, estimate: Estimate) -> np.ndarray:
    """Now minus then of all that the prior holds, as one tangent."""
    values = ((v, prior.means[v.name], estimate.values[v.name]) for v in prior.held)
    return np.concatenate([v.difference(then, now) for v, then, now in values])


def blocks_of(variables: Sequence[Unknown]) -> dict[str, slice]:
    """Name -> where each stands among the tangents of all."""
    ends = np.cumsum([v.dim for v in variables])
    return {v.name: slice(end - v.dim, end) for v, end in zip(variables, ends, strict=True)}


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
            return effect.estimate[term.free] if effect else None
    frame = solution.shared.frames.get(variable.name)
    return frame.T_parent_child if frame else None
