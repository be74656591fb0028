"""Spreads by all that rows tell of values: a dense likelihood, closed forms, and chance."""

import numpy as np
import pytest
from scipy import optimize, stats
from scipy.linalg import block_diag

from calib.diagnosis.chance.at_zero import AtZero
from calib.solve.components.told import Told

SD, PLACE_SD = 0.7, 0.4


class Mixed:
    """Rows ``y = X b + Z u + e``, unit noise, with values u of members in two crossed groups."""

    def __init__(self, seed, sd=(SD, PLACE_SD), members=(20, 8), rows=300):
        rng = np.random.default_rng(seed)
        design = np.random.default_rng(99)
        self.X = np.column_stack([np.ones(rows), design.standard_normal((rows, 2))])
        index = [design.integers(0, count, rows) for count in members]
        self.Z = np.hstack([np.eye(c)[i] for c, i in zip(members, index, strict=True)])
        self.group = np.repeat([0, 1], members)
        u = np.repeat(sd, members) * rng.standard_normal(sum(members))
        self.y = self.X @ [1.0, -0.5, 2.0] + self.Z @ u + rng.standard_normal(rows)

    def told(self):
        """Score and information of the values, the others projected off."""
        left = np.eye(len(self.y)) - self.X @ np.linalg.pinv(self.X)
        return Told(self.Z.T @ left @ self.y, self.Z.T @ left @ self.Z, self.group)

    def minus_log_likelihood(self, log_variance):
        """Restricted, from the dense covariance of all rows (Patterson and Thompson 1971)."""
        variance = np.exp(log_variance)[self.group]
        V = np.eye(len(self.y)) + (self.Z * variance) @ self.Z.T
        inverse = np.linalg.inv(V)
        inner = self.X.T @ inverse @ self.X
        P = inverse - inverse @ self.X @ np.linalg.solve(inner, self.X.T @ inverse)
        logs = np.linalg.slogdet(V)[1] + np.linalg.slogdet(inner)[1]
        return (logs + self.y @ P @ self.y) / 2


@pytest.mark.long
def test_the_spread_has_the_greatest_restricted_likelihood():
    for seed in range(3):
        world = Mixed(seed)
        dense = optimize.minimize(world.minus_log_likelihood, [0.0, 0.0], method="Nelder-Mead")
        expected = np.exp(dense.x / 2)
        for start in ([0.05, 5.0], [1.0, 1.0]):
            found = world.told().spread(np.array(start))
            np.testing.assert_allclose(found, expected, rtol=2e-3)


def test_its_sigma_is_the_curvature_of_that_likelihood():
    world = Mixed(4, rows=900, members=(60, 40))
    sd = world.told().spread(np.ones(2))
    x, step = 2 * np.log(sd), 1e-3
    second = [
        world.minus_log_likelihood(x + step * e)
        + world.minus_log_likelihood(x - step * e)
        - 2 * world.minus_log_likelihood(x)
        for e in np.eye(2)
    ]
    observed = sd / 2 / np.sqrt(np.array(second) / step**2)  # of the sd, groups nearly independent
    np.testing.assert_allclose(world.told().sigma(sd), observed, rtol=0.15)


def test_a_balanced_design_has_the_closed_form():
    members, each = 12, 5
    rng = np.random.default_rng(3)
    member = np.repeat(np.arange(members), each)
    y = 0.8 * rng.standard_normal(members)[member] + rng.standard_normal(members * each)
    Z = np.eye(members)[member]
    left = np.eye(len(y)) - 1.0 / len(y)
    told = Told(Z.T @ left @ y, Z.T @ left @ Z, np.zeros(members, int))
    means = y.reshape(members, each).mean(axis=1)
    expected = np.sqrt(means.var(ddof=1) - 1.0 / each)  # the noise is known
    assert told.spread(np.array([0.1]))[0] == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("known", [1.0, 1e2, 1e3])
@pytest.mark.parametrize("times", [3, 30, 300])
def test_a_spread_is_found_however_far_from_the_start(known, times):
    """Each seen as well, `known` times better than the start is wide, but for the mean of each
    group, where rounding leaves less than nothing: a closed form."""
    start, rng = 3e-4, np.random.default_rng(times)
    sigma = start / known
    seen = times * start * rng.standard_normal((3, 8)) + sigma * rng.standard_normal((3, 8))
    about = np.kron(np.eye(3), np.eye(8) - 1 / 8)
    information = (about - 1e-15 * np.kron(np.eye(3), np.ones((8, 8)))) / sigma**2
    told = Told(about @ seen.ravel() / sigma**2, information, np.repeat(range(3), 8))
    expected = np.sqrt(seen.var(axis=1, ddof=1) - sigma**2)
    np.testing.assert_allclose(told.spread(np.full(3, start)), expected, rtol=1e-3)


def test_what_members_have_in_common_is_no_spread():
    """A weak prior on a range zero pulls at the mean of few members, and would widen them."""
    rng = np.random.default_rng(8)
    own, mean = 3e-3 * rng.standard_normal(4), 25e-3
    sigma, of_zero = 3e-5, 4.4e-3
    V = sigma**2 * np.eye(4) + of_zero**2  # the range zero, known beforehand, and taken out
    information = np.linalg.inv(V)
    told = Told(information @ (own + mean), information, np.zeros(4, int))
    expected = np.sqrt(own.var(ddof=1) - sigma**2)
    about = told.about_means([slice(0, 4)])
    assert about.spread(np.full(1, 3e-4))[0] == pytest.approx(expected, rel=1e-4)
    again = Told(information @ (own - mean), information, told.group).about_means([slice(0, 4)])
    np.testing.assert_allclose(again.score, about.score, atol=1e-6 * np.abs(about.score).max())
    assert told.spread(np.full(1, 3e-4))[0] > 2 * expected
    np.testing.assert_array_equal(told.about_means([slice(0, 1)]).information, information)
    both = block_diag(information, information)  # two LiDARs, whose zeros are far apart
    rows = np.concatenate([information @ (own + mean), information @ (own - mean)])
    apart = Told(rows, both, np.zeros(8, int)).about_means([slice(0, 4), slice(4, 8)])
    assert apart.spread(np.full(1, 3e-4))[0] == pytest.approx(expected, rel=1e-4)


def test_values_as_fitted_say_the_same_whatever_held_them():
    told = Mixed(5).told()
    for sd in (0.2, 3.0):
        variance = np.full(28, sd**2)
        covariance = np.linalg.inv(told.information + np.diag(1 / variance))
        again = Told.fitted(covariance @ told.score, covariance, variance, told.group)
        np.testing.assert_allclose(again.score, told.score, rtol=1e-7)
        np.testing.assert_allclose(again.information, told.information, atol=1e-8)


def test_rounding_beside_a_very_wide_spread_is_no_fault():
    """What is not seen at all stays at zero, however wide; what is seen, at what the rows say."""
    rng = np.random.default_rng(2)
    axes, _ = np.linalg.qr(rng.standard_normal((40, 40)))
    size = np.r_[np.geomspace(1e6, 1e2, 20), np.full(20, -1e-7)]  # as rounding may leave it
    information = (axes * size) @ axes.T
    with pytest.raises(np.linalg.LinAlgError):
        np.linalg.cholesky(np.eye(40) + 1e8 * information)
    truth = axes[:, :20] @ rng.standard_normal(20)
    told = Told(information @ truth, information, np.zeros(40, int))
    values, covariance, _ = told.given(np.full(1, 1e8))
    np.testing.assert_allclose(axes[:, :20].T @ values, axes[:, :20].T @ truth, atol=0.05)
    assert np.abs(axes[:, 20:].T @ values).max() < 1.0
    assert np.linalg.eigvalsh(covariance)[0] > -1e-3


def test_the_estimate_and_its_sigma_hold_over_many_worlds():
    found = [Mixed(seed).told() for seed in range(150)]
    sd = np.array([told.spread(np.ones(2)) for told in found])
    sigma = np.array([t.sigma(s) for t, s in zip(found, sd, strict=True)])
    np.testing.assert_allclose(np.sqrt((sd**2).mean(axis=0)), [SD, PLACE_SD], rtol=0.08)
    z = (sd[:, 0] - SD) / sigma[:, 0]
    assert 0.85 < z.std() < 1.2


def test_where_nothing_scatters_the_spread_is_nothing():
    sd = np.array([Mixed(seed, sd=(0, 0)).told().spread(np.ones(2))[0] for seed in range(60)])
    assert np.mean(sd < 0.01) > 0.3 and np.median(sd) < 0.12


# --------------------------------------------------------------------------------- tested at zero


def one_way(seed, sd=0.0, members=30, even=True):
    """A group whose members are seen by as many rows each, or by very different numbers."""
    rng = np.random.default_rng(seed)
    each = np.full(members, 20.0) if even else np.geomspace(1, 400, members)
    M = np.diag(each) - np.outer(each, each) / each.sum()
    u = sd * rng.standard_normal(members)
    noise = rng.standard_normal(members) * np.sqrt(each)
    score = each * u + noise
    return Told(score - each * score.sum() / each.sum(), M, np.zeros(members, int))


@pytest.mark.parametrize("even", [True, False])
@pytest.mark.parametrize("members", [6, 30])
def test_the_test_at_zero_has_its_size(even, members):
    p = [AtZero(one_way(s, members=members, even=even)).p_value()[1] for s in range(400)]
    for level in (0.01, 0.05, 0.2):
        least, most = stats.binom.ppf([0.001, 0.999], 400, level)
        assert least <= np.sum(np.array(p) < level) <= most


def test_a_spread_of_the_smallest_detectable_size_is_found_four_times_out_of_five():
    size = AtZero(one_way(0)).detectable(0.01)
    hits = [AtZero(one_way(seed, sd=size)).p_value()[1] < 0.01 for seed in range(300)]
    assert 0.72 < np.mean(hits) < 0.88


@pytest.mark.parametrize("size", [1.0, 1e8, 1e16, 1e24])
def test_spreads_are_found_where_rounding_spoils_the_information(size):
    """Values that nothing but their sum is told of, to ever more digits than a double has: of such
    a matrix and 1, rounding makes eigenvalues that are negative."""
    rng = np.random.default_rng(0)
    along = rng.normal(size=(30, 2))
    information = size * along @ along.T
    information += 1e-15 * size * (noise := rng.normal(size=(30, 30))) + 1e-15 * size * noise.T
    score = information @ rng.normal(size=30)
    told = Told(score, information, np.repeat([0, 1], 15))
    sd = told.spread(np.array([0.1, 0.1]))
    assert np.isfinite(sd).all() and np.isfinite(told.statistic(sd))
    assert told.statistic(sd) >= told.statistic(np.array([0.1, 0.1]))
