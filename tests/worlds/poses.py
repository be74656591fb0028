"""Rotations and poses as arrays (..., 3, 3) and (..., 4, 4); T_a_b maps b to a."""

from __future__ import annotations

import numpy as np


def turn(axis: np.ndarray, angle: np.ndarray | float) -> np.ndarray:
    """Rotations (..., 3, 3) about unit axes (..., 3) by angles (...) rad: Rodrigues' formula."""
    axis, angle = np.asarray(axis, float), np.asarray(angle, float)[..., None, None]
    x, y, z = np.moveaxis(axis, -1, 0)
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(*x.shape, 3, 3)
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * (cross @ cross)


def turn_vector(vector: np.ndarray) -> np.ndarray:
    """Rotations (..., 3, 3) of rotation vectors (..., 3) rad."""
    angle = np.linalg.norm(vector, axis=-1)
    safe = np.where(angle > 0, angle, 1.0)[..., None]
    return turn(np.where(angle[..., None] > 0, vector / safe, [0.0, 0.0, 1.0]), angle)


def rpy(roll: float, pitch: float, yaw: float) -> np.ndarray:
    """URDF's rotation (3, 3): about the fixed axes x, then y, then z."""
    x, y, z = np.eye(3)
    return turn(z, yaw) @ turn(y, pitch) @ turn(x, roll)


def pose(rotation: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Poses (..., 4, 4) of rotations (..., 3, 3) and positions (..., 3) m."""
    rotation, shift = np.asarray(rotation, float), np.asarray(shift, float)
    out = np.zeros((*np.broadcast_shapes(rotation.shape[:-2], shift.shape[:-1]), 4, 4))
    out[..., :3, :3], out[..., :3, 3], out[..., 3, 3] = rotation, shift, 1.0
    return out


def moved(T: np.ndarray, shift: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Poses moved by shifts (..., 3) m in the parent's axes, turned about the child's by rad."""
    return pose(T[..., :3, :3] @ turn_vector(vector), T[..., :3, 3] + shift)


def inverse(T: np.ndarray) -> np.ndarray:
    """Inverse poses (..., 4, 4)."""
    back = np.swapaxes(T[..., :3, :3], -1, -2)
    return pose(back, -(back @ T[..., :3, 3, None])[..., 0])


def apply(T: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points (N, 3) of the child, in the parent."""
    return points @ T[:3, :3].T + T[:3, 3]


def quaternion(R: np.ndarray) -> np.ndarray:
    """Unit quaternions (..., 4) w x y z, w >= 0, by the eigenvectors of Bar-Itzhack."""
    K = np.zeros((*R.shape[:-2], 4, 4))
    trace = np.trace(R, axis1=-2, axis2=-1)
    K[..., 0, 0] = trace
    for i, (j, k) in enumerate(((1, 2), (2, 0), (0, 1))):
        K[..., 0, i + 1] = K[..., i + 1, 0] = R[..., k, j] - R[..., j, k]
    both = R + np.swapaxes(R, -1, -2)
    K[..., 1:, 1:] = both - trace[..., None, None] * np.eye(3)
    q = np.linalg.eigh(K)[1][..., -1]
    return np.where(q[..., :1] < 0, -q, q)
