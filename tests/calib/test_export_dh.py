"""dh.yaml is the arm of the run: matrix by matrix as its header says, and as the graph has it."""

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import RigidTransform, Rotation

from calib.evaluation.arm import Arm
from calib.exporters import export
from chains.errors import InputError

from . import exports, rigs

EFFECTS = ("arm_link_length", "arm_joint_offset", "arm_geometry")


def pose(xyz_m, rpy_rad):
    return RigidTransform.from_components(xyz_m, Rotation.from_euler("xyz", rpy_rad))


def placed(table, q):
    """T_base_tip as the file's header says."""
    T = pose(table["base"]["xyz_m"], table["base"]["rpy_rad"])
    for link, value in zip(table["links"], q[:-1], strict=True):
        turns = link["kind"] == "revolute"
        T = T * pose([0, 0, 0], [0, 0, link["theta_rad"] + value * turns])
        T = T * pose([0, 0, link["d_m"] + value * (not turns)], [0, 0, 0])
        T = T * pose([link["a_m"], 0, 0], [0, 0, 0]) * pose([0, 0, 0], [link["alpha_rad"], 0, 0])
        T = T * pose([0, 0, 0], [0, link["beta_rad"], 0])
    turns = table["last"]["kind"] == "revolute"
    motion = np.array([0, 0, q[-1]])
    T = T * (pose([0, 0, 0], motion) if turns else pose(motion, [0, 0, 0]))
    return (T * pose(table["tip"]["xyz_m"], table["tip"]["rpy_rad"])).as_matrix()


def test_the_table_is_where_the_arm_is(tmp_path):
    run = exports.found_by_chance([rigs.write(tmp_path / "rec")], EFFECTS)
    done = export(run, tmp_path / "out", ["dh"])
    assert [file.name for file in done.files] == ["dh.yaml"]
    text = (tmp_path / "out/dh.yaml").read_text()
    assert text.startswith("#") and "Rz(theta + q) Tz(d) Tx(a) Rx(alpha) Ry(beta)" in text
    tables, arm = yaml.safe_load(text), Arm.of(run)
    joints = np.random.default_rng(0).uniform(-2, 2, (6, 3))
    chains = {"calibrated": arm.corrected(joints), "drawn": arm.drawn.place(joints)}
    for name, T in chains.items():
        ours = [placed(tables[name], q) for q in joints]
        np.testing.assert_allclose(ours, T, atol=1e-9)
    assert np.abs(chains["calibrated"] - chains["drawn"]).max() > 1e-4


def test_a_rig_without_an_arm_has_none(tmp_path):
    none = {"tracker": None, "target": None, "reference": None}
    run = exports.found_by_chance([rigs.write(tmp_path / "rec", arm=None, frames={}, **none)], ())
    with pytest.raises(InputError, match="--format dh: the rig has no arm"):
        export(run, tmp_path / "out", ["dh"])
