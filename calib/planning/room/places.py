"""Where the base can stand: where it stood, or anywhere on a part of the floor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from calib.problem import Problem
from calib.problem.model import Source
from chains import se3
from chains.errors import InputError
from sensors.recording import RecordedStops
from sensors.reference import Reference

PLACES_A_REGION = 6  # that are drawn in a region: a recording of a day has about as many
TRIED = 50  # times as many are tried
# A base keeps so far from what is as high as itself: half the diagonal of a Husky, 0.99 by 0.67 m.
BASE_CLEAR_M, BASE_HEIGHT_M = 0.6, 0.3


def where_it_stood(problem: Problem, values: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Location -> T_world_root (4, 4) at the first stop there, of the first recording."""
    recording = problem.sources[0].recording
    found = roots_of(problem, recording)
    out: dict[str, np.ndarray] = {}
    for k in sorted(found):
        out.setdefault(str(recording.location[k]), values[found[k]])
    return out


def roots_of(problem: Problem, recording: RecordedStops) -> dict[int, str]:
    """Number of every stop of a recording that tells anything -> the unknown that its base is."""
    found: dict[int, str] = {}
    for scan in problem.scans:
        if scan.recording.folder == recording.folder:
            found.setdefault(scan.index, scan.stops.root)
    for block in problem.bodies:
        for folder, k in block.stop_names:
            if folder == recording.folder:
                found.setdefault(k, block.stops.root)
    return found


def in_region(
    source: Source,
    region: Sequence[float],
    stood: Mapping[str, np.ndarray],
    T_world_reference: np.ndarray,
    rng: np.random.Generator,
) -> dict[str, np.ndarray]:
    """Some places on the floor, any way round, level, clear of furniture.

    The base stands as high above the mesh's floor as it stood at the recording's locations; where
    there are none, on it.

    Args:
        source: with its mesh.
        region: x and y of two corners, m, in the reference's frame.
        stood: location -> T_world_root (4, 4), of the recording.
        T_world_reference: (4, 4).
        rng: chance.

    Returns:
        Location -> T_world_root (4, 4).

    Raises:
        InputError: the base never moves, there is no mesh, or no free place.
    """
    if source.rig.moves == "never" and stood:
        raise InputError("--region: rig.yaml says that the base never moves (base.moves: never)")
    if source.reference is None:
        raise InputError("--region: there is no mesh to say where the floor is; add reference.mesh")
    low, high = np.sort(np.reshape(region, (2, 2)), axis=0)
    mesh, T_reference_world = source.reference, se3.inverse(T_world_reference)
    were = np.array([(T_reference_world @ T)[:3, 3] for T in stood.values()]).reshape(-1, 3)
    above_m = np.nan_to_num(np.median(were[:, 2] - _floor(mesh, were[:, :2]))) if len(were) else 0.0
    xy = rng.uniform(low, high, (TRIED * PLACES_A_REGION, 2))
    at = np.column_stack([xy, _floor(mesh, xy) + above_m])
    free = at[_free(mesh, at)][:PLACES_A_REGION]
    if not len(free):
        raise InputError(
            f"--region {' '.join(f'{x:g}' for x in region)}: no place in it has a floor and is "
            f"{BASE_CLEAR_M:g} m clear of what stands there; it is x0 y0 x1 y1, m, in the frame "
            f"'{source.rig.reference_frame}'"
        )
    yaw = rng.uniform(-np.pi, np.pi, len(free))
    still = np.zeros(len(free))
    Ts = T_world_reference @ se3.from_xyz_rpy(free, np.stack([still, still, yaw], axis=1))
    return {f"R{k:02d}": T for k, T in enumerate(Ts)}


def _floor(mesh: Reference, xy: np.ndarray) -> np.ndarray:
    """Height (n,) m of what lies below half the mesh's height at places (n, 2); NaN for nothing."""
    middle = float(mesh.vertices_m[:, 2].min() + mesh.vertices_m[:, 2].max()) / 2
    start = np.column_stack([xy, np.full(len(xy), middle)])
    down = np.broadcast_to([0.0, 0.0, -1.0], start.shape)
    height = mesh.cast(start, down).point_m[:, 2]
    return np.where(np.isfinite(height), height, np.nan)


def _free(mesh: Reference, at: np.ndarray) -> np.ndarray:
    """Indices of the places (n, 3) with a floor and nothing near."""
    turn = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    around = np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)
    known = np.flatnonzero(np.isfinite(at).all(axis=1))
    if not len(known):
        return known
    start = np.repeat(at[known] + [0.0, 0.0, BASE_HEIGHT_M], len(turn), axis=0)
    range_m = mesh.cast(start, np.tile(around, (len(known), 1))).range_m
    return known[range_m.reshape(len(known), -1).min(axis=1) > BASE_CLEAR_M]
