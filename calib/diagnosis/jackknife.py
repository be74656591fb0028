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
  a true effect widens nothing. The degrees of freedom of either way come from the I_c, as Bell and
  McCaffrey (2002) have it, were the rows of a cluster to err as one; those of the sum are
  Satterthwaite's. A cluster that alone holds a direction leaves nothing to compare it with: the
  variance there is infinite. Clusters fewer than two for each parameter that one of them tells as
  one (the sum of the largest eigenvalues of the I_c) tell nothing: parameters fit their errors.

Where few clusters hold most of the information, few degrees of freedom are left, however well all
others agree. Then the others are asked by themselves, in the second way: those without the cluster
that holds most, without the next, and so on, which would find the smallest effect (`Judges`).
Information alone decides which they are; their p-value is doubled, as it hardly depends on that of
all. A mishap of one stop, or the shape of one wall, then neither makes an effect nor hides one.

The smaller of both p-values counts: where nothing is missing the second is hardly ever the smaller,
but for a single parameter, where both are nearly the same. Measured by `tests/bench/bench_size.py`
at a nominal 0.05, with 1, 4, 16 and 64 parameters and 6 to 60 stops, 240 draws each: where rows err
alone, stops err together by up to three times a row's sigma, stops and surfaces do by half of it,
three stops show most of the effect, or it acts within stops only, 0.02 to 0.07 of empty worlds
show something, stops averaged over (0.12 in the worst of 240 cases); none, where parameters that
act by stop are as many as the stops. A limit: 0.13 with few stops where surfaces err by three times
a row's sigma and the model does not know it. Of an effect of 10 sigmas that three of thirty stops,
or two of 25 surfaces, show, 0.7 and 0.9 are found at 0.001, by signs alone none.

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

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy import special

from calib.linear.clusters import ClusteredRows, summed
from calib.results.intervals import ALONE

UNKNOWN_VARIANCE = 1e12  # variance, of a whitened score, where nothing tells it
# Least stops, or surfaces, for each parameter that one of these tells as one. Measured in the
# benchmark: with fewer, 0.1 to 1.0 of empty worlds where stops err show something; else below 0.1.
PER_PARAMETER = 2
SLIGHT_SHARE = 0.05  # of a direction's information: the others predict a cluster with less to 5 %
# Of a part's information, from which a cluster is worth a look without it: where none holds as much
# there are ten degrees of freedom or more, and the test's limit is at most 2.6 times the least.
HEAVY = 0.1
LIMIT = 1e-4  # about the level of one test of an effect after all looks, for what judges it best
HIGHEST_WORTH = 1.0 / float(special.chdtri(1.0, LIMIT))  # of a share of 1: with d without end


@dataclass(frozen=True)
class ScoreSpread:
    """How a whitened score scatters where nothing is missing.

    Args:
        covariance: (r, r) of the score.
        nu, d: degrees of freedom of the statistic over the covariance's trace.
        clusters: how many even clusters would tell as much of the covariance.
        ratio: of the statistic to that trace, where not all clusters judge it.
        share: of the information, that judges it.
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
        ways: shares (c, r) of the whitened score by stop, by surface, and by both.
        stops: how many stops have a share in it; one tells nothing.
        spent: how many unknowns of the model differ by stop alone.
    """
    by_stop, by_place, both = (_evenly(shares) for shares in ways)
    more = _beyond(by_place, both)
    count = max(min(stops, len(ways[1])), 1)
    nu = _freedom(ways[0], count)
    if np.trace(more) > 0.0:
        nu = min(nu, _freedom(ways[1], len(ways[1])))
    size = np.square(ways[0]).sum(axis=1)
    # Were scores normal, their squares would scatter by 2 / nu.
    even = size.sum() ** 2 / max(np.square(size).sum(), 1e-300) * (1.0 + 2.0 / nu)
    left = max(count - 1.0 - spent, 0.0)
    by_stop = by_stop * _widened(count, spent)
    return ScoreSpread(by_stop + more, nu, left * nu, min(float(count), float(even)))


def _widened(count: int, spent: int) -> float:
    """How much wider scores of stops scatter than residuals show, where a model has spent so many
    unknowns on stops."""
    return (count - 1.0) / max(count - 1.0 - spent, 1.0) if spent else 1.0


def _freedom(shares: np.ndarray, count: int) -> float:
    """Degrees of freedom of the square of a sum of shares (c, r), by pairs of different clusters;
    so many of them tell it."""
    size = np.square(shares).sum(axis=1)
    pairs = np.square(shares.T @ shares).sum() - np.square(size).sum()
    alike = max(float(pairs / max(size.sum() ** 2, 1e-300)), 1e-9)
    return max((1.0 - 1.0 / count) / alike - 2.0 / count, 0.5)


def _evenly(shares: np.ndarray) -> np.ndarray:
    """Covariance (r, r) of the sum of shares (c, r), an even part of it taken off each."""
    count, total = len(shares), shares.sum(axis=0)
    if count < 2:
        return UNKNOWN_VARIANCE * np.eye(len(total))
    return (shares.T @ shares - np.outer(total, total) / count) * count / (count - 1)


def _beyond(by_place: np.ndarray, both: np.ndarray) -> np.ndarray:
    """What surfaces that err alike at all stops add to a covariance by stops."""
    more = by_place - both
    return more if np.trace(more) > 0.0 else np.zeros_like(more)


@dataclass
class Shares:
    """Each cluster's share of a candidate's whitened score and of its information."""

    cells: dict[tuple[int, int], list[np.ndarray]] = field(default_factory=dict)

    def add(self, rows: ClusteredRows) -> None:
        """Add rows along the candidate's directions, projected off the model and whitened."""
        order = np.lexsort([rows.place, rows.stop])
        stop, place = rows.stop[order], rows.place[order]
        bounds = np.flatnonzero((np.diff(stop) != 0) | (np.diff(place) != 0)) + 1
        for some in np.split(order, bounds):
            mine, right = rows.A[some], rows.b[some]
            score, information = mine.T @ right, mine.T @ mine
            cell = int(rows.stop[some[0]]), int(rows.place[some[0]])
            if cell in self.cells:
                self.cells[cell][0] += score
                self.cells[cell][1] += information
            else:
                self.cells[cell] = [score, information]

    def left_out(self, nu: float, spent: int = 0) -> tuple[ScoreSpread, ...]:
        """Chance from leaving out cluster after cluster, of all and of those that tell most where
        few dominate; see the module.

        Args:
            nu: degrees of freedom of the statistic, by signs.
            spent: how many unknowns of the model differ by stop alone.
        """
        scores, information = (np.stack(each) for each in zip(*self.cells.values(), strict=True))
        return Judges.of(np.array(list(self.cells)), information, spent).chances(scores, nu)


@dataclass(frozen=True)
class Clusters:
    """What can be said of clusters before their scores are known.

    Args:
        information: (c, r, r) of the whitened score; they add up to 1.
        count: how many are stops, in the way by stops, or surfaces.
        apart: cluster -> ``(1 - I)^-1`` (r, r), where that is not nearly 1.
        alone: (r, r) variance in directions that one cluster alone holds.
    """

    information: np.ndarray
    count: int
    apart: Mapping[int, np.ndarray]
    alone: np.ndarray

    @classmethod
    def of(cls, information: np.ndarray, count: int) -> Clusters:
        """Of clusters that hold so much of the information, (c, r, r)."""
        apart, alone = {}, np.zeros_like(information[0])
        for c in np.flatnonzero(np.linalg.norm(information, axis=(1, 2)) > SLIGHT_SHARE).tolist():
            values, axes = np.linalg.eigh(information[c])
            apart[c] = (axes / (1.0 - np.clip(values, 0.0, ALONE))) @ axes.T
            lonely = axes[:, values > ALONE]
            alone += UNKNOWN_VARIANCE * lonely @ lonely.T
        return cls(information, count, apart, alone)

    @cached_property
    def d(self) -> float:
        """Degrees of freedom of the covariance's trace, were each cluster's rows to err as one."""
        variance = self.information.copy()  # I (1 - I)^-1, of what each is compared by
        for c, inverse in self.apart.items():
            variance[c] = variance[c] @ inverse
        common = variance @ variance  # of two clusters: minus I (1 - I)^-1 of one by the other's
        among = np.square(common.sum(axis=0)).sum() - np.square(common).sum()
        size = np.trace(variance, axis1=1, axis2=2)
        return float(size.sum() ** 2 / max(np.square(size).sum() + among, 1e-300))

    @cached_property
    def crowded(self) -> bool:
        """Whether they are too few for the parameters that each of them tells as one: these then
        fit what the clusters err by, and nothing is left of it."""
        return PER_PARAMETER * np.linalg.eigvalsh(self.information)[:, -1].sum() > self.count

    def covariance(self, score: np.ndarray) -> np.ndarray:
        """Covariance (r, r) of the sum of scores (c, r), each compared with what others predict."""
        beyond = score - self.information @ score.sum(axis=0)
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


@dataclass(frozen=True)
class SomeCells:
    """Cells of stop and place, all or some.

    Args:
        kept: (n,) which of all cells.
        whiten: (r, k), of what these say of the whitened score.
        share: of the information.
        cells: (m, 2) numbers of stop and place of each, -1 for none.
        clusters: by stop, by place, and by both.
        spent: how many unknowns of the model differ by stop alone.
    """

    kept: np.ndarray
    whiten: np.ndarray
    share: float
    cells: np.ndarray
    clusters: tuple[Clusters, ...]
    spent: int

    @classmethod
    def of(
        cls, cells: np.ndarray, information: np.ndarray, kept: np.ndarray, spent: int
    ) -> SomeCells | None:
        """Some of the cells (n, 2), which hold (n, r, r); None where that is next to nothing."""
        cells, mine = cells[kept], information[kept]
        whole = mine.sum(axis=0)
        values, axes = np.linalg.eigh(whole)
        seen = values > SLIGHT_SHARE
        if not seen.any():
            return None
        whiten = axes[:, seen] / np.sqrt(values[seen])
        if kept.all():
            whiten = np.eye(len(whole))
        else:
            mine = whiten.T @ mine @ whiten
        counts = (_stated(cells, 0), _stated(cells, 1), len(cells))
        clusters = tuple(
            Clusters.of(_added(mine, numbers), count)
            for numbers, count in zip(_ways(cells), counts, strict=True)
        )
        share = float(np.trace(whole)) / len(whole)
        return cls(
            kept=kept, whiten=whiten, share=share, cells=cells, clusters=clusters, spent=spent
        )

    @cached_property
    def worth(self) -> float:
        """How small an effect it finds: its information over the limit of its test."""
        if self.clusters[0].crowded or self.clusters[1].crowded:
            return 0.0
        d = max(min(self.clusters[0].d - self.spent, self.clusters[1].d), 1.0)
        return self.share / float(special.fdtri(1.0, d, 1.0 - LIMIT))

    @cached_property
    def shares(self) -> list[np.ndarray]:
        """Of its information, by stop and by place."""
        parts = (np.trace(each.information, axis1=1, axis2=2) for each in self.clusters[:2])
        return [each / len(self.whiten.T) for each in parts]

    def without_the_heaviest(self) -> np.ndarray:
        """Which of all cells (n,) are left without the stop, or the place, that holds most."""
        way = int(np.argmax([each.max() for each in self.shares]))
        gone = _ways(self.cells)[way] == np.argmax(self.shares[way])
        left = self.kept.copy()
        left[np.flatnonzero(left)[gone]] = False
        return left

    def sums(self, scores: np.ndarray) -> list[np.ndarray]:
        """Shares of the score by stop, by place, and by both, from those (n, r) of all cells."""
        mine = scores[self.kept] @ self.whiten
        return [_added(mine, numbers) for numbers in _ways(self.cells)]


@dataclass(frozen=True)
class Judges:
    """All cells, and the part of them that finds the smallest effect: without the cluster that
    holds most, without the next, and so on. Scores have no say in which it is."""

    every: SomeCells
    best: SomeCells

    @classmethod
    def of(cls, cells: np.ndarray, information: np.ndarray, spent: int = 0) -> Judges:
        """Arguments as of `SomeCells`."""
        every = best = this = SomeCells.of(cells, information, np.ones(len(cells), bool), spent)
        while every.worth and max(each.max() for each in this.shares) > HEAVY:
            this = SomeCells.of(cells, information, this.without_the_heaviest(), spent)
            if this is None or this.share < best.worth / HIGHEST_WORTH:
                break
            best = max(best, this, key=lambda part: part.worth)
        return cls(every, best)

    def chances(self, scores: np.ndarray, nu: float) -> tuple[ScoreSpread, ...]:
        """From scores (n, r) of all cells: by all, and by the best part where that is not all; `nu`
        is that of the statistic, by signs."""
        every = by_leaving_out(self.every.clusters, self.every.sums(scores), nu, self.every.spent)
        if self.best is self.every:
            return (every,)
        ways, stops = self.best.sums(scores), self.best.clusters[0].count
        nu = by_signs(ways, stops, self.best.spent).nu
        rest = by_leaving_out(self.best.clusters, ways, nu, self.best.spent)
        ratio = float(np.square(ways[0].sum(axis=0)).sum()) / max(rest.trace, 1e-300)
        wider = rest.trace / len(rest.covariance) * np.eye(len(every.covariance))
        return every, replace(rest, covariance=wider, ratio=ratio, share=self.best.share)


def _ways(cells: np.ndarray) -> list[np.ndarray]:
    """Numbers (n,) of the clusters that cells (n, 2) are in: by stop and by place, where a cell
    without one is a cluster of its own; and each its own."""
    own = np.arange(len(cells))
    some = (np.where(each >= 0, each, -1 - own) for each in cells.T)
    return [*(np.unique(each, return_inverse=True)[1] for each in some), own]


def _stated(cells: np.ndarray, way: int) -> int:
    """How many stops (0), or places (1), cells (n, 2) have; of cells that have none, how many."""
    return len(np.unique(cells[cells[:, way] >= 0, way])) or len(cells)


def _added(values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Sums (G, ...) of values (n, ...) by group (n,)."""
    sums = summed(values.reshape(len(values), -1), at)
    return sums.reshape(-1, *values.shape[1:])
