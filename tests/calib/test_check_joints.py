"""What check sees of joints and tables before any fit: which rows, which columns, read how."""

from dataclasses import replace

import numpy as np
import pytest

from calib.problem.model import Source
from calib.problem.without import leave_out
from calib.rig import load_rig
from calib.rig.recording import Recording
from calib.rig.tracked import odd_bodies

from . import arm_worlds
from .test_check_suspects import BASE, MOUNT, changed, only, opened


@pytest.fixture(scope="module")
def sound(shared):
    return opened(shared, "known_nothing_hidden")


@pytest.mark.parametrize("by", [-2, -1, 1])
@pytest.mark.parametrize("name", [BASE, MOUNT, "joints"])
def test_columns_out_of_step(sound, name, by):
    """As where tables were joined a row apart: which columns, and which way."""
    rig, recording = sound
    if name == "joints":
        late = replace(recording, joints=np.roll(recording.joints, by, axis=0))
    else:
        late = changed(recording, name, slice(None), lambda p: np.roll(p, by, axis=0))
    found = only(odd_bodies(rig, late))
    row = f"the {'second ' * (abs(by) == 2)}row {'below' if by > 0 else 'above'}"
    assert f"the columns of {name} from {row}" in found.sentence and found.stops == ()


def test_an_arm_alone_whose_joints_are_a_row_late(shared):
    rig, recording = opened(shared, "arm_base_creeps")
    late = replace(recording, joints=np.roll(recording.joints, 1, axis=0))
    found = only(odd_bodies(rig, late))
    assert "the columns of joints from the row below" in found.sentence
    assert found.sentence.startswith("tool would lie where CAD and joints put it if")


def test_rows_of_joints_in_another_order_than_those_of_bodies_are_told(sound):
    """As where one table was sorted: no column is a row late, and no stop is to blame."""
    rig, recording = sound
    order = np.random.default_rng(3).permutation(len(recording.stops))
    found = only(odd_bodies(rig, replace(recording, joints=recording.joints[order])))
    assert "would fit the joints of another stop: are rows of stops.csv mixed" in found.sentence
    assert found.stops == ()


@pytest.mark.parametrize(("first", "last"), [(10, 16), (100, 119), (150, 299)])
def test_some_rows_of_an_arm_are_out_of_step(shared, first, last):
    """From a row on, or between two: most rows may be good, or most bad."""
    rig, recording = opened(shared, "arm_base_creeps")
    some = np.arange(first, last + 1)
    late = replace(recording, joints=recording.joints.copy())
    late.joints[some] = recording.joints[some - 1]
    (found,) = (f for f in odd_bodies(rig, late) if "out of step" in f.sentence)
    stops = recording.stops[first], recording.stops[last]
    assert "if each row from {} to {} of stops.csv took".format(*stops) in found.sentence
    assert "the columns of joints from the row below" in found.sentence


def test_rows_that_have_nothing_in_common_are_not_out_of_step(shared):
    """Ten rows of the joints, drawn anew: each is told, and no step."""
    rig, recording = opened(shared, "arm_base_creeps")
    wild = replace(recording, joints=recording.joints.copy())
    some = np.arange(40, 50)
    wild.joints[some] = np.random.default_rng(1).permutation(recording.joints)[some]
    told = list(odd_bodies(rig, wild))
    assert {s for f in told for s in f.stops} == {recording.stops[k] for k in some}
    assert not any("out of step" in f.sentence for f in told)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda q: q * [1, -1, 1, 1, 1, 1], "joint_2 had the other sign"),
        (lambda q: q * [1, 1, 1, 1, -1, 1], "joint_5 had the other sign"),
        (lambda q: q[:, [0, 2, 1, 3, 4, 5]], "the columns of joint_2 and joint_3 were exchanged"),
        (lambda q: q[:, ::-1], "all joints were in reverse order"),
        (lambda q: q[:, [0, 1, 2, 5, 4, 3]], "the columns of joint_4 and joint_6 were exchanged"),
        (lambda q: q + np.pi / 2 * np.eye(6)[2], "joint_3 read 90 deg less"),
        (lambda q: q - np.pi / 2 * np.eye(6)[1], "joint_2 read 90 deg more"),
        (lambda q: q + q[:, [1]] * np.eye(6)[2], "joint_3 moved by joint_3 - joint_2"),
        (lambda q: q - q[:, [4]] * np.eye(6)[5], "joint_6 moved by joint_6 + joint_5"),
    ],
)
def test_joints_read_otherwise_than_the_urdf_has_them(shared, change, said):
    rig, recording = opened(shared, "arm_base_creeps")
    found = only(odd_bodies(rig, replace(recording, joints=change(recording.joints))))
    assert f"if {said}" in found.sentence and found.stops == ()
    assert "are the joints read as the URDF has them?" in found.sentence


@pytest.mark.parametrize("count", [4, 90])
def test_a_joint_whose_reading_stood_still(shared, count):
    """Some rows of 300, each to be left out by its name; a joint that nobody moves is none."""
    rig, recording = opened(shared, "arm_base_creeps")
    joints = recording.joints.copy()
    joints[50 : 50 + count, 3] = joints[49, 3]
    found = only(odd_bodies(rig, replace(recording, joints=joints)))
    assert (found.kind, found.name) == ("joints", "joint_4") and "stand still" in found.sentence
    assert found.stops == tuple(recording.stops[50 : 50 + count])
    source = Source(rig, replace(recording, joints=joints), None)
    leave_out([source], [f"{found.stops[0]}:joint_4"])


def test_a_wild_pose_widens_no_range_and_stays_told(shared):
    """Rows 100 to 119 are late. At row 5 the arm was elsewhere, and at 200 too."""
    rig, recording = opened(shared, "arm_base_creeps")
    late = replace(recording, joints=recording.joints.copy())
    late.joints[100:120] = recording.joints[99:119]
    late.joints[[5, 200]] += 1.0
    first, *others = odd_bodies(rig, late)
    assert "if each row from p100 to p119 of stops.csv took" in first.sentence
    assert [each.stops for each in others] == [("p005",), ("p200",)]


def test_single_rows_that_hold_the_pose_before_are_no_step_of_the_table(shared):
    """What lies between them fits as it is."""
    rig, recording = opened(shared, "arm_base_creeps")
    rows = [10, 150, 290]
    poses = recording.bodies["tool"].copy()
    poses[rows] = poses[np.subtract(rows, 1)] + [1e-5, 0, 0, 0, 0, 0, 0]
    stale = replace(recording, bodies={"tool": poses})
    found = list(odd_bodies(rig, stale))
    assert [each.stops for each in found] == [("p010",), ("p150",), ("p290",)]


def test_a_joint_that_counts_the_other_way_at_a_few_stops_is_not_so_at_all(sound):
    rig, recording = sound
    some = np.flatnonzero(
        np.all([np.isfinite(p).all(axis=1) for p in recording.bodies.values()], 0)
    )
    joints = recording.joints.copy()
    joints[some[:4], 2] *= -1
    found = list(odd_bodies(rig, replace(recording, joints=joints)))
    assert not any("other sign" in each.sentence for each in found)


def test_all_joints_whose_readings_stood_still_are_told_once(shared):
    rig, recording = opened(shared, "arm_base_creeps")
    joints = recording.joints.copy()
    joints[50:60] = joints[49]
    joints[200] += 1.0
    found, wild = odd_bodies(rig, replace(recording, joints=joints))
    assert (found.kind, found.name) == ("joints", "joints") and wild.stops == ("p200",)
    assert found.stops == tuple(recording.stops[50:60])
    joints = recording.joints.copy()
    joints[50:60, 2:4] = joints[49, 2:4]
    found = list(odd_bodies(rig, replace(recording, joints=joints)))
    assert [each.name for each in found] == ["joint_3", "joint_4"]


def test_a_joint_that_nobody_moves_has_not_stood_still(tmp_path):
    """Ten wild poses of an arm whose wrist was held all the time: they are told, and no reading."""
    rng, rows = np.random.default_rng(5), np.arange(20, 40, 2)
    world = arm_worlds.bent(tmp_path / "rec", "ur10", rng)
    read = world.draw(rng, 60)
    read[:, 5] = 0.3
    wild = read.copy()
    wild[rows] += 1.0
    arm_worlds.save(tmp_path / "rec", world, read, world.seen(wild))
    recording = Recording.open(tmp_path / "rec")
    found = list(odd_bodies(load_rig(tmp_path / "rec"), recording))
    assert {k for each in found for k in each.stops} == {recording.stops[k] for k in rows}
    assert {each.kind for each in found} == {"body"}


def test_bodies_that_are_never_seen_together_are_not_compared(sound):
    rig, recording = sound
    bodies = {name: poses.copy() for name, poses in recording.bodies.items()}
    bodies[BASE][::2], bodies[MOUNT][1::2] = np.nan, np.nan
    assert not list(odd_bodies(rig, replace(recording, bodies=bodies)))
