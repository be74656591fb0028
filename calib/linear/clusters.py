"""The gradient ``J^T W b`` of each cluster of rows: those that err together count as one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array, issparse


def summed(values: np.ndarray, at: np.ndarray, count: int | None = None) -> np.ndarray:
    """Sums (G, P) of values (N, P) by group (N,), numbered from 0; -1 for none. There are as many
    groups as are met, or this `count` of them."""
    used = np.flatnonzero(at >= 0)
    count = int(at.max(initial=-1)) + 1 if count is None else count
    return csr_array((np.ones(len(used)), (at[used], used)), shape=(count, len(at))) @ values


class Entries(NamedTuple):
    """Rows over some of U columns, as what in them is not zero.

    Args:
        values: (E,), row after row.
        columns: (E,) of each.
        count: (m,) how many each row has.
    """

    values: np.ndarray
    columns: np.ndarray
    count: np.ndarray

    @classmethod
    def of(cls, A: np.ndarray | csr_array, columns: np.ndarray) -> Entries:
        """Of rows (m, n) over some columns (n,), of which one may stand more than once."""
        if issparse(A):
            found = csr_array(A)
            return cls(found.data, columns[found.indices], np.diff(found.indptr))
        row, at = np.nonzero(A)
        return cls(A[row, at], columns[at], np.bincount(row, minlength=len(A)))

    @classmethod
    def one_each(cls, values: np.ndarray, columns: np.ndarray) -> Entries:
        """Of rows with one value (m,) each, in these columns (m,)."""
        return cls(values, columns, np.ones(len(columns), int))


def over_all(some: Sequence[Entries], size: int) -> csr_array:
    """Some rows, one after the other, over all columns (R, U)."""
    if not some:
        return csr_array((0, size))
    values, columns, count = map(np.concatenate, zip(*some, strict=True))
    return csr_array((values, columns, np.append(0, np.cumsum(count))), shape=(len(count), size))


class ClusteredRows(NamedTuple):
    """Whitened rows, and the cluster of each: rows of one stop and place err together.

    Args:
        A: (m, n) derivatives, sparse where each row has one; columns: (n,) by which.
        b: (m,) minus the residuals.
        stop, place: (m,) numbers of the stop and of what is looked at; -1 for none.
    """

    A: np.ndarray | csr_array
    b: np.ndarray
    columns: np.ndarray
    stop: np.ndarray
    place: np.ndarray

    def with_residuals(self, b: np.ndarray) -> ClusteredRows:
        """The same with others (m,) on the right side."""
        return self._replace(b=b)

    def along(self, directions: np.ndarray) -> ClusteredRows:
        """The rows over q directions (U, q) in all unknowns."""
        every = np.arange(directions.shape[1])
        return self._replace(A=self.A @ directions[self.columns], columns=every)

    def entries(self) -> Entries:
        """All rows, as what in them is not zero."""
        return Entries.of(self.A, self.columns)

    def gradients(self) -> tuple[Entries, np.ndarray, np.ndarray]:
        """``J^T W b`` of each cluster; and the stop and place (C,) of each. Each row of a sparse
        derivative is a cluster of its own."""
        if issparse(self.A):
            found, clusters = self.A.multiply(self.b[:, None]), (self.stop, self.place)
        elif np.ptp(self.stop) == 0 == np.ptp(self.place):
            found, clusters = (self.b @ self.A)[None], (self.stop[:1], self.place[:1])
        else:
            pairs, cell = np.unique([self.stop, self.place], axis=1, return_inverse=True)
            shape = len(self.b), pairs.shape[1]
            pick = csr_array((self.b, cell, np.arange(len(self.b) + 1)), shape=shape)
            found, clusters = pick.T @ self.A, tuple(pairs)
        return Entries.of(found, self.columns), *clusters

    def add_gradient(self, b: np.ndarray, out: np.ndarray) -> None:
        """Add ``J^T b`` of a right side (m,) to (U,)."""
        out[self.columns] += self.A.T @ b


class CellSums(NamedTuple):
    """Sums of a stop's whitened rows along P directions, by what they look at.

    Args:
        stop: number of the stop.
        place: (G,) numbers of what is looked at.
        moved: (G, P) derivatives times right side, added up.
        share: (G, P) squares of the derivatives, added up.
        products: (P, P) products of the derivatives, all added up.
    """

    stop: int
    place: np.ndarray
    moved: np.ndarray
    share: np.ndarray
    products: np.ndarray


@dataclass
class Gradients:
    """``J^T W b`` of clusters of rows: beams of a stop on a surface, bodies at a stop, ...

    Args:
        size: number of columns, U.
    """

    size: int
    places: dict[object, int] = field(default_factory=dict)
    _entries: list[Entries] = field(default_factory=list)
    _clusters: list[np.ndarray] = field(default_factory=list)

    def place(self, key: object) -> int:
        """Number of a part of the room, or of anything else that errs alike for several stops."""
        return self.places.setdefault(key, len(self.places))

    def numbers(self, room: object, parts: np.ndarray) -> np.ndarray:
        """Numbers of parts of a room."""
        return np.array([self.place((room, part)) for part in parts.tolist()], int)

    def add(
        self,
        gradient: np.ndarray | csr_array,
        columns: np.ndarray,
        stop: np.ndarray,
        place: np.ndarray,
    ) -> None:
        """Add clusters (C, n) over some columns (n,), of stops and places (C,), -1 for none."""
        self.add_entries(Entries.of(gradient, columns), stop, place)

    def add_entries(self, entries: Entries, stop: np.ndarray, place: np.ndarray) -> None:
        """Add clusters as rows give them, see `ClusteredRows.gradients`."""
        self._entries.append(entries)
        self._clusters.append(np.stack([stop, place]))

    def table(self) -> tuple[csr_array, np.ndarray, np.ndarray]:
        """All clusters (C, U), sparse; the stop and the place (C,) of each."""
        stop, place = np.concatenate(self._clusters, axis=1)
        return over_all(self._entries, self.size), stop, place
