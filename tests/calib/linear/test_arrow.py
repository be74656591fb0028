"""An arrow's factor, against dense algebra."""

import numpy as np
import pytest
from scipy.sparse import csr_array

from calib.linear.arrow import Arrow, apart, cheapest


def arrow(rng, sizes, shared):
    """H of rows that touch one set each, or none, and what all share; and the sets' columns."""
    columns = rng.permutation(sum(sizes) + shared)  # of all sets, then of what is shared
    own = np.split(columns[: sum(sizes)], np.cumsum(sizes)[:-1]) if sizes else []
    common = columns[sum(sizes) :]
    rows = []
    for mine in [*own, np.zeros(0, int)]:
        touched = np.concatenate([mine, common])
        some = np.zeros((len(touched) + 2, len(columns)))
        some[:, touched] = rng.normal(size=(len(some), len(touched)))
        rows.append(some * 10.0 ** rng.uniform(-3, 3, len(columns)))
    A = np.vstack(rows)
    return A.T @ A, own


@pytest.mark.parametrize("sparse", [False, True])
@pytest.mark.parametrize(
    ("sizes", "shared"),
    [([3, 3, 3], 5), ([2, 4, 2, 1], 3), ([], 4), ([4], 1), ([3, 0, 2], 2), ([3, 2], 0)],
    ids=str,
)
def test_it_solves_as_dense_algebra_does(sizes, shared, sparse):
    rng = np.random.default_rng(len(sizes) + shared)
    H, own = arrow(rng, sizes, shared)
    factor = Arrow.of(csr_array(H) if sparse else H, own)
    size = np.sqrt(np.diag(H))
    right = rng.normal(size=(len(H), 3)) * size[:, None]
    expected = np.linalg.solve(H / np.outer(size, size), right / size[:, None]) / size[:, None]
    found = factor.solve(right)
    np.testing.assert_allclose(found * size[:, None], expected * size[:, None], rtol=1e-6)
    np.testing.assert_allclose(factor.solve(right[:, 0]), found[:, 0], rtol=1e-12)
    assert factor.solve(right[:, :0]).shape == (len(H), 0)
    root = factor.root(right)
    np.testing.assert_allclose(root.T @ root, right.T @ expected, rtol=1e-6, atol=1e-9)


def rows_of(own, size):
    """Rows that touch one set each, and what all share."""
    rows = np.ones((len(own), size))
    for some, row in zip(own, rows, strict=True):
        row[np.setdiff1d(np.concatenate(own), some)] = 0.0
    return rows


def test_sets_apart_are_those_that_no_row_ties():
    rng = np.random.default_rng(0)
    H, own = arrow(rng, [3, 1, 2], 4)
    among = np.concatenate(own)
    rows = csr_array(rows_of(own, len(H)))
    found = {frozenset(some.tolist()) for some in apart(rows, rng.permutation(among))}
    assert found == {frozenset(some.tolist()) for some in own}
    (whole,) = apart(rows, np.arange(len(H)))  # what all share ties all
    assert sorted(whole.tolist()) == list(range(len(H)))


def test_the_cheapest_sets_leave_least_that_is_shared():
    few, many = [np.arange(6)], [np.arange(6 + 3 * k, 9 + 3 * k) for k in range(10)]
    assert cheapest(40, few, many) is many
    assert cheapest(40, few, []) is few
    one_large = [np.arange(36)]  # a set is factored whole
    assert cheapest(40, one_large, many) is many


@pytest.mark.parametrize("by", ["stops", "surfaces"])
def test_an_answer_does_not_depend_on_the_sets(by):
    rng = np.random.default_rng(3)
    H, own = arrow(rng, [3, 3, 2], 4)
    sets = own if by == "stops" else own[1:]
    right = rng.normal(size=(len(H), 2)) * np.sqrt(np.diag(H))[:, None]
    alone = Arrow.of(csr_array(H), []).solve(right)
    found, size = Arrow.of(csr_array(H), sets).solve(right), np.sqrt(np.diag(H))[:, None]
    np.testing.assert_allclose(found * size, alone * size, rtol=1e-6)
