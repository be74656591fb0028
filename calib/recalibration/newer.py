"""What newer data alone say of all that an earlier run knew, and the tests of each link."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.special import chdtrc

from calib.problem.prior import JointPrior
from calib.problem.unknowns import Unknown

# Of the earlier variance left: less than that, and the new data say something. A choice: they took
# 5 % off the earlier sigma.
LEFT_VARIANCE = 0.9
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
    force, blocks, found = Force.of(prior, data), blocks_of(prior.held), {}
    for v in prior.held:
        k = blocks[v.name]
        block = force.pull[k], force.spread[k, k], force.weight[k, k]
        found[v.name] = _test(*block)
        if v.of_members and v.dim > 1:
            of_all = np.ones((1, v.dim))
            mean = _test(of_all @ block[0], *(of_all @ each @ of_all.T for each in block[1:]))
            single = [p for p in map(_test, *map(_singly, block)) if p is not None]
            least = min(single) * len(single) if single else None
            several = [p for p in (found[v.name], mean, least) if p is not None]
            found[v.name] = min(1.0, len(TESTS_OF_MEMBERS) * min(several)) if several else None
    return found


def _test(pull: np.ndarray, spread: np.ndarray, weight: np.ndarray) -> float | None:
    """The p-value of a pull ~ N(0, spread), along the axes that anything but the prior holds."""
    root = np.linalg.inv(np.linalg.cholesky(weight))
    told, axes = np.linalg.eigh(root @ spread @ root.T)
    use = told > 1.0 - LEFT_VARIANCE
    if not use.any():
        return None
    statistic = float((np.square(axes.T @ root @ pull)[use] / told[use]).sum())
    return float(chdtrc(use.sum(), statistic))


def _singly(block: np.ndarray) -> np.ndarray:
    """Of a pull (P,) or its covariance (P, P), that of each alone: (P, 1) or (P, 1, 1)."""
    return block[:, None] if block.ndim == 1 else np.diagonal(block)[:, None, None]


def blocks_of(variables: Sequence[Unknown]) -> dict[str, slice]:
    """Name -> where each stands among the tangents of all."""
    ends = np.cumsum([v.dim for v in variables])
    return {v.name: slice(end - v.dim, end) for v, end in zip(variables, ends, strict=True)}
