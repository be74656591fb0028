"""Tests of effects find one in about as many empty worlds as they say, and no p-value is told that
nobody knows."""

import sys
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from calib.blunders.chance import LEAST_P, after_looks, at_least
from calib.diagnosis.jackknife import UNKNOWN_VARIANCE, Clusters, by_signs
from calib.diagnosis.judges import Shares

BENCH = Path(__file__).parents[1] / "bench"
DRAWS = 800
LOWEST, HIGHEST = 0.012, 0.097  # 0.03 to 0.07, and three sigmas of as many draws beside


@pytest.fixture(scope="module")
def bench():
    """The benchmark, which is a script."""
    sys.path.insert(0, str(BENCH))
    try:
        yield import_module("bench_size")
    finally:
        sys.path.remove(str(BENCH))


@pytest.mark.parametrize(
    "family, parameters, stops",
    [
        ("rows", 1, 12),
        ("rows", 16, 6),
        ("stops err", 1, 6),
        ("stops err", 4, 12),
        ("stops err", 16, 30),
        ("by stop, stops err", 1, 20),
        ("three stops, stops err", 1, 30),
        ("three surfaces", 1, 30),
        ("one stop, stops err", 1, 12),
        ("one surface, surfaces err a little", 4, 30),
        ("within stops, stops err", 4, 12),
        ("two surfaces own half, one errs", 4, 30),
        ("both err", 1, 12),
        ("model by stop, stops err", 1, 12),
        ("model by stop, stops err", 4, 30),
    ],
)
@pytest.mark.long
def test_a_judged_test_has_its_size(bench, family, parameters, stops):
    p = bench.drawn(bench.FAMILIES[family], stops, parameters, DRAWS)["judged"]
    assert LOWEST < np.mean(p < 0.05) < HIGHEST


@pytest.mark.parametrize("stops, places", [(3, 0), (0, 2)])
def test_what_few_clusters_dominate_is_found_by_the_others(bench, stops, places):
    """Thirty stops all show it; few of them, or two of 25 walls, hold most of the information."""
    p = bench.drawn(bench.Family(stops=stops, places=places), 30, 1, 64, effect=30.0)["judged"]
    assert np.mean(p < 1e-3) > 0.9


def test_directions_that_few_clusters_dominate_leave_the_others_to_be_judged(bench):
    """Two of 25 walls alone show eight of sixteen parameters, as a wall does with rings that meet
    nothing else; all walls show the others."""
    p = bench.drawn(bench.Family(owned=0.5), 30, 16, 64, effect=30.0)["judged"]
    assert np.mean(p < 1e-3) > 0.9


@pytest.mark.parametrize("shown", ["by one", "by all"])
def test_a_cluster_says_nothing_of_a_direction_that_it_alone_holds(shown):
    """Of two parameters one wall alone shows the first, and all show the second alike."""
    rng, walls = np.random.default_rng(1), 20
    holds = np.zeros((walls, 2, 2))
    holds[0, 0, 0], holds[:, 1, 1] = 1.0, 1.0 / walls
    size = np.array([30.0, 0.0] if shown == "by one" else [0.0, 30.0])
    scores = holds @ size + np.sqrt(holds.diagonal(axis1=1, axis2=2)) * rng.normal(size=(walls, 2))
    pairs = np.array([(k % 10, k) for k in range(walls)])
    shares = Shares([*np.sqrt(holds)], [*map(tuple, pairs)])
    statistic = float(np.square(scores.sum(axis=0)).sum())
    p = min(each.p_value(statistic) for each in shares.left_out(pairs, scores, 1.5))
    assert p > 0.05 if shown == "by one" else p < 1e-4


@pytest.mark.parametrize("size", [0.96, 1.0, 1.04])
def test_two_walls_tell_one_parameter_whatever_drawn_beams_add_up_to(size):
    """Shares of two walls in it add up to two of its parameters, exactly: they are just enough."""
    scores = np.random.default_rng(0).standard_normal(24) / 5 + 0.9
    pairs = np.array([(k % 12, k // 12) for k in range(24)])
    shares = Shares([*np.full((24, 1, 1), np.sqrt(size / 24))], [*map(tuple, pairs)])
    (told,) = shares.left_out(pairs, scores[:, None], 1.0)
    assert 0.5 < told.trace < 3.0


@pytest.mark.parametrize("agree", [True, False])
def test_the_cluster_that_holds_most_says_nothing_without_the_others(agree):
    """One stop shows 30 sigmas of an effect; the others show as much each as it would have there,
    or what chance makes of it."""
    rng, holds = np.random.default_rng(0), np.array([0.8, *np.full(20, 0.01)])
    scores = 30.0 * holds if agree else 30.0 * holds * (np.arange(21) == 0)
    scores = scores + np.sqrt(holds) * rng.standard_normal(21)
    pairs = np.array([(k, -1) for k in range(21)])
    shares = Shares([*np.sqrt(holds)[:, None, None]], [*map(tuple, pairs)])
    told = shares.left_out(pairs, scores[:, None], 1.0)
    p = min(each.p_value(float(scores.sum() ** 2)) for each in told)
    assert p < 1e-4 if agree else p > 0.05


def test_with_degrees_of_freedom_that_are_not_there_it_would_not(bench):
    """The test above has teeth."""
    family, small = bench.FAMILIES["stops err"], []
    for seed in range(8):
        world, rng = bench.World(family, 6, 1, seed), np.random.default_rng(seed)
        for _ in range(DRAWS // 8):
            ways = world.scores(rng)
            statistic = float(np.sum(np.square(ways[0].sum(axis=0))))
            small.append(replace(by_signs(ways, 6), d=36.0).p_value(statistic) < 0.05)
    assert np.mean(small) > HIGHEST


def test_p_values_of_several_parameters_are_uniform(bench):
    p = bench.drawn(bench.FAMILIES["stops err a little"], 30, 4, DRAWS)["signs"]
    assert stats.kstest(p, "uniform").pvalue > 1e-3


def test_one_stop_that_alone_shows_an_effect_proves_nothing():
    lone = [np.array([[50.0], [0.1], [-0.2]]), np.array([[50.0], [-0.1]]), np.array([[49.9]])]
    assert by_signs(lone, 3).p_value(49.9**2) > 0.1
    assert by_signs([lone[0], lone[1], lone[2]], 1).p_value(1e6) == 1.0
    holds = np.array([0.9995, 0.0003, 0.0002])[:, None, None]
    clusters = Clusters(np.sqrt(holds)[:, 0], np.arange(3), 3, 3)
    assert clusters.covariance(lone[0])[0, 0] > 0.99 * UNKNOWN_VARIANCE


def test_no_p_value_is_told_below_the_least_nor_adjusted_below_itself():
    for p in (0.0, 1e-300, 1e-7, 1e-3, 0.5, 1.0):
        told = at_least(p)
        assert LEAST_P <= told <= 1.0
        for looks in (1.0, 3.7, 300.0):
            assert told <= after_looks(p, looks) * (1 + 1e-9)
            assert after_looks(p, looks) <= after_looks(told, looks) * (1 + 1e-9)


@pytest.mark.parametrize("looks", [10.0, 6_000.0, 1e6])
def test_what_is_far_enough_out_is_found_however_many_looks_there_are(looks):
    assert after_looks(1e-30, looks) == LEAST_P
    assert after_looks(1e-9, looks) == pytest.approx(max(1e-9 * looks, LEAST_P), rel=1e-3)


def test_unknowns_that_stops_are_spent_on_count(bench):
    """Where they are not counted, something is found in empty worlds too often."""
    family, small = bench.FAMILIES["model by stop, stops err"], {0: [], 3: []}
    for seed in range(8):
        world, rng = bench.World(family, 12, 4, seed), np.random.default_rng(seed)
        for _ in range(DRAWS // 8):
            ways = world.scores(rng)
            statistic = float(np.sum(np.square(ways[0].sum(axis=0))))
            for spent, found in small.items():
                found.append(by_signs(ways, 12, spent).p_value(statistic) < 0.05)
    assert np.mean(small[3]) < 0.05 < HIGHEST < np.mean(small[0])


def test_as_many_unknowns_as_stops_leave_nothing_to_tell():
    shares = np.random.default_rng(0).normal(size=(6, 2))
    assert by_signs([shares, shares, shares], 6, 5).p_value(1e9) == 1.0
