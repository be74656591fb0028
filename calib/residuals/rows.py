"""Many rows become few: compression, and robust weights.

A million whitened rows ``[A | b]`` enter the graph only through their Gram matrix. Its pivoted
Cholesky factor gives at most P + 1 rows with the same cost and the same linearisation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import dpstrf
from scipy.sparse import csr_matrix

TUKEY = 4.685  # 95 % efficiency on normal rows (Holland and Welsch 1977)


def tukey_weight(z: np.ndarray, scale: float = 1.0) -> np.ndarray:
    """Weight of each whitened row under Tukey's biweight: ``(1 - (z / c)^2)^2`` inside c, else 0.

    Args:
        z: (N,) whitened residuals.
        scale: multiplies the tuning constant c = 4.685.
    """
    u = np.square(z / (TUKEY * scale))
    return np.square(np.maximum(1.0 - u, 0.0))


def tukey_curvature(z: np.ndarray, scale: float = 1.0) -> np.ndarray:
    """Second derivative of the biweight's cost, ``(1 - u)(1 - 5u)`` with ``u = (z / c)^2``, held
    above a tenth of the weight: with it in place of the weight, steps are nearly Newton's."""
    u = np.square(z / (TUKEY * scale))
    left = np.maximum(1.0 - u, 0.0)
    return left * np.maximum(1.0 - 5.0 * u, 0.1 * left)


def tukey_cost(z: np.ndarray, scale: float = 1.0) -> float:
    """Half the robust chi-square, ``sum rho(z)`` with ``rho'' (0) = 1``."""
    c2 = (TUKEY * scale) ** 2
    inside = np.maximum(1.0 - np.square(z) / c2, 0.0)
    return float(np.sum(c2 / 6.0 * (1.0 - inside**3)))


def robust_scale(z: np.ndarray) -> float:
    """How many times wider than its sigma the bulk of the rows is; at least 1 (from the MAD)."""
    return max(1.0, 1.4826 * float(np.median(np.abs(z)))) if len(z) else 1.0


@dataclass(frozen=True)
class Group:
    """Columns of which each row touches one: a ring, a patch, a plane.

    Args:
        index: (N,) which column; -1 for none.
        value: (N,) entry there.
        size: number of columns.
    """

    index: np.ndarray
    value: np.ndarray
    size: int


def gram(dense: np.ndarray, groups: list[Group], weight: np.ndarray) -> np.ndarray:
    """Gram matrix of ``sqrt(weight) * [dense | groups]``, group columns kept sparse.

    Args:
        dense: (N, d).
        groups: sparse columns, one non-zero entry per row each.
        weight: (N,) non-negative.

    Returns:
        (d + sum of sizes, same), symmetric.
    """
    weighted = dense * weight[:, None]
    top = dense.T @ weighted
    if not groups:
        return top
    starts = np.concatenate([[0], np.cumsum([g.size for g in groups])])
    d, total = dense.shape[1], int(starts[-1])
    out = np.zeros((d + total, d + total))
    out[:d, :d] = top
    for i, g in enumerate(groups):
        at = slice(d + starts[i], d + starts[i + 1])
        picks = _one_hot(g)
        out[at, :d] = picks.T @ weighted
        out[:d, at] = out[at, :d].T
        for j in range(i, len(groups)):
            h = groups[j]
            to = slice(d + starts[j], d + starts[j + 1])
            out[at, to] = _cross(g, h, weight)
            out[to, at] = out[at, to].T
    return out


def _one_hot(g: Group) -> csr_matrix:
    rows = len(g.index)
    value = np.where(g.index >= 0, g.value, 0.0)
    return csr_matrix((value, np.maximum(g.index, 0), np.arange(rows + 1)), shape=(rows, g.size))


def _cross(g: Group, h: Group, weight: np.ndarray) -> np.ndarray:
    product = np.where((g.index >= 0) & (h.index >= 0), weight * g.value * h.value, 0.0)
    if g is h:
        return np.diag(np.bincount(np.maximum(g.index, 0), product, g.size)[: g.size])
    flat, size = np.maximum(g.index * h.size + h.index, 0), g.size * h.size
    return np.bincount(flat, product, size)[:size].reshape(g.size, h.size)


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


def split(matrix: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows that know the first columns, and the Gram matrix of what is left for the others.

    With ``R.T @ R = matrix`` and those columns eliminated first, R is ``[top; 0 | root(rest)]``.

    Args:
        matrix: (n, n) symmetric semidefinite.
        count: how many columns come first; they may be dependent.

    Returns:
        top (count, n), rest (n - count, n - count).
    """
    scale = np.sqrt(np.maximum(np.diag(matrix)[:count], 1e-300))
    values, axes = np.linalg.eigh(matrix[:count, :count] / np.outer(scale, scale))
    known = values > count * np.finfo(float).eps * max(values[-1], 0.0)
    root = np.sqrt(np.where(known, values, 1.0))
    top = ((axes * known / root).T / scale) @ matrix[:count]
    rest = matrix[count:, count:] - top[:, count:].T @ top[:, count:]
    return top, rest
