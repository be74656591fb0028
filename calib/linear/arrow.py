"""Normal equations of which many sets of unknowns touch, beside themselves, only what all share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cholesky, solve_triangular
from scipy.sparse import csr_array, issparse
from scipy.sparse.csgraph import connected_components

from calib.linear.elimination import square


@dataclass(frozen=True, eq=False)
class Arrow:
    """A factor of H (U, U), an arrow: blocks of sets of unknowns, and what is shared beside them.

    With ``H = [D E; E' F]``, where D is of blocks, ``D = L L'`` and ``W = L^-1 E``, what is left of
    F is ``F - W' W = R' R``. So the work grows with the number of sets, not with its cube.

    Args:
        sets: (K, o) columns of K sets of o unknowns, for each o that there is.
        inverse: (K, o, o) inverse of L of each.
        beside: (O, S) W, over the columns of all sets, one after the other.
        shared: (S,) columns of the others.
        factor: (S, S) R, upper.
    """

    sets: Sequence[np.ndarray]
    inverse: Sequence[np.ndarray]
    beside: np.ndarray
    shared: np.ndarray
    factor: np.ndarray

    @classmethod
    def of(cls, H: csr_array | np.ndarray, own: Sequence[np.ndarray]) -> Arrow:
        """Of a symmetric positive definite matrix; `own` are the columns of each set."""
        shared = np.setdiff1d(np.arange(H.shape[0]), np.concatenate([np.zeros(0, int), *own]))
        sizes = sorted({len(c) for c in own} - {0})
        sets = [np.stack([c for c in own if len(c) == size]) for size in sizes]
        inverse, beside = [], [np.zeros((0, len(shared)))]
        for columns in sets:
            i, j = np.broadcast_arrays(columns[:, :, None], columns[:, None, :])
            block = np.asarray(H[i.ravel(), j.ravel()]).reshape(i.shape)
            inverse.append(np.linalg.inv(np.linalg.cholesky(block)))
            cross = _dense(H[columns.ravel()][:, shared]).reshape(*columns.shape, len(shared))
            beside.append((inverse[-1] @ cross).reshape(columns.size, len(shared)))
        W = np.vstack(beside)
        left = _dense(H[shared][:, shared]) - square(W)
        factor = cholesky(left, overwrite_a=True, check_finite=False)
        return cls(sets=sets, inverse=inverse, beside=W, shared=shared, factor=factor)

    def root(self, right: np.ndarray) -> np.ndarray:
        """``N right`` of (U, q), with ``N' N = H^-1``; its rows are in an order of their own."""
        own = [
            (inverse @ right[columns]).reshape(columns.size, right.shape[1])
            for columns, inverse in zip(self.sets, self.inverse, strict=True)
        ]
        first = np.vstack([np.zeros((0, right.shape[1])), *own])
        rest = right[self.shared] - self.beside.T @ first
        last = solve_triangular(self.factor, rest, trans=1, check_finite=False)
        return np.vstack([first, last])

    def solve(self, right: np.ndarray) -> np.ndarray:
        """``H^-1 right`` of (U,) or (U, q)."""
        columns = right if right.ndim == 2 else right[:, None]
        found, count = self.root(columns), len(self.beside)
        out = np.empty_like(columns)
        shared = solve_triangular(self.factor, found[count:], check_finite=False)
        out[self.shared] = shared
        first, start = found[:count] - self.beside @ shared, 0
        for some, inverse in zip(self.sets, self.inverse, strict=True):
            mine = first[start : start + some.size].reshape(*some.shape, columns.shape[1])
            out[some] = inverse.mT @ mine
            start += some.size
        return out.reshape(right.shape)


def apart(rows: csr_array, among: np.ndarray) -> list[np.ndarray]:
    """Some columns of rows (R, U), in sets of which no row touches two."""
    touched = abs(rows[:, among])
    _, label = connected_components(touched.T @ touched, directed=False)
    order = np.argsort(label, kind="stable")
    return np.split(among[order], np.flatnonzero(np.diff(label[order])) + 1)


def cheapest(size: int, *ways: Sequence[np.ndarray]) -> Sequence[np.ndarray]:
    """Of several ways to have sets of so many unknowns apart, that with the fewest products to
    factor it by."""

    def products(own: Sequence[np.ndarray]) -> int:
        return (size - sum(map(len, own))) ** 3 + sum(len(columns) ** 3 for columns in own)

    return min(ways, key=products)


def _dense(matrix: csr_array | np.ndarray) -> np.ndarray:
    return matrix.toarray() if issparse(matrix) else matrix
