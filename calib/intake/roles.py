"""What each tracked body hangs on, base or tip of the arm, and roughly where, from the data."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from calib.intake.motion import place
from chains import se3
from chains.align import align_points, hand_eye, mean_pose
from chains.errors import InputError
from chains.frames import Edge
from chains.se3 import Array
from sensors.readers.base import Columns
from sensors.stops import POSE

# Rms that a guess may leave: arms and trackers are better than that.
GUESS_FITS_M, GUESS_FITS_RAD = 0.05, 0.05
FEWEST_SEEN = 4  # stops at which a body must be seen
OUTLIER_TIMES = 5.0  # times the median error

Ends = dict[str, Array]
"""Base and tip of the arm: T_world_end (K, 4, 4); NaN where what tells it was not seen."""

_TOO_FEW = (
    "{}: too few stops, or turns about one axis only, do not determine where it is mounted on "
    "the arm; give "
    "--rig with its frame from CAD"
)
_STRAYS = (
    "{} does not move as the joints say ({}); is this the arm, are units, signs and the order of "
    "Euler angles right, did the base move unseen? --rig takes its frame from CAD"
)


@dataclass(frozen=True)
class Mounted:
    """A body, the frame that it hangs on, T_parent_body (4, 4), where that comes from, and whether
    the body is a point, whose turn is none."""

    body: str
    parent: str
    T_parent_body: Array
    why: str
    point: bool = False


@dataclass(frozen=True)
class Roles:
    """Where bodies hang, and whether the arm's base stands still in the tracker's world."""

    mounted: list[Mounted]
    base_moves: bool
    odd: list[str]


def poses_of(columns: Columns) -> dict[str, Array]:
    """Tracked bodies: name -> T_world_body (K, 4, 4), NaN where it was not seen."""
    bodies = [name[:-3] for name in columns if name.endswith(".qw") and name != "base_guess.qw"]
    poses = {}
    for body in bodies:
        row = np.stack([columns[f"{body}.{part}"] for part in POSE], axis=1)
        poses[body] = se3.from_xyz_quat(row[:, :3], row[:, 3:])
    return poses


def points_of(columns: Columns) -> dict[str, Array]:
    """Tracked points: name -> (K, 3) in the world, NaN where it was not seen."""
    names = [name[:-2] for name in columns if name.endswith(".x")]
    return {
        name: np.stack([columns[f"{name}.{axis}"] for axis in "xyz"], axis=1)
        for name in names
        if f"{name}.qw" not in columns and name != "base_guess"
    }


def find_roles(
    columns: Columns, edges: Sequence[Edge], joints: Sequence[str], base: str, tip: str
) -> Roles:
    """Find on which side of the arm each body hangs: there it moves as the joints say.

    With two or more bodies those two are base and tip whose motion against each other the arm
    explains best; with one, or with points alone, the arm's base is taken to stand still.

    Raises:
        InputError: the joints explain no motion of a body; left-handed axes are named as such.
    """
    seen, points = poses_of(columns), points_of(columns)
    if not seen and not points:
        return Roles([], False, [])
    T_base_tip = place(edges, np.stack([columns[name] for name in joints], axis=1))
    if seen:
        mounted, ends = _place_pose(seen, T_base_tip, base, tip)
    else:
        mounted, ends = _place_point(points, T_base_tip, base, tip)
    more, odd = _others(seen, points, mounted, ends)
    return Roles([*mounted, *more], len(mounted) > 1, odd)


def _place_pose(
    seen: Mapping[str, Array], T_base_tip: Array, base: str, tip: str
) -> tuple[list[Mounted], Ends]:
    """The body whose motion the arm explains best, after that on the base where it has one."""
    fits = []
    for body in seen:
        for on_base in (None, *(other for other in seen if other != body)):
            against = seen[body] if on_base is None else se3.inverse(seen[on_base]) @ seen[body]
            fit = _fit(against, T_base_tip)
            if fit is not None:
                fits.append((fit[2] / GUESS_FITS_M + fit[3] / GUESS_FITS_RAD, body, on_base, fit))
    if not fits:
        raise InputError(_TOO_FEW.format(", ".join(seen)))
    _, body, on_base, (X, Z, rms_m, rms_rad) = min(fits, key=lambda fit: fit[0])
    why = f"{1e3 * rms_m:.1f} mm and {np.degrees(rms_rad):.2f} deg rms over {len(T_base_tip)} stops"
    if rms_m > GUESS_FITS_M or rms_rad > GUESS_FITS_RAD:
        raise InputError(_misfit(body, seen[body], on_base, T_base_tip, why))
    mounted, T_world_base = [Mounted(body, tip, X, why)], np.broadcast_to(Z, T_base_tip.shape)
    if on_base is not None:
        mounted.insert(0, Mounted(on_base, base, se3.inverse(Z), why))
        T_world_base = seen[on_base] @ Z
    return mounted, {tip: seen[body] @ se3.inverse(X), base: T_world_base}


def _place_point(
    points: Mapping[str, Array], T_base_tip: Array, base: str, tip: str
) -> tuple[list[Mounted], Ends]:
    """The point whose motion the arm explains best: `T_world_base T_base_tip x`, for an x."""
    fits = []
    for name, seen in points.items():
        at = np.isfinite(seen).all(axis=1)
        try:
            start, _ = align_points(seen[at], T_base_tip[at, :3, 3])
        except InputError:
            continue
        if np.count_nonzero(at) < FEWEST_SEEN or np.ptp(seen[at], axis=0).max() < GUESS_FITS_M:
            continue

        def off(v: Array, T: Array = start, world: Array = seen[at], arm: Array = T_base_tip[at]):
            return (world - se3.apply(T @ se3.exp(v[:6]) @ arm, v[None, 6:])[:, 0]).ravel()

        found = least_squares(off, np.zeros(9), loss="soft_l1", f_scale=GUESS_FITS_M)
        rms_m = float(np.sqrt(3 * np.median(np.square(found.fun))))
        fits.append((rms_m, name, start @ se3.exp(found.x[:6]), found.x[6:]))
    if not fits:
        raise InputError(_TOO_FEW.format(", ".join(points)))
    rms_m, name, Z, x = min(fits, key=lambda fit: fit[0])
    why = f"{1e3 * rms_m:.1f} mm over {len(T_base_tip)} stops"
    if rms_m > GUESS_FITS_M:
        raise InputError(_STRAYS.format(name, why))
    ends = {tip: Z @ T_base_tip, base: np.broadcast_to(Z, T_base_tip.shape)}
    return [Mounted(name, tip, se3.from_xyz_rpy(x, np.zeros(3)), why, point=True)], ends


def _fit(T_world_body: Array, T_base_tip: Array) -> tuple[Array, Array, float, float] | None:
    """T_tip_body, T_world_base and the rms errors (m, rad) left, without what is far off."""
    index = np.flatnonzero(np.isfinite(T_world_body).all(axis=(1, 2)))
    try:
        for _ in range(2):
            if len(index) < FEWEST_SEEN:
                return None
            X, Z = hand_eye(T_world_body[index], T_base_tip[index])
            gap = se3.log(se3.inverse(Z @ T_base_tip[index] @ X) @ T_world_body[index])
            size = np.linalg.norm(gap[:, :3], axis=1), np.linalg.norm(gap[:, 3:], axis=1)
            kept = np.all([s <= OUTLIER_TIMES * max(np.median(s), 1e-9) for s in size], axis=0)
            rms = [float(np.sqrt(np.mean(s[kept] ** 2))) for s in size]
            index = index[kept]
    except InputError:
        return None
    return X, Z, rms[1], rms[0]


def _misfit(body: str, seen: Array, on_base: str | None, T_base_tip: Array, why: str) -> str:
    """Why joints do not explain how a body moves: mirrored axes, or no one knows."""
    mirror = np.diag([1.0, 1.0, -1.0, 1.0])
    other = _fit(mirror @ seen @ mirror, T_base_tip)
    if (
        on_base is None
        and other is not None
        and other[2] < GUESS_FITS_M
        and other[3] < GUESS_FITS_RAD
    ):
        return (
            f"{body}: its poses are those of left-handed axes: with z reversed they fit the arm; "
            "export them right-handed"
        )
    return _STRAYS.format(body, why)


def _others(
    seen: Mapping[str, Array], points: Mapping[str, Array], mounted: Sequence[Mounted], ends: Ends
) -> tuple[list[Mounted], list[str]]:
    """Hang further bodies on the end of the arm that they move with; name those that do not."""
    placed, more, odd = {m.body for m in mounted}, [], []
    for body in (name for name in (*seen, *points) if name not in placed):
        for parent, T_world_parent in ends.items():
            inward = se3.inverse(T_world_parent)
            if body in seen:
                between = inward @ seen[body]
            else:
                at_m = se3.apply(inward, points[body][:, None])[:, 0]
                between = se3.from_xyz_rpy(at_m, np.zeros_like(at_m))
            between = between[np.isfinite(between).all(axis=(1, 2))]
            if len(between) and np.ptp(between[:, :3, 3], axis=0).max() < GUESS_FITS_M:
                why = f"it moves with {parent}"
                more.append(Mounted(body, parent, mean_pose(between), why, point=body in points))
                break
        else:
            odd.append(f"{body} moves with neither end of the arm, and is left out")
    return more, odd
