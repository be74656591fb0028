"""From sums of stops to normal equations of what is kept, in either order of elimination.

`CellsFirst` holds one matrix over ``[twists of all stops | coarser cells | kept | b]``, and beside
it the finest cells as a diagonal and their products with all columns of that matrix. `StopsFirst`
holds one over ``[finest cells | coarser cells | kept | b]``, from which each stop's own unknowns
are gone. Both give the same result; see `calib.linear` for which is taken when.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from calib.linear.clusters import ClusteredRows
from calib.linear.elimination import BY_TWIST, Eliminated, eliminate, square
from calib.linear.layout import Layout, positions
from calib.linear.rows import TWIST, OwnSums, StopSums
from calib.linear.system import Linearisation, Values
from calib.problem.unknowns import Role
from calib.residuals.compiled import add_at, add_both, add_gram, add_sparse

# Where fewer than one entry in so many can differ from 0, a product stop by stop is faster than the
# whole one (measured: one in 7, 24 stops, 3.1 ms against 1.8; one in 23, 90 stops, 8.5 against 21).
DENSE = 8


@dataclass(frozen=True)
class OwnRows:
    """Whitened rows that are no beams: of a tracked body, of a prior, or of a hold's scatter.

    Args:
        A: (m, n) derivatives, columns: (n,) by which.
        b: (m,) minus the residuals.
        measured: False for a prior.
    """

    A: np.ndarray
    b: np.ndarray
    columns: np.ndarray
    measured: bool

    def of_stop(self, stop: int, place: np.ndarray | None = None) -> ClusteredRows:
        """The same as rows of a stop, each of a place (m,); -1 for none, as without it."""
        at, none = np.full(len(self.b), stop), np.full(len(self.b), -1)
        place = none if place is None else place
        return ClusteredRows(A=self.A, b=self.b, columns=self.columns, stop=at, place=place)

    def add_to(self, target: np.ndarray, at: np.ndarray, sigma: np.ndarray, b: int = -1) -> None:
        """Add their Gram matrix to another.

        Args:
            target: (N, N), added to.
            at: (U,) where columns stand in it, -1 for those that do not.
            sigma: (U,) units of the columns.
            b: where the right side stands; -1 if it does not.
        """
        rows = np.column_stack([self.A * sigma[self.columns], self.b])
        add_gram(target, np.append(at[self.columns], b), rows)


class Assembly:
    """What both orders share: give it each stop's sums by `add`, other rows about kept unknowns by
    `add_kept`, then call ``done``.

    Args:
        layout: which column is what.
        own: stop -> rows about its own unknowns.
        beams: how many stops have beams.
        raw: whether the Gram matrix before eliminations is wanted.
    """

    def __init__(
        self, layout: Layout, own: Mapping[int, Sequence[OwnRows]], beams: int, raw: bool
    ) -> None:
        self.layout, self.own = layout, own
        self.raw = np.zeros((len(layout.kept), len(layout.kept))) if raw else None
        self.chi2 = sum(float(rows.b @ rows.b) for each in own.values() for rows in each)
        self.touched = np.zeros(layout.size, bool)
        for rows in (r for each in own.values() for r in each if r.measured):
            self.touched[rows.columns] |= np.any(rows.A != 0, axis=0)
        self.weight_m2 = self.beams_chi2 = 0.0
        self.eliminated: list[Eliminated] = []
        self.twists: list[tuple[int, np.ndarray, np.ndarray]] = []
        self.scans: dict[int, OwnSums] = {}

    def add(self, sums: StopSums) -> None:
        """Add the beams of a stop."""
        self.weight_m2 += sums.weight_m2
        self.beams_chi2 += float(sums.dense[TWIST, TWIST])
        self.chi2 += float(sums.dense[TWIST, TWIST])
        seen = np.append(np.diag(sums.dense)[TWIST + 1 :], sums.own) > 0
        self.touched[sums.columns] |= seen
        self.touched[sums.chain_columns] |= np.any(sums.chain != 0, axis=0)
        if self.raw is not None:
            self.scans[sums.stop] = sums.alone()

    def _add_raw(self, found: Iterable[OwnRows]) -> None:
        """Add what rows say of kept columns."""
        at = positions(self.layout.size, self.layout.kept)
        for rows in found:
            rows.add_to(self.raw, at, self.layout.sigma)

    def add_kept(self, rows: OwnRows) -> None:
        """Add whitened rows about kept unknowns."""
        self.chi2 += float(rows.b @ rows.b)
        self.touched[rows.columns] |= np.any(rows.A != 0, axis=0)

    def _cell_priors(self, values: Values, columns: np.ndarray) -> np.ndarray:
        """Right side (n,) of the priors of cells, in units of their sigmas: the derivative is 1."""
        whole = np.zeros(self.layout.size)
        for name, at in self.layout.at.items():
            if self.layout.unknowns[name].role is Role.SURFACE:
                whole[at] = -values[name] / self.layout.unknowns[name].sigma
        self.chi2 += float(whole[columns] @ whole[columns])
        return whole[columns]

    def _done(self, values: Values, kept: np.ndarray) -> Linearisation:
        return Linearisation(
            beams_chi2=self.beams_chi2,
            layout=self.layout,
            values=values,
            kept=kept,
            raw=self.raw,
            chi2=self.chi2,
            touched=self.touched,
            eliminated=self.eliminated,
            twists=self.twists,
            scans=self.scans,
            weight_m2=self.weight_m2,
        )


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

    def add_kept(self, rows: OwnRows) -> None:
        """Add whitened rows about kept unknowns."""
        super().add_kept(rows)
        rows.add_to(self.rest, self.at, np.ones(self.layout.size), self.b)

    def done(self, values: Values) -> Linearisation:
        """Eliminate all but the kept."""
        layout = self.layout
        over = np.concatenate([layout.cells, layout.kept, [layout.size]])
        over = np.append(np.full(self.first, BY_TWIST), over).astype(int)
        unit = np.ones(self.b + 1)
        unit[self.first : self.b] = layout.sigma[over[self.first : -1]]
        rest = self.rest * unit * unit[:, None]
        if self.raw is not None:
            cells = np.arange(self.first, self.first + len(layout.cells))
            before = np.delete(np.delete(rest, cells, 0), cells, 1)
            self.raw += self._chained(before, np.zeros(0, int))[:-1, :-1]
            self.raw += self._own_rows[1][:-1, :-1]
        if len(layout.finest):
            own = layout.sigma[layout.finest]
            cross = self.cross * own[:, None] * unit
            prior = self._cell_priors(values, layout.finest)
            cross[:, -1] += prior
            rest[-1, -1] += prior @ prior
            factor, gain = eliminate(self.diagonal * own**2 + 1.0, cross, rest)
            self.eliminated.append(Eliminated(layout.finest, over, factor, gain))
        cells = np.arange(self.first, self.first + len(layout.cells))
        left = np.setdiff1d(np.arange(self.b + 1), cells)
        if len(cells):
            rest[cells, cells] += 1.0
            prior = self._cell_priors(values, layout.cells)
            rest[cells, -1] += prior
            rest[-1, cells] += prior
            rest[-1, -1] += prior @ prior
            cross, block = rest[np.ix_(cells, left)], rest[np.ix_(cells, cells)]
            rest = rest[np.ix_(left, left)]
            factor, gain = eliminate(block, cross, rest)
            self.eliminated.append(Eliminated(layout.cells, over[left], factor, gain))
        return self._done(values, self._without_own(rest))

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

    def _without_own(self, rest: np.ndarray) -> np.ndarray:
        """From [twists | kept | b] to [kept | b]: through the chain, then stops' own unknowns."""
        layout = self.layout
        own = np.concatenate([np.zeros(0, int), *layout.own.values()])
        columns = np.concatenate([own, layout.kept, [layout.size]])
        at = positions(layout.size + 1, columns)
        whole, count = self._chained(rest, own), len(own)
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

    def _chained(self, rest: np.ndarray, own: np.ndarray) -> np.ndarray:
        """From [twists | kept | b] to [own | kept | b] by the chain rule, in units of sigmas.
        Unknowns that place a LiDAR and are neither in `own` nor kept are left out."""
        layout, first = self.layout, self.first
        columns = np.concatenate([own, layout.kept])
        at = positions(layout.size, columns)
        used = np.unique(at[np.concatenate([np.zeros(0, int), *(c for _, _, c in self.twists)])])
        used = used[used >= 0]
        chains = []
        for i, (_, d, c) in enumerate(self.twists):
            there = np.flatnonzero(at[c] >= 0)
            rows, twist = np.searchsorted(used, at[c[there]]), slice(TWIST * i, TWIST * (i + 1))
            chains.append((rows, twist, (d[:, there] * layout.sigma[c[there]]).T))
        beside = _times(chains, len(used), rest[:first])
        inner = _times(chains, len(used), np.ascontiguousarray(beside[:, :first].T))
        whole = np.zeros((len(columns) + 1, len(columns) + 1))
        whole[len(own) :, len(own) :] = rest[first:, first:]
        add_at(whole, used, used, inner)
        add_both(whole, used, np.arange(len(own), len(whole)), beside[:, first:])
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

    def add_kept(self, rows: OwnRows) -> None:
        """Add whitened rows about kept unknowns."""
        super().add_kept(rows)
        if self.raw is not None:
            self._add_raw([rows])
        rows.add_to(self.total, self.at, self.layout.sigma, len(self.columns) - 1)

    def _columns(self, stop: int, *beams: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Columns (m,) that a stop's rows touch, its own first and the right side last, and where
        among them each of all stands; those of its beams are given."""
        size, own = self.layout.size, self.layout.own.get(stop, np.zeros(0, int))
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
        count = len(layout.own.get(stop, ()))
        rest = whole[count:, count:]
        if count:
            factor, gain = eliminate(whole[:count, :count], whole[:count, count:], rest)
            self.eliminated.append(Eliminated(mine[:count], mine[count:], factor, gain))
        to = self.at[mine[count:]]
        add_at(self.total, to, to, rest)

    def done(self, values: Values) -> Linearisation:
        """Eliminate all but the kept."""
        for stop in list(self.waiting):
            mine, at = self._columns(stop)
            self._finish(stop, mine, at, np.zeros((len(mine), len(mine))))
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
