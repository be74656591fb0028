"""Joints that nothing reads: about where they are at every stop, from the poses of tracked bodies.

A fit estimates them; it must begin near them, and effects look at them as at any joint.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from calib.rig.description import Rig
from chains import se3
from chains.align import mean_pose
from sensors.recording import RecordedStops
from sensors.stops import Array

STARTS = 512  # values of all of a stop's joints that are tried; of two joints, every 16 degrees
MOST_OF_ONE = 72  # of one joint: every 5 degrees
FOLLOWED = 4  # of those, from so many the way down is followed
STEPS = 15  # of Gauss and Newton; from a few degrees away five are enough
STIFF = 1e-9  # of the largest curvature: so much holds a joint that nothing shows to its middle
# Where nothing before the joints shows the base: so many stops rank what it may be, and from so
# many of these the way down is followed.
RANKING, BASES = 12, 8


def with_unread(rig: Rig, recording: RecordedStops) -> RecordedStops:
    """The recording with a value for every joint that was not read: within its limits, as the
    tracked bodies lie there best; in their middle, where they do not tell."""
    missing = np.isnan(recording.joints)
    if not missing.any():
        return recording
    lower, upper = joint_limits(rig)
    q = np.where(missing, (lower + upper) / 2.0, recording.joints)
    lacking = {n for n, gone in zip(rig.joint_names, missing.T, strict=True) if gone.any()}
    seen = {b: _Body(b, p) for b, p in recording.bodies.items() if np.isfinite(p[:, :3]).any()}
    beyond = [b for n, b in seen.items() if not lacking.isdisjoint(rig.joints_to(n))]
    before = [b for b in seen.values() if b not in beyond and not b.is_point]
    labels = _standing(rig, recording)
    roots = np.stack([np.full((4, 4), np.nan)] * len(q))
    for label in dict.fromkeys(labels.tolist()):
        at = np.flatnonzero(labels == label)
        roots[at] = _root(rig, q[at], [b.some(at) for b in before])
    told = np.isfinite(roots[:, 0, 0])
    at = np.flatnonzero(told & missing.any(axis=1))
    q[at] = _Some(rig, q[at], missing[at], [b.some(at) for b in beyond]).placed(roots[at])
    for label in dict.fromkeys(labels[~told].tolist()):
        at = np.flatnonzero(~told & (labels == label))
        q[at] = _Some(rig, q[at], missing[at], [b.some(at) for b in beyond]).with_base()
    return replace(recording, joints=q)


def _standing(rig: Rig, recording: RecordedStops) -> Array:
    """Label (K,) of each stop: those with one share where the rig stands."""
    every = ["all"] * len(recording.stops)
    labels = {"stop": recording.stops, "location": recording.location, "never": every}
    return np.array(labels[rig.moves])


def joint_limits(rig: Rig) -> tuple[Array, Array]:
    """Lower and upper (J,) of all joints; a whole turn, or a metre either way, where the URDF has
    none."""
    far = np.array([np.pi if j.kind == "revolute" else 1.0 for j in rig.joints])
    said = np.array([[j.lower, j.upper] for j in rig.joints]).T
    lower, upper = np.where(np.isfinite(said), said, [-far, far])
    return lower, upper


def values_between(rig: Rig, q: Array, missing: Array) -> Array:
    """Joints (N, K, J) with what is `missing` of some (K, J) on a grid over the limits, a whole
    turn at most; those given first."""
    lower, upper = joint_limits(rig)
    turns = np.array([j.kind == "revolute" for j in rig.joints])
    middle, half = (lower + upper) / 2.0, (upper - lower) / 2.0
    half = np.where(turns, np.minimum(half, np.pi), half)
    lacking = np.flatnonzero(missing.any(axis=0))
    each = max(2, min(MOST_OF_ONE, round(STARTS ** (1.0 / len(lacking)))))
    grid = np.stack(np.meshgrid(*[np.arange(each)] * len(lacking)), axis=-1)
    share = 2.0 * (grid.reshape(-1, len(lacking)) + 0.5) / each - 1.0
    share = share[:: -(-len(share) // STARTS)]
    tried = np.repeat(q[None], 1 + len(share), axis=0)
    value = middle[lacking] + share[:, None] * half[lacking]
    tried[1:, :, lacking] = np.where(missing[:, lacking], value, tried[1:, :, lacking])
    return tried


@dataclass(frozen=True)
class _Body:
    """A tracked body: its poses (K, 7) as stops have them, NaN where unseen."""

    name: str
    pose: Array

    @property
    def is_point(self) -> bool:
        """Whether it has no orientation anywhere."""
        return not np.isfinite(self.pose[:, 3:]).any()

    def some(self, at: Array) -> _Body:
        return replace(self, pose=self.pose[at])

    @property
    def where(self) -> Array:
        """(n,) the stops at which it was seen."""
        known = self.pose[:, :3] if self.is_point else self.pose
        return np.flatnonzero(np.isfinite(known).all(axis=1))

    @property
    def T_seen(self) -> Array:
        """(n, 4, 4) there; of a point, not turned."""
        pose = self.pose[self.where]
        turn = [1.0, 0.0, 0.0, 0.0] if self.is_point else pose[:, 3:]
        return se3.from_xyz_quat(pose[:, :3], np.broadcast_to(turn, (len(pose), 4)))


def _root(rig: Rig, q: Array, bodies: list[_Body]) -> Array:
    """T_world_root (4, 4) of stops that share it, as bodies with known joints say on average; NaN
    where they say nothing."""
    said = [b.T_seen @ se3.inverse(rig.tree.transform(b.name, q[b.where])) for b in bodies]
    said = np.concatenate([*said, np.zeros((0, 4, 4))])
    return mean_pose(said) if len(said) else np.full((4, 4), np.nan)


@dataclass(frozen=True)
class _Some:
    """Some stops, and what is missing of their joints.

    Args:
        rig: on paper.
        q: (K, J), of what is missing any value.
        missing: (K, J).
        bodies: what lies beyond a missing joint.
    """

    rig: Rig
    q: Array
    missing: Array
    bodies: list[_Body]

    def placed(self, root: Array) -> Array:
        """Joints (K, J) with which the bodies lie best on a known T_world_root, (K, 4, 4) or one of
        all stops."""
        if not self.missing.any():
            return self.q
        tried = self._tried()
        costs = np.stack([self._cost(q, root) for q in tried])
        order = np.argsort(costs, axis=0)[:FOLLOWED]
        found = np.take_along_axis(tried, order[:, :, None], axis=0)
        found = [self._down(q, root, moves=False)[0] for q in found]
        costs = np.stack([self._cost(q, root) for q in found])
        return np.take_along_axis(np.stack(found), costs.argmin(axis=0)[None, :, None], axis=0)[0]

    def with_base(self) -> Array:
        """Joints (K, J) where the root, one of all stops, is known as little: the best of several
        roots, each found from one stop at one of the values that are tried, and followed down with
        the joints."""
        posed = [b for b in self.bodies if not b.is_point and len(b.where)]
        if not posed or not self.missing.any():
            return self.q
        found = []
        for root in self._bases(max(posed, key=lambda b: len(b.where))):
            q, root = self._down(self.placed(root), root, moves=True)
            found.append((self._cost(q, root).sum(), q))
        return min(found, key=lambda each: each[0])[1]

    def _tried(self) -> Array:
        """(N, K, J) values of what is missing, see `values_between`."""
        return values_between(self.rig, self.q, self.missing)

    def _bases(self, body: _Body) -> Array:
        """T_world_root (n, 4, 4), best first: where a body was seen at one stop, with each of the
        values tried there, ranked by how near it comes at some other stops at its best."""
        chosen = body.where[np.linspace(0, len(body.where) - 1, RANKING).astype(int)]
        chosen = np.unique(chosen)
        some = _Some(self.rig, self.q[chosen], self.missing[chosen], [])
        tried, seen = some._tried(), body.some(chosen).T_seen
        T = self.rig.tree.transform(body.name, tried.reshape(-1, tried.shape[2]))
        T = T.reshape(*tried.shape[:2], 4, 4)
        roots = seen[len(chosen) // 2] @ se3.inverse(T[:, len(chosen) // 2])
        cost = np.zeros(len(roots))
        flat = roots.reshape(len(roots), -1)
        square = (roots.mT @ roots).reshape(len(roots), -1)
        for k in range(len(chosen)):  # |root T - seen|^2 of each root and each T
            across = flat @ (seen[k] @ T[:, k].mT).reshape(len(T), -1).T
            each = square @ (T[:, k] @ T[:, k].mT).reshape(len(T), -1).T - 2.0 * across
            cost += (each + np.square(seen[k]).sum()).min(axis=1)
        return roots[np.argsort(cost)[:BASES]]

    def _compared(self, q: Array, root: Array) -> Iterator[tuple[_Body, Array, Array]]:
        """Each body, what it is off by (n, 6 or 3) in its axes, rad and m alike, and where it is in
        the root's frame."""
        for body in self.bodies:
            T = self.rig.tree.transform(body.name, q[body.where])
            off = se3.inverse(_at(root, body.where) @ T) @ body.T_seen
            yield body, off[:, :3, 3] if body.is_point else se3.log(off), T

    def _cost(self, q: Array, root: Array) -> Array:
        """(K,) sum of squares of what the bodies are off by."""
        out = np.zeros(len(q))
        for body, off, _ in self._compared(q, root):
            out[body.where] += np.square(off).sum(axis=1)
        return out

    def _down(self, q: Array, root: Array, moves: bool) -> tuple[Array, Array]:
        """Joints, and the root where it moves, after some steps of Gauss and Newton; within the
        limits where it does not, as these may be all that tells it from the first joint."""
        lower, upper = (-np.inf, np.inf) if moves else joint_limits(self.rig)
        for _ in range(STEPS):
            step, of_root = self._step(q, root, moves)
            q = np.where(self.missing, np.clip(q + step, lower, upper), q)
            root = root @ se3.exp(of_root)
        return q, root

    def _step(self, q: Array, root: Array, moves: bool) -> tuple[Array, Array]:
        """Of joints (K, J), and of the root (6,): zero unless it moves."""
        count, J = q.shape
        A, b = np.zeros((count, J, J)), np.zeros((count, J))
        by_root, A_root, b_root = np.zeros((count, J, 6)), np.zeros((6, 6)), np.zeros(6)
        for body, off, T in self._compared(q, root):
            at, rows = body.where, slice(3, 6) if body.is_point else slice(0, 6)
            d = self.rig.tree.place(body.name, q[at]).d_joint[:, rows] * self.missing[at][:, None]
            d_root = se3.adjoint(se3.inverse(T))[:, rows]
            A[at] += d.mT @ d
            b[at] += np.matvec(d.mT, off)
            by_root[at] += d.mT @ d_root
            A_root += (d_root.mT @ d_root).sum(axis=0)
            b_root += np.matvec(d_root.mT, off).sum(axis=0)
        stiff = STIFF * max(float(np.abs(A).max(initial=0.0)), 1e-12)
        A += np.where(self.missing, stiff, 1.0)[:, None] * np.eye(J)
        b += stiff * np.where(self.missing, np.mean(joint_limits(self.rig), axis=0) - q, 0.0)
        of_root = np.zeros(6)
        if moves:
            gone = np.linalg.solve(A, by_root)
            A_root = A_root - (by_root.mT @ gone).sum(axis=0)
            b_root = b_root - (gone.mT @ b[..., None]).sum(axis=0)[:, 0]
            of_root = np.linalg.lstsq(A_root, b_root, rcond=1e-14)[0]
        return np.linalg.solve(A, (b - by_root @ of_root)[..., None])[..., 0], of_root


def _at(root: Array, where: Array) -> Array:
    """The root (n, 4, 4) at some stops, (4, 4) where it is one of all."""
    return root if root.ndim == 2 else root[where]
