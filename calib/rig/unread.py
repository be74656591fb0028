"""Joints that nothing reads: about where they are at every stop, from the poses of tracked bodies.

A fit estimates them; it must begin near them, and effects look at them as at any joint.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from calib.rig.description import Rig
from chains import se3
from chains.align import mean_pose
from sensors.recording import RecordedStops
from sensors.stops import Array

STARTS = 64  # values of all of a stop's joints that are tried; of one joint, every few degrees
FOLLOWED = 4  # of those, from so many the way down is followed
STEPS = 15  # of Gauss and Newton; from a few degrees away five are enough
IN_TURN = 10  # of base and joints in turn, where nothing before the joints shows the base
STIFF = 1e-9  # of the largest curvature: a joint that the bodies do not show stays where it is


def with_unread(rig: Rig, recording: RecordedStops) -> RecordedStops:
    """The recording with a value for every joint that was not read: within its limits, as the
    tracked bodies lie there best; in their middle, where they do not tell."""
    missing = np.isnan(recording.joints)
    if not missing.any():
        return recording
    lower, upper = _limits(rig)
    q = np.where(missing, (lower + upper) / 2.0, recording.joints)
    seen = {b: p for b, p in recording.bodies.items() if np.isfinite(p[:, 3:]).any()}
    beyond = [b for b in seen if _moves(rig, missing, b)]
    before = {b: p for b, p in seen.items() if b not in beyond}
    for _ in range(1 if before else IN_TURN if beyond else 0):
        roots = _roots(rig, recording, q, before or seen)
        told = np.isfinite(roots[:, 0, 0])
        for gone in np.unique(missing[told], axis=0):
            at = np.flatnonzero(told & (missing == gone).all(axis=1))
            if gone.any():
                q[at] = _best(rig, recording, at, q[at], roots[at], np.flatnonzero(gone), beyond)
    return replace(recording, joints=q)


def _limits(rig: Rig) -> tuple[Array, Array]:
    """(J,) of all joints; a whole turn, or a metre either way, where the URDF has none."""
    far = np.array([np.pi if j.kind == "revolute" else 1.0 for j in rig.joints])
    said = np.array([[j.lower, j.upper] for j in rig.joints]).T
    lower, upper = np.where(np.isfinite(said), said, [-far, far])
    return lower, upper


def _moves(rig: Rig, missing: Array, body: str) -> bool:
    """Whether a joint that some stop lacks moves a body."""
    lacking = {n for n, gone in zip(rig.joint_names, missing.T, strict=True) if gone.any()}
    return not lacking.isdisjoint(rig.joints_to(body))


def _roots(rig: Rig, recording: RecordedStops, q: Array, bodies: dict[str, Array]) -> Array:
    """T_world_root (K, 4, 4) as these bodies say on average, wherever it is the same; else NaN."""
    every = np.full((len(bodies), len(q), 4, 4), np.nan)
    for T, (body, pose) in zip(every, bodies.items(), strict=True):
        at = np.flatnonzero(np.isfinite(pose).all(axis=1))
        T_world_body = se3.from_xyz_quat(pose[at, :3], pose[at, 3:])
        T[at] = T_world_body @ se3.inverse(rig.tree.transform(body, q[at]))
    standing = {"stop": recording.stops, "location": recording.location, "never": ["all"] * len(q)}
    labels, out = np.array(standing[rig.moves]), np.full((len(q), 4, 4), np.nan)
    for label in dict.fromkeys(labels.tolist()):
        said = every[:, labels == label].reshape(-1, 4, 4)
        said = said[np.isfinite(said[:, 0, 0])]
        if len(said):
            out[labels == label] = mean_pose(said)
    return out


def _best(
    rig: Rig,
    recording: RecordedStops,
    at: Array,
    q: Array,
    roots: Array,
    free: Array,
    bodies: list[str],
) -> Array:
    """Joints (n, J) of some stops, those that are free where the bodies lie best."""
    lower, upper = (limit[free] for limit in _limits(rig))
    each = max(2, round(STARTS ** (1.0 / len(free))))
    share = (np.stack(np.meshgrid(*[np.arange(each)] * len(free)), axis=-1) + 0.5) / each
    tried = lower + share.reshape(-1, len(free)) * (upper - lower)
    tried = tried[:: -(-len(tried) // STARTS)]
    starts = np.repeat(q[None], 1 + len(tried), axis=0)
    starts[1:, :, free] = tried[:, None]
    costs = np.stack([_cost(rig, recording, at, s, roots, bodies) for s in starts])
    order = np.argsort(costs, axis=0)[:FOLLOWED]
    found = np.take_along_axis(starts, order[:, :, None], axis=0)
    for s in found:
        for _ in range(STEPS):
            A, b = _normal(rig, recording, at, s, roots, bodies)
            A, b = A[:, free][:, :, free], b[:, free]
            size = np.abs(A).max(axis=(1, 2), initial=1e-12)[:, None, None]
            step = np.linalg.solve(A + STIFF * size * np.eye(len(free)), b[..., None])[..., 0]
            s[:, free] = np.clip(s[:, free] + step, lower, upper)
    costs = np.stack([_cost(rig, recording, at, s, roots, bodies) for s in found])
    return np.take_along_axis(found, costs.argmin(axis=0)[None, :, None], axis=0)[0]


def _cost(
    rig: Rig, recording: RecordedStops, at: Array, q: Array, roots: Array, bodies: list[str]
) -> Array:
    """(n,) sum of squares of what the bodies are off by, rad and m alike."""
    out = np.zeros(len(at))
    for body, where, T_seen in _seen(recording, at, bodies):
        T = roots[where] @ rig.tree.transform(body, q[where])
        out[where] += np.square(se3.log(se3.inverse(T) @ T_seen)).sum(axis=1)
    return out


def _normal(
    rig: Rig, recording: RecordedStops, at: Array, q: Array, roots: Array, bodies: list[str]
) -> tuple[Array, Array]:
    """Normal equations of a step of the joints, (n, J, J) and (n, J)."""
    J = q.shape[1]
    A, b = np.zeros((len(at), J, J)), np.zeros((len(at), J))
    for body, where, T_seen in _seen(recording, at, bodies):
        placed = rig.tree.place(body, q[where])
        off = se3.log(se3.inverse(roots[where] @ placed.Ts_root_frame) @ T_seen)
        A[where] += placed.d_joint.mT @ placed.d_joint
        b[where] += np.matvec(placed.d_joint.mT, off)
    return A, b


def _seen(
    recording: RecordedStops, at: Array, bodies: list[str]
) -> Iterator[tuple[str, Array, Array]]:
    """Each body, at which of these stops it was seen, and its poses there (n, 4, 4)."""
    for body in bodies:
        pose = recording.bodies[body][at]
        where = np.flatnonzero(np.isfinite(pose).all(axis=1))
        yield body, where, se3.from_xyz_quat(pose[where, :3], pose[where, 3:])
