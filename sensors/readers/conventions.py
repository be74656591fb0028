"""How files write poses, brought to what a `Track` has: unit quaternions, z up, NaN = not seen."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from chains.errors import InputError
from sensors.readers.base import Array

FARTHEST = 50.0  # m from the origin at which no tracker sees a body: these are other units
# A choice: the length of a quaternion with two decimals is off by 0.01 at most, that of other
# columns by far more.
_UNIT_WITHIN = 0.02
_ORDERS = {"".join(o) for o in ("xyz", "xzy", "yxz", "yzx", "zxy", "zyx")}
Z_FROM_Y = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""(x, y, z) with y up is (x, -z, y) with z up: a quarter turn about x, so right stays right."""


def poses(where: str, xyz_m: ArrayLike, rotation: ArrayLike, first: str = "w") -> Array:
    """Poses (N, 7) x y z qw qx qy qz; a row with an empty cell or a quaternion of 0 is not seen.

    Args:
        where: names file and body in a complaint.
        xyz_m: (N, 3) m.
        rotation: (N, 4) quaternions, or (N, 3, 3) matrices.
        first: "w" or "x": which part of the quaternion stands first.

    Raises:
        InputError: a quaternion is not of length 1, or no pose is ever seen.
    """
    xyz, quat = np.asarray(xyz_m, float), np.asarray(rotation, float)
    quat = quat if first == "w" else quat[:, [3, 0, 1, 2]]
    with np.errstate(invalid="ignore"):
        length = np.linalg.norm(quat, axis=1)
        seen = np.isfinite(xyz).all(axis=1) & (length > 0)
        wrong = seen & (np.abs(length - 1) > _UNIT_WITHIN)
    if wrong.any():
        row = int(np.argmax(wrong))
        raise InputError(
            f"{where}: row {row + 1} has a quaternion of length {length[row]:.3g}, and a rotation "
            "has 1; are these the right columns, in the right order?"
        )
    pose = np.full((len(xyz), 7), np.nan)
    pose[seen, :3], pose[seen, 3:] = xyz[seen], quat[seen] / length[seen, None]
    return pose


def quaternions(where: str, angles_rad: ArrayLike, order: str | None) -> Array:
    """Quaternions (N, 4) w x y z of Euler angles (N, 3) about x, y and z; NaN stays NaN.

    Args:
        where: names file and body in a complaint.
        angles_rad: the columns rx, ry, rz.
        order: as scipy writes it: "XYZ" about the moved axes, "xyz" about the fixed ones.

    Raises:
        InputError: no order is given, or none of the twelve.
    """
    if order is None or order.lower() not in _ORDERS or order not in (order.lower(), order.upper()):
        fault = "no order is given" if order is None else f"'{order}' is no order"
        raise InputError(
            f"{where}: rotations are Euler angles, and {fault}; say --euler XYZ (about the moved "
            "axes), xyz (about the fixed ones), or another order"
        )
    angles = np.asarray(angles_rad, float)
    seen = np.isfinite(angles).all(axis=1)
    quat = np.full((len(angles), 4), np.nan)
    in_order = angles[seen][:, ["xyz".index(axis) for axis in order.lower()]]
    if seen.any():
        quat[seen] = Rotation.from_euler(order, in_order).as_quat(scalar_first=True)
    return quat


def z_up(pose: ArrayLike) -> Array:
    """Poses (N, 7), or points (N, 3), of a world whose y is up, in one whose z is up."""
    pose = np.asarray(pose, float)
    turned = pose.copy()
    turned[:, :3] = pose[:, :3] @ Z_FROM_Y.T
    if pose.shape[1] == 7:
        seen = np.isfinite(pose).all(axis=1)
        body = Rotation.from_quat(pose[seen, 3:], scalar_first=True)
        turned[seen, 3:] = (Rotation.from_matrix(Z_FROM_Y) * body).as_quat(scalar_first=True)
    return turned


def check_metres(where: str, xyz_m: ArrayLike, unit: str | None) -> None:
    """Refuse positions that no tracker sees, unless somebody said what unit they are in.

    Raises:
        InputError: nobody did, and one of them lies beyond `FARTHEST`; the flag is --length-unit.
    """
    size = np.abs(np.asarray(xyz_m, float))
    size = size[np.isfinite(size)]
    if unit is None and size.max(initial=0.0) > FARTHEST:
        raise InputError(
            f"{where}: a position is {size.max():.0f} from the origin, which looks like "
            "millimetres; say --length-unit mm, cm or m"
        )


def axis_up(choice: str | None, said: str | None) -> bool:
    """Whether y points up: as the flag says, or else the file."""
    return (choice or said) == "y"
