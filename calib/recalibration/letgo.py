"""Which links are let go, as they moved since an earlier run, or may have."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from scipy.special import chdtrc

from calib.problem.prior import JointPrior
from calib.problem.unknowns import Unknown
from calib.recalibration.links import Link
from calib.recalibration.newer import (
    NewerData,
    RefittedPrior,
    blocks_of,
    fall_of_aic,
    left_by_moves,
    moved_alone,
    tests,
    told_from,
)
from calib.recalibration.odds import FREEDOMS, MoveOdds
from chains.errors import NothingMetError

ALARM = 0.01  # chance that anything is called moved when nothing has
# Odds by which one link explains better than another, from which on it is named alone: "strong"
# evidence (Kass and Raftery 1995, Bayes factors, JASA 90).
STRONG_ODDS = 20.0
SECOND_LOOK = 0.1  # of that chance, for what shows only once it is let go (weighted Bonferroni)
OFF = 3.0  # sigmas, a choice: what is further off than that is wrong, as people read sigmas
UNLIKE = 0.01  # chance that rings that changed alike are not told to have done so
# Of each look at one recalibration, until it settles: one where nothing moved, two where data stay
# as they are.
MOST_FITS = 4


class _Moves(NamedTuple):
    """Which links moved, each with by how many of CAD's sigmas it may have; and for each those that
    may have in its place."""

    moved: dict[str, float]
    instead: dict[str, dict[str, float]]

    @classmethod
    def of(cls, prior: JointPrior, data: NewerData, limit: float) -> _Moves:
        """As newer data have it; arguments as of `_moved`."""
        moved = _moved(prior, data, limit)
        return cls(moved, _instead(prior, data, moved, limit))

    @property
    def free(self) -> dict[str, float]:
        """All that are not known to be where they were."""
        return {n: f for each in self.instead.values() for n, f in each.items()} | self.moved


class _Settled(NamedTuple):
    """Where fits end: what newer data say in the last but one, what moved, what the last lets go,
    and what any of them did."""

    data: NewerData
    moves: _Moves
    free: dict[str, float]
    tried: frozenset[str]


def let_go(
    prior: JointPrior,
    fit: Callable[[JointPrior], RefittedPrior],
    alarm: float = ALARM,
    begin: Mapping[str, float] = MappingProxyType({}),
) -> list[Link]:
    """What became of each link since an earlier solution.

    Links that contradict prior and data beyond chance are taken to have moved, and the fit is
    repeated with these let go, until one finds what it let go. So are links of which one may have
    moved in their place, as their estimates are no surer. Where fits find in turn what another let
    go, the last lets go what any two of them did. Residuals that then exceed their sigmas are due
    to something else: what seems to move because of that is held again. Half or more of a ring's
    beams, say, may have been rejected because its zero was held: moves are then judged from a fit
    that lets it go. A move that is held leaves residuals that look like errors common to many rows,
    and these hide it. So where nothing has moved, what would have if rows erred alone is let go,
    and judged from that fit at a tenth of the level.

    Args:
        prior: the earlier solution.
        fit: from it, or from the same where links were let go, to the newer data.
        alarm: chance that any link is called moved where none has.
        begin: links that the first fit lets go, each by how many of its sigmas.
    """
    limit, free = alarm / len(prior.held), dict(begin)
    first = _where_anything_is_met(prior.loosened(free), fit)
    if first is None or not first.converged:
        free, first = _from_afar(prior, fit)
    elif first.not_trusted:
        free |= {v.name: float(FREEDOMS[0]) for v in prior.held if v.name in first.not_trusted}
        first = fit(prior.loosened(free))
    settled = _settled(prior, fit, free, first, limit)
    if first.converged and not (free or settled.moves.free):
        by_rows = NewerData.of(prior, first).by_single_rows
        hidden = _Moves.of(prior, by_rows, SECOND_LOOK * limit).free
        if hidden.keys() - settled.tried:
            now = fit(prior.loosened(hidden))
            settled = _settled(prior, fit, hidden, now, SECOND_LOOK * limit)
    return _links(prior, settled, limit)


def _settled(
    prior: JointPrior,
    fit: Callable[[JointPrior], RefittedPrior],
    free: dict[str, float],
    now: RefittedPrior,
    limit: float,
) -> _Settled:
    """Where fits end.

    Args:
        prior, fit: as of `let_go`.
        free, now: what the first of them let go, and that fit.
        limit: p-value of a link from which on it is beyond chance.
    """
    fits: list[dict[str, float]] = []
    last = False
    while True:
        found = _Moves.of(prior, NewerData.of(prior.loosened(free), now), limit).free
        if last or _alike(found, free):
            break
        fits.append(free)
        last = len(fits) == MOST_FITS - 1 or any(_alike(found, earlier) for earlier in fits)
        both = {n: max(found.get(n, 0.0), free.get(n, 0.0)) for n in found | free}
        if last and _alike(both, free):
            break
        free = both if last else found
        now = fit(prior.loosened(free))
        last = last or not now.converged
    tried = frozenset(name for each in (*fits, free) for name in each)
    data = NewerData.of(prior.loosened(free), now.at_least)
    moves = _Moves.of(prior, data, limit)
    if moves.free.keys() != free.keys():
        free = moves.free
        fit(prior.loosened(free))
    return _Settled(data, moves, free, tried)


def _where_anything_is_met(
    prior: JointPrior, fit: Callable[[JointPrior], RefittedPrior]
) -> RefittedPrior | None:
    """A fit from a prior; None where beams would meet nothing there."""
    try:
        return fit(prior)
    except NothingMetError:
        return None


def _from_afar(
    prior: JointPrior, fit: Callable[[JointPrior], RefittedPrior]
) -> tuple[dict[str, float], RefittedPrior]:
    """A fit from which what moved is told where one that held all to the earlier solution came to
    no optimum, as where the reference was scanned anew in another frame: one that holds nothing.
    Where that has none either, the first once more."""
    every = {v.name: float(FREEDOMS[-1]) for v in prior.held}
    now = fit(prior.loosened(every))
    return (every, now) if now.converged else ({}, fit(prior))


def _links(prior: JointPrior, settled: _Settled, limit: float) -> list[Link]:
    """What became of each link, where fits end so; `limit` as of `_settled`."""
    data, moves, free, _ = settled
    held = prior.loosened(moves.moved)
    p_values, now, links = tests(held, data), data.fitted(held), []
    least, left = told_from(held, data, limit), left_by_moves(held, data)
    shown_by = {}
    for name in moves.moved:
        others = prior.loosened(_without(moves.moved, name))
        p_values[name] = tests(others, data)[name]
        shown_by[name] = moved_alone(others, data, name)
    for v in prior.held:
        link = _link(v, held, now, p_values[v.name], moves.moved.get(v.name, 0.0))
        instead = tuple(moves.instead.get(v.name, {}))
        link = replace(link, freed=free.get(v.name, 0.0), instead=instead)
        if v.name in shown_by:
            best, *alone = shown_by[v.name]
            link = replace(link, shown_by=v.dofs[best], alone=tuple(alone))
        if not link.moved and link.p_value is not None:
            off = v.sigma * left[blocks_of(prior.held)[v.name]]
            hidden = (least[v.name] > v.sigma) & (off > OFF)
            unchecked = tuple(n for n, each in zip(v.dofs, hidden, strict=True) if each)
            link = replace(link, told_from=least[v.name], unchecked=unchecked)
        links.append(link)
    return links


def _without(freed: Mapping[str, float], name: str) -> dict[str, float]:
    return {other: times for other, times in freed.items() if other != name}


def _alike(freed: Mapping[str, float], other: Mapping[str, float]) -> bool:
    """Whether the same links are let go, each within a step of the grid."""
    return freed.keys() == other.keys() and all(
        abs(np.log2(f / other[name])) <= 1.0 for name, f in freed.items()
    )


def _moved(prior: JointPrior, data: NewerData, limit: float) -> dict[str, float]:
    """The links that moved, each with by how many of CAD's sigmas it may have.

    Of those beyond chance beside the ones that moved already, the next is that with the greatest
    evidence. Any that is not beyond chance beside all others did not move.

    Args:
        prior, data: what was known, and the newer data.
        limit: p-value of a link from which on it is beyond chance.
    """
    moved: dict[str, float] = {}
    odds = MoveOdds.of(prior, data)
    for _ in range(2 * len(prior.held)):
        beyond = _beyond(prior.loosened(moved), data, limit)
        ways = [odds.freest(moved, name) for name in beyond if name not in moved]
        if not ways:
            break
        moved = max(ways, key=odds.gain)
        for name in list(moved)[:-1]:
            others = _without(moved, name)
            moved = moved if name in _beyond(prior.loosened(others), data, limit) else others
    return moved


def _instead(
    prior: JointPrior, data: NewerData, moved: Mapping[str, float], limit: float
) -> dict[str, dict[str, float]]:
    """Per link that moved those that explain nearly as much in its place, and how free each is;
    arguments as of `_moved`. A link of many parameters has small odds, as all of them might have
    moved and most did not. Where it explains as much as the one that is named, by a move no larger
    in CAD's sigmas, data do not tell them apart."""
    odds, found = MoveOdds.of(prior, data), {}
    for name in moved:
        others, enough = _without(moved, name), odds.gain(moved) - np.log(STRONG_ODDS)
        held = prior.loosened(others)
        beyond = _beyond(held, data, STRONG_ODDS * limit)
        ways = {n: odds.freest(others, n) for n in beyond if n not in moved}
        fall = fall_of_aic(held, data)
        least = fall[name] - 2.0 * np.log(STRONG_ODDS)
        alike = {n for n, way in ways.items() if fall[n] > least and way[n] <= moved[name]}
        found[name] = {n: w[n] for n, w in ways.items() if n in alike or odds.gain(w) > enough}
    return found


def _beyond(prior: JointPrior, data: NewerData, limit: float) -> list[str]:
    """The links whose change is beyond chance."""
    return [name for name, p in tests(prior, data).items() if p is not None and p <= limit]


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
        of_mean=_of_mean(change, covariance) if freed and variable.of_members else (),
    )


def _of_mean(change: np.ndarray, covariance: np.ndarray) -> tuple[float, ...]:
    """The mean change and its sigma, where single ones differ from it by chance; else empty."""
    mean, sigma = float(change.mean()), float(np.sqrt(covariance.mean()))
    apart = np.eye(len(change))[1:] - 1.0 / len(change)  # all but one of the differences
    rest = apart @ change
    statistic = rest @ np.linalg.solve(apart @ covariance @ apart.T, rest)
    alike = len(rest) == 0 or float(chdtrc(len(rest), statistic)) > UNLIKE
    return (mean, sigma) if alike else ()
