"""Elimination and square roots, against dense algebra."""

import numpy as np
import pytest
from scipy.linalg import block_diag

from calib.linear.elimination import Eliminated, eliminate, eliminate_apart, square_root
from calib.problem import build
from calib.problem.model import Model, Source

from .. import rigs


def equations(rng, count, scale=1.0):
    """Normal equations of rows with a right side, and the rows."""
    A = rng.normal(size=(300, count + 1)) * scale
    return A.T @ A, A


@pytest.mark.parametrize("sizes", [[1], [6], [1, 1, 1, 1, 1, 1], [3, 1, 2]])
def test_what_is_left_is_what_the_others_say_once_the_first_have_taken_all_they_can(sizes):
    """Whether they are tied to each other or, set by set, are not."""
    count = sum(sizes)
    rng = np.random.default_rng(count)
    _, A = equations(rng, 9, 10.0 ** np.array([-3, 2, 0, 1, -2, 3, 0, 0, -1, 2]))
    apart, _ = np.linalg.qr(A[:, :count])
    turn = block_diag(*(rng.normal(size=(n, n)) + 3.0 * np.eye(n) for n in sizes))
    A = np.hstack([apart @ turn, A[:, count:]])
    whole = A.T @ A
    block, left = whole[:count, :count], whole[count:, count:].copy()
    gone = eliminate_apart(np.tril(block), whole[:count, count:], left, sizes)
    gain = np.vstack([gain for _, gain in gone])
    taken = np.linalg.lstsq(A[:, :count], A[:, count:], rcond=None)[0]
    beyond = A[:, count:] - A[:, :count] @ taken
    size = np.sqrt(np.diag(whole))
    expected = beyond.T @ beyond
    unit = np.outer(size, size)
    np.testing.assert_allclose(
        left / unit[count:, count:], expected / unit[count:, count:], atol=1e-10
    )
    np.testing.assert_array_equal(left, left.T)
    np.testing.assert_allclose(gain, taken, rtol=1e-7, atol=1e-9)
    right = rng.normal(size=(count, 3))
    first, found = 0, []
    for (factor, gain), n in zip(gone, sizes, strict=True):
        one = Eliminated(np.arange(n), np.arange(n, len(whole)), factor, gain)
        found.append(one.solve(right[first : first + n]))
        first += n
    np.testing.assert_allclose(np.vstack(found), np.linalg.solve(block, right), rtol=1e-7)


def test_eliminated_one_by_one_or_at_once_the_rest_and_the_solution_are_the_same():
    rng = np.random.default_rng(5)
    whole, A = equations(rng, 9)
    at_once = whole[4:, 4:].copy()
    eliminate(whole[:4, :4], whole[:4, 4:], at_once)
    left = whole.copy()
    for _ in range(4):
        rest = left[1:, 1:].copy()
        eliminate(left[:1, :1], left[:1, 1:], rest)
        left = rest
    np.testing.assert_allclose(left, at_once, atol=1e-9)
    solution = np.linalg.solve(at_once[:-1, :-1], at_once[:-1, -1])
    expected = np.linalg.lstsq(A[:, :-1], A[:, -1], rcond=None)[0]
    np.testing.assert_allclose(solution, expected[4:], rtol=1e-9)


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
