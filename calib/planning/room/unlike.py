"""In which way planned stops are unlike those that were measured: what will be new there."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from calib.planning.stops import Poses
from calib.problem.model import Source
from calib.results.reach import far_beyond

# Beyond what was measured, at least, from which a stop is unlike all others. A choice: less changes
# little of what the beams and the tracker see.
BEYOND_LEAST = {"rad": np.radians(5.0), "m": 0.02}


@dataclass(frozen=True)
class Unlike:
    """Something that planned stops have and no measured one.

    Args:
        what: a joint, or the frame whose z axis is tilted from the world's.
        tilt: whether it is that.
        unit: rad or m.
        planned: least and largest of the planned stops that lie beyond; measured: of all measured.
    """

    what: str
    tilt: bool
    unit: str
    planned: tuple[float, float]
    measured: tuple[float, float]

    def document(self) -> dict[str, Any]:
        """As JSON."""
        name = "tilt" if self.tilt else "joint"
        ends = {"planned": list(self.planned), "measured": list(self.measured)}
        return {name: self.what, "unit": self.unit, **ends}

    def __str__(self) -> str:
        scale, unit = (np.degrees(1.0), "deg") if self.unit == "rad" else (1e3, "mm")
        planned, measured = (
            " to ".join(dict.fromkeys(f"{scale * end:.0f}" for end in ends))
            for ends in (self.planned, self.measured)
        )
        if self.tilt:
            return f"'{self.what}' tilted by {planned} {unit} (so far {measured})"
        return f"{self.what} at {planned} {unit} (so far {measured})"


def unlike(source: Source, measured: Poses, planned: Poses) -> list[Unlike]:
    """What planned stops have that no measured one has; nothing where none was measured.

    Args:
        source: the recording, whose rig they are of.
        measured, planned: the stops.
    """
    if not len(measured.joints):
        return []
    both = (_quantities(source, poses) for poses in (measured, planned))
    found = (_beyond(*one, two[-1]) for one, two in zip(*both, strict=True))
    return [each for each in found if each is not None]


def _quantities(source: Source, poses: Poses) -> Iterator[tuple[str, bool, str, np.ndarray]]:
    """What, whether it is a tilt, its unit, and its value (n,) at stops."""
    rig = source.rig
    frame = rig.lidar_frame or (rig.tracker.bodies[-1] if rig.tracker else None)
    if frame:
        T = poses.Ts_world_root @ rig.tree.place(frame, poses.joints).Ts_root_frame
        yield frame, True, "rad", np.arccos(np.clip(T[:, 2, 2], -1.0, 1.0))
    for (name, unit), joint in zip(rig.joint_units.items(), poses.joints.T, strict=True):
        yield name, False, unit, joint


def _beyond(
    what: str, tilt: bool, unit: str, measured: np.ndarray, planned: np.ndarray
) -> Unlike | None:
    out = planned[far_beyond(measured, planned, BEYOND_LEAST[unit])]
    if not len(out):
        return None
    ends, so_far = ((float(some.min()), float(some.max())) for some in (out, measured))
    return Unlike(what=what, tilt=tilt, unit=unit, planned=ends, measured=so_far)
