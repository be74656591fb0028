"""What the search names first: an effect in its true shape, and one that predicts before chance."""

import pytest

from calib.diagnosis.search import search
from calib.runs.calibrate import calibrate
from calib.runs.diagnose import stand_of

from .simulated import made


def quiet(what, done, total):
    pass


def found(folder, **hidden):
    """What is found in a small recording with these hidden, by the default model."""
    _, truth = made(folder / "rec", "tiny", 1, **hidden)
    run = calibrate([folder / "rec"], folder / "run", hold_out="none")
    return search(stand_of(run, quiet), quiet), truth


def test_an_effect_that_no_shape_of_the_grid_fits_is_named_in_its_own(tmp_path):
    """A wave of 8 mm halfway between two lengths of the grid: beams near and far, a quarter of a
    period off, contradict either."""
    done, truth = found(tmp_path, **{"range_cyclic@0.815": 3.0})
    (step,) = done.found
    assert step.effect.family == "range_cyclic"
    assert step.effect.shape == pytest.approx(0.815, abs=3e-4)
    grid = next(c for c in step.before.named.candidates if c.effect.family == "range_cyclic")
    assert step.candidate.test.statistic == pytest.approx(step.judged.statistic, rel=1e-6)
    assert step.candidate.test.statistic > 1.1 * grid.test.statistic
    size = step.after.stand.theta(step.effect)
    assert size == pytest.approx(truth["effects"]["range_cyclic@0.815"], abs=5e-4)
    assert not done.chance


def test_a_drift_that_another_effect_covers_is_no_scatter_of_stops(tmp_path):
    """At first a zero of its own at every stop explains more than any effect alone."""
    done, _ = found(tmp_path, **{"warmup_drift@700": 3.0, "optitrack_distortion": 3.0})
    assert done.looks[0].chance[0].effect.name == "stop_range_scatter"
    assert [step.effect.family for step in done.found] == ["warmup_drift", "optitrack_distortion"]
    assert done.found[0].effect.shape == pytest.approx(700, rel=0.1)
    assert not done.chance
