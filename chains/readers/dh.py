"""Tables of Denavit and Hartenberg as URDF: each row a joint that moves about or along z.

Standard rows (Denavit and Hartenberg 1955): T = Rz(theta + q) Tz(d) Tx(a) Rx(alpha). Modified rows
(Craig, Introduction to Robotics, 3.4): T = Rx(alpha) Tx(a) Rz(theta + q) Tz(d). What stands before
a joint's motion is the origin of its URDF joint; what stands after it belongs to the next origin.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal
from xml.etree import ElementTree

import numpy as np

from chains import se3
from chains.se3 import Array


@dataclass(frozen=True)
class DhRow:
    """One joint: a, d in m, alpha, theta in rad; what its link weighs, in its frame.

    That frame turns with the joint, its z along the axis and its origin where the joint's is.
    """

    name: str
    a_m: float
    alpha_rad: float
    d_m: float
    theta_rad: float = 0.0
    kind: Literal["revolute", "prismatic"] = "revolute"
    lower: float = -2 * np.pi
    upper: float = 2 * np.pi
    mass_kg: float = 0.0
    centre_m: tuple[float, float, float] = (0.0, 0.0, 0.0)


def origins(rows: Sequence[DhRow], modified: bool) -> tuple[list[Array], Array]:
    """T_parent_joint (4, 4) of every joint at its zero, and T_last_tip behind the last."""
    placed, before = [], np.eye(4)
    for row in rows:
        link = se3.from_xyz_rpy([row.a_m, 0, 0], [row.alpha_rad, 0, 0])
        turn = se3.from_xyz_rpy([0, 0, 0], [0, 0, row.theta_rad])
        shift = se3.from_xyz_rpy([0, 0, row.d_m], [0, 0, 0])
        along = row.kind == "prismatic"  # all but the motion along z commutes with it
        fixed = turn @ shift if along else turn
        placed.append(before @ link @ fixed if modified else before @ fixed)
        after = np.eye(4) if along else shift
        before = after if modified else after @ link
    return placed, before


def to_urdf(
    name: str, rows: Sequence[DhRow], modified: bool, base: str = "arm_base", tip: str = "arm_end"
) -> str:
    """The URDF text of an arm, from link `base` to link `tip`; metres and radians."""
    robot = ElementTree.Element("robot", name=name)
    ElementTree.SubElement(robot, "link", name=base)
    placed, end = origins(rows, modified)
    parent = base
    for row, T in zip(rows, placed, strict=True):
        child = f"{row.name}_link"
        link = ElementTree.SubElement(robot, "link", name=child)
        if row.mass_kg:
            inertial = ElementTree.SubElement(link, "inertial")
            ElementTree.SubElement(inertial, "origin", xyz=_words(row.centre_m))
            ElementTree.SubElement(inertial, "mass", value=repr(float(row.mass_kg)))
        joint = _joint(robot, row.name, row.kind, parent, child, T)
        ElementTree.SubElement(joint, "axis", xyz="0 0 1")
        limits = {"lower": row.lower, "upper": row.upper, "effort": 0.0, "velocity": 0.0}
        ElementTree.SubElement(joint, "limit", {k: repr(float(v)) for k, v in limits.items()})
        parent = child
    ElementTree.SubElement(robot, "link", name=tip)
    _joint(robot, f"{tip}_joint", "fixed", parent, tip, end)
    ElementTree.indent(robot)
    return ElementTree.tostring(robot, encoding="unicode") + "\n"


def _joint(
    robot: ElementTree.Element, name: str, kind: str, parent: str, child: str, T: Array
) -> ElementTree.Element:
    joint = ElementTree.SubElement(robot, "joint", name=name, type=kind)
    ElementTree.SubElement(joint, "parent", link=parent)
    ElementTree.SubElement(joint, "child", link=child)
    ElementTree.SubElement(joint, "origin", xyz=_words(T[:3, 3]), rpy=_words(se3.to_rpy(T)))
    return joint


def _words(values: Sequence[float]) -> str:
    return " ".join(repr(float(value)) for value in values)
