"""What effects look at, at poses that were not measured: what has to be given, and what follows."""

import numpy as np
import pandas as pd
import pytest

from calib import effects
from calib.effects.own.formula import FormulaEffect
from calib.evaluation.arm import Arm
from calib.evaluation.at_poses import evaluate_at
from calib.problem.model import Model, Source
from calib.results.solution import EffectEstimate
from calib.runs.calibrate import calibrate
from chains.errors import InputError

from . import arm_worlds
from .test_arm import found
from .test_arm_geometry import opened


@pytest.fixture
def folder(tmp_path):
    """A recording of an arm that carries 0, 2 or 4 kg."""
    rng = np.random.default_rng(3)
    opened(tmp_path / "rec", arm_worlds.bent(tmp_path / "rec", "ur10", rng), rng, poses=60)
    table = pd.read_csv(tmp_path / "rec" / "stops.csv")
    table["payload_kg"] = 2.0 * (np.arange(len(table)) % 3)
    table.to_csv(tmp_path / "rec" / "stops.csv", index=False)
    return tmp_path / "rec"


def test_a_payload_that_an_effect_feels_is_to_be_given(folder):
    """Else it would be taken for none."""
    source, rng = Source.open(folder), np.random.default_rng(1)
    joints = rng.uniform(-1, 1, (5, 6))
    part, known, _ = found(source, ["arm_gravity_sag"], rng)
    arm = Arm.as_found(source, part, known)
    with pytest.raises(InputError, match=r"'arm_gravity_sag' feels .* give payload_kg for these"):
        arm.corrected(joints)
    empty, full = (arm.corrected(joints, {"payload_kg": np.full(5, kg)}) for kg in (0.0, 4.0))
    assert np.abs(full - empty)[:, :3, 3].max() > 1e-4
    part, known, _ = found(source, ["arm_joint_offset"], rng)
    stiff = Arm.as_found(source, part, known)
    np.testing.assert_array_equal(
        stiff.corrected(joints), stiff.corrected(joints, {"payload_kg": np.full(5, 4.0)})
    )


def test_a_formula_finds_the_joints_among_the_columns(folder):
    """Those at which the arm is asked for, also while joints to command are sought."""
    source, rng = Source.open(folder), np.random.default_rng(2)
    (before, wrist), joints = source.rig.joint_names[-2:], rng.uniform(-1, 1, (5, 6))
    document = {"name": "coupled", "site": f"joint:{wrist}", "basis": [before]}
    effect = FormulaEffect.read({**document, "unit": "rad/rad", "sigma": 0.01}, folder, {})
    part, _, _ = found(source, [], rng)
    plain = Arm.as_found(source, part, {})
    by = EffectEstimate(unit="rad/rad", names=("0",), estimate=np.array([0.02]), sigma=np.zeros(1))
    part.effects["coupled"] = by
    arm = Arm.as_found(source, part, {"coupled": effect})
    turned = joints.copy()
    turned[:, 5] += 0.02 * joints[:, 4]
    np.testing.assert_allclose(arm.corrected(joints), plain.corrected(turned), atol=1e-12)
    command = arm.to_command(joints)
    there, wanted = arm.corrected(command.joints), arm.drawn.place(joints)
    np.testing.assert_allclose(there, wanted, atol=1e-6)


def test_a_column_that_is_not_given_is_asked_for(folder):
    source, joints = Source.open(folder), np.zeros((2, 6))
    source.columns["elapsed_s"] = np.arange(60.0)
    part, known, _ = found(source, ["mount_creep"], np.random.default_rng(0))
    beyond = Arm.as_found(source, part, known, tip="tool")
    with pytest.raises(InputError, match=r"'mount_creep' looks at column 'elapsed_s', which was"):
        beyond.corrected(joints)
    plain = Arm.as_found(source, part, {})
    arm = Arm.as_found(source, part, known)  # its own tip, which the mount does not carry
    np.testing.assert_array_equal(arm.corrected(joints), plain.corrected(joints))


def test_a_table_of_poses_lacks_the_payload(folder, tmp_path):
    model = Model(tuple(effects.find(n) for n in ("arm_joint_offset", "arm_gravity_sag")))
    run = calibrate([folder], tmp_path / "run", model, "none")
    poses = pd.read_csv(folder / "stops.csv")[["stop", *Source.open(folder).rig.joint_names]]
    poses.to_csv(tmp_path / "poses.csv", index=False)
    with pytest.raises(InputError, match=r"poses\.csv: effect 'arm_gravity_sag' feels"):
        evaluate_at(run, tmp_path / "poses.csv")
    poses.assign(payload_kg=0.0).to_csv(tmp_path / "poses.csv", index=False)
    assert len(evaluate_at(run, tmp_path / "poses.csv").names) == 60


def test_up_is_where_the_recording_had_it(folder):
    """An arm on a wall sags sideways, at poses without levels too."""
    source, rng = Source.open(folder), np.random.default_rng(1)
    part, known, _ = found(source, ["arm_gravity_sag"], rng)
    arm, joints = Arm.as_found(source, part, known), rng.uniform(-1, 1, (5, 6))
    columns = {"payload_kg": np.zeros(5), "up": np.tile([1.0, 0.0, 0.0], (5, 1))}
    sideways = arm.corrected(joints, columns)
    source.columns["up"] = np.tile([1.0, 0.0, 0.0], (60, 1))
    np.testing.assert_allclose(arm.corrected(joints, {"payload_kg": np.zeros(5)}), sideways)
