"""rig.yaml as it is written: its keys, their types, and what no number in it can be."""

from __future__ import annotations

from typing import Annotated, Literal, Self

import numpy as np
import pydantic

from chains.errors import is_file_name, shortened
from sensors.documents import Document, Format, Number, Triple
from sensors.lidar import LidarFile, Size

Sigma = Annotated[Number, pydantic.Field(gt=0)]

RECORDING_FORMAT = Format(kind="recording", newest=1)
LARGEST_FRAME_M = 10.0  # a choice: no rig is larger, and in millimetres no frame is so small


def _file_name(name: str) -> str:
    if not is_file_name(name):
        raise ValueError(f"{shortened(name)} is no name for a file, and a rig's names some")
    return name


def _metres(length: float) -> float:
    if abs(length) > LARGEST_FRAME_M:
        raise ValueError(f"{length:g} m looks like millimetres; give metres")
    return length


def _once_each(names: tuple[str, ...]) -> tuple[str, ...]:
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"{name} is there twice; name each once")
    return names


Names = Annotated[
    tuple[str, ...], pydantic.Field(min_length=1), pydantic.AfterValidator(_once_each)
]


def _in_a_row(tip: object) -> object:
    return (tip,) if isinstance(tip, str) else tip


def _each_station(stood: object) -> object:
    flat = isinstance(stood, list) and stood and not any(isinstance(x, list) for x in stood)
    return [stood] if flat else stood


class FrameDocument(Document):
    """An edge from CAD, and how sure CAD is of it."""

    parent: str
    xyz_m: tuple[Number, Number, Number]
    rpy_rad: tuple[Number, Number, Number] = (0.0, 0.0, 0.0)
    sigma_m: Triple
    sigma_rad: Triple

    @pydantic.field_validator("xyz_m")
    @classmethod
    def _in_metres(cls, xyz: tuple[float, ...]) -> tuple[float, ...]:
        _metres(max(xyz, key=abs))
        return xyz

    @pydantic.field_validator("rpy_rad")
    @classmethod
    def _radians(cls, rpy: tuple[float, ...]) -> tuple[float, ...]:
        if max(map(abs, rpy)) > 2 * np.pi:
            raise ValueError(f"{max(rpy, key=abs):g} rad looks like degrees; give radians")
        return rpy

    @pydantic.field_validator("sigma_m", "sigma_rad")
    @classmethod
    def _not_negative(cls, sigma: tuple[float, ...]) -> tuple[float, ...]:
        if min(sigma) < 0:
            raise ValueError(f"{min(sigma):g} is negative; a sigma is 0 (exact) or more")
        return sigma


LidarDocument = pydantic.create_model(
    "LidarDocument",
    __base__=Document,
    model=(str, ...),
    frame=(str, "lidar"),
    **{
        name: (Annotated[field.annotation, pydantic.Field(), *field.metadata], None)
        for name, field in LidarFile.model_fields.items()
    },
)


class ArmDocument(Document):
    """The URDF, the link that the arm begins at, and that or those where it ends."""

    urdf: str
    base: str
    tip: Annotated[Names, pydantic.BeforeValidator(_in_a_row)]
    sigma_joint_rad: Size = 0.0
    passive: Annotated[tuple[str, ...], pydantic.AfterValidator(_once_each)] = ()


class BaseDocument(Document):
    """When the base may stand elsewhere."""

    moves: Literal["stop", "location", "never"] = "stop"


class TrackerDocument(Document):
    """What sees the bodies."""

    frame: str = "opti"
    bodies: Names
    sigma_m: Sigma
    sigma_rad: Sigma


class LevelsDocument(Document):
    """Frames with an accelerometer, and what is known beforehand of up in the world."""

    frames: Annotated[tuple[str, ...], pydantic.AfterValidator(_once_each)] = ()
    sigma_rad: Sigma | None = None
    sigma_zero_rad: Sigma | None = None
    up: tuple[Number, Number, Number] | None = None
    sigma_up_rad: Sigma | None = None

    @pydantic.model_validator(mode="after")
    def _both_or_neither(self) -> Self:
        if (self.up is None) != (self.sigma_up_rad is None):
            raise ValueError("up and sigma_up_rad go together; give both, or neither")
        if self.up is not None and not any(self.up):
            raise ValueError("up is (0, 0, 0), which points nowhere; of a level world it is 0 0 1")
        if not self.frames and self.up is None:
            raise ValueError("it has neither frames nor up; give one of them, or both")
        if self.frames and self.sigma_rad is None:
            raise ValueError("frames have no sigma_rad; say how sure a direction is")
        if not self.frames and (self.sigma_rad or self.sigma_zero_rad):
            raise ValueError("sigma_rad and sigma_zero_rad are of frames; name these, too")
        return self


class TargetDocument(Document):
    """Rods with spheres."""

    sphere_below_lower_marker_m: Annotated[Number, pydantic.AfterValidator(_metres)]
    sigma_sphere_m: Size
    sigma_marker_m: Sigma


class ReferenceDocument(Document):
    """The scanned mesh."""

    frame: str = "faro"
    mesh: str
    faces: str | None = None
    labels: str | None = None
    sigma_m: Size
    scanner_m: Annotated[
        tuple[tuple[Number, Number, Number], ...], pydantic.BeforeValidator(_each_station)
    ] = ((0.0, 0.0, 0.0),)


class RigDocument(Document):
    """All of it."""

    format: int = RECORDING_FORMAT.newest
    name: Annotated[str, pydantic.AfterValidator(_file_name)]
    lidar: LidarDocument | None = None
    arm: ArmDocument | None = None
    frames: dict[Annotated[str, pydantic.Field(min_length=1)], FrameDocument] = pydantic.Field(
        default_factory=dict
    )
    base: BaseDocument = BaseDocument()
    tracker: TrackerDocument | None = None
    levels: LevelsDocument | None = None
    target: TargetDocument | None = None
    reference: ReferenceDocument | None = None
    shared: tuple[str, ...] = ()
    own: tuple[str, ...] = ()
    effects: tuple[str, ...] = ()
