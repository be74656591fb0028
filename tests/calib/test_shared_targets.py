"""A targets.csv that several recordings have was measured once, and counts once.

The oracle is one recording of all stops: cut in two, with the table of targets in both, it holds
the same measurements.
"""

import shutil

import numpy as np
import open3d as o3d
import pytest

from calib.planning import planner_of
from calib.planning.room.targets import known_with
from calib.problem.model import Model, Source
from calib.problem.without import leave_out
from calib.runs.calibrate import calibrate
from calib.simulation import Spec, simulate

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
    np.testing.assert_allclose(faro(second)[0], faro(first)[0], rtol=0.0, atol=1e-6)
    np.testing.assert_allclose(faro(second)[1], faro(first)[1], rtol=1e-2)
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


def test_a_stop_called_as_a_target_is_no_target(home, tmp_path):
    """And one that is left out by two of its names is left out once."""
    folders = [shutil.copytree(home / name, tmp_path / name) for name in ("first", "second")]
    for folder in folders:
        with Scene(folder, np.random.default_rng()).sheet("stops.csv") as stops:
            stops.columns["stop"][0] = "T3"
    sources = [Source.open(folder) for folder in folders]
    first, second = leave_out(sources, ["first/T3:base_markers"])
    assert np.isnan(first.recording.bodies["base_markers"][0]).all()
    assert np.isfinite(second.recording.bodies["base_markers"][0]).all()
    both = leave_out(sources, ["first/T3:sphere", "second/T3:sphere"])
    assert all(np.isnan(each.recording.targets.faro_m[2]).all() for each in both)
    assert not {*both[0].counted_targets} - {*both[1].counted_targets}


def test_a_sphere_that_the_earlier_run_left_out_counts_in_the_next(home, tmp_path):
    without = Model(without=("T3:sphere", "T4:sphere", "T5:sphere"))
    fitted(home / "first", tmp_path / "first", model=without)
    second = fitted(home / "second", tmp_path / "second", prior=tmp_path / "first")
    whole = fitted(home / "whole", tmp_path / "whole")
    np.testing.assert_allclose(faro(second)[0], faro(whole)[0], rtol=0.0, atol=2e-4)
    third = fitted(home / "second", tmp_path / "third", model=without, prior=tmp_path / "first")
    assert (
        np.abs(faro(third)[0] - faro(whole)[0]).max()
        > np.abs(faro(second)[0] - faro(whole)[0]).max()
    )


def test_frames_of_the_scanner_with_other_names_have_their_own_targets(home, tmp_path):
    """In one fit of both, and in one from the other."""
    other = shutil.copytree(home / "second", tmp_path / "other")
    rig = (other / "rig.yaml").read_text()
    (other / "rig.yaml").write_text(
        f"{rig}reference: {{frame: b, mesh: box.ply, sigma_m: 0.001}}\n"
    )
    o3d.io.write_triangle_mesh(str(other / "box.ply"), o3d.geometry.TriangleMesh.create_box())
    alone = faro(fitted(home / "first", tmp_path / "alone"))
    both = fitted([home / "first", other], tmp_path / "both").solution.shared.frames
    later = fitted(other, tmp_path / "later", prior=tmp_path / "alone").solution.shared.frames
    for frame in (both["faro"], both["b"], later["b"]):
        np.testing.assert_allclose(frame.T_parent_child, alone[0], rtol=0.0, atol=2e-5)
        np.testing.assert_allclose(frame.sigma_m, alone[1][:3], rtol=0.2)


def test_spheres_tell_of_what_the_earlier_run_had_no_unknown_for(home, tmp_path):
    fitted(home / "first", tmp_path / "first")
    model = Model.of("arm_link_length,arm_joint_offset,target_sphere_offset", ())
    second = fitted(home / "second", tmp_path / "second", model=model, prior=tmp_path / "first")
    offset = second.solution.shared.effects["target_sphere_offset"]
    assert (offset.sigma < 5e-4).all()  # of 1 mm on paper


def test_planned_targets_stand_beside_those_of_a_run_that_leaves_some_out(home, tmp_path):
    run = fitted(home / "whole", tmp_path / "run", model=Model(without=("T3:sphere",)))
    scene = planner_of(run, "all").scene
    more = known_with(scene, np.array([[1.0, 1.0, 1.5], [-1.0, 2.0, 1.0]]))
    at = [scene.now.keys.index(key) for key in scene.now.keys if key[0] == "faro"]
    assert len(more.keys) > len(scene.now.keys) and at
