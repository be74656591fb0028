"""The score (Lagrange multiplier) test of effects that a model does not have.

One fit serves all candidates: their columns are projected off everything that the model estimates,
stops' poses and surfaces' errors included, and what is left of the residual along them is the score
``s``, with information ``I`` (Rao 1948). The statistic ``s' I^-1 s`` is what the effect would
explain. How large it gets by chance is estimated from clusters of rows, not rows: see `jackknife`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import special
from scipy.linalg import block_diag, cho_factor, cho_solve

from calib.blunders.chance import at_least, enough, log_tail
from calib.diagnosis.jackknife import ScoreSpread, ShareSquares, spread_by
from calib.diagnosis.judges import Shares
from calib.diagnosis.linear import NONE, Linear
from calib.linear.clusters import summed
from calib.linear.symmetric import eigh, pinv
from calib.problem.unknowns import Owner

GAUGE = 1e-6  # share of a direction's information that is left, below which there is none
UNFELT = 1e-9  # of an effect's largest column, below which no row feels a parameter
CLUSTERS = 4096  # that are projected at once: bounds the memory
SCORE_DRAWS = 1999  # of chance: 100 of them are beyond 5 %, where looks are counted, so to 10 %


@dataclass(frozen=True)
class Scores:
    """Scores of the Q parameters of some candidates.

    Args:
        at: candidate -> its columns.
        owner: candidate -> whose it is.
        score: (Q,).
        information: (Q, Q) left after projection.
        felt: (Q,) of each alone, before it.
        whole: candidate -> (q, q) of its parameters, before it; empty of formulas.
        cells: (C, Q) shares of the score, of rows of one stop and one place, by
            residuals as large as errors are (`leverage`).
        stop, place: (C,) the numbers of these, -1 for none.
        weight_m2: of all beams that are looked at, 1/m2.
        spent: how many unknowns of the model differ by stop alone.
    """

    at: Mapping[str, slice]
    owner: Mapping[str, Owner]
    score: np.ndarray
    information: np.ndarray
    felt: np.ndarray
    whole: Mapping[str, np.ndarray]
    cells: np.ndarray
    stop: np.ndarray
    place: np.ndarray
    weight_m2: float
    spent: int = 0

    def thinned(self) -> Scores:
        """The same without clusters, of which nothing more is asked."""
        return replace(self, cells=self.cells[:0].copy(), stop=NONE, place=NONE)

    def moved(self, columns: np.ndarray, theta: np.ndarray) -> float:
        """Sum of the squares by which parameters (q,) in some columns move all rows, the model's
        part included."""
        every = np.zeros(len(self.score))
        every[columns] = theta
        return sum(float(every[at] @ self.whole[n] @ every[at]) for n, at in self.at.items())

    def told_as(self, columns: np.ndarray, other: Scores, its: np.ndarray) -> Scores:
        """The same, with what all rows tell of some parameters as other scores have it of theirs,
        both given by all columns of as many candidates of the same sizes."""
        mine, theirs = (
            [n for n, at in scores.at.items() if np.isin(np.r_[at], some).any()]
            for scores, some in ((self, columns), (other, its))
        )
        felt = self.felt.copy()
        felt[columns] = other.felt[its]
        blocks = {n: other.whole[m] for n, m in zip(mine, theirs, strict=True)}
        return replace(self, felt=felt, whole={**self.whole, **blocks})

    @cached_property
    def by_stop(self) -> np.ndarray:
        """(K, Q) shares of the score of rows of each stop."""
        return summed(self.cells, self.stop)

    @cached_property
    def by_place(self) -> np.ndarray:
        """(M, Q) shares of the score of rows of each place."""
        return summed(self.cells, self.place)

    def by_both(self, columns: slice) -> np.ndarray:
        """Shares of some columns (n, q) of rows that have a stop and a place, by both."""
        return self.cells[(self.stop >= 0) & (self.place >= 0), columns]

    def ways(self, columns: np.ndarray) -> list[np.ndarray]:
        """Shares of some columns (n, q) by stop and, where any place is met from several stops, by
        place, and by both, of those that have any share of any; each adds up to the score, as rows
        that have no stop, or no place, are clusters of their own."""
        return [part[:, columns][any_share] for part, any_share in self._ways]

    @cached_property
    def _ways(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """The same of all columns, (n, Q) each, and which of these rows (n,) have any share."""
        every = [np.vstack([self.by_stop, self.cells[self.stop < 0]])]
        if np.bincount(self.place[self.place >= 0]).max(initial=0) > 1:
            every += [np.vstack([self.by_place, self.cells[self.place < 0]]), self.cells]
        return [(part, np.any(part, axis=1)) for part in every]

    @cached_property
    def sharing(self) -> int:
        """How many stops have any share of any score, which come first by stop."""
        return int(np.any(self.by_stop, axis=1).sum())

    @cached_property
    def draws(self) -> np.ndarray:
        """Scores (R, Q) as chance might have dealt them: every cluster's share, times a normal
        number of its own (the multiplier bootstrap). In single precision, which is enough."""
        shares = np.vstack([self.by_stop, self.by_place]).astype(np.float32)
        signs = np.random.default_rng(0).standard_normal((SCORE_DRAWS, len(shares)))
        return signs.astype(np.float32) @ shares


def projection(linear: Linear, names: Sequence[str]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Variables, be they candidates or of the model itself, projected off all that the model
    absorbs; other candidates play no part.

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
    """Directions (U, Q) of variables with all that the model absorbs of them taken off, stops'
    poses and surfaces' errors included."""
    theirs, model, taken = projection(linear, names)
    kept = np.zeros((len(linear.information), len(theirs)))
    kept[theirs, np.arange(len(theirs))] = 1.0
    kept[model] = -taken
    return linear.whole.followed(kept)


def information_left(linear: Linear, names: Sequence[str]) -> np.ndarray:
    """Information (Q, Q) that is left of variables once projected."""
    return _left(linear, *projection(linear, names))


def _left(linear: Linear, theirs: np.ndarray, model: np.ndarray, taken: np.ndarray) -> np.ndarray:
    """The same, projected so."""
    left = linear.information[np.ix_(theirs, theirs)]
    left -= linear.information[np.ix_(theirs, model)] @ taken
    left += left.T
    left /= 2.0
    return left


def _projected(
    gradient: np.ndarray, theirs: np.ndarray, model: np.ndarray, taken: np.ndarray
) -> np.ndarray:
    """Gradients (C, Q) of clusters by variables, projected so; some clusters at once, as there may
    be gigabytes of them."""
    out = np.empty((len(gradient), len(theirs)))
    for at in range(0, len(gradient), CLUSTERS):
        some = slice(at, at + CLUSTERS)
        np.subtract(gradient[some, theirs], gradient[some, model] @ taken, out=out[some])
    return out


def project(linear: Linear, names: Sequence[str], spent: int = 0) -> Scores:
    """Project variables off the model, be they candidates or of the model itself; that has spent
    so many unknowns on stops alone."""
    at, start = {}, 0
    for name in names:
        size = len(linear.at[name])
        at[name], start = slice(start, start + size), start + size
    theirs, model, taken = projection(linear, names)
    return Scores(
        at=at,
        owner={name: linear.owner[name] for name in names},
        score=linear.score[theirs] - linear.score[model] @ taken,
        information=_left(linear, theirs, model, taken),
        felt=np.concatenate([np.diag(linear.raw[name]) for name in names]),
        whole={name: linear.raw[name] for name in names},
        cells=_projected(linear.gradient, theirs, model, taken),
        stop=linear.stop,
        place=linear.place,
        weight_m2=linear.weight_m2,
        spent=spent,
    )


@dataclass(frozen=True)
class ScoreTest:
    """One candidate's test; see the module.

    Args:
        columns: (q,) of its parameters among the scores.
        statistic: what it would explain, in squared sigmas.
        whiten: (q, r), ``whiten @ whiten.T`` the inverse of the information; r is in how many
            directions the data could show it, 0 for a gauge.
        chances: how the whitened score scatters by chance: by signs and, once it is judged, by
            leaving out; see `jackknife`.
        clusters: how many stops have a share in it.
        score: (q,).
        spent: how many unknowns of the model differ by stop alone.
    """

    columns: np.ndarray
    statistic: float
    whiten: np.ndarray
    chances: tuple[ScoreSpread, ...]
    clusters: int
    score: np.ndarray
    spent: int = 0

    @property
    def dof(self) -> int:
        return self.whiten.shape[1]

    @cached_property
    def chance(self) -> ScoreSpread:
        """That which counts, as it leaves least to chance; a true effect widens the first."""
        return min(self.chances, key=lambda chance: chance.p_value(self.statistic))

    @cached_property
    def inflation(self) -> float:
        """How much wider its score scatters than independent rows of their sigmas would."""
        return self.chance.trace / self.dof

    def judged(self, shares: Shares, scores: Scores) -> ScoreTest:
        """The same with its clusters left out one by one.

        Args:
            shares: their rows along the whitened directions.
            scores: those that this test was made from.
        """
        if not self.dof:
            return self
        pairs, mine = np.stack([scores.stop, scores.place], axis=1), scores.cells[:, self.columns]
        left_out = shares.left_out(pairs, mine @ self.whiten, self.chances[0].nu, self.spent)
        return replace(self, chances=(*self.chances, *left_out))

    def at(self, own: np.ndarray, shares: Shares, scores: Scores) -> ScoreTest:
        """The same of parameters that were fitted, with clusters left out one by one: these then
        show what is fitted and, as scores, what that leaves.

        Args:
            own: (r,) the parameters, along the whitened directions.
            shares: rows of the clusters along these.
            scores: those that this test was made from.
        """
        told = np.array([(rows @ own) @ rows for rows in shares.rows]).reshape(
            len(shares.rows), len(own)
        )
        pairs = np.stack([scores.stop, scores.place], axis=1)
        pairs = np.concatenate([pairs, np.array(shares.pairs, int).reshape(-1, 2)])
        whole = np.concatenate([scores.cells[:, self.columns] @ self.whiten, told])
        left_out = shares.left_out(pairs, whole, self.chances[0].nu, self.spent)
        score = scores.information[np.ix_(self.columns, self.columns)] @ self.whiten @ own
        return replace(self, statistic=float(own @ own), score=score, chances=left_out)

    def p_value(self) -> float:
        """How often chance alone explains as much."""
        return at_least(self.chance.p_value(self.statistic))

    def evidence(self, common: float) -> float:
        """Minus the log of the p-value were rows independent but for the common inflation. It
        ranks what candidates explain, at a price for their parameters, and decides nothing."""
        return evidence(self.statistic, self.dof, common)

    def estimate(self) -> np.ndarray:
        """Parameters (q,) after one step; 0 along gauges."""
        return self.whiten @ (self.whiten.T @ self.score)

    def sigma(self, common: float) -> np.ndarray:
        """Of the estimate (q,); see `covariance`."""
        return np.sqrt(np.diag(self.covariance(common)))

    def covariance(self, common: float) -> np.ndarray:
        """Of the estimate (q, q), by clusters; no variance is less than with the candidates'
        `common` inflation, as few clusters of a difference of covariances may say anything."""
        W = self.whiten
        own = W @ self.chance.covariance @ W.T
        variance = np.maximum(np.diag(own), common * np.square(W).sum(axis=1))
        wider = np.sqrt(variance / np.maximum(np.diag(own), 1e-300))
        out = own * np.outer(wider, wider)
        out[np.diag_indices(len(out))] = variance
        return out

    def smallest_detectable(self, common: float, alpha: float) -> float:
        """Root mean square of its parameters' size at which it is found with 80 % power, where its
        score scatters as it does here; no less than the candidates' `common` inflation has it.

        For several parameters on average over directions. Infinite for a gauge.
        """
        if not self.dof:
            return np.inf
        # Along a direction of unit length the information is this much, on average.
        each = np.trace(pinv(self.whiten @ self.whiten.T)) / len(self.score)
        return min(self._detectable(chance, common, alpha) for chance in self.chances) / each**0.5

    def _detectable(self, chance: ScoreSpread, common: float, alpha: float) -> float:
        """The same of a whitened parameter, by one of the tests."""
        nu = chance.nu
        d = max(min(chance.d, (chance.clusters - 1.0) * nu), 0.5 * nu)
        limit = special.fdtri(nu, d, 1.0 - alpha / chance.looks)
        scale = max(chance.trace, common * self.dof)
        return float(np.sqrt(enough(nu, d, limit) * scale / nu / chance.share))


def evidence(statistic: float, dof: int, common: float) -> float:
    """As of `ScoreTest.evidence`, of a statistic in so many directions."""
    return -log_tail(statistic / max(common, 1e-300), dof)


def explained(scores: Scores, columns: np.ndarray) -> tuple[np.ndarray, float]:
    """What (q, r) makes the scores of some columns (q,) r independent ones of variance 1; and the
    sum of the squares of these."""
    size = np.sqrt(np.maximum(scores.felt[columns], 0.0))
    size = np.where(size > UNFELT * size.max(initial=0.0), size, np.inf)
    block = scores.information[np.ix_(columns, columns)]
    values, axes = eigh(block / np.outer(size, size))
    seen = values > GAUGE
    whiten = (axes[:, seen] / np.sqrt(values[seen])) / size[:, None]
    return whiten, float(np.sum(np.square(whiten.T @ scores.score[columns])))


def score_test(scores: Scores, columns: np.ndarray) -> ScoreTest:
    """Test the candidate of these columns."""
    return score_tests(scores, [columns])[0]


def score_tests(scores: Scores, sets: Sequence[np.ndarray]) -> list[ScoreTest]:
    """Test candidates, each of some columns (q,), together: so the products are few and large."""
    every = [explained(scores, columns) for columns in sets]
    whiten = block_diag(*(each for each, _ in every))
    ends = np.cumsum([each.shape[1] for each, _ in every]).tolist()
    shares = [way @ whiten for way in scores.ways(np.concatenate(sets))]
    squares, tests = [ShareSquares.each_of(way, ends) for way in shares], []
    for columns, (each, statistic), *ways in zip(sets, every, *squares, strict=True):
        clusters = int(np.count_nonzero(ways[0].each[: scores.sharing]))
        tests.append(
            ScoreTest(
                columns=columns,
                statistic=statistic,
                whiten=each,
                chances=(spread_by(ways, clusters, scores.spent),),
                clusters=clusters,
                score=scores.score[columns],
                spent=scores.spent,
            )
        )
    return tests
