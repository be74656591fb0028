"""What is predicted of an arm at poses that were not measured, against worlds of scipy."""

import csv
import json
import shutil

import numpy as np
import pytest
from scipy.spatial import Delaunay

from calib.evaluation.arm import Arm
from calib.evaluation.at_poses import evaluate_at, over_workspace
from calib.problem.model import Model, Source, default_effects
from calib.report.charts.bodies import workspace
from calib.report.evidence import Evidence
from calib.runs.calibrate import calibrate
from chains.errors import InputError

from . import arm_worlds, rigs
from .test_arm_geometry import opened


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    """An arm that no name describes, its run, poses of which none was measured, and their table."""
    folder = tmp_path_factory.mktemp("arm")
    rng = np.random.default_rng(21)
    world = arm_worlds.bent(folder, "irb120", rng)
    source = opened(folder, world, rng, poses=150)
    run = calibrate([folder], folder.with_name("run"), hold_out="none")
    joints = world.draw(rng, 300)
    table = folder.with_name("poses.csv")
    write(table, source, joints)
    return world, run, joints, table


def write(table, source, joints):
    with open(table, "w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["stop", *source.rig.joint_names])
        rows.writerows([f"p{k}", *row] for k, row in enumerate(joints.tolist()))


def test_what_an_earlier_run_knew_is_known_of_any_pose(world, tmp_path):
    """It has the effects of that run, and predicts as its own solution has it, not one refitted."""
    world, before, _, table = world
    shutil.copytree(before.recordings[0], tmp_path / "few")
    opened(tmp_path / "few", world, np.random.default_rng(4), poses=12)
    known = calibrate([tmp_path / "few"], tmp_path / "known", hold_out="none", prior=before.folder)
    assert set(default_effects([tmp_path / "few"])) < set(known.effects) == set(before.effects)
    alone = calibrate([tmp_path / "few"], tmp_path / "alone", Model(before.effects), "none")
    found, first, plain = (evaluate_at(run, table) for run in (known, before, alone))
    sigma = {
        id(each): np.sqrt(np.trace(each.covariance[:, 3:, 3:], axis1=1, axis2=2)).max()
        for each in (found, plain)
    }
    assert sigma[id(found)] < 0.6 * sigma[id(plain)]
    assert np.abs(found.error - first.error)[:, 3:].max() < 4.0 * sigma[id(found)]


def test_the_true_place_is_predicted_within_its_sigma(world, tmp_path):
    """Drawn place plus predicted error is the true one, to the sigma that is said."""
    world, run, joints, table = world
    found = evaluate_at(run, table, tmp_path / "at.csv")
    frame = run.solution.shared.frames["tool"].T_parent_child
    still = np.zeros(6)
    drawn = arm_worlds.ArmWorld(
        edges=world.edges,
        twists={},
        zeros=dict.fromkeys(world.joints, 0.0),
        tool=still,
        T_world_base=world.T_world_base,
    )
    # Where the base stands as fitted the run does not say: the errors' shift and turn are free.
    ours = drawn.tip(joints).as_matrix() @ frame
    seen = world.seen(joints).translation
    predicted = found.error[:, 3:]
    from chains.align import align_points

    T, _ = align_points(seen - predicted, ours[:, :3, 3])
    left = seen - predicted - (ours[:, :3, 3] @ T[:3, :3].T + T[:3, 3])
    rms = np.sqrt(np.mean(np.sum(left**2, axis=1)))
    before = np.sqrt(np.mean(np.sum(predicted**2, axis=1)))
    assert rms < 1.5 * np.sqrt(np.mean(found.sigma_m**2)) < 1e-4 < 1e-3 < before
    with open(tmp_path / "at.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["pose"] for row in rows] == found.names
    np.testing.assert_allclose([float(r["error_x_mm"]) for r in rows], 1e3 * predicted[:, 0])
    sizes = [np.hypot(np.hypot(*(float(r[f"sigma_{a}_mm"]) for a in "xy")), float(r["sigma_z_mm"]))
             for r in rows]  # fmt: skip
    np.testing.assert_allclose(sizes, [float(r["sigma_mm"]) for r in rows])


def test_far_from_the_measured_poses_less_is_known(world):
    _, run, _, table = world
    found = evaluate_at(run, table)
    told = found.document()
    assert told["poses"] == 300 and told["body"] == "tool" and told["frame"] == "opti"
    assert 0 < told["sigma_mm"]["mean"] < told["sigma_mm"]["max"] < 0.1 < told["error_mm"]["max"]
    at_poses = run.summary["predicted_mm"]["anywhere"]
    # A quantile of 95 % in space is about 1.6 times the root mean square.
    assert told["sigma_mm"]["mean"] == pytest.approx(at_poses / 1.6, rel=0.3)
    json.dumps(told)


def test_poses_beyond_what_was_measured_are_counted(world, tmp_path):
    _, run, joints, _ = world
    source = Source.open(run.recordings[0])
    far = joints[:20].copy()
    low, high = source.recording.joints.min(axis=0), source.recording.joints.max(axis=0)
    far[:7, 1] = high[1] + 0.2 * (high - low)[1]
    far[7:9, 4] = low[4] - 0.2 * (high - low)[4]
    write(tmp_path / "far.csv", source, far)
    names = source.rig.joint_names
    assert evaluate_at(run, tmp_path / "far.csv").beyond == {names[1]: 7, names[4]: 2}


def test_a_report_shows_the_workspace_and_where_the_poses_end(world, tmp_path):
    """The places in the picture are those where the corrected arm brings the body."""
    _, run, joints, table = world
    found = evaluate_at(run, table)
    ours = Arm.of(run, tip="tool").corrected(joints)
    np.testing.assert_allclose(found.place_m, ours[:, :3, 3], atol=1e-9)
    (chart,) = workspace(Evidence.of([run]))
    evidence = Evidence.of([run])
    measured, drawn = over_workspace(run, evidence.estimate)
    for each in (measured, drawn):
        assert f"{1e3 * np.median(each.sigma_m):.2g} mm" in chart.title
    assert f"up to {1e3 * drawn.error_m.max():.2g} mm off" in chart.title
    axes = chart.figure().axes
    dots = [ax.collections[0].get_offsets() for ax in axes if ax.get_xlabel()][:3]
    at = drawn.place_m
    np.testing.assert_allclose(dots[0], np.column_stack([np.hypot(*at[:, :2].T), at[:, 2]]))
    np.testing.assert_allclose(dots[2], at[:, :2])
    outline = next(ax for ax in axes if ax.get_xlabel() == "x of the foot, m").lines[0]
    inside = Delaunay(outline.get_xydata()).find_simplex(0.999 * measured.place_m[:, :2])
    assert np.mean(inside >= 0) > 0.98


def test_a_rig_with_scans_has_no_workspace_in_its_report(tmp_path):
    run = calibrate([rigs.write(tmp_path / "rec")], tmp_path / "run", hold_out="none")
    (absent,) = workspace(Evidence.of([run]))
    assert absent.why


def test_what_is_wrong_with_the_poses_is_said(world, tmp_path):
    _, run, _, table = world
    lines = table.read_text().splitlines()
    short = tmp_path / "short.csv"
    short.write_text("\n".join(line.rpartition(",")[0] for line in lines))
    with pytest.raises(InputError, match=r"short\.csv: column j6 is missing"):
        evaluate_at(run, short)
    with pytest.raises(InputError, match=r"give FILE\.csv"):
        evaluate_at(run, table, tmp_path / "out.txt")
    with pytest.raises(InputError, match=r"nowhere.csv does not exist"):
        evaluate_at(run, tmp_path / "nowhere.csv")


def test_a_rig_whose_base_is_tracked_is_predicted_from_there(tmp_path):
    recording = rigs.write(tmp_path / "rec")
    run = calibrate([recording], tmp_path / "run", hold_out="none")
    table = tmp_path / "poses.csv"
    table.write_text("stop,turn,lift,slide\na,0.1,0.2,0.05\nb,1,0.5,0.1\n")
    found = evaluate_at(run, table)
    assert found.frame == "base_markers" and found.body == "mount_markers"
    assert (found.sigma_m > 0).all() and np.isfinite(found.error).all()
