"""What to simulate: a preset by name, or a YAML file."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, Self

import pydantic

from chains.errors import InputError
from sensors.documents import Document, nearest, read_yaml, validate

SURFACES = 200  # that values by chance are drawn for: more than any room here has


class Spec(Document):
    """A recording to be simulated; the defaults are the preset `default`.

    Attributes:
        lidar: name in the sensor catalogue, or none.
        locations, stops_per_location: how often base and arm are put elsewhere.
        column_step: every how many-th azimuth column is kept.
        sweeps: sweeps per stop.
        raw: every sweep is written, else the average per direction.
        arm, mesh, targets: whether there is one, and how many hang.
        tracker: bodies seen as poses, as points, or no tracker.
        levels: frames, the LiDAR's or links of the arm, with an accelerometer.
        passive: joints of the arm that nothing reads.
        base_moves: when the base stands elsewhere; where no tracker sees it, stops have a guess.
        mesh_error_m: sd of the reference mesh, smooth over each surface and common to it in halves.
        mixed_pixel_share: share of the returns whose range is a mixture or far off.
        occluded_share: share of the stops at which the mount's markers are not seen.
        level: the LiDAR's spin axis stays vertical.
        poses: what the arm does from stop to stop: it goes anywhere; or one joint turns and all
            others stay at 0, at each location the next one; or it is read while it moves.
        acting: effects that act beside the default ones, or file of effects -> the value of each
            parameter, as it is, in the effect's unit.
        room: furnished, or bare.
        noise: every instrument's noise, as a multiple of what the rig states.
        build_error: how far the hardware is from paper, as a multiple of what is usual.
        world_seed: recordings with the same one share room, arm, base, trackers and targets and
            differ in the mounted LiDAR and in where it stood; none means the recording's own seed.
    """

    lidar: str | None = "ouster_os0_128_rev6"
    locations: int = pydantic.Field(default=6, ge=1)
    stops_per_location: int = pydantic.Field(default=4, ge=1)
    column_step: int = pydantic.Field(default=16, ge=1)
    sweeps: int = pydantic.Field(default=20, ge=1)
    raw: bool = False
    arm: bool = True
    tracker: Literal["poses", "points"] | None = "poses"
    levels: tuple[str, ...] = ()
    passive: tuple[str, ...] = ()
    mesh: bool = True
    targets: int = pydantic.Field(default=5, ge=0)
    base_moves: Literal["stop", "location", "never"] = "stop"
    mesh_error_m: float = pydantic.Field(default=0.0006, ge=0)
    mixed_pixel_share: float = pydantic.Field(default=0.004, ge=0, le=1)
    occluded_share: float = pydantic.Field(default=0.1, ge=0, le=1)
    level: bool = False
    poses: Literal["anywhere", "one_joint", "moving"] = "anywhere"
    acting: dict[str, float] = pydantic.Field(default_factory=dict)
    room: Literal["lab", "box"] = "lab"
    noise: float = pydantic.Field(default=1.0, ge=0)
    build_error: float = pydantic.Field(default=1.0, ge=0)
    world_seed: int | None = pydantic.Field(default=None, ge=0)

    @property
    def names(self) -> dict[str, list[str]]:
        """Of all stops, of the location (K,) of each, of targets, and of surfaces."""
        places = [(a, b) for a in range(self.locations) for b in range(self.stops_per_location)]
        return {
            "stop": [f"L{a:02d}P{b:02d}" for a, b in places],
            "location": [f"L{a:02d}" for a, _ in places],
            "target": [f"T{m + 1}" for m in range(self.targets)],
            "surface": [str(k) for k in range(SURFACES)],
        }

    @pydantic.model_validator(mode="after")
    def _fits_together(self) -> Self:
        if self.targets and self.tracker is None:
            raise ValueError("targets are seen by a tracker; give one, or targets: 0")
        if self.targets in (1, 2):
            raise ValueError("a frame needs 3 targets or more; give 3, or targets: 0")
        if self.tracker is None and not (self.mesh and self.lidar):
            raise ValueError("without a tracker a lidar and a mesh are needed to place anything")
        if self.tracker == "points" and not self.arm:
            raise ValueError("points without an arm do not tell how the rig is turned; use poses")
        if self.poses != "anywhere" and (self.lidar or not self.arm):
            raise ValueError(f"poses {self.poses} are of an arm alone; give one, and no lidar")
        if self.poses == "one_joint" and self.base_moves == "never":
            raise ValueError("at each location another joint turns; base_moves: location or stop")
        return self


# Without so many spoilt returns a room's cloud-to-mesh distances scatter by far too little.
_PAPER = {
    "locations": 9,
    "stops_per_location": 10,
    "column_step": 1,
    "sweeps": 100,
    "mixed_pixel_share": 0.04,
}
_NO_LIDAR = {"lidar": None, "mesh": False, "targets": 0, "stops_per_location": 12}

PRESETS: dict[str, Spec] = {
    "default": Spec(),
    "paper-qt64": Spec(lidar="hesai_pandarqt64", **_PAPER),
    "paper-xt32": Spec(lidar="hesai_pandarxt32", **_PAPER),
    "paper-os0-rev6": Spec(lidar="ouster_os0_128_rev6", **_PAPER),
    "paper-os0-rev7": Spec(lidar="ouster_os0_128_rev7", **_PAPER),
    "tiny": Spec(lidar="hesai_pandarxt32", locations=4, stops_per_location=3, column_step=100),
    "arm-tracker": Spec(**_NO_LIDAR),
    "lidar-tracker": Spec(arm=False, occluded_share=0),
    "lidar-arm": Spec(tracker=None, targets=0, base_moves="location"),
    "planes": Spec(mesh=False, targets=0),
    "targets": Spec(lidar=None, stops_per_location=8, targets=8),
    "one-joint": Spec(**{**_NO_LIDAR, "locations": 6, "poses": "one_joint"}),
    "moving": Spec(**_NO_LIDAR, poses="moving"),
    "laser-tracker": Spec(**{**_NO_LIDAR, "tracker": "points", "base_moves": "never"}),
}


def load_spec(name: str) -> Spec:
    """The preset of this name, or what a YAML file of this path describes.

    Raises:
        InputError: there is neither, or a key of the file is unknown or out of range.
    """
    if name in PRESETS:
        return PRESETS[name]
    if not Path(name).is_file():
        raise InputError(f"{name} is neither a YAML file nor a preset{nearest(name, PRESETS)}.")
    data, marks = read_yaml(name)
    return validate(Spec, data, name, marks)
