"""An arm as its maker describes it: the chain of joints of a URDF file, and what its links weigh.

URDF: https://wiki.ros.org/urdf/XML/joint. A joint's origin is T_parent_child at zero, its axis
stands in the child's frame, and what is left out has the defaults given there.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Literal
from xml.etree.ElementTree import Element

import numpy as np

from chains import se3
from chains.errors import InputError
from chains.frames import Edge, FrameTree, Joint, unknown_name
from chains.se3 import Array
from chains.serial import SerialChain, cross
from chains.xml import numbers_of, origin_of, read_robot

G = 9.80665  # m/s^2
UPRIGHT = np.array([0.0, 0.0, 1.0])  # up in a root that stands level
_LONGEST_LINK_M = 10.0  # more is taken for millimetres, of a centre of mass as well
_KIND: dict[str | None, Literal["revolute", "prismatic"]] = {
    "revolute": "revolute",
    "continuous": "revolute",
    "prismatic": "prismatic",
}


@dataclass(frozen=True)
class Mass:
    """What weighs ``kg`` (a number, or (K,) by stop) at ``centre_m`` (3,) of a frame."""

    frame: str
    kg: float | Array
    centre_m: Array


def read_arm(urdf_path: str | Path, base: str, *tips: str) -> list[Edge]:
    """Return the edges from link ``base`` to each of some links, one per URDF joint, in order.

    What leads to several tips is there once.

    Edges carry the joint's name, frames the links' names; fixed joints are edges without a Joint,
    continuous ones revolute without limits. One that mimics another moves by the other's name, its
    URDF offset in its origin. Metres and radians. Raises InputError where the file cannot be read,
    a link is missing, no chain leads from base to a tip, a joint's type is not supported, one
    mimics a joint that there is not or itself, or a length can only be millimetres.
    """
    path = Path(urdf_path)
    robot = read_robot(path)
    links = [link.get("name", "") for link in robot.findall("link")]
    for link in (base, *tips):
        if link not in links:
            raise InputError(f"{path}: {unknown_name('link', link, links)}")
    try:
        joints = {id(joint): joint for tip in tips for joint in _chain(robot, base, tip)}
        return _led([_following(_edge(joint), joint, robot) for joint in joints.values()])
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def read_masses(urdf_path: str | Path, base: str, *tips: str) -> list[Mass]:
    """Return what weighs on the arm's joints, link by link, in kg and m.

    The base's own mass weighs on none. A link that hangs beside the chains counts for the link of
    a chain that carries it, its own joints at zero. Raises InputError as ``read_arm`` does.
    """
    path = Path(urdf_path)
    robot = read_robot(path)
    above = {_link(joint, "child"): joint for joint in robot.findall("joint")}
    masses = []
    try:
        chain = {_link(joint, "child") for tip in tips for joint in _chain(robot, base, tip)}
        for link in robot.findall("link"):
            kg = float(numbers_of(link, "inertial/mass", "value", [0.0])[0])
            if kg < 0:
                raise InputError(f"link '{link.get('name')}' weighs {kg:g} kg; 0 or more is wanted")
            centre_m, name = numbers_of(link, "inertial/origin", "xyz", [0, 0, 0]), link.get("name")
            away_m = np.linalg.norm(centre_m)
            if kg and away_m > _LONGEST_LINK_M:
                raise InputError(
                    f"link '{name}': its centre of mass (inertial/origin xyz) lies {away_m:g} m "
                    f"from the link; URDF lengths are in metres (millimetres?)"
                )
            climbed: set[str] = set()
            while kg and name not in chain and name in above and name not in climbed:
                climbed.add(name)
                T_parent_child = origin_of(above[name])
                centre_m = T_parent_child[:3, :3] @ centre_m + T_parent_child[:3, 3]
                name = _link(above[name], "parent")
            if kg and name in chain:
                masses.append(Mass(name, kg, centre_m))
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    return masses


def gravity_moment(
    tree: FrameTree,
    masses: Sequence[Mass],
    edges: Sequence[str],
    joints: Array,
    up: Array = UPRIGHT,
) -> Array:
    """Return the moment of weights about the origins of edges (K, n, 3), N m.

    Of each edge, of all masses beyond it, in the axes of its origin, which its joint has not turned
    yet: ``m = R^T sum((c - o) x (-G kg up))``, with the unit vector ``up`` (3,), or (K, 3) by stop,
    in the tree's root.
    """
    moment = np.zeros((len(joints), len(edges), 3))
    at = [tree.edge_names.index(name) for name in edges]
    parts = [tree.edges[e] for e in at]
    origins = [tree.transform(edge.parent, joints) @ edge.T_parent_child for edge in parts]
    for mass in masses:
        T = tree.transform(mass.frame, joints)
        centre_m = T[:, :3, :3] @ mass.centre_m + T[:, :3, 3]
        weight = -G * np.reshape(mass.kg, (-1, 1)) * up
        beyond = set(tree.path(mass.frame))
        for n in (n for n, e in enumerate(at) if e in beyond):
            about = np.cross(centre_m - origins[n][:, :3, 3], weight)
            moment[:, n] += np.einsum("kji,kj->ki", origins[n][:, :3, :3], about)
    return moment


def gravity_torque(
    tree: FrameTree, masses: Sequence[Mass], joints: Array, up: Array = UPRIGHT
) -> Array:
    """Return what gravity exerts on every joint (K, J), N m about or N along its axis.

    ``tau = -d(potential energy) / dq`` at ``joints`` (K, J), with the unit vector ``up`` (3,), or
    (K, 3) by stop, in the tree's root: a joint that gave way would turn along it.
    """
    torque = np.zeros(np.shape(joints))
    for end, mine in _by_route(tree, masses).items():
        chain = _serial(tree, end)
        ours = [tree.joint_names.index(name) for name in chain.joint_names]
        edges = [len(tree.path(mass.frame)) for mass in mine]
        axes, at_m = chain.axes_and_points(
            joints[:, ours], edges, np.array([mass.centre_m for mass in mine])
        )
        before = np.array([chain.behind[edge][0] for edge in edges])
        beyond = (before > np.arange(len(chain.turns))[:, None]).astype(float)
        # Of all that lies beyond each axis: how much, and the sum of where, weighed by that.
        kg = np.stack([np.broadcast_to(mass.kg, len(joints)) for mass in mine])[:, None]
        whole, first = (np.tensordot(beyond, of, axes=1) for of in (kg, kg * at_m))
        across = cross(axes.direction, first - whole * axes.at_m)
        along = np.where(chain.turns[:, None, None], across, whole * axes.direction)
        torque[:, ours] -= G * (chain.by @ (along * np.atleast_2d(up).T).sum(axis=1)).T
    return torque


def _by_route(tree: FrameTree, masses: Sequence[Mass]) -> dict[str, list[Mass]]:
    """Return the masses along each of as few chains as lead to all, by the frame at its end."""
    found: dict[str, list[Mass]] = {}
    for mass in sorted(masses, key=lambda mass: -len(tree.path(mass.frame))):
        path = tree.path(mass.frame)
        end = next((end for end in found if tree.path(end)[: len(path)] == path), mass.frame)
        found.setdefault(end, []).append(mass)
    return found


@lru_cache(maxsize=32)
def _serial(tree: FrameTree, frame: str) -> SerialChain:
    """Return the chain from the root to a frame."""
    return SerialChain([tree.edges[i] for i in tree.path(frame)])


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
    name, T_parent_child = joint.get("name", ""), origin_of(joint)
    length_m = np.linalg.norm(T_parent_child[:3, 3])
    if length_m > _LONGEST_LINK_M:
        raise InputError(
            f"joint '{name}' sits {length_m:g} m from its parent; URDF lengths are in metres "
            f"(millimetres?)"
        )
    return Edge(
        name=name,
        parent=_link(joint, "parent"),
        child=_link(joint, "child"),
        T_parent_child=T_parent_child,
        joint=_motion(joint),
    )


def _motion(joint: Element) -> Joint | None:
    name, kind = joint.get("name", ""), joint.get("type")
    if kind == "fixed":
        return None
    if kind not in _KIND:
        raise InputError(
            f"joint '{name}' is of type '{kind}'; only fixed, revolute, continuous and prismatic "
            f"joints can be placed"
        )
    axis = numbers_of(joint, "axis", "xyz", [1, 0, 0])
    length = np.linalg.norm(axis)
    if length == 0:
        raise InputError(f"joint '{name}': axis xyz is 0 0 0; it must point somewhere")
    if kind == "continuous" or joint.find("limit") is None:
        return Joint(name, _KIND[kind], axis / length)
    lower = float(numbers_of(joint, "limit", "lower", [0])[0])
    upper = float(numbers_of(joint, "limit", "upper", [0])[0])
    if lower > upper:
        raise InputError(f"joint '{name}': limit lower {lower:g} lies above upper {upper:g}")
    return Joint(name=name, kind=_KIND[kind], axis=axis / length, lower=lower, upper=upper)


def _following(edge: Edge, element: Element, robot: Element) -> Edge:
    """Return the edge as it is, or one that mimics another: ``q = multiplier * q_other + offset``,
    through as many as there are."""
    by_name = {joint.get("name"): joint for joint in robot.findall("joint")}
    factor, shift, seen = 1.0, 0.0, [edge.name]
    while (mimic := element.find("mimic")) is not None:
        shift += factor * float(numbers_of(element, "mimic", "offset", [0.0])[0])
        factor *= float(numbers_of(element, "mimic", "multiplier", [1.0])[0])
        other = mimic.get("joint", "")
        if other not in by_name or other in seen:
            what = "follows itself so" if other in seen else "there is no such joint"
            raise InputError(f"joint '{edge.name}' mimics '{other}', and {what}")
        seen.append(other)
        element = by_name[other]
    if edge.joint is None or len(seen) == 1:
        return edge
    if not factor:
        raise InputError(f"joint '{edge.name}' mimics '{seen[1]}' 0 times; make it a fixed joint")
    T = edge.T_parent_child @ se3.exp(shift * edge.joint.screw)
    joint = replace(edge.joint, name=seen[-1], factor=factor, leads=False, shift=shift)
    return replace(edge, T_parent_child=T, joint=joint)


def _led(edges: list[Edge]) -> list[Edge]:
    """Return the edges; where the joint that others follow is not among them, the first of these
    leads, within its own limits."""
    there = {edge.joint.name for edge in edges if edge.joint is not None and edge.joint.leads}
    for i, edge in enumerate(edges):
        joint = edge.joint
        if joint is not None and joint.name not in there:
            there.add(joint.name)
            limits = sorted((at - joint.shift) / joint.factor for at in (joint.lower, joint.upper))
            joint = replace(joint, leads=True, lower=limits[0], upper=limits[1])
            edges[i] = replace(edge, joint=joint)
    return edges


def _link(joint: Element, role: str) -> str:
    element = joint.find(role)
    link = None if element is None else element.get("link")
    if link is None:
        raise InputError(f"joint '{joint.get('name')}' names no {role} link")
    return link
