"""Axes of scans, of the mesh or of the tracker that were exchanged or mirrored."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from calib.problem.problem import Problem
from calib.solve.otherwise.orientations import best_turn, by_turning_frame, lidars_turned
from calib.solve.otherwise.sampled import FITS_M, NEAR_M, NEARER, asked, turned_off_m

MIRROR = np.diag([1.0, -1.0, 1.0])  # any other follows by turns


class OtherAxes(NamedTuple):
    """Coordinates that fit when they are read with other axes.

    Args:
        whose: "scans", "mesh" or "tracker".
        frame: of the LiDAR whose scans say so.
        read: (3, 3) what takes the coordinates that are there to those that fit; None for scans, of
            which it is only known that they are mirrored.
    """

    whose: str
    frame: str
    read: np.ndarray | None


def axes_of(
    problem: Problem, values: Mapping[str, np.ndarray], turned: Collection[str] | None = None
) -> Iterator[OtherAxes]:
    """Axes that were exchanged or mirrored, if the beams of a LiDAR are less than half as far off
    when they are set right: of the mesh or of the tracker by quarter turns and mirrors; of scans
    mirrored, in any orientation. Nothing where the LiDAR turned, as it is, does as well.

    Args:
        problem, values: as of `lidars_turned`.
        turned: the frames that this turns, where they are known.
    """
    turned = lidars_turned(problem, values) if turned is None else turned
    quarters = Rotation.create_group("O").as_matrix().round()
    every = np.concatenate([quarters, quarters @ MIRROR])
    for (name, _), scans in by_turning_frame(problem, values).items():
        chosen, frame = asked(scans), scans[0].scan.stops.rig.lidar_frame
        start_m = turned_off_m(chosen, np.eye(3)[None])[0]
        if start_m < NEAR_M or name in turned:
            continue
        for whose in ("mesh", "tracker"):
            at = (each.read(whose, every, values) for each in chosen)
            off_m = np.mean([s.off_m(T) for s, T in zip(chosen, at, strict=True)], axis=0)
            if off_m.min() < min(NEARER * start_m, FITS_M):
                read = every[np.argmin(off_m)]
                yield OtherAxes(whose, frame, read.T if whose == "mesh" else read)
                break
        else:
            if best_turn(scans, MIRROR) is not None:
                yield OtherAxes("scans", frame, None)
