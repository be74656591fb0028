"""Joints that nothing reads, at stops where no tracked body beyond them is seen: the scan of the
stop tells where they were."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.problem.problem import Problem
from calib.rig.unread import values_between
from calib.solve.otherwise.orientations import BEST
from calib.solve.otherwise.sampled import (
    FITS_M,
    NEAR_M,
    NEARER,
    Sampled,
    Values,
    sampled_by_recording,
)

# Values of all such joints of a stop are tried over their limits, and beside the best of these on
# grids that are finer by a half each time, until a step is as small as this, rad or m: a scan 4 m
# from a wall is then off by less than `NEAR_M`, from where passes over the scans find the optimum.
FINEST_STEP = 0.02
MOST_AT_ONCE = 3  # joints: of more, the grid has fewer than eight values of each


def joints_by_scans(problem: Problem, values: Values) -> dict[str, np.ndarray]:
    """What is to be added to the joints of such stops as their scans fit the mesh best.

    Args:
        problem: with scans.
        values: the state; the rig stands where it has it.

    Returns:
        The unknowns of the joints, by name: where beams are then less than half as far off.
    """
    found: dict[str, np.ndarray] = {}
    if not any(source.unread for source in problem.sources):
        return found
    seen: dict[str | None, set[str]] = {}  # unknown of joints -> those before any body seen there
    for body in problem.bodies:
        seen.setdefault(body.stops.noise, set()).update(body.stops.rig.joints_to(body.body))
    for number, scans in sampled_by_recording(problem, values).items():
        unread = problem.sources[number].unread
        for each in scans:
            stop = _Stop(each, values)
            axes = stop.untold(unread, seen.get(stop.name, set()))
            if 0 < len(axes) <= MOST_AT_ONCE and (best := stop.best(axes)) is not None:
                found[stop.name] = best
    return found


@dataclass(frozen=True)
class _Stop:
    """A scan, and the state."""

    sampled: Sampled
    values: Values

    @property
    def name(self) -> str | None:
        """The unknown of its joints."""
        return self.sampled.scan.stops.noise

    def untold(self, unread: frozenset[tuple[str, str]], seen: set[str]) -> list[int]:
        """Numbers of its joints that nothing reads and no body shows, of those that move the
        LiDAR."""
        scan = self.sampled.scan
        stop, rig = scan.recording.stops[scan.index], scan.stops.rig
        moving = set(rig.joints_to(rig.lidar_frame)) - seen
        return [i for i, n in enumerate(rig.joint_names) if n in moving and (stop, n) in unread]

    def best(self, axes: Sequence[int]) -> np.ndarray | None:
        """What is added to its joints (J,) as beams fit best; None where none is much better."""
        start = self.values[self.name]
        start_m = float(self._off_m(start[None])[0])
        if start_m < NEAR_M:
            return None
        rig, q = self.sampled.scan.stops.rig, self.sampled.scan.stops.joints[0]
        missing = np.isin(np.arange(len(q)), axes)
        tried = values_between(rig, q[None], missing[None])[:, 0] - q
        each = round(len(tried) ** (1 / len(axes)))
        step = np.ptp(tried[1:], axis=0) / (each - 1)
        beside = np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * len(axes)), axis=-1)
        offsets = np.zeros((beside[..., 0].size, len(q)))
        offsets[:, axes] = beside.reshape(-1, len(axes))
        off_m = self._off_m(tried)
        while step.max() > FINEST_STEP:
            step = step / 2.0
            best = tried[np.argsort(off_m)[:BEST]]
            tried = (best[:, None] + step * offsets).reshape(-1, len(q))
            off_m = self._off_m(tried)
        good = off_m.min() < min(NEARER * start_m, FITS_M)
        return tried[np.argmin(off_m)] if good else None

    def _off_m(self, added: np.ndarray) -> np.ndarray:
        """Mean error (G,) of its beams with so much added to its joints (G, J)."""
        scan = self.sampled.scan
        return self.sampled.off_m(
            np.stack([scan.pose({**self.values, self.name: each}) for each in added])
        )
