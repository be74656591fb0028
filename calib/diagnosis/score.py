"""The score (Lagrange multiplier) test of effects that a model does not have.

One fit serves all candidates: their columns are projected off everything that the model estimates,
stops' poses and surfaces' errors included, and what is left of the residual along them is the score
``s``, with information ``I`` (Rao 1948). The statistic ``s' I^-1 s`` is what the effect would
explain. How large it gets by chance is judged from clusters of rows, not rows: the score's
covariance ``V`` is the sum over stops plus that over surfaces less that over both (Cameron, Gelbach
and Miller 2011). The statistic is then near ``a F(nu, d)`` whose a and nu match its mean and
variance (Satterthwaite; Rao and Scott 1984). As V is never inverted, an effect may have more
parameters than there are clusters. Few clusters tell V badly: it is moderated towards what all
candidates have in common, as Smyth (2004) does for variances.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import optimize, special, stats
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import csr_array

from calib.diagnosis.linear import Linear

GAUGE = 1e-6  # share of a direction's information that is left, below which there is none
UNFELT = 1e-9  # of an effect's largest column, below which no row feels a parameter
COMMON = 30.0  # how many clusters the candidates' common inflation counts for
POWER = 0.8  # with which an effect of the smallest detectable size is found
DRAWS = 1999


@dataclass(frozen=True)
class Scores:
    """Scores of the Q parameters of some candidates.

    Args:
        at: candidate -> its columns.
        score: (Q,).
        information: (Q, Q) left after projection.
        whole: (Q, Q) before it.
        by_stop: (K, Q) and by_place (M, Q): shares of the score.
        both: (Q, Q) sum of squares over the cells of stop and place.
        weight_m2: of all beams, 1/m2.
    """

    at: Mapping[str, slice]
    score: np.ndarray
    information: np.ndarray
    whole: np.ndarray
    by_stop: np.ndarray
    by_place: np.ndarray
    both: np.ndarray
    weight_m2: float

    @cached_property
    def draws(self) -> np.ndarray:
        """Scores (R, Q) as chance might have dealt them: every cluster's share, times a normal
        number of its own (the multiplier bootstrap)."""
        shares = np.vstack([self.by_stop, self.by_place])
        return np.random.default_rng(0).standard_normal((DRAWS, len(shares))) @ shares


def away_from_model(linear: Linear, names: Sequence[str]) -> np.ndarray:
    """Directions (U, Q) of variables, be they candidates or of the model itself, with all that the
    model can take on of them taken off; other candidates play no part."""
    theirs = _columns(linear, names)
    apart = _columns(linear, [*linear.candidates, *names])
    model = np.setdiff1d(np.arange(len(linear.information)), apart)
    scale = np.sqrt(np.maximum(np.diag(linear.information), 1e-300))
    root = linear.information[np.ix_(model, model)] / np.outer(scale[model], scale[model])
    cross = linear.information[np.ix_(model, theirs)] / scale[model, None]
    away = np.zeros((len(linear.information), len(theirs)))
    away[theirs] = np.eye(len(theirs))
    away[model] = -cho_solve(cho_factor(root + 1e-13 * np.eye(len(model))), cross)
    away[model] /= scale[model, None]
    return away


def information_left(linear: Linear, names: Sequence[str], away: np.ndarray) -> np.ndarray:
    """Information (Q, Q) of variables along their directions `away` from the model."""
    left = linear.information[_columns(linear, names)] @ away
    return (left + left.T) / 2


def project(linear: Linear, names: Sequence[str]) -> Scores:
    """Project variables off the model, be they candidates or of the model itself."""
    at, start = {}, 0
    for name in names:
        size = linear.at[name].stop - linear.at[name].start
        at[name], start = slice(start, start + size), start + size
    theirs, away = _columns(linear, names), away_from_model(linear, names)
    cells = linear.gradient @ away
    both = cells[(linear.stop >= 0) & (linear.place >= 0)]
    return Scores(
        at,
        cells.sum(axis=0),
        information_left(linear, names, away),
        linear.information[np.ix_(theirs, theirs)],
        _sums(cells, linear.stop),
        _sums(cells, linear.place),
        both.T @ both,
        linear.weight_m2,
    )


def _columns(linear: Linear, names: Sequence[str]) -> np.ndarray:
    return np.concatenate([np.r_[linear.at[name]] for name in names])


def _sums(cells: np.ndarray, index: np.ndarray) -> np.ndarray:
    used = np.flatnonzero(index >= 0)
    shape = (int(index.max(initial=-1)) + 1, len(index))
    return csr_array((np.ones(len(used)), (index[used], used)), shape=shape) @ cells


@dataclass(frozen=True)
class Test:
    """One candidate's test; see the module.

    Args:
        columns: (q,) of its parameters among the scores.
        statistic: what it would explain, in squared sigmas.
        whiten: (q, r), ``whiten @ whiten.T`` the inverse of the information; r is in how many
            directions the data could show it, 0 for a gauge.
        covariance: (r, r) of the whitened score, by clusters.
        clusters: c, how many stops have a share in it.
        score: (q,).
    """

    columns: np.ndarray
    statistic: float
    whiten: np.ndarray
    covariance: np.ndarray
    clusters: int
    score: np.ndarray

    @property
    def dof(self) -> int:
        return self.whiten.shape[1]

    @cached_property
    def inflation(self) -> float:
        """How much wider its score scatters than independent rows of their sigmas would."""
        return float(np.trace(self.covariance)) / self.dof

    def moderated(self, common: float) -> np.ndarray:
        """Covariance (r, r) of the whitened score, leaning on the candidates' `common` one."""
        own = self.clusters * self.covariance + COMMON * common * np.eye(self.dof)
        return own / (self.clusters + COMMON)

    def p_value(self, common: float, statistic: float | None = None) -> float:
        """How often chance alone explains as much."""
        first, nu = self._moments(common)
        d = max(1.0, self.clusters - 1.0 + COMMON)
        value = self.statistic if statistic is None else statistic
        return float(stats.f.sf(value / first, nu, d))

    def _moments(self, common: float) -> tuple[float, float]:
        """Mean of the statistic under the null, and its effective degrees of freedom."""
        spread = self.moderated(common)
        first, second = float(np.trace(spread)), float(np.sum(np.square(spread)))
        return first, first**2 / second

    def evidence(self, common: float) -> float:
        """Minus the log of the p-value were rows independent but for the common inflation: ranks
        what candidates explain, at a price for their parameters."""
        return -log_tail(self.statistic / max(common, 1e-300), self.dof)

    def estimate(self) -> np.ndarray:
        """Parameters (q,) after one step; 0 along gauges."""
        return self.whiten @ (self.whiten.T @ self.score)

    def sigma(self, common: float) -> np.ndarray:
        """Of the estimate (q,), by clusters."""
        W = self.whiten
        return np.sqrt(np.einsum("qr,rs,qs->q", W, self.moderated(common), W))

    def smallest_detectable(self, common: float, alpha: float) -> float:
        """Root mean square of its parameters' size at which it is found with 80 % power.

        For several parameters on average over directions. Infinite for a gauge.
        """
        if not self.dof:
            return np.inf
        first, nu = self._moments(common)
        d = max(1.0, self.clusters - 1.0 + COMMON)
        limit = stats.f.isf(alpha, nu, d)

        def missing(log_size: float) -> float:
            return float(stats.ncf.sf(limit, nu, d, np.exp(log_size))) - POWER

        noncentral = np.exp(optimize.brentq(missing, np.log(0.1), np.log(1e5)))
        # Along a direction of unit length the information is this much, on average.
        each = np.trace(np.linalg.pinv(self.whiten @ self.whiten.T)) / len(self.score)
        return float(np.sqrt(noncentral * first / nu / each))


def log_tail(x: float, q: float) -> float:
    """Log of the upper tail of chi-square with q degrees of freedom, however far out."""
    found = float(stats.chi2.logsf(x, q))
    if np.isfinite(found):
        return found
    half = x / 2
    return float((q / 2 - 1) * np.log(half) - half - special.gammaln(q / 2))


def test(scores: Scores, columns: np.ndarray) -> Test:
    """Test the candidate of these columns."""
    size = np.sqrt(np.maximum(np.diag(scores.whole)[columns], 0.0))
    size = np.where(size > UNFELT * size.max(initial=0.0), size, np.inf)
    block = scores.information[np.ix_(columns, columns)]
    values, axes = np.linalg.eigh(block / np.outer(size, size))
    seen = values > GAUGE
    whiten = (axes[:, seen] / np.sqrt(values[seen])) / size[:, None]
    score = scores.score[columns]
    statistic = float(np.sum(np.square(whiten.T @ score)))
    stop, place = (part[:, columns] @ whiten for part in (scores.by_stop, scores.by_place))
    both = whiten.T @ scores.both[np.ix_(columns, columns)] @ whiten
    one_way = stop.T @ stop, place.T @ place
    two_way = one_way[0] + one_way[1] - both
    covariance = max(two_way, *one_way, key=np.trace)
    clusters = int((np.abs(stop).max(axis=1, initial=0.0) > 0).sum())
    return Test(columns, statistic, whiten, covariance, clusters, score)
