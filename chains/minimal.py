"""Which small errors of an arm's geometry are its own: complete, and none of them said twice.

Geometry can put a revolute joint's axis wrong in four ways and a prismatic one's in two, and six
more numbers place the tool: N = 4 R + 2 P + 6 describe every arm near the drawn one, and fewer do
not (Mooring, Roth and Driels 1991, Fundamentals of Manipulator Calibration). Here a joint's numbers
are tilts and shifts across its axis, a twist before its motion: the minimal product of exponentials
in local frames (He, Zhao, Yang and Yang 2010, IEEE Trans. Robotics 26(3); Chen, Kao and Yang 2014).
It needs no second convention where axes are parallel, as Denavit and Hartenberg's does.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from chains.frames import Edge, FrameTree
from chains.se3 import Array

# Less than this share of a direction is new: the others can say it. Of the arms in
# tests/chains/arms.py shares are 0.014 and more or below 1e-9; in a URDF of calibrated values,
# 1 mm and 1 mrad from such drawings, those below 1e-9 become up to 0.01.
NEW = 0.01
RANDOM_POSES = 40  # drawn: 240 rows for some seventy columns


@dataclass(frozen=True)
class Slip:
    """One small error of an edge: its name, its unit, and its twist (6,) per unit."""

    edge: str
    name: str
    unit: str
    twist: Array


@lru_cache(maxsize=32)
def own_slips(
    tree: FrameTree, arm: tuple[str, ...], base_held: bool, tip_held: bool
) -> tuple[Slip, ...]:
    """Return what an arm's geometry can be off by beside its joints' zeros and origins' lengths.

    Of the tilts and shifts across every axis, in order, those are taken for which no zero, no
    length and nothing taken before can stand, wherever the arm is: a QR by blocks at poses drawn
    over all joints (Khalil and Gautier 1991, Int. Conf. Robotics and Automation).

    Args:
        tree: the frames.
        arm: the edges from the arm's base to its tip, in order.
        base_held, tip_held: whether other unknowns place the base and the tool, six numbers each.
            Where they do not, the first axis and the edge behind the last joint have what is then
            missing.
    """
    edges = [tree.edges[tree.edge_names.index(name)] for name in arm]
    moving = [i for i, edge in enumerate(edges) if edge.joint is not None]
    if not moving:
        return ()
    by_twist, by_joint, by_tool = _columns(tree, arm, edges)
    span = _Span()
    span.take(by_twist[0][:, : 6 * base_held])
    span.take(by_tool[:, : 6 * tip_held])
    for column in by_joint.T:
        span.take(column[:, None])
    for edge, columns in zip(edges, by_twist, strict=True):
        span.take(columns[:, 3:] @ (edge.T_parent_child[:3, :3].T @ edge.T_parent_child[:3, 3:]))
    slips = []
    for i in [*moving, *range(moving[-1] + 1, len(edges))[:1]]:
        for kind, unit, plane in _ways(edges[i]):
            directions = plane @ span.take(by_twist[i] @ plane)
            for letter, twist in zip("abc", directions.T, strict=False):
                slips.append(Slip(arm[i], f"{kind}_{letter}", unit, twist))
    return tuple(slips)


def across(axis: Array) -> Array:
    """Return two orthonormal directions (3, 2) across an axis (3,)."""
    return np.linalg.svd(axis[None])[2][1:].T


def _ways(edge: Edge) -> list[tuple[str, str, Array]]:
    """Return how an edge can be off: kind, unit, and twists (6, n). What an axis does to itself is
    its zero, or the next edge's; so is any shift of a prismatic joint."""
    plane = np.eye(3) if edge.joint is None else across(edge.joint.axis)
    none = np.zeros_like(plane)
    ways = [("tilt", "rad", np.vstack([plane, none])), ("shift", "m", np.vstack([none, plane]))]
    return ways[:1] if edge.joint is not None and edge.joint.kind == "prismatic" else ways


def _columns(
    tree: FrameTree, arm: Sequence[str], edges: Sequence[Edge]
) -> tuple[list[Array], Array, Array]:
    """Return the tool's motion, in units of the arm's length, by the twist (R, 6) of each of its
    edges, by its joints (R, J), and by a twist of the tool itself (R, 6)."""
    length_m = sum(float(np.linalg.norm(edge.T_parent_child[:3, 3])) for edge in edges) or 1.0
    turns = {e.joint.name: e.joint.kind == "revolute" for e in edges if e.joint is not None}
    reach = np.array([np.pi if turns.get(name, True) else length_m for name in tree.joint_names])
    drawn = np.random.default_rng(0).uniform(-reach, reach, (RANDOM_POSES, len(reach)))
    placed = tree.place(edges[-1].child, drawn)
    unit = np.repeat([1.0, 1.0 / length_m], 3)

    def rows(motion: Array) -> Array:
        return (unit[:, None] * motion).reshape(6 * RANDOM_POSES, -1)

    by_twist = [rows(placed.d_twist[:, :, tree.edge_names.index(name)]) for name in arm]
    own = [tree.joint_names.index(name) for name in turns]
    by_tool = rows(np.broadcast_to(np.eye(6), (RANDOM_POSES, 6, 6)))
    return by_twist, rows(placed.d_joint[:, :, own]), by_tool


class _Span:
    """What columns taken so far can say: an orthonormal basis of them."""

    def __init__(self) -> None:
        self.basis: Array | None = None

    def take(self, columns: Array) -> Array:
        """Take what is new of some columns (R, n); return it as directions (n, m) of theirs."""
        size = np.linalg.norm(columns)
        if not size:
            return np.zeros((columns.shape[1], 0))
        new = columns if self.basis is None else columns - self.basis @ (self.basis.T @ columns)
        left, share, axes = np.linalg.svd(new / size, full_matrices=False)
        found = share > NEW
        self.basis = np.hstack([left[:, found], *([] if self.basis is None else [self.basis])])
        if found.all():
            return np.eye(columns.shape[1])
        directions = axes[found].T
        largest = np.take_along_axis(directions, np.abs(directions).argmax(axis=0)[None], axis=0)
        return directions * np.sign(largest)
