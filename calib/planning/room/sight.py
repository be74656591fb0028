"""What the tracker's cameras see: lines of sight past the mesh and the arm's tubes."""

from __future__ import annotations

import numpy as np

from calib.planning.stops import Poses
from calib.problem.model import Source
from chains import se3

CAMERAS_THAT_SEE = 2  # a marker is where the rays of two cameras meet
# Of a line of sight to the middle of a tube: half as wide as tubes are kept apart, and as wide
# about a body, which sits on one.
TUBE_RADIUS_M, CARRIES_M = 0.05, 0.1


def in_sight(
    source: Source,
    cameras_m: np.ndarray,
    poses: Poses,
    tubes_m: np.ndarray,
    T_world_reference: np.ndarray,
) -> np.ndarray:
    """(n,) whether two cameras see every tracked body: neither the mesh nor the arm is between.
    Which side of a body its markers are on, nobody says.

    Args:
        source: the recording.
        cameras_m: (C, 3) world frame.
        poses: n of them.
        tubes_m: (n, K, 3) points along the arm's tubes, in the root's frame.
        T_world_reference: (4, 4).
    """
    tracker, Ts = source.rig.tracker, poses.Ts_world_root
    tubes = np.einsum("nij,nkj->nki", Ts[:, :3, :3], tubes_m) + Ts[:, None, :3, 3]
    out = np.ones(len(Ts), bool)
    for body in tracker.bodies if tracker else ():
        at = (Ts @ source.rig.tree.place(body, poses.joints).Ts_root_frame)[:, :3, 3]
        out &= seen_by_two(source, cameras_m, at, T_world_reference, tubes)
    return out


def seen_by_two(
    source: Source,
    cameras_m: np.ndarray,
    at_m: np.ndarray,
    T_world_reference: np.ndarray,
    tubes_m: np.ndarray | None = None,
) -> np.ndarray:
    """(n,) whether two cameras (C, 3) see points (n, 3), world frame, past the mesh and the points
    (n, K, 3) of tubes, if there are any; other arguments as of `in_sight`."""
    seen = np.zeros(len(at_m), int)
    for camera in cameras_m:
        here = _past_mesh(source, camera, at_m, T_world_reference)
        seen += here if tubes_m is None else here & _past_tubes(camera, at_m, tubes_m)
    return seen >= CAMERAS_THAT_SEE


def _past_tubes(camera_m: np.ndarray, at_m: np.ndarray, tubes_m: np.ndarray) -> np.ndarray:
    """(n,) whether no point of the tubes is in the way, but for those that the body sits on."""
    ray = at_m - camera_m
    share = np.einsum("nki,ni->nk", tubes_m - camera_m, ray) / np.sum(ray**2, axis=1)[:, None]
    foot = camera_m + np.clip(share, 0.0, 1.0)[..., None] * ray[:, None]
    beside = np.linalg.norm(tubes_m - foot, axis=2) > TUBE_RADIUS_M
    carries = np.linalg.norm(tubes_m - at_m[:, None], axis=2) < CARRIES_M
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
