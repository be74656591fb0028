"""What newer data alone say of all that an earlier run knew, and the tests of each link."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.special import chdtrc, chdtri, chndtrinc

from calib.blunders.chance import POWER
from calib.linear.symmetric import eigh
from calib.problem.prior import JointPrior
from calib.problem.unknowns import Unknown

# Of the earlier variance left along a direction, up to which the new data are asked about it: where
# they alone know it at most 30 times worse than the earlier run. With 3 times, a LiDAR that had
# moved by millimetres, seen at one stop, was told as a move of the scanner's frame, or not at all.
LEFT_VARIANCE = 0.999
NEVER = 1e-9  # of the earlier information on a parameter, as what rounding leaves: it shows nothing
TESTS_OF_MEMBERS = ("all", "their mean", "each")  # of unknowns with a value for each ring, say


class RefittedPrior(NamedTuple):
    """What a joint prior holds, fitted to newer data.

    ``change`` (P,) is now minus then, as a tangent there; ``graph`` and ``covariance`` (P, P) say
    how well it is known now, as rows that err alone have it and as its intervals have it; and
    ``widened`` (P, P) as they have it where residuals exceed their sigmas; None where they do not.
    Of a fit that has not ``converged`` none of this says anything, nor does it of variables that
    are ``not_trusted``, as `Estimate.not_trusted` has it.
    """

    change: np.ndarray
    graph: np.ndarray
    covariance: np.ndarray
    widened: np.ndarray | None = None
    converged: bool = True
    not_trusted: frozenset[str] = frozenset()

    @property
    def at_least(self) -> RefittedPrior:
        """The same, as sure as residuals allow."""
        return self if self.widened is None else self._replace(covariance=self.widened)


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

    @property
    def by_single_rows(self) -> NewerData:
        """The same, where rows err by themselves alone."""
        return replace(self, beyond=np.zeros_like(self.beyond))

    def fitted(self, prior: JointPrior) -> RefittedPrior:
        """A fit to them from another prior of the same means: one step, as all is linear here."""
        scale = np.sqrt(np.diag(prior.covariance))
        both = np.outer(scale, scale)
        known = np.linalg.inv(np.linalg.inv(prior.covariance / both) + self.information * both)
        wide = known + known @ (self.beyond * both) @ known
        return RefittedPrior(scale * (known @ (self.right * scale)), known * both, wide * both)


class Force(NamedTuple):
    """How the prior pulls at a fit, in units of its sigmas.

    Args:
        weight: (P, P) of the prior.
        pull: (P,) ``weight @ change``.
        answer: (P, P) by how much it pulls more for a move of each.
        spread: (P, P) its covariance where nothing moved: as the answer, and what rows that err
            together add.
    """

    weight: np.ndarray
    pull: np.ndarray
    answer: np.ndarray
    spread: np.ndarray

    @classmethod
    def of(cls, prior: JointPrior, data: NewerData) -> Force:
        now, scale = data.fitted(prior), np.sqrt(np.diag(prior.covariance))
        both = np.outer(scale, scale)
        P = np.linalg.inv(prior.covariance / both)
        graph, wide = now.graph / both, now.covariance / both
        answer, spread = (P - P @ known @ P for known in (graph, 2.0 * graph - wide))
        return cls(P, P @ (now.change / scale), answer, spread)


def tests(prior: JointPrior, data: NewerData) -> dict[str, float | None]:
    """Per link, the p-value of its not having moved; None where the data cannot tell.

    Baarda's test of a group of observations, which the prior's means m of covariance S are. With
    nothing moved, ``d = now - m ~ N(0, V)``, ``V = S - S_now`` and what rows that err together add
    to S_now; with P = S^-1, link k alone having moved shows in ``T = (P d)_k^T [(P V P)_kk]^-1
    (P d)_k``, chi2-distributed if it has not. Links are strongly correlated, so the change of each
    by itself would accuse the wrong one. Of many rings T says little where they changed alike, or
    one alone did: there the mean and each one are tested, too. Three times the smallest p-value of
    these counts, that of single ones times their number (Bonferroni).

    Baarda 1968, A testing procedure for use in geodetic networks.
    """
    found = {}
    for v, block in _pulls(prior, data):
        found[v.name] = block.p_value
        if v.of_members and v.dim > 1:
            single, told = block.each
            least = told.sum() * float(chdtrc(1, single.max())) if told.any() else None
            several = [p for p in (block.p_value, block.mean.p_value, least) if p is not None]
            found[v.name] = min(1.0, len(TESTS_OF_MEMBERS) * min(several)) if several else None
    return found


def fall_of_aic(prior: JointPrior, data: NewerData) -> dict[str, float]:
    """Per link, by how much Akaike's criterion falls where it is let go, or one of its parameters
    alone, or the mean of its members: the statistic, as of `tests`, less twice the number of
    parameters that the data tell and, for one of n, 2 log n. Half the difference of two links is
    the logarithm of their odds (Akaike 1974; Burnham and Anderson 2002, 2.9)."""
    found = {}
    for v, block in _pulls(prior, data):
        ways = [block.statistic, *([block.mean.statistic] if v.of_members else [])]
        one = block.each[0].max() - 2.0 - 2.0 * np.log(v.dim)
        found[v.name] = max(one, *(statistic - 2.0 * dof for statistic, dof in ways))
    return found


def moved_alone(prior: JointPrior, data: NewerData, name: str) -> tuple[int, float, float]:
    """Which parameter of a link explains most, had it alone moved; by how much then, and the sigma
    of that; arguments as of `tests`. All of a link let go, what moved shows in others too, as the
    data tell them apart."""
    (block,) = (block for v, block in _pulls(prior, data) if v.name == name)
    best = int(np.argmax(block.each[0]))
    answer = block.answer[best, best] or np.inf  # only the mean is told: no size
    unit = np.sqrt(np.diag(prior.covariance)[blocks_of(prior.held)[name]][best]) / answer
    return best, float(unit * block.pull[best]), float(unit * np.sqrt(block.spread[best, best]))


def told_from(prior: JointPrior, data: NewerData, limit: float) -> dict[str, np.ndarray]:
    """Per link, how far (n,) each of its parameters has to move by itself, all else at rest, for
    `tests` to tell it with a chance of `POWER`, by that of the whole link or, of members, by its
    own; infinite where the data never do.

    A move of size x along a parameter makes the statistic of a test non-central, by x^2 times what
    the pull's answer to a unit has of its own covariance (Baarda 1968: internal reliability).

    Args:
        prior, data: as of `tests`.
        limit: p-value from which on a link has moved.
    """
    unit, blocks, found = np.sqrt(np.diag(prior.covariance)), blocks_of(prior.held), {}
    for v, block in _pulls(prior, data):
        if v.of_members and v.dim > 1:
            share = limit / len(TESTS_OF_MEMBERS)
            least = np.minimum(block.seen_from(share), block.seen_from_alone(share))
        else:
            least = block.seen_from(limit)
        found[v.name] = unit[blocks[v.name]] * least
    return found


def left_by_moves(prior: JointPrior, data: NewerData) -> np.ndarray:
    """By how much (P,) each parameter is off, in its sigmas now, for a unit of a move of its own
    that nobody tells: the earlier value holds it, or what goes along with it draws it the other way
    (external reliability: Baarda 1968)."""
    now, scale = data.fitted(prior), np.sqrt(np.diag(prior.covariance))
    both = np.outer(scale, scale)
    held = (now.graph / both) @ np.linalg.inv(prior.covariance / both)
    return np.abs(np.diag(held)) / np.sqrt(np.diag(now.covariance))


class _Pull(NamedTuple):
    """How the prior pulls at a link, as of `Force`: a pull (n,) ~ N(0, spread) where nothing moved,
    how it answers to moves, and the weight of the prior there (n, n)."""

    pull: np.ndarray
    answer: np.ndarray
    spread: np.ndarray
    weight: np.ndarray

    @property
    def statistic(self) -> tuple[float, int]:
        """That of the test, and its degrees of freedom."""
        unit = self._units()
        return float(np.square(unit @ self.pull).sum()), len(unit)

    @property
    def p_value(self) -> float | None:
        """Of the test; None where nothing but the prior holds the link."""
        statistic, dof = self.statistic
        return float(chdtrc(dof, statistic)) if dof else None

    @property
    def each(self) -> tuple[np.ndarray, np.ndarray]:
        """(n,) those of tests of each parameter by itself, of one degree of freedom, and (n,)
        whether anything but the prior holds it; 0 where nothing does."""
        spread, told = np.diag(self.spread), self._told_alone
        return np.divide(np.square(self.pull), spread, out=np.zeros(len(told)), where=told), told

    @property
    def mean(self) -> _Pull:
        """At the mean of all parameters."""
        of_all = np.ones((1, len(self.pull)))
        return _Pull(of_all @ self.pull, *(of_all @ m @ of_all.T for m in self[1:]))

    def seen_from(self, limit: float) -> np.ndarray:
        """How far (n,) a parameter has to move for the test to tell it; see `told_from`."""
        unit = self._units()
        return self._enough(np.square(unit @ self.answer).sum(axis=0), len(unit), limit)

    def seen_from_alone(self, limit: float) -> np.ndarray:
        """The same of tests of each parameter by itself, which share the limit."""
        told, answer = self._told_alone, np.diag(self.answer)
        of_unit = np.divide(
            np.square(answer), np.diag(self.spread), out=np.zeros(len(told)), where=told
        )
        return self._enough(of_unit, int(told.any()), limit / max(1, told.sum()))

    def _enough(self, of_unit: np.ndarray, dof: int, limit: float) -> np.ndarray:
        """How large (n,) a move has to be, where one of a unit makes the statistic of a test of so
        many degrees of freedom non-central by `of_unit` (n,)."""
        shows = of_unit > NEVER * np.diag(self.weight)
        if not (dof and shows.any()):
            return np.full(len(of_unit), np.inf)
        enough = chndtrinc(chdtri(dof, limit), dof, 1.0 - POWER)
        ratio = np.divide(enough, of_unit, out=np.full(len(of_unit), np.inf), where=shows)
        return np.sqrt(ratio)

    @property
    def _told_alone(self) -> np.ndarray:
        return np.diag(self.spread) > (1.0 - LEFT_VARIANCE) * np.diag(self.weight)

    def _units(self) -> np.ndarray:
        """(m, n) that makes it unit noise, along the axes that anything but the prior holds."""
        root = np.linalg.inv(np.linalg.cholesky(self.weight))
        told, axes = eigh(root @ self.spread @ root.T)
        use = told > 1.0 - LEFT_VARIANCE
        return (axes.T @ root)[use] / np.sqrt(told[use, None])


def _pulls(prior: JointPrior, data: NewerData) -> Iterator[tuple[Unknown, _Pull]]:
    """Every link, and how the prior pulls at it."""
    force, blocks = Force.of(prior, data), blocks_of(prior.held)
    for v in prior.held:
        k = blocks[v.name]
        whole = (force.answer[k, k], force.spread[k, k], force.weight[k, k])
        yield v, _Pull(force.pull[k], *whole)


def blocks_of(variables: Sequence[Unknown]) -> dict[str, slice]:
    """Name -> where each stands among the tangents of all."""
    ends = np.cumsum([v.dim for v in variables])
    return {v.name: slice(end - v.dim, end) for v, end in zip(variables, ends, strict=True)}
