"""Exact elimination of unknowns from normal equations, and the way back to them.

With ``H x = h`` and unknowns e eliminated first, ``x_e = H_ee^-1 (h_e - H_er x_r)``, and what is
left says ``(H_rr - H_re H_ee^-1 H_er) x_r = h_r - H_re H_ee^-1 h_e``: the Schur complement. All
is in units of the priors' sigmas: the prior alone gives H_ee eigenvalues of about 1, so it can be
factored whatever the data leave open.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_solve, cholesky, solve_triangular
from scipy.linalg.blas import dsyrk
from scipy.linalg.lapack import dpstrf

from calib.linear.symmetric import eigh

MIRRORED_AT_ONCE = 128  # rows and columns: a square of them stays in a cache


@dataclass(frozen=True)
class Eliminated:
    """Unknowns that were eliminated, in terms of those that were left.

    ``x_e = -gain @ x_over``. The last of `over` is the right side, whose x is -1 for a solution.

    Args:
        columns: (e,) which unknowns.
        over: (r,) columns of the others they depend on, and U, the number of unknowns, for the
            right side.
        factor: (e, e) lower Cholesky factor of their block.
        gain: (e, r).
    """

    columns: np.ndarray
    over: np.ndarray
    factor: np.ndarray
    gain: np.ndarray

    def onto(self, to: np.ndarray) -> Eliminated:
        """The same over fewer others: `to` (U + 1,) says where each column is then, -1 where it is
        not."""
        over = to[self.over]
        there = over != -1
        return replace(self, columns=to[self.columns], over=over[there], gain=self.gain[:, there])

    def solve(self, right: np.ndarray) -> np.ndarray:
        """``H_ee^-1 @ right``, of (e, q)."""
        return cho_solve((self.factor, True), right, check_finite=False)


def eliminate(
    block: np.ndarray, cross: np.ndarray, rest: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Take unknowns out of normal equations.

    Args:
        block: (e, e) of those, positive definite, of which only what is on the diagonal and below
            it is read.
        cross: (e, r) of them and the others.
        rest: (r, r) of the others, symmetric and contiguous; the Schur complement takes its place.

    Returns:
        The factor and the gain, as `Eliminated` has them.
    """
    ((factor, gain),) = eliminate_apart(block, cross, rest, [len(block)])
    return factor, gain


def eliminate_apart(
    block: np.ndarray, cross: np.ndarray, rest: np.ndarray, sizes: Sequence[int]
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Take sets of unknowns, which nothing ties to each other, out of normal equations.

    Args:
        block: (e, e), cross, rest: as of `eliminate`.
        sizes: how many of the e each set has, one set after the other; none of them is empty.

    Returns:
        The factor and the gain of each.
    """
    found, halves, first = [], np.empty(cross.shape), 0
    for size in sizes:
        some, first = slice(first, first + size), first + size
        factor = cholesky(block[some, some], lower=True, check_finite=False)
        half = solve_triangular(factor, cross[some], lower=True, check_finite=False)
        halves[some] = half
        gain = solve_triangular(factor, half, lower=True, trans=1, check_finite=False)
        found.append((factor, gain))
    _take_square(rest, halves)
    return found


def _take_square(symmetric: np.ndarray, rows: np.ndarray) -> None:
    """Subtract ``rows.T @ rows``, computed once per pair of columns, from a matrix (n, n), which is
    large: so no other of its size is made."""
    dsyrk(-1.0, rows.T, beta=1.0, c=symmetric.T, overwrite_c=1)  # on the diagonal, and below it
    for first in range(0, len(symmetric), MIRRORED_AT_ONCE):
        some = slice(first, first + MIRRORED_AT_ONCE)
        square_part = symmetric[some, some]
        square_part[:] = np.tril(square_part) + np.tril(square_part, -1).T
        symmetric[some, some.stop :] = symmetric[some.stop :, some].T


def add_square(target: np.ndarray, rows: np.ndarray, times: float = 1.0) -> None:
    """Add ``rows.T @ rows`` so many times to a matrix of which half is held, below its diagonal."""
    if not target.size:
        return  # which BLAS refuses
    # Each pair of columns once, and each column by itself twice as much as is held of it.
    dsyrk(times, rows.T, beta=1.0, c=target.T, overwrite_c=1)
    np.einsum("ii->i", target)[:] -= times * np.einsum("ij,ij->j", rows, rows) / 2


def square(rows: np.ndarray) -> np.ndarray:
    """``rows.T @ rows``, computed once per pair of columns."""
    upper = dsyrk(1.0, rows.T, trans=0, lower=0)  # zero below the diagonal
    whole = upper + upper.T
    np.einsum("ii->i", whole)[:] /= 2.0
    return whole


def square_root(matrix: np.ndarray) -> np.ndarray:
    """R with ``R.T @ R = matrix``, for a symmetric semidefinite matrix of any rank.

    Data alone leave some directions open, where a plain Cholesky fails: a mount against the next,
    say. The matrix is scaled to unit diagonal and factored with pivoting (LAPACK dpstrf).

    Returns:
        (n, n) with zero rows beyond the rank.
    """
    scale = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    scale[scale == 0.0] = 1.0
    factor, pivot, rank, _ = dpstrf(matrix / np.outer(scale, scale), lower=0)
    upper = np.triu(factor)
    upper[rank:] = 0.0
    root = np.empty_like(upper)
    root[:, pivot - 1] = upper
    return root * scale


def inverse_and_log_det(inner: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of symmetric matrices (..., n, n) whose eigenvalues are all at least 1, though rounding
    errors of the largest may exceed that: the inverses, and the logarithms (...) of their
    determinants."""
    try:
        factor = np.linalg.cholesky(inner)
    except np.linalg.LinAlgError:
        values, axes = eigh(inner)
        values = np.maximum(values, 1.0)
        return (axes / values[..., None, :]) @ np.swapaxes(axes, -1, -2), _logs(values)
    half = np.linalg.inv(factor)
    return np.swapaxes(half, -1, -2) @ half, 2.0 * _logs(np.diagonal(factor, axis1=-2, axis2=-1))


def _logs(values: np.ndarray) -> np.ndarray:
    return np.log(values).sum(axis=-1)
