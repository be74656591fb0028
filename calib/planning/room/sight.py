"""What the tracker's cameras see: lines of sight past the mesh and the arm."""

from __future__ import annotations

import numpy as np

from calib.planning.room.clear import InTheWay
from calib.planning.stops import Poses
from calib.problem.model import Source
from chains import se3

CAMERAS_THAT_SEE = 2  # a marker is where the rays of two cameras meet
# Beyond a part's own radius, within which it carries a body: half as wide as a tube is kept clear.
CARRIES_M = 0.05


def in_sight(
    source: Source,
    cameras_m: np.ndarray,
    poses: Poses,
    arm: InTheWay,
    T_world_reference: np.ndarray,
) -> np.ndarray:
    """(n,) whether two cameras see every tracked body: neither the mesh nor the arm is between.
    Which side of a body its markers are on, nobody says.

    Args:
        source: the recording.
        cameras_m: (C, 3) world frame.
        poses: n of them.
        arm: what of it is in the way.
        T_world_reference: (4, 4).
    """
    tracker, Ts = source.rig.tracker, poses.Ts_world_root
    points = np.einsum("nij,nkj->nki", Ts[:, :3, :3], arm.points_m) + Ts[:, None, :3, 3]
    arm = InTheWay(points, arm.radius_m)
    out = np.ones(len(Ts), bool)
    for body in tracker.bodies if tracker else ():
        at = (Ts @ source.rig.tree.place(body, poses.joints).Ts_root_frame)[:, :3, 3]
        out &= seen_by_two(source, cameras_m, at, T_world_reference, arm)
    return out


def seen_by_two(
    source: Source,
    cameras_m: np.ndarray,
    at_m: np.ndarray,
    T_world_reference: np.ndarray,
    arm: InTheWay | None = None,
) -> np.ndarray:
    """(n,) whether two cameras (C, 3) see points (n, 3), world frame, past the mesh and the arm, if
    there is one, in the world's frame; other arguments as of `in_sight`."""
    seen = np.zeros(len(at_m), int)
    for camera in cameras_m:
        here = _past_mesh(source, camera, at_m, T_world_reference)
        seen += here if arm is None else here & _past_arm(camera, at_m, arm)
    return seen >= CAMERAS_THAT_SEE


def _past_arm(camera_m: np.ndarray, at_m: np.ndarray, arm: InTheWay) -> np.ndarray:
    """(n,) whether no part is in the way, but for that on which the body sits."""
    ray = at_m - camera_m
    share = np.einsum("nki,ni->nk", arm.points_m - camera_m, ray) / np.sum(ray**2, axis=1)[:, None]
    foot = camera_m + np.clip(share, 0.0, 1.0)[..., None] * ray[:, None]
    beside = np.linalg.norm(arm.points_m - foot, axis=2) > arm.radius_m
    carries = np.linalg.norm(arm.points_m - at_m[:, None], axis=2) < arm.radius_m + CARRIES_M
    return (beside | carries).all(axis=1)


def _past_mesh(
    source: Source, camera_m: np.ndarray, at_m: np.ndarray, T_world_reference: np.ndarray
) -> np.ndarray:
    """(n,) whether nothing of the mesh is in the way."""
    if source.reference is None or not len(at_m):
        return np.ones(len(at_m), bool)
    T = se3.inverse(T_world_reference)
    camera, at = se3.apply(T, camera_m[None])[0], se3.apply(T, at_m)
    far_m = np.linalg.norm(at - camera, axis=1)
    met = source.reference.cast(np.tile(camera, (len(at), 1)), (at - camera) / far_m[:, None])
    return ~(met.range_m < far_m)
