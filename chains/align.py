"""Closed forms: the transform that best lays one set of points, or of poses, on another."""

import numpy as np
from numpy.typing import ArrayLike

from chains.errors import InputError
from chains.se3 import Array

# Width over length of points, below which they are one line. A choice: of points along metres that
# are known to a millimetre, the turn about such a line is not known to a radian.
_NARROWEST = 1e-3
# By how much, of the largest, the second singular value is less where poses turn about more than
# one axis. A choice: half the mean square of turns about other axes, so 0.014 rad of them.
_DISTINCT = 1e-4


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
    R = nearest_rotation((a - mean_a).T @ (w[:, None] * (b - mean_b)))
    T_a_b = np.eye(4)
    T_a_b[:3, :3] = R
    T_a_b[:3, 3] = mean_a - R @ mean_b
    squares = np.sum((a - mean_a - (b - mean_b) @ R.T) ** 2, axis=1)
    return T_a_b, float(np.sqrt(np.average(squares, weights=w)))


def nearest_rotation(M: Array) -> Array:
    """Return the rotation R (3, 3) with the largest trace(R^T M): of points, by which one set is
    turned into the other (Kabsch, Acta Cryst. A32, 1976); of a mean of rotations, their mean."""
    U, _, Vt = np.linalg.svd(M)
    U[:, 2] *= np.sign(np.linalg.det(U @ Vt))
    return U @ Vt


def mean_pose(Ts: ArrayLike) -> Array:
    """Return the pose (4, 4) nearest to the poses Ts (K, 4, 4) by squared chordal distance.

    Mean translation, and the rotation that minimises sum |R - R_k|_F^2.
    """
    Ts = np.asarray(Ts, float)
    T = np.eye(4)
    T[:3, :3] = nearest_rotation(Ts[:, :3, :3].mean(axis=0))
    T[:3, 3] = Ts[:, :3, 3].mean(axis=0)
    return T


def hand_eye(Ts_a: ArrayLike, Ts_b: ArrayLike) -> tuple[Array, Array]:
    """Return X and Z (4, 4) with ``Ts_a[k] = Z @ Ts_b[k] @ X`` as nearly as may be.

    A tracked body beyond an arm: ``T_world_body = T_world_base @ T_base_tip @ T_tip_body``.
    ``Ts_a``, ``Ts_b`` (K, 4, 4). Rotations are the leading singular vectors of the sum of the
    Kronecker products of both, then translations are linear least squares, the shortest where
    several are as good (Shah, J. Mechanisms and Robotics 5, 2013). Raises InputError where fewer
    than 3 poses are given, or all turns are about one axis, so that a turn is not determined.
    """
    A, B = np.asarray(Ts_a, float), np.asarray(Ts_b, float)
    if len(A) < 3:
        raise InputError(f"{len(A)} poses cannot place a body on an arm; at least 3 are needed")
    Ra, Rb = A[:, :3, :3], B[:, :3, :3]
    # Ra X' Rb^T = Z for X' = X^-1, and vec(Ra X' Rb^T) = (Rb kron Ra) vec(X'), columns stacked.
    kron = np.einsum("kij,kab->iajb", Rb, Ra).reshape(9, 9)
    left, sizes, right = np.linalg.svd(kron)
    if sizes[1] > (1 - _DISTINCT) * sizes[0]:
        raise InputError(
            "the arm turns about one axis only, so the turn of what it carries is not determined; "
            "move more of its joints"
        )
    Rx, Rz = _nearest_rotations(right[0].reshape(3, 3).T, left[:, 0].reshape(3, 3).T)
    # Ra tx' + ta = Rz tb + tz
    rows = np.concatenate([Ra, np.broadcast_to(-np.eye(3), Ra.shape)], axis=2).reshape(-1, 6)
    shift = (B[:, :3, 3] @ Rz.T - A[:, :3, 3]).reshape(-1)
    t, *_ = np.linalg.lstsq(rows, shift, rcond=1e-6)
    X, Z = np.eye(4), np.eye(4)
    X[:3, :3], X[:3, 3] = Rx.T, -Rx.T @ t[:3]
    Z[:3, :3], Z[:3, 3] = Rz, t[3:]
    return X, Z


def _nearest_rotations(*matrices: Array) -> list[Array]:
    """Rotations nearest to matrices that are rotations but for one common factor."""
    sign = np.sign(np.linalg.det(matrices[0]))
    out = []
    for matrix in matrices:
        u, _, vt = np.linalg.svd(sign * matrix)
        out.append(u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt)
    return out


def fit_sphere(points_m: ArrayLike, radius_m: float | None = None) -> tuple[Array, float, float]:
    """Return centre (3,), radius and rms distance, m, of the sphere nearest to points (N, 3).

    Minimises sum (|p - c| - r)^2, over the radius too unless it is given, by Gauss and Newton from
    the linear solution of |p|^2 = 2 c.p + (r^2 - |c|^2) (Coope, JOTA 1993). Raises InputError for
    fewer than 4 points, or points so flat that a plane is as good.
    """
    points = np.asarray(points_m, float)
    if len(points) < 4:
        raise InputError(f"{len(points)} points do not fix a sphere; at least 4 are needed")
    mean = points.mean(axis=0)
    local = points - mean
    _, spread, _ = np.linalg.svd(local, full_matrices=False)
    if spread[2] <= _NARROWEST * spread[0]:
        raise InputError("the points lie on a plane or a line, which fixes no sphere")
    rows = np.column_stack([2 * local, np.ones(len(local))])
    *centre, rest = np.linalg.lstsq(rows, np.sum(local**2, axis=1))[0]
    centre = np.array(centre)
    radius = np.sqrt(rest + centre @ centre) if radius_m is None else radius_m
    for _ in range(50):
        away = local - centre
        distance = np.linalg.norm(away, axis=1)
        rows = np.column_stack([away / distance[:, None], np.ones(len(local))])
        step = np.zeros(4)
        free = 4 if radius_m is None else 3
        step[:free] = np.linalg.lstsq(rows[:, :free], distance - radius)[0]
        centre, radius = centre + step[:3], radius + step[3]
        if np.abs(step).max() < 1e-12 * (1 + radius):
            break
    rms = np.sqrt(np.mean((np.linalg.norm(local - centre, axis=1) - radius) ** 2))
    return centre + mean, float(radius), float(rms)
