"""How stops are chosen: against designs and numbers that textbooks have."""

from __future__ import annotations

from itertools import combinations, permutations

import numpy as np
import pytest
from scipy import stats

from calib.diagnosis.search.confirmed import ALPHA_EFFECT
from calib.planning.criteria import (
    Apart,
    Variance,
    Volume,
    chosen,
    indices,
    information_left,
    smallest,
)
from calib.planning.information import Information
from calib.planning.room.ways import in_order_of_path


def known(size, prior=1e-6):
    """Next to nothing known of so many components of an effect."""
    keys = tuple(("x", str(i)) for i in range(size))
    return Information(keys, np.ones(size), prior * np.eye(size), np.zeros((size, size)))


def silent(done, total):
    """Nobody looks."""


def test_d_optimal_stops_of_a_parabola_lie_at_its_ends_and_its_middle():
    """Six measurements of 1, x, x^2 on [-1, 1]: two at -1, two at 0, two at 1."""
    x = np.repeat(np.linspace(-1, 1, 21), 3)
    rows = np.stack([np.ones_like(x), x, x**2], axis=1)
    each = rows[:, :, None] * rows[:, None]
    found = chosen(Volume(known(3), np.arange(3)), each, 6, silent)
    assert sorted(x[found]) == pytest.approx([-1, -1, 0, 0, 1, 1])


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("kind", ["D", "A", "D of two", "T"])
def test_no_other_stop_in_place_of_one_is_better_and_few_designs_are(seed, kind):
    rng = np.random.default_rng(seed)
    rows = rng.standard_normal((9, 2, 4)) * rng.uniform(0.2, 3, (9, 1, 1))
    each, start = rows.mT @ rows, known(4, 0.1)
    by = {
        "D": Volume(start, np.arange(4)),
        "A": Variance(start, np.arange(4), np.ones(4)),
        "D of two": Volume(start, np.arange(2)),
        "T": Apart(start, [(np.array([k]), np.ones(1)) for k in (2, 3)], np.array([2, 3])),
    }[kind]
    found = chosen(by, each, 3, silent)
    assert len(set(found)) == 3
    designs = list(combinations(range(9), 3))
    value = by.of(np.stack([by.start + each[list(d)].sum(axis=0) for d in designs]))
    mine = value[designs.index(tuple(sorted(found)))]
    near = [len({*d} & {*found}) >= 2 for d in designs]
    assert mine >= value[near].max() - 1e-9
    assert np.mean(value > mine + 1e-9) < 0.05


def test_what_is_left_of_an_effect_is_what_regression_leaves():
    rng = np.random.default_rng(0)
    J = rng.standard_normal((40, 5))
    others = J[:, [0, 1, 4]]
    rest = J[:, 2:4] - others @ np.linalg.lstsq(others, J[:, 2:4], rcond=None)[0]
    left = information_left((J.T @ J)[None], np.array([2, 3]))[0]
    np.testing.assert_allclose(left, rest.T @ rest, rtol=1e-9)
    beside = J[:, [0, 1]]
    rest = J[:, 2:4] - beside @ np.linalg.lstsq(beside, J[:, 2:4], rcond=None)[0]
    left = information_left((J.T @ J)[None], np.array([2, 3]), [4])[0]
    np.testing.assert_allclose(left, rest.T @ rest, rtol=1e-9)


def test_an_effect_of_the_smallest_size_is_found_four_times_of_five():
    information = np.array([[40.0]])
    size = smallest(information, information)
    rng = np.random.default_rng(0)
    z = np.sqrt(40.0) * size + rng.standard_normal(20_000)
    found = stats.chi2.sf(z**2, 1) < ALPHA_EFFECT
    assert found.mean() == pytest.approx(0.8, abs=0.01)
    assert smallest(0 * information, information) == np.inf


def test_observability_indices_of_a_jacobian_with_known_singular_values():
    s = np.array([1.0, 4.0, 10.0])
    turn = np.linalg.qr(np.random.default_rng(0).standard_normal((3, 3)))[0]
    matrix = turn @ np.diag(s**2) @ turn.T
    what = Information(known(3).keys, np.ones(3), matrix, np.zeros((3, 3)))
    assert indices(what, np.arange(3), 4) == pytest.approx(
        {"O1": 40 ** (1 / 3) / 2, "O2": 0.1, "O3": 1.0, "O4": 0.1, "O5": 1 / 1.35}
    )


@pytest.mark.parametrize("seed", range(4))
def test_the_way_is_short(seed):
    """At one location after another, at most a twentieth longer than the shortest way."""
    joints = np.random.default_rng(seed).uniform(-3, 3, (10, 6))
    location = np.array(["b", "a"] * 5)
    order = in_order_of_path(joints, location, ["a", "b", "c"])
    assert sorted(order) == list(range(10))
    assert location[order].tolist() == ["a"] * 5 + ["b"] * 5

    def length(way):
        return np.linalg.norm(np.diff(joints[list(way)], axis=0), axis=1).sum()

    first, *rest = order[:5]
    shortest = min(length([first, *way]) for way in permutations(rest))
    assert length(order[:5]) <= 1.05 * shortest
