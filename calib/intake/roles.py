"""What each tracked body hangs on, base or tip of the arm, and roughly where, from the data."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calib.intake.motion import place
from chains import se3
from chains.align import hand_eye, mean_pose
from chains.errors import InputError
from chains.frames import Edge
from chains.se3 import Array
from sensors.readers.base import POSE, Columns

FITS_M, FITS_RAD = 0.05, 0.05  # rms that a guess may leave: arms and trackers are better than that
LEAST = 4  # stops at which a body must be seen
OUTLIER = 5.0  # times the median error


@dataclass(frozen=True)
class Mounted:
    """A body, the frame that it hangs on, T_parent_body (4, 4), and where that comes from."""

    body: str
    parent: str
    T_parent_body: Array
    why: str


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


def find_roles(
    columns: Columns, edges: Sequence[Edge], joints: Sequence[str], base: str, tip: str
) -> Roles:
    """Find on which side of the arm each body hangs: there it moves as the joints say.

    With two or more bodies those two are base and tip whose motion against each other the arm
    explains best; with one, the arm's base is taken to stand still.

    Raises:
        InputError: the joints explain no motion of a body; left-handed axes are named as such.
    """
    seen = poses_of(columns)
    if not seen:
        return Roles([], False, [])
    T_base_tip = place(edges, np.stack([columns[name] for name in joints], axis=1))
    fits = []
    for body in seen:
        for on_base in (None, *(other for other in seen if other != body)):
            against = seen[body] if on_base is None else se3.inverse(seen[on_base]) @ seen[body]
            fit = _fit(against, T_base_tip)
            if fit is not None:
                fits.append((fit[2] / FITS_M + fit[3] / FITS_RAD, body, on_base, fit))
    if not fits:
        raise InputError(
            f"{', '.join(seen)}: too few stops, or turns about one axis only, do not tell where it "
            "hangs on the arm; give --rig with its frame from CAD"
        )
    _, body, on_base, (X, Z, rms_m, rms_rad) = min(fits, key=lambda fit: fit[0])
    why = f"{1e3 * rms_m:.1f} mm and {np.degrees(rms_rad):.2f} deg rms over {len(T_base_tip)} stops"
    if rms_m > FITS_M or rms_rad > FITS_RAD:
        raise InputError(_misfit(body, seen[body], on_base, T_base_tip, why))
    mounted = [Mounted(body, tip, X, why)]
    if on_base is not None:
        mounted.insert(0, Mounted(on_base, base, se3.inverse(Z), why))
    odd = _others(seen, mounted)
    return Roles(mounted, on_base is not None, odd)


def _fit(T_world_body: Array, T_base_tip: Array) -> tuple[Array, Array, float, float] | None:
    """T_tip_body, T_world_base and the rms errors (m, rad) left, without what is far off."""
    index = np.flatnonzero(np.isfinite(T_world_body).all(axis=(1, 2)))
    try:
        for _ in range(2):
            if len(index) < LEAST:
                return None
            X, Z = hand_eye(T_world_body[index], T_base_tip[index])
            gap = se3.log(se3.inverse(Z @ T_base_tip[index] @ X) @ T_world_body[index])
            size = np.linalg.norm(gap[:, :3], axis=1), np.linalg.norm(gap[:, 3:], axis=1)
            kept = np.all([s <= OUTLIER * max(np.median(s), 1e-9) for s in size], axis=0)
            rms = [float(np.sqrt(np.mean(s[kept] ** 2))) for s in size]
            index = index[kept]
    except InputError:
        return None
    return X, Z, rms[1], rms[0]


def _misfit(body: str, seen: Array, on_base: str | None, T_base_tip: Array, why: str) -> str:
    """Why joints do not explain how a body moves: mirrored axes, or no one knows."""
    mirror = np.diag([1.0, 1.0, -1.0, 1.0])
    other = _fit(mirror @ seen @ mirror, T_base_tip)
    if on_base is None and other is not None and other[2] < FITS_M and other[3] < FITS_RAD:
        return (
            f"{body}: its poses are those of left-handed axes: with z reversed they fit the arm; "
            "export them right-handed"
        )
    return (
        f"{body} does not move as the joints say ({why}); is this the arm, are units, signs and "
        "the order of Euler angles right, did the base move unseen? --rig takes its frame from CAD"
    )


def _others(seen: Mapping[str, Array], mounted: list[Mounted]) -> list[str]:
    """Hang further bodies on those placed, where they move with them; name those that do not."""
    odd = []
    placed = list(mounted)
    for body in [name for name in seen if name not in {m.body for m in placed}]:
        for anchor in placed:
            between = se3.inverse(seen[anchor.body]) @ seen[body]
            between = between[np.isfinite(between).all(axis=(1, 2))]
            if len(between) and np.ptp(between[:, :3, 3], axis=0).max() < FITS_M:
                T = anchor.T_parent_body @ mean_pose(between)
                mounted.append(Mounted(body, anchor.parent, T, f"it moves with {anchor.body}"))
                break
        else:
            odd.append(f"{body} moves with neither end of the arm, and is left out")
    return odd
