"""From sums of stops to normal equations of what is kept, stops first.

Unknowns of stops are taken out many stops at a time, and all cells at the end: no matrix grows with
the number of stops, and most of the work is in products of large matrices.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from calib.linear.assembly.common import Assembly, Scanned, alone
from calib.linear.elimination import Eliminated, add_square, square
from calib.linear.layout import Layout, positions
from calib.linear.own import OwnRows, alike
from calib.linear.rows import TWIST
from calib.linear.system import Values

STOPS_TOGETHER = 64  # without beams, whose rows are multiplied at once: of 32 to 256 the fastest


class StopsFirst(Assembly):
    """Beside cells its matrix has what is kept; arguments as of `Assembly`."""

    def __init__(self, layout: Layout, own: Sequence[OwnRows], raw: bool) -> None:
        super().__init__(layout, own, raw, layout.kept)
        self.waiting = _waiting(layout, own)
        # What goes with stops' own unknowns, apart where it is asked what there was before.
        self.taken = np.zeros_like(self.half) if raw else self.half

    def eliminate(self, values: Values) -> np.ndarray:
        stops = list(self.waiting)
        if self.raw is not None:
            self.tell_raw()
            self.half += self.taken
        for first in range(0, len(stops), STOPS_TOGETHER):
            self._finish_without_beams(stops[first : first + STOPS_TOGETHER])
        return self.without_cells(values, [len(self.cells)])

    # ------------------------------------------------------------------------ stops with beams

    def add_twists(self, beams: Sequence[Scanned]) -> None:
        """Add what the beams of stops say of where their LiDARs are, and the stops' own rows;
        eliminate what is their own.

        With the twist ``t = T_o o + T_k k`` of own and kept unknowns, and A and Z as `add_through`
        has them for T_k, its own have ``T_o' A T_o`` with each other and ``T_o' Z`` with the rest.
        """
        by_stop = {each.stop: each for each in beams}
        for some in self._alike(list(by_stop)):
            mine, at = self._columns(some[0])
            count, (rows, _) = len(self._own(some[0])), self._stacked(some, at, len(mine))
            others = self.at[mine[count:]]
            A, Z = self.add_through([by_stop[stop] for stop in some])
            T_own = np.zeros((len(some), TWIST, count))
            place = np.full(self.layout.size, -1)
            for i, stop in enumerate(some):
                each = by_stop[stop]
                place[self._own(stop)] = np.arange(count)
                here = place[each.columns]
                T_own[i][:, here[here >= 0]] = each.chain[:, here >= 0]
                place[self._own(stop)] = -1
                self.waiting.pop(stop, None)
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
            factor: (K, o, o), T_own: (K, 6, o), Z: (K, 6, N) as of `add_through`.
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
