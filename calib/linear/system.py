"""The result of a linearisation: normal equations of what is kept, and the way back to the rest.

The step, the covariance and every test are read off it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.sparse import csr_array

from calib.linear.clusters import Entries, over_all
from calib.linear.elimination import Eliminated
from calib.linear.layout import Layout, positions
from calib.linear.rows import OwnSums, Weighing

Values = Mapping[str, np.ndarray]
ROWS_AT_ONCE = 256  # rows whose variances are computed at once: 1024 take half as long again
ELIMINATED_AT_ONCE = 128  # whose unknowns follow from others in one product, likewise


@dataclass(frozen=True)
class Linearisation:
    """Normal equations at a state, down to the kept unknowns of a layout.

    Args:
        layout: which column is what.
        values: the state.
        kept: (S + 1, S + 1) Gram matrix over the layout's kept columns and, last, the right side b,
            in units of the priors' sigmas; without the priors of the kept, and without the layout's
            other blocks. Its last diagonal entry is what of chi2 the eliminated cannot take away.
        raw: kept unknown -> (n, n) its Gram matrix before anything was eliminated, where gradients
            were asked for.
        chi2: of all rows in it, before anything was eliminated.
        touched: (U,) bool, whether any beam or tracked body depends on a column.
        eliminated: what was eliminated, in that order.
        scans: stop -> what its beams say of a shift that it alone has; empty unless gradients were
            asked for.
        weight_m2: sum of the beams' weights over their variances, 1/m2.
        beams_chi2: what of chi2 is of beams, at their weights, and of their scatter within holds.
        weighed: per stop with beams, how they were weighed here.
        beams_cost: half their robust chi-square, so weighed.
        cost_before: the same as they were weighed elsewhere; None where that was not asked for.
    """

    layout: Layout
    values: Values
    kept: np.ndarray
    raw: Mapping[str, np.ndarray] | None
    chi2: float
    touched: np.ndarray
    eliminated: Sequence[Eliminated]
    scans: Mapping[int, OwnSums]
    weight_m2: float
    beams_chi2: float
    weighed: Sequence[Weighing] = ()
    beams_cost: float = 0.0
    cost_before: float | None = None

    def onto(self, layout: Layout) -> Linearisation:
        """The same rows, but for `raw`, over the unknowns of another layout, which lacks some of
        those kept."""
        here = np.concatenate([np.r_[self.layout.at[name]] for name in layout.at])
        to = positions(self.layout.size + 1, np.append(here, self.layout.size))
        at = positions(self.layout.size, self.layout.kept)[here[layout.kept]]
        withal = np.append(at, len(self.kept) - 1)
        return replace(
            self,
            layout=layout,
            kept=self.kept[np.ix_(withal, withal)],
            raw=None,
            touched=self.touched[here],
            eliminated=[each.onto(to) for each in self.eliminated],
            scans={stop: sums.onto(to) for stop, sums in self.scans.items()},
        )

    def directions(self, kept: np.ndarray) -> np.ndarray:
        """All unknowns (U, q) that follow from those kept (S + 1, q), in units of their sigmas.

        The last row of `kept` is what the right side is multiplied by: -1 for a solution, 0 for a
        direction, of which the right side is no part.
        """
        layout = self.layout
        out = np.zeros((layout.size + 1, kept.shape[1]))
        out[layout.kept], out[-1] = kept[:-1], kept[-1]
        for some in self._batches():
            over = np.unique(np.concatenate([each.over for each in some]))
            at = positions(layout.size + 1, over)
            gain, first = np.zeros((sum(len(each.columns) for each in some), len(over))), 0
            for each in some:
                gain[first : first + len(each.columns), at[each.over]] = each.gain
                first += len(each.columns)
            out[np.concatenate([each.columns for each in some])] = -(gain @ out[over])
        return out[:-1]

    def _batches(self) -> Iterator[list[Eliminated]]:
        """What was eliminated, last first, as many together as do not depend on each other."""
        some: list[Eliminated] = []
        among = np.zeros(self.layout.size + 1, bool)
        for each in reversed(self.eliminated):
            if some and (len(some) == ELIMINATED_AT_ONCE or among[each.over].any()):
                yield some
                some, among[:] = [], False
            some.append(each)
            among[each.columns] = True
        if some:
            yield some

    def followed(self, kept: np.ndarray) -> np.ndarray:
        """Directions in all unknowns (U, q) that follow from those in the kept (S, q), in the
        unknowns' own units."""
        sigma = self.layout.sigma
        scaled = np.vstack([kept / sigma[self.layout.kept, None], np.zeros((1, kept.shape[1]))])
        return self.directions(scaled) * sigma[:, None]

    def step(self, kept: np.ndarray) -> dict[str, np.ndarray]:
        """Tangent step of each eliminated unknown, given that of the kept (S,) in their units."""
        scaled = np.append(kept / self.layout.sigma[self.layout.kept], -1.0)
        moved = self.directions(scaled[:, None])[:, 0] * self.layout.sigma
        return {name: moved[self.layout.at[name]] for name in self.layout.inner()}

    def reduced(self, rows: csr_array) -> np.ndarray:
        """Rows (n, U) over all unknowns, in these' own units, as rows over the kept (n, S) that
        say the same of each state in which what was eliminated follows the kept."""
        found = np.empty((rows.shape[0], len(self.layout.kept)))
        first = np.full(len(found), len(self.eliminated))
        gone = self._gone_in[rows.indices]
        row = np.repeat(np.arange(len(found)), np.diff(rows.indptr))
        np.minimum.at(first, row[gone >= 0], gone[gone >= 0])
        order = np.argsort(first, kind="stable")  # those of one stop together
        for some in np.array_split(order, range(ROWS_AT_ONCE, len(order), ROWS_AT_ONCE)):
            for each, _, mine in self._through(rows[some]):
                if each is None:
                    found[some] = mine
        return found

    def covariance(self, rows: csr_array, kept: np.ndarray) -> np.ndarray:
        """Covariance (q, q) of ``rows @ unknowns``.

        Args:
            rows: (q, U) over all unknowns.
            kept: (S, S) covariance of the kept.
        """
        out = np.zeros((rows.shape[0], rows.shape[0]))
        for some, mine, known in self._shares(rows, kept):
            out[np.ix_(some, some)] += mine @ known
        return out

    def _shares(
        self, rows: csr_array, kept: np.ndarray
    ) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """What each step of the elimination, and the kept, add to a covariance of rows: of which
        rows (n,), these over some unknowns (n, e), and the unknowns' covariance with them (e, n);
        arguments as of `covariance`."""
        for each, some, mine in self._through(rows):
            yield some, mine, kept @ mine.T if each is None else each.solve(mine.T)

    def _through(
        self, rows: csr_array
    ) -> Iterator[tuple[Eliminated | None, np.ndarray, np.ndarray]]:
        """Rows (n, U) through the elimination: for each step of it that they touch, which of them
        do (m,), and these (m, e) over its unknowns, in units of sigmas. Last, for no step, all rows
        over the kept (n, S), in the unknowns' own units."""
        sigma, last = self.layout.sigma, self.layout.kept
        touched = np.unique(rows.indices)
        concerned = self._concerned(touched)
        # Over no more columns than these rows come to: of many stops they touch a few.
        parts = [p for each in concerned for p in (each.columns, each.over)]
        columns = np.unique(np.concatenate([touched, last, [self.layout.size], *parts]))
        at = positions(self.layout.size + 1, columns)
        scaled = rows.data * sigma[rows.indices], at[rows.indices], rows.indptr
        left = csr_array(scaled, (rows.shape[0], len(columns))).toarray()
        for each in concerned:
            mine = left[:, at[each.columns]]
            some = np.flatnonzero(np.any(mine != 0, axis=1))
            if not len(some):
                continue
            mine = mine[some]
            yield each, some, mine
            left[np.ix_(some, at[each.over])] -= mine @ each.gain
        yield None, np.arange(len(left)), left[:, at[last]] / sigma[last]

    @cached_property
    def _gone_in(self) -> np.ndarray:
        """(U + 1,) in which step of the elimination each column goes; -1 for those kept."""
        out = np.full(self.layout.size + 1, -1)
        for i, each in enumerate(self.eliminated):
            out[each.columns] = i
        return out

    def _concerned(self, touched: np.ndarray) -> list[Eliminated]:
        """The steps of the elimination, in order, that rows which touch some columns (n,) go
        through."""
        wanted, found = set(self._gone_in[touched].tolist()), []
        for i, each in enumerate(self.eliminated):
            if i in wanted:
                found.append(each)
                wanted.update(self._gone_in[each.over].tolist())
        return found

    def variances(
        self, some: Sequence[Mapping[str, np.ndarray]], kept: np.ndarray
    ) -> list[np.ndarray]:
        """Variances (m,) of ``rows @ tangents``, of each of some sets of rows.

        Args:
            some: of each set, unknown -> (m, n) the rows over its tangents.
            kept: (S, S) covariance of the kept.
        """
        tables = [np.hstack(list(by.values())) for by in some]
        ends = np.cumsum([0, *(len(table) for table in tables)])
        columns = (self.layout.columns(list(by)) for by in some)
        entries = [Entries.of(*each) for each in zip(tables, columns, strict=True)]
        rows = over_all(entries, self.layout.size)
        found = np.zeros(rows.shape[0])
        for first in range(0, len(found), ROWS_AT_ONCE):
            here = slice(first, first + ROWS_AT_ONCE)
            for at, mine, known in self._shares(rows[here], kept):
                found[here][at] += np.einsum("ij,ji->i", mine, known)
        return np.split(found, ends[1:])[:-1]
