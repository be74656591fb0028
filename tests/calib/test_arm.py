"""The calibrated arm: as the graph has it, and joints that put the tip where it should be."""

import numpy as np
import pytest

import calib
from calib.effects import CATALOGUE, Site
from calib.evaluation.arm import Arm
from calib.forward import Term, place
from calib.problem.model import Source
from calib.results.solution import EffectEstimate, FrameEstimate, Part
from chains import se3
from chains.errors import InputError

from ..chains.arms import TABLES
from . import arm_worlds, rigs
from .test_arm_geometry import opened

BENDS = [e for e in CATALOGUE if e.site in (Site.JOINTS, Site.EDGE) and not e.by_chance]
COLUMNS = ("temperature_c", "time_s", "elapsed_s", "payload_kg")


def found(source, names, rng, size=1.0):
    """A solution in which these effects and all frames are off by their prior sigma."""
    effects, frames, values = {}, {}, {}
    for effect in (e for e in BENDS if e.family in names and e.params(source.rig)):
        params = effect.params(source.rig)
        theta = size * np.array([p.sigma for p in params]) * rng.normal(size=len(params))
        values[effect.name] = theta
        labels = tuple(p.name for p in params)
        estimate = EffectEstimate(unit="m", names=labels, estimate=theta, sigma=0 * theta)
        effects[effect.name] = (effect, estimate)
    tree = source.rig.tree
    for name, sigma in source.rig.frame_sigma.items():
        edge = tree.edges[tree.edge_names.index(name)]
        values[name] = size * sigma * rng.normal(size=6)
        T = edge.T_parent_child @ se3.exp(values[name])
        still = np.zeros(3)
        frames[name] = FrameEstimate(edge.parent, T, sigma_m=still, sigma_rad=still)
    part = Part(frames, {name: estimate for name, (_, estimate) in effects.items()})
    return part, {name: effect for name, (effect, _) in effects.items()}, values


def in_the_graph(source, known, values, joints, columns, base, tip):
    """T_base_tip as `calib.forward` has it, the base where it stands at rest."""
    frames = [calib.effects.FrameOffset(name) for name in source.rig.frame_sigma]
    terms = [Term(e, e.name, np.arange(len(values[e.name]))) for e in (*frames, *known.values())]
    stops = place(source.rig, terms, joints, columns, "root", None)
    rest = {n: 0 * v if n in known and known[n].covariates else v for n, v in values.items()}
    T_base, T_tip = stops.in_root(base, rest).T, stops.in_root(tip, values).T
    return se3.inverse(T_base) @ T_tip


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    return Source.open(rigs.write(tmp_path_factory.mktemp("arm") / "rec"))


@pytest.mark.parametrize("tip", [None, "lidar"])
@pytest.mark.parametrize("name", [e.name for e in BENDS] + ["all of these", "none"])
def test_it_is_where_the_graph_has_it(source, name, tip):
    rng = np.random.default_rng(4)
    names = {"all of these": [e.family for e in BENDS], "none": []}.get(name, [name])
    part, known, values = found(source, names, rng)
    joints = rng.uniform(-3, 3, (50, 3))
    columns = {c: rng.uniform(10, 30, 50) for c in COLUMNS}
    for joint, travel in zip(source.rig.joint_names, rng.uniform(-1, 1, (3, 50)), strict=True):
        columns |= {f"moved.{joint}": np.sign(travel), f"travel.{joint}": travel}
    columns["waited.s"] = rng.uniform(1.0, 100.0, 50)
    columns["torques"] = rng.uniform(-30, 30, (50, 3))
    columns |= {j: q for j, q in zip(source.rig.joint_names, joints.T, strict=True)}
    arm = Arm.as_found(source, part, known, tip)
    there = in_the_graph(source, known, values, joints, columns, arm.base, arm.tip)
    np.testing.assert_allclose(arm.corrected(joints, columns), there, atol=1e-12)


@pytest.mark.parametrize("name", [name for name in TABLES if name not in ("scara", "positioner")])
def test_what_is_commanded_brings_the_tip_where_it_should_be(tmp_path, name):
    rng = np.random.default_rng(6)
    world = arm_worlds.bent(tmp_path, name, rng, size=0.0)
    source = opened(tmp_path, world, rng, poses=2)
    names = ("arm_link_length", "arm_joint_offset", "arm_geometry", "arm_joint_eccentricity")
    part, known, values = found(source, (*names, "arm_gravity_sag"), rng, size=0.3)
    arm = Arm.as_found(source, part, known, "tool")
    joints = world.draw(rng, 3000)
    command = arm.to_command(joints)
    wanted = arm.drawn.place(joints)
    there = in_the_graph(source, known, values, command.joints, {}, "arm_base", "tool")
    off = se3.log(se3.inverse(wanted) @ there)
    np.testing.assert_array_equal(command.went, np.abs(command.joints - joints).max(axis=1))
    limits = np.array([[joint.lower, joint.upper] for joint in source.rig.joints]).T
    beyond = (command.joints < limits[0]) | (command.joints > limits[1])
    np.testing.assert_array_equal(command.within, ~beyond.any(axis=1))
    assert not command.within.all() and command.within.mean() > 0.5
    close = command.off_m < 1e-7
    # But for poses in which the arm is stretched or its wrist straight: it cannot go on that way.
    J = arm.drawn.axes(joints).jacobian()
    J[:, :3] *= sum(np.linalg.norm(T[:3, 3]) for T in arm.drawn.fixed)
    assert close.mean() > 0.8 and close[np.linalg.svd(J, compute_uv=False)[:, 5] > 0.06].all()
    assert np.abs(off[close]).max() < 1e-6
    off_m = np.linalg.norm(there[:, :3, 3] - wanted[:, :3, 3], axis=1)
    np.testing.assert_allclose(command.off_m, off_m, atol=1e-9)
    before = arm.corrected(joints)[:, :3, 3] - wanted[:, :3, 3]
    size = np.linalg.norm(before, axis=1)
    assert (off_m < size + 0.02).all() and np.median(size) > 1e-4, "there was something to correct"


def test_an_arm_of_few_joints_says_how_far_it_stays_off(tmp_path):
    rng = np.random.default_rng(7)
    world = arm_worlds.bent(tmp_path, "scara", rng, size=0.0)
    source = opened(tmp_path, world, rng, poses=2)
    part, known, _ = found(source, ("arm_link_length", "arm_joint_offset", "arm_geometry"), rng)
    arm = Arm.as_found(source, part, known)
    joints = world.draw(rng, 500)
    command = arm.to_command(joints)
    left = se3.log(se3.inverse(arm.drawn.place(joints)) @ arm.corrected(command.joints))
    np.testing.assert_allclose(command.off_rad, np.linalg.norm(left[:, :3], axis=1), atol=1e-8)
    assert (command.off_rad > 1e-4).all() and command.off_rad.max() < 0.05


def test_an_arm_of_seven_joints_reaches_towards_what_is_out_of_reach(tmp_path):
    """Every step brings the tip nearer, and so damps the next less: without an end to that, seven
    joints have no least step."""
    world = arm_worlds.bent(tmp_path, "iiwa7", np.random.default_rng(9), size=0.0)
    source = opened(tmp_path, world, np.random.default_rng(9), poses=2)
    names = ("arm_link_length", "arm_joint_offset", "arm_geometry")
    part, known, _ = found(source, names, np.random.default_rng(9), size=0.3)
    arm = Arm.as_found(source, part, known)
    for seed, beyond_m in ((0, 0.0), (2, 1e-6), (3, 1e-3), (4, 0.3)):
        rng = np.random.default_rng(seed)
        joints = rng.uniform(-2, 2, (200, 7))
        joints[:, [1, 3, 5]] *= 0.02 * rng.uniform(0, 1)  # stretched
        wanted = arm.corrected(joints)
        out = wanted[:, :3, 3] / np.linalg.norm(wanted[:, :3, 3], axis=1, keepdims=True)
        wanted[:, :3, 3] += beyond_m * out
        start = joints + rng.normal(0, 0.1, joints.shape)
        command = arm.joints_for(wanted, start)
        before = np.linalg.norm(wanted[:, :3, 3] - arm.corrected(start)[:, :3, 3], axis=1)
        assert np.isfinite(command.joints).all()
        assert (command.off_m < np.maximum(before, beyond_m) + 0.02).all()


def test_what_cannot_be_is_said(source):
    rng = np.random.default_rng(8)
    part, known, _ = found(source, ["arm_thermal_growth"], rng)
    arm = Arm.as_found(source, part, known)
    with pytest.raises(InputError, match="temperature_c"):
        arm.corrected(np.zeros((2, 3)))
    with pytest.raises(InputError, match=r"\(2, 4\); \(K, 3\) is wanted"):
        arm.corrected(np.zeros((2, 4)))
    with pytest.raises(InputError, match="frame 'base_markers' is not carried by the arm"):
        Arm.as_found(source, part, known, "base_markers")


def test_a_run_has_an_arm(shared, tmp_path):
    recording = shared / "recordings/arm_payload"
    run = calib.fit([recording], tmp_path / "run", hold_out="none")
    arm = calib.Arm.of(run, "tool")
    joints = Source.open(recording).recording.joints
    off = arm.corrected(joints)[:, :3, 3] - arm.drawn.place(joints)[:, :3, 3]
    assert 1e-3 < np.linalg.norm(off, axis=1).mean() < 1e-2
    with pytest.raises(InputError, match="no rig 'other'"):
        calib.Arm.of(run, rig="other")
