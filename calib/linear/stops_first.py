"""Stops' own unknowns are eliminated first, each stop's as it comes, and all cells at the end.

It holds one matrix over ``[finest cells | coarser cells | kept | b]``, from which each stop's own
unknowns are gone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from calib.linear.assembly import Assembly, KeptSums, OwnRows
from calib.linear.elimination import Eliminated, eliminate, square
from calib.linear.layout import Layout, positions
from calib.linear.rows import TWIST, StopSums
from calib.linear.system import Linearisation, Values
from calib.residuals.compiled import add_at

STOPS_TOGETHER = 256  # without beams, whose rows are multiplied at once: bounds the memory


class StopsFirst(Assembly):
    """Each stop's own unknowns are eliminated as it comes, all cells at the end."""

    def __init__(
        self, layout: Layout, own: Mapping[int, Sequence[OwnRows]], beams: int, raw: bool
    ) -> None:
        super().__init__(layout, own, beams, raw)
        self.cells = np.concatenate([layout.finest, layout.cells])
        self.columns = np.concatenate([self.cells, layout.kept, [layout.size]])
        self.at = positions(layout.size + 1, self.columns)
        self.total = np.zeros((len(self.columns), len(self.columns)))
        self.waiting = dict(own)

    def add(self, sums: StopSums) -> None:
        """Add the beams of a stop, and eliminate what is its own."""
        super().add(sums)
        mine, at = self._columns(sums.stop, sums.chain_columns, sums.columns)
        unit = np.append(self.layout.sigma, 1.0)
        through, beside = np.zeros((2, TWIST, len(mine)))
        through[:, at[sums.chain_columns]] = sums.chain * unit[sums.chain_columns]
        direct = np.append(self.layout.size, sums.columns).astype(int)
        block, place, scale = sums.whole(), at[direct], unit[direct]
        beside[:, place] = block[:TWIST, TWIST:] * scale
        half = block[:TWIST, :TWIST] @ through / 2.0 + beside
        whole = np.vstack([through, half]).T @ np.vstack([half, through])
        add_at(whole, place, place, block[TWIST:, TWIST:] * scale * scale[:, None])
        self._finish(sums.stop, mine, at, whole)

    def add_kept(self, sums: KeptSums) -> None:
        """Add the sums of whitened rows about kept unknowns."""
        super().add_kept(sums)
        if self.raw is not None:
            self._add_raw([sums])
        sums.add_to(self.total, self.at, self.layout.sigma, len(self.columns) - 1)

    def _columns(self, stop: int, *beams: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Columns (m,) that a stop's rows touch, its own first and the right side last, and where
        among them each of all stands; those of its beams are given."""
        size, own = self.layout.size, self._own(stop)
        rows = (each.columns for each in self.waiting.get(stop, ()))
        touched = np.unique(np.concatenate([*beams, *rows, [size]]).astype(int))
        mine = np.concatenate([own, np.setdiff1d(touched, own)])
        return mine, positions(size + 1, mine)

    def _finish(self, stop: int, mine: np.ndarray, at: np.ndarray, whole: np.ndarray) -> None:
        """Add a stop's own rows to the matrix of its beams over its columns, and eliminate what is
        its own; the other arguments are those of `_columns`."""
        layout, rows = self.layout, self.waiting.pop(stop, ())
        if self.raw is not None:
            place = positions(layout.size + 1, layout.kept)[mine]
            add_at(self.raw, place, place, whole)
            self._add_raw(rows)
        for each in rows:
            each.add_to(whole, at, layout.sigma, len(mine) - 1)
        count = len(self._own(stop))
        rest = whole[count:, count:]
        if count:
            factor, gain = eliminate(whole[:count, :count], whole[:count, count:], rest)
            self.eliminated.append(Eliminated(mine[:count], mine[count:], factor, gain))
        to = self.at[mine[count:]]
        add_at(self.total, to, to, rest)

    def _finish_without_beams(self, stops: Sequence[int]) -> None:
        """Eliminate what is their own from stops that have no beams. Their rows are few: they are
        turned until no more of them touch a stop's own unknowns than there are of these (QR), and
        all others go into one product."""
        left, raw = [], []
        kept = positions(self.layout.size, self.layout.kept)
        for some in self._alike(stops):
            mine, at = self._columns(some[0])
            rows, count = self._stacked(some, at, len(mine)), len(self._own(some[0]))
            if self.raw is not None:
                raw.append(_over(rows, kept, mine[:-1]))
            if count:
                Q, R = np.linalg.qr(rows[:, :, :count], mode="complete")
                rows = Q.mT @ rows
                R, over = R[:, :count], mine[count:]
                gains = np.linalg.solve(R, rows[:, :count, count:])
                self.eliminated += [
                    Eliminated(self._own(stop), over, root.T, gain)
                    for stop, root, gain in zip(some, R, gains, strict=True)
                ]
            left.append(_over(rows[:, count:, count:], self.at, mine[count:]))
            for stop in some:
                del self.waiting[stop]
        self.total += square(np.vstack(left))
        if self.raw is not None:
            self.raw += square(np.vstack(raw))

    def _own(self, stop: int) -> np.ndarray:
        return self.layout.own.get(stop, np.zeros(0, int))

    def _alike(self, stops: Sequence[int]) -> list[list[int]]:
        """Stops whose rows touch the same unknowns, but for their own, in the same order."""
        found: dict[object, list[int]] = {}
        place = np.full(self.layout.size, -1)
        for stop in stops:
            own = self._own(stop)
            place[own] = -2 - np.arange(len(own))
            like: list[object] = [len(own)]
            for rows in self.waiting[stop]:
                at = place[rows.columns]
                like += [len(rows.b), np.where(at < -1, at, rows.columns).tobytes()]
            place[own] = -1
            found.setdefault(tuple(like), []).append(stop)
        return list(found.values())

    def _stacked(self, stops: Sequence[int], at: np.ndarray, width: int) -> np.ndarray:
        """Own rows (K, m, width) of stops that are alike, in units of sigmas; `at` says where the
        columns of the first of them stand."""
        each = list(zip(*(self.waiting[stop] for stop in stops), strict=True))
        out, first = np.zeros((len(stops), sum(len(rows[0].b) for rows in each), width)), 0
        for rows in each:
            here = slice(first, first := first + len(rows[0].b))
            sigma = self.layout.sigma[np.stack([r.columns for r in rows])]
            out[:, here, at[rows[0].columns]] = np.stack([r.A for r in rows]) * sigma[:, None]
            out[:, here, -1] = np.stack([r.b for r in rows])
        return out

    def done(self, values: Values) -> Linearisation:
        """Eliminate all but the kept."""
        stops = list(self.waiting)
        for first in range(0, len(stops), STOPS_TOGETHER):
            self._finish_without_beams(stops[first : first + STOPS_TOGETHER])
        count = len(self.cells)
        if not count:
            return self._done(values, self.total)
        prior = self._cell_priors(values, self.cells)
        self.total[:count, :count] += np.eye(count)
        self.total[:count, -1] += prior
        self.total[-1, :count] += prior
        self.total[-1, -1] += prior @ prior
        rest = self.total[count:, count:].copy()
        factor, gain = eliminate(self.total[:count, :count], self.total[:count, count:], rest)
        self.eliminated.append(Eliminated(self.cells, self.columns[count:], factor, gain))
        return self._done(values, rest)


def _over(rows: np.ndarray, at: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Rows (K, m, n) of some columns (n,), each (K m,) among the columns that stand somewhere in
    `at`."""
    rows, there = rows.reshape(-1, rows.shape[2]), at[columns] >= 0
    out = np.zeros((len(rows), int(at.max(initial=-1)) + 1))
    out[:, at[columns[there]]] = rows[:, : len(columns)][:, there]
    return out
