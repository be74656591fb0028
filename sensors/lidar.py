"""Spinning LiDARs: where their beams point and how they scatter, from a catalogue of models."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
import pydantic
from numpy.typing import ArrayLike, NDArray

from chains.errors import InputError
from sensors.documents import Document, Number, nearest, read_yaml, validate

Array = NDArray[np.float64]
Size = Annotated[Number, pydantic.Field(ge=0)]
Count = Annotated[int, pydantic.Field(ge=1, strict=True)]

CATALOG = Path(__file__).parent / "catalog"
GRAZING_RAD = 1.5
"""Incidence beyond which the spread grows no further: tan(90 deg) is no measurement."""
LARGEST_REFLECTANCE = 2.0
"""An intensity that goes no higher is a reflectance, 1 of white and more of what mirrors; makers'
others count to 255 or 65535."""


@dataclass(frozen=True)
class LidarModel:
    """One model of spinning LiDAR with R rings; lengths in m, angles in rad."""

    name: str
    maker: str
    source: str
    rings: int
    columns: int
    """Azimuth steps of a full turn."""
    elevation_rad: Array
    """(R,) nominal, by ring, up positive."""
    azimuth_offset_rad: Array
    """(R,) of each ring from its column's azimuth, counter-clockwise positive."""
    beam_origin_m: Array
    """(2,) where beams start: along their azimuth, and to the left of it."""
    min_range_m: float
    max_range_m: float
    sigma_range_m: float
    """Single-shot range noise, at any range."""
    sigma_range_per_m: float
    """The part that grows with range."""
    sigma_range_incidence: float
    """The part that grows with range * tan(incidence)."""
    quantum_m: float
    """Step of the range readout."""
    sigma_angle_rad: float
    """Single-shot noise of azimuth and of elevation."""
    beam_divergence_rad: float
    """Full width of the beam."""
    typical_range_offset_m: float
    """Mean range error that such sensors have shown; for simulation."""
    typical_ring_offset_m: float
    """Standard deviation of range error between the rings; for simulation."""

    def directions(self, rings: ArrayLike, columns: ArrayLike) -> Array:
        """Return the nominal unit directions (..., 3) of beams in the LiDAR's frame.

        Column c of C points to azimuth pi - 2 pi c / C, plus its ring's offset.
        """
        rings = np.asarray(rings)
        azimuth = np.pi - 2 * np.pi * np.asarray(columns) / self.columns
        azimuth = azimuth + self.azimuth_offset_rad[rings]
        elevation = np.broadcast_to(self.elevation_rad[rings], azimuth.shape)
        flat = np.cos(elevation)
        return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], -1)

    def range_variance(self, range_m: ArrayLike, cosine: ArrayLike) -> Array:
        """Return the single-shot variance of range (N,) m2, by the cosine of incidence g.

        sigma^2 = s0^2 + (k r)^2 + (kappa r tan g)^2 + quantum^2 / 12, g held below 1.5 rad.
        """
        c2 = np.maximum(np.square(cosine), np.cos(GRAZING_RAD) ** 2)
        slant2 = self.sigma_range_incidence**2 * (1.0 / c2 - 1.0)
        growth = self.sigma_range_per_m**2 + slant2
        return self.sigma_range_m**2 + self.quantum_m**2 / 12 + growth * np.square(range_m)

    def sigma_range(self, range_m: ArrayLike, incidence_rad: ArrayLike) -> Array:
        """Return the single-shot standard deviation of range (N,) m; see `range_variance`."""
        return np.sqrt(self.range_variance(range_m, np.cos(incidence_rad)))


@dataclass(frozen=True)
class Beams:
    """N beams in the LiDAR's frame: point = origin_m + range_m * direction."""

    origin_m: Array
    direction: Array
    range_m: Array

    @cached_property
    def azimuth_rad(self) -> Array:
        """(N,) of the direction, counter-clockwise from x: the encoder's, wherever it starts."""
        return np.arctan2(self.direction[:, 1], self.direction[:, 0])

    @cached_property
    def elevation_rad(self) -> Array:
        """(N,) of the direction, up positive."""
        u = self.direction
        return np.arctan2(u[:, 2], np.hypot(u[:, 0], u[:, 1]))

    def only(self, some: Array) -> Self:
        """Some of them (n,)."""
        return type(self)(self.origin_m[some], self.direction[some], self.range_m[some])

    def turned(self, azimuth_rad: Array, elevation_rad: Array) -> Self:
        """The same, turned by small angles (N,): their origin goes along in azimuth."""
        azimuth, elevation = self.azimuth_rad + azimuth_rad, self.elevation_rad + elevation_rad
        u = np.stack(
            [
                np.cos(elevation) * np.cos(azimuth),
                np.cos(elevation) * np.sin(azimuth),
                np.sin(elevation),
            ],
            axis=1,
        )
        c, s = np.cos(azimuth_rad), np.sin(azimuth_rad)
        x, y, z = self.origin_m.T
        origin = np.stack([c * x - s * y, s * x + c * y, z], axis=1)
        return type(self)(origin, u, self.range_m)


def beams(xyz_m: ArrayLike, beam_origin_m: ArrayLike) -> Beams:
    """Return the beams that measured points (N, 3) m, in the LiDAR's frame.

    With H the radial and B the tangential part of `beam_origin_m`, a beam of azimuth a starts at
    H (cos a, sin a, 0) + B (-sin a, cos a, 0); the point at horizontal distance d and azimuth
    atan2(y, x) was seen by the beam with a = atan2(y, x) - asin(B / d).
    """
    p = np.asarray(xyz_m, float)
    radial, tangential = np.asarray(beam_origin_m, float)
    origin = np.zeros_like(p)
    if radial or tangential:
        square = np.maximum(p[:, 0] ** 2 + p[:, 1] ** 2, max(tangential**2, 1e-24))
        along = np.sqrt(square - tangential**2)
        c = (p[:, 0] * along + p[:, 1] * tangential) / square
        s = (p[:, 1] * along - p[:, 0] * tangential) / square
        origin[:, 0] = radial * c - tangential * s
        origin[:, 1] = radial * s + tangential * c
    reach = p - origin
    range_m = np.sqrt(np.einsum("ni,ni->n", reach, reach))
    return Beams(origin, reach / range_m[:, None], range_m)


class LidarFile(Document):
    """A model as its YAML file says it; angles in degrees, as data sheets have them.

    `elevation_deg` lists every ring, or the first and the last of evenly spread ones;
    `azimuth_offset_deg` is repeated over the rings.
    """

    maker: str
    source: str
    rings: Count
    columns: Count
    elevation_deg: Annotated[tuple[Number, ...], pydantic.Field(min_length=1)]
    azimuth_offset_deg: Annotated[tuple[Number, ...], pydantic.Field(min_length=1)] = (0.0,)
    beam_origin_m: tuple[Number, Number] = (0.0, 0.0)
    min_range_m: Size
    max_range_m: Size
    sigma_range_m: Size
    sigma_range_per_m: Size = 0.0
    sigma_range_incidence: Size = 0.0
    quantum_m: Size = 0.0
    sigma_angle_rad: Size = 0.0
    beam_divergence_rad: Size = 0.0
    typical_range_offset_m: Number = 0.0
    typical_ring_offset_m: Size = 0.0

    @pydantic.model_validator(mode="after")
    def _check_rings(self) -> "LidarFile":
        if len(self.elevation_deg) not in (2, self.rings):
            raise ValueError(
                f"elevation_deg has {len(self.elevation_deg)} values for {self.rings} rings;"
                " give one for each, or the first and the last"
            )
        if self.rings % len(self.azimuth_offset_deg):
            raise ValueError(
                f"azimuth_offset_deg has {len(self.azimuth_offset_deg)} values, which do not repeat"
                f" evenly over {self.rings} rings"
            )
        if max(map(abs, self.elevation_deg)) > 90:
            raise ValueError("elevation_deg goes beyond 90 degrees")
        if max(map(abs, self.beam_origin_m)) > 1:
            raise ValueError("beam_origin_m is beyond 1 m, which looks like millimetres")
        return self

    def model(self, name: str) -> LidarModel:
        """Return the model with its angles by ring, in radians."""
        fields = self.model_dump()
        elevation = np.radians(fields.pop("elevation_deg"))
        if len(elevation) != self.rings:
            elevation = np.linspace(*elevation, self.rings)
        offset = np.radians(fields.pop("azimuth_offset_deg"))
        return LidarModel(
            name=name,
            elevation_rad=elevation,
            azimuth_offset_rad=np.tile(offset, self.rings // len(offset)),
            beam_origin_m=np.array(fields.pop("beam_origin_m")),
            **fields,
        )


def catalog() -> list[str]:
    """Return the names of the models in the catalogue."""
    return sorted(path.stem for path in CATALOG.glob("*.yaml"))


def load_lidar(name_or_path: str | Path, overrides: Mapping[str, Any] | None = None) -> LidarModel:
    """Load a LiDAR model by its name in the catalogue or the path of a YAML file.

    `overrides` replace fields of the file. Raises InputError for an unknown name, naming the
    nearest of the catalogue, for a missing file, and for fields that do not fit.
    """
    path = Path(name_or_path)
    if path.suffix not in (".yaml", ".yml"):
        if str(name_or_path) not in catalog():
            name = str(name_or_path)
            raise InputError(f"LiDAR model {name} is unknown{nearest(name, catalog())}")
        path = CATALOG / f"{name_or_path}.yaml"
    data, marks = read_yaml(path)
    if isinstance(data, dict):
        data = {**data, **(overrides or {})}
    return validate(LidarFile, data, path, marks).model(path.stem)
