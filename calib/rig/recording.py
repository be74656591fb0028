"""A recording opened by its folder alone."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Self

from calib.rig.description import load_rig
from sensors import recording


class Recording(recording.RecordedStops):
    """K stops of the rig that the folder's rig.yaml describes; `Recording.open` reads one."""

    @classmethod
    def open(
        cls,
        folder: str | Path,
        joint_names: Sequence[str] | None = None,
        bodies: Sequence[str] | None = None,
        rings: int | None = None,
    ) -> Self:
        """Read and check the stops and targets of a recording, without reading any scan.

        Args:
            folder: where it is.
            joint_names: of the columns of joints; what is not given, rig.yaml says.
            bodies: those that are tracked, likewise.
            rings: how many the LiDAR has, likewise.

        Raises:
            InputError: what is wrong, and where.
        """
        rig = load_rig(folder)
        joint_names = rig.joint_names if joint_names is None else joint_names
        if bodies is None:
            bodies = rig.tracker.bodies if rig.tracker else ()
        if rings is None and rig.lidar:
            rings = rig.lidar.rings
        return super().open(folder, joint_names, bodies, rings)
