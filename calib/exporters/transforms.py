"""The fixed frames for those who speak of transforms otherwise: ROS 2, Autoware, Kalibr."""

from __future__ import annotations

from collections.abc import Mapping
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np

from calib.exporters.fitted import FittedRig, for_every_rig
from calib.exporters.written import NO_PLACE_FOR_SIGMAS, Unheld, Written, commented, write_text
from calib.results.solution import FrameEstimate
from chains import se3
from sensors.documents import yaml_text

ROS = (
    "A transform places the child in the parent: p_parent = T_parent_child p_child.",
    "Translations in m, in the parent's axes; rotations as unit quaternions x, y, z, w (Hamilton).",
    "Joints move, so they are not here: robot_state_publisher takes them from arm.urdf.",
    "Where rig.urdf is published, it holds these frames too; publish each frame only once.",
)
AUTOWARE = (
    "x, y, z in m place the sensor in its parent's axes; roll, pitch, yaw in rad turn it about",
    "the parent's fixed x, then y, then z: p_parent = T_parent_sensor p_sensor.",
)
KALIBR = (
    "Directions as in Kalibr, the other way round than elsewhere in rigcal:",
    "T_<child>_<parent> takes coordinates in the parent to those in the child,",
    "p_child = T_child_parent p_parent, as T_cam_imu does of the IMU's; 4 x 4, row by row, in m.",
)
LAUNCH = """\
from launch import LaunchDescription
from launch_ros.actions import Node

# parent, child, translation x y z [m], rotation x y z w
TRANSFORMS = [
{rows}
]
OPTIONS = ["--x", "--y", "--z", "--qx", "--qy", "--qz", "--qw"]


def generate_launch_description():
    return LaunchDescription(
        [
            Node(
                package="tf2_ros",
                executable="static_transform_publisher",
                arguments=[
                    *["--frame-id", parent, "--child-frame-id", child],
                    *[word for pair in zip(OPTIONS, map(repr, numbers)) for word in pair],
                ],
            )
            for parent, child, *numbers in TRANSFORMS
        ]
    )
"""


@for_every_rig
def write_ros2(fit: FittedRig, folder: Path) -> Written:
    """Write the fixed frames as static_transforms.launch.py and as a tf2_msgs/TFMessage in YAML.

    Raises:
        Unheld: the rig has no frames.
    """
    frames, not_held = _frames(fit), [NO_PLACE_FOR_SIGMAS, *_effects_not_held(fit)]
    comment = commented(fit.head(ROS, not_held))
    rows = [
        f"    ({', '.join(map(repr, (frame.parent, name, *_numbers(frame))))}),"
        for name, frame in frames.items()
    ]
    launch = fit.file(folder, "static_transforms.launch.py")
    write_text(launch, comment + LAUNCH.format(rows="\n".join(rows)))
    message = fit.file(folder, "static_transforms.yaml")
    transforms = [_stamped(name, frame) for name, frame in frames.items()]
    write_text(message, comment + yaml_text({"transforms": transforms}))
    return Written([launch, message], not_held)


@for_every_rig
def write_autoware(fit: FittedRig, folder: Path) -> Written:
    """Write sensor_kit_calibration.yaml: the LiDAR, and what else stands on the frame it stands on.

    Where that frame is fixed to the rig's root, sensors_calibration.yaml says how.

    Raises:
        Unheld: the rig has no LiDAR, or it hangs from no frame.
    """
    frames = _frames(fit)
    if fit.rig.lidar_frame not in frames:
        raise Unheld("no LiDAR hangs from a frame of this rig, so it has no sensor kit")
    kit = frames[fit.rig.lidar_frame].parent
    on_kit = {name: frame for name, frame in frames.items() if frame.parent == kit}
    not_held = [
        *(f"{name}: it stands on {f.parent}" for name, f in frames.items() if name not in on_kit),
        NO_PLACE_FOR_SIGMAS,
        *_effects_not_held(fit),
    ]
    conventions = [*AUTOWARE, f"sensor_kit_base_link stands for the rig's frame {kit}."]
    files = {"sensor_kit_calibration.yaml": {"sensor_kit_base_link": _poses(on_kit)}}
    tree = fit.rig.tree
    if any(tree.edges[e].joint for e in tree.path(kit)):
        moves = f"place on the vehicle: the arm moves between it and {kit}; arm.urdf has that"
        not_held.insert(0, moves)
    else:
        T = reduce(np.matmul, (_edge_pose(fit, e) for e in tree.path(kit)), np.eye(4))
        still = FrameEstimate(tree.root, T, np.zeros(3), np.zeros(3))
        conventions.append(f"base_link stands for the rig's frame {tree.root}.")
        files["sensors_calibration.yaml"] = {"base_link": _poses({"sensor_kit_base_link": still})}
    comment = commented(fit.head(conventions, not_held))
    for name, values in files.items():
        write_text(fit.file(folder, name), comment + yaml_text(values))
    return Written([fit.file(folder, name) for name in files], not_held)


@for_every_rig
def write_kalibr(fit: FittedRig, folder: Path) -> Written:
    """Write kalibr.yaml: every fixed frame as T_<child>_<parent>, 4 x 4.

    Raises:
        Unheld: the rig has no frames.
    """
    not_held = [NO_PLACE_FOR_SIGMAS, *_effects_not_held(fit)]
    values = {
        name: {
            "parent": frame.parent,
            f"T_{name}_{frame.parent}": se3.inverse(frame.T_parent_child),
        }
        for name, frame in _frames(fit).items()
    }
    path = fit.file(folder, "kalibr.yaml")
    write_text(path, commented(fit.head(KALIBR, not_held)) + yaml_text(values))
    return Written([path], not_held)


def _frames(fit: FittedRig) -> dict[str, FrameEstimate]:
    if not fit.frames:
        raise Unheld("the rig has no frames besides its sensor's own")
    return fit.frames


def _effects_not_held(fit: FittedRig) -> list[str]:
    """Effects but those that are in the frames as they stand."""
    arm = [name in fit.origins for name in fit.rig.tree.edge_names]
    held = [name for name, bend in fit.fixed.items() if bend.ndim == 2 and not bend[arm].any()]
    return fit.not_held(held)


def _edge_pose(fit: FittedRig, edge: int) -> np.ndarray:
    name = fit.rig.tree.edge_names[edge]
    return fit.origins[name] if name in fit.origins else fit.frames[name].T_parent_child


def _poses(frames: Mapping[str, FrameEstimate]) -> dict[str, dict[str, float]]:
    """Autoware's x, y, z [m], roll, pitch, yaw [rad] of each frame in its parent."""
    keys = ("x", "y", "z", "roll", "pitch", "yaw")
    poses = {}
    for name, frame in frames.items():
        T = frame.T_parent_child
        poses[name] = dict(zip(keys, (*T[:3, 3].tolist(), *se3.to_rpy(T).tolist()), strict=True))
    return poses


def _stamped(name: str, frame: FrameEstimate) -> dict[str, Any]:
    x, y, z, qx, qy, qz, qw = _numbers(frame)
    return {
        "header": {"frame_id": frame.parent},
        "child_frame_id": name,
        "transform": {
            "translation": {"x": x, "y": y, "z": z},
            "rotation": {"x": qx, "y": qy, "z": qz, "w": qw},
        },
    }


def _numbers(frame: FrameEstimate) -> tuple[float, ...]:
    """x, y, z and the quaternion x, y, z, w."""
    w, *xyz = se3.to_quat_wxyz(frame.T_parent_child).tolist()
    return (*frame.T_parent_child[:3, 3].tolist(), *xyz, w)
