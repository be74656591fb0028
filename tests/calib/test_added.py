"""Where unknowns begin where a fit rejects all that they explain."""

import numpy as np
import pytest

from calib.effects.own.formula import FormulaEffect
from calib.problem import build
from calib.problem.model import Model, Source
from calib.problem.prior import JointPrior
from calib.results.intervals import intervals
from calib.runs.calibrate import calibrate
from calib.runs.diagnose import diagnose
from calib.simulation import Spec
from calib.solve.fit import solve
from sensors.documents import Marks

from . import rescans
from .rescans import change_ranges
from .simulated import made

SMALL = Spec(lidar="hesai_pandarxt32", locations=3, stops_per_location=2, column_step=50)
FIRST_RAD, LAST_RAD = 0.3, 1.0


def sector(sigma: float = 0.3) -> FormulaEffect:
    page = {"name": "sector", "site": "range", "unit": "m", "sigma": sigma}
    page["basis"] = [f"(azimuth_rad > {FIRST_RAD}) * (azimuth_rad < {LAST_RAD})"]
    return FormulaEffect.read(page, "sector.yaml", Marks({}))


def shifted(source: Source, by_m: float) -> Source:
    """The recording with the ranges of a sector made longer."""
    change_ranges(source.recording.folder, rescans.sector(FIRST_RAD, LAST_RAD, by_m))
    return Source.open(source.recording.folder)


@pytest.mark.parametrize("by_m", [0.025, -0.1])
def test_an_effect_takes_up_beams_that_had_no_weight(tmp_path, by_m):
    source = shifted(made(tmp_path / "rec", SMALL)[0], by_m)
    without = solve(build([source], Model()))
    found = solve(build([source], Model().plus((sector(),))), start=without.start)
    assert found.values["sector"][0] == pytest.approx(by_m, abs=1e-3)
    anew = solve(build([source], Model().plus((sector(),))))
    assert found.values["sector"][0] == pytest.approx(anew.values["sector"][0], abs=1e-4)


def test_an_effect_that_explains_nothing_begins_at_zero(tmp_path):
    source = made(tmp_path / "rec", SMALL)[0]
    without = solve(build([source], Model()))
    found = solve(build([source], Model().plus((sector(),))), start=without.start)
    assert abs(found.values["sector"][0]) < 1e-3


def with_ring_off(source: Source, ring: int, off: rescans.Change) -> Source:
    """The recording with the ranges of a ring longer by `off`."""
    elevation = np.asarray(source.rig.lidar.elevation_rad)
    half = np.min(np.abs(np.diff(np.sort(elevation)))) / 2

    def change(stop, range_m, azimuth, elevations):
        mine = np.abs(elevations - elevation[ring]) < half
        return range_m + np.where(mine, off(stop, range_m, azimuth, elevations), 0.0)

    change_ranges(source.recording.folder, change)
    return Source.open(source.recording.folder)


def clutter(seed: int) -> rescans.Change:
    """Beams end anywhere on the last tenth of their way."""
    rng = np.random.default_rng(seed)
    return lambda stop, range_m, *_: -0.1 * range_m * rng.random(len(range_m))


def test_a_ring_all_of_whose_beams_are_far_off_is_found(tmp_path):
    """By 0.3 m: one or two stray beams hold it where it is, with a sigma of some mm."""
    source, truth = made(tmp_path / "rec", SMALL)
    source = with_ring_off(source, 12, lambda stop, range_m, *_: np.full(len(range_m), -0.3))
    found = solve(build([source], Model()))
    assert found.converged
    offset = found.values["ring_range_offset"]
    true = np.array(truth["effects"]["ring_range_offset"]) - 0.3 * (np.arange(len(offset)) == 12)
    assert np.abs(offset - offset.mean() - true + true.mean()).max() < 3e-3


def test_a_ring_whose_beams_fit_nothing_stays_and_it_is_said_why(tmp_path):
    """No two of its beams are off by the same, and none by less than ten of its sigmas."""
    source = made(tmp_path / "rec", SMALL)[0]

    def apart(stop, range_m, azimuth, elevation):
        return -0.5 - (azimuth / np.pi + 1.0) / 2 - 0.05 * stop / 6

    source = with_ring_off(source, 12, apart)
    found = solve(build([source], Model()))
    lost = found.not_trusted["ring_range_offset"]
    assert np.flatnonzero(lost).tolist() == [12]
    offset = found.values["ring_range_offset"]
    others = np.delete(offset, 12)  # it is as far from their mean as is known before any data
    assert offset[12] == pytest.approx(others.sum() / (len(others) + 1.0), abs=1e-7)


def test_a_ring_that_meets_clutter_is_not_known_by_the_beams_that_agree_by_chance(tmp_path):
    source, truth = made(tmp_path / "rec", SMALL)
    source = with_ring_off(source, 12, clutter(5))
    found = solve(build([source], Model()))
    offset, known = found.values["ring_range_offset"], intervals(found).of(["ring_range_offset"])
    sigma, true = np.sqrt(np.diag(known.covariance)), truth["effects"]["ring_range_offset"]
    assert np.abs(offset[12] - true[12]) > 4e-3  # it is off, by more than others' sigmas
    assert sigma[12] > 0.03
    assert np.median(sigma) < 1.5e-3


@pytest.mark.long
def test_a_diagnosis_says_which_ring_nobody_knows(tmp_path):
    source, _ = made(tmp_path / "rec", SMALL)
    source = with_ring_off(source, 12, clutter(5))
    run = calibrate(source.recording.folder, tmp_path / "run", hold_out="none")
    said = [s for s in diagnose(run).sentences if "what do these beams see" in s]
    assert len(said) == 1 and "ring_range_offset.ring_012 were rejected, so it is" in said[0]


def test_what_an_earlier_run_knew_of_a_ring_that_meets_clutter_stays(tmp_path):
    source, truth = made(tmp_path / "rec", SMALL)
    source = with_ring_off(source, 12, clutter(5))
    problem = build([source], Model())
    rings = problem.variables["ring_range_offset"]
    true = np.array(truth["effects"]["ring_range_offset"])
    prior = JointPrior([rings], {rings.name: true}, np.eye(rings.dim) * 0.002**2)
    found = solve(problem, prior=prior)
    known = intervals(found).of([rings.name])
    assert abs(found.values[rings.name][12] - true[12]) < 0.01
    assert np.sqrt(known.covariance[12, 12]) == pytest.approx(0.002, rel=0.2)
