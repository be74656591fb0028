"""The simulated rig on paper: a six-joint arm on a mobile base, as URDF and rig.yaml."""

from __future__ import annotations

from typing import Any

import numpy as np

from calib.rig.document import RECORDING_FORMAT
from calib.simulation.spec import Spec

# name, origin xyz (m), origin rpy (rad), axis z, limit (degrees), mass of the link behind it (kg),
# and that link's centre of mass (m). Proportions of a Schunk LWA 4P; its limits rounded down.
_ARM = (
    ("joint_1", (0, 0, 0.205), (0, 0, 0), 1, 170, 3.9, (0, 0.01, -0.02)),
    ("joint_2", (0, 0, 0), (np.pi / 2, 0, 0), 1, 100, 4.1, (0, 0.175, 0.02)),
    ("joint_3", (0, 0.35, 0), (0, 0, 0), -1, 150, 2.6, (0, 0.01, 0.02)),
    ("joint_4", (0, 0, 0), (-np.pi / 2, 0, 0), 1, 170, 2.2, (0, 0, 0.18)),
    ("joint_5", (0, 0, 0.305), (np.pi / 2, 0, 0), -1, 130, 1.5, (0, 0.01, 0.01)),
    ("joint_6", (0, 0, 0), (-np.pi / 2, 0, 0), 1, 170, 0.8, (0, 0, 0.03)),
)
_TIP_M = (0, 0, 0.075)
INCLINOMETER_RAD = 0.0005  # of a fair MEMS inclinometer, assumed
TIP_POINTS = ("tip_1", "tip_2", "tip_3")
# Laser-tracker nests on the mount, well apart and off any line.
_POINTS_M = ((0.12, 0.0, 0.05), (-0.07, 0.1, 0.04), (-0.05, -0.11, 0.11))


def urdf() -> str:
    """The arm's URDF, links `arm_base` to `arm_end`, with masses for what gravity does to it."""
    parts = ['<?xml version="1.0"?>', '<robot name="arm">', '  <link name="arm_base"/>']
    parent = "arm_base"
    for i, (name, xyz, rpy, axis, limit_deg, mass_kg, centre_m) in enumerate(_ARM, start=1):
        limit = np.radians(limit_deg)
        parts += [
            f'  <link name="arm_{i}"><inertial><origin xyz="{_text(centre_m)}" rpy="0 0 0"/>'
            f'<mass value="{mass_kg}"/><inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0"'
            ' izz="0.01"/></inertial></link>',
            f'  <joint name="{name}" type="revolute">'
            f'<parent link="{parent}"/><child link="arm_{i}"/>'
            f'<origin xyz="{_text(xyz)}" rpy="{_text(rpy)}"/><axis xyz="0 0 {axis}"/>'
            f'<limit lower="{-limit:.9g}" upper="{limit:.9g}" effort="100" velocity="1"/></joint>',
        ]
        parent = f"arm_{i}"
    parts += [
        '  <link name="arm_end"/>',
        f'  <joint name="joint_tip" type="fixed"><parent link="{parent}"/><child link="arm_end"/>'
        f'<origin xyz="{_text(_TIP_M)}" rpy="0 0 0"/></joint>',
        "</robot>",
    ]
    return "\n".join(parts) + "\n"


def _text(values: tuple[float, ...]) -> str:
    return " ".join(repr(float(v)) for v in values)


def bodies(spec: Spec) -> list[str]:
    """What the tracker sees of the rig."""
    if spec.tracker == "points":
        return list(TIP_POINTS)
    base = ["base_markers"] if spec.arm else []
    return [*base, "mount_markers"] if spec.tracker else []


def document(spec: Spec) -> dict[str, Any]:
    """What rig.yaml says of the rig that the spec asks for."""
    carrier = "husky-lwa4p" if spec.arm else "handheld"
    name = f"{carrier}-{spec.lidar or 'no-lidar'}"
    rig: dict[str, Any] = {"format": RECORDING_FORMAT.newest, "name": name}
    if spec.lidar:
        rig["lidar"] = {"model": spec.lidar, "frame": "lidar"}
    if spec.arm:
        rig["arm"] = {
            "urdf": "arm.urdf",
            "base": "arm_base",
            "tip": "arm_end",
            "sigma_joint_rad": 0.0001,
        } | ({"passive": list(spec.passive)} if spec.passive else {})
    rig["frames"] = _frames(spec)
    rig["base"] = {"moves": spec.base_moves}
    if spec.tracker:
        fine = spec.tracker == "points"
        rig["tracker"] = {
            "frame": "opti",
            "bodies": bodies(spec),
            "sigma_m": 0.00003 if fine else 0.0002,
            "sigma_rad": 0.0003,
        }
    if spec.levels:
        rig["levels"] = {"frames": list(spec.levels), "sigma_rad": INCLINOMETER_RAD}
    if spec.targets:
        rig["target"] = {
            "sphere_below_lower_marker_m": 0.18,
            "sigma_sphere_m": 0.0006,
            "sigma_marker_m": 0.0002,
        }
    if spec.mesh:
        rig["reference"] = {
            "frame": "faro",
            "mesh": "reference/mesh.ply",
            "faces": "reference/faces.parquet",
            "labels": "reference/labels.yaml",
            "sigma_m": spec.mesh_error_m or 0.0006,
        }
    return rig


def _frames(spec: Spec) -> dict[str, Any]:
    frames: dict[str, Any] = {}
    if "base_markers" in bodies(spec):
        frames["base_markers"] = _frame("base", (0.12, -0.05, 0.32), (0, 0, 0.3), 0.0015, 0.003)
    if spec.arm:
        frames["arm_base"] = _frame("base", (0.18, 0, 0.42), (0, 0, 0), 0.0015, 0.003)
        frames["mount"] = _frame("arm_end", (0, 0, 0.02), (0, 0, 0.5), 0.0008, 0.002)
    if "mount_markers" in bodies(spec):
        frames["mount_markers"] = _frame("mount", (0.03, 0.02, 0.05), (0, 0, 0), 0.0008, 0.002)
    if spec.tracker == "points":
        for name, xyz_m in zip(TIP_POINTS, _POINTS_M, strict=True):
            frames[name] = _frame("mount", xyz_m, (0, 0, 0), 0.0008, 0)
    if spec.lidar:
        frames["lidar"] = _frame("mount", (0, 0, 0.085), (0, 0, -0.7), 0.001, 0.003)
    return frames


def _frame(parent: str, xyz_m: tuple, rpy_rad: tuple, sigma_m: float, sigma_rad: float) -> dict:
    return {
        "parent": parent,
        "xyz_m": [float(v) for v in xyz_m],
        "rpy_rad": [float(v) for v in rpy_rad],
        "sigma_m": sigma_m,
        "sigma_rad": sigma_rad,
    }
