"""A recording opened by its folder alone."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Self

from calib.rig.description import Rig, load_rig
from calib.rig.unread import with_unread
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
        levels: Sequence[str] | None = None,
        unread: Sequence[str] | None = None,
    ) -> Self:
        """Read and check the stops and targets of a recording, without reading any scan.

        Args:
            folder: where it is.
            joint_names: of the columns of joints; what is not given, rig.yaml says.
            bodies: those that are tracked, likewise.
            rings: how many the LiDAR has, likewise.
            levels: frames with an accelerometer, likewise.
            unread: joints that nothing reads, likewise: NaN where the file has no number.

        Raises:
            InputError: what is wrong, and where.
        """
        said = columns_of(rig := load_rig(folder))
        given = {"joint_names": joint_names, "bodies": bodies, "rings": rings, "levels": levels}
        given["unread"] = unread
        chosen = {name: each for name, each in given.items() if each is not None}
        return super().open(rig.folder, **(said | chosen))


def recorded(rig: Rig) -> recording.RecordedStops:
    """The recording of a rig, with a value for every joint; InputError says what is wrong."""
    return with_unread(rig, recording.RecordedStops.open(rig.folder, **columns_of(rig)))


def columns_of(rig: Rig) -> dict[str, Sequence[str] | int | None]:
    """What a rig's recording has columns for: the arguments of `RecordedStops.open`."""
    return {
        "joint_names": rig.joint_names,
        "bodies": rig.tracker.bodies if rig.tracker else (),
        "rings": rig.lidar.rings if rig.lidar else None,
        "levels": rig.levels.frames if rig.levels else (),
        "unread": rig.passive,
    }
