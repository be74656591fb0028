"""The study's own way to a calibration: one thing after another, each from data of its own.

Arm lengths from circles, the scanner's frame from five spheres, mount and LiDAR from CAD, where the
rig stood from one tracked body, a range offset from the mean residual. Each step takes the ones
before at their word.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from calib.effects import View
from calib.effects.arm import ArmLinkLength
from calib.problem import Problem, start
from calib.problem.model import Source
from calib.residuals.scan import ScanStop
from chains import se3
from chains.align import align_points
from chains.errors import InputError

STEP_M = 1e-4
LEAST_EFFECT = 0.05  # of the best-known length's effect on the radii: below it a length is not told
LENGTHS, RINGS = "arm_link_length", "ring_range_offset"


def fit_circle(points_m: np.ndarray) -> float:
    """Radius, m, of the circle through points (N, 3): their plane, then linear least squares.

    ``|x|^2 = 2 c.x + (r^2 - |c|^2)`` in the plane (Kåsa 1976); good for arcs, not for slivers.

    Raises:
        InputError: fewer than 3 points.
    """
    if len(points_m) < 3:
        raise InputError(f"{len(points_m)} points do not fix a circle; at least 3 are needed")
    local = points_m - points_m.mean(axis=0)
    flat = local @ np.linalg.svd(local, full_matrices=False)[2][:2].T
    rows = np.column_stack([2 * flat, np.ones(len(flat))])
    x, y, rest = np.linalg.lstsq(rows, np.sum(flat**2, axis=1))[0]
    return float(np.sqrt(rest + x**2 + y**2))


def lengths_from_circles(source: Source) -> np.ndarray:
    """By how much each arm edge is longer than drawn (E,), m, as one-joint circles tell it.

    The last tracked body goes round each joint's axis on a circle. Its radius is taken as length:
    the chain's lengths are changed until the circles of its own body have the measured radii. A
    length that no radius depends on, such as one along a joint's axis, stays as drawn.

    Args:
        source: a recording in which, at each location, one joint alone turns.

    Raises:
        InputError: at some location no joint turns alone.
    """
    recording, rig = source.recording, source.rig
    first, last = _bodies(source)
    T_first_last = se3.inverse(start.body_poses(source, first)) @ start.body_poses(source, last)
    arcs = [recording.location == name for name in np.unique(recording.location)]
    for arc in arcs:
        if np.count_nonzero(np.ptp(recording.joints[arc], axis=0) > 0) != 1:
            raise InputError(
                f"{recording.folder}: at location {recording.location[arc][0]} not one joint alone "
                f"turns; circles need one each"
            )
    basis = ArmLinkLength().basis(View(rig, 1, {}, recording.joints[:1]))

    def radii(lengths_m: np.ndarray) -> np.ndarray:
        twists = basis @ lengths_m
        at = rig.tree.place(last, recording.joints, twists).Ts_root_frame[:, :3, 3]
        return np.array([fit_circle(at[arc]) for arc in arcs])

    seen = np.isfinite(T_first_last[:, 0, 3])
    measured = np.array([fit_circle(T_first_last[arc & seen, :3, 3]) for arc in arcs])
    lengths_m = np.zeros(len(rig.arm_edges))
    for _ in range(3):  # radii are nearly linear in lengths
        steps = STEP_M * np.eye(len(lengths_m))
        slope = np.stack([radii(lengths_m + s) - radii(lengths_m - s) for s in steps], axis=1)
        slope /= 2 * STEP_M
        change, *_ = np.linalg.lstsq(slope, measured - radii(lengths_m), rcond=LEAST_EFFECT)
        lengths_m = lengths_m + change
    return lengths_m


def spheres_mm(source: Source) -> float:
    """Mean distance, mm, of the spheres' centres from where tracker and alignment put them."""
    targets, spec = source.recording.targets, source.rig.target
    sphere_m = targets.lower_m + spec.sphere_below_lower_marker_m * start.gravity(source)
    T_opti_faro, _ = align_points(sphere_m, targets.faro_m)
    away_m = se3.apply(T_opti_faro, targets.faro_m) - sphere_m
    return 1e3 * float(np.linalg.norm(away_m, axis=1).mean())


def from_paper(problem: Problem, lengths_m: np.ndarray | None = None) -> dict[str, np.ndarray]:
    """A state with everything as on paper, but the arm's lengths (E,) where they are given.

    `opti` to `faro` comes from the spheres: no paper knows it.
    """
    values = dict(problem.initial)
    if lengths_m is not None:
        (term,) = (t for t in problem.terms[0] if t.variable == LENGTHS)
        values[LENGTHS] = lengths_m[term.free]
    return values


def way(source: Source, scan: ScanStop, values: Mapping, body: str) -> np.ndarray | None:
    """T_opti_lidar (4, 4) of a stop by one tracked body, or None where it was not seen.

    ``T_opti_body @ inverse(T_root_body) @ T_root_lidar``: of a body on the mount the joints cancel.
    """
    T_opti_body = start.body_poses(source, body)[scan.index]
    if not np.isfinite(T_opti_body).all():
        return None
    T_root_lidar = scan.stops.in_root(source.rig.lidar_frame, values).T[0]
    return T_opti_body @ se3.inverse(scan.stops.in_root(body, values).T[0]) @ T_root_lidar


def by_tracker(
    source: Source, problem: Problem, values: Mapping[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """The state with every stop where the mount's markers say, or else base markers and arm."""
    first, last = _bodies(source)
    return standing(source, problem, values, (last, first))


def by_arm(
    source: Source, problem: Problem, values: Mapping[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """The state with every stop where base markers and arm say."""
    return standing(source, problem, values, _bodies(source)[:1])


def standing(
    source: Source, problem: Problem, values: Mapping[str, np.ndarray], bodies: tuple[str, ...]
) -> dict[str, np.ndarray]:
    """The state with every stop where the first of these bodies that was seen says."""
    values = dict(values)
    for scan in problem.scans:
        ways = (way(source, scan, values, body) for body in bodies)
        T_opti_lidar = next(T for T in ways if T is not None)
        T_root_lidar = scan.stops.in_root(source.rig.lidar_frame, values).T[0]
        values[scan.stops.root] = T_opti_lidar @ se3.inverse(T_root_lidar)
    return values


def offset_by_mean(values: Mapping[str, np.ndarray], mean_m: float) -> dict[str, np.ndarray]:
    """The state with one range offset, the mean residual."""
    return {**values, RINGS: np.full_like(values[RINGS], mean_m)}


def offsets_by_ring(
    values: Mapping[str, np.ndarray], ring: np.ndarray, error_m: np.ndarray, count: np.ndarray
) -> dict[str, np.ndarray]:
    """The state with each ring's mean residual as its offset.

    Args:
        values: a state of a model with every ring's offset free.
        ring, error_m, count: (N,) of directions: ring, mean residual and number of returns.
    """
    size = len(values[RINGS])
    total, n = np.bincount(ring, count * error_m, size), np.bincount(ring, count, size)
    mean_m = total.sum() / n.sum()  # of a ring that was not seen
    return {**values, RINGS: np.where(n > 0, total / np.maximum(n, 1), mean_m)}


def _bodies(source: Source) -> tuple[str, str]:
    """The tracked bodies before and beyond the arm."""
    rig = source.rig
    beyond = [b for b in rig.tracker.bodies if b in rig.beyond_arm]
    before = [b for b in rig.tracker.bodies if b not in rig.beyond_arm]
    if not (beyond and before):
        raise InputError(f"{rig.folder}: two ways need a tracked body on either side of the arm")
    return before[0], beyond[0]
