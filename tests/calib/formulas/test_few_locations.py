"""A gross structure is seen whole from few locations, each of which errs by itself."""

import numpy as np
import pytest

from calib.diagnosis.formulas.pursuit import pursue

from .made import table

ALPHA = 0.01
LOCATIONS, AT_EACH = 6, 3


def warm_locations(rng, c):
    """Each location has its temperature, which its stops share but for 0.3 K."""
    stops = LOCATIONS * AT_EACH
    each = np.repeat(rng.uniform(15.0, 35.0, LOCATIONS), AT_EACH) + 0.3 * rng.standard_normal(stops)
    return {"temperature_c": np.repeat(each, len(c["ring"]) // stops)}


@pytest.mark.parametrize("seed", [2, *(pytest.param(n, marks=pytest.mark.long) for n in (4, 5))])
@pytest.mark.parametrize("size_m", [12e-3, 0.0])
def test_six_locations_tell_a_gross_structure_from_one_of_its_covariates(seed, size_m):
    """What it does at each differs as much as the temperatures do, so a test of how much worse a
    simpler form is at all of them tells nothing; structure over the elevation stands out beside
    any function of the temperature."""
    beams = table(
        seed,
        stops=LOCATIONS * AT_EACH,
        each=300,
        scatter_m=0.001,
        hidden=lambda c: size_m * (c["temperature_c"] - 25) / 10 * c["elevation_rad"] / 0.27,
        more=warm_locations,
    ).clustered(np.repeat(np.arange(LOCATIONS), AT_EACH))
    steps = pursue(beams, ALPHA, lambda *what: None)
    assert len(steps) == bool(size_m)
    for step in steps:
        over = set(step.form.term.covariates)
        assert over in ({"temperature_c", "ring"}, {"temperature_c", "elevation_rad"})
