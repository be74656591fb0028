"""URDF as a tree of links and joints: where an arm begins and ends, its limits, its zeros.

An SRDF names the links between which a group moves; ``joint_limits.yaml`` narrows the limits of
joints; a mapping of joint -> number, as robot_calibration writes it, is added to their zeros.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from chains import se3
from chains.errors import InputError, nearest
from chains.xml import parse_xml

_MOVING = ("revolute", "continuous", "prismatic")


def parse_robot(path: Path, text: str) -> Element:
    """The tree of a URDF's text; InputError, which names `path`, where it is none."""
    robot = parse_xml(text, path, "a URDF file")
    if robot.tag != "robot" or not robot.findall("link"):
        raise InputError(f"{path} is no URDF: it holds no <robot> with links")
    return robot


# -------------------------------------------------------------------------------- base and tip


def arm_ends(path: Path, robot: Element, base: str | None, tip: str | None) -> tuple[str, str, str]:
    """The links between which the arm moves, and what else hangs from its last joint, in words.

    Raises:
        InputError: a link is not in the robot, nothing moves, or it has several arms.
    """
    links = [link.get("name", "") for link in robot.findall("link")]
    for link, flag in ((base, "--base"), (tip, "--tip")):
        if link is not None and link not in links:
            raise InputError(f"{path}: {flag} {link}: there is no such link{nearest(link, links)}")
    more = ""
    if tip is None:
        tip, more = _tip(path, robot, links, base)
    moving = _moving(robot, base, tip)
    if not moving:
        raise InputError(f"{path}: nothing moves between {base or 'the root'} and {tip}")
    return base or _parent(moving[0]), tip, more


def _tip(path: Path, robot: Element, links: Sequence[str], base: str | None) -> tuple[str, str]:
    """The end of the longest chain of moving joints."""
    joints = {link: _moving(robot, None, link) for link in links}
    if base is not None:
        joints = {
            k: v for k, v in joints.items() if base in {_parent(j) for j in v} | {k}
        } or joints
    most = max(map(len, joints.values()))
    if most == 0:
        raise InputError(f"{path}: no joint of it moves; is it the description of an arm?")
    last = {v[-1].get("name"): v[-1] for v in joints.values() if len(v) == most}
    if len(last) > 1:
        ends = ", ".join(_child(joint) for joint in last.values())
        raise InputError(f"{path}: several chains of {most} joints end at {ends}; say --tip LINK")
    tip = _child(next(iter(last.values())))
    beyond = [k for k, v in joints.items() if len(v) == most and k != tip]
    return tip, f"; from {tip} hang {', '.join(beyond)}, one of which --tip may name" * bool(beyond)


def joint_names(robot: Element, base: str, tip: str) -> list[str]:
    """Names of the joints that move between two links, from the base on."""
    return [joint.get("name", "") for joint in _moving(robot, base, tip)]


def _moving(robot: Element, base: str | None, tip: str) -> list[Element]:
    return [joint for joint in _chain(robot, base, tip) if _moves(joint)]


def _chain(robot: Element, base: str | None, tip: str) -> list[Element]:
    """The joints from a link, or the root, to another."""
    above = {_child(joint): joint for joint in robot.findall("joint")}
    chain: list[Element] = []
    link = tip
    while link != base and link in above and above[link] not in chain:
        chain.append(above[link])
        link = _parent(above[link])
    return chain[::-1]


def _moves(joint: Element) -> bool:
    return joint.get("type") in _MOVING and joint.find("mimic") is None


def _parent(joint: Element) -> str:
    element = joint.find("parent")
    return "" if element is None else element.get("link", "")


def _child(joint: Element) -> str:
    element = joint.find("child")
    return "" if element is None else element.get("link", "")


# -------------------------------------------------------------------------------- other files


def group_ends(path: Path, text: str, tip: str | None = None) -> tuple[str, str]:
    """Base and tip of the one group of an SRDF's text that is a chain, and ends at `tip` if given.

    Raises:
        InputError: the text is no XML, or its groups do not tell.
    """
    robot = _srdf(path, text)
    chains = [chain for group in robot.findall("group") for chain in group.findall("chain")]
    fits = [c for c in chains if tip in (None, c.get("tip_link"))]
    if len({(c.get("base_link"), c.get("tip_link")) for c in fits}) != 1:
        ends = ", ".join(sorted({str(c.get("tip_link")) for c in chains})) or "none"
        raise InputError(f"{path}: groups that are chains end at {ends}; say --base and --tip")
    return fits[0].get("base_link", ""), fits[0].get("tip_link", "")


def _srdf(path: Path, text: str) -> Element:
    return parse_xml(text, path, "an SRDF file")


def apply_note(path: Path, data: Any, robot: Element) -> str:
    """Apply a file's limits, or offsets of joints, to the robot; what was done, in words.

    Raises:
        InputError: the data are neither.
    """
    joints = {j.get("name", ""): j for j in robot.findall("joint") if _moves(j)}
    if isinstance(data, dict) and isinstance(data.get("joint_limits"), dict):
        limits = {k: v for k, v in data["joint_limits"].items() if k in joints}
        count = sum(_limit(joints[name], limit) for name, limit in limits.items())
        return f"{path.name}: limits of {count} joints"
    offsets = {k: v for k, v in data.items() if k in joints} if isinstance(data, dict) else {}
    if not offsets or not all(isinstance(v, int | float) for v in offsets.values()):
        raise InputError(
            f"{path}: neither joint_limits nor offsets of joints; joints are {', '.join(joints)}"
        )
    for name, offset in offsets.items():
        _shift(joints[name], float(offset))
    left = [k for k in data if k not in joints]
    more = f"; {', '.join(map(str, left))} are not joints, and not taken" if left else ""
    return f"{path.name}: {len(offsets)} offsets are added to the zeros of joints{more}"


def _limit(joint: Element, said: dict) -> bool:
    """Set a joint's limits where MoveIt's file has some."""
    if not isinstance(said, dict) or not said.get("has_position_limits", "min_position" in said):
        return False
    limit = joint.find("limit")
    limit = ElementTree.SubElement(joint, "limit") if limit is None else limit
    for key, name in (("lower", "min_position"), ("upper", "max_position")):
        limit.set(key, str(said.get(name, limit.get(key, "0"))))
    return True


def _shift(joint: Element, offset: float) -> None:
    """Move a joint's zero: a reading of q then means what q + offset meant."""
    origin, axis = joint.find("origin"), joint.find("axis")
    origin = ElementTree.SubElement(joint, "origin") if origin is None else origin
    xyz, rpy = (np.array(origin.get(k, "0 0 0").split(), float) for k in ("xyz", "rpy"))
    unit = np.array(("1 0 0" if axis is None else axis.get("xyz", "1 0 0")).split(), float)
    turn = joint.get("type") != "prismatic"
    step = np.concatenate([unit, np.zeros(3)] if turn else [np.zeros(3), unit]) * offset
    T = se3.from_xyz_rpy(xyz, rpy) @ se3.exp(step / np.linalg.norm(unit))
    origin.set("xyz", " ".join(f"{v:.12g}" for v in T[:3, 3]))
    origin.set("rpy", " ".join(f"{v:.12g}" for v in se3.to_rpy(T)))
