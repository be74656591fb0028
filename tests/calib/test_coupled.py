"""An arm whose joints follow each other, from a recording to a calibrated URDF."""

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import RigidTransform, Rotation

from calib.effects import DEFAULT, GEOMETRY
from calib.evaluation.arm import Arm
from calib.exporters import export
from calib.problem.model import Model, Source
from calib.runs.calibrate import calibrate
from calib.runs.diagnose import diagnose
from chains.arm import read_arm
from chains.frames import FrameTree

from ..chains.test_mimic import ARM
from . import arm_worlds


def written(folder, rng, true_urdf=ARM, poses=100, drawn=ARM):
    """A recording of an arm that is as one URDF has it, and drawn as another."""
    folder.mkdir()
    (folder / "arm.urdf").write_text(true_urdf)
    edges = read_arm(folder / "arm.urdf", "arm_base", "arm_end")
    (folder / "arm.urdf").write_text(drawn)
    world = arm_worlds.ArmWorld(
        edges=edges,
        twists={e.name: 1e-3 * rng.normal(size=6) for e in edges},
        zeros={e.joint.name: 2e-3 for e in edges if e.joint is not None},
        tool=rng.normal(size=6) * np.repeat([0.01, 0.005], 3),
        T_world_base=arm_worlds.somewhere(rng),
    )
    arm_worlds.write(folder, world, rng, poses=poses)
    return folder


def test_a_coupled_arm_is_calibrated_and_its_urdf_is_the_fitted_arm(tmp_path):
    rng = np.random.default_rng(2)
    folder = written(tmp_path / "rec", rng)
    assert Source.open(folder).rig.joint_names == ("lift", "shoulder")
    run = calibrate([folder], tmp_path / "run", Model(GEOMETRY))
    rms = run.summary["rms_mm"]
    assert rms["held_out"] < 1.3 * rms["noise_floor"] < 0.15 < rms["nominal"]
    export(run, tmp_path / "out", ["urdf"])
    fitted = FrameTree(read_arm(tmp_path / "out/arm.urdf", "arm_base", "arm_end"))
    joints = rng.uniform(-0.2, 0.2, (20, 2))
    T = fitted.place("arm_end", joints).Ts_root_frame
    np.testing.assert_allclose(T, Arm.of(run).corrected(joints), atol=1e-8)
    command = Arm.of(run).to_command(joints)
    assert np.isfinite(command.joints).all() and command.off_rad.max() < 0.02


def test_a_joint_that_follows_further_than_drawn_is_named_and_its_urdf_says_how_far(tmp_path):
    rng = np.random.default_rng(3)
    true = ARM.replace('multiplier="-1.5"', 'multiplier="-1.503"')
    true = true.replace('multiplier="0.5"', 'multiplier="0.498"')
    folder = written(tmp_path / "rec", rng, true)
    without = Model(GEOMETRY[:-1])
    diagnosis = diagnose(calibrate([folder], tmp_path / "run", without)).document()
    assert diagnosis["verdict"] == "missing_effect"
    assert [c["effect"] for c in diagnosis["candidates"] if c["step"]] == ["arm_mimic_ratio"]
    run = calibrate([folder], tmp_path / "usual")  # where nobody chooses
    assert run.model["effects"] == [*DEFAULT, "arm_geometry", "arm_mimic_ratio"]
    rms = run.summary["rms_mm"]
    assert rms["held_out"] < 1.3 * rms["noise_floor"] < 0.15
    found = run.solution.part(None).effects["arm_mimic_ratio"]
    assert found.names == ("elbow", "wrist")
    truth = np.array([-0.003, 0.498 * -1.503 - 0.5 * -1.5])  # of the shoulder, which both follow
    assert (np.abs(found.estimate - truth) < 4 * found.sigma).all()
    assert (found.sigma < np.abs(truth) / 4).all()
    export(run, tmp_path / "out", ["urdf", "dh"])
    fitted = FrameTree(read_arm(tmp_path / "out/arm.urdf", "arm_base", "arm_end"))
    assert [edge.joint.factor for edge in fitted.edges[2:4]] == pytest.approx(
        np.add([-1.5, -0.75], found.estimate), abs=1e-12
    )
    joints = rng.uniform(-0.2, 0.2, (20, 2))
    T = fitted.place("arm_end", joints).Ts_root_frame
    # Tilts of 1e-3 and a turn of 6e-4 on one edge are one twist in the fit, a product in the URDF.
    np.testing.assert_allclose(T, Arm.of(run).corrected(joints), atol=1e-6)
    table = yaml.safe_load((tmp_path / "out/dh.yaml").read_text())["calibrated"]
    for T_base_tip, (lift, shoulder) in zip(T, joints, strict=True):
        there = by_table(table, {"lift": lift, "shoulder": shoulder})
        np.testing.assert_allclose(there.as_matrix(), T_base_tip, atol=1e-8)


def by_table(table, read):
    """T_base_tip as the header of dh.yaml has it, of joints that are read."""

    def pose(of):
        turn = Rotation.from_euler("xyz", of["rpy_rad"])
        return RigidTransform.from_components(of["xyz_m"], turn)

    def moved(along_m=(0, 0, 0), about=(0, 0, 0)):
        return RigidTransform.from_components(along_m, Rotation.from_rotvec(about))

    T = pose(table["base"])
    for row in (*table["links"], table["last"]):
        q = read.get(row["joint"], 0.0)
        if "follows" in row:
            q = row["multiplier"] * read[row["follows"]] + row["offset"]
        slid, turned = (q, 0.0) if row["kind"] == "prismatic" else (0.0, q)
        theta, d = row.get("theta_rad", 0.0) + turned, row.get("d_m", 0.0) + slid
        T = T * moved((0, 0, d), (0, 0, theta)) * moved((row.get("a_m", 0.0), 0, 0))
        T = T * moved(about=(row.get("alpha_rad", 0.0), 0, 0))
        T = T * moved(about=(0, row.get("beta_rad", 0.0), 0))
    return T * pose(table["tip"])


def test_one_whose_leader_is_not_in_the_chain_may_go_further_too(tmp_path):
    """What is read is the other, which stands elsewhere on the robot."""
    ends = '<parent link="arm_base"/><child link="aside"/>'
    side = f'<joint name="side" type="continuous">{ends}</joint>'
    drawn = ARM.replace('joint="shoulder"', 'joint="side"').replace('joint="elbow"', 'joint="side"')
    drawn = drawn.replace("</robot>", f'<link name="aside"/>{side}</robot>')
    true = drawn.replace('multiplier="-1.5"', 'multiplier="-1.503"')
    folder = written(tmp_path / "rec", np.random.default_rng(5), true, drawn=drawn)
    run = calibrate([folder], tmp_path / "run")
    found = run.solution.part(None).effects["arm_mimic_ratio"]
    assert found.names == ("elbow", "wrist")
    assert (np.abs(found.estimate - [-0.003, 0.0]) < 4 * found.sigma).all()
    export(run, tmp_path / "out", ["urdf"])
    fitted = FrameTree(read_arm(tmp_path / "out/arm.urdf", "arm_base", "arm_end"))
    joints = np.random.default_rng(6).uniform(-0.2, 0.2, (20, 3))
    T = fitted.place("arm_end", joints).Ts_root_frame
    np.testing.assert_allclose(T, Arm.of(run).corrected(joints), atol=1e-6)


def test_a_joint_that_goes_a_little_with_the_one_before_it_is_named(tmp_path):
    rng = np.random.default_rng(4)
    world = arm_worlds.bent(tmp_path / "rec", "ur10", rng, size=0.3)
    joints = world.draw(rng, 120)
    goes_with = joints + 0.001 * joints[:, [3]] * (np.arange(6) == 4)
    seen = world.seen(goes_with) * arm_worlds.exp(arm_worlds.noise(rng, 120))
    arm_worlds.save(tmp_path / "rec", world, joints, seen)
    diagnosis = diagnose(
        calibrate([tmp_path / "rec"], tmp_path / "run", Model(GEOMETRY))
    ).document()
    assert [c["effect"] for c in diagnosis["candidates"] if c["step"]] == ["arm_joint_coupling"]
    run = calibrate(
        [tmp_path / "rec"], tmp_path / "added", Model([*GEOMETRY, "arm_joint_coupling"])
    )
    found = run.solution.part(None).effects["arm_joint_coupling"]
    truth = 0.001 * (np.array(found.names) == "j5.by_j4")
    assert (np.abs(found.estimate - truth) < 4 * found.sigma).all()
    assert found.sigma.max() < 1e-4
