"""Two LiDARs in one room, fitted together: what is wrong with one of them is shown of that one."""

import numpy as np
import pytest

from calib.diagnosis.verdict.curves import curves
from calib.effects import find
from calib.problem.build import shapes_of, stops_view
from calib.problem.model import Source
from calib.runs.calibrate import calibrate
from calib.runs.reopen import stand_of
from calib.simulation import Spec, simulate

from . import simulated

XT32, QT64 = "hesai_pandarxt32", "hesai_pandarqt64"
SPEC = Spec(lidar=XT32, locations=4, stops_per_location=3, column_step=100, world_seed=5)


def quiet(what, done, total):
    """No progress is shown."""


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    """The curves of a run of both, one of them with an error that depends on azimuth."""
    home = tmp_path_factory.mktemp("two")
    simulate(SPEC, home / "a", 1)
    hidden = {"azimuth_range_harmonic": 3}
    simulate(simulated.changed(SPEC, lidar=QT64), home / "b", 2, hidden)
    run = calibrate([home / "a", home / "b"], home / "run", hold_out="none")
    return curves(stand_of(run, quiet).look(quiet).unnamed)


@pytest.mark.long
def test_each_lidar_has_its_own_curve_of_every_covariate(found):
    seen = [(curve.covariates, curve.rig) for curve in found]
    assert len(set(seen)) == len(seen)
    of = {rig: {covariates for covariates, r in seen if r == rig} for _, rig in seen}
    assert set(of) == {f"husky-lwa4p-{XT32}", f"husky-lwa4p-{QT64}"}
    assert len(set(map(frozenset, of.values()))) == 1
    for curve in found:
        shape = tuple(map(len, curve.centres.values()))
        assert curve.mean_m.shape == curve.band_m.shape == shape
        assert curve.document()["rig"] == curve.rig


@pytest.mark.long
def test_the_error_is_in_the_curve_of_the_lidar_that_has_it(found):
    """4.9 mm rms of its ranges, of which the model takes on a quarter."""
    rms_mm = {
        curve.rig.rpartition("-")[2]: 1e3 * np.sqrt(np.nanmean(np.square(curve.mean_m)))
        for curve in found
        if curve.covariates == ("azimuth_rad",)
    }
    assert rms_mm[QT64] > 2.0 > 1.0 > rms_mm[XT32], rms_mm


def test_several_recordings_do_not_multiply_the_times_that_are_looked_at(tmp_path):
    """Of both, as many are tried as of one; of one alone, all of its own."""
    simulate(SPEC, tmp_path / "a", 1)
    simulate(simulated.changed(SPEC, lidar=QT64), tmp_path / "b", 2)
    sources = [Source.open(tmp_path / name) for name in "ab"]
    slip = find("mount_slip")
    first, second = ([*slip.shapes(stops_view(source))] for source in sources)
    assert shapes_of(slip, sources[:1]) == first
    both = shapes_of(slip, sources)
    assert len(both) == max(len(first), len(second)) and {*both} <= {*first, *second}
    assert both[0] == min(first + second) and both[-1] == max(first + second)
    assert not set(first) & set(second), "else nothing is chosen from"
