"""An arm whose joints follow each other, from a recording to a calibrated URDF."""

import numpy as np

from calib.effects import GEOMETRY
from calib.evaluation.arm import Arm
from calib.exporters import export
from calib.problem.model import Model, Source
from calib.runs.calibrate import calibrate
from chains.arm import read_arm
from chains.frames import FrameTree

from ..chains.test_mimic import ARM
from . import arm_worlds


def test_a_coupled_arm_is_calibrated_and_its_urdf_is_the_fitted_arm(tmp_path):
    folder, rng = tmp_path / "rec", np.random.default_rng(2)
    folder.mkdir()
    (folder / "arm.urdf").write_text(ARM)
    edges = read_arm(folder / "arm.urdf", "arm_base", "arm_end")
    world = arm_worlds.ArmWorld(
        edges=edges,
        twists={e.name: 1e-3 * rng.normal(size=6) for e in edges},
        zeros={"lift": 2e-3, "shoulder": -3e-3},
        tool=rng.normal(size=6) * np.repeat([0.01, 0.005], 3),
        T_world_base=arm_worlds.somewhere(rng),
    )
    arm_worlds.write(folder, world, rng, poses=100)
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
