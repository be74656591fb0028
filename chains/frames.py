"""A tree of frames: where each frame is, and how that changes with every edge and joint."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from chains import se3
from chains.errors import InputError
from chains.se3 import Array


@dataclass(frozen=True)
class Joint:
    """One moving axis: name, kind, unit axis (3,) in the child's frame, limits in rad or m.

    Several edges may move by one name, each by ``factor`` times that joint's value: the one that
    leads, and those that follow it (mimic). ``shift`` is what a follower's origin has of the offset
    that its URDF gives.
    """

    name: str
    kind: Literal["revolute", "prismatic"]
    axis: Array
    lower: float = -np.inf
    upper: float = np.inf
    factor: float = 1.0
    leads: bool = True
    shift: float = 0.0

    @property
    def unit(self) -> str:
        """Return the unit of its motion."""
        return "rad" if self.kind == "revolute" else "m"

    @property
    def screw(self) -> Array:
        """Return the tangent (6,) of the motion per radian or metre of the joint's value."""
        return self.factor * self.along

    @property
    def along(self) -> Array:
        """Return the tangent (6,) of the motion per radian or metre that the axis itself goes."""
        parts = [self.axis, np.zeros(3)]
        return np.concatenate(parts if self.kind == "revolute" else parts[::-1])

    @property
    def unshifted(self) -> Array:
        """Return what takes the shift out of a follower's origin again, (4, 4)."""
        return se3.exp(-self.shift * self.along) if self.shift else np.eye(4)


@dataclass(frozen=True)
class Edge:
    """One body fixed or jointed to another: ``T_parent_child @ exp(twist) @ motion(q)``.

    The twist, by which the true edge differs from the drawn one, sits before the motion.
    """

    name: str
    parent: str
    child: str
    T_parent_child: Array
    joint: Joint | None = None


@dataclass(frozen=True)
class Placement:
    """One frame at K stops: ``Ts_root_frame`` (K, 4, 4) and its derivatives.

    ``d_twist`` (K, 6, E, 6) by the twist of every edge and ``d_joint`` (K, 6, J) by every joint
    give the increment on the right, in the frame's own axes, in rad and m per rad or m; they are
    zero for what does not lie between root and frame.
    """

    Ts_root_frame: Array
    d_twist: Array
    d_joint: Array


@dataclass(frozen=True)
class _Path:
    """What ``place`` needs of the n edges from the root to one frame, m of them moving."""

    edges: NDArray[np.int64]  # (n,) index among the tree's edges
    Ts_parent_child: Array  # (n, 4, 4)
    moving: NDArray[np.int64]  # (m,) place among the path's edges
    joints: NDArray[np.int64]  # (m,) index among the tree's joints
    screws: Array  # (m, 6)


class FrameTree:
    """Frames joined by edges into one tree, each frame hanging from one parent.

    ``edges`` keep their order; ``joint_names`` are the moving joints, parents before children.
    ``root`` is needed only where there is no edge. Raises InputError for two roots, a loop, a
    frame with two parents, or a name used twice.
    """

    def __init__(self, edges: Iterable[Edge], root: str | None = None) -> None:
        self.edges = tuple(edges)
        self.edge_names = tuple(edge.name for edge in self.edges)
        _refuse_twice(self.edge_names, "edge")
        self.root = _find_root(self.edges, root)
        routes = _routes(self.edges, self.root)
        self.frames = tuple(routes)
        order = dict.fromkeys(i for route in routes.values() for i in route)
        joints = [joint for i in order if (joint := self.edges[i].joint) is not None]
        self.joint_names = tuple(dict.fromkeys(joint.name for joint in joints))
        _refuse_twice([joint.name for joint in joints if joint.leads], "joint")
        self._paths = {frame: self._prepare(route) for frame, route in routes.items()}

    def _prepare(self, route: Sequence[int]) -> _Path:
        edges = [self.edges[i] for i in route]
        moving = [i for i, edge in enumerate(edges) if edge.joint is not None]
        joints = [joint for edge in edges if (joint := edge.joint) is not None]
        return _Path(
            edges=np.array(route, np.int64),
            Ts_parent_child=np.array([edge.T_parent_child for edge in edges]).reshape(-1, 4, 4),
            moving=np.array(moving, np.int64),
            joints=np.array([self.joint_names.index(joint.name) for joint in joints], np.int64),
            screws=np.array([joint.screw for joint in joints]).reshape(-1, 6),
        )

    def _find(self, frame: str) -> _Path:
        if frame not in self._paths:
            raise InputError(unknown_name("frame", frame, self.frames))
        return self._paths[frame]

    def path(self, frame: str) -> tuple[int, ...]:
        """Return the indices of the edges from the root to ``frame``; InputError if unknown."""
        return tuple(self._find(frame).edges.tolist())

    def _along(
        self, frame: str, joints: ArrayLike, twists: ArrayLike | None
    ) -> tuple[_Path, Array, Array | None]:
        """The way to a frame, the joints, and the twists along it."""
        joints = np.asarray(joints, float)
        if joints.ndim != 2 or joints.shape[1] != len(self.joint_names):
            raise ValueError(f"joints must be (K, {len(self.joint_names)}), not {joints.shape}")
        path = self._find(frame)
        return path, joints, None if twists is None else np.asarray(twists, float)[:, path.edges]

    def transform(self, frame: str, joints: ArrayLike, twists: ArrayLike | None = None) -> Array:
        """Return Ts_root_frame (K, 4, 4) alone, for what `place` takes and as it raises."""
        return _chain(*self._along(frame, joints, twists))[0]

    def place(self, frame: str, joints: ArrayLike, twists: ArrayLike | None = None) -> Placement:
        """Return where ``frame`` is at K stops, and its derivatives by edge twist and joint.

        ``joints`` (K, J) in rad or m, ordered as ``joint_names``. ``twists`` (K, E, 6), or
        (1, E, 6) where all stops share them, ordered as ``edges``; none means zero.

        With S what follows the twist on the path, d/d(twist) = Ad(S^-1) right_jacobian(twist) and
        d/dq = Ad(S^-1) screw, as a motion leaves its own screw in place. Raises InputError for an
        unknown frame, naming the nearest, and ValueError for a wrong number of joints.
        """
        path, joints, xi = self._along(frame, joints, twists)
        Ts_root_frame, Ts_twist_frame = _chain(path, joints, xi)
        to_frame = se3.adjoint(se3.inverse(Ts_twist_frame))
        d_joint = np.zeros((len(joints), 6, len(self.joint_names)))
        by_axis = np.matvec(to_frame[:, path.moving], path.screws).mT
        np.add.at(d_joint, (..., path.joints), by_axis)  # several axes may move by one joint
        d_twist = np.zeros((len(joints), 6, len(self.edges), 6))
        if xi is not None:
            to_frame = to_frame @ se3.right_jacobian(xi)
        d_twist[:, :, path.edges] = to_frame.swapaxes(1, 2)
        return Placement(Ts_root_frame, d_twist, d_joint)


def _chain(path: _Path, joints: Array, xi: Array | None) -> tuple[Array, Array]:
    """Return Ts_root_frame (K, 4, 4) and, from behind each edge's twist, (K, n, 4, 4)."""
    motions = se3.exp(joints[:, path.joints, None] * path.screws)
    motion_of = {edge: motions[:, m] for m, edge in enumerate(path.moving.tolist())}
    origins = path.Ts_parent_child[None]
    if xi is not None:
        origins = origins @ se3.exp(xi)
    behind = np.empty((len(joints), len(path.edges), 4, 4))
    T = np.broadcast_to(np.eye(4), (len(joints), 4, 4))
    for i in reversed(range(len(path.edges))):
        behind[:, i] = motion_of[i] @ T if i in motion_of else T
        T = origins[:, i] @ behind[:, i]
    return T, behind


def unknown_name(kind: str, name: str, known: Iterable[str]) -> str:
    """Return the sentence that refuses ``name`` and offers the nearest of the known ones."""
    known = list(known)
    nearest = get_close_matches(name, known, n=1, cutoff=0)
    hint = f"did you mean '{nearest[0]}'?" if nearest else "there is none"
    return f"{kind} '{name}' is unknown; {hint} (known: {', '.join(known) or 'none'})"


def _refuse_twice(names: Sequence[str], kind: str) -> None:
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"{kind} '{name}' is given twice; every {kind} needs its own name")


def _find_root(edges: Sequence[Edge], root: str | None) -> str:
    """Return the one frame without a parent."""
    parent_of: dict[str, str] = {}
    for edge in edges:
        if edge.child in parent_of:
            raise InputError(
                f"frame '{edge.child}' has two parents, '{parent_of[edge.child]}' and "
                f"'{edge.parent}'; a frame hangs from one"
            )
        parent_of[edge.child] = edge.parent
    if root in parent_of:
        raise InputError(f"frame '{root}' cannot be the root; it hangs from '{parent_of[root]}'")
    named = [] if root is None else [root]
    frames = dict.fromkeys([*named, *parent_of.values()])
    roots = [frame for frame in frames if frame not in parent_of]
    if len(roots) > 1:
        raise InputError(
            f"frames {_quoted(roots)} have no parent; join them into one tree, with one root"
        )
    if not frames:
        raise InputError("a tree without edges has no root; name the frame that stands alone")
    if not roots:
        raise InputError(f"frames {_quoted(parent_of)} form a loop; one must have no parent")
    return roots[0]


def _routes(edges: Sequence[Edge], root: str) -> dict[str, tuple[int, ...]]:
    """Return the edges from the root to every frame, depth first."""
    leaving: dict[str, list[int]] = {}
    for i, edge in enumerate(edges):
        leaving.setdefault(edge.parent, []).append(i)
    routes: dict[str, tuple[int, ...]] = {}
    waiting: list[tuple[str, tuple[int, ...]]] = [(root, ())]
    while waiting:
        frame, route = waiting.pop()
        routes[frame] = route
        waiting += [(edges[i].child, (*route, i)) for i in reversed(leaving.get(frame, []))]
    loop = [edge.child for edge in edges if edge.child not in routes]
    if loop:
        raise InputError(f"frames {_quoted(loop)} form a loop; one of them must hang from '{root}'")
    return routes


def _quoted(names: Iterable[str]) -> str:
    return ", ".join(f"'{name}'" for name in names)
