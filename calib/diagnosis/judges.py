"""Which clusters judge a candidate: all, and those that tell most where few of them dominate.

Where few clusters hold most of the information, few degrees of freedom are left, however well all
others agree. Then the others are asked by themselves as well, or all of them about those of its
directions that no cluster dominates; see `jackknife`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy import special

from calib.diagnosis.jackknife import Clusters, ScoreSpread, by_leaving_out, by_signs
from calib.linear.clusters import summed
from calib.linear.elimination import square_root
from calib.linear.layout import positions
from calib.linear.symmetric import eigh

SLIGHT_LEFT = 0.05  # of a direction's information: with less of it left, it is not tested
# Of a part's information, from which a cluster is worth a look without it: where none holds as much
# there are ten degrees of freedom or more, and the test's limit is at most 2.6 times the least.
HEAVY = 0.1
# Of a direction's information: a cluster that holds more is not asked about it, nor any other.
# Tried one after the other, as more shares leave fewer directions and more degrees of freedom.
HELD_BY_ONE = (0.9, 0.7, 0.5)
SAME_DIRECTION = 1e-6  # singular value of unit directions, below which one follows from the others
# Share of what the others say by which clusters left out may differ from it in any case; beyond it,
# the p-value below which they disagree. Both are choices.
NEARLY, DISAGREE = 0.25, 0.01
LIMIT = 1e-4  # the level at which parts are compared: about that of one test after all looks
HIGHEST_WORTH = 1.0 / float(special.chdtri(1.0, LIMIT))  # of a share of 1: with d without end


@dataclass(frozen=True)
class CellRows:
    """Rows along a candidate's directions, projected off the model and whitened, or others of the
    same information; and the cell, of stop and place, that each is of.

    Args:
        pairs: (n, 2) the stop and the place of each cell; -1 for none.
        rows: (N, r); cell: (N,) of which of these each is.
    """

    pairs: np.ndarray
    rows: np.ndarray = field(repr=False)
    cell: np.ndarray = field(repr=False)


@dataclass
class Shares:
    """Rows (n, r) of clusters along a candidate's directions, as they come, and the stop and the
    place of each."""

    rows: list[np.ndarray] = field(default_factory=list)
    pairs: list[tuple[int, int]] = field(default_factory=list)

    def add(self, rows: np.ndarray, stop: np.ndarray, place: np.ndarray) -> None:
        """Add some rows (m, r), of stops and places (m,). Of a cell with more rows than there are
        directions only as many are kept, of the same information."""
        order = np.lexsort([place, stop])
        pairs = np.stack([stop, place], axis=1)[order]
        for some in np.split(order, np.flatnonzero(np.diff(pairs, axis=0).any(axis=1)) + 1):
            mine = rows[some]
            if len(mine) > mine.shape[1]:
                mine = square_root(mine.T @ mine)
            self.rows.append(mine)
            self.pairs.append((int(stop[some[0]]), int(place[some[0]])))

    def left_out(
        self, pairs: np.ndarray, scores: np.ndarray, nu: float, spent: int = 0
    ) -> tuple[ScoreSpread, ...]:
        """Chance from leaving out cluster after cluster, of all and of those that tell most where
        few dominate; see the module.

        Args:
            pairs: (c, 2) the stop and the place of each share of the score.
            scores: (c, r) these shares, along the same directions.
            nu: degrees of freedom of the statistic, by signs.
            spent: how many unknowns of the model differ by stop alone.
        """
        every = np.concatenate([pairs, np.array(self.pairs, int).reshape(-1, 2)])
        cells, at = np.unique(every, axis=0, return_inverse=True)
        mine, theirs = np.split(at.ravel(), [len(pairs)])
        scores = summed(scores, mine, len(cells))
        theirs = np.repeat(theirs, [len(rows) for rows in self.rows])
        cells = CellRows(cells, _adding_up(np.concatenate(self.rows)), theirs)
        return Judges.of(cells, spent).chances(scores, nu)


@dataclass(frozen=True)
class SomeCells:
    """Cells of stop and place, all or some.

    Args:
        kept: (n,) which of all cells.
        cells: all of them.
        whiten: (r, k), of what the kept ones say of the directions that are asked about.
        share: of the information, that they hold.
        ways: numbers (n,) of the stop and of the place of each; -1 for those that are not kept.
        clusters: by stop, by place, and each cell by itself.
        spent: how many unknowns of the model differ by stop alone.
    """

    kept: np.ndarray
    cells: CellRows
    whiten: np.ndarray
    share: float
    ways: tuple[np.ndarray, ...]
    clusters: tuple[Clusters, ...]
    spent: int

    @classmethod
    def of(
        cls, cells: CellRows, kept: np.ndarray, spent: int, axes: np.ndarray | None = None
    ) -> SomeCells | None:
        """Some of the cells, about all directions or these (r, k), of unit length and at right
        angles; None where they say next to nothing."""
        ways = tuple(_numbered(cells.pairs, kept, way) for way in (0, 1))
        rows, cell = cells.rows, cells.cell
        if not kept.all():
            mine = kept[cell]
            rows, cell = rows[mine], cell[mine]
        plain = kept.all() and axes is None
        axes = np.eye(rows.shape[1]) if axes is None else axes
        whole = axes.T @ (rows.T @ rows) @ axes
        values, vectors = eigh(whole)
        seen = values > SLIGHT_LEFT
        if not seen.any():
            return None
        whiten = axes if kept.all() else axes @ (vectors[:, seen] / np.sqrt(values[seen]))
        rows = rows if plain else rows @ whiten
        each = positions(len(kept), np.flatnonzero(kept))
        clusters = tuple(
            Clusters(rows, way[cell], way.max() + 1, count)
            for way, count in (
                (ways[0], _stated(cells.pairs[kept], 0)),
                (ways[1], _stated(cells.pairs[kept], 1)),
                (each, int(kept.sum())),
            )
        )
        return cls(
            kept=kept,
            cells=cells,
            whiten=whiten,
            share=float(np.trace(whole)) / len(axes),
            ways=ways,
            clusters=clusters,
            spent=spent,
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
        return [each.trace / len(self.whiten.T) for each in self.clusters[:2]]

    def without_the_heaviest(self) -> np.ndarray:
        """Which of all cells (n,) are left without the stop, or the place, that holds most."""
        way = int(np.argmax([each.max() for each in self.shares]))
        return self.kept & (self.ways[way] != np.argmax(self.shares[way]))

    def held_by_no_one(self, axes: np.ndarray, most: float) -> np.ndarray:
        """Those among some directions (r, k) of which no stop, and no place, holds more than a
        share; all cells being kept, in all directions."""
        while axes.shape[1]:
            held = [_held(each.information, axes, most) for each in self.clusters[:2]]
            if not (found := np.hstack(held)).shape[1]:
                break
            along, size, _ = np.linalg.svd(found)
            axes = axes @ along[:, int((size > SAME_DIRECTION).sum()) :]
        return axes

    def spread(self, scores: np.ndarray, nu: float | None = None) -> tuple[ScoreSpread, float]:
        """Chance from the scores (n, r) of all cells, and the statistic; `nu` is that of the
        statistic, by signs, and as these cells have it where None."""
        mine = scores @ self.whiten
        ways = [*(summed(mine, way) for way in self.ways), mine[self.kept]]
        if nu is None:
            nu = by_signs(ways, self.clusters[0].count, self.spent).nu
        statistic = float(np.square(ways[0].sum(axis=0)).sum())
        return by_leaving_out(self.clusters, ways, nu, self.spent), statistic


@dataclass(frozen=True)
class Judges:
    """All cells, and what of them finds the smallest effect: those without the cluster that holds
    most, without the next, and so on, or all about the directions that none dominates. Scores have
    no say in which it is."""

    every: SomeCells
    best: SomeCells

    @classmethod
    def of(cls, cells: CellRows, spent: int = 0) -> Judges:
        """As of `SomeCells`."""
        whole = np.ones(len(cells.pairs), bool)
        every = best = this = SomeCells.of(cells, whole, spent)
        axes = every.whiten
        for most in HELD_BY_ONE:
            axes = every.held_by_no_one(axes, most)
            if axes.shape[1] <= len(axes) * best.worth / HIGHEST_WORTH:
                break
            if axes.shape[1] < len(axes):
                part = SomeCells.of(cells, whole, spent, axes)
                best = max(best, part, key=lambda part: part.worth)
        if not best.worth:
            return cls(every, every)
        while max(each.max() for each in this.shares) > HEAVY:
            this = SomeCells.of(cells, this.without_the_heaviest(), spent)
            if this is None or this.share < best.worth / HIGHEST_WORTH:
                break
            best = max(best, this, key=lambda part: part.worth)
        return cls(every, best)

    def chances(self, scores: np.ndarray, nu: float) -> tuple[ScoreSpread, ...]:
        """From scores (n, r) of all cells: by all, and by the best part where that is not all; `nu`
        is that of the statistic, by signs."""
        every, _ = self.every.spread(scores, nu)
        if self.best is self.every:
            return (every,)
        rest, statistic = self.best.spread(scores)
        if not self._agree(scores, rest):
            return (every,)
        wider = rest.trace / len(rest.covariance) * np.eye(len(every.covariance))
        ratio = statistic / max(rest.trace, 1e-300)
        return every, replace(rest, covariance=wider, ratio=ratio, share=self.best.share)

    def _agree(self, scores: np.ndarray, rest: ScoreSpread) -> bool:
        """Whether the clusters left out show what the others say, to a quarter of it or as far as
        these scatter. An error of their own would have moved the model, and by that the others, the
        other way; an effect whose shape is not quite right is off by less."""
        kept, whiten = self.best.kept, self.best.whiten
        told = scores[kept].sum(axis=0) @ whiten @ whiten.T
        rows = self.best.cells.rows[~kept[self.best.cells.cell]]
        held = rows.T @ rows
        said = held @ told
        off = scores[~kept].sum(axis=0) - said
        variance = held + held @ whiten @ whiten.T @ held
        values, axes = eigh(variance)
        seen = values > SLIGHT_LEFT
        if not seen.any() or rest.d <= 0.0:
            return True
        root = axes[:, seen] / np.sqrt(values[seen])
        square = float(np.square(off @ root).sum())
        if square < NEARLY**2 * float(np.square(said @ root).sum()):
            return True
        times = square / max(rest.trace / len(rest.covariance), 1e-300) / int(seen.sum())
        return bool(special.fdtrc(int(seen.sum()), rest.d, times) > DISAGREE)


def _adding_up(rows: np.ndarray) -> np.ndarray:
    """Rows (N, r), changed so that ``rows.T @ rows`` is 1. It is so already, but for rounding,
    unless beams were drawn."""
    values, axes = eigh(rows.T @ rows)
    return rows @ (axes / np.sqrt(np.maximum(values, SLIGHT_LEFT))) @ axes.T


def _held(information: np.ndarray, axes: np.ndarray, most: float) -> np.ndarray:
    """Directions among some (r, k) of which one cluster holds more than a share of the information
    (c, r, r), all of them side by side (k, h)."""
    found = [np.zeros((axes.shape[1], 0))]
    norm = np.linalg.norm(information, axis=(1, 2))  # no less than it holds of any direction
    for each in information[norm > most]:
        values, vectors = eigh(axes.T @ each @ axes)
        found.append(vectors[:, values > most])
    return np.hstack(found)


def _numbered(cells: np.ndarray, kept: np.ndarray, way: int) -> np.ndarray:
    """Numbers (n,) of the stops (0) or places (1) of cells (n, 2); one without is a cluster of its
    own, and one that is not kept has -1."""
    own = np.where(cells[:, way] >= 0, cells[:, way], -1 - np.arange(len(cells)))
    found = np.full(len(cells), -1)
    found[kept] = np.unique(own[kept], return_inverse=True)[1]
    return found


def _stated(cells: np.ndarray, way: int) -> int:
    """How many stops (0), or places (1), cells (n, 2) have; of cells that have none, how many."""
    return len(np.unique(cells[cells[:, way] >= 0, way])) or len(cells)
