"""Rigid transforms, batched: every function takes any leading shape ``...`` and keeps it.

``T`` (..., 4, 4) is a rigid transform, ``xi`` (..., 6) its tangent ``[rx ry rz tx ty tz]`` in
radians and metres; increments stand on the right, as in gtsam. Below ``w = xi[:3]``,
``v = xi[3:]``, ``W = skew(w)``, ``V = skew(v)`` and ``t = |w|``. Formulas: Barfoot, State
Estimation for Robotics (2017), section 7.1; his tangent is [v w], so his blocks swap places here.
"""

from math import factorial

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

_EYE3 = np.eye(3)
_SKEW = np.cross(_EYE3[:, None], _EYE3[None]).swapaxes(1, 2).reshape(3, 9)

# Closed forms lose t^-4 of their digits to cancellation, so below this angle the series is summed.
_SERIES_BELOW_RAD = 1.0
_ORDERS = np.arange(10)
_SERIES = np.array(
    [[(-1.0) ** n / factorial(2 * n + first) for n in _ORDERS] for first in (1, 2, 3, 4, 5)]
) * np.where(np.arange(5)[:, None] == 4, _ORDERS + 1, 1)


def _coefficients(t: Array) -> Array:
    """Return (5, ...) the functions of the angle that the exponential and its Jacobian sum to.

    sin t / t, (1 - cos t) / t^2, (t - sin t) / t^3, (t^2 / 2 + cos t - 1) / t^4 and
    (2 t - 3 sin t + t cos t) / (2 t^5).
    """
    far = np.maximum(t, _SERIES_BELOW_RAD)
    s, c, far2 = np.sin(far), np.cos(far), far * far
    values = np.stack(
        [
            s / far,
            (1 - c) / far2,
            (far - s) / (far2 * far),
            (far2 / 2 + c - 1) / far2**2,
            (2 * far - 3 * s + far * c) / (2 * far2**2 * far),
        ]
    )
    near = t < _SERIES_BELOW_RAD
    values[:, near] = _SERIES @ np.power.outer(t[near] ** 2, _ORDERS).T
    return values


def _angle(w: Array) -> Array:
    return np.sqrt(np.vecdot(w, w))


def _turned(along: Array, cosine: Array) -> Array:
    """Return vectors (..., 3) of length k sin(a) scaled to length a, given k cos(a) (...)."""
    sine = _angle(along)
    some = np.where(sine > 0.0, sine, 1.0)  # where it is 0, so is the turn
    return (np.arctan2(sine, cosine) / some)[..., None] * along


def _transform(R: Array, p: Array) -> Array:
    T = np.zeros((*np.broadcast_shapes(R.shape[:-2], p.shape[:-1]), 4, 4))
    T[..., :3, :3] = R
    T[..., :3, 3] = p
    T[..., 3, 3] = 1
    return T


def _lower_blocks(A: Array, B: Array) -> Array:
    """Return [[A, 0], [B, A]] (..., 6, 6), the shape of every map between SE(3) tangents."""
    blocks = np.zeros((*A.shape[:-2], 6, 6))
    blocks[..., :3, :3] = A
    blocks[..., 3:, 3:] = A
    blocks[..., 3:, :3] = B
    return blocks


def skew(w: ArrayLike) -> Array:
    """Return the matrices (..., 3, 3) of the cross product, ``skew(w) @ x = w x x``."""
    w = np.asarray(w, float)
    return (w @ _SKEW).reshape(*w.shape, 3)


def so3_exp(w: ArrayLike) -> Array:
    """Return the rotation matrices (..., 3, 3) of the rotation vectors w (..., 3) in radians."""
    w = np.asarray(w, float)
    a, b, *_ = _coefficients(_angle(w))[..., None, None]
    W = skew(w)
    return _EYE3 + a * W + b * (W @ W)


def so3_log(R: ArrayLike) -> Array:
    """Return the rotation vectors (..., 3) of R (..., 3, 3), of length at most pi."""
    R = np.asarray(R, float)
    sine_axis = np.stack(
        [
            R[..., 2, 1] - R[..., 1, 2],
            R[..., 0, 2] - R[..., 2, 0],
            R[..., 1, 0] - R[..., 0, 1],
        ],
        axis=-1,
    )
    twice_cosine = R[..., 0, 0] + R[..., 1, 1] + R[..., 2, 2] - 1.0
    w = _turned(sine_axis, twice_cosine)
    far = twice_cosine < 0.0  # more than a quarter turn, whose sine says less and less
    if np.any(far):
        q = _quat_wxyz(R[far])
        w[far] = 2.0 * _turned(q[..., 1:], q[..., 0])
    return w


def so3_left_jacobian_inverse(w: ArrayLike) -> Array:
    """Return (..., 3, 3) the inverse left Jacobian of SO(3), for angles below 2 pi.

    I - W / 2 + (1 - (t / 2) cot(t / 2)) / t^2 W^2 (Barfoot 7.37).
    """
    w = np.asarray(w, float)
    _, b, c, d, _ = _coefficients(_angle(w))[..., None, None]
    W = skew(w)
    return _EYE3 - W / 2 + (c - 2 * d) / (2 * b) * (W @ W)


def exp(xi: ArrayLike) -> Array:
    """Return the transforms (..., 4, 4) of the tangents xi (..., 6).

    Rotation I + a W + b W^2 and translation (I + b W + c W^2) v (Barfoot 7.33, 7.37).
    """
    xi = np.asarray(xi, float)
    w, v = xi[..., :3], xi[..., 3:]
    a, b, c, *_ = _coefficients(_angle(w))[..., None]
    W = skew(w)
    Wv = np.matvec(W, v)
    R = _EYE3 + a[..., None] * W + b[..., None] * (W @ W)
    return _transform(R, v + b * Wv + c * np.matvec(W, Wv))


def log(T: ArrayLike) -> Array:
    """Return the tangents (..., 6) of T (..., 4, 4), of rotation at most pi."""
    T = np.asarray(T, float)
    w = so3_log(T[..., :3, :3])
    return np.concatenate([w, np.matvec(so3_left_jacobian_inverse(w), T[..., :3, 3])], axis=-1)


def inverse(T: ArrayLike) -> Array:
    """Return the inverse transforms (..., 4, 4), [R p]^-1 = [R^T  -R^T p]."""
    T = np.asarray(T, float)
    Rt = T[..., :3, :3].swapaxes(-1, -2)
    return _transform(Rt, -np.matvec(Rt, T[..., :3, 3]))


def adjoint(T: ArrayLike) -> Array:
    """Return (..., 6, 6) the map of tangents with ``T exp(xi) = exp(adjoint(T) xi) T``.

    [[R, 0], [skew(p) R, R]] (Barfoot 7.45).
    """
    T = np.asarray(T, float)
    R = T[..., :3, :3]
    return _lower_blocks(R, skew(T[..., :3, 3]) @ R)


def right_jacobian(xi: ArrayLike) -> Array:
    """Return (..., 6, 6) the map J with ``exp(xi + d) = exp(xi) exp(J d)`` for small d.

    [[J, 0], [Q, J]] with J = I - b W + c W^2 (Barfoot 7.85, 7.86 at -xi, by W V W = -(w v) W).
    """
    xi = np.asarray(xi, float)
    w, v = xi[..., :3], xi[..., 3:]
    _, b, c, d, e = _coefficients(_angle(w))[..., None, None]
    W, V, wv = skew(w), skew(v), np.vecdot(w, v)[..., None, None]
    WW, WV, wvW = W @ W, W @ V, wv * W
    WWV = W @ WV
    Q = c * (WV + WV.mT + wvW) - d * (WWV - WWV.mT + 3 * wvW) - 2 * e * wv * WW - V / 2
    return _lower_blocks(_EYE3 - b * W + c * WW, Q)


def right_jacobian_inverse(xi: ArrayLike) -> Array:
    """Return (..., 6, 6) the inverse of ``right_jacobian(xi)``, for rotations below 2 pi.

    With it ``log(T exp(d)) = log(T) + right_jacobian_inverse(log(T)) d`` for small d.
    """
    xi = np.asarray(xi, float)
    J_inverse = so3_left_jacobian_inverse(-xi[..., :3])
    Q = right_jacobian(xi)[..., 3:, :3]
    return _lower_blocks(J_inverse, -J_inverse @ Q @ J_inverse)


def apply(T: ArrayLike, points: ArrayLike) -> Array:
    """Return the points (..., N, 3) in metres of frame b expressed in frame a, for T_a_b."""
    T = np.asarray(T, float)
    moved = np.asarray(points, float) @ T[..., :3, :3].mT
    for axis in range(3):  # one axis of all points at a time: numpy adds rows of three slowly
        moved[..., axis] += T[..., None, axis, 3]
    return moved


def from_xyz_rpy(xyz: ArrayLike, rpy: ArrayLike) -> Array:
    """Return (..., 4, 4) from URDF's xyz (..., 3) in metres and rpy (..., 3) in radians.

    Fixed axes x, y, z: R = Rz(yaw) Ry(pitch) Rx(roll).
    """
    turns = np.asarray(rpy, float)[..., None] * _EYE3
    Rx, Ry, Rz = np.moveaxis(so3_exp(turns), -3, 0)
    return _transform(Rz @ Ry @ Rx, np.asarray(xyz, float))


def to_rpy(T: ArrayLike) -> Array:
    """Return URDF's roll, pitch, yaw (..., 3) in radians; at pitch +-pi/2 the yaw is set to 0.

    Each angle is read off what those before it leave of R, so that R is met to rounding at any
    pitch, which Euler angles computed one by one do not do close to +-pi/2.
    """
    R = np.asarray(T, float)[..., :3, :3]
    upright = np.hypot(R[..., 0, 0], R[..., 1, 0]) < 1e-15
    yaw = np.where(upright, 0.0, np.arctan2(R[..., 1, 0], R[..., 0, 0]))
    c, s = np.cos(yaw)[..., None], np.sin(yaw)[..., None]
    x, y = c * R[..., 0, :] + s * R[..., 1, :], c * R[..., 1, :] - s * R[..., 0, :]
    pitch = np.arctan2(-R[..., 2, 0], x[..., 0])
    return np.stack([np.arctan2(-y[..., 2], y[..., 1]), pitch, yaw], axis=-1)


def from_xyz_quat(xyz: ArrayLike, quat_wxyz: ArrayLike) -> Array:
    """Return (..., 4, 4) from xyz (..., 3) in metres and quat_wxyz (..., 4) of any length but 0.

    Rows with NaN (a body not seen) give NaN.
    """
    q = np.asarray(quat_wxyz, float)
    q = q / np.sqrt(np.vecdot(q, q))[..., None]
    V = skew(q[..., 1:])
    return _transform(_EYE3 + 2 * (q[..., :1, None] * V + V @ V), np.asarray(xyz, float))


def to_quat_wxyz(T: ArrayLike) -> Array:
    """Return the unit quaternions (..., 4) of T (..., 4, 4) as w x y z with w >= 0."""
    return _quat_wxyz(np.asarray(T, float)[..., :3, :3])


def _quat_wxyz(R: Array) -> Array:
    """Unit quaternions (..., 4) of rotations (..., 3, 3), w >= 0.

    All entries of ``4 q q^T`` are sums of those of R; its longest row is q times a number far from
    zero (Shepperd, J. Guidance and Control 1, 1978).
    """
    (a, b, c), (d, e, f), (g, h, i) = np.moveaxis(R, (-2, -1), (0, 1))
    rows = [
        [1 + a + e + i, h - f, c - g, d - b],
        [h - f, 1 + a - e - i, b + d, c + g],
        [c - g, b + d, 1 - a + e - i, f + h],
        [d - b, c + g, f + h, 1 - a - e + i],
    ]
    outer = np.moveaxis(np.array(rows), (0, 1), (-2, -1))
    longest = np.argmax(np.einsum("...ii->...i", outer), axis=-1)
    q = np.take_along_axis(outer, longest[..., None, None], axis=-2)[..., 0, :]
    q = q / np.sqrt(np.vecdot(q, q))[..., None]
    return np.where(q[..., :1] < 0.0, -q, q)
