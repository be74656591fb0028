"""An arm as URDF or xacro; with it, where wanted, MoveIt's SRDF, its limits, or offsets.

An SRDF names the links between which a group moves; ``joint_limits.yaml`` narrows the limits of
joints; a YAML file of joint -> number, as robot_calibration writes it, is added to their zeros.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from chains import se3
from chains.errors import InputError
from sensors.documents import nearest, read_text, read_yaml
from sensors.readers import xacros
from sensors.readers.base import Arm, Found, Options, Progress

_MOVING = ("revolute", "continuous", "prismatic")


def read_urdf(files: Sequence[Path], options: Options, progress: Progress) -> Found:
    """Read an arm: one URDF or xacro file, and what others say of the same arm.

    Raises:
        InputError: there is not one description, a link is not in it, or it has several arms.
    """
    progress("reading the arm", 0, 1)
    groups = [path for path in files if path.suffix == ".srdf"]
    notes = [path for path in files if path.suffix in (".yaml", ".yml")]
    described = [path for path in files if path not in (*groups, *notes)]
    if len(described) != 1:
        raise InputError(
            f"urdf takes one description of an arm, not {len(described)}: "
            f"{', '.join(map(str, described)) or 'name a .urdf or .xacro file'}"
        )
    text, odd = _text(described[0], options)
    robot = _robot(described[0], text)
    said = []
    for path in notes:
        said += _note(path, robot)
    base, tip = _group(groups[0], options) if groups else (None, None)
    try:
        base, tip, more = _ends(described[0], robot, options.base or base, options.tip or tip)
    except InputError as error:
        raise InputError("; ".join([str(error), *odd])) from None
    names = [j.get("name", "") for j in _chain(robot, base, tip) if _moves(j)]
    said.append(
        f"{described[0].name}: an arm of {len(names)} joints from {base} to {tip}: "
        f"{', '.join(names)}{more}"
    )
    if notes:
        text = ElementTree.tostring(robot, encoding="unicode")
    return Found(arm=Arm(text, base, tip), understood=tuple(said), odd=odd)


def with_ends(where: str, arm: Arm, options: Options) -> Arm:
    """The arm with its base and tip, found where its source does not say them.

    Raises:
        InputError: `where` is no URDF, a link is not in it, or it has several arms.
    """
    if arm.base and arm.tip:
        return arm
    robot = _robot(Path(where), arm.urdf)
    base, tip, _ = _ends(Path(where), robot, options.base or arm.base, options.tip or arm.tip)
    return Arm(arm.urdf, base, tip)


def _text(path: Path, options: Options) -> tuple[str, tuple[str, ...]]:
    text = read_text(path)
    if not text.strip():
        raise InputError(f"{path} is empty; a URDF or xacro file is wanted")
    if path.suffix == ".xacro" or "xmlns:xacro" in text:
        return xacros.write_out(path, options.packages)
    return text, ()


def _robot(path: Path, text: str) -> Element:
    try:
        robot = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise InputError(f"{path} is not XML ({error}); a URDF file is wanted") from None
    if robot.tag != "robot" or not robot.findall("link"):
        raise InputError(f"{path} is no URDF: it holds no <robot> with links")
    return robot


# -------------------------------------------------------------------------------- base and tip


def _ends(path: Path, robot: Element, base: str | None, tip: str | None) -> tuple[str, str, str]:
    """The links between which the arm moves, and what else hangs from its last joint."""
    links = [link.get("name", "") for link in robot.findall("link")]
    for link, flag in ((base, "--base"), (tip, "--tip")):
        if link is not None and link not in links:
            raise InputError(f"{path}: {flag} {link}: there is no such link{nearest(link, links)}")
    more = ""
    if tip is None:
        tip, more = _tip(path, robot, links, base)
    moving = [j for j in _chain(robot, base, tip) if _moves(j)]
    if not moving:
        raise InputError(f"{path}: nothing moves between {base or 'the root'} and {tip}")
    return base or _parent(moving[0]), tip, more


def _tip(path: Path, robot: Element, links: Sequence[str], base: str | None) -> tuple[str, str]:
    """The end of the longest chain of moving joints."""
    joints = {link: [j for j in _chain(robot, None, link) if _moves(j)] for link in links}
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


def _group(path: Path, options: Options) -> tuple[str, str]:
    """Base and tip of the one group of an SRDF that is a chain."""
    robot = _srdf(path)
    chains = [chain for group in robot.findall("group") for chain in group.findall("chain")]
    fits = [c for c in chains if options.tip in (None, c.get("tip_link"))]
    if len({(c.get("base_link"), c.get("tip_link")) for c in fits}) != 1:
        ends = ", ".join(sorted({str(c.get("tip_link")) for c in chains})) or "none"
        raise InputError(f"{path}: groups that are chains end at {ends}; say --base and --tip")
    return fits[0].get("base_link", ""), fits[0].get("tip_link", "")


def _srdf(path: Path) -> Element:
    try:
        return ElementTree.fromstring(read_text(path))
    except ElementTree.ParseError as error:
        raise InputError(f"{path} is not XML ({error}); an SRDF file is wanted") from None


def _note(path: Path, robot: Element) -> list[str]:
    """Apply limits, or offsets of joints, to the robot."""
    data, _ = read_yaml(path)
    joints = {j.get("name", ""): j for j in robot.findall("joint") if _moves(j)}
    if isinstance(data, dict) and isinstance(data.get("joint_limits"), dict):
        limits = {k: v for k, v in data["joint_limits"].items() if k in joints}
        count = sum(_limit(joints[name], limit) for name, limit in limits.items())
        return [f"{path.name}: limits of {count} joints"]
    offsets = {k: v for k, v in data.items() if k in joints} if isinstance(data, dict) else {}
    if not offsets or not all(isinstance(v, int | float) for v in offsets.values()):
        raise InputError(
            f"{path}: neither joint_limits nor offsets of joints; joints are {', '.join(joints)}"
        )
    for name, offset in offsets.items():
        _shift(joints[name], float(offset))
    left = [k for k in data if k not in joints]
    more = f"; {', '.join(map(str, left))} are not joints, and not taken" if left else ""
    return [f"{path.name}: {len(offsets)} offsets are added to the zeros of joints{more}"]


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
