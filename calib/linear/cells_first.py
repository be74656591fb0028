"""Cells are eliminated first, then stops' own unknowns, all in one block.

It holds one matrix over ``[twists of all stops | coarser cells | kept | b]``, and beside it the
finest cells as a diagonal and their products with all columns of that matrix.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property

import numpy as np

from calib.linear.assembly import Assembly, KeptSums, OwnRows
from calib.linear.elimination import BY_TWIST, Eliminated, eliminate, square
from calib.linear.layout import Layout, positions
from calib.linear.rows import TWIST, StopSums
from calib.linear.system import Linearisation, Values
from calib.residuals.compiled import add_at, add_both, add_sparse

# Where fewer than one entry in so many can differ from 0, a product stop by stop is faster than the
# whole one (measured: one in 7, 24 stops, 3.1 ms against 1.8; one in 23, 90 stops, 8.5 against 21).
DENSE = 8


class CellsFirst(Assembly):
    """Cells are eliminated from [twists of all stops | cells | kept | b], then stops' unknowns."""

    def __init__(
        self, layout: Layout, own: Mapping[int, Sequence[OwnRows]], beams: int, raw: bool
    ) -> None:
        super().__init__(layout, own, beams, raw)
        self.first = TWIST * beams
        rest = np.concatenate([layout.cells, layout.kept])
        self.at = np.full(layout.size, -1)
        self.at[rest] = self.first + np.arange(len(rest))
        self.finest = positions(layout.size, layout.finest)
        self.b = self.first + len(rest)
        self.rest = np.zeros((self.b + 1, self.b + 1))
        self.diagonal = np.zeros(len(layout.finest))
        self.cross = np.zeros((len(layout.finest), self.b + 1))

    def add(self, sums: StopSums) -> None:
        """Add the beams of a stop."""
        super().add(sums)
        start = TWIST * len(self.twists)
        self.twists.append((sums.stop, sums.chain, sums.chain_columns))
        own = [*range(start, start + TWIST), self.b]
        dense = np.append(own, self.at[sums.dense_columns]).astype(int)
        sparse, fine = self.at[sums.sparse_columns], self.finest[sums.sparse_columns]
        add_at(self.rest, dense, dense, sums.dense)
        add_both(self.rest, sparse, dense, sums.with_dense)
        add_at(self.cross, fine, dense, sums.with_dense)
        parts = self.rest, self.cross, self.diagonal
        add_sparse(sums.with_sparse, sums.own, sparse, fine, *parts)

    def add_kept(self, sums: KeptSums) -> None:
        """Add the sums of whitened rows about kept unknowns."""
        super().add_kept(sums)
        sums.add_to(self.rest, self.at, np.ones(self.layout.size), self.b)

    def done(self, values: Values) -> Linearisation:
        """Eliminate all but the kept."""
        layout, cells = self.layout, self.first + np.arange(len(self.layout.cells))
        # Kept unknowns that no beam depends on but by where its LiDAR is have nothing here yet.
        there = np.diag(self.rest) > 0
        there[: self.first + len(cells)] = there[-1] = True
        there = np.flatnonzero(there)
        over = np.concatenate([layout.cells, layout.kept, [layout.size]])
        over = np.append(np.full(self.first, BY_TWIST), over).astype(int)[there]
        unit = np.append(np.ones(self.first), layout.sigma[over[self.first : -1]])
        unit = np.append(unit, 1.0)
        rest = self.rest[np.ix_(there, there)]
        rest *= unit
        rest *= unit[:, None]
        if self.raw is not None:
            before = np.delete(np.delete(rest, cells, 0), cells, 1)
            beside = np.delete(over, cells)
            self.raw += self._chained(before, beside, np.zeros(0, int))[:-1, :-1]
            self.raw += self._own_rows[1][:-1, :-1]
        if len(layout.finest):
            own = layout.sigma[layout.finest]
            cross = self.cross[:, there]
            cross *= own[:, None]
            cross *= unit
            prior = self._cell_priors(values, layout.finest)
            cross[:, -1] += prior
            rest[-1, -1] += prior @ prior
            factor, gain = eliminate(self.diagonal * own**2 + 1.0, cross, rest)
            self.eliminated.append(Eliminated(layout.finest, over, factor, gain))
        if len(cells):
            rest[cells, cells] += 1.0
            prior = self._cell_priors(values, layout.cells)
            rest[cells, -1] += prior
            rest[-1, cells] += prior
            rest[-1, -1] += prior @ prior
            left = np.delete(np.arange(len(over)), cells)
            cross, block = rest[np.ix_(cells, left)], rest[np.ix_(cells, cells)]
            rest, over = rest[np.ix_(left, left)], over[left]
            factor, gain = eliminate(block, cross, rest)
            self.eliminated.append(Eliminated(layout.cells, over, factor, gain))
        return self._done(values, self._without_own(rest, over))

    @cached_property
    def _own_rows(
        self,
    ) -> tuple[np.ndarray, np.ndarray, list[tuple[np.ndarray, slice, np.ndarray]]]:
        """All rows about stops' own unknowns, in units of sigmas, over [kept | b], and their Gram
        matrix; and of each its own columns, which of the rows it is, and their derivatives."""
        layout, found = self.layout, [rows for each in self.own.values() for rows in each]
        at = positions(layout.size, layout.kept)
        stacked = np.zeros((sum(len(rows.b) for rows in found), len(layout.kept) + 1))
        about_own, start = [], 0
        for rows in found:
            here = slice(start, start + len(rows.b))
            A, place = rows.A * layout.sigma[rows.columns], at[rows.columns]
            stacked[here, place[place >= 0]] = A[:, place >= 0]
            stacked[here, -1] = rows.b
            about_own.append((rows.columns[place < 0], here, A[:, place < 0]))
            start = here.stop
        return stacked, square(stacked), about_own

    def _without_own(self, rest: np.ndarray, over: np.ndarray) -> np.ndarray:
        """From [twists | kept | b], of the columns `over`, to [kept | b] with all that are kept:
        through the chain, then stops' own unknowns."""
        layout = self.layout
        own = np.concatenate([np.zeros(0, int), *layout.own.values()])
        columns = np.concatenate([own, layout.kept, [layout.size]])
        at = positions(layout.size + 1, columns)
        whole, count = self._chained(rest, over, own), len(own)
        stacked, gram, about_own = self._own_rows
        whole[count:, count:] += gram
        for mine, rows, A in about_own:  # of own by kept, one side is enough
            add_at(whole, at[mine], at[mine], A.T @ A)
            whole[at[mine], count:] += A.T @ stacked[rows]
        if not count:
            return whole
        left = np.ascontiguousarray(whole[count:, count:])
        factor, gain = eliminate(whole[:count, :count], whole[:count, count:], left)
        self.eliminated.append(Eliminated(own, columns[count:], factor, gain))
        return left

    def _chained(self, rest: np.ndarray, over: np.ndarray, own: np.ndarray) -> np.ndarray:
        """From [twists | kept | b], of the columns `over`, to [own | kept | b], with all that are
        kept, by the chain rule, in units of sigmas. Unknowns that place a LiDAR and are neither in
        `own` nor kept are left out."""
        layout, first = self.layout, self.first
        columns = np.concatenate([own, layout.kept, [layout.size]])
        at = positions(layout.size + 1, columns)
        used = np.unique(at[np.concatenate([np.zeros(0, int), *(c for _, _, c in self.twists)])])
        used, others = used[used >= 0], at[over[first:]]
        chains = []
        for i, (_, d, c) in enumerate(self.twists):
            there = np.flatnonzero(at[c] >= 0)
            rows, twist = np.searchsorted(used, at[c[there]]), slice(TWIST * i, TWIST * (i + 1))
            chains.append((rows, twist, (d[:, there] * layout.sigma[c[there]]).T))
        beside = _times(chains, len(used), rest[:first])
        inner = _times(chains, len(used), np.ascontiguousarray(beside[:, :first].T))
        whole = np.zeros((len(columns), len(columns)))
        add_at(whole, others, others, rest[first:, first:])
        add_at(whole, used, used, inner)
        add_both(whole, used, others, beside[:, first:])
        return whole


def _times(
    chains: Sequence[tuple[np.ndarray, slice, np.ndarray]], size: int, by_twist: np.ndarray
) -> np.ndarray:
    """The transpose (size, T) of the chains of all stops times a matrix (T, n): stop by stop where
    each chain fills few of the rows, else as one product.

    Args:
        chains: per stop the rows (r,) that it fills, its columns, and what is there (r, 6).
        size: how many rows there are.
        by_twist: the matrix.
    """
    if DENSE * sum(len(rows) for rows, _, _ in chains) < size * len(chains):
        out = np.zeros((size, by_twist.shape[1]))
        for rows, twist, chain in chains:
            out[rows] += chain @ by_twist[twist]
        return out
    whole = np.zeros((size, len(by_twist)))
    for rows, twist, chain in chains:
        whole[rows, twist] = chain
    return whole @ by_twist
