"""Closed forms against known transforms, a numerical minimum, and points that fix nothing."""

import numpy as np
import pytest
from scipy.optimize import minimize

from chains import se3
from chains.align import align_points, hand_eye, mean_pose
from chains.errors import InputError

RNG = np.random.default_rng(3)
T_A_B = se3.exp(np.array([2.0, -1.5, 1.0, 5.0, -3.0, 1.0]))


@pytest.mark.parametrize("flat", [False, True])
@pytest.mark.parametrize("count", [3, 4, 50])
def test_exact_points_give_the_transform_back(count, flat):
    points_b = RNG.normal(size=(count, 3)) * ([1, 1, 0] if flat else [1, 1, 1])
    T_a_b, rms_m = align_points(se3.apply(T_A_B, points_b), points_b)
    np.testing.assert_allclose(T_a_b, T_A_B, atol=1e-12)
    assert rms_m < 1e-12


def test_mirrored_points_are_not_matched_by_a_mirror():
    points_b = RNG.normal(size=(8, 3))
    T_a_b, rms_m = align_points(points_b * [1, 1, -1], points_b)
    assert np.linalg.det(T_a_b[:3, :3]) == pytest.approx(1)
    assert rms_m > 0.1


def test_noisy_weighted_points_reach_the_least_squares_minimum():
    points_b, weights = RNG.normal(size=(12, 3)), RNG.uniform(0.1, 5, size=12)
    points_a = se3.apply(T_A_B, points_b) + 0.05 * RNG.normal(size=(12, 3))
    T_a_b, rms_m = align_points(points_a, points_b, weights)

    def mean_square(xi):
        misses = points_a - se3.apply(T_a_b @ se3.exp(xi), points_b)
        return np.average((misses**2).sum(axis=1), weights=weights)

    best = minimize(mean_square, np.full(6, 0.02), tol=1e-14)
    np.testing.assert_allclose(best.x, 0, atol=1e-6)
    assert rms_m == pytest.approx(np.sqrt(best.fun), rel=1e-9)


def test_a_point_of_no_weight_has_no_say():
    points_b = RNG.normal(size=(5, 3))
    points_a = se3.apply(T_A_B, points_b)
    points_a[2] += 10
    T_a_b, rms_m = align_points(points_a, points_b, [1, 1, 0, 1, 1])
    np.testing.assert_allclose(T_a_b, T_A_B, atol=1e-12)
    assert rms_m < 1e-12


def test_too_few_points_are_refused():
    points = RNG.normal(size=(4, 3))
    with pytest.raises(InputError, match="2 points cannot fix a pose; at least 3"):
        align_points(points[:2], points[:2])
    with pytest.raises(InputError, match="2 points"):
        align_points(points, points, [1, 0, 0, 1])


@pytest.mark.parametrize("noise_m", [0.0, 1e-4])
def test_points_on_one_line_are_refused(noise_m):
    line = np.linspace(-1, 3, 6)[:, None] * [1.0, 2.0, -1.0] + [4, 5, 6]
    line_b = line + noise_m * RNG.normal(size=(6, 3))
    with pytest.raises(InputError, match="one line"):
        align_points(se3.apply(T_A_B, line), line_b)
    bent = line + [[0, 0, 0.1 * (i == 2)] for i in range(6)]
    np.testing.assert_allclose(align_points(se3.apply(T_A_B, bent), bent)[0], T_A_B, atol=1e-10)


def test_mean_pose_of_poses_spread_evenly_is_the_centre():
    spread = 0.3 * np.concatenate([np.eye(6), -np.eye(6)])
    np.testing.assert_allclose(mean_pose(T_A_B @ se3.exp(spread)), T_A_B, atol=1e-12)


def test_mean_pose_minimises_the_chordal_distance():
    Ts = T_A_B @ se3.exp(0.5 * RNG.normal(size=(7, 6)))
    mean = mean_pose(Ts)

    def distance(xi):
        return np.sum((Ts - mean @ se3.exp(xi)) ** 2)

    assert all(distance(s * d) > distance(np.zeros(6)) for s in (-1e-3, 1e-3) for d in np.eye(6))


# ---------------------------------------------------------------------------------------- hand-eye

T_TIP_BODY, T_WORLD_BASE = se3.exp([0.3, -2, 1, 0.1, 0.2, -0.3]), se3.exp([3.0, 0.4, 0, 2, -1, 0.5])


def test_exact_poses_give_both_ends_of_an_arm_back():
    T_base_tip = se3.exp(RNG.normal(size=(8, 6)))
    X, Z = hand_eye(T_WORLD_BASE @ T_base_tip @ T_TIP_BODY, T_base_tip)
    np.testing.assert_allclose(X, T_TIP_BODY, atol=1e-10)
    np.testing.assert_allclose(Z, T_WORLD_BASE, atol=1e-10)


def test_noise_moves_them_by_no_more_than_it_may():
    T_base_tip = se3.exp(RNG.normal(size=(200, 6)))
    noise = se3.exp(1e-3 * RNG.normal(size=(200, 6)))
    X, Z = hand_eye(T_WORLD_BASE @ T_base_tip @ T_TIP_BODY @ noise, T_base_tip)
    for found, true in ((X, T_TIP_BODY), (Z, T_WORLD_BASE)):
        gap = se3.log(se3.inverse(true) @ found)
        assert 1e-6 < np.linalg.norm(gap) < 1e-3


@pytest.mark.parametrize("count", [2, 9])
def test_turns_about_one_axis_do_not_tell(count):
    one_axis = np.zeros((count, 6))
    one_axis[:, 2:] = RNG.normal(size=(count, 4))
    with pytest.raises(InputError, match="at least 3" if count < 3 else "one axis"):
        hand_eye(se3.exp(one_axis), se3.exp(one_axis))
