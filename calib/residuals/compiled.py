"""Compiled loops over beams (the numba door): where each meets its plane, and sums of its rows.

They release the interpreter, so stops run side by side. numba keeps what it compiled beside this
file, so a second start pays nothing; an arm without a LiDAR does not even load it. Each is checked
against numpy in the tests.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, wraps
from typing import Any, TypeVar

import numpy as np

F = TypeVar("F", bound=Callable[..., Any])
OPTIONS = {"nogil": True, "error_model": "numpy"}  # a division by zero is infinite, as numpy has it


def compiled(function: F) -> F:
    """The function, compiled when first called, and kept on disk for the next start; where no
    folder can be written to it is compiled at every start."""

    @wraps(function)
    def called(*args: Any) -> Any:
        return _made(function)(*args)

    return called


@cache
def _made(function: Callable[..., Any]) -> Callable[..., Any]:
    from numba import njit  # late: it takes a quarter of a second

    try:
        return njit(cache=True, **OPTIONS)(function)
    except RuntimeError:  # numba finds no place for its cache
        return njit(**OPTIONS)(function)


@compiled
def meet_planes(
    T_reference_lidar: np.ndarray,
    origin_m: np.ndarray,
    direction: np.ndarray,
    plane: np.ndarray,
    part: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where N beams meet the planes of their parts.

    Args:
        T_reference_lidar: (4, 4).
        origin_m, direction: (N, 3) of the beams, lidar axes.
        plane: (M + 1, 4) planes [n, n.p] in the reference's frame; the last is met by no beam.
        part: (N,) which plane; -1 for none.

    Returns:
        Range (N,) m, infinite where there is no plane ahead; cosine (N,) of incidence, 0 there;
        and the normal over its product with the direction (N, 3), lidar axes, 0 there.
    """
    count, T = len(part), T_reference_lidar
    range_m, cosine, slope = np.empty(count), np.empty(count), np.empty((count, 3))
    for i in range(count):
        k = part[i] if part[i] >= 0 else len(plane) - 1
        a, b, c = plane[k, 0], plane[k, 1], plane[k, 2]
        x = T[0, 0] * a + T[1, 0] * b + T[2, 0] * c
        y = T[0, 1] * a + T[1, 1] * b + T[2, 1] * c
        z = T[0, 2] * a + T[1, 2] * b + T[2, 2] * c
        offset = plane[k, 3] - (a * T[0, 3] + b * T[1, 3] + c * T[2, 3])
        offset -= x * origin_m[i, 0] + y * origin_m[i, 1] + z * origin_m[i, 2]
        along = x * direction[i, 0] + y * direction[i, 1] + z * direction[i, 2]
        t = offset / along
        if t > 0.0 and t < np.inf:
            range_m[i], cosine[i] = t, min(abs(along), 1.0)
            slope[i, 0], slope[i, 1], slope[i, 2] = x / along, y / along, z / along
        else:
            range_m[i], cosine[i] = np.inf, 0.0
            slope[i, 0], slope[i, 1], slope[i, 2] = 0.0, 0.0, 0.0
    return range_m, cosine, slope


@compiled
def twist_derivative(
    origin_m: np.ndarray, direction: np.ndarray, range_m: np.ndarray, slope: np.ndarray
) -> np.ndarray:
    """``d residual / d twist = [h x s, s]`` (N, 6) by the lidar's right increment, where the beam
    hits, h, and the normal over its product with the direction, s (N, 3), in the lidar's axes."""
    count = len(range_m)
    out = np.empty((count, 6))
    for i in range(count):
        x = origin_m[i, 0] + range_m[i] * direction[i, 0]
        y = origin_m[i, 1] + range_m[i] * direction[i, 1]
        z = origin_m[i, 2] + range_m[i] * direction[i, 2]
        a, b, c = slope[i, 0], slope[i, 1], slope[i, 2]
        out[i, 0], out[i, 1], out[i, 2] = y * c - z * b, z * a - x * c, x * b - y * a
        out[i, 3], out[i, 4], out[i, 5] = a, b, c
    return out


@compiled
def renumber(index: np.ndarray, size: int, first: int, out: np.ndarray) -> np.ndarray:
    """Number the columns that any row touches, from `first` on.

    Args:
        index: (N,) which of `size` columns a row touches; -1 for none.
        size: how many there are.
        first: number of the first.
        out: (N,) takes the number of each row's column, -1 for none.

    Returns:
        The columns that are touched (K,), ascending.
    """
    number = np.full(size, -1, np.int32)
    for i in range(len(index)):
        if index[i] >= 0:
            number[index[i]] = 0
    touched = np.flatnonzero(number == 0)
    for k in range(len(touched)):
        number[touched[k]] = first + k
    for i in range(len(index)):
        out[i] = number[index[i]] if index[i] >= 0 else -1
    return touched


@compiled
def cross_sums(
    dense: np.ndarray,
    weight: np.ndarray,
    index: np.ndarray,
    value: np.ndarray,
    size: int,
    last: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Weighted sums over rows of products with columns of which each row touches one per group.

    Args:
        dense: (N, m), C order.
        weight: (N,).
        index: (N, g) which of all `size` sparse columns a row touches in each group; -1 for none.
            The columns of a group follow those of the groups before it.
        value: (N, g) its entry there.
        size: number of sparse columns, all groups together.
        last: where the last group begins.

    Returns:
        Sparse by dense (size, m); sparse by sparse (last, size) of different groups, in the rows of
        the earlier one; and each sparse column by itself (size,).
    """
    count, groups = index.shape
    width = dense.shape[1]
    with_dense, with_sparse = np.zeros((size, width)), np.zeros((last, size))
    diagonal = np.zeros(size)
    for i in range(count):
        w = weight[i]
        if w == 0.0:
            continue
        for g in range(groups):
            row = index[i, g]
            if row < 0:
                continue
            v = w * value[i, g]
            for j in range(width):
                with_dense[row, j] += v * dense[i, j]
            diagonal[row] += v * value[i, g]
            for h in range(g + 1, groups):
                column = index[i, h]
                if column >= 0:
                    with_sparse[row, column] += v * value[i, h]
    return with_dense, with_sparse, diagonal


@compiled
def add_sparse(
    half: np.ndarray,
    at: np.ndarray,
    unit: np.ndarray,
    with_sparse: np.ndarray,
    own: np.ndarray,
) -> None:
    """Add sums of sparse columns to a matrix of which half is held, below its diagonal: the whole
    is that and its transpose.

    Args:
        half: (n, n), added to.
        at: (s,) where each column stands in it, unit: (s,) what it is multiplied by.
        with_sparse, own: (last, s) and (s,) as `cross_sums` gives them.
    """
    rows, size = with_sparse.shape
    for a in range(size):
        half[at[a], at[a]] += own[a] * unit[a] * unit[a] / 2.0
    for a in range(rows):
        for b in range(size):
            v = with_sparse[a, b]
            if v != 0.0:
                half[max(at[a], at[b]), min(at[a], at[b])] += v * unit[a] * unit[b]


@compiled
def cluster_sums(
    dense: np.ndarray,
    weight: np.ndarray,
    index: np.ndarray,
    value: np.ndarray,
    size: int,
    cluster: np.ndarray,
    clusters: int,
) -> np.ndarray:
    """Weighted sums (clusters, m + size) of rows by the cluster (N,) that each is in; the other
    arguments are those of `cross_sums`."""
    count, groups = index.shape
    width = dense.shape[1]
    out = np.zeros((clusters, width + size))
    for i in range(count):
        w, c = weight[i], cluster[i]
        if w == 0.0:
            continue
        for j in range(width):
            out[c, j] += w * dense[i, j]
        for g in range(groups):
            if index[i, g] >= 0:
                out[c, width + index[i, g]] += w * value[i, g]
    return out


@compiled
def square_sums(
    dense: np.ndarray,
    weight: np.ndarray,
    index: np.ndarray,
    value: np.ndarray,
    by_dense: np.ndarray,
    by_sparse: np.ndarray,
    cluster: np.ndarray,
    clusters: int,
) -> np.ndarray:
    """Weighted sums (clusters, P) of squares of rows along P directions.

    Args:
        dense, weight, index, value: as of `cross_sums`.
        by_dense: (m, P), by_sparse: (size, P) the directions, in the columns of each kind.
        cluster: (N,) that each row is in, of so many `clusters`.
    """
    count, groups = index.shape
    width, directions = by_dense.shape
    out, along = np.zeros((clusters, directions)), np.empty(directions)
    for i in range(count):
        w, c = weight[i], cluster[i]
        if w == 0.0:
            continue
        along[:] = 0.0
        for j in range(width):
            x = dense[i, j]
            if x != 0.0:
                for p in range(directions):
                    along[p] += x * by_dense[j, p]
        for g in range(groups):
            at = index[i, g]
            if at >= 0:
                x = value[i, g]
                for p in range(directions):
                    along[p] += x * by_sparse[at, p]
        for p in range(directions):
            out[c, p] += w * along[p] * along[p]
    return out


@compiled
def add_at(target: np.ndarray, rows: np.ndarray, columns: np.ndarray, block: np.ndarray) -> None:
    """``target[rows[i], columns[j]] += block[i, j]``; rows and columns of -1 are left out."""
    for i in range(len(rows)):
        if rows[i] >= 0:
            for j in range(len(columns)):
                if columns[j] >= 0:
                    target[rows[i], columns[j]] += block[i, j]


@compiled
def add_both(target: np.ndarray, rows: np.ndarray, columns: np.ndarray, block: np.ndarray) -> None:
    """As `add_at`, and its transpose."""
    for i in range(len(rows)):
        if rows[i] >= 0:
            for j in range(len(columns)):
                if columns[j] >= 0:
                    target[rows[i], columns[j]] += block[i, j]
                    target[columns[j], rows[i]] += block[i, j]
