"""An effect tested at what it was fitted to, against its test at zero."""

from dataclasses import replace

import numpy as np
import pytest

from calib.diagnosis.search.confirmed import ALPHA_EFFECT, judged, judged_as_fitted
from calib.runs.calibrate import calibrate
from calib.runs.diagnose import diagnose
from calib.runs.reopen import stand_of

from ..bench.hidden_cases import case, record
from .simulated import made


def quiet(what, done, total):
    pass


@pytest.fixture(scope="module")
def look(tmp_path_factory):
    """At a fit that lacks a small incidence bias."""
    folder = tmp_path_factory.mktemp("as_fitted")
    made(folder / "rec", "tiny", seed=3, incidence_angle_bias=0.3)
    run = calibrate([folder / "rec"], folder / "run", hold_out="none")
    return stand_of(run, quiet).look(quiet)


@pytest.mark.parametrize("name", ["incidence_angle_bias", "range_scale", "elevation_scale"])
def test_of_a_small_effect_both_say_the_same(look, name):
    """Its rows are as good as linear, whether it is there or not; two parameters at most."""
    candidate = next(c for c in look.named.candidates if c.effect.name == name)
    at_zero, p = judged(look, candidate, quiet)
    after = look.stand.with_effects([candidate.effect], quiet).look(quiet)
    fitted, p_fitted = judged_as_fitted(after, candidate.effect, candidate.looks, quiet)
    assert fitted.dof == at_zero.dof
    # Its own prior holds a fit back a little, and beams weigh otherwise with it.
    assert np.sqrt(fitted.statistic) == pytest.approx(np.sqrt(at_zero.statistic), rel=0.15, abs=0.3)
    assert fitted.chances[0].trace == pytest.approx(at_zero.chances[1].trace, rel=0.5)
    assert (p_fitted < ALPHA_EFFECT) == (p < ALPHA_EFFECT) == (name == "incidence_angle_bias")


@pytest.mark.long
@pytest.mark.parametrize(
    ("number", "name"), [(18, "ring_elevation_slip"), (37, "ring_azimuth_slip")]
)
def test_a_table_of_rings_that_changes_a_lot_is_named(tmp_path, number, name):
    """By it beams are rejected, more at one stop than at another; it was called adequate, the
    held-out error twice as large as expected."""
    wanted = replace(case("single-shot", number), hidden=(name,))
    source, _, _ = record(wanted, tmp_path)
    found = diagnose(calibrate([source.recording.folder], tmp_path / "run"))
    (named,) = found.worth_adding
    assert named.partition("@")[0] == name
