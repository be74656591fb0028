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

    ``direction`` (M, 3, K) unit vectors; ``at_m`` (M, 3, K) a point of each axis; ``T`` (K, 4, 4)
    of the chain's end; ``turns`` (M,) whether an axis turns, or else slides; ``by`` (J, M) how far
    each axis goes by each joint.
    """

    direction: Array
    at_m: Array
    T: Array
    turns: Array
    by: Array

    def jacobian(self) -> Array:
        """Return the end's motion (K, 6, J), rotation over translation, in the start's axes."""
        turn = self.direction * self.turns[:, None, None]
        shift = cross(self.direction, self.T[:, :3, 3].T - self.at_m)
        shift[~self.turns] = self.direction[~self.turns]
        by_axis = np.concatenate([turn, shift], axis=1)
        return np.ascontiguousarray(np.tensordot(self.by, by_axis, axes=1).transpose(2, 1, 0))


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
            T[first : first + CHUNK] = self._end(self._walk(joints[first : first + CHUNK]))
        return T

    def axes(self, joints: Array) -> Axes:
        """Return where the axes are at joints (K, J)."""
        return self.axes_and_points(joints, [], np.zeros((0, 3)))[0]

    def axes_and_points(
        self, joints: Array, edges: Sequence[int], points_m: Array
    ) -> tuple[Axes, Array]:
        """Return where the axes are, and points (n, 3, K) given (n, 3) in what some edges (n,) lead
        to, counted from 1; 0 is the start."""
        moved = self._walk(joints)
        at_m = np.empty((len(edges), 3, len(joints)))
        for n, (edge, point) in enumerate(zip(edges, points_m, strict=True)):
            axes, T = self.behind[edge]
            weights = np.append(T[:3, :3] @ point + T[:3, 3], 1.0)
            at_m[n] = np.tensordot(weights, moved[axes], axes=1)
        axes = Axes(
            direction=moved[1:, 2],  # as no motion along an axis, or about it, moves it
            at_m=moved[1:, 3],
            T=self._end(moved),
            turns=self.turns,
            by=self.by,
        )
        return axes, at_m

    def _end(self, moved: Array) -> Array:
        """Return T_start_end (K, 4, 4) from what `_walk` found."""
        T = np.zeros((moved.shape[3], 4, 4))
        T[:, :3] = _after(moved[-1], self.fixed[-1]).transpose(2, 1, 0)
        T[:, 3, 3] = 1.0
        return T

    def _walk(self, joints: Array) -> Array:
        """Return where the start, and what each axis moves, is (M + 1, 4, 3, K).

        Columns of T, not its rows, lie together: x, y, z and the origin.
        """
        by_axis = (joints @ self.by).T
        moved = np.empty((len(self.fixed), 4, 3, len(joints)))
        moved[0] = np.eye(4, 3)[..., None]
        cosine, sine = np.cos(by_axis), np.sin(by_axis)
        for j, fixed in enumerate(self.fixed[:-1]):
            x, y, z, origin = _after(moved[j], fixed, out=moved[j + 1])
            if self.turns[j]:
                x_before = x.copy()
                x *= cosine[j]
                x += sine[j] * y
                y *= cosine[j]
                y -= sine[j] * x_before
            else:
                origin += by_axis[j] * z
        return moved


def cross(a: Array, b: Array) -> Array:
    """Return the vector products (..., 3, K) of vectors whose components lie apart."""
    out = np.empty(np.broadcast_shapes(a.shape, b.shape))
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        out[..., k, :] = a[..., i, :] * b[..., j, :] - a[..., j, :] * b[..., i, :]
    return out


def _after(columns: Array, T: Array, out: Array | None = None) -> Array:
    """Return the columns (4, 3, K) of ``C @ T``, T (4, 4) being the same for all."""
    out = np.empty_like(columns) if out is None else out
    np.matmul(T[:3].T, columns[:3].reshape(3, -1), out=out.reshape(4, -1))
    out[3] += columns[3]
    return out


def _with_z_along(axis: Array) -> Array:
    """Return a rotation (4, 4) whose third column is the unit vector ``axis`` (3,)."""
    R = np.eye(4)
    R[:3, 2] = axis
    R[:3, 0] = np.linalg.svd(axis[None])[2][1]
    R[:3, 1] = np.cross(axis, R[:3, 0])
    return R
