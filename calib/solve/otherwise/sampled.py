"""Some beams of scans of a mesh, and how far off it they are, wherever else they are put."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calib.problem.problem import Problem
from calib.residuals.scan import ScanStop
from calib.residuals.surfaces import MeshSurface
from chains import se3
from sensors.lidar import Beams

# So many beams of so many scans tell orientations apart; beams are off by no more than this, as
# what they pass by may be anywhere behind.
SCANS_ASKED, BEAMS_A_SCAN, FARTHEST_OFF_M = 8, 150, 1.0
NEAR_M = 0.1  # mean error of these beams that asks for no other orientation: good ones have 0.02
# Of the mean error, what another orientation may have at most: a choice, between good ones' 0.02 m
# and the 0.1 m from which one is asked for.
NEARER = 0.5
# Mean error, at most, with other axes: 0.02 m of good beams, 0.1 m as a tenth of them are 1 m off,
# and some to spare. A room with floor and ceiling 0.3 m too low has 0.26 m as a mirror shows it.
FITS_M = 0.2

Values = Mapping[str, np.ndarray]


@dataclass(frozen=True)
class Sampled:
    """A scan, and T_reference_lidar (4, 4) as a state has it."""

    scan: ScanStop
    T: np.ndarray

    def turned(self, turns: np.ndarray) -> np.ndarray:
        """T_reference_lidar (G, 4, 4) with the LiDAR turned, or mirrored, (G, 3, 3) about its
        origin."""
        return self.T @ maps(turns)

    def read(self, whose: str, axes: np.ndarray, values: Values) -> np.ndarray:
        """The same (G, 4, 4) with other axes (G, 3, 3): of the mesh, into which they lead, or of
        the world that bodies are tracked in."""
        outer = self.scan.stops.reference
        if whose == "mesh" or outer is None:
            return maps(axes) @ self.T
        T_world_reference = values[outer]
        return se3.inverse(T_world_reference) @ maps(axes) @ T_world_reference @ self.T

    def some(self, most: int) -> Beams:
        """About so many of its beams, in the mesh's frame."""
        _, ray = self.scan.store.read(self.scan.index)
        some = np.unique(np.linspace(0, len(ray.range_m) - 1, most).round().astype(int))
        R = self.T[:3, :3]
        origin_m = se3.apply(self.T, ray.origin_m[some])
        return Beams(origin_m, ray.direction[some] @ R.T, ray.range_m[some])

    def off_m(self, at: np.ndarray, beams: int = BEAMS_A_SCAN) -> np.ndarray:
        """Mean error (G,) of so many beams, of maps (G, 4, 4) from the LiDAR's frame to the
        mesh's."""
        _, ray = self.scan.store.read(self.scan.index)
        some = np.linspace(0, len(ray.range_m) - 1, beams).round().astype(int)
        linear = at[:, :3, :3].mT
        origin = ray.origin_m[some] @ linear + at[:, None, :3, 3]
        direction = ray.direction[some] @ linear
        range_m = np.tile(ray.range_m[some], len(at))
        rays, here = Beams(origin.reshape(-1, 3), direction.reshape(-1, 3), range_m), np.eye(4)
        met = self.scan.meeting.associate(here, rays, {}, near_edges=False)
        surface = self.scan.meeting.meet(here, rays, {}, met)
        off_m = np.where(surface.usable, np.abs(range_m - surface.predicted_m), FARTHEST_OFF_M)
        return np.minimum(off_m, FARTHEST_OFF_M).reshape(len(at), -1).mean(axis=1)


def maps(linear: np.ndarray) -> np.ndarray:
    """Linear maps (G, 3, 3) as (G, 4, 4)."""
    out = np.tile(np.eye(4), (len(linear), 1, 1))
    out[:, :3, :3] = linear
    return out


def asked(scans: Sequence[Sampled]) -> list[Sampled]:
    """Some of the scans, spread evenly."""
    chosen = np.unique(np.linspace(0, len(scans) - 1, SCANS_ASKED).round().astype(int))
    return [scans[i] for i in chosen]


def turned_off_m(
    scans: Sequence[Sampled], turns: np.ndarray, beams: int = BEAMS_A_SCAN
) -> np.ndarray:
    """Mean error (G,) of so many beams of each, with the LiDAR turned (G, 3, 3)."""
    return np.mean([each.off_m(each.turned(turns), beams) for each in scans], axis=0)


def sampled_by_recording(problem: Problem, values: Values) -> dict[int, list[Sampled]]:
    """The scans that a mesh shows, by the number of their recording."""
    number = {id(source.recording): i for i, source in enumerate(problem.sources)}
    found: dict[int, list[Sampled]] = {}
    for scan in problem.scans:
        if isinstance(scan.meeting, MeshSurface):
            mine = found.setdefault(number[id(scan.recording)], [])
            mine.append(Sampled(scan, scan.pose(values)))
    return found
