"""Where to start: poses that nothing but the data knows, from closed forms."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calib.problem.model import Source
from chains import se3
from chains.align import align_points, mean_pose
from chains.errors import InputError
from sensors.stops import Targets

FEWEST_SPHERES = 3  # spheres that fix a pose


def root_pose(source: Source, stops: Sequence[int]) -> np.ndarray | None:
    """T_world_root (4, 4) of stops that share it, with every CAD and URDF value taken at its word.

    From tracked bodies: those with the fewest joints between them and the root. From points: the
    rigid motion that best lays the chain's points on those measured.

    Returns:
        None where the tracker does not say.
    """
    tracker = source.rig.tracker
    if tracker is None:
        return None
    seen = {b: _seen(source, b, stops) for b in tracker.bodies}
    seen = {b: index for b, index in seen.items() if len(index)}
    posed = [b for b in seen if not is_point(source, b)]
    if posed:
        body = min(posed, key=lambda b: len(source.rig.joints_to(b)))
        index = seen[body]
        T_world_body = body_poses(source, body)[index]
        return mean_pose(T_world_body @ se3.inverse(_placed(source, body, index)))
    root, world = [], []
    for body, index in seen.items():
        root.append(_placed(source, body, index)[:, :3, 3])
        world.append(source.recording.bodies[body][index, :3])
    if not root:
        return None
    try:
        return align_points(np.concatenate(world), np.concatenate(root))[0]
    except InputError:
        return None


def reference_from_targets(source: Source) -> np.ndarray | None:
    """T_world_reference (4, 4) from the spheres, the rods hanging along their mean direction.

    Returns:
        None where no targets are there, or what is left out leaves too few.

    Raises:
        InputError: there are too few.
    """
    targets, spec = source.recording.targets, source.rig.target
    if targets is None or spec is None:
        return None
    sphere = lower_markers(targets) + spec.sphere_below_lower_marker_m * gravity(source)
    known = np.isfinite(targets.faro_m).all(axis=1)
    if known.sum() < FEWEST_SPHERES and source.given is not None:
        return None
    try:
        return align_points(sphere[known], targets.faro_m[known])[0]
    except InputError as error:
        raise InputError(
            f"{source.recording.folder / 'targets.csv'}: {error}, and hang targets around an area"
        ) from None


def gravity(source: Source) -> np.ndarray:
    """Unit vector (3,) along which the rods hang, in the world frame."""
    down = _rods(source.recording.targets).mean(axis=0)
    return down / np.linalg.norm(down)


def lower_markers(targets: Targets) -> np.ndarray:
    """Lower marker (M, 3) of each rod, world frame; one that was left out is where it hangs from
    its upper marker on the other rods."""
    hung = targets.upper_m + _rods(targets).mean(axis=0)
    return np.where(np.isfinite(targets.lower_m), targets.lower_m, hung)


def _rods(targets: Targets) -> np.ndarray:
    """From upper to lower marker, of the rods that have both.

    Raises:
        InputError: none has.
    """
    rods = targets.lower_m - targets.upper_m
    rods = rods[np.isfinite(rods).all(axis=1)]
    if not len(rods):
        raise InputError(
            "no target has both of its markers, so nothing says which way rods hang; leave out "
            "fewer markers, or the rods as a whole"
        )
    return rods


def guessed_pose(source: Source, stops: Sequence[int]) -> np.ndarray | None:
    """T_reference_root (4, 4) as the recording's ``base_guess`` says, or None."""
    guess = source.recording.base_guess
    if guess is None:
        return None
    rows = guess[list(stops)]
    rows = rows[np.isfinite(rows).all(axis=1)]
    return mean_pose(se3.from_xyz_quat(rows[:, :3], rows[:, 3:])) if len(rows) else None


def body_poses(source: Source, body: str) -> np.ndarray:
    """T_world_body (K, 4, 4) as tracked: NaN where unseen, rotation identity for a point."""
    seen = source.recording.bodies[body]
    if not is_point(source, body):
        out = np.full((len(seen), 4, 4), np.nan)
        fine = np.isfinite(seen).all(axis=1)
        out[fine] = se3.from_xyz_quat(seen[fine, :3], seen[fine, 3:])
        return out
    out = np.tile(np.eye(4), (len(seen), 1, 1))
    out[:, :3, 3] = seen[:, :3]
    return out


def is_point(source: Source, body: str) -> bool:
    """Whether the tracker gives no orientation of this body."""
    return not np.isfinite(source.recording.bodies[body][:, 3:]).any()


def _seen(source: Source, body: str, stops: Sequence[int]) -> np.ndarray:
    index = np.asarray(stops, int)
    return index[np.isfinite(source.recording.bodies[body][index, :3]).all(axis=1)]


def _placed(source: Source, body: str, index: np.ndarray) -> np.ndarray:
    return source.rig.tree.place(body, source.recording.joints[index]).Ts_root_frame
