"""Joints that follow others: against products of scipy's transforms, and through a fit."""

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from chains import se3
from chains.arm import Mass, gravity_torque, read_arm
from chains.frames import FrameTree
from chains.serial import SerialChain

# A column that a spindle drives, an elbow that turns back as far as the shoulder turns, and a wrist
# that follows the elbow: so the shoulder, through two.
ARM = """<robot name="coupled">
  <link name="arm_base"/><link name="column"/><link name="upper"/><link name="fore"/>
  <link name="hand"/><link name="arm_end"/>
  <joint name="lift" type="prismatic">
    <parent link="arm_base"/><child link="column"/><origin xyz="0.1 0 0.5" rpy="0 0.1 0"/>
    <axis xyz="0 0 1"/><limit lower="-0.2" upper="0.2"/>
  </joint>
  <joint name="shoulder" type="revolute">
    <parent link="column"/><child link="upper"/><origin xyz="0 0 0.3" rpy="0.2 0 0"/>
    <axis xyz="0 1 0"/><limit lower="-1" upper="1"/>
  </joint>
  <joint name="elbow" type="revolute">
    <parent link="upper"/><child link="fore"/><origin xyz="0.4 0 0" rpy="0 0 0.1"/>
    <axis xyz="0 1 0"/><limit lower="-2" upper="2"/>
    <mimic joint="shoulder" multiplier="-1.5" offset="0.2"/>
  </joint>
  <joint name="wrist" type="revolute">
    <parent link="fore"/><child link="hand"/><origin xyz="0.3 0 0"/>
    <axis xyz="1 0 0"/><limit lower="-2" upper="2"/>
    <mimic joint="elbow" multiplier="0.5" offset="0.1"/>
  </joint>
  <joint name="tip" type="fixed">
    <parent link="hand"/><child link="arm_end"/><origin xyz="0.1 0 0"/>
  </joint>
</robot>
"""


def hand(lift, shoulder):
    """T_base_end (4, 4) with the URDF's numbers written out."""
    elbow = -1.5 * shoulder + 0.2
    wrist = 0.5 * elbow + 0.1

    def step(xyz, rpy, moved=(0, 0, 0), turned=(0, 0, 0)):
        origin = RigidTransform.from_components(xyz, Rotation.from_euler("xyz", rpy))
        return origin * RigidTransform.from_components(moved, Rotation.from_rotvec(turned))

    T = step([0.1, 0, 0.5], [0, 0.1, 0], moved=(0, 0, lift))
    T = T * step([0, 0, 0.3], [0.2, 0, 0], turned=(0, shoulder, 0))
    T = T * step([0.4, 0, 0], [0, 0, 0.1], turned=(0, elbow, 0))
    T = T * step([0.3, 0, 0], [0, 0, 0], turned=(wrist, 0, 0))
    return (T * step([0.1, 0, 0], [0, 0, 0])).as_matrix()


@pytest.fixture
def edges(tmp_path):
    (tmp_path / "arm.urdf").write_text(ARM)
    return read_arm(tmp_path / "arm.urdf", "arm_base", "arm_end")


def test_they_move_by_the_joint_that_they_follow(edges):
    tree, chain = FrameTree(edges), SerialChain(edges)
    assert tree.joint_names == chain.joint_names == ("lift", "shoulder")
    joints = np.random.default_rng(0).uniform(-1, 1, (30, 2))
    wanted = [hand(*q) for q in joints]
    placed = tree.place("arm_end", joints)
    np.testing.assert_allclose(placed.Ts_root_frame, wanted, atol=1e-12)
    np.testing.assert_allclose(chain.place(joints), wanted, atol=1e-12)
    step = 1e-6
    for j in range(2):
        moved = [hand(*(q + s * step * np.eye(2)[j])) for s in (1, -1) for q in joints]
        ahead, behind = np.split(np.array(moved), 2)
        own = se3.log(se3.inverse(behind) @ ahead) / (2 * step)
        np.testing.assert_allclose(placed.d_joint[:, :, j], own, atol=1e-8)
        R = placed.Ts_root_frame[:, :3, :3]
        ours = chain.axes(joints).jacobian()[:, :, j].reshape(-1, 2, 3)
        np.testing.assert_allclose(ours, np.matvec(R[:, None], own.reshape(-1, 2, 3)), atol=1e-8)


def test_gravity_pulls_on_the_joint_that_drives_them(edges):
    """Minus the slope of the potential energy, by differences."""
    mass = Mass("arm_end", 3.0, np.array([0.0, 0.1, 0.05]))
    joints = np.random.default_rng(1).uniform(-1, 1, (20, 2))
    torque = gravity_torque(FrameTree(edges), [mass], joints)

    def energy(q):
        return 9.80665 * 3.0 * (hand(*q) @ np.append(mass.centre_m, 1))[2]

    for j in range(2):
        step = 1e-6 * np.eye(2)[j]
        slope = [(energy(q + step) - energy(q - step)) / 2e-6 for q in joints]
        np.testing.assert_allclose(torque[:, j], np.negative(slope), atol=1e-6)


def test_where_the_driver_is_elsewhere_the_first_that_follows_leads(tmp_path):
    (tmp_path / "arm.urdf").write_text(ARM)
    edges = read_arm(tmp_path / "arm.urdf", "upper", "arm_end")
    elbow, wrist = (edge.joint for edge in edges if edge.joint is not None)
    assert elbow.name == wrist.name == "shoulder" and elbow.leads and not wrist.leads
    assert [elbow.lower, elbow.upper] == pytest.approx([-1.2, 2.2 / 1.5])
    assert FrameTree(edges).joint_names == ("shoulder",)


def test_an_origin_gives_back_the_offset_that_its_urdf_has(edges):
    for edge in (e for e in edges if e.joint is not None):
        T = edge.T_parent_child @ edge.joint.unshifted
        rpy = {"lift": (0, 0.1, 0), "shoulder": (0.2, 0, 0), "elbow": (0, 0, 0.1)}
        wanted = Rotation.from_euler("xyz", rpy.get(edge.name, (0, 0, 0))).as_matrix()
        np.testing.assert_allclose(T[:3, :3], wanted, atol=1e-12)
