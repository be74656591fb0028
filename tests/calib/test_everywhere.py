"""Changes of an arm's geometry that no pose shows, and those that other poses show."""

from __future__ import annotations

import numpy as np
import pytest

import calib
from calib.diagnosis.everywhere import Everywhere
from calib.diagnosis.weak import to_be_planned, to_be_told_apart
from calib.effects import find
from calib.planning import planner_of
from calib.results.reach import at_joints, placed
from calib.simulation import PRESETS, simulate
from tests.worlds import World

from .narrow import fitted, run_of


@pytest.fixture(scope="module")
def planner(once):
    """Of a recording whose joint 5 never turned, and joints 2, 3 and 6 hardly."""
    return planner_of(run_of(once), "all")


FRAME = ("rx", "ry", "rz", "tx", "ty", "tz")


@pytest.mark.parametrize(
    ("names", "still"),
    [
        # Along the first joint's axis, as is where the arm's base is tilted.
        ((*(f"arm_base.{dof}" for dof in FRAME), "arm_link_length.joint_1"), 1),
        ((*(f"mount.{dof}" for dof in FRAME), "arm_joint_offset.joint_6"), 1),  # about the last one
        (("arm_joint_offset.joint_2", "arm_joint_offset.joint_3"), 0),
        (("arm_link_length.joint_3", "arm_link_length.joint_5"), 0),
    ],
)
def test_what_moves_nothing_at_any_pose_is_told_from_what_moves_something_at_some(
    planner, names, still
):
    everywhere = Everywhere.of(planner.scene.stand)
    keys = [key for key in planner.keys if key.name in names]
    none, rest = everywhere.split(keys, np.ones(len(keys)))
    assert (none.shape[1], rest.shape[1]) == (still, len(names) - still)
    for direction in none.T:
        assert names[-1] in everywhere.movers(keys, direction, 0.2)


def test_what_is_said_to_move_nothing_moves_nothing_when_it_is_changed(planner):
    """By the rig's own kinematics at other poses, the estimate moved along each direction."""
    scene, problem = planner.scene, planner.scene.stand.estimate.problem
    rig, values = scene.source.rig, dict(scene.values)
    weak = [w for w in planner.now.weak if w["alike"]]
    assert len(weak) >= 4 and not any("faro" in name for w in weak for name in w["parameters"])
    everywhere, known = scene.everywhere, scene.now
    at = known.at(scene.calibration)
    keys, unit = [known.keys[i] for i in at], known.unit[at]
    none, _ = everywhere.split(keys, unit)
    joints = np.random.default_rng(5).uniform(-2, 2, (20, len(rig.joint_names)))

    def seen(values):
        stops = at_joints(problem, np.zeros(20, int), joints, "")
        base = rig.tracker.bodies[0]
        return np.stack([placed(stops, f, base, values).T for f in ("mount_markers", "lidar")])

    assert none.shape[1] >= 6
    for direction in none.T:
        change, moved = 0.1 * direction * unit, dict(values)
        for name in scene.calibration:
            mine = np.array([key.unknown == name for key in keys])
            unknown = problem.variables[name]
            moved[name] = unknown.moved(values[name], change[mine]) if mine.any() else values[name]
        by = np.abs(seen(moved) - seen(values)).max()
        parts = np.abs(change).max()
        assert by < 0.02 * parts  # what is left is of second order


def test_any_number_of_stops_leaves_what_no_pose_shows(planner):
    poses = planner.candidates(60, 0)
    endless = planner.endless(planner.look(poses, 3))
    now, then = (
        {tuple(w["parameters"]) for w in k.weak if w["alike"]} for k in (planner.now, endless)
    )
    assert now <= then  # of so many the first are told
    assert any(not w["alike"] for w in planner.now.weak)


@pytest.mark.parametrize(
    ("one", "other", "alike"),
    [
        ("arm_gravity_sag", "arm_link_bending", True),
        ("arm_gravity_sag", "arm_joint_scale", False),
        ("arm_gravity_sag", "arm_joint_eccentricity", False),
    ],
)
def test_effects_that_are_alike_at_every_pose_are_those_that_all_stops_hardly_tell(
    planner, once, one, other, alike
):
    """By kinematics alone, and by what the beams and bodies of all candidates say: two ways."""
    everywhere = Everywhere.of(planner.scene.stand, (find(one), find(other)))
    assert everywhere.alike(one, other) == everywhere.alike(other, one) == alike
    rivals = planner_of(run_of(once), f"{one},{other}")
    poses = rivals.candidates(60, 0)
    never = rivals.alike(rivals.look(poses, 3))
    assert ((one, other) in never) == alike


def test_no_stops_are_asked_for_where_none_separate():
    rivals = [{"add": "b", "alike": True, "effect": "b"}, {"add": "c", "alike": False}]
    candidate = {"add": "a", "rivals": rivals, "step": 1, "indistinguishable_from": ["b", "c"]}
    assert to_be_planned(candidate) == to_be_told_apart([candidate], []) == ["a", "c"]
    only = candidate | {"rivals": rivals[:1]}
    assert to_be_planned(only) == to_be_told_apart([only], []) == []
    earlier = candidate | {"rivals": [{"add": "b"}]}  # of an earlier version
    assert to_be_planned(earlier) == ["a", "b"]


def test_a_plan_says_what_changed_alike_so_far_and_what_never_will(once, rigcal):
    """Joint 5 never turned, so that the axes of joints 4 and 6 were one line."""
    words = ["plan", run_of(once).folder, "--candidates", 60, "--stops", 3, "--for"]
    told = [" ".join(rigcal(*words, name)[1].split()) for name in ("arm_joint_offset", "mount.tz")]
    names = "arm_joint_offset.joint_4, arm_joint_offset.joint_6 and mount.rz"
    assert f"So far {names} change alike in all that is seen; at these stops not." in told[0]
    assert "With them sigmas fall: arm_joint_offset." in told[0] and "joint_5 at " in told[0]
    assert "NO STOPS of this arm help: the sigma of mount.tz stays at" in told[1]
    assert "With them sigmas fall: mount" not in told[1]


def test_with_a_mesh_of_one_wall_the_arm_keeps_off_it(tmp_path):
    """Its box is flat, so that every stop that was measured lies outside."""
    wall_m, few = 4.0, (1.0, 0.4, 0.4, 0.4, 0.4, 1.0)
    world = World(seed=14, locations=2, stops=3, beams=800, meshed=(2,), turned=few)
    planner = planner_of(fitted(world, tmp_path), "all")
    clear, source = planner.clear, planner.scene.source
    assert len(planner.candidates(40, 0).joints) == 40
    joints = clear.drawn(200, np.random.default_rng(0))
    T = np.eye(4)
    T[:3, 3] = wall_m - 0.5, 0.0, 0.12
    Ts = np.broadcast_to(T, (200, 4, 4))
    lidar = (Ts @ source.rig.tree.place("lidar", joints).Ts_root_frame)[:, 0, 3]
    told = clear.of_poses(joints, Ts)
    assert np.sum(lidar > wall_m - 0.05) > 20 and told.sum() > 20
    assert lidar[told].max() < wall_m - 0.05


def test_where_the_base_may_be_anywhere_it_takes_on_what_moves_all_alike(tmp_path):
    """A turn about the first joint, and the height of its place, of an arm that nothing but a
    tracker sees."""
    spec = PRESETS["laser-tracker"]
    simulate(spec, tmp_path / "rec", seed=1)
    run = calib.fit([tmp_path / "rec"], tmp_path / "run", hold_out="none")
    everywhere = Everywhere.of(planner_of(run, "all").scene.stand)
    names = [key.name for key in everywhere.keys]
    still = [np.linalg.norm(column) == 0 for column in everywhere.J.T]
    mine = {name for name, none in zip(names, still, strict=True) if none}
    assert "arm_joint_offset.joint_1" in mine and "arm_joint_offset.joint_2" not in mine
    keys = [everywhere.keys[names.index("arm_joint_offset.joint_1")]]
    none, rest = everywhere.split(keys, np.ones(1))
    assert none.shape[1] == 1 and not rest.shape[1]
    assert everywhere.movers(keys, none[:, 0], 0.2) == ["arm_joint_offset.joint_1"]
