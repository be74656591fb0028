"""Poses that an arm can take: within its limits, clear of itself and the room; and a way over them.

The arm is taken for tubes between its joints: the URDF's shapes are not read. What came closer than
that at a stop that was measured is no collision, as the arm stood so.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from calib.planning.room.sight import in_sight
from calib.planning.stops import Poses
from calib.problem.model import Source
from calib.results.reach import joint_range
from chains import se3
from chains.errors import InputError

# Between parts of the arm, and to the room: about the width of arms' tubes, assumed.
ARM_CLEAR_M = 0.1
TUBE_POINTS = 4  # points of each tube that are held against the others
TIMES_DRAWN = 20  # times as many poses as are wanted are drawn at most


def reachable(
    source: Source,
    places: Mapping[str, np.ndarray],
    T_world_reference: np.ndarray,
    count: int,
    rng: np.random.Generator,
    cameras_m: np.ndarray | None = None,
) -> Poses:
    """Random poses of an arm, evenly over its joints' range and the places where its base was.

    Args:
        source: the recording.
        places: location -> T_world_root (4, 4).
        T_world_reference: (4, 4).
        count: how many.
        rng: chance.
        cameras_m: (C, 3) of the tracker, world frame, that are to see every tracked body; None
            where nothing says where they are.

    Raises:
        InputError: the rig has no arm, or it can hardly take any pose there.
    """
    rig, recording = source.rig, source.recording
    if not rig.joint_names:
        raise InputError(
            f"{rig.folder}: the rig has no arm; 'plan' chooses joints of an arm, and cannot say "
            "where to carry a rig"
        )
    names, Ts = list(places), np.stack(list(places.values()))
    measured = recording.joints if len(recording.joints) else np.zeros((1, len(rig.joint_names)))
    low, high = joint_range(rig, measured)
    clear = Clear.of(source, places, T_world_reference)
    found: list[tuple[np.ndarray, np.ndarray]] = []
    for _ in range(TIMES_DRAWN):
        joints = rng.uniform(low, high, (count, len(low)))
        at = rng.integers(len(names), size=count)
        free = clear.of_poses(joints, se3.inverse(T_world_reference) @ Ts[at])
        if cameras_m is not None and free.any():
            some = np.flatnonzero(free)
            tubes = along(clear.points(joints[some])).reshape(len(some), -1, 3)
            poses = Poses(np.array(names)[at[some]], joints[some], Ts[at[some]])
            free[some] = in_sight(source, cameras_m, poses, tubes, T_world_reference)
        found.append((joints[free], at[free]))
        if sum(map(len, (each[0] for each in found))) >= count:
            break
    joints, at = (np.concatenate(parts)[:count] for parts in zip(*found, strict=True))
    if not len(joints):
        raise InputError(
            f"{rig.folder}: none of {TIMES_DRAWN * count} random poses of the arm is clear of "
            "itself and of the mesh where its base was"
            + (", and in the cameras' sight" if cameras_m is not None else "")
        )
    return Poses(np.array(names)[at], joints, Ts[at])


class Clear:
    """What keeps an arm from a pose.

    Args:
        source: the recording.
    """

    def __init__(self, source: Source) -> None:
        self.source, tree = source, source.rig.tree
        tip = source.rig.lidar_frame or max(tree.frames, key=lambda frame: len(tree.path(frame)))
        edges = [tree.edges[i] for i in tree.path(tip)]
        self.frames = [tree.root, *(edge.child for edge in edges)]
        moving = [i for i, edge in enumerate(edges, start=1) if edge.joint is not None]
        self.first = moving[0] + 1 if moving else 1  # of the frames that the joints move
        zero = np.zeros((1, len(tree.joint_names)))
        length = np.linalg.norm(np.diff(self.points(zero), axis=1), axis=2)[0]
        self.tubes = np.flatnonzero(length > ARM_CLEAR_M)
        gap = np.concatenate([[0.0], np.cumsum(length)])
        pairs = [
            (a, b)
            for a in self.tubes.tolist()
            for b in self.tubes.tolist()
            if gap[b] - gap[a + 1] > ARM_CLEAR_M  # those next to each other always touch
        ]
        self.pairs = np.array(pairs, int).reshape(-1, 2)
        self.least_m = np.full(len(self.pairs), ARM_CLEAR_M)
        self.room_m = np.full(len(self.frames) - self.first, ARM_CLEAR_M)

    @classmethod
    def of(
        cls, source: Source, places: Mapping[str, np.ndarray], T_world_reference: np.ndarray
    ) -> Clear:
        """As of a recording, whose own stops are clear."""
        out, recording = cls(source), source.recording
        known = np.array([str(at) in places for at in recording.location], bool)
        if known.any():
            roots = np.stack([places[str(at)] for at in recording.location[known]])
            apart, room = out._gaps(recording.joints[known], se3.inverse(T_world_reference) @ roots)
            out.least_m = np.minimum(out.least_m, apart.min(axis=0, initial=np.inf))
            out.room_m = np.minimum(out.room_m, room.min(axis=0, initial=np.inf))
        return out

    def of_poses(self, joints: np.ndarray, Ts_reference_root: np.ndarray) -> np.ndarray:
        """(n,) whether each pose is clear, and within the mesh's box."""
        apart, room = self._gaps(joints, Ts_reference_root)
        return (apart >= self.least_m).all(axis=1) & (room >= self.room_m).all(axis=1)

    def points(self, joints: np.ndarray) -> np.ndarray:
        """Origins (n, F, 3) of all frames from the root on, in the root's frame."""
        tree = self.source.rig.tree
        placed = [tree.place(frame, joints).Ts_root_frame[:, :3, 3] for frame in self.frames[1:]]
        return np.stack([np.zeros((len(joints), 3)), *placed], axis=1)

    def _gaps(
        self, joints: np.ndarray, Ts_reference_root: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """How far tubes are from each other (n, P), and moved frames from the mesh (n, F), m;
        negative outside of the mesh's box."""
        points = self.points(joints)
        tubes = along(points)
        apart = [
            np.linalg.norm(tubes[:, a, :, None] - tubes[:, b, None], axis=3).min(axis=(1, 2))
            for a, b in self.pairs
        ]
        apart_m = np.stack(apart, axis=1) if apart else np.zeros((len(joints), 0))
        mesh = self.source.reference
        if mesh is None:
            return apart_m, np.full((len(joints), len(self.room_m)), np.inf)
        moved = points[:, self.first :]
        at = np.einsum("nij,nfj->nfi", Ts_reference_root[:, :3, :3], moved)
        at += Ts_reference_root[:, None, :3, 3]
        room_m = mesh.distance_m(at.reshape(-1, 3)).reshape(at.shape[:2])
        low, high = mesh.vertices_m.min(axis=0), mesh.vertices_m.max(axis=0)
        inside = ((at > low) & (at < high)).all(axis=2)
        return apart_m, np.where(inside, room_m, -room_m)


def along(points_m: np.ndarray) -> np.ndarray:
    """Points (n, F - 1, K, 3) along the tubes between frames (n, F, 3)."""
    share = np.linspace(0.0, 1.0, TUBE_POINTS)[:, None]
    return points_m[:, :-1, None] * (1 - share) + points_m[:, 1:, None] * share


def in_order_of_path(
    joints: np.ndarray, location: np.ndarray, locations: Sequence[str]
) -> list[int]:
    """An order (n,) of stops: the base moves as seldom as can be, the arm by short ways.

    At each location the nearest stop comes next, then the way is untangled (2-opt: Croes 1958). A
    way's length is the sum of the joints' Euclidean steps; nothing checks what lies on it.

    Args:
        joints: (n, J) rad or m.
        location: (n,) of each stop.
        locations: in the order in which they are visited.
    """
    order: list[int] = []
    for place in locations:
        here = np.flatnonzero(location == place)
        if len(here):
            from_ = joints[order[-1]] if order else None
            order += here[_way(joints[here], from_)].tolist()
    return order


def _way(joints: np.ndarray, start: np.ndarray | None) -> np.ndarray:
    """A short open way over all of some stops (n, J), from somewhere."""
    step = np.linalg.norm(joints[:, None] - joints[None], axis=2)
    first = 0 if start is None else int(np.argmin(np.linalg.norm(joints - start, axis=1)))
    way, left = [first], set(range(len(joints))) - {first}
    while left:
        way.append(min(sorted(left), key=lambda k: step[way[-1], k]))
        left.remove(way[-1])
    better = True
    while better:
        better = False
        for i in range(1, len(way) - 1):
            for k in range(i + 1, len(way)):
                turned = way[:i] + way[i : k + 1][::-1] + way[k + 1 :]
                if _length(step, turned) < _length(step, way) - 1e-12:
                    way, better = turned, True
    return np.array(way)


def _length(step: np.ndarray, way: Sequence[int]) -> float:
    return float(step[way[:-1], way[1:]].sum())
