"""Formulas where all beams of a location may err together."""

import numpy as np
import pytest

from calib.blunders.chance import LEVELS
from calib.diagnosis.formulas.pursuit import pursue

from .made import table

LOCATION = np.repeat(np.arange(6), 5)  # of 30 stops


def quiet(what, done, total):
    pass


def by_location(rng, c):
    """When stops stood, one after the other, and what each location is off by."""
    stop = np.repeat(np.arange(30), len(c["ring"]) // 30)
    return {"time_s": 90.0 * stop, "own_m": rng.normal(0.0, 2e-3, 6)[LOCATION[stop]]}


def beams(seed, more=lambda c: 0.0):
    """Beams of which each location has a range zero of its own, and more that is hidden."""
    found = table(seed, each=100, hidden=lambda c: c["own_m"] + more(c), more=by_location)
    assert np.ptp(found.covariates.pop("own_m")) > 2e-3
    return found


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.long
def test_what_locations_have_of_their_own_is_no_form_of_the_time(seed):
    """Single stops would confirm one, as those of a location agree."""
    found, alpha = beams(seed), LEVELS["structure"]
    assert pursue(found, alpha, quiet, most=1), "by stops"
    assert not pursue(found.clustered(LOCATION), alpha, quiet, most=1)


@pytest.mark.long
def test_a_form_is_found_where_locations_err_together():
    found = beams(5, lambda c: 6e-3 * np.sin(2 * c["azimuth_rad"]))
    (step,) = pursue(found.clustered(LOCATION), LEVELS["structure"], quiet)
    assert step.form.term.texts[0] == "sin(2 * azimuth_rad)"
