"""Symmetric matrices, by their eigenvalues."""

from __future__ import annotations

import numpy as np
from scipy import linalg


def eigh(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Eigenvalues (..., n), ascending, and eigenvectors (..., n, n) in columns, of symmetric
    matrices (..., n, n).

    LAPACK's divide and conquer, which NumPy calls, comes to no end on some sound matrices (one of
    46 parameters, most of them known by their priors alone). Those are done by relatively robust
    representations (Dhillon and Parlett 2004, Linear Algebra and its Applications 387:1).

    Raises:
        numpy.linalg.LinAlgError: a number is not finite.
    """
    try:
        return np.linalg.eigh(matrix)
    except np.linalg.LinAlgError:
        matrix = np.asarray(matrix)
        if not np.isfinite(matrix).all():
            raise
    n = matrix.shape[-1]
    each = [linalg.eigh(one, driver="evr") for one in matrix.reshape(-1, n, n)]
    values, vectors = (np.stack(some) for some in zip(*each, strict=True))
    return values.reshape(matrix.shape[:-1]), vectors.reshape(matrix.shape)


def pinv(matrix: np.ndarray, least: float = 1e-15) -> np.ndarray:
    """Pseudo-inverses (..., n, n) of symmetric matrices (..., n, n); eigenvalues of `least` times
    the largest, by size, or less count as 0."""
    values, vectors = eigh(matrix)
    size = np.abs(values)
    kept = size > least * size.max(axis=-1, keepdims=True, initial=0.0)
    inverse = np.where(kept, 1.0, 0.0) / np.where(kept, values, 1.0)
    return (vectors * inverse[..., None, :]) @ np.swapaxes(vectors, -1, -2)
