"""From sums of stops to normal equations of what is kept.

Unknowns of stops are taken out first, many stops at a time, and all cells at the end: no matrix
grows with the number of stops, and most of the work is in products of large matrices.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from calib.linear.elimination import Eliminated, add_square, eliminate, square
from calib.linear.layout import Layout, positions
from calib.linear.own import OwnRows, alike
from calib.linear.rows import TWIST, OwnSums, StopSums
from calib.linear.system import Linearisation, Values
from calib.problem.unknowns import Role
from calib.residuals.compiled import add_at, add_sparse

# Most entries of the rows of stops that wait, over all columns: bounds the memory.
WAITING_ENTRIES = 2_000_000
STOPS_TOGETHER = 64  # without beams, whose rows are multiplied at once: of 32 to 256 the fastest


@dataclass(frozen=True)
class KeptSums:
    """The Gram matrix of whitened rows about kept unknowns.

    Args:
        gram: (n + 1, n + 1) over the columns and, last, the right side.
        columns: (n,) by which.
    """

    gram: np.ndarray
    columns: np.ndarray

    @classmethod
    def of(cls, A: np.ndarray, b: np.ndarray, columns: np.ndarray) -> KeptSums:
        """Of rows (m, n), however many, with a right side (m,)."""
        return cls(square(np.column_stack([A, b])), columns)


@dataclass(frozen=True)
class _Scanned:
    """A stop's beams, as far as they say something of where its LiDAR is.

    Args:
        stop: its number.
        information: (6, 6) of the twist.
        beside: (6, n) products of the twist with unknowns and, first, the right side, in units of
            sigmas; at: (n,) where these stand.
        chain: (6, m) derivative of the twist, in units of sigmas, by the columns (m,).
    """

    stop: int
    information: np.ndarray
    beside: np.ndarray
    at: np.ndarray
    chain: np.ndarray
    columns: np.ndarray


class Assembly:
    """Give it each stop's sums by `add`, those of other rows about kept unknowns by `add_kept`,
    then call ``done``.

    Its matrix is over ``[finest cells | coarser cells | kept | b]``, in units of sigmas. Half of it
    is held: the whole is that and its transpose. So a product of two different columns is added
    once, below the diagonal where one of them is a cell; of two that are kept it may stand on
    either side, or half of it on both.

    Args:
        layout: which column is what.
        own: rows about stops' own unknowns, those of priors last.
        raw: whether what rows tell of each kept unknown before eliminations is wanted.
    """

    def __init__(self, layout: Layout, own: Sequence[OwnRows], raw: bool) -> None:
        self.layout, self.rows, self.waiting = layout, own, _waiting(layout, own)
        self.raw = {n: np.zeros((u.dim, u.dim)) for n, u in layout.outer().items()} if raw else None
        self.cells = np.concatenate([layout.finest, layout.cells])
        self.columns = np.concatenate([self.cells, layout.kept, [layout.size]])
        self.at = positions(layout.size + 1, self.columns)
        self.half = np.zeros((len(self.columns), len(self.columns)))
        # What goes with stops' own unknowns, apart where it is asked what there was before.
        self.taken = np.zeros_like(self.half) if raw else self.half
        self.chi2 = sum(float(rows.b @ rows.b) for rows in own)
        self.touched = np.zeros(layout.size, bool)
        for rows in (rows for rows in own if rows.measured):
            shared = rows.shared.reshape(len(rows.b), -1)
            self.touched[rows.shared_columns] |= layout.moves(shared, rows.shared_columns)
            self.touched[rows.own_columns[layout.moves(rows.own, rows.own_columns)]] = True
        self.weight_m2 = self.beams_chi2 = 0.0
        self.eliminated: list[Eliminated] = []
        self.scans: dict[int, OwnSums] = {}
        self.scanned: list[_Scanned] = []
        widest = max(map(len, layout.own.values()), default=0) + 2 * TWIST
        self.together = max(WAITING_ENTRIES // (widest * len(self.columns)), 1)

    def add(self, sums: StopSums) -> None:
        """Add the beams of a stop."""
        self.weight_m2 += sums.weight_m2
        self.beams_chi2 += float(sums.dense[TWIST, TWIST])
        self.chi2 += float(sums.dense[TWIST, TWIST])
        seen = np.append(np.diag(sums.dense)[TWIST + 1 :], sums.own) > 0
        self.touched[sums.columns] |= seen
        # Twists are in m and rad, so rounding is less than in rows, which are in sigmas.
        self.touched[sums.chain_columns] |= self.layout.moves(sums.chain, sums.chain_columns)
        if self.raw is not None:
            self.scans[sums.stop] = sums.alone()
        sigma, width = self.layout.sigma, sums.dense.shape[1] - TWIST
        at = np.append(len(self.columns) - 1, self.at[sums.columns])
        unit = np.append(1.0, sigma[sums.columns])
        dense = sums.dense[TWIST:, TWIST:] * unit[:width] * unit[:width, None]
        with_dense = sums.with_dense.T * unit[width:]
        add_at(self.half, at[:width], at[:width], dense / 2)
        add_at(self.half, at[:width], at[width:], with_dense[TWIST:] * unit[:width, None])
        add_sparse(self.half, at[width:], unit[width:], sums.with_sparse, sums.own)
        by_twist = np.hstack([sums.dense[:TWIST, TWIST:] * unit[:width], with_dense[:TWIST]])
        found = _Scanned(
            stop=sums.stop,
            information=sums.dense[:TWIST, :TWIST],
            beside=by_twist,
            at=at,
            chain=sums.chain * sigma[sums.chain_columns],
            columns=sums.chain_columns,
        )
        self.scanned.append(found)
        if len(self.scanned) >= self.together:
            self._finish_scanned()

    def add_kept(self, sums: KeptSums) -> None:
        """Add the sums of whitened rows of scatter within holds, which are about kept unknowns."""
        self.chi2 += float(sums.gram[-1, -1])
        self.beams_chi2 += float(sums.gram[-1, -1])
        self.touched[sums.columns] |= np.diag(sums.gram)[:-1] > 0
        unit = np.append(self.layout.sigma[sums.columns], 1.0)
        at = np.append(self.at[sums.columns], len(self.columns) - 1)
        add_at(self.half, at, at, sums.gram * unit * unit[:, None] / 2)

    def done(self, values: Values) -> Linearisation:
        """Eliminate all but the kept."""
        self._finish_scanned()
        count, stops = len(self.cells), list(self.waiting)
        if self.raw is not None:
            for name, told in self.raw.items():
                first = self.at[self.layout.at[name].start]
                mine = slice(first, first + len(told))
                told += self.half[mine, mine] + self.half[mine, mine].T
            self.half += self.taken
        for first in range(0, len(stops), STOPS_TOGETHER):
            self._finish_without_beams(stops[first : first + STOPS_TOGETHER])
        rest = self.half[count:, count:] + self.half[count:, count:].T
        if count:
            prior = self._cell_priors(values)
            block, cross = self.half[:count, :count], self.half[count:, :count].T
            np.einsum("ii->i", block)[:] *= 2.0
            np.einsum("ii->i", block)[:] += 1.0
            cross[:, -1] += prior
            rest[-1, -1] += prior @ prior
            factor, gain = eliminate(block, cross, rest)
            self.eliminated.append(Eliminated(self.cells, self.columns[count:], factor, gain))
        return Linearisation(
            layout=self.layout,
            values=values,
            kept=rest,
            raw=self.raw,
            chi2=self.chi2,
            touched=self.touched,
            eliminated=self.eliminated,
            scans=self.scans,
            weight_m2=self.weight_m2,
            beams_chi2=self.beams_chi2,
        )

    def _cell_priors(self, values: Values) -> np.ndarray:
        """Right side (n,) of the priors of cells, in units of their sigmas: the derivative is 1."""
        whole = np.zeros(self.layout.size)
        for name, at in self.layout.at.items():
            if self.layout.unknowns[name].role is Role.SURFACE:
                whole[at] = -values[name] / self.layout.unknowns[name].sigma
        self.chi2 += float(whole[self.cells] @ whole[self.cells])
        return whole[self.cells]

    # ------------------------------------------------------------------------ stops with beams

    def _finish_scanned(self) -> None:
        """Add what the beams of the stops that wait say of where their LiDARs are, and the stops'
        own rows; eliminate what is their own.

        With the twist ``t = T_o o + T_k k`` of own and kept unknowns, its information A and what it
        has with all others B, a stop adds ``T_k' Z + Z' T_k - T_k' A T_k`` to the others, where
        ``Z = A T_k + B``; its own have ``T_o' A T_o`` with each other and ``T_o' Z`` with the rest.
        """
        beams, self.scanned = {each.stop: each for each in self.scanned}, []
        kept = positions(self.layout.size, self.layout.kept)
        for some in self._alike(list(beams)):
            mine, at = self._columns(some[0])
            count, (rows, _) = len(self._own(some[0])), self._stacked(some, at, len(mine))
            others = self.at[mine[count:]]
            A = np.stack([beams[stop].information for stop in some])
            T_own = np.zeros((len(some), TWIST, count))
            T_kept = np.zeros((len(some), TWIST, len(self.layout.kept)))
            Z = np.zeros((len(some), TWIST, len(self.columns)))
            place = np.full(self.layout.size, -1)
            for i, stop in enumerate(some):
                each = beams[stop]
                place[self._own(stop)] = np.arange(count)
                here, there = place[each.columns], kept[each.columns]
                T_own[i][:, here[here >= 0]] = each.chain[:, here >= 0]
                T_kept[i][:, there[there >= 0]] = each.chain[:, there >= 0]
                Z[i][:, each.at] = each.beside
                place[self._own(stop)] = -1
                self.waiting.pop(stop, None)
            moved = A @ T_kept
            Z[:, :, len(self.cells) : -1] += moved
            self._add_through(T_kept, moved, Z)
            self._add_squares(rows[:, :, count:], others)
            if not count:
                continue
            block = T_own.mT @ A @ T_own + rows[:, :, :count].mT @ rows[:, :, :count]
            factor = np.linalg.cholesky(block)
            gain = self._without(factor, T_own, Z, rows, others)
            for i, stop in enumerate(some):
                over = np.flatnonzero(gain[i].any(axis=0))
                found = Eliminated(self._own(stop), self.columns[over], factor[i], gain[i][:, over])
                self.eliminated.append(found)

    def _without(
        self,
        factor: np.ndarray,
        T_own: np.ndarray,
        Z: np.ndarray,
        rows: np.ndarray,
        others: np.ndarray,
    ) -> np.ndarray:
        """Take from the matrix what goes with the own unknowns of some stops; their gains (K, o, N)
        over all columns.

        What goes is the square of ``W = L^-1 (T_o' Z + R_o' R_r)``, with L the factor and R the own
        rows. Its rows are turned so that only six, the rank of a twist, touch more columns than R.

        Args:
            factor: (K, o, o), T_own: (K, 6, o), Z: (K, 6, N) as of `_finish_scanned`.
            rows: (K, m, o + r) own rows, of which the last r stand at `others` (r,).
        """
        count = factor.shape[1]
        wide = min(count, TWIST)
        Q, R = np.linalg.qr(np.linalg.solve(factor, T_own.mT), mode="complete")
        by_rows = rows[:, :, :count].mT @ rows[:, :, count:]
        by_rows = Q.mT @ np.linalg.solve(factor, by_rows)
        W, beyond = R[:, :wide] @ Z, by_rows[:, wide:]
        W[:, :, others] += by_rows[:, :wide]
        add_square(self.taken, W.reshape(-1, W.shape[2]), -1.0)
        self.taken[np.ix_(others, others)] -= square(beyond.reshape(-1, len(others))) / 2
        turned = np.linalg.solve(factor.mT, Q)
        gain = turned[:, :, :wide] @ W
        gain[:, :, others] += turned[:, :, wide:] @ beyond
        return gain

    def _add_through(self, T: np.ndarray, moved: np.ndarray, Z: np.ndarray) -> None:
        """Add what twists say by the kept unknowns (K, 6, S) they depend on."""
        used, first = np.flatnonzero(T.any(axis=(0, 1))), len(self.cells)
        chain = T.reshape(-1, T.shape[2])[:, used]
        self.half[first + used] += chain.T @ Z.reshape(-1, Z.shape[2])
        both = chain.T @ moved.reshape(-1, T.shape[2])[:, used]
        self.half[np.ix_(first + used, first + used)] -= both / 2

    def _add_squares(self, rows: np.ndarray, at: np.ndarray) -> None:
        """Add the products of rows (K, m, n) over columns that stand at (n,)."""
        self.half[np.ix_(at, at)] += square(rows.reshape(-1, len(at))) / 2

    # --------------------------------------------------------------------- stops without beams

    def _finish_without_beams(self, stops: Sequence[int]) -> None:
        """Eliminate what is their own from stops that have no beams. Their rows are few: they are
        turned until no more of them touch a stop's own unknowns than there are of these (QR), which
        go with these, and all others go into one product. Priors of their own unknowns have no
        more than a right side of what is shared."""
        for some in self._alike(stops):
            mine, at = self._columns(some[0])
            rows, told = self._stacked(some, at, len(mine))
            over, shared = mine[len(self._own(some[0])) :], rows[:, :, len(self._own(some[0])) :]
            if self.raw is not None:
                for name, some_of_it, its in alone(self.layout, over[:-1]):
                    A = shared[:, :told, some_of_it].reshape(-1, len(its))
                    self.raw[name][np.ix_(its, its)] += A.T @ A
            if count := len(mine) - len(over):
                Q, R = np.linalg.qr(rows[:, :, :count], mode="complete")
                inverse = np.linalg.inv(R[:, :count])
                gains = _turned(inverse @ Q[:, :, :count].mT, shared, told)
                self.eliminated += [
                    Eliminated(self._own(stop), over, root.T, gain)
                    for stop, root, gain in zip(some, R[:, :count], gains, strict=True)
                ]
                shared = _turned(Q[:, :, count:].mT, shared, told)
            add_square(self.half, _over(shared, self.at, over))
            for stop in some:
                del self.waiting[stop]

    # ------------------------------------------------------------------------- stops' own rows

    def _columns(self, stop: int) -> tuple[np.ndarray, np.ndarray]:
        """Columns (m,) that a stop's own rows touch, its own first and the right side last, and
        where among them each of all stands."""
        size, own = self.layout.size, self._own(stop)
        shared = (self.rows[each.of].shared_columns for each in self.waiting.get(stop, ()))
        mine = np.concatenate([own, np.unique(np.concatenate([*shared, [size]])).astype(int)])
        return mine, positions(size + 1, mine)

    def _own(self, stop: int) -> np.ndarray:
        return self.layout.own.get(stop, np.zeros(0, int))

    def _alike(self, stops: Sequence[int]) -> list[list[int]]:
        """Stops whose rows touch the same unknowns, but for their own, in the same order."""
        found: dict[object, list[int]] = {}
        for stop in stops:
            some = self.waiting.get(stop, ())
            like = len(self._own(stop)), tuple((each.of, each.order) for each in some)
            found.setdefault(like, []).append(stop)
        return list(found.values())

    def _stacked(self, stops: Sequence[int], at: np.ndarray, width: int) -> tuple[np.ndarray, int]:
        """Own rows (K, m, width) of stops that are alike, in units of sigmas, and how many come
        before those of priors; `at` says where the columns of the first of them stand."""
        each = list(zip(*(self.waiting.get(stop, ()) for stop in stops), strict=True))
        parts = [(self.rows[some[0].of], np.array([one.at for one in some])) for some in each]
        out = np.zeros((len(stops), sum(rows.of_each for rows, _ in parts), width))
        first, sigma = 0, self.layout.sigma
        for rows, k in parts:
            here = out[:, first : first + rows.of_each]
            first += rows.of_each
            shared, own = rows.shared_columns, rows.own_columns[k]
            here[:, :, at[shared]] = rows.shared[k] * sigma[shared]
            here[:, :, at[own[0]]] = rows.own[k] * sigma[own][:, None]
            here[:, :, -1] = rows.b.reshape(-1, rows.of_each)[k]
        return out, sum(rows.of_each for rows, _ in parts if rows.measured)


def alone(layout: Layout, columns: np.ndarray) -> Iterator[tuple[str, slice, np.ndarray]]:
    """Each unknown that columns (n,) are of, with where its own, side by side, stand among these
    and among its own (k,)."""
    names, first = list(layout.at), np.array([at.start for at in layout.at.values()])
    of = np.searchsorted(first, columns, side="right") - 1
    ends = [0, *(np.flatnonzero(np.diff(of)) + 1).tolist(), len(columns)]
    for start, end in pairwise(ends if len(columns) else ()):
        yield names[of[start]], slice(start, end), columns[start:end] - first[of[start]]


class _Waiting(NamedTuple):
    """Rows of a stop: of which set, which there, and in which order its own unknowns stand in
    them; a number for each order that there is in the set."""

    of: int
    at: int
    order: int


def _waiting(layout: Layout, own: Sequence[OwnRows]) -> dict[int, list[_Waiting]]:
    """Stop -> its rows, of all that have unknowns of their own."""
    found: dict[int, list[_Waiting]] = {stop: [] for stop in layout.own}
    rank = np.zeros(layout.size, int)
    for columns in layout.own.values():
        rank[columns] = np.arange(len(columns))
    for of, rows in enumerate(own):
        order = np.zeros(len(rows.stops), int)
        for number, some in enumerate(alike(rank[rows.own_columns])):
            order[some] = number
        for at, (stop, like) in enumerate(zip(rows.stops.tolist(), order.tolist(), strict=True)):
            found[stop].append(_Waiting(of, at, like))
    return found


def _turned(turn: np.ndarray, rows: np.ndarray, told: int) -> np.ndarray:
    """Rows (K, m, n) multiplied by (K, r, m), of which those that come after so many have zeros but
    for the right side, which is last."""
    out = turn[:, :, :told] @ rows[:, :told]
    out[:, :, -1:] += turn[:, :, told:] @ rows[:, told:, -1:]
    return out


def _over(rows: np.ndarray, at: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Rows (K, m, n) of some columns (n,), each (K m,) among the columns that stand somewhere in
    `at`."""
    rows, to, width = rows.reshape(-1, rows.shape[2]), at[columns], int(at.max(initial=-1)) + 1
    if np.array_equal(to, np.arange(width)):
        return rows
    out = np.zeros((len(rows), width))
    out[:, to[to >= 0]] = rows[:, to >= 0]
    return out
