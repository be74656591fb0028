"""Reads the public UR10 data set of example 06 into recordings: an arm, a tracker, no LiDAR."""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

SERIES = {"A": "Series_A/measurements_grid.csv", "D": "Series_D/measurements_iso_cubes.csv"}
# d, a (m) and alpha (rad) of the rows of Denavit and Hartenberg that the maker publishes; mass (kg)
# and how far out along x and z it hangs (m), from ros-industrial's ur_description. Tool: unknown.
JOINTS = {
    "shoulder_pan_joint": (0.1273, 0, np.pi / 2, 7.778, 0, 0),
    "shoulder_lift_joint": (0, -0.612, 0, 12.93, -0.388, 0.151),
    "elbow_joint": (0, -0.5723, 0, 3.87, -0.198, 0.061),
    "wrist_1_joint": (0.163941, 0, np.pi / 2, 1.96, 0, 0.164),
    "wrist_2_joint": (0.1157, 0, -np.pi / 2, 1.96, 0, 0.116),
    "wrist_3_joint": (0.0922, 0, 0, 0.202, 0, 0.092),
}
RIG = """\
arm: {urdf: arm.urdf, base: arm_base, tip: arm_end, sigma_joint_rad: 0}
frames:
  arm_base: {parent: base, xyz_m: [0, 0, 0], rpy_rad: [0, 0, 0], sigma_m: 0, sigma_rad: 0}
  mount_markers: {parent: arm_end, xyz_m: [0, 0, 0.109], rpy_rad: [0, 0, -1.5708],
                  sigma_m: 0.02, sigma_rad: 0.02}
base: {moves: never}
tracker: {frame: opti, bodies: [mount_markers], sigma_m: 0.00005, sigma_rad: 0.0003}
"""


def recording(data: Path, series: str, folder: Path, most: int) -> Path:
    """Write a series as a recording; of more poses than so many some, evenly spread."""
    head, *rows = (data / SERIES[series]).read_text("utf-8-sig").replace(",", ".").splitlines()
    table = dict(zip(head.split(";"), np.loadtxt(rows, delimiter=";").T, strict=True))
    order = np.argsort(table["Timestamp"], kind="stable")  # those of D are ruined, and all alike
    order = order[np.linspace(0, len(order) - 1, min(most, len(order))).astype(int)]
    angles = np.stack([table[f"measurement_r{axis}"] for axis in "xyz"], axis=1)
    quat = Rotation.from_euler("XYZ", angles, degrees=True).as_quat(scalar_first=True).T
    columns = {"time_s": 4.0 * np.argsort(np.argsort(table["Timestamp"], kind="stable"))}
    columns |= {joint: table[joint] for joint in JOINTS}
    columns["temperature_c"] = table["measurement_temperature"]
    columns |= {f"mount_markers.{x}": table[f"measurement_{x}"] / 1000 for x in "xyz"}
    columns |= {f"mount_markers.q{x}": q for x, q in zip("wxyz", quat, strict=True)}
    lines = [",".join(["stop", "location", *columns])]
    for k, row in enumerate(np.stack([c[order] for c in columns.values()], axis=1).tolist()):
        lines.append(",".join([f"p{k:05}", f"L{12 * k // len(order):02}", *map(repr, row)]))
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "stops.csv").write_text("\n".join([*lines, ""]))
    (folder / "rig.yaml").write_text(f"name: ur10-{series}\n{RIG}")
    (folder / "arm.urdf").write_text(_urdf())
    return folder


def _urdf() -> str:
    """The arm: each row's fixed part is the origin of the joint after it."""
    text, parent = '<link name="arm_base"/>', "arm_base"
    xyz, roll = (0, 0, 0), 0
    for joint, (d, a, alpha, mass, x, z) in JOINTS.items():
        link = f"link_of_{joint}"
        text += f'<link name="{link}"><inertial><origin xyz="{x} 0 {z}"/><mass value="{mass}"/>'
        text += f'</inertial></link><joint name="{joint}" type="revolute"><axis xyz="0 0 1"/>'
        text += f'<parent link="{parent}"/><child link="{link}"/>{_origin(xyz, roll)}'
        text += '<limit lower="-6.3" upper="6.3" effort="0" velocity="0"/></joint>'
        parent, xyz, roll = link, (a, 0, d), alpha
    text += f'<link name="arm_end"/><joint name="flange" type="fixed"><parent link="{parent}"/>'
    return f'<robot name="ur10">{text}<child link="arm_end"/>{_origin(xyz, roll)}</joint></robot>'


def _origin(xyz: tuple[float, float, float], roll: float) -> str:
    return f'<origin xyz="{xyz[0]} {xyz[1]} {xyz[2]}" rpy="{roll} 0 0"/>'
