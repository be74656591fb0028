"""An arm as its maker describes it: the chain of joints of a URDF file.

URDF: https://wiki.ros.org/urdf/XML/joint. A joint's origin is T_parent_child at zero, its axis
stands in the child's frame, and what is left out has the defaults given there.
"""

from pathlib import Path
from typing import Literal
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from chains import se3
from chains.errors import InputError
from chains.frames import Edge, Joint, unknown_name
from chains.se3 import Array

_LONGEST_LINK_M = 10.0
_KIND: dict[str | None, Literal["revolute", "prismatic"]] = {
    "revolute": "revolute",
    "continuous": "revolute",
    "prismatic": "prismatic",
}


def read_arm(urdf_path: str | Path, base: str, tip: str) -> list[Edge]:
    """Return the edges from link ``base`` to link ``tip``, one per URDF joint, in order.

    Edges carry the joint's name, frames the links' names; fixed joints are edges without a Joint,
    continuous ones revolute without limits. Metres and radians. Raises InputError where the file
    cannot be read, a link is missing, no chain leads from base to tip, a joint's type is not
    supported, or a length can only be millimetres.
    """
    path = Path(urdf_path)
    robot = _parse(path)
    links = [link.get("name", "") for link in robot.findall("link")]
    for link in (base, tip):
        if link not in links:
            raise InputError(f"{path}: {unknown_name('link', link, links)}")
    try:
        return [_edge(joint) for joint in _chain(robot, base, tip)]
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def _parse(path: Path) -> Element:
    try:
        robot = ElementTree.parse(path).getroot()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); name a URDF file") from None
    except ElementTree.ParseError as error:
        raise InputError(f"{path}: is not XML ({error}); a URDF file is wanted") from None
    if any("xacro" in element.tag for element in robot.iter()):
        raise InputError(f"{path}: still holds xacro; write it out with 'xacro FILE > arm.urdf'")
    if robot.tag != "robot":
        raise InputError(f"{path}: starts with <{robot.tag}>; a URDF file starts with <robot>")
    return robot


def _chain(robot: Element, base: str, tip: str) -> list[Element]:
    """Return the joints from base to tip, found by climbing from tip."""
    above: dict[str, Element] = {}
    for joint in robot.findall("joint"):
        child = _link(joint, "child")
        if child in above:
            both = f"'{above[child].get('name')}' and '{joint.get('name')}'"
            raise InputError(f"link '{child}' is the child of joints {both}; it can hang from one")
        above[child] = joint
    chain: list[Element] = []
    link = tip
    while link != base:
        if link not in above or above[link] in chain:
            raise InputError(
                f"no chain of joints leads from '{base}' to '{tip}'; upwards from '{tip}' it ends "
                f"at '{link}'"
            )
        chain.append(above[link])
        link = _link(above[link], "parent")
    return chain[::-1]


def _edge(joint: Element) -> Edge:
    name = joint.get("name", "")
    xyz = _numbers(joint, "origin", "xyz", [0, 0, 0])
    rpy = _numbers(joint, "origin", "rpy", [0, 0, 0])
    if np.linalg.norm(xyz) > _LONGEST_LINK_M:
        raise InputError(
            f"joint '{name}' sits {np.linalg.norm(xyz):g} m from its parent; URDF lengths are in "
            f"metres (millimetres?)"
        )
    parent, child = _link(joint, "parent"), _link(joint, "child")
    return Edge(name, parent, child, se3.from_xyz_rpy(xyz, rpy), _motion(joint))


def _motion(joint: Element) -> Joint | None:
    name, kind = joint.get("name", ""), joint.get("type")
    if kind == "fixed":
        return None
    if kind not in _KIND:
        raise InputError(
            f"joint '{name}' is of type '{kind}'; only fixed, revolute, continuous and prismatic "
            f"joints can be placed"
        )
    if joint.find("mimic") is not None:
        raise InputError(
            f"joint '{name}' mimics another; only joints that move alone can be placed"
        )
    axis = _numbers(joint, "axis", "xyz", [1, 0, 0])
    length = np.linalg.norm(axis)
    if length == 0:
        raise InputError(f"joint '{name}': axis xyz is 0 0 0; it must point somewhere")
    if kind == "continuous" or joint.find("limit") is None:
        return Joint(name, _KIND[kind], axis / length)
    lower = float(_numbers(joint, "limit", "lower", [0])[0])
    upper = float(_numbers(joint, "limit", "upper", [0])[0])
    if lower > upper:
        raise InputError(f"joint '{name}': limit lower {lower:g} lies above upper {upper:g}")
    return Joint(name, _KIND[kind], axis / length, lower, upper)


def _link(joint: Element, role: str) -> str:
    element = joint.find(role)
    link = None if element is None else element.get("link")
    if link is None:
        raise InputError(f"joint '{joint.get('name')}' names no {role} link")
    return link


def _numbers(joint: Element, tag: str, attribute: str, default: list[float]) -> Array:
    """Return the finite numbers of one attribute, as many as the default has."""
    element = joint.find(tag)
    text = None if element is None else element.get(attribute)
    if text is None:
        return np.array(default, float)
    try:
        values = np.array([float(word) for word in text.split()])
    except ValueError:
        values = np.array([np.nan])
    if values.shape != (len(default),) or not np.isfinite(values).all():
        count = "a number" if len(default) == 1 else f"{len(default)} numbers"
        raise InputError(
            f"joint '{joint.get('name')}': {tag} {attribute} is '{text}'; it must be {count}"
        )
    return values
