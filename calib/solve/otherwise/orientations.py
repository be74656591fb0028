"""Orientations of a LiDAR in its frame: the one from which its beams end on the mesh."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from calib.problem.problem import Problem
from calib.residuals.scan import ScanStop
from calib.residuals.surfaces import MeshSurface
from calib.solve.otherwise.sampled import (
    BEAMS_A_SCAN,
    NEAR_M,
    NEARER,
    Sampled,
    Values,
    asked,
    turned_off_m,
)
from chains import se3

# Orientations of a LiDAR are looked at on a grid, of turns by up to 0.6 rad about three axes beside
# each of the 24 that map a cube onto itself, and on finer ones beside the best of these. From
# 0.3 rad away passes over the scans find the optimum.
STEP_RAD, FINER_RAD, BEST = 0.3, (0.15, 0.07), 8
# Of the first grid's 3,000 a few beams, of all scans together, choose those that all are asked
# about. In nine rooms, turned 27 ways, 100 beams and 50 orientations found what all beams did
# (`tests/bench/bench_turns.py`).
CHOOSING_BEAMS, CHOSEN = 160, 200


def lidars_turned(problem: Problem, values: Values) -> dict[str, np.ndarray]:
    """The frame of each LiDAR turned as its scans fit the mesh best, of orientations all around.

    Args:
        problem: with scans.
        values: the state; a LiDAR's origin stays where it has it.

    Returns:
        The unknowns of the frames to turn, by name: of those LiDARs whose beams are then less than
        half as far off.
    """
    return {
        name: _with_turn(values[name], start, turn)
        for (name, start), scans in by_turning_frame(problem, values).items()
        if (turn := best_turn(scans)) is not None
    }


def by_turning_frame(problem: Problem, values: Values) -> dict[tuple[str, int], list[Sampled]]:
    """The scans of each LiDAR that a mesh shows, by the unknown that turns its frame."""
    seen: dict[tuple[str, int], list[Sampled]] = {}
    for scan in problem.scans:
        edge = _free_edge(problem, scan)
        if edge and isinstance(scan.meeting, MeshSurface):
            seen.setdefault(edge, []).append(Sampled(scan, scan.pose(values)))
    return seen


def best_turn(scans: Sequence[Sampled], of: np.ndarray | None = None) -> np.ndarray | None:
    """The turn (3, 3) of a LiDAR that makes its beams fit best, after they were mirrored, say, by
    `of` (3, 3); None where none is much better than all as it is."""
    chosen, of = asked(scans), np.eye(3) if of is None else of
    start_m = float(turned_off_m(chosen, np.eye(3)[None])[0])
    if start_m < NEAR_M:
        return None
    turns = _beside(Rotation.create_group("O").as_matrix(), STEP_RAD * np.arange(-2, 3))
    off_m = turned_off_m(chosen, turns @ of, min(CHOOSING_BEAMS // len(chosen), BEAMS_A_SCAN))
    turns = turns[np.argsort(off_m)[:CHOSEN]]
    for step in FINER_RAD:
        best = np.argsort(turned_off_m(chosen, turns @ of))[:BEST]
        turns = _beside(turns[best], step * np.arange(-1, 2))
    found_m = turned_off_m(chosen, turns @ of)
    return turns[np.argmin(found_m)] if found_m.min() < NEARER * start_m else None


def _beside(turns: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Turns (G, 3, 3), each turned further by all combinations of angles about three axes."""
    further = se3.so3_exp(np.stack(np.meshgrid(*[angles] * 3), axis=-1).reshape(-1, 3))
    return (turns[:, None] @ further).reshape(-1, 3, 3)


def _free_edge(problem: Problem, scan: ScanStop) -> tuple[str, int] | None:
    """Unknown that may turn the frame of a LiDAR any way, the same at all stops, and where its
    rotation vector begins; None where there is none."""
    path = scan.stops.rig.tree.path(scan.stops.rig.lidar_frame)
    if not path:  # it is the rig's root
        return None
    for name, own in scan.stops.edge_bases.items():
        basis = scan.stops.at_edges(name, own[:1])
        turns = np.flatnonzero(np.any(basis[0, path[-1], :3] != 0, axis=0))
        same = len(own) == 1 and name in problem.calibration
        if same and np.array_equal(basis[0, path[-1], :3][:, turns], np.eye(3)):
            return name, int(turns[0])
    return None


def _with_turn(value: np.ndarray, start: int, turn: np.ndarray) -> np.ndarray:
    """A frame's offsets with its rotation vector, which begins there, turned."""
    out, angles = value.copy(), slice(start, start + 3)
    out[angles] = se3.so3_log(se3.so3_exp(value[angles]) @ turn)
    return out
