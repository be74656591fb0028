"""Compiled loops against plain numpy: dense matrices, planes and vectors one by one."""

import numpy as np
import pytest

from calib.residuals import compiled
from chains import se3

GROUPS = [(), (5,), (5, 1, 16), (3, 3)]


def close(found, expected):
    scale = max(np.abs(expected).max(initial=0.0), 1e-300)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12 * scale)


# ------------------------------------------------------------------------------------------- beams


def pose(rng):
    return se3.exp(rng.normal(0, [0.5] * 3 + [2.0] * 3))


def beams(rng, count):
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return rng.normal(0, 0.05, (count, 3)), direction


def planes(rng, count):
    normal = rng.normal(size=(count, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    none = [[0.0, 0.0, 0.0, np.inf]]
    return np.vstack([np.column_stack([normal, rng.normal(0, 3.0, count)]), none])


def test_beams_meet_planes_where_points_of_both_coincide():
    rng = np.random.default_rng(0)
    T, plane = pose(rng), planes(rng, 40)
    origin, direction = beams(rng, 500)
    part = rng.integers(-1, 40, 500)
    range_m, cosine, slope = compiled.meet_planes(T, origin, direction, plane, part)
    met = np.isfinite(range_m)
    assert 100 < met.sum() < 400 and not met[part < 0].any()
    for i in range(500):
        R, t = T[:3, :3], T[:3, 3]
        start, along = R @ origin[i] + t, R @ direction[i]
        n, d = plane[part[i], :3], plane[part[i], 3]
        expected = (d - n @ start) / (n @ along) if part[i] >= 0 else -1.0
        assert met[i] == (expected > 0), "a plane behind the sensor is not met"
        if met[i]:
            close(range_m[i], expected)
            close(n @ (start + range_m[i] * along), d)
            close(cosine[i], abs(n @ along))
            close(slope[i], R.T @ n / (n @ along))
        else:
            assert cosine[i] == 0 and not slope[i].any() and range_m[i] == np.inf


def test_a_beam_along_its_plane_and_one_that_starts_on_it_meet_nothing():
    plane = np.array([[0.0, 0, 1, 2], [0, 0, 1, 0], [0, 0, 0, np.inf]])
    ahead, up = [1.0, 0, 0], [0.0, 0, 1]
    found = compiled.meet_planes(
        np.eye(4), np.zeros((4, 3)), np.array([ahead, ahead, up, up]), plane, np.array([0, 1, 1, 0])
    )
    np.testing.assert_array_equal(found[0], [np.inf, np.inf, np.inf, 2.0])
    np.testing.assert_array_equal(found[1], [0, 0, 0, 1])
    np.testing.assert_array_equal(found[2], [[0, 0, 0]] * 3 + [[0, 0, 1]])


def test_twist_derivative_is_how_the_range_to_the_plane_moves():
    """By differences of what a moved sensor meets, and by the cross product it is."""
    rng = np.random.default_rng(1)
    T, plane = pose(rng), planes(rng, 20)
    origin, direction = beams(rng, 200)
    part = rng.integers(0, 20, 200)
    range_m, cosine, slope = compiled.meet_planes(T, origin, direction, plane, part)
    met = np.flatnonzero(cosine > 0.1)
    chosen = origin[met], direction[met]
    found = compiled.twist_derivative(*chosen, range_m[met], slope[met])
    hit = chosen[0] + range_m[met, None] * chosen[1]
    close(found, np.hstack([np.cross(hit, slope[met]), slope[met]]))
    step = 1e-6
    for k, twist in enumerate(step * np.eye(6)):
        ahead, back = (
            compiled.meet_planes(T @ se3.exp(sign * twist), *chosen, plane, part[met])[0]
            for sign in (1, -1)
        )
        by_range = (ahead - back) / (2 * step)
        np.testing.assert_allclose(-by_range, found[:, k], rtol=1e-6, atol=1e-6)


# -------------------------------------------------------------------------------------------- sums


def rows(rng, count, sizes):
    """Dense columns, weights with zeros, and sparse columns: index, value, and both in full."""
    dense, weight = rng.normal(size=(count, 4)), rng.uniform(0, 3, count)
    weight[::7] = 0.0
    starts = np.cumsum([0, *sizes])
    index = np.empty((count, len(sizes)), np.int32)
    for g, size in enumerate(sizes):
        inside = rng.integers(-1, size, count)
        index[:, g] = np.where(inside < 0, -1, inside + starts[g])
    value = rng.normal(size=index.shape)
    value[index < 0] = np.nan  # of no column, and looked at by nobody
    full = np.zeros((count, starts[-1]))
    for i, g in zip(*np.nonzero(index >= 0), strict=True):
        full[i, index[i, g]] = value[i, g]
    return dense, weight, index, value, full, int(starts[-2]) if sizes else 0


@pytest.mark.parametrize("sizes", GROUPS)
@pytest.mark.parametrize("count", [0, 1, 200])
def test_cross_sums_are_blocks_of_the_dense_product(count, sizes):
    rng = np.random.default_rng(len(sizes) + count)
    dense, weight, index, value, full, last = rows(rng, count, sizes)
    size = full.shape[1]
    found = compiled.cross_sums(dense, weight, index, value, size, last)
    gram = full.T @ (weight[:, None] * full)
    group = np.repeat(np.arange(len(sizes)), sizes)
    later = group[:last, None] < group
    close(found[0], full.T @ (weight[:, None] * dense))
    close(found[1], np.where(later, gram[:last], 0.0))
    close(found[2], np.diag(gram))
    assert found[1].shape == (last, size)


@pytest.mark.parametrize("sizes", GROUPS)
def test_cluster_sums_are_those_of_the_rows_of_each(sizes):
    rng = np.random.default_rng(len(sizes))
    dense, weight, index, value, full, _ = rows(rng, 300, sizes)
    cluster = rng.integers(0, 6, 300)
    weight -= 1.0  # weights times residuals have either sign
    found = compiled.cluster_sums(dense, weight, index, value, full.shape[1], cluster, 7)
    pick = (cluster == np.arange(7)[:, None]) * weight
    close(found, pick @ np.hstack([dense, full]))
    assert not found[6].any()


@pytest.mark.parametrize("sizes", GROUPS)
def test_square_sums_are_those_of_rows_along_directions(sizes):
    rng = np.random.default_rng(len(sizes))
    dense, weight, index, value, full, _ = rows(rng, 300, sizes)
    cluster = rng.integers(0, 6, 300)
    directions = rng.normal(size=(dense.shape[1] + full.shape[1], 4))
    by = directions[: dense.shape[1]], directions[dense.shape[1] :]
    found = compiled.square_sums(dense, weight, index, value, *by, cluster, 7)
    pick = (cluster == np.arange(7)[:, None]) * weight
    close(found, pick @ np.square(np.hstack([dense, full]) @ directions))
    assert not found[6].any()


def test_add_sparse_puts_every_product_once_below_the_diagonal_where_its_columns_stand():
    rng = np.random.default_rng(3)
    sizes = (6, 4, 5)
    dense, weight, index, value, full, last = rows(rng, 200, sizes)
    count, places = sum(sizes), 20  # more places than columns
    at, unit = rng.permutation(places)[:count], rng.uniform(0.5, 2.0, count)
    half = rng.normal(size=(places, places))
    before = half.copy()
    _, with_sparse, own = compiled.cross_sums(dense, weight, index, value, count, last)
    compiled.add_sparse(half, at, unit, with_sparse, own)
    full = full * unit
    expected = np.zeros((places, places))
    expected[np.ix_(at, at)] = full.T @ (weight[:, None] * full)
    added = half - before
    assert not np.triu(added, 1).any()
    close(added + added.T, expected)


@pytest.mark.parametrize("both", [False, True])
def test_blocks_are_added_at_their_places_and_nowhere_for_minus_one(both):
    rng = np.random.default_rng(4)
    target, block = rng.normal(size=(8, 8)), rng.normal(size=(4, 5))
    at, to = np.array([3, -1, 0, 7]), np.array([1, 3, -1, 6, 2])
    expected = target.copy()
    for i, row in enumerate(at):
        for k, column in enumerate(to):
            if row >= 0 and column >= 0:
                expected[row, column] += block[i, k]
                if both:
                    expected[column, row] += block[i, k]
    (compiled.add_both if both else compiled.add_at)(target, at, to, block)
    np.testing.assert_array_equal(target, expected)


def test_columns_are_numbered_as_they_are_touched():
    rng = np.random.default_rng(4)
    index = rng.choice([-1, 2, 3, 7], 50).astype(np.int32)
    out = np.empty((50, 2), np.int32)
    touched = compiled.renumber(index, 9, 5, out[:, 1])
    np.testing.assert_array_equal(touched, np.unique(index[index >= 0]))
    met = index >= 0
    np.testing.assert_array_equal(out[met, 1], 5 + np.searchsorted(touched, index[met]))
    assert (out[~met, 1] == -1).all()


def test_what_cannot_be_kept_on_disk_is_compiled_all_the_same():
    where = {}
    exec("def twice(x):\n    return 2.0 * x", where)  # of no file, beside which it could be kept
    assert compiled.compiled(where["twice"])(1.5) == 3.0
