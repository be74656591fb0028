"""What is expected of the error of stops held out."""

import numpy as np
import pytest
from scipy.special import ndtri

from calib.effects import DEFAULT, find
from calib.problem.model import Model
from calib.problem.unknowns import vector_unknown
from calib.results.errors import Errors, over_expected
from calib.results.holdout import held_out
from calib.simulation import Spec

from .simulated import made

WARMING = "warmup_drift@60"  # cold at the first location alone


def test_what_no_other_stop_tells_of_an_effect_is_expected_of_those_held_out(tmp_path):
    """A sensor that is warm wherever else it stood. Without the drift's part in what is expected,
    the error of the first stop held out was twice as large; and where rings had zeros that were
    known to be 4 mm on average, while each was known to 50, the drift was off by 17 mm."""
    spec = Spec(locations=4, stops_per_location=4, column_step=64)
    source, truth = made(tmp_path / "rec", spec, **{WARMING: 1.0})
    (drift,) = truth["effects"][WARMING]
    assert np.mean(truth["effects"]["ring_range_offset"]) > 0.02
    model = Model((*map(find, DEFAULT), find(WARMING)))
    errors = held_out([source], model, "location", 5, lambda what, done, total: None)
    first, *others = np.sqrt(errors.each_m2)
    assert first == np.clip(first, 0.9 * abs(drift), 1.2 * np.hypot(drift, np.median(others)))
    assert 0.8 < errors.misfit < 1.1
    # Nearly all of that is the drift, one number: once in a hundred times it is 2.6 of its sigmas.
    most = np.sqrt(errors.expected_m2 + (ndtri(0.995) ** 2 - 1) * errors.foretold_m2)
    assert 0.85 < errors.by_chance_mm / (1e3 * most / np.sqrt(errors.count)) < 1.0


def test_an_error_that_other_stops_cannot_tell_is_no_larger_than_expected():
    rms_mm = {"held_out": 4.4, "fit": 1.7, "noise_floor": 2.6}
    summary = {"residual": "range", "rms_mm": rms_mm}
    assert over_expected(summary) == pytest.approx(4.4 / 2.6)
    assert over_expected({**summary, "held_out_by_chance_mm": 5.0}) == 1.0
    assert over_expected({**summary, "held_out_by_chance_mm": 4.3}) == pytest.approx(4.4 / 2.6)
    assert over_expected({**summary, "rms_mm": {**rms_mm, "held_out": None}}) == 0.0


def test_of_few_unknowns_errors_are_seldom_larger_than_chance_makes_them():
    """Beams of three stops that three unknowns move alike, and their own noise."""
    rng, above = np.random.default_rng(2), []
    A, root = rng.normal(size=(3, 200, 3)), np.linalg.cholesky(np.diag([9.0, 1.0, 0.1]))
    for _ in range(3000):
        off, errors = A @ root @ rng.normal(size=3) + rng.normal(size=(3, 200)), Errors()
        for each, moves in zip(off, A, strict=True):
            spread = moves.T @ moves @ root @ root.T
            sum_m2, swing_m2 = np.trace(spread), np.sqrt(2 * np.trace(spread @ spread))
            errors += Errors(
                count=200,
                squares_m2=each @ each,
                expected_m2=200 + sum_m2,
                foretold_m2=sum_m2,
                swing_m2=swing_m2,
            )
        above.append(errors.rms_mm > errors.by_chance_mm)
    assert 0.002 < np.mean(above) < 0.02


def test_what_is_known_of_members_before_any_data_is_whitened_by_its_root():
    sigma, names = np.array([0.05, 0.02, 0.01]), ("a", "b", "c")
    rings = vector_unknown("x", sigma, names, ["m"] * 3, of_members=True, weight=0.25)
    assert rings.prior_sigma == pytest.approx(2.0 * np.sqrt(2.0) * sigma)
    root, expected = rings.prior_root, 4.0 * (np.diag(sigma**2) + np.outer(sigma, sigma))
    np.testing.assert_allclose(root @ expected @ root.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(rings.prior_covariance, expected)
