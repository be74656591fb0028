"""Poses that an arm can take: within its limits, clear of itself and the room, and in sight."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from calib.planning.room.clear import Clear
from calib.planning.room.sight import in_sight
from calib.planning.stops import Poses
from chains import se3
from chains.errors import InputError

TIMES_DRAWN = 20  # times as many poses as are wanted are drawn at most


def reachable(
    clear: Clear,
    places: Mapping[str, np.ndarray],
    T_world_reference: np.ndarray,
    count: int,
    rng: np.random.Generator,
    cameras_m: np.ndarray | None = None,
) -> Poses:
    """Random poses of an arm, evenly over its joints' range and the places where its base was.

    Args:
        clear: what keeps the arm of a recording from a pose.
        places: location -> T_world_root (4, 4).
        T_world_reference: (4, 4).
        count: how many.
        rng: chance.
        cameras_m: (C, 3) of the tracker, world frame, that are to see every tracked body; None
            where nothing says where they are.

    Raises:
        InputError: it can hardly take any pose there.
    """
    source = clear.source
    names, Ts = list(places), np.stack(list(places.values()))
    found: list[tuple[np.ndarray, np.ndarray]] = []
    for _ in range(TIMES_DRAWN):
        joints = clear.drawn(count, rng)
        at = rng.integers(len(names), size=count)
        free = clear.of_poses(joints, se3.inverse(T_world_reference) @ Ts[at])
        if cameras_m is not None and free.any():
            some = np.flatnonzero(free)
            poses = Poses(np.array(names)[at[some]], joints[some], Ts[at[some]])
            arm = clear.in_the_way(joints[some])
            free[some] = in_sight(source, cameras_m, poses, arm, T_world_reference)
        found.append((joints[free], at[free]))
        if sum(map(len, (each[0] for each in found))) >= count:
            break
    joints, at = (np.concatenate(parts)[:count] for parts in zip(*found, strict=True))
    if not len(joints):
        raise InputError(
            f"{source.rig.folder}: none of {TIMES_DRAWN * count} random poses of the arm is clear "
            "of itself and of the mesh where its base was"
            + (", and in the cameras' sight" if cameras_m is not None else "")
        )
    return Poses(np.array(names)[at], joints, Ts[at])
