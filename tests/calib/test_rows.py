"""Compression and robust weights, against dense algebra and the functions they are defined by."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm

from calib.problem import build
from calib.problem.model import Model, Source
from calib.residuals.rows import (
    TUKEY,
    Group,
    gram,
    robust_scale,
    split,
    square_root,
    tukey_cost,
    tukey_curvature,
    tukey_weight,
)

from . import rigs


def group(rng, rows, size):
    return Group(rng.integers(-1, size, rows), rng.normal(size=rows), size)


def expanded(g):
    columns = np.zeros((len(g.index), g.size))
    for row, (index, value) in enumerate(zip(g.index, g.value, strict=True)):
        if index >= 0:
            columns[row, index] = value
    return columns


@pytest.mark.parametrize("sizes", [(), (5,), (5, 1, 16), (3, 3)])
@pytest.mark.parametrize("rows", [0, 1, 200])
def test_gram_is_the_dense_product(rows, sizes):
    rng = np.random.default_rng(len(sizes) + rows)
    dense, weight = rng.normal(size=(rows, 4)), rng.uniform(0, 3, rows)
    groups = [group(rng, rows, size) for size in sizes]
    A = np.hstack([dense, *[expanded(g) for g in groups]])
    np.testing.assert_allclose(gram(dense, groups, weight), A.T @ (weight[:, None] * A), atol=1e-12)


def test_a_row_that_touches_no_column_of_a_group_may_hold_any_value_there():
    g = Group(np.array([0, -1]), np.array([2.0, np.nan]), 2)
    np.testing.assert_array_equal(
        gram(np.ones((2, 1)), [g], np.ones(2)), [[2, 2, 0], [2, 4, 0], [0, 0, 0]]
    )


def assert_is_root(root, matrix):
    size = np.sqrt(np.diag(matrix))
    size[size == 0] = 1.0
    assert np.isfinite(root).all()
    unit = np.outer(size, size)
    np.testing.assert_allclose(root.T @ root / unit, matrix / unit, atol=1e-12)


@pytest.mark.parametrize("scale", [1.0, 1e-140, 1e140])
@pytest.mark.parametrize("rank", [0, 1, 3, 12])
def test_square_root_reproduces_a_matrix_of_any_rank(rank, scale):
    rng = np.random.default_rng(rank)
    A = scale * rng.normal(size=(rank, 12))
    root = square_root(A.T @ A)
    assert_is_root(root, A.T @ A)
    assert np.count_nonzero(np.abs(root).max(axis=1)) == rank


def test_square_root_stands_columns_of_very_different_size():
    rng = np.random.default_rng(0)
    A = rng.normal(size=(4, 9)) * 10.0 ** np.array([-140, -70, -9, -3, 0, 3, 9, 70, 140])
    A[:, 2] = 0.0
    assert_is_root(square_root(A.T @ A), A.T @ A)


def test_square_root_gives_the_residuals_cost():
    rng = np.random.default_rng(1)
    A, b = rng.normal(size=(500, 6)) * 10.0 ** np.arange(-3, 3), rng.normal(size=500)
    rows = np.column_stack([A, b])
    root = square_root(rows.T @ rows)
    x = rng.normal(size=6)
    assert np.sum((root[:, 6] + root[:, :6] @ x) ** 2) == pytest.approx(
        np.sum((b + A @ x) ** 2), rel=1e-12
    )


@pytest.mark.parametrize("rank", [0, 1, 3, 6])
def test_split_gives_the_same_cost_with_few_rows_that_know_the_first_columns(rank):
    rng = np.random.default_rng(rank)
    first = rng.normal(size=(200, rank)) @ rng.normal(size=(rank, 6)) * 10.0 ** np.arange(-3, 3)
    A = np.hstack([first, rng.normal(size=(200, 9))])
    top, rest = split(A.T @ A, 6)
    assert top.shape == (6, 15) and np.count_nonzero(np.abs(top).max(axis=1)) == rank
    rebuilt = top.T @ top
    rebuilt[6:, 6:] += rest
    size = np.maximum(np.linalg.norm(A, axis=0), 1e-9)
    np.testing.assert_allclose(
        rebuilt / np.outer(size, size), A.T @ A / np.outer(size, size), atol=1e-12
    )
    # What is left is what the others say once the first have taken up all they can.
    taken = np.linalg.lstsq(A[:, :6] / size[:6], A[:, 6:], rcond=1e-12)[0]
    left = A[:, 6:] - A[:, :6] / size[:6] @ taken
    np.testing.assert_allclose(rest, left.T @ left, atol=1e-9)


@pytest.fixture(scope="module")
def stop(tmp_path_factory):
    """One stop's scan, and a state."""
    source = Source.open(rigs.write(tmp_path_factory.mktemp("rows") / "box"))
    problem = build([source], Model())
    return problem.scans[0], problem.initial


def test_plain_cholesky_fails_on_one_stops_information_and_square_root_does_not(stop):
    scan, values = stop
    rows = scan.rows(values)
    placed = scan.stops.in_reference("lidar", values)
    A = rows.by_twist @ np.hstack([d[0] for d in placed.d.values()])
    A *= np.sqrt(rows.weight)[:, None] / rows.sigma_m[:, None]
    information = A.T @ A
    size = np.sqrt(np.maximum(np.diag(information), 1e-300))
    with pytest.raises(np.linalg.LinAlgError):
        np.linalg.cholesky(information / np.outer(size, size))
    root = square_root(information)
    assert_is_root(root, information)
    assert np.count_nonzero(np.abs(root).max(axis=1)) == 6


@pytest.mark.parametrize("scale", [1.0, 2.5])
def test_tukey_weight_is_the_slope_of_the_cost(scale):
    z = np.linspace(-15, 15, 301)
    h = 1e-5
    slope = [(tukey_cost(x + h, scale) - tukey_cost(x - h, scale)) / (2 * h) for x in z[:, None]]
    np.testing.assert_allclose(z * tukey_weight(z, scale), slope, atol=1e-8)


@pytest.mark.parametrize("scale", [1.0, 2.5])
def test_tukey_curvature_is_the_slope_of_the_pull_and_never_far_below_the_weight(scale):
    z = np.linspace(-15, 15, 301)
    h = 1e-5
    pull = [(z + step) * tukey_weight(z + step, scale) for step in (h, -h)]
    slope, floor = (pull[0] - pull[1]) / (2 * h), 0.1 * tukey_weight(z, scale)
    assert (slope > floor).any() and (slope < floor).any()
    np.testing.assert_allclose(tukey_curvature(z, scale), np.maximum(slope, floor), atol=1e-4)


def test_tukey_cost_is_half_chi_square_near_zero_and_bounded_far_off():
    z = np.array([0.01, -0.02])
    assert tukey_cost(z) == pytest.approx(0.5 * z @ z, rel=1e-4)
    assert (
        tukey_cost(np.array([1e6])) == tukey_cost(np.array([20.0])) == pytest.approx(TUKEY**2 / 6)
    )
    assert tukey_cost(np.array([20.0]), 3.0) == pytest.approx(1.5 * TUKEY**2)


def test_tukey_keeps_95_percent_of_the_information_of_normal_rows():
    def influence(z):
        return z * tukey_weight(np.array(z))

    def slope(z):
        return (influence(z + 1e-5) - influence(z - 1e-5)) / 2e-5

    gain = quad(lambda z: slope(z) * norm.pdf(z), -TUKEY, TUKEY)[0]
    noise = quad(lambda z: influence(z) ** 2 * norm.pdf(z), -TUKEY, TUKEY)[0]
    assert gain**2 / noise == pytest.approx(0.95, abs=1e-3)


def test_robust_scale_is_the_width_of_the_bulk_and_never_below_one():
    rng = np.random.default_rng(0)
    z = rng.normal(0, 3, 20000)
    z[:2000] = 1e4
    # Of the other 90 %, the median of |z| is the quantile 5/9.
    assert robust_scale(z) == pytest.approx(3 * 1.4826 * norm.ppf(0.5 + 5 / 18), rel=0.02)
    assert robust_scale(z / 100) == 1.0 == robust_scale(np.zeros(0))
