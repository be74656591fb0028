"""The band of a binned mean, against dense matrices of who errs with whom, and by its coverage."""

import numpy as np
import pytest
from scipy import stats

from calib.linear.binned import BinnedMean, BinnedSums, TwoWay
from calib.linear.clusters import summed

BINS, STOPS, PLACES = 5, 12, 9


@pytest.fixture(scope="module")
def rows():
    """Bin, residual, weight, stop and place of rows. The last bin is seen from one stop, the last
    but one at one place."""
    rng = np.random.default_rng(0)
    count = 900
    at, stop = rng.integers(0, BINS, count), rng.integers(0, STOPS, count)
    place = rng.integers(0, PLACES, count)
    stop[at == BINS - 1], place[at == BINS - 2] = 3, 7
    of_stop, of_place = rng.normal(size=STOPS), rng.normal(size=PLACES)
    residual = of_stop[stop] + of_place[place] + rng.normal(size=count)
    return at, residual, rng.uniform(0.2, 1.0, count), stop, place


def summed_up(at, residual, weight, stop, place):
    sums = BinnedSums(BINS)
    for k in np.unique(stop):
        mine = stop == k
        sums.add(at[mine], residual[mine], weight[mine], place[mine])
    return sums.mean()


def test_sigmas_are_those_of_the_dense_sandwich(rows):
    """``u' M u / W^2`` with M who errs with whom, a matrix of ones and zeros over all rows."""
    at, residual, weight, stop, place = rows
    found, clusters = summed_up(*rows)
    for b in range(BINS):
        r, w, k, m = (x[at == b] for x in (residual, weight, stop, place))
        mean = np.average(r, weights=w)
        u = w * (r - mean)
        ways, counts = [], []
        for label in (k, m, k * PLACES + m):
            same, count = np.equal.outer(label, label), len(set(label.tolist()))
            ways.append(u @ same @ u * (count / (count - 1) if count > 1 else 0.0))
            counts.append(count)
        variance = max(ways[0] + ways[1] - ways[2], *ways)
        fewest = min((c for c in counts[:2] if c > 1), default=counts[2])
        assert found.mean[b] == pytest.approx(mean)
        assert found.sigma[b] == pytest.approx(np.sqrt(variance) / w.sum())
        assert clusters[b] == fewest
        half = stats.t(fewest - 1).ppf(0.975) * found.sigma[b]
        assert found.each(clusters)[b] == pytest.approx(half)


def test_the_order_of_stops_and_the_numbers_of_places_change_nothing(rows):
    at, residual, weight, stop, place = rows
    other, clusters = summed_up(at, residual, weight, STOPS - stop, 3 * place)
    found = summed_up(*rows)
    np.testing.assert_allclose(other.sigma, found[0].sigma, rtol=1e-9)
    np.testing.assert_array_equal(clusters, found[1])


def shares(rng, bins, stops, places, scale):
    """What each stop, each place and each cell of both adds to every bin; the truth is 0. A cell of
    one row in each bin has an error of its stop, of its place, and of its own."""
    stop, place = np.divmod(np.arange(stops * places), places)
    errors = scale * (rng.normal(size=(stops, bins))[stop] + rng.normal(size=(places, bins))[place])
    cells = errors + rng.normal(size=(stops * places, bins))
    return summed(cells, stop), summed(cells, place), cells


@pytest.mark.parametrize("scale", [0.0, 1.0])
def test_a_band_holds_all_bins_at_once(scale):
    """In 0.99 of 300 worlds; one four fifths as wide in 0.89, bands of each bin in 0.77."""
    bins, stops, places, trials = 12, 40, 30, 300
    held, narrow, alone = 0, 0, 0
    for seed in range(trials):
        rng = np.random.default_rng(seed)
        ways = shares(rng, bins, stops, places, scale)
        squares, weight = TwoWay.of(*ways), np.full(bins, float(stops * places))
        found = BinnedMean.of(ways[2].sum(axis=0), weight, squares, np.zeros(bins))
        chance = np.vstack(ways[:2])
        draws = rng.standard_normal((999, len(chance))) @ chance
        band = found.together(draws, squares)
        held += (np.abs(found.mean) <= band).all()
        narrow += (np.abs(found.mean) <= 0.8 * band).all()
        alone += (np.abs(found.mean) <= found.each(np.full(bins, places))).all()
    assert held / trials > 0.95 > narrow / trials
    assert alone / trials < 0.85


def test_an_empty_bin_says_nothing_and_narrows_no_other():
    ways = shares(np.random.default_rng(1), 3, 10, 8, 0.5)
    weight = np.array([80.0, np.nan, 80.0])
    squares = TwoWay.of(*ways)
    found = BinnedMean.of(ways[2].sum(axis=0), weight, squares, np.zeros(3))
    draws = np.random.default_rng(2).standard_normal((999, 18)) @ np.vstack(ways[:2])
    band = found.together(draws, squares)
    assert np.isnan([found.mean[1], band[1]]).all()
    at = [0, 2]
    others = BinnedMean.of(
        ways[2].sum(axis=0)[at], weight[at], TwoWay(*(x[at] for x in squares)), np.zeros(2)
    )
    np.testing.assert_allclose(
        band[at], others.together(draws[:, at], TwoWay(*(x[at] for x in squares)))
    )


def test_no_variance_is_less_than_what_is_asked_for():
    zero = TwoWay(*np.zeros((3, 2)))
    found = BinnedMean.of(np.ones(2), np.full(2, 10.0), zero, np.array([4.0, 9.0]))
    np.testing.assert_allclose(found.sigma, [0.2, 0.3])
