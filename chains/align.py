"""Closed forms: the transform that best lays one set of points, or of poses, on another."""

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from chains.errors import InputError
from chains.se3 import Array

_NARROWEST = 1e-3


def align_points(
    points_a: ArrayLike, points_b: ArrayLike, weights: ArrayLike | None = None
) -> tuple[Array, float]:
    """Return T_a_b (4, 4) that minimises sum w |a - T_a_b b|^2, and the weighted rms in metres.

    ``points_a``, ``points_b`` (N, 3) in metres, row by row the same points in frames a and b;
    ``weights`` (N,) >= 0, all 1 if not given. Kabsch's rotation without scale (Umeyama, PAMI
    1991). Raises InputError for fewer than 3 points, or points so near one line (width below
    1/1000 of the length) that the turn about it is not determined.
    """
    a, b = np.asarray(points_a, float), np.asarray(points_b, float)
    w = np.ones(len(a)) if weights is None else np.asarray(weights, float)
    if np.count_nonzero(w) < 3:
        raise InputError(f"{np.count_nonzero(w)} points cannot fix a pose; at least 3 are needed")
    mean_a, mean_b = np.average(a, axis=0, weights=w), np.average(b, axis=0, weights=w)
    for centred in (a - mean_a, b - mean_b):
        length, width, _ = np.linalg.svd(np.sqrt(w)[:, None] * centred, compute_uv=False)
        if width <= _NARROWEST * length:
            raise InputError(
                "the points lie on one line, so the turn about it is not determined; "
                "add a point off the line"
            )
    rotation, _ = Rotation.align_vectors(a - mean_a, b - mean_b, weights=w)
    T_a_b = np.eye(4)
    T_a_b[:3, :3] = rotation.as_matrix()
    T_a_b[:3, 3] = mean_a - rotation.apply(mean_b)
    squares = np.sum((a - mean_a - rotation.apply(b - mean_b)) ** 2, axis=1)
    return T_a_b, float(np.sqrt(np.average(squares, weights=w)))


def mean_pose(Ts: ArrayLike) -> Array:
    """Return the pose (4, 4) nearest to the poses Ts (K, 4, 4) by squared chordal distance.

    Mean translation, and the rotation that minimises sum |R - R_k|_F^2.
    """
    Ts = np.asarray(Ts, float)
    T = np.eye(4)
    T[:3, :3] = Rotation.from_matrix(Ts[:, :3, :3]).mean().as_matrix()
    T[:3, 3] = Ts[:, :3, 3].mean(axis=0)
    return T
