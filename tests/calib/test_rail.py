"""What is wrong with linear joints is named as that, in worlds that are not drawn as the model is:
a rail that is an arc of a circle, a screw that is uneven."""

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from calib.runs.add import add
from calib.runs.calibrate import calibrate
from calib.runs.diagnose import diagnose

from ..bench.arm_worlds_hidden import places, tool
from . import arm_worlds

BENT = 3.6e-4  # 1/m: a beam of 3 m that sags by 0.4 mm
UNEVEN_M = 2e-4
POSES = 150


def along_a_circle(q, bent, axis, across):
    """Where what slides on the rail is (K,), against where a straight rail has it."""
    turn = Rotation.from_rotvec(bent * q[:, None] * np.cross(axis, across))
    forth = np.sin(bent * q) / bent - q
    aside = (1.0 - np.cos(bent * q)) / bent
    shift = forth[:, None] * axis + aside[:, None] * across
    return RigidTransform.from_components(shift, turn)


def seen(world, read, joint):
    """T_world_tool (K,) where one rail is an arc."""
    links, T = places(world, read), None
    before = RigidTransform.identity(len(read))
    for edge, link in zip(world.edges, links, strict=True):
        T = link if T is None else T * (before.inv() * link)
        before = link
        if edge.joint is not None and edge.joint.name == joint:
            axis = edge.joint.axis
            across = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
            q = read[:, world.joints.index(joint)]
            T = T * along_a_circle(q, BENT, axis, across / np.linalg.norm(across))
    return tool(world, T)


@pytest.mark.parametrize("arm", ["gantry", pytest.param("stanford", marks=pytest.mark.long)])
def test_it_is_named_alone_and_sized(tmp_path, arm):
    """It was told as a joint's scale and a distortion of the tracker, each making up for the other:
    the scale was 17 of its sigmas off."""
    rng, folder = np.random.default_rng(3), tmp_path / "rec"
    world = arm_worlds.bent(folder, arm, rng)
    read = world.draw(rng, POSES)
    joint = next(e.joint.name for e in world.edges if e.joint and e.joint.kind == "prismatic")
    truth = seen(world, read, joint) * arm_worlds.exp(arm_worlds.noise(rng, POSES))
    arm_worlds.save(folder, world, read, truth, {}, 2e-5)
    run = calibrate([folder], tmp_path / "run")
    found = diagnose(run)
    assert [c["add"] for c in found.candidates if c["step"]] == ["arm_rail_bending"]
    after = add(run, ["arm_rail_bending"], tmp_path / "after")
    effect = after.solution.shared.effects["arm_rail_bending"]
    mine = [n.startswith(f"{joint}.bend") for n in effect.names]
    assert np.hypot(*effect.estimate[mine]) == pytest.approx(BENT, abs=4 * effect.sigma[mine].max())
    rest = np.abs(effect.estimate[~np.array(mine)] / effect.sigma[~np.array(mine)])
    assert rest.max() < 4
    assert diagnose(after).verdict == "adequate"


@pytest.mark.parametrize("lead", [0.02, pytest.param(0.4, marks=pytest.mark.long)])
def test_an_uneven_screw_is_named_and_its_lead_found(tmp_path, lead):
    """That of a screw to buy, and one that no list has. It was told as a joint that scatters."""
    rng, folder = np.random.default_rng(4), tmp_path / "rec"
    world = arm_worlds.bent(folder, "gantry", rng)
    read = world.draw(rng, POSES)
    joint = next(e.joint.name for e in world.edges if e.joint and e.joint.kind == "prismatic")
    true = read.copy()
    true[:, world.joints.index(joint)] += UNEVEN_M * np.sin(
        2 * np.pi * read[:, world.joints.index(joint)] / lead + 0.7
    )
    truth = tool(world, places(world, true)[-1]) * arm_worlds.exp(arm_worlds.noise(rng, POSES))
    arm_worlds.save(folder, world, read, truth, {}, 2e-5)
    run = calibrate([folder], tmp_path / "run")
    found = diagnose(run)
    (name,) = [c["add"] for c in found.candidates if c["step"]]
    family, _, length = name.partition("@")
    turns_off = np.ptp(read[:, world.joints.index(joint)]) * abs(1 / float(length) - 1 / lead)
    assert family == "arm_screw_error" and turns_off < 0.1
    effect = add(run, [name], tmp_path / "after").solution.shared.effects[name]
    mine = np.array([n.startswith(f"{joint}.") for n in effect.names])
    size, sigma = np.hypot(*effect.estimate[mine]), effect.sigma[mine].max()
    assert size == pytest.approx(UNEVEN_M, abs=4 * sigma) and sigma < UNEVEN_M / 5
    assert np.abs(effect.estimate[~mine] / effect.sigma[~mine]).max() < 4
