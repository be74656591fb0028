"""Whitened rows about what stops have for themselves, of many stops at a time.

They are of tracked bodies, and of the priors of stops' own unknowns. A tracker may give thousands
of stops a few rows each, all by the same unknowns but for the stops' own: so they are held as
arrays over stops.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from calib.linear.clusters import ClusteredRows, Entries
from calib.linear.layout import Layout
from calib.residuals.seen import BodiesTogether
from chains import se3

Values = Mapping[str, np.ndarray]


@dataclass(frozen=True)
class OwnRows:
    """Whitened rows in K sets of m, each of one stop, of which there may be several: by unknowns
    that stops share, and by the stop's own.

    Args:
        shared: (K, m, s) derivatives by the unknowns in the columns shared_columns (s,).
        own: (K, m, o) by those in the columns own_columns (K, o).
        b: (K m,) minus the residuals, set after set.
        stops: (K,) numbers of the stops.
        measured: False for priors.
    """

    shared: np.ndarray
    shared_columns: np.ndarray
    own: np.ndarray
    own_columns: np.ndarray
    b: np.ndarray
    stops: np.ndarray
    measured: bool

    @property
    def of_each(self) -> int:
        """m, the rows of each set."""
        return self.own.shape[1]

    @property
    def stop(self) -> np.ndarray:
        """(K m,) the stop of each row."""
        return np.repeat(self.stops, self.of_each)

    @property
    def place(self) -> np.ndarray:
        """(K m,) -1: they are of no part of the room."""
        return np.full(len(self.b), -1)

    def with_residuals(self, b: np.ndarray) -> Self:
        """The same with others (K m,) on the right side."""
        return replace(self, b=b)

    def along(self, directions: np.ndarray) -> ClusteredRows:
        """The rows over q directions (U, q) in all unknowns."""
        A = self.own @ directions[self.own_columns]
        A += self.shared @ directions[self.shared_columns]
        every, flat = np.arange(directions.shape[1]), A.reshape(-1, directions.shape[1])
        return ClusteredRows(A=flat, b=self.b, columns=every, stop=self.stop, place=self.place)

    def entries(self) -> Entries:
        """All rows, as what in them is not zero."""
        return self._entries(self.shared, self.own)

    def gradients(self) -> tuple[Entries, np.ndarray, np.ndarray]:
        """``J^T W b`` of each set; and the stop and place (K,) of each."""
        b = self._of_each(self.b)[:, None]
        entries = self._entries(b @ self.shared, b @ self.own)
        return entries, self.stops, np.full(len(self.stops), -1)

    def add_gradient(self, b: np.ndarray, out: np.ndarray) -> None:
        """Add ``J^T b`` of a right side (K m,) to (U,)."""
        out[self.shared_columns] += b @ self.shared.reshape(len(b), -1)
        by_own = self._of_each(b)[:, None] @ self.own
        np.add.at(out, self.own_columns, by_own[:, 0])  # a stop may stand twice

    def _of_each(self, b: np.ndarray) -> np.ndarray:
        return b.reshape(len(self.stops), -1)

    def _entries(self, shared: np.ndarray, own: np.ndarray) -> Entries:
        A = np.concatenate([shared, own], axis=2)
        every = np.broadcast_to(self.shared_columns, (len(own), len(self.shared_columns)))
        columns = np.hstack([every, self.own_columns])[:, None]
        there = A != 0
        columns = np.broadcast_to(columns, A.shape)[there]
        return Entries(A[there], columns, there.sum(axis=2).ravel())


def own_rows(layout: Layout, values: Values) -> list[OwnRows]:
    """Rows of the tracked bodies that depend on stops' own unknowns, and of these unknowns'
    priors."""
    found: list[OwnRows] = []
    for together in layout.bodies:
        found += _told_apart(layout, *body_rows(layout, together, values), True)
    mine = [name for name, at in layout.at.items() if (layout.owner[at] >= 0).any()]
    for names, A, b in priors(layout, mine, values):
        found += _told_apart(layout, A, b, layout.columns_of_each(names), False)
    return found


def body_rows(
    layout: Layout, together: BodiesTogether, values: Values
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Whitened rows of K blocks: derivatives (K, m, n), right sides (K, m), and by which columns
    (K, n): first those of the stops' own unknowns, but where only some of the stops have such."""
    at = {n: layout.columns_of_each(together.named(n)) for n in together.whole.variables}
    names = sorted(at, key=lambda name: layout.owner[at[name][0, 0]] < 0)
    residual, A, _ = together.table(values, names)
    each = [np.broadcast_to(at[name], (len(residual), at[name].shape[1])) for name in names]
    return A, -residual, np.hstack(each)


def _told_apart(
    layout: Layout, A: np.ndarray, b: np.ndarray, columns: np.ndarray, measured: bool
) -> Iterator[OwnRows]:
    """Rows (K, m, n) of stops, by unknowns in the columns (K, n), as such of what is shared and of
    what is a stop's own: of all stops at once that share the same."""
    owner = layout.owner[columns]
    for some in alike(np.where(owner < 0, columns, -1)):
        mine, rows, right, at = owner[some[0]] >= 0, A, b, columns
        if len(some) < len(A):
            rows, right, at = A[some], b[some], columns[some]
        count = int(mine.sum())
        if not mine[:count].all():
            order = np.argsort(~mine, kind="stable")
            rows, at = rows[:, :, order], at[:, order]
        yield OwnRows(
            shared=rows[:, :, count:],
            shared_columns=at[0, count:],
            own=rows[:, :, :count],
            own_columns=at[:, :count],
            b=right.ravel(),
            stops=owner[some, np.argmax(mine)],
            measured=measured,
        )


def alike(table: np.ndarray) -> list[np.ndarray]:
    """The rows of a table that are the same as each other: the numbers of each such set."""
    if (table == table[:1]).all():
        return [np.arange(len(table))]
    _, which = np.unique(table, axis=0, return_inverse=True)
    order = np.argsort(which.ravel(), kind="stable")
    return np.split(order, np.cumsum(np.bincount(which.ravel()))[:-1])


def priors(
    layout: Layout, names: Sequence[str], values: Values
) -> Iterator[tuple[list[str], np.ndarray, np.ndarray]]:
    """Rows of the own priors of some unknowns, of vectors and of poses, of all at once that have
    as many components: which (K), their derivatives (K, n, n) and right sides (K, n)."""
    groups: dict[tuple[bool, int], list[str]] = {}
    for name in names:
        unknown = layout.unknowns[name]
        groups.setdefault((unknown.kind == "pose", unknown.dim), []).append(name)
    for (poses, dim), some in groups.items():
        known = [layout.unknowns[name] for name in some]
        mean, here = np.stack([u.mean for u in known]), np.stack([values[name] for name in some])
        root = np.stack([u.prior_root for u in known])
        A = np.broadcast_to(np.eye(dim), (len(some), dim, dim))
        away = here - mean
        if poses:
            away = se3.log(se3.inverse(mean) @ here)
            A = se3.right_jacobian_inverse(away)
        yield some, root @ A, -np.einsum("kij,kj->ki", root, away)
