"""Recalibration: what an earlier run knew is the prior, and what has moved since is found."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag
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
# A link that moved may have gone by as many of CAD's sigmas: to 0.1 m, of a mount known to 0.1 mm.
# Between two of them evidence hardly differs.
FREEDOMS = 2.0 ** np.arange(11)
# Odds by which one link explains better than another, from which on it is named alone: "strong"
# evidence (Kass and Raftery 1995, Bayes factors, JASA 90).
STRONG_ODDS = 20.0
MOST_FITS = 4  # of one recalibration: one where nothing moved, two where data stay as they are


@dataclass(frozen=True)
class Link:
    """One link (a frame or an effect) then and now.

    Args:
        name: the variable.
        moved: whether it moved, as chance hardly makes such a change beside all others that moved.
        p_value: of the change, if it had not; None where the new data say nothing of it.
        change: (n,) now minus then, per parameter, m or rad, if those that moved are the ones.
        sigma: (n,) of the change where it moved, else of the estimate now; the same holds.
        parameters: (n,) names.
        units: (n,).
        freed: by how many of CAD's sigmas the fit let it go from the earlier value; 0 where held.
        instead: links of which one may have moved in its place: the data cannot tell.
    """

    name: str
    moved: bool
    p_value: float | None
    change: np.ndarray
    sigma: np.ndarray
    parameters: tuple[str, ...]
    units: tuple[str, ...]
    freed: float = 0.0
    instead: tuple[str, ...] = ()


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


class RefittedPrior(NamedTuple):
    """What a joint prior holds, fitted to newer data.

    ``change`` (P,) is now minus then, as a tangent there; ``graph`` and ``covariance`` (P, P) say
    how well it is known now, as rows that err alone have it and as its intervals have it.
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
        held, (change, turned) = known.of([v.name for v in prior.held]), _change(prior, estimate)
        about_then = (turned @ each @ turned.T for each in (held.graph, held.covariance))
        return RefittedPrior(change, *about_then)

    links = let_go(prior, fit)
    return *found[-1], links


@dataclass(frozen=True, eq=False)
class NewerData:
    """What newer data alone say of all that a joint prior holds: their normal equations.

    Args:
        information: (P, P) of the tangents from the earlier values.
        right: (P,).
        beyond: (P, P) by how much more the right side scatters than the information has it.
    """

    information: np.ndarray
    right: np.ndarray
    beyond: np.ndarray

    @classmethod
    def of(cls, prior: JointPrior, now: RefittedPrior) -> NewerData:
        """From a fit to them and to a prior."""
        scale = np.sqrt(np.diag(prior.covariance))
        both = np.outer(scale, scale)
        weight, known = (np.linalg.inv(m / both) for m in (now.graph, prior.covariance))
        beyond = weight @ ((now.covariance - now.graph) / both) @ weight
        right = weight @ (now.change / scale)
        return cls((weight - known) / both, right / scale, beyond / both)

    def fitted(self, prior: JointPrior) -> RefittedPrior:
        """A fit to them from another prior of the same means: one step, as all is linear here."""
        scale = np.sqrt(np.diag(prior.covariance))
        both = np.outer(scale, scale)
        known = np.linalg.inv(np.linalg.inv(prior.covariance / both) + self.information * both)
        wide = known + known @ (self.beyond * both) @ known
        return RefittedPrior(scale * (known @ (self.right * scale)), known * both, wide * both)


def let_go(prior: JointPrior, fit: Callable[[JointPrior], RefittedPrior]) -> list[Link]:
    """What became of each link since an earlier solution.

    Links that contradict prior and data beyond chance (1 % over all links) are taken to have moved,
    and the fit is repeated with these let go, until one finds what another found before. So are
    links of which one may have moved in their place, as their estimates are no surer.

    Args:
        prior: the earlier solution.
        fit: from it, or from the same where links were let go, to the newer data.
    """
    fits: list[dict[str, float]] = []
    free: dict[str, float] = {}
    while True:
        held = prior.loosened(free)
        data = NewerData.of(held, fit(held))
        fits.append(free)
        moved = _moved(prior, data)
        instead = _instead(prior, data, moved)
        found = {n: f for each in instead.values() for n, f in each.items()} | moved
        if len(fits) == MOST_FITS or any(_alike(found, earlier) for earlier in fits):
            break
        free = found
    held = prior.loosened(moved)
    p_values, now, links = _tests(held, data), data.fitted(held), []
    for name in moved:
        p_values[name] = _tests(prior.loosened(_without(moved, name)), data)[name]
    for v in prior.held:
        link = _link(v, held, now, p_values[v.name], moved.get(v.name, 0.0))
        alike = tuple(instead.get(v.name, {}))
        links.append(replace(link, freed=fits[-1].get(v.name, 0.0), instead=alike))
    return links


def _without(freed: Mapping[str, float], name: str) -> dict[str, float]:
    return {other: times for other, times in freed.items() if other != name}


def _alike(freed: Mapping[str, float], other: Mapping[str, float]) -> bool:
    """Whether the same links are let go, each within a step of the grid."""
    return freed.keys() == other.keys() and all(
        abs(np.log2(f / other[name])) <= 1.0 for name, f in freed.items()
    )


def _moved(prior: JointPrior, data: NewerData) -> dict[str, float]:
    """The links that moved, each with by how many of CAD's sigmas it may have.

    Of those beyond chance beside the ones that moved already, the next is that with the greatest
    evidence. Any that is not beyond chance beside all others did not move.
    """
    moved: dict[str, float] = {}
    evidence = _Evidence.of(prior, data)
    for _ in range(2 * len(prior.held)):
        tests = _tests(prior.loosened(moved), data)
        limit = ALARM / len(tests)
        beyond = [n for n, p in tests.items() if p is not None and p <= limit and n not in moved]
        if not beyond:
            break
        moved = max((evidence.freest(moved, name) for name in beyond), key=evidence.gain)
        for name in list(moved)[:-1]:
            others = _without(moved, name)
            p_value = _tests(prior.loosened(others), data)[name]
            moved = moved if p_value is not None and p_value <= limit else others
    return moved


def _instead(
    prior: JointPrior, data: NewerData, moved: Mapping[str, float]
) -> dict[str, dict[str, float]]:
    """Per link that moved those that explain nearly as much in its place, and how free each is."""
    evidence, found = _Evidence.of(prior, data), {}
    for name in moved:
        others = _without(moved, name)
        ways = {v.name: evidence.freest(others, v.name) for v in prior.held if v.name not in moved}
        enough = max(evidence.gain(moved) - np.log(STRONG_ODDS), evidence.gain(others))
        found[name] = {n: way[n] for n, way in ways.items() if evidence.gain(way) > enough}
    return found


@dataclass(frozen=True, eq=False)
class _Evidence:
    """How much likelier data and prior are where some links moved; see `_tests` for the force and
    its spread.

    With moves ``N(0, D)`` the force f of those links is ``N(0, W + W D W)``, W its spread. So the
    log of the likelihood gains ``(f' (W + D^-1)^-1 f - log|1 + D W|) / 2``. By how many of CAD's
    sigmas a link may move is half-Cauchy beforehand (Gelman 2006, Bayesian Analysis 1), here per
    step of a grid of logarithms.
    """

    force: np.ndarray
    spread: np.ndarray
    sigma: np.ndarray
    blocks: Mapping[str, slice]

    @classmethod
    def of(cls, prior: JointPrior, data: NewerData) -> _Evidence:
        _, force, spread = _force(prior, data.fitted(prior))
        scale = np.sqrt(np.diag(prior.covariance))
        sigma = np.concatenate([v.sigma for v in prior.held]) / scale
        return cls(force, spread, sigma, blocks_of(prior.held))

    def gain(self, freed: Mapping[str, float]) -> float:
        if not freed:
            return 0.0
        rows = np.concatenate([np.r_[self.blocks[name]] for name in freed])
        root = np.concatenate([f * self.sigma[self.blocks[name]] for name, f in freed.items()])
        told, axes = np.linalg.eigh(self.spread[np.ix_(rows, rows)] * np.outer(root, root))
        size = 1.0 + np.maximum(told, 0.0)  # less is rounding
        explained = np.square(axes.T @ (root * self.force[rows])) / size
        expected = sum(np.log(2.0 * f / (1.0 + f * f)) for f in freed.values())
        return float(np.sum(explained - np.log(size)) / 2 + expected)

    def freest(self, freed: Mapping[str, float], name: str) -> dict[str, float]:
        """Some links that are let go, and one more, as far as evidence has it."""
        ways = [{**freed, name: float(f)} for f in FREEDOMS]
        return max(ways, key=self.gain)


def _force(prior: JointPrior, now: RefittedPrior) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of a fit, in units of the prior's sigmas: the prior's weights P (P, P), the force ``P d``
    (P,) by which it pulls, and the spread (P, P) of that where nothing moved."""
    scale = np.sqrt(np.diag(prior.covariance))
    P = np.linalg.inv(prior.covariance / np.outer(scale, scale))
    known = (2.0 * now.graph - now.covariance) / np.outer(scale, scale)
    return P, P @ (now.change / scale), P - P @ known @ P


def _tests(prior: JointPrior, data: NewerData) -> dict[str, float | None]:
    """Per link, the p-value of its not having moved; None where the data cannot tell.

    Baarda's test of a group of observations, which the prior's means m of covariance S are. With
    nothing moved, ``d = now - m ~ N(0, V)``, ``V = S - S_now`` and what rows that err together add
    to S_now; with P = S^-1, link k alone having moved shows in ``T = (P d)_k^T [(P V P)_kk]^-1
    (P d)_k``, chi2-distributed if it has not. Links are strongly correlated, so the change of each
    by itself would accuse the wrong one.

    Baarda 1968, A testing procedure for use in geodetic networks.
    """
    P, force, spread = _force(prior, data.fitted(prior))
    blocks = blocks_of(prior.held)
    return {name: _test(force[k], spread[k, k], P[k, k]) for name, k in blocks.items()}


def _test(force: np.ndarray, spread: np.ndarray, precision: np.ndarray) -> float | None:
    """The p-value of a force ~ N(0, spread), along the axes that anything but the prior holds."""
    root = np.linalg.inv(np.linalg.cholesky(precision))
    told, axes = np.linalg.eigh(root @ spread @ root.T)
    use = told > 1.0 - LEFT_VARIANCE
    if not use.any():
        return None
    statistic = float((np.square(axes.T @ root @ force)[use] / told[use]).sum())
    return float(chdtrc(use.sum(), statistic))


def _link(
    variable: Unknown,
    prior: JointPrior,
    now: RefittedPrior,
    p_value: float | None,
    freed: float,
) -> Link:
    """The link, with the move that explains all changes best where it is the one that moved.

    With x = m + error + move, error ~ N(0, S) and move ~ N(0, D_k) of each link k that moved, after
    the fit ``move_k = G (x - m)``, ``G = D_k (S + D)^-1``, of ``G S_now G^T + D_k - G D_k``.

    Args:
        variable: the link.
        prior: with what moved let go.
        now: all that it holds, fitted.
        p_value: of the link.
        freed: by how many of CAD's sigmas it may have moved; 0 where it did not.
    """
    k, change, covariance = blocks_of(prior.held)[variable.name], now.change, now.covariance
    if freed:
        D = np.diag(np.square(freed * variable.sigma))
        scale = np.sqrt(np.diag(prior.covariance))
        P = np.linalg.inv(prior.covariance / np.outer(scale, scale)) / np.outer(scale, scale)
        G = D @ P[k]
        change = G @ change
        covariance = G @ covariance @ G.T + D - G[:, k] @ D
    else:
        change, covariance = change[k], covariance[k, k]
    return Link(
        name=variable.name,
        moved=freed > 0.0,
        p_value=p_value,
        change=change,
        sigma=np.sqrt(np.diag(covariance)),
        parameters=variable.dofs,
        units=variable.units,
    )


def _change(prior: JointPrior, estimate: Estimate) -> tuple[np.ndarray, np.ndarray]:
    """Now minus then of all that the prior holds (P,), as one tangent at its means; and how that
    goes (P, P) with a tangent at the estimate, of which covariances are: a frame that is turned far
    has other axes."""
    changes, by = [], []
    for v in prior.held:
        change = v.difference(prior.means[v.name], estimate.values[v.name])
        changes.append(change)
        by.append(se3.right_jacobian_inverse(change) if v.kind == "pose" else np.eye(v.dim))
    return np.concatenate(changes), block_diag(*by)


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
