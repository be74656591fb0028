"""Targets and lengths: rods that hang askew, spheres that are mixed up, and instruments whose
lengths differ."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.optimize import linear_sum_assignment

from calib.rig import TargetSpec
from calib.rig.suspect import Suspect, listed
from chains import se3
from chains.align import align_points
from chains.errors import InputError
from sensors.reference import Reference
from sensors.stops import Targets

# A choice: the end of a rod of 0.2 m is then 10 mm off, where markers are known to tenths of one.
ASKEW_RAD = np.radians(3.0)
APART_M = 0.01  # a choice: tracker and scanner place spheres to better than a tenth of that
# Of how far spheres lie apart, what is left where they are mirrored: a choice. All of 0.27 m but
# 1 mm went where they were.
LEFT_MIRRORED = 0.2
NUMBERED, HANDEDNESS = "numbering", "handedness"  # of targets, what puts all of them right at once
UPWARDS = 0.9  # a choice, of the cosine: scanners are level to a degree, and have z up
SIGNIFICANT = 5.0  # sigmas of a ratio of lengths
# In a metre.
LENGTH_UNITS = {
    1000.0: "millimetres",
    100.0: "centimetres",
    39.37: "inches",
    3.281: "feet",
}
NEAR_A_UNIT = 0.03  # of a factor, by which a ratio may miss it
FARTHER = 30.0  # rooms are at most so many times as large as what is seen of them
ROOM_ACROSS = 2.5  # times the distance of their walls, rooms are across from corner to corner


def mixed_up(targets: Targets, spec: TargetSpec) -> list[Suspect]:
    """What of `odd_targets` puts all targets that are whole right at once: other numbers, or the
    other hand."""
    parts = targets.faro_m, targets.upper_m, targets.lower_m
    whole = np.isfinite(np.hstack(parts)).all(axis=1)
    if not whole.any():
        return []
    names = [name for name, kept in zip(targets.names, whole, strict=True) if kept]
    odd = odd_targets(Targets(names, *(part[whole] for part in parts)), spec)
    of_all = {NUMBERED, HANDEDNESS}.difference(names)
    return [s for s in odd if isinstance(s, Suspect) and s.name in of_all]


def odd_targets(targets: Targets, spec: TargetSpec) -> Iterator[str | Suspect]:
    """Rods that hang askew, lengths that differ between tracker and scanner, and spheres that both
    see at different places, or one of the two mirrored."""
    names, rods = np.array(targets.names), targets.lower_m - targets.upper_m
    rods = rods / np.linalg.norm(rods, axis=1, keepdims=True)
    down = np.median(rods, axis=0)
    down /= np.linalg.norm(down)
    askew = rods @ down < np.cos(ASKEW_RAD)
    if askew.any():
        said = (
            f"the rod of {listed(names[askew])} does not hang as the others do; are its markers "
            "swapped?"
        )
        yield Suspect("target", names[askew][0], said)
    sphere_m = targets.lower_m + spec.sphere_below_lower_marker_m * down
    try:
        T_world_reference, _ = align_points(sphere_m, targets.faro_m)
    except InputError:
        return
    there_m = se3.apply(T_world_reference, targets.faro_m)
    off_m = np.linalg.norm(sphere_m - there_m, axis=1)
    differing, mirrored_m = _ratio(sphere_m, there_m, spec), _mirrored_off_m(sphere_m, targets)
    if off_m.max() < APART_M and (T_world_reference[:3, :3].T @ down)[2] > UPWARDS:
        yield (
            "by upper and lower of targets.csv the rods stand upwards in the scanner's frame; are "
            "these two exchanged?"
        )
    if off_m.max() > APART_M and (order := _renumbered(sphere_m, targets.faro_m)) is not None:
        other = np.flatnonzero(order != np.arange(len(order)))
        pairs = ", ".join(f"{names[order[k]]} is the tracker's {names[k]}" for k in other)
        said = f"scanner and tracker number targets otherwise: the scanner's {pairs}"
        yield Suspect("target", NUMBERED, said)
    elif off_m.max() > APART_M and mirrored_m < min(APART_M, LEFT_MIRRORED * off_m.max()):
        said = (
            f"tracker and scanner place all targets within {max(1e3 * mirrored_m, 1.0):.0f} mm if "
            f"one of the two is mirrored, and up to {1e3 * off_m.max():.0f} mm apart as they are: "
            "are the tracker's coordinates left-handed, or two of their columns exchanged?"
        )
        yield Suspect("target", HANDEDNESS, said)
    elif differing is not None and not askew.any():
        yield differing
    elif off_m.max() > APART_M:
        said = (
            f"tracker and scanner place {names[off_m.argmax()]} {1e3 * off_m.max():.0f} mm apart, "
            f"the others up to {1e3 * np.sort(off_m)[-2]:.0f} mm; is it the same target in both?"
        )
        size_m = float(off_m.max())
        yield Suspect("target", str(names[off_m.argmax()]), said, size=size_m, unit="m")


def _mirrored_off_m(tracked_m: np.ndarray, targets: Targets) -> float:
    """How far (m) at most spheres of a tracker (M, 3) m, mirrored, lie from those of a scanner."""
    mirrored_m = tracked_m * [1.0, -1.0, 1.0]  # across any plane: what is left is a pose
    T, _ = align_points(mirrored_m, targets.faro_m)
    return float(np.linalg.norm(mirrored_m - se3.apply(T, targets.faro_m), axis=1).max())


def _renumbered(tracked_m: np.ndarray, scanned_m: np.ndarray) -> np.ndarray | None:
    """Which of the spheres of a scanner (M, 3) m is each of a tracker (M, 3) m, by its distances to
    all others; None where the spheres then still lie apart."""
    each = [np.linalg.norm(x[:, None] - x, axis=2) for x in (tracked_m, scanned_m)]
    one, other = (np.sort(distances_m, axis=1) for distances_m in each)
    order = linear_sum_assignment(np.linalg.norm(one[:, None] - other, axis=2))[1]
    T, _ = align_points(tracked_m, scanned_m[order])
    off_m = np.linalg.norm(tracked_m - se3.apply(T, scanned_m[order]), axis=1)
    return order if off_m.max() < APART_M else None


def _ratio(tracked_m: np.ndarray, scanned_m: np.ndarray, spec: TargetSpec) -> Suspect | None:
    """Lengths between spheres (M, 3) m by the tracker over those by the scanner, where the ratio
    is not 1 and explains most of how they differ."""
    a, b = tracked_m - tracked_m.mean(axis=0), scanned_m - scanned_m.mean(axis=0)
    square = np.sum(b**2)
    ratio = float(np.sum(a * b) / square)
    left_m = a - ratio * b
    free = 3 * len(a) - 7
    noise_m = max(np.hypot(spec.sigma_sphere_m, spec.sigma_marker_m),
                  np.sqrt(np.sum(left_m**2) / max(free, 1)))  # fmt: skip
    sigma = float(noise_m / np.sqrt(square))
    if abs(ratio - 1.0) < SIGNIFICANT * sigma:
        return None
    said = (
        f"distances between targets are {ratio:.6g} times as long by the tracker as by the scanner,"
        f" +- {sigma:.1g}"
    )
    for factor, unit in LENGTH_UNITS.items():
        for part, value in (("faro", 1 / ratio), ("upper and lower", ratio)):
            if abs(value / factor - 1) < NEAR_A_UNIT:
                return Suspect("target", "scale", f"{said}; is {part} in {unit}?", size=ratio - 1)
    said += "; one of the two is out of scale"
    return Suspect("target", "scale", said, size=ratio - 1.0, unit="1")


def odd_mesh(reference: Reference, reach_m: float) -> Iterator[Suspect]:
    """A mesh whose size is out of all proportion to how far the LiDAR sees.

    Args:
        reference: the mesh.
        reach_m: distance below which nineteen in twenty returns lie.
    """
    size_m = float(np.linalg.norm(np.ptp(reference.vertices_m, axis=0)))
    ratio = size_m / reach_m
    if 1 / FARTHER < ratio < FARTHER:
        return
    factor = min(
        LENGTH_UNITS, key=lambda f: abs(np.log(max(ratio / ROOM_ACROSS, ROOM_ACROSS / ratio) / f))
    )
    unit = LENGTH_UNITS[factor] if ratio > 1 else f"metres divided by {factor:g}"
    said = (
        f"the mesh is {size_m:.3g} m across, and nineteen in twenty returns come from within "
        f"{reach_m:.3g} m; is it in {unit}?"
    )
    yield Suspect("surface", "scale", said, size=ratio)
