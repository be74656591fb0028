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
from scipy import special
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import csr_array

from calib.blunders.chance import log_tail
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
        both: (C, Q) shares of the cells of stop and place.
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
    def shares(self) -> tuple[np.ndarray, ...]:
        """By stop, by place, and by both, of those that have any."""
        every = (self.by_stop, self.by_place, self.both)
        return tuple(part[np.any(part != 0, axis=1)] for part in every)

    @cached_property
    def draws(self) -> np.ndarray:
        """Scores (R, Q) as chance might have dealt them: every cluster's share, times a normal
        number of its own (the multiplier bootstrap)."""
        shares = np.vstack([self.by_stop, self.by_place])
        return np.random.default_rng(0).standard_normal((DRAWS, len(shares))) @ shares


def projection(linear: Linear, names: Sequence[str]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Variables, be they candidates or of the model itself, projected off all that the model can
    take on; other candidates play no part.

    Returns:
        Columns of the variables (Q,) and of the model's unknowns (M,), and how much of each of
        these (M, Q) is to be taken off.
    """
    theirs = linear.among(names)
    apart = linear.among([*linear.candidates, *names])
    model = np.setdiff1d(np.arange(len(linear.information)), apart)
    block = linear.information[np.ix_(model, model)]
    scale = np.sqrt(np.maximum(np.diag(block), 1e-300))
    root = block / np.outer(scale, scale) + 1e-13 * np.eye(len(model))
    cross = linear.information[np.ix_(model, theirs)] / scale[:, None]
    return theirs, model, cho_solve(cho_factor(root), cross) / scale[:, None]


def away_from_model(linear: Linear, names: Sequence[str]) -> np.ndarray:
    """Directions (U, Q) of variables with all that the model can take on of them taken off, stops'
    poses and surfaces' errors included."""
    theirs, model, taken = projection(linear, names)
    kept = np.zeros((len(linear.information), len(theirs)))
    kept[theirs], kept[model] = np.eye(len(theirs)), -taken
    return linear.directions(kept)


def information_left(linear: Linear, names: Sequence[str]) -> np.ndarray:
    """Information (Q, Q) that is left of variables once projected."""
    theirs, model, taken = projection(linear, names)
    left = linear.information[np.ix_(theirs, theirs)]
    left = left - linear.information[np.ix_(theirs, model)] @ taken
    return (left + left.T) / 2


def project(linear: Linear, names: Sequence[str]) -> Scores:
    """Project variables off the model, be they candidates or of the model itself."""
    at, start = {}, 0
    for name in names:
        size = len(linear.at[name])
        at[name], start = slice(start, start + size), start + size
    theirs, away = linear.among(names), away_from_model(linear, names)
    own = np.concatenate([np.r_[linear.columns[name]] for name in names])
    others = np.setdiff1d(np.flatnonzero(np.any(away != 0, axis=1)), own)
    cells = linear.gradient[:, own].toarray() + linear.gradient[:, others] @ away[others]
    return Scores(
        at=at,
        score=cells.sum(axis=0),
        information=information_left(linear, names),
        whole=linear.raw[np.ix_(theirs, theirs)],
        by_stop=_sums(cells, linear.stop),
        by_place=_sums(cells, linear.place),
        both=cells[(linear.stop >= 0) & (linear.place >= 0)],
        weight_m2=linear.weight_m2,
    )


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
        return float(special.fdtrc(nu, d, value / first))

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
        # The covariance is a difference (by stops, by places, less both): it may dip below 0.
        return np.sqrt(np.maximum(np.einsum("qr,rs,qs->q", W, self.moderated(common), W), 0.0))

    def smallest_detectable(self, common: float, alpha: float) -> float:
        """Root mean square of its parameters' size at which it is found with 80 % power.

        For several parameters on average over directions. Infinite for a gauge.
        """
        if not self.dof:
            return np.inf
        first, nu = self._moments(common)
        d = max(1.0, self.clusters - 1.0 + COMMON)
        limit = special.fdtri(nu, d, 1.0 - alpha)
        noncentral = special.ncfdtrinc(nu, d, 1.0 - POWER, limit)
        # Along a direction of unit length the information is this much, on average.
        each = np.trace(np.linalg.pinv(self.whiten @ self.whiten.T)) / len(self.score)
        return float(np.sqrt(noncentral * first / nu / each))


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
    stop, place, both = (part[:, columns] @ whiten for part in scores.shares)
    one_way = stop.T @ stop, place.T @ place
    two_way = one_way[0] + one_way[1] - both.T @ both
    covariance = max(two_way, *one_way, key=np.trace)
    clusters = int((np.abs(stop).max(axis=1, initial=0.0) > 0).sum())
    return Test(
        columns=columns,
        statistic=statistic,
        whiten=whiten,
        covariance=covariance,
        clusters=clusters,
        score=score,
    )
