"""Arms that stand under a tracker: a level tells what they stand on from the tracker, and a known
up tells how their weight pulls. Kinematics are scipy's, weights pull by the slope of heights."""

from dataclasses import replace

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import RigidTransform, Rotation

from calib.effects import GEOMETRY
from calib.problem.model import Model
from calib.results.check import check
from calib.runs.calibrate import calibrate
from calib.runs.diagnose import diagnose

from ..bench.arm_worlds_hidden import KINDS, Session, places, scaled
from . import arm_worlds

POSES, LEVEL_RAD = 120, 2e-4
UP = {"up": [0.0, 0.0, 1.0], "sigma_up_rad": 0.005}


def with_levels(folder, levels):
    """The recording, with this section of levels in its rig.yaml."""
    rig = yaml.safe_load((folder / "rig.yaml").read_text())
    (folder / "rig.yaml").write_text(yaml.safe_dump(rig | {"levels": levels}))
    return folder


def named(folder, out):
    """The effects that the diagnosis of complete geometry names."""
    found = diagnose(calibrate([folder], out, Model(GEOMETRY))).document()
    return [c["effect"] for c in found["candidates"] if c["step"]]


@pytest.mark.parametrize(("what", "name"), [("stand", "stand_creep"), ("tracker", "tracker_creep")])
def test_a_level_tells_what_the_arm_stands_on_from_the_tracker(tmp_path, what, name):
    """Either tilts by 1 mrad in an hour. The level is on the base."""
    rng = np.random.default_rng(5)
    world = arm_worlds.bent(tmp_path / "rec", "ur10", rng, size=0.3)
    joints, time_s = world.draw(rng, POSES), 30.0 * np.arange(POSES)
    tilt = Rotation.from_rotvec(np.outer(time_s / 3600.0, [1e-3, -6e-4, 0.0]))
    tilt = RigidTransform.from_rotation(tilt)
    at_base, seen = world.T_world_base, world.seen(joints)
    if what == "stand":
        base = at_base * tilt
        seen = base * at_base.inv() * seen
    else:  # where things are does not change
        base, seen = at_base * RigidTransform.identity(POSES), tilt * seen
    felt = base.rotation.inv().apply([0.0, 0.0, 1.0]) + LEVEL_RAD * rng.normal(size=(POSES, 3))
    columns = {"time_s": time_s, **{f"base.a{c}": felt[:, i] for i, c in enumerate("xyz")}}
    seen = seen * arm_worlds.exp(arm_worlds.noise(rng, POSES))
    arm_worlds.save(tmp_path / "rec", world, joints, seen, columns)
    with_levels(tmp_path / "rec", {"frames": ["base"], "sigma_rad": LEVEL_RAD})
    assert named(tmp_path / "rec", tmp_path / "run") == [name]


def test_a_level_that_is_askew_on_its_link_is_told_and_no_tracker_blamed(tmp_path):
    """A link's frame is only as good as its URDF. The tracker was to scatter by 0.5 mm, "random as
    far as these data show", and the model was adequate, held-out poses five times worse."""
    rng = np.random.default_rng(9)
    world = arm_worlds.bent(tmp_path / "rec", "ur10", rng)
    joints = world.draw(rng, POSES)
    link = world.T_world_base * places(world, joints)[3]
    felt = link.rotation.inv().apply([0.0, 0.0, 1.0]) + LEVEL_RAD * rng.normal(size=(POSES, 3))
    frame = world.edges[3].child
    columns = {f"{frame}.a{c}": felt[:, i] for i, c in enumerate("xyz")}
    seen = world.seen(joints) * arm_worlds.exp(arm_worlds.noise(rng, POSES))
    arm_worlds.save(tmp_path / "rec", world, joints, seen, columns)
    with_levels(tmp_path / "rec", {"frames": [frame], "sigma_rad": LEVEL_RAD})
    found = diagnose(calibrate([tmp_path / "rec"], tmp_path / "run", Model(GEOMETRY)))
    document = found.document()
    assert found.verdict != "adequate" and not any("scatter" in name for name in found.worth_adding)
    assert any("Give it a frame of its own" in line for line in document["sentences"])


@pytest.fixture
def askew(tmp_path):
    """A UR10 whose base is tilted by 0.54 rad and whose joints sag: its recording."""
    rng = np.random.default_rng(6)
    world = arm_worlds.bent(tmp_path / "rec", "ur10", rng, size=0.3)
    turn = Rotation.from_rotvec([0.5, -0.2, 0.0]) * Rotation.from_rotvec([0.0, 0.0, 1.0])
    at_base = RigidTransform.from_components([0.2, 0.3, 0.1], turn)
    world = replace(world, T_world_base=at_base)
    session = Session.drawn(world, rng, POSES)
    seen = scaled(KINDS["gravity sag"].hide(world, session, rng), 5.0)
    seen = seen * arm_worlds.exp(arm_worlds.noise(rng, POSES))
    columns = {"payload_kg": session.payload_kg}
    arm_worlds.save(tmp_path / "rec", world, session.joints, seen, columns)
    return tmp_path / "rec"


def test_an_arm_that_stands_askew_sags_along_an_up_that_is_known(askew, tmp_path):
    assert named(with_levels(askew, UP), tmp_path / "run") == ["arm_gravity_sag"]


def test_a_check_asks_where_up_is_of_an_arm_that_stands_askew(askew):
    (said,) = (line for line in check(askew, graph=False).odd if "leans" in line)
    assert "z of 'base' leans by 31 deg from z" in said and "levels: {up: [0, 0, 1]" in said
    with_levels(askew, UP)
    (said,) = (line for line in check(askew, graph=False).odd if "leans" in line)
    assert "leans by 31 deg from up as rig.yaml has it" in said


def test_joints_that_are_misread_do_not_lean_an_arm(tmp_path):
    world = arm_worlds.bent(tmp_path / "rec", "ur10", np.random.default_rng(7))
    joints = world.draw(np.random.default_rng(8), POSES)
    read = joints.copy()
    read[:, 4] -= joints[:, 3]
    arm_worlds.save(tmp_path / "rec", world, read, world.seen(joints))
    assert not any("leans" in line for line in check(tmp_path / "rec", graph=False).odd)


def test_a_head_down_arm_is_told_nothing_of_levels_that_it_has_not(askew):
    with_levels(askew, {**UP, "up": [0.0, 0.0, -1.0]})
    assert not any("levels say" in line for line in check(askew, graph=False).odd)


def test_an_up_alone_needs_a_tracker(askew):
    rig = yaml.safe_load((askew / "rig.yaml").read_text())
    del rig["tracker"]
    (askew / "rig.yaml").write_text(yaml.safe_dump(rig | {"levels": UP}))
    (said,) = check(askew, graph=False).problems
    assert "levels.up" in said and "give one, or frames" in said


def test_an_up_that_was_given_is_no_finding(askew, tmp_path):
    run = calibrate([with_levels(askew, UP)], tmp_path / "run", Model(GEOMETRY))
    assert "up" not in run.summary
