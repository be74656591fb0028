"""Robust weights, against the functions they are defined by."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm

from calib.residuals.robust import TUKEY, robust_scale, tukey_cost, tukey_weight


@pytest.mark.parametrize("scale", [1.0, 2.5])
def test_tukey_weight_is_the_slope_of_the_cost(scale):
    z = np.linspace(-15, 15, 301)
    h = 1e-5
    slope = [(tukey_cost(x + h, scale) - tukey_cost(x - h, scale)) / (2 * h) for x in z[:, None]]
    np.testing.assert_allclose(z * tukey_weight(z, scale), slope, atol=1e-8)


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
