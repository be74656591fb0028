"""How far a candidate's score goes by chance, told from clusters of rows that err together.

The rows fall into clusters in two ways: by stop and by surface. A row of no stop (a surface's own
error) is a cluster of that surface among the stops, and the other way round. With ``s_c`` a
cluster's share of the whitened score ``s = sum s_c`` of r parameters, the score's covariance is
``V = V_stop + max(V_surface - V_both, 0)`` (Cameron, Gelbach and Miller 2011): stops count in full,
and what surfaces share between stops comes on top. The statistic ``s's`` over the trace of V is
near ``F(nu, d)`` (the ANOVA-type statistic: Box 1954; Brunner, Dette and Munk 1997). V is never
inverted, so there may be more parameters than clusters. There are two ways to V and d:

- **By signs**, from the scores alone. Where nothing is missing every stop's score might as well
  have the other sign. ``E = sum |s_c|^2`` and ``sum (s_c's_d)^2`` over pairs of different clusters
  are the mean and half the variance of the statistic over all signs: the restricted wild bootstrap
  of scores (Cameron, Gelbach and Miller 2008) in closed form, as Box and Andersen (1955) have it
  for permutations. Then ``V = (sum s_c s_c' - s s'/c) c / (c - 1)``, nu matches that variance (by
  stops or, where surfaces add to V, by surfaces if that leaves less), and ``d = (n - 1) nu``, n the
  number of stops or of surfaces, whichever is smaller. It holds however clusters err, and however
  uneven they are; but an effect that few stops show cannot be significant, as few signs often agree
  by chance.
- **By leaving out** cluster after cluster, which needs the information ``I_c`` of each, thus one
  more pass over the rows, for one candidate. Each cluster is compared with what the others predict:
  ``(1 - I_c)^-1 (s_c - I_c s)`` (the cluster jackknife CV3 of MacKinnon, Nielsen and Webb 2022), so
  a true effect widens nothing. Where the I_c are those of drawn beams, it widens V a little (see
  `DRAWN_NUMBERS` in `linear`). The degrees of freedom of either way come from the I_c, as Bell and
  McCaffrey (2002) have it, were the rows of a cluster to err as one; those of the sum are
  Satterthwaite's. A cluster that alone holds a direction leaves nothing to compare it with: the
  variance there is infinite. Clusters fewer than two for each parameter that one of them tells as
  one (the sum of the largest eigenvalues of the I_c) tell nothing: parameters fit their errors.

Where few clusters hold most of the information, few degrees of freedom are left, however well all
others agree. Then the others are asked by themselves, in the second way: those without the cluster
that holds most, without the next, and so on, which would find the smallest effect (`judges`).
Information alone decides which they are; their p-value is doubled, as it hardly depends on that of
all. They count only where the clusters left out agree with them, to a quarter or by chance: an
error of such a cluster moves the model, and by that all others alike. Or all clusters are asked
about some directions, those of which none holds more than a share: of the zeros of rings, say, of
which many meet one wall alone. Of both the one counts that would find the smallest effect.

A limit, of signs as well: with 17 unknowns that all stops share, and one stop that holds half of
the information or more and errs by ten of a row's sigmas, 0.5 to 0.9 of empty worlds show something
(family "one stop, it errs, wide model", 1 and 4 parameters, 12 to 30 stops). In a recording such a
stop is a blunder, which is left out before.

The smaller of both p-values counts: where nothing is missing the second is hardly ever the smaller,
but for a single parameter, where both are nearly the same. Measured by `tests/bench/bench_size.py`
at a nominal 0.05, with 1, 4, 16 and 64 parameters and 6 to 60 stops, 240 draws each: where rows err
alone, stops err together by up to three times a row's sigma, stops and surfaces do by half of it,
three stops show most of the effect, or it acts within stops only, 0.02 to 0.07 of empty worlds
show something, stops averaged over (0.12 in the worst of 240 cases); none, where parameters that
act by stop are as many as the stops. A limit: 0.13 with few stops where surfaces err by three times
a row's sigma and the model does not know it. An effect of 10 sigmas is found at 0.001 in 0.7 of
worlds where three of thirty stops show most of it, in 0.9 where two of 25 surfaces do, and by signs
alone in none; one of 30 sigmas over 16 parameters, of which two surfaces alone show eight, in all.

A model that itself has unknowns which differ by stop alone, a drift say, fits a part of what stops
err by, and residuals scatter less than errors. With n stops and k such unknowns, covariances by
stop are widened by ``(n - 1) / (n - 1 - k)``, and k fewer stops count in d. With three of them, 6
to 60 stops and 1 to 64 parameters, the sizes are then 0.00 to 0.08 (the benchmark's family "model
by stop", 240 draws each). Not counted, they were up to 0.75, with 16 parameters and 8 stops.

What was compared and left, on the same rows: leaving out with ``d nu`` in place of d and no least
number of clusters finds something in 0.1 to 1.0 of empty worlds where stops err together and 4 or
more parameters act by stop, as the I_c know nothing of such errors. Draws of the restricted wild
bootstrap by stops, studentised, with Webb's weights, are as good for one parameter and too bold for
4 to 64 with few stops (0.1 to 1.0); they see no surfaces; and their least p-value is one over their
number.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple, Self

import numpy as np
from scipy import special

from calib.linear.cluster_sums import ALONE
from calib.linear.clusters import summed
from calib.linear.layout import positions
from calib.linear.symmetric import eigh

UNKNOWN_VARIANCE = 1e12  # variance, of a whitened score, where nothing tells it
# Least stops, or surfaces, for each parameter that one of these tells as one. Measured in the
# benchmark: with fewer, 0.1 to 1.0 of empty worlds where stops err show something; else below 0.1.
PER_PARAMETER = 2
ROUNDED_UP = 1.0 + 1e-6  # shares of two surfaces in one parameter add up to 1, but for rounding
TRIFLING = 1e-9  # of a direction's information, below which a cluster holds none
SLIGHT_SHARE = 0.05  # of a direction's information: the others predict a cluster with less to 5 %


@dataclass(frozen=True)
class ScoreSpread:
    """How a whitened score scatters where nothing is missing.

    Args:
        covariance: (r, r) of the score.
        nu, d: degrees of freedom of the statistic over the covariance's trace.
        clusters: how many even clusters would tell as much of the covariance.
        ratio: of the statistic to that trace, where not all clusters judge it.
        share: of the information, that these clusters hold.
    """

    covariance: np.ndarray
    nu: float
    d: float
    clusters: float
    ratio: float | None = None
    share: float = 1.0

    @property
    def trace(self) -> float:
        return float(np.trace(self.covariance))

    @property
    def looks(self) -> int:
        """How many tests are paid for: one by some clusters hardly depends on that by all."""
        return 1 if self.ratio is None else 2

    def over(self, statistic: float) -> float:
        """The statistic over its trace."""
        return statistic / max(self.trace, 1e-300) if self.ratio is None else self.ratio

    def p_value(self, statistic: float) -> float:
        """How often chance alone makes as large a statistic; always, where nothing tells."""
        if self.d <= 0.0:
            return 1.0
        p = float(special.fdtrc(self.nu, self.d, self.over(statistic)))
        return min(self.looks * p, 1.0)


def by_signs(ways: Sequence[np.ndarray], stops: int, spent: int = 0) -> ScoreSpread:
    """Chance from the scores alone; see the module.

    Args:
        ways: shares (c, r) of the whitened score by stop and, where stops share surfaces, by
            surface, and by both.
        stops: how many stops have a share in it; one tells nothing.
        spent: how many unknowns of the model differ by stop alone.
    """
    whole = [ShareSquares.each_of(shares, [shares.shape[1]]) for shares in ways]
    return spread_by([squares for (squares,) in whole], stops, spent)


def spread_by(ways: Sequence[ShareSquares], stops: int, spent: int = 0) -> ScoreSpread:
    """The same from sums of the shares by each way."""
    by_stop, *others = (squares.covariance() for squares in ways)
    more = _beyond(*others) if others else np.zeros_like(by_stop)
    count = max(min([stops, *(squares.count for squares in ways[1:2])]), 1)
    nu = ways[0].freedom(count)
    if np.trace(more) > 0.0:
        nu = min(nu, ways[1].freedom(ways[1].count))
    size = ways[0].each
    # Were scores normal, their squares would scatter by 2 / nu.
    even = size.sum() ** 2 / max(np.square(size).sum(), 1e-300) * (1.0 + 2.0 / nu)
    left = max(count - 1.0 - spent, 0.0)
    by_stop = by_stop * _widened(count, spent)
    return ScoreSpread(by_stop + more, nu, left * nu, min(float(count), float(even)))


def _widened(count: int, spent: int) -> float:
    """How much wider scores of stops scatter than residuals show, where a model has spent so many
    unknowns on stops."""
    return (count - 1.0) / max(count - 1.0 - spent, 1.0) if spent else 1.0


class ShareSquares(NamedTuple):
    """What chance is told from of shares (c, r) of a score.

    Args:
        sum: (r,) of them.
        each: (c,) the sum of squares of each.
        products: (r, r) of all of them.
    """

    sum: np.ndarray
    each: np.ndarray
    products: np.ndarray

    @classmethod
    def each_of(cls, shares: np.ndarray, ends: Sequence[int]) -> list[Self]:
        """Of consecutive columns of shares (c, R), which end there (n,)."""
        total, products = shares.sum(axis=0), shares.T @ shares
        parts = [slice(*pair) for pair in pairwise([0, *ends])]
        return [cls(total[at], squares_of(shares[:, at]), products[at, at]) for at in parts]

    @property
    def count(self) -> int:
        return len(self.each)

    def freedom(self, count: int) -> float:
        """Degrees of freedom of the square of the sum, by pairs of different clusters; so many of
        them tell it."""
        pairs = np.square(self.products).sum() - np.square(self.each).sum()
        alike = max(float(pairs / max(self.each.sum() ** 2, 1e-300)), 1e-9)
        return max((1.0 - 1.0 / count) / alike - 2.0 / count, 0.5)

    def covariance(self) -> np.ndarray:
        """Covariance (r, r) of the sum, an even part of it taken off each."""
        n = self.count
        if n < 2:
            return UNKNOWN_VARIANCE * np.eye(len(self.sum))
        return (self.products - np.outer(self.sum, self.sum) / n) * n / (n - 1)


def squares_of(rows: np.ndarray) -> np.ndarray:
    """The sum of squares (c,) of each row (c, r)."""
    return np.einsum("ij,ij->i", rows, rows)


def _beyond(by_place: np.ndarray, both: np.ndarray) -> np.ndarray:
    """What surfaces that err alike at all stops add to a covariance by stops."""
    more = by_place - both
    return more if np.trace(more) > 0.0 else np.zeros_like(more)


@dataclass(frozen=True)
class Clusters:
    """What can be said of clusters of rows before their scores are known.

    Args:
        rows: (N, r) of the whitened score, or others of the same information; ``rows.T @ rows``, of
            all of them, is 1.
        at: (N,) of which cluster each is.
        size: how many clusters there are.
        count: how many are stops, in the way by stops, or surfaces.
    """

    rows: np.ndarray = field(repr=False)
    at: np.ndarray = field(repr=False)
    size: int
    count: int

    @cached_property
    def trace(self) -> np.ndarray:
        """(c,) of the information of each, which is no less than that along any direction."""
        return np.bincount(self.at, squares_of(self.rows), self.size)

    @cached_property
    def information(self) -> np.ndarray:
        """(h, r, r) of those that hold any."""
        return self._of(self._holding)

    @cached_property
    def _holding(self) -> np.ndarray:
        return np.flatnonzero(self.trace > TRIFLING)

    def _of(self, some: np.ndarray) -> np.ndarray:
        """Information (n, r, r) of some clusters."""
        number = positions(self.size, some)[self.at]
        order = np.argsort(number, kind="stable")
        ends = np.searchsorted(number[order], np.arange(len(some) + 1))
        parts = (self.rows[order[i:k]] for i, k in pairwise(ends))
        out = np.empty((len(some), *2 * self.rows.shape[1:]))
        for each, rows in zip(out, parts, strict=True):
            each[:] = rows.T @ rows
        return out

    @cached_property
    def apart(self) -> dict[int, np.ndarray]:
        """Cluster -> ``(1 - I)^-1`` (r, r), where that is not nearly 1."""
        return {c: inverse for c, inverse, _ in self._predicted}

    @cached_property
    def alone(self) -> np.ndarray:
        """Variance (r, r) in directions that one cluster alone holds."""
        out = np.zeros(2 * self.rows.shape[1:])
        for _, _, lonely in self._predicted:
            out += UNKNOWN_VARIANCE * lonely @ lonely.T
        return out

    @cached_property
    def _predicted(self) -> list[tuple[int, np.ndarray, np.ndarray]]:
        """Of clusters that others do not predict nearly, each with the inverse of what they miss,
        and the directions (r, h) that it alone holds."""
        some = np.flatnonzero(self.trace > SLIGHT_SHARE)
        out, one = [], np.eye(self.rows.shape[1])
        for c, information in zip(some.tolist(), self._of(some), strict=True):
            norm = np.linalg.norm(information)  # no less than the largest eigenvalue
            if norm <= SLIGHT_SHARE:
                continue
            if norm < ALONE:
                out.append((c, np.linalg.inv(one - information), one[:, :0]))
                continue
            values, axes = eigh(information)
            inverse = (axes / (1.0 - np.clip(values, 0.0, ALONE))) @ axes.T
            out.append((c, inverse, axes[:, values > ALONE]))
        return out

    @cached_property
    def d(self) -> float:
        """Degrees of freedom of the covariance's trace, were each cluster's rows to err as one."""
        variance = self.information.copy()  # I (1 - I)^-1, of what each is compared by
        number = positions(self.size, self._holding)
        for c, inverse in self.apart.items():
            variance[number[c]] = variance[number[c]] @ inverse
        common = variance @ variance  # of two clusters: minus I (1 - I)^-1 of one by the other's
        among = np.square(common.sum(axis=0)).sum() - np.square(common).sum()
        size = np.trace(variance, axis1=1, axis2=2)
        return float(size.sum() ** 2 / max(np.square(size).sum() + among, 1e-300))

    @cached_property
    def crowded(self) -> bool:
        """Whether they are too few for the parameters that each of them tells as one: these then
        fit what the clusters err by, and nothing is left of it."""
        bound = np.linalg.norm(self.information, axis=(1, 2)).sum()  # of the largest eigenvalues
        enough = self.count * ROUNDED_UP
        if PER_PARAMETER * bound <= enough:
            return False
        return PER_PARAMETER * np.linalg.eigvalsh(self.information)[:, -1].sum() > enough

    def covariance(self, score: np.ndarray) -> np.ndarray:
        """Covariance (r, r) of the sum of scores (c, r), each compared with what others predict."""
        told = self.rows * (self.rows @ score.sum(axis=0))[:, None]
        beyond = score - summed(told, self.at, self.size)
        for c, inverse in self.apart.items():
            beyond[c] = inverse @ beyond[c]
        return beyond.T @ beyond + self.alone


def by_leaving_out(
    ways: Sequence[Clusters], scores: Sequence[np.ndarray], nu: float, spent: int = 0
) -> ScoreSpread:
    """Chance from clusters and their scores (c, r), by stop, by surface, and by both; the model has
    spent so many unknowns on stops alone."""
    by_stop, by_place, both = (w.covariance(s) for w, s in zip(ways, scores, strict=True))
    if ways[0].crowded or ways[1].crowded:
        by_stop = UNKNOWN_VARIANCE * np.eye(len(by_stop))
    more = _beyond(by_place, both)
    by_stop = by_stop * _widened(ways[0].count, spent)
    parts, of_stops = np.array([np.trace(by_stop), np.trace(more)]), max(ways[0].d - spent, 1.0)
    d = parts.sum() ** 2 / max(float(np.sum(parts**2 / [of_stops, ways[1].d])), 1e-300)
    return ScoreSpread(by_stop + more, nu, float(d), float(d) + 1.0)
