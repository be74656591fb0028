"""What keeps an arm from a pose: its own links, and the room.

Links are capsules about the shapes of the URDF, those to be collided with before those to be seen;
where a link has none, it is a tube from its joint to the next. What came closer than the clearance
at a stop that was measured is no collision, as the arm stood so.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from calib.planning.room.capsules import Capsules, about, segments_apart_m
from calib.problem.model import Source
from calib.results.reach import joint_range
from calib.rig import Rig
from calib.rig.shapes import arm_shapes
from chains import se3
from chains.errors import InputError

# Between lines from joint to joint, and from them to the room: about the width of arms' tubes,
# assumed.
TUBE_CLEAR_M = 0.1
# Between shapes, and from them to the room: what an arm that is not calibrated yet may be off by,
# and what the points that stand for a shape miss of it; assumed.
SHAPE_CLEAR_M = 0.02
TUBE_RADIUS_M = 0.05  # of a tube in a line of sight
# Share of random poses at which two parts touch, from which on that is how the arm is built: as
# MoveIt's setup assistant has it.
BUILT_SO, BUILT_SO_POSES = 0.95, 200


@dataclass(frozen=True)
class InTheWay:
    """An arm in lines of sight: points (n, K, 3) along its parts, in the root's frame, and how far
    around each (K,) it reaches, m."""

    points_m: np.ndarray
    radius_m: np.ndarray


class Clear:
    """What keeps an arm from a pose.

    Args:
        source: the recording.

    Attributes:
        lacking: of each link whose shapes are not in the recording, why; it is a tube.

    Raises:
        InputError: the rig has no arm.
    """

    def __init__(self, source: Source) -> None:
        rig, tree = source.rig, source.rig.tree
        if not rig.joint_names:
            raise InputError(
                f"{rig.folder}: the rig has no arm; 'plan' chooses joints of an arm, and cannot "
                "say where to carry a rig"
            )
        self.source = source
        tip = rig.lidar_frame or max(tree.frames, key=lambda frame: len(tree.path(frame)))
        edges = [tree.edges[i] for i in tree.path(tip)]
        self.frames = [tree.root, *(edge.child for edge in edges)]
        moved = np.cumsum([0, *(edge.joint is not None for edge in edges)])
        self.parts, self.lacking = _parts(rig, self.frames)
        last = moved[self.parts.frames].max(axis=1, initial=0)
        first = moved[self.parts.frames].min(axis=1, initial=len(edges))
        self.moving = np.flatnonzero(last > 0)
        count = range(len(last))
        drawn = self._ends_of_parts(np.zeros((1, len(tree.joint_names))))[0]
        long_m = np.linalg.norm(drawn[:, 1] - drawn[:, 0], axis=1) + 2 * self.parts.radius_m
        # Those with one joint between them are built to touch; short tubes lie within others.
        pairs = [
            (a, b)
            for a in count
            for b in count
            if first[b] - last[a] > 1 and min(long_m[a], long_m[b]) > TUBE_CLEAR_M
        ]
        self.pairs = np.array(pairs, int).reshape(-1, 2)
        clear = np.maximum(*self.parts.clear_m[self.pairs.T]) if pairs else np.zeros(0)
        self.least_m = clear + self.parts.radius_m[self.pairs].sum(axis=1)
        self.room_m = (self.parts.radius_m + self.parts.clear_m)[self.moving]
        self.outside_m = 0.0
        self._leave_out_what_is_built_so()

    def _leave_out_what_is_built_so(self) -> None:
        joints = self.drawn(BUILT_SO_POSES, np.random.default_rng(0))
        touch = self._apart_m(self._ends_of_parts(joints)) < self.least_m
        differ = touch.mean(axis=0) < BUILT_SO
        self.pairs, self.least_m = self.pairs[differ], self.least_m[differ]

    @classmethod
    def of(
        cls, source: Source, places: Mapping[str, np.ndarray], T_world_reference: np.ndarray
    ) -> Clear:
        """As of a recording, whose own stops are clear.

        Args:
            source: the recording.
            places: location -> T_world_root (4, 4).
            T_world_reference: (4, 4).
        """
        out, recording = cls(source), source.recording
        known = np.array([str(at) in places for at in recording.location], bool)
        if known.any():
            roots = np.stack([places[str(at)] for at in recording.location[known]])
            Ts_reference_root = se3.inverse(T_world_reference) @ roots
            apart, room, outside = out._gaps(recording.joints[known], Ts_reference_root)
            out.least_m = np.minimum(out.least_m, apart.min(axis=0, initial=np.inf))
            out.room_m = np.minimum(out.room_m, room.min(axis=0, initial=np.inf))
            out.outside_m = float(outside.max(initial=0.0))
        return out

    def drawn(self, count: int, rng: np.random.Generator) -> np.ndarray:
        """Random joints (n, J), evenly over their range."""
        measured = self.source.recording.joints
        known = measured if len(measured) else np.zeros((1, measured.shape[1]))
        low, high = joint_range(self.source.rig, known)
        return rng.uniform(low, high, (count, len(low)))

    def of_poses(self, joints: np.ndarray, Ts_reference_root: np.ndarray) -> np.ndarray:
        """(n,) whether each pose is clear, and no further out of the mesh's box than the arm was at
        a stop that was measured: a mesh of one wall has a flat box."""
        apart, room, outside = self._gaps(joints, Ts_reference_root)
        clear = (apart >= self.least_m).all(axis=1) & (room >= self.room_m).all(axis=1)
        return clear & (outside <= self.outside_m).all(axis=1)

    def in_the_way(self, joints: np.ndarray) -> InTheWay:
        """What of the arm (n, J) is in lines of sight."""
        points, of = self.parts.points(self._ends_of_parts(joints))
        return InTheWay(points, np.maximum(self.parts.radius_m, TUBE_RADIUS_M)[of])

    def _frames(self, joints: np.ndarray) -> np.ndarray:
        """Poses (n, F, 4, 4) of all frames from the root on, in the root's frame."""
        tree = self.source.rig.tree
        root = np.broadcast_to(np.eye(4), (len(joints), 4, 4))
        return np.stack([root, *(tree.transform(f, joints) for f in self.frames[1:])], axis=1)

    def _ends_of_parts(self, joints: np.ndarray) -> np.ndarray:
        return self.parts.placed(self._frames(joints))

    def _apart_m(self, ends_m: np.ndarray) -> np.ndarray:
        """(n, P) how far lines of pairs of parts are from each other."""
        a, b = self.pairs.T
        return segments_apart_m(ends_m[:, a], ends_m[:, b])

    def _gaps(
        self, joints: np.ndarray, Ts_reference_root: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """How far lines of parts are from each other (n, P), those of moving parts from the mesh
        (n, M), and how far these reach out of the mesh's box (n, M), m."""
        ends = self._ends_of_parts(joints)
        apart_m, mesh = self._apart_m(ends), self.source.reference
        if mesh is None:
            none = np.zeros((len(joints), len(self.room_m)))
            return apart_m, none + np.inf, none
        points, of = self.parts.points(ends[:, self.moving])
        at = np.einsum("nij,nkj->nki", Ts_reference_root[:, :3, :3], points)
        at += Ts_reference_root[:, None, :3, 3]
        room_m = mesh.distance_m(at.reshape(-1, 3)).reshape(at.shape[:2])
        low, high = mesh.vertices_m.min(axis=0), mesh.vertices_m.max(axis=0)
        outside_m = np.linalg.norm(at - np.clip(at, low, high), axis=2)
        starts = np.flatnonzero(np.diff(of, prepend=-1))
        return (
            apart_m,
            np.minimum.reduceat(room_m, starts, axis=1),
            np.maximum.reduceat(outside_m, starts, axis=1),
        )


def _parts(rig: Rig, frames: list[str]) -> tuple[Capsules, list[str]]:
    """The parts of an arm of these frames; of each link whose shapes are not there, why."""
    try:
        shapes, lacking = arm_shapes(rig, hit=True)
    except InputError as error:
        shapes, lacking = [], [str(error)]
    shaped = {shape.link for shape in shapes}
    parts = []
    for at, frame in enumerate(frames):
        for shape in (each for each in shapes if each.link == frame):
            found = about(shape.vertices_m, shape.triangles)
            parts += [((at, at), ends, radius, SHAPE_CLEAR_M) for ends, radius in found]
        if frame not in shaped and at + 1 < len(frames):
            parts.append(((at, at + 1), np.zeros((2, 3)), 0.0, TUBE_CLEAR_M))
    return Capsules.of(parts), lacking
