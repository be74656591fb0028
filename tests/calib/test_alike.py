"""Columns of the stops that change together are told of a name that follows one of them."""

from types import SimpleNamespace

import numpy as np

from calib.diagnosis.verdict.alike import columns_alike
from calib.effects import find


def test_columns_that_go_together_are_told_of_a_name_that_follows_one():
    warm = np.linspace(20.0, 24.0, 12)
    rng = np.random.default_rng(0)
    recorded = {
        "temperature_c": warm,
        "fan_rpm": 100 * warm + 400,
        "board_c": warm + 0.01 * rng.normal(size=12),
        "humidity": rng.normal(size=12),
        "room": np.full(12, 3.0),
    }
    source = SimpleNamespace(
        recording=SimpleNamespace(covariates=recorded),
        columns={**recorded, "elapsed_s": rng.normal(size=12)},
    )

    def alike(effect="temperature_drift", sigmas=20.0):
        step = SimpleNamespace(
            effect=find(effect),
            judged=SimpleNamespace(statistic=2.0 * sigmas**2, inflation=2.0),
            before=SimpleNamespace(stand=SimpleNamespace(sources=[source])),
        )
        return list(columns_alike(step))

    assert alike() == [("temperature_c", "board_c"), ("temperature_c", "fan_rpm")]
    # What is seen well enough is told from a column that differs a little.
    assert alike(sigmas=2000.0) == [("temperature_c", "fan_rpm")]
    assert alike("incidence_angle_bias") == []
    recorded["fan_rpm"][3] = np.nan
    assert alike() == [("temperature_c", "board_c")]
