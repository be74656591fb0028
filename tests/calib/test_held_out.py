"""What is expected of the error of stops held out."""

import numpy as np

from calib.effects import DEFAULT, find
from calib.problem.model import Model
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
