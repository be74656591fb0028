"""Which small errors of an arm's geometry are its own: complete, and none of them said twice.

Geometry can put a revolute joint's axis wrong in four ways and a prismatic one's in two, and six
more numbers place the tool: N = 4 R + 2 P + 6 describe every arm near the drawn one, and fewer do
not (Mooring, Roth and Driels 1991, Fundamentals of Manipulator Calibration). Here a joint's numbers
are tilts and shifts across its axis, a twist before its motion: the minimal product of exponentials
in local frames (He, Zhao, Yang and Yang 2010, IEEE Trans. Robotics 26(3); Chen, Kao and Yang 2014).
It needs no second convention where axes are parallel, as Denavit and Hartenberg's does.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from chains import se3
from chains.frames import Edge, FrameTree
from chains.se3 import Array

# Less than this share of a direction is new: the others can say it. Of the arms in
# tests/chains/arms.py shares are 0.014 and more or below 1e-9; in a URDF of calibrated values,
# 1 mm and 1 mrad from such drawings, those below 1e-9 become up to 0.01.
NEW = 0.01
# If less than this share of a direction is new, others nearly say it: its value would have to be
# many times as large as the error that it stands for. An axis that passes 25 mm beside the first
# leans by 40 mrad to move along itself by 1 mm. Of those arms shares are 0.06 and less, or 0.16 and
# more.
NEARLY_SAID = 0.1
NO_LENGTH_M = 1e-9  # rounding of an origin that is drawn as none
RANDOM_POSES = 40  # drawn: 240 rows for some seventy columns


@dataclass(frozen=True)
class Slip:
    """One small error of an edge: its name, its unit, and its twist (6,) per unit."""

    edge: str
    name: str
    unit: str
    twist: Array


class Own(NamedTuple):
    """What an arm's geometry can be off by beside its joints' zeros.

    Args:
        lengths: edge -> along which (3,), in the child's frame, its origin may be too long.
        slips: all else.
    """

    lengths: Mapping[str, Array]
    slips: tuple[Slip, ...]


@lru_cache(maxsize=32)
def own_errors(
    tree: FrameTree,
    chains: tuple[tuple[str, ...], ...],
    base_held: bool,
    tips_held: tuple[bool, ...],
) -> Own:
    """Return what an arm's geometry can be off by beside its joints' zeros.

    Of the tilts and shifts across every axis, in order, those are taken for which no zero, no
    length and nothing taken before can stand, wherever the arm is: a QR by blocks at poses drawn
    over all joints (Khalil and Gautier 1991, Int. Conf. Robotics and Automation). Directions for
    which others can nearly stand are taken last, and of such a length the part that is new is
    taken: see `NEARLY_SAID`.

    Args:
        tree: the frames.
        chains: per tip, the edges from the arm's base to it, in order.
        base_held, tips_held: whether other unknowns place the base, and the tool at each tip, six
            numbers each. Where they do not, the first axes and the edges behind the last joints
            have what is then missing.
    """
    arm = tuple(dict.fromkeys(name for chain in chains for name in chain))
    edges = [tree.edges[tree.edge_names.index(name)] for name in arm]
    moving = [i for i, edge in enumerate(edges) if edge.joint is not None]
    if not moving:
        return Own({edge.name: _along(edge) for edge in edges if _along(edge).any()}, ())
    by_base, by_twist, by_joint, by_tools = _columns(tree, chains, edges)
    span = _Span()
    span.take(by_base[:, : 6 * base_held])
    for by_tool, held in zip(by_tools, tips_held, strict=True):
        span.take(by_tool[:, : 6 * held])
    for column in by_joint.T:
        span.take(column[:, None])
    lengths = {}
    for edge, columns in zip(edges, by_twist, strict=True):
        along, by_shift = _along(edge), columns[:, 3:]
        if not along.any():
            continue
        if NEW < span.share(by_shift @ along[:, None]) < NEARLY_SAID:
            told = span.directions(by_shift, NEARLY_SAID)
            along = told @ (told.T @ along)
            along = along / np.linalg.norm(along)
        span.take(by_shift @ along[:, None])
        lengths[edge.name] = along
    behind = [arm.index(name) for chain in chains for name in _behind(tree, chain)]
    ways = [(i, *way) for i in [*moving, *dict.fromkeys(behind)] for way in _ways(edges[i])]
    found: dict[tuple[int, str, str], list[Array]] = {way[:3]: [] for way in ways}
    for least in (NEARLY_SAID, NEW):
        for i, kind, unit, plane in ways:
            found[i, kind, unit] += list((plane @ span.take(by_twist[i] @ plane, least)).T)
    slips = (
        Slip(arm[i], f"{kind}_{letter}", unit, twist)
        for (i, kind, unit), twists in found.items()
        for letter, twist in zip("abc", twists, strict=False)
    )
    return Own(lengths, tuple(slips))


def _along(edge: Edge) -> Array:
    """Return the direction (3,) of an edge's origin, in its child's frame; 0 where it has none."""
    t = edge.T_parent_child[:3, :3].T @ edge.T_parent_child[:3, 3]
    length_m = float(np.linalg.norm(t))
    return t / length_m if length_m > NO_LENGTH_M else np.zeros(3)


def _behind(tree: FrameTree, chain: Sequence[str]) -> Sequence[str]:
    """Return the edge of a chain behind its last joint, if there is one."""
    moves = [tree.edges[tree.edge_names.index(name)].joint is not None for name in chain]
    return chain[len(moves) - moves[::-1].index(True) :][:1] if any(moves) else ()


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
    tree: FrameTree, chains: Sequence[Sequence[str]], edges: Sequence[Edge]
) -> tuple[Array, list[Array], Array, list[Array]]:
    """Return the motion of all tools, in units of the arm's length, by a twist of the base (R, 6),
    by that of each edge (R, 6), by the joints (R, J), and by a twist of each tool itself (R, 6)."""
    length_m = sum(float(np.linalg.norm(edge.T_parent_child[:3, 3])) for edge in edges) or 1.0
    turns = {e.joint.name: e.joint.kind == "revolute" for e in edges if e.joint is not None}
    reach = np.array([np.pi if turns.get(name, True) else length_m for name in tree.joint_names])
    drawn = np.random.default_rng(0).uniform(-reach, reach, (RANDOM_POSES, len(reach)))
    tips = [tree.edges[tree.edge_names.index(chain[-1])].child for chain in chains]
    placed = [tree.place(tip, drawn) for tip in tips]
    unit = np.repeat([1.0, 1.0 / length_m], 3)

    def rows(*motions: Array) -> Array:
        each = [(unit[:, None] * motion).reshape(6 * RANDOM_POSES, -1) for motion in motions]
        return np.vstack(each)

    T_root_base = tree.transform(edges[0].parent, drawn)
    by_base = [se3.adjoint(se3.inverse(p.Ts_root_frame) @ T_root_base) for p in placed]
    at = [tree.edge_names.index(edge.name) for edge in edges]
    by_twist = [rows(*(p.d_twist[:, :, e] for p in placed)) for e in at]
    own = [tree.joint_names.index(name) for name in turns]
    eye, none = np.broadcast_to(np.eye(6), (RANDOM_POSES, 6, 6)), np.zeros((RANDOM_POSES, 6, 6))
    by_tools = [rows(*(eye if tip == own_tip else none for tip in tips)) for own_tip in tips]
    return rows(*by_base), by_twist, rows(*(p.d_joint[:, :, own] for p in placed)), by_tools


class _Span:
    """What columns taken so far can say: an orthonormal basis of them."""

    def __init__(self) -> None:
        self.basis: Array | None = None

    def share(self, column: Array) -> float:
        """Return how much of a column (R, 1) is new."""
        return float(np.linalg.norm(self._new(column)) / max(np.linalg.norm(column), 1e-300))

    def _new(self, columns: Array) -> Array:
        return columns if self.basis is None else columns - self.basis @ (self.basis.T @ columns)

    def directions(self, columns: Array, least: float) -> Array:
        """Return along which directions (n, m) of some columns (R, n) at least such a share is
        new."""
        return self._told(columns, least)[0]

    def take(self, columns: Array, least: float = NEW) -> Array:
        """Take what is new of some columns (R, n), of directions of which at least so much is;
        return it as directions (n, m) of theirs."""
        directions, new = self._told(columns, least)
        self.basis = np.hstack([new, *([] if self.basis is None else [self.basis])])
        return directions

    def _told(self, columns: Array, least: float) -> tuple[Array, Array]:
        """Return these directions, and an orthonormal basis (R, m) of what is new along them."""
        size = np.linalg.norm(columns)
        if not size:
            return np.zeros((columns.shape[1], 0)), np.zeros((len(columns), 0))
        left, share, axes = np.linalg.svd(self._new(columns) / size, full_matrices=False)
        found = share > least
        if found.all():
            return np.eye(columns.shape[1]), left
        directions = axes[found].T
        largest = np.take_along_axis(directions, np.abs(directions).argmax(axis=0)[None], axis=0)
        return directions * np.sign(largest), left[:, found]
