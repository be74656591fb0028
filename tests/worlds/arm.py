"""A six-joint arm of the Schunk LWA 4P's proportions: where its end is, and its URDF."""

from __future__ import annotations

import numpy as np

from .poses import pose, rpy, turn

QUARTER = np.pi / 2
Z, DOWN = (0.0, 0.0, 1.0), (0.0, 0.0, -1.0)
# Joint -> origin m, roll rad, axis, mass kg of the link that it moves, half its range rad.
JOINTS = {
    "joint_1": ((0.0, 0.0, 0.205), 0.0, Z, 2.0, 2.6),
    "joint_2": ((0.0, 0.0, 0.0), QUARTER, Z, 3.1, 0.9),
    "joint_3": ((0.0, 0.35, 0.0), 0.0, DOWN, 2.2, 1.2),
    "joint_4": ((0.0, 0.0, 0.0), -QUARTER, Z, 1.8, 2.2),
    "joint_5": ((0.0, 0.0, 0.305), QUARTER, DOWN, 1.2, 1.1),
    "joint_6": ((0.0, 0.0, 0.0), -QUARTER, Z, 0.6, 2.6),
}
TIP = (0.0, 0.0, 0.075)
ORIGINS = np.array([*(joint[0] for joint in JOINTS.values()), TIP])
MASSES_KG = np.array([joint[3] for joint in JOINTS.values()])
HALF_RANGE_RAD = np.array([joint[4] for joint in JOINTS.values()])
G = 9.81


def lengthened(extra_m: np.ndarray) -> np.ndarray:
    """Origins (7, 3) m, each longer by (7,) m; those of no length stay."""
    length = np.linalg.norm(ORIGINS, axis=1)
    scale = np.divide(extra_m, length, out=np.zeros(len(length)), where=length > 0)
    return ORIGINS * (1 + scale)[:, None]


def along(angles: np.ndarray, origins: np.ndarray = ORIGINS) -> np.ndarray:
    """Poses T_base_link (K, 7, 4, 4) of the six moved links and the tip, at angles (K, 6) rad."""
    T, out = np.broadcast_to(np.eye(4), (len(angles), 4, 4)), []
    for i, (_, roll, axis, _, _) in enumerate(JOINTS.values()):
        T = T @ pose(rpy(roll, 0, 0), origins[i]) @ pose(turn(axis, angles[:, i]), np.zeros(3))
        out.append(T)
    return np.stack([*out, T @ pose(np.eye(3), origins[6])], axis=1)


def gravity_torque(angles: np.ndarray) -> np.ndarray:
    """Torque (K, 6) N m of the links' weights about each joint's axis; masses sit at the joints."""
    links = along(angles)[:, :6]
    axes = np.stack([links[:, i, :3, :3] @ j[2] for i, j in enumerate(JOINTS.values())], axis=1)
    places = links[..., :3, 3]
    weights = -G * MASSES_KG[:, None] * np.array(Z)
    reach = places[:, None] - places[:, :, None]  # [k, i, j]: from joint i to the mass of joint j
    beyond = np.triu(np.ones((6, 6)))[None, :, :, None]
    moment = np.sum(beyond * np.cross(reach, weights), axis=2)
    return np.einsum("kix,kix->ki", axes, moment)


def urdf() -> str:
    """The arm as its maker draws it."""
    lines = ['<?xml version="1.0"?>', '<robot name="worlds_arm">', '  <link name="arm_base"/>']
    parent = "arm_base"
    for i, (name, (xyz, roll, axis, mass, _)) in enumerate(JOINTS.items(), 1):
        origin = f'<origin xyz="{_numbers(xyz)}" rpy="{roll!r} 0 0"/>'
        lines += [
            f'  <link name="arm_{i}"><inertial><origin xyz="0 0 0"/><mass value="{mass}"/>'
            '<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>',
            f'  <joint name="{name}" type="revolute"><parent link="{parent}"/>'
            f'<child link="arm_{i}"/>{origin}<axis xyz="{_numbers(axis)}"/>'
            '<limit lower="-2.97" upper="2.97" effort="100" velocity="1"/></joint>',
        ]
        parent = f"arm_{i}"
    lines += [
        '  <link name="arm_end"/>',
        f'  <joint name="joint_tip" type="fixed"><parent link="{parent}"/><child link="arm_end"/>'
        f'<origin xyz="{_numbers(TIP)}" rpy="0 0 0"/></joint>',
        "</robot>",
    ]
    return "\n".join(lines) + "\n"


def _numbers(xyz: tuple[float, ...]) -> str:
    return " ".join(map(repr, xyz))
