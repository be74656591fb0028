"""Exact elimination of unknowns from normal equations, and the way back to them.

With ``H x = h`` and unknowns e eliminated first, ``x_e = H_ee^-1 (h_e - H_er x_r)``, and what is
left says ``(H_rr - H_re H_ee^-1 H_er) x_r = h_r - H_re H_ee^-1 h_e``: the Schur complement. All
is in units of the priors' sigmas, so that every block has eigenvalues of 1 or more.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_solve, cholesky, solve_triangular
from scipy.linalg.blas import dsyrk
from scipy.linalg.lapack import dpstrf

BY_TWIST = -2  # among what eliminated cells depend on: a stop's twist, not an unknown


@dataclass(frozen=True)
class Eliminated:
    """Unknowns that were eliminated, in terms of those that were left.

    ``x_e = -gain @ x_over``, where the last of `over` stands for the right side, and is -1.

    Args:
        columns: (e,) which unknowns.
        over: (r,) which others they depend on, twists first; U for the right side.
        factor: (e, e) lower Cholesky factor of their block, or (e,) its diagonal.
        gain: (e, r).
    """

    columns: np.ndarray
    over: np.ndarray
    factor: np.ndarray
    gain: np.ndarray

    def solve(self, right: np.ndarray) -> np.ndarray:
        """``H_ee^-1 @ right``, of (e, q)."""
        if self.factor.ndim == 1:
            return right / self.factor[:, None]
        return cho_solve((self.factor, True), right, check_finite=False)


def eliminate(
    block: np.ndarray, cross: np.ndarray, rest: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Take unknowns out of normal equations.

    Args:
        block: (e, e) of those, positive definite; or (e,) where it is diagonal.
        cross: (e, r) of them and the others.
        rest: (r, r) of the others, symmetric; the Schur complement takes its place.

    Returns:
        The factor and the gain, as `Eliminated` has them.
    """
    if block.ndim == 1:
        root = np.sqrt(block)[:, None]
        rest -= square(cross / root)
        return block, cross / block[:, None]
    factor = cholesky(block, lower=True, check_finite=False)
    half = solve_triangular(factor, cross, lower=True, check_finite=False)
    rest -= square(half)
    return factor, solve_triangular(factor, half, lower=True, trans=1, check_finite=False)


def square(rows: np.ndarray) -> np.ndarray:
    """``rows.T @ rows``, computed once per pair of columns."""
    upper = dsyrk(1.0, rows.T, trans=0, lower=0)  # zero below the diagonal
    whole = upper + upper.T
    np.einsum("ii->i", whole)[:] /= 2.0
    return whole


def square_root(matrix: np.ndarray) -> np.ndarray:
    """R with ``R.T @ R = matrix``, for a symmetric semidefinite matrix of any rank.

    A plain Cholesky fails here always: one stop's rows cannot tell its pose from its mount. The
    matrix is scaled to unit diagonal and factored with pivoting (LAPACK dpstrf).

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
