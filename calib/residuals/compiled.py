"""Compiled loops over beams (the numba door): where each meets its plane, and sums of its rows.

They release the interpreter, so stops run side by side. numba keeps what it compiled beside this
file, so a second start pays nothing. Each is checked against numpy in the tests.
"""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
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


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True)
def cross_sums(
    dense: np.ndarray,
    weight: np.ndarray,
    index: np.ndarray,
    value: np.ndarray,
    size: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Weighted sums over rows of products with columns of which each row touches one per group.

    Args:
        dense: (N, m), C order.
        weight: (N,).
        index: (N, g) which of all `size` sparse columns a row touches in each group; -1 for none.
        value: (N, g) its entry there.
        size: number of sparse columns, all groups together.

    Returns:
        Sparse by dense (size, m), and sparse by sparse (size, size), its upper blocks only: the
        product of two groups stands in the rows of the earlier one.
    """
    count, groups = index.shape
    width = dense.shape[1]
    with_dense, with_sparse = np.zeros((size, width)), np.zeros((size, size))
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
            for h in range(g, groups):
                column = index[i, h]
                if column >= 0:
                    with_sparse[row, column] += v * value[i, h]
    return with_dense, with_sparse


@njit(cache=True, nogil=True)
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
