"""A targets.csv that several recordings have was measured once, and counts once.

The oracle is one recording of all stops: cut in two, with the table of targets in both, it holds
the same measurements.
"""

import shutil

import numpy as np
import pytest

from calib.problem.model import Model
from calib.runs.calibrate import calibrate
from calib.simulation import Spec, simulate
from sensors.numbers import read_csv

from ..mishaps import Scene

SPEC = Spec(lidar=None, mesh=False, targets=8, locations=4, stops_per_location=4)
STOPS = 16


def cut(folder):
    """One recording, and its two halves; without a mesh, so that targets alone tell of FARO."""
    simulate(SPEC, folder / "whole", seed=5)
    for half, kept in (("first", range(8)), ("second", range(8, STOPS))):
        shutil.copytree(folder / "whole", folder / half)
        with Scene(folder / half, np.random.default_rng()).sheet("stops.csv") as stops:
            for name, column in stops.columns.items():
                stops.columns[name] = [column[k] for k in kept]


def faro(run):
    frame = run.solution.shared.frames["faro"]
    return frame.T_parent_child, np.concatenate([frame.sigma_m, frame.sigma_rad])


def fitted(recordings, out, **how):
    return calibrate(recordings, out, hold_out="none", **how)


@pytest.fixture
def home(once):
    return once(cut)


def test_recordings_of_one_day_know_no_more_of_the_scanner_than_one_of_all_stops(home, tmp_path):
    whole = faro(fitted(home / "whole", tmp_path / "whole"))
    both = faro(fitted([home / "first", home / "second"], tmp_path / "both"))
    np.testing.assert_allclose(both[0], whole[0], atol=1e-6)
    np.testing.assert_allclose(both[1], whole[1], rtol=1e-3)


def test_a_fit_from_an_earlier_one_learns_nothing_of_targets_that_this_knows(home, tmp_path):
    first = fitted(home / "first", tmp_path / "first")
    second = fitted(home / "second", tmp_path / "second", prior=tmp_path / "first")
    for one, other in zip(faro(second), faro(first), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-2, atol=1e-6)
    assert second.summary["links"] and not any(link["moved"] for link in second.summary["links"])


def test_targets_that_were_measured_again_count_again(home, tmp_path):
    later = shutil.copytree(home / "second", tmp_path / "later")
    rng = np.random.default_rng(1)
    with Scene(later, rng).sheet("targets.csv") as targets:
        for name in (n for n in targets.columns if n != "target"):
            at = np.array(targets.columns[name], float) + rng.normal(0.0, 5e-4, SPEC.targets)
            targets.columns[name] = [repr(x) for x in at.tolist()]
    first = fitted(home / "first", tmp_path / "first")
    again = fitted(later, tmp_path / "again", prior=tmp_path / "first")
    moved_m = faro(again)[0][:3, 3] - faro(first)[0][:3, 3]
    assert np.abs(moved_m).max() > 5e-5  # half a millimetre of new noise, over 8 targets


@pytest.mark.parametrize("named", ["T3:sphere", "first/T3:sphere", "second/T3:sphere"])
def test_a_shared_target_is_left_out_of_all_by_any_of_its_names(home, tmp_path, named):
    whole = fitted(home / "whole", tmp_path / "whole", model=Model(without=("T3:sphere",)))
    recordings = [home / "first", home / "second"]
    both = fitted(recordings, tmp_path / "both", model=Model(without=(named,)))
    np.testing.assert_allclose(faro(both)[0], faro(whole)[0], atol=1e-6)
    kept = fitted(recordings, tmp_path / "kept")
    assert np.abs(faro(both)[0] - faro(kept)[0]).max() > 1e-5
    assert len(read_csv(home / "first/targets.csv", text=("target",))["target"]) == SPEC.targets
