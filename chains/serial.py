"""A serial chain for many poses at once: what is fixed is multiplied out beforehand.

Frames between two joints become one matrix, turned so that every joint moves about or along its own
z; at a pose only cosines and sines are new. The same numbers as a `FrameTree` gives, without what a
derivative by every edge costs there.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from chains.frames import Edge
from chains.se3 import Array

CHUNK = 2048  # poses at once: what they need stays in a processor's own memory


@dataclass(frozen=True)
class Axes:
    """The joints' axes at K poses, in the frame that the chain starts from.

    ``direction`` (K, M, 3) unit vectors; ``at_m`` (K, M, 3) a point of each axis; ``T`` (K, 4, 4)
    of the chain's end; ``turns`` (M,) whether an axis turns, or else slides; ``by`` (J, M) how far
    each axis goes by each joint.
    """

    direction: Array
    at_m: Array
    T: Array
    turns: Array
    by: Array

    def velocities(self, points_m: Array) -> Array:
        """Return how points (K, 3) behind all joints move, (K, J, 3) m per rad or m."""
        across = np.cross(self.direction, points_m[:, None] - self.at_m)
        return self.by @ np.where(self.turns[:, None], across, self.direction)

    def jacobian(self) -> Array:
        """Return the end's motion (K, 6, J), rotation over translation, in the start's axes."""
        turn = self.by @ (self.direction * self.turns[:, None])
        return np.concatenate([turn, self.velocities(self.T[:, :3, 3])], axis=2).mT


class SerialChain:
    """Edges one after the other, each ``T_parent_child @ motion(q)``.

    ``joint_names`` of its J joints; ``by`` (J, M) how far each of its M axes goes by each joint;
    ``fixed``, M + 1 matrices (4, 4): what lies between the axes; ``behind``, of the start and of
    each edge, how many axes lie before what it leads to, and where (4, 4) that is from the last.
    """

    def __init__(self, edges: Sequence[Edge]) -> None:
        joints = [edge.joint for edge in edges if edge.joint is not None]
        self.joint_names = tuple(dict.fromkeys(joint.name for joint in joints))
        self.by = np.zeros((len(self.joint_names), len(joints)))
        for axis, joint in enumerate(joints):
            self.by[self.joint_names.index(joint.name), axis] = joint.factor
        self.turns = np.array([joint.kind == "revolute" for joint in joints], bool)
        self.fixed, before = [], np.eye(4)
        self.behind = [(0, before)]
        for edge in edges:
            before = before @ edge.T_parent_child
            if edge.joint is not None:
                T_joint_z = _with_z_along(edge.joint.axis)
                self.fixed.append(before @ T_joint_z)
                before = T_joint_z.T  # a rotation alone
            self.behind.append((len(self.fixed), before))
        self.fixed.append(before)

    def place(self, joints: Array) -> Array:
        """Return T_start_end (K, 4, 4) at joints (K, J), rad or m, ordered as ``joint_names``."""
        T = np.empty((len(joints), 4, 4))
        for first in range(0, len(joints), CHUNK):
            T[first : first + CHUNK] = self._end(self._walk(joints[first : first + CHUNK])[0])
        return T

    def axes(self, joints: Array) -> Axes:
        """Return where the axes are at joints (K, J)."""
        return self.axes_and_points(joints, [], np.zeros((0, 3)))[0]

    def axes_and_points(
        self, joints: Array, edges: Sequence[int], points_m: Array
    ) -> tuple[Axes, Array]:
        """Return where the axes are, and points (K, n, 3) given (n, 3) in what some edges (n,) lead
        to, counted from 1; 0 is the start."""
        moved, found = self._walk(joints)
        stacked = np.stack(found, axis=1) if found else np.zeros((len(joints), 0, 2, 3))
        at_m = np.empty((len(joints), len(edges), 3))
        for n, (edge, point) in enumerate(zip(edges, points_m, strict=True)):
            axes, T = self.behind[edge]
            weights = np.append(T[:3, :3] @ point + T[:3, 3], 1.0)
            at_m[:, n] = np.tensordot(weights, moved[axes], axes=1)
        axes = Axes(
            direction=stacked[:, :, 0],
            at_m=stacked[:, :, 1],
            T=self._end(moved),
            turns=self.turns,
            by=self.by,
        )
        return axes, at_m

    def _end(self, moved: Sequence[Array]) -> Array:
        """Return T_start_end (K, 4, 4) from what `_walk` found."""
        T = np.zeros((moved[-1].shape[1], 4, 4))
        T[:, :3] = np.moveaxis(_after(moved[-1], self.fixed[-1]), 0, 2)
        T[:, 3, 3] = 1.0
        return T

    def _walk(self, joints: Array) -> tuple[list[Array], list[Array]]:
        """Return where the start, and what each axis moves, is (4, K, 3), and every axis (K, 2, 3):
        its direction and a point of it.

        Columns of T, not its rows, lie together: x, y, z and the origin.
        """
        joints, count, found = joints @ self.by, len(joints), []
        columns = np.zeros((4, count, 3))
        columns[[0, 1, 2], :, [0, 1, 2]] = 1.0
        moved = [columns]
        cosine, sine = np.cos(joints.T)[..., None], np.sin(joints.T)[..., None]
        for j, fixed in enumerate(self.fixed[:-1]):
            columns = _after(columns, fixed)
            found.append(columns[2:].swapaxes(0, 1))
            x, y, z, origin = columns
            if self.turns[j]:
                x, y = cosine[j] * x + sine[j] * y, cosine[j] * y - sine[j] * x
            else:
                origin = origin + joints[:, j, None] * z
            columns = np.stack([x, y, z, origin])
            moved.append(columns)
        return moved, found


def _after(columns: Array, T: Array) -> Array:
    """Return the columns (4, K, 3) of ``C @ T``, T (4, 4) being the same for all."""
    out = (T[:3].T @ columns[:3].reshape(3, -1)).reshape(4, -1, 3)
    out[3] += columns[3]
    return out


def _with_z_along(axis: Array) -> Array:
    """Return a rotation (4, 4) whose third column is the unit vector ``axis`` (3,)."""
    R = np.eye(4)
    R[:3, 2] = axis
    R[:3, 0] = np.linalg.svd(axis[None])[2][1]
    R[:3, 1] = np.cross(axis, R[:3, 0])
    return R
