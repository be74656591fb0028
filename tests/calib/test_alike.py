"""Columns of the stops that change together are told of a name that follows one of them."""

from types import SimpleNamespace

import numpy as np
import pytest

from calib.diagnosis.verdict.alike import columns_alike
from calib.effects import find

WARM = np.linspace(20.0, 24.0, 12)


@pytest.fixture
def recorded():
    """Columns of twelve stops, some of which go with the temperature."""
    rng = np.random.default_rng(0)
    return {
        "temperature_c": WARM,
        "fan_rpm": 100 * WARM + 400,
        "board_c": WARM + 0.01 * rng.normal(size=12),
        "humidity": rng.normal(size=12),
        "room": np.full(12, 3.0),
        "unread": np.full(12, np.nan),
    }


def source(recorded, elapsed_s=None):
    elapsed_s = np.random.default_rng(1).normal(size=12) if elapsed_s is None else elapsed_s
    times = {"elapsed_s": elapsed_s, "time_s": 1e9 + elapsed_s}
    return SimpleNamespace(
        recording=SimpleNamespace(covariates=recorded), columns={**recorded, **times}
    )


def alike(*sources, effect="temperature_drift", sigmas=20.0, dof=1):
    step = SimpleNamespace(
        effect=find(effect),
        judged=SimpleNamespace(statistic=2.0 * sigmas**2, inflation=2.0, dof=dof),
        before=SimpleNamespace(stand=SimpleNamespace(sources=sources)),
    )
    return list(columns_alike(step))


def test_columns_that_go_with_that_of_an_effect_are_named(recorded):
    twins = [("temperature_c", "board_c"), ("temperature_c", "fan_rpm")]
    assert alike(source(recorded)) == twins
    # What is seen well enough is told from a column that differs a little.
    assert alike(source(recorded), sigmas=2000.0) == twins[1:]
    # Of more parameters as much may be chance.
    limit = np.sqrt(3.9 / (1.0 - np.corrcoef(WARM, recorded["board_c"])[0, 1] ** 2))
    assert alike(source(recorded), sigmas=limit) == twins[1:]
    assert alike(source(recorded), sigmas=limit, dof=4) == twins
    recorded["fan_rpm"][3] = np.nan
    assert alike(source(recorded)) == twins[:1]


def test_one_recording_in_which_they_differ_tells_them_apart(recorded):
    other = {**recorded, "fan_rpm": 100 * WARM[::-1], "board_c": WARM[::-1]}
    assert alike(source(recorded), source(other)) == []
    assert len(alike(source(recorded), source(recorded))) == 2


def test_the_time_is_a_column_like_others_but_for_what_asks_for_the_order(recorded):
    warming = source({"temperature_c": WARM}, elapsed_s=900.0 * (WARM - 20.0))
    assert alike(warming) == [("temperature_c", "elapsed_s")]
    assert alike(warming, effect="tracker_creep") == [("elapsed_s", "temperature_c")]
    assert alike(warming, effect="arm_backlash") == []
    assert alike(warming, effect="warmup_drift") == []  # which bends
    assert alike(warming, effect="incidence_angle_bias") == []
