"""Measurements of ROS-Industrial's industrial_calibration: joints, and a target as a camera saw it.

A YAML mapping from the time of a measurement (s since 1970) to ``target_joints`` (rad or m) and
``pose``, the target's in the camera's frame (x y z m, quaternion). The camera is the tracker.
https://github.com/ros-industrial/industrial_calibration, examples/kinematic_calibration.cpp
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from chains.errors import InputError
from sensors.documents import read_yaml
from sensors.readers import conventions
from sensors.readers.base import Columns, Contents, Options, Progress
from sensors.readers.tables.sheets import seconds
from sensors.stops import POSE


def read_industrial_calibration(
    files: Sequence[Path], options: Options, progress: Progress
) -> Contents:
    """Read measurements, each a stop, in the order of time.

    Raises:
        InputError: a file is of another form, or its camera moves on joints of its own.
    """
    rows: dict[float, Mapping[str, Any]] = {}
    for i, path in enumerate(files):
        progress("reading measurements", i, len(files))
        rows |= _rows(path)
    where = str(files[0])
    stamps = sorted(rows)
    joints = [rows[stamp]["target_joints"] for stamp in stamps]
    names = list(options.joints) or [f"joint_{k + 1}" for k in range(len(joints[0]))]
    if any(len(row) != len(names) for row in joints):
        odd = next(len(row) for row in joints if len(row) != len(names))
        raise InputError(f"{where}: a measurement has {odd} joints, and the arm {len(names)}")
    pose = np.array([[rows[stamp]["pose"][part] for part in POSE] for stamp in stamps], float)
    pose = conventions.poses(f"{where}: target", pose[:, :3], pose[:, 3:])
    time_s, said = seconds(np.array(stamps), None)
    stops: Columns = {"time_s": time_s, **dict(zip(names, np.array(joints, float).T, strict=True))}
    stops |= {f"target.{part}": pose[:, k] for k, part in enumerate(POSE)}
    line = f"{files[0].name}: {len(stamps)} stops, {said}; target is seen from the camera, in m"
    return Contents(stops=stops, understood=(line,))


def _rows(path: Path) -> dict[float, Mapping[str, Any]]:
    data, _ = read_yaml(path)
    if not isinstance(data, dict) or not data:
        raise InputError(f"{path}: a mapping of times to measurements is wanted")
    rows = {}
    for stamp, row in data.items():
        pose = row.get("pose") if isinstance(row, dict) else None
        if not isinstance(pose, dict) or not {*POSE} <= pose.keys() or "target_joints" not in row:
            raise InputError(
                f"{path}: {stamp}: needs target_joints, and a pose of {', '.join(POSE)}"
            )
        joints = row["target_joints"]
        numbers = [*(pose[part] for part in POSE), *(joints if isinstance(joints, list) else "?")]
        if wrong := [n for n in numbers if isinstance(n, bool) or not isinstance(n, int | float)]:
            raise InputError(
                f"{path}: {stamp}: {wrong[0]!r} is no number; target_joints is a list of numbers, "
                f"and pose has one for each of {', '.join(POSE)}"
            )
        if row.get("camera_joints"):
            raise InputError(
                f"{path}: {stamp}: the camera moves on joints, and it must stand still"
            )
        try:
            rows[float(stamp)] = row
        except (ValueError, TypeError, OverflowError):
            raise InputError(f"{path}: '{stamp}' is no time in seconds") from None
    return rows
