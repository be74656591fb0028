"""Rigid transforms against their axioms, scipy's matrix exponential, differences, and gtsam."""

import gtsam
import numpy as np
import pytest
import scipy.linalg

from chains import se3

RNG = np.random.default_rng(1)
ANGLES_RAD = [0.0, 1e-12, 1e-6, 1e-3, 0.3, 0.999999, 1.0, 2.0, np.pi - 1e-3, np.pi - 1e-9]


def tangents(angle_rad: float, count: int = 4) -> se3.Array:
    """Return tangents (count, 6) that all turn by the same angle about random axes."""
    w, v = RNG.normal(size=(2, count, 3))
    w *= angle_rad / np.linalg.norm(w, axis=1, keepdims=True)
    return np.concatenate([w, v], axis=1)


def generator(xi: se3.Array) -> se3.Array:
    """Return the matrix (4, 4) whose exponential is the transform."""
    rx, ry, rz, tx, ty, tz = xi
    return np.array([[0, -rz, ry, tx], [rz, 0, -rx, ty], [-ry, rx, 0, tz], [0, 0, 0, 0]])


def difference(function, at: se3.Array, step: float = 1e-6) -> se3.Array:
    """Return the central differences (..., rows, columns) of a function of (..., columns)."""
    steps = step * np.eye(at.shape[-1])
    return np.stack([(function(at + d) - function(at - d)) / (2 * step) for d in steps], axis=-1)


@pytest.mark.parametrize("angle_rad", ANGLES_RAD)
def test_exp_is_the_matrix_exponential(angle_rad):
    for xi in tangents(angle_rad):
        np.testing.assert_allclose(se3.exp(xi), scipy.linalg.expm(generator(xi)), atol=2e-14)
        np.testing.assert_allclose(se3.so3_exp(xi[:3]), se3.exp(xi)[:3, :3], atol=1e-15)


@pytest.mark.parametrize("angle_rad", ANGLES_RAD)
def test_log_undoes_exp(angle_rad):
    xi = tangents(angle_rad)
    np.testing.assert_allclose(se3.log(se3.exp(xi)), xi, atol=1e-12)


def test_log_at_pi_is_one_of_the_two_answers():
    xi = tangents(np.pi)
    np.testing.assert_allclose(se3.exp(se3.log(se3.exp(xi))), se3.exp(xi), atol=1e-12)


@pytest.mark.parametrize("angle_rad", ANGLES_RAD)
def test_right_jacobian_against_differences(angle_rad):
    xi = tangents(angle_rad)
    back = se3.inverse(se3.exp(xi))
    numerical = difference(lambda x: se3.log(back @ se3.exp(x)), xi)
    np.testing.assert_allclose(se3.right_jacobian(xi), numerical, atol=1e-8)


@pytest.mark.parametrize("angle_rad", ANGLES_RAD)
def test_right_jacobian_inverse(angle_rad):
    xi = tangents(angle_rad)
    product = se3.right_jacobian_inverse(xi) @ se3.right_jacobian(xi)
    np.testing.assert_allclose(product, np.broadcast_to(np.eye(6), (4, 6, 6)), atol=1e-13)


def test_right_jacobian_has_no_step_where_the_series_ends():
    w = np.array([0.6, 0.0, 0.8, 1.0, -2.0, 3.0])
    scale = np.array([[1 - 1e-13], [1 + 1e-13]])
    below, above = se3.right_jacobian(scale * w)
    np.testing.assert_allclose(below, above, atol=1e-12)


@pytest.mark.parametrize("angle_rad", [0.0, 1e-4, 0.7, 3.0])
def test_so3_left_jacobian_inverse_against_differences(angle_rad):
    w = tangents(angle_rad)[:, :3]
    R = se3.so3_exp(w)
    numerical = difference(lambda d: se3.so3_log(se3.so3_exp(d) @ R), np.zeros((4, 3)))
    np.testing.assert_allclose(se3.so3_left_jacobian_inverse(w), numerical, atol=1e-8)


def test_group_axioms():
    A, B = se3.exp(tangents(1.3)), se3.exp(tangents(2.1))
    eye = np.broadcast_to(np.eye(4), A.shape)
    np.testing.assert_allclose(A @ se3.inverse(A), eye, atol=1e-14)
    np.testing.assert_allclose(se3.inverse(A @ B), se3.inverse(B) @ se3.inverse(A), atol=1e-14)
    np.testing.assert_allclose(se3.adjoint(A @ B), se3.adjoint(A) @ se3.adjoint(B), atol=1e-13)
    xi = tangents(0.4)
    moved = se3.exp(np.matvec(se3.adjoint(A), xi)) @ A
    np.testing.assert_allclose(A @ se3.exp(xi), moved, atol=1e-13)


@pytest.mark.parametrize("angle_rad", [1e-7, 0.02, 0.9, 2.5])
def test_agrees_with_gtsam(angle_rad):
    for xi, step in zip(tangents(angle_rad), tangents(0.5), strict=True):
        T, pose = se3.exp(xi), gtsam.Pose3.Expmap(xi)
        np.testing.assert_allclose(T, pose.matrix(), atol=1e-12)
        np.testing.assert_allclose(se3.log(T), gtsam.Pose3.Logmap(pose), atol=1e-9)
        np.testing.assert_allclose(se3.adjoint(T), pose.AdjointMap(), atol=1e-12)
        np.testing.assert_allclose(T @ se3.exp(step), pose.retract(step).matrix(), atol=1e-12)
        np.testing.assert_allclose(se3.inverse(T), pose.inverse().matrix(), atol=1e-12)


def test_skew_is_the_cross_product():
    w, x = RNG.normal(size=(2, 5, 3))
    np.testing.assert_allclose(np.matvec(se3.skew(w), x), np.cross(w, x), atol=1e-15)


def test_apply_maps_b_to_a():
    T_a_b = se3.from_xyz_rpy([1, 2, 3], [0, 0, np.pi / 2])
    np.testing.assert_allclose(se3.apply(T_a_b, [[1.0, 0, 0], [0, 1, 0]]), [[1, 3, 3], [0, 2, 3]])
    Ts, points = se3.exp(tangents(1.0)), RNG.normal(size=(4, 7, 3))
    each = np.stack(
        [(T @ np.c_[p, np.ones(7)].T).T[:, :3] for T, p in zip(Ts, points, strict=True)]
    )
    np.testing.assert_allclose(se3.apply(Ts, points), each, atol=1e-14)


def test_rpy_turns_about_fixed_axes_x_then_y_then_z():
    roll, pitch, yaw = 0.3, -0.8, 2.0
    turns = [
        se3.so3_exp(angle * axis) for angle, axis in zip((roll, pitch, yaw), np.eye(3), strict=True)
    ]
    T = se3.from_xyz_rpy([4, 5, 6], [roll, pitch, yaw])
    np.testing.assert_allclose(T[:3, :3], turns[2] @ turns[1] @ turns[0], atol=1e-15)
    np.testing.assert_allclose(T[:3, 3], [4, 5, 6])
    np.testing.assert_allclose(se3.to_rpy(T), [roll, pitch, yaw], atol=1e-14)


def test_rpy_of_a_vertical_pitch_still_gives_the_rotation():
    T = se3.from_xyz_rpy([0, 0, 0], [0.4, np.pi / 2, 1.0])
    rpy = se3.to_rpy(T)
    assert rpy[2] == 0
    np.testing.assert_allclose(se3.from_xyz_rpy([0, 0, 0], rpy), T, atol=1e-7)


def test_quaternions_against_gtsam_and_back():
    Ts = se3.exp(np.concatenate([tangents(0.2), tangents(3.1)]))
    quat_wxyz = se3.to_quat_wxyz(Ts)
    assert (quat_wxyz[:, 0] >= 0).all()
    for T, (w, x, y, z) in zip(Ts, quat_wxyz, strict=True):
        np.testing.assert_allclose(
            gtsam.Rot3.Quaternion(w, x, y, z).matrix(), T[:3, :3], atol=1e-14
        )
    np.testing.assert_allclose(se3.from_xyz_quat(Ts[:, :3, 3], -2 * quat_wxyz), Ts, atol=1e-14)


def test_a_body_not_seen_stays_not_seen():
    Ts = se3.from_xyz_quat(np.zeros((2, 3)), [[1, 0, 0, 0], [np.nan] * 4])
    np.testing.assert_array_equal(Ts[0], np.eye(4))
    assert np.isnan(Ts[1, :3, :3]).all()


@pytest.mark.parametrize("shape", [(), (0,), (5,), (2, 3)])
def test_leading_shape_is_kept(shape):
    xi = RNG.normal(size=(*shape, 6))
    T = se3.exp(xi)
    assert T.shape == (*shape, 4, 4)
    assert se3.log(T).shape == (*se3.to_quat_wxyz(T).shape[:-1], 6) == (*shape, 6)
    assert se3.to_rpy(T).shape == (*shape, 3)
    assert se3.from_xyz_rpy(xi[..., 3:], xi[..., :3]).shape == (*shape, 4, 4)
    assert se3.right_jacobian_inverse(xi).shape == se3.adjoint(T).shape == (*shape, 6, 6)
