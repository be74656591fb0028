"""What an Ouster sensor says of itself (JSON), and where its beams point.

Packet formats and geometry: Ouster's sensor documentation ("Sensor Data", "Lidar Range to XYZ").
With n the distance from the LiDAR's centre to where beams start (`lidar_origin_to_beam_origin_mm`),
a range r, column c of C, and a ring's azimuth angle a and altitude angle e, a point is

    u = pi - 2 pi c / C,  h = (r - n) cos(e)
    (h cos(u - a) + n cos(u),  h sin(u - a) + n sin(u),  (r - n) sin(e)).

The frame is rigcal's: the axes of the maker's sensor frame (x forwards, away from the connector, z
up), the origin in the LiDAR's own centre. The maker's LiDAR frame has the same origin and is turned
by half a turn about z; the sensor frame's origin lies lower, in the foot of the housing. Rings
count from the highest beam down, from 0; columns are the sensor's measurement ids.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chains.errors import InputError
from sensors.documents import parse_json
from sensors.lidar import LidarModel, catalog, load_lidar
from sensors.readers.base import Array, Columns, Contents, Options, Sweeps


@dataclass(frozen=True)
class Profile:
    """Where a packet of one UDP profile has what, bytes; of two returns the first is taken."""

    header: int
    column_header: int
    pixel: int
    column_footer: int
    footer: int
    range_type: str
    range_mask: int
    range_step_m: float
    reflectivity: tuple[int, str]
    near_infrared: tuple[int, str]
    dual: bool = False


PROFILES = {
    "LEGACY": Profile(
        header=0,
        column_header=16,
        pixel=12,
        column_footer=4,
        footer=0,
        range_type="<u4",
        range_mask=0xFFFFF,
        range_step_m=0.001,
        reflectivity=(4, "<u2"),
        near_infrared=(8, "<u2"),
    ),
    "RNG19_RFL8_SIG16_NIR16": Profile(
        header=32,
        column_header=12,
        pixel=12,
        column_footer=0,
        footer=32,
        range_type="<u4",
        range_mask=0x7FFFF,
        range_step_m=0.001,
        reflectivity=(4, "u1"),
        near_infrared=(8, "<u2"),
    ),
    "RNG19_RFL8_SIG16_NIR16_DUAL": Profile(
        header=32,
        column_header=12,
        pixel=16,
        column_footer=0,
        footer=32,
        range_type="<u4",
        range_mask=0x7FFFF,
        range_step_m=0.001,
        reflectivity=(3, "u1"),
        near_infrared=(12, "<u2"),
        dual=True,
    ),
    "RNG15_RFL8_NIR8": Profile(
        header=32,
        column_header=12,
        pixel=4,
        column_footer=0,
        footer=32,
        range_type="<u2",
        range_mask=0x7FFF,
        range_step_m=0.008,
        reflectivity=(2, "u1"),
        near_infrared=(3, "u1"),
    ),
}
# What the maker's tools take where the metadata is silent, by product line; the first generation
# of OS1 never stated it.
_BEAM_ORIGIN_MM = {"OS-0-": 27.67, "OS-1-": 15.806, "OS-2-": 13.762, "": 12.163}


_MOST_RINGS, _MOST_COLUMNS = 512, 8192  # four times, and twice, what the largest sensors have


@dataclass(frozen=True)
class Metadata:
    """What the sensor says of itself; angles (rings,) rad."""

    name: str
    product: str
    profile: str
    rings: int
    columns: int
    columns_per_packet: int
    altitude_rad: Array
    azimuth_rad: Array
    """Clockwise from above."""
    beam_origin_m: float
    odd: tuple[str, ...] = ()

    @property
    def lidar(self) -> dict[str, Any]:
        """What rig.yaml should say of this LiDAR: the catalogue's nearest, with its own figures."""
        models = [load_lidar(name) for name in catalog() if name.startswith("ouster_")]
        models = [m for m in models if m.rings == self.rings and _alike(m, self.altitude_rad)]
        own = {
            "columns": self.columns,
            "elevation_deg": np.degrees(self.altitude_rad).round(6).tolist(),
            "azimuth_offset_deg": (-np.degrees(self.azimuth_rad)).round(6).tolist(),
            "beam_origin_m": [round(self.beam_origin_m, 9), 0.0],
        }
        if not models:
            return own
        nearest = min(models, key=lambda m: abs(m.beam_origin_m[0] - self.beam_origin_m))
        return {"model": nearest.name, **own}


def _alike(model: LidarModel, altitude_rad: Array) -> bool:
    """Whether beams are those of a model: on average within two degrees."""
    return bool(np.abs(model.elevation_rad - altitude_rad).mean() < np.radians(2))


def read_metadata(name: str, text: str) -> Metadata:
    """Read the sensor's JSON, of any firmware; `name` is the file's or topic's.

    Raises InputError where it is no such JSON, lacks the beams' angles, or names a UDP profile that
    is not decoded here.
    """
    facts = _flat(name, text)
    missing = [k for k in ("beam_altitude_angles", "beam_azimuth_angles") if not facts.get(k)]
    if missing:
        raise InputError(
            f"{name} lacks {' and '.join(missing)}; the sensor's whole metadata is needed, which it"
            " gives at http://SENSOR/api/v1/sensor/metadata"
        )
    try:
        altitude = np.ravel(facts["beam_altitude_angles"]).astype(float)
        azimuth = np.ravel(facts["beam_azimuth_angles"]).astype(float)
        shape = facts.get("data_format") or {}
        rings = int(shape.get("pixels_per_column", len(altitude)))
        mode = str(facts.get("lidar_mode", "1024x10")).split("x")[0]
        columns = int(shape.get("columns_per_frame", mode))
        columns_per_packet = int(shape.get("columns_per_packet", 16))
        origin_mm, odd = _beam_origin_mm(name, facts)
    except (TypeError, ValueError, AttributeError, IndexError) as error:
        raise InputError(f"{name} is no metadata of an Ouster sensor: {error}") from None
    if not len(altitude) == len(azimuth) == rings:
        raise InputError(
            f"{name} has {len(altitude)} altitude and {len(azimuth)} azimuth angles for {rings}"
            " rings; every ring has one of each"
        )
    if not (0 < rings <= _MOST_RINGS and 0 < columns <= _MOST_COLUMNS and columns_per_packet > 0):
        raise InputError(
            f"{name} states {rings} rings and {columns} columns, {columns_per_packet} to a packet; "
            f"sensors have up to {_MOST_RINGS} and {_MOST_COLUMNS}"
        )
    profile = shape.get("udp_profile_lidar", "LEGACY")
    if profile not in PROFILES:
        raise InputError(
            f"{name} states the UDP profile {profile}, which cannot be decoded; set the sensor to"
            f" one of {', '.join(PROFILES)}"
        )
    return Metadata(
        name=name,
        product=str(facts.get("prod_line") or ""),
        profile=profile,
        rings=rings,
        columns=columns,
        columns_per_packet=columns_per_packet,
        altitude_rad=np.radians(altitude),
        azimuth_rad=np.radians(azimuth),
        beam_origin_m=origin_mm / 1000,
        odd=odd,
    )


def ouster_points(
    metadata: Metadata, range_m: Array, index: NDArray, **covariates: NDArray
) -> Columns:
    """Points of ranges (B, rings) m at measurement ids (B,); nothing nearer than the beams' origin.

    `covariates` are (B, rings); the frame is that of the file's head.
    """
    column, ring = np.nonzero(range_m > metadata.beam_origin_m)
    step = index.astype(np.int64)[column]
    encoder = np.pi - 2 * np.pi * step / metadata.columns
    azimuth = encoder - metadata.azimuth_rad[ring]
    n = metadata.beam_origin_m
    along = range_m[column, ring] - n
    flat = along * np.cos(metadata.altitude_rad[ring])
    return {
        "x": (flat * np.cos(azimuth) + n * np.cos(encoder)).astype(np.float32),
        "y": (flat * np.sin(azimuth) + n * np.sin(encoder)).astype(np.float32),
        "z": (along * np.sin(metadata.altitude_rad[ring])).astype(np.float32),
        "ring": ring.astype(np.uint16),
        "column": step.astype(np.uint16),
        **{name: values[column, ring].astype(np.float32) for name, values in covariates.items()},
    }


def describe_ouster(name: str, sweeps: Sweeps, metadata: Metadata, options: Options) -> Contents:
    """The sweeps with what is to be told of them and of the sensor."""
    lidar = metadata.lidar | ({"model": options.lidar} if options.lidar else {})
    understood = [
        f"{name}: Ouster {metadata.product or 'sensor'}, {metadata.rings} rings x"
        f" {metadata.columns} columns, profile {metadata.profile}, {len(sweeps.time_s)} turns;"
        f" beams start {1000 * metadata.beam_origin_m:g} mm from the axis ({metadata.name});"
        " axes of the sensor frame, origin in the LiDAR's centre"
    ]
    if PROFILES[metadata.profile].dual:
        understood.append(f"{name}: two returns per direction; the first (strongest) is taken")
    return Contents(sweeps=(sweeps,), lidar=lidar, understood=tuple(understood), odd=metadata.odd)


def _flat(name: str, text: str) -> dict[str, Any]:
    """The JSON's facts in one mapping, as firmware before 2.4 wrote them."""
    facts = parse_json(text, name)
    if not isinstance(facts, dict):
        raise InputError(f"{name} is no metadata of an Ouster sensor: it holds no mapping")
    groups = ("sensor_info", "beam_intrinsics", "lidar_intrinsics", "config_params")
    for group in groups:
        facts = {**facts, **(facts.get(group) or {})}
    if "lidar_data_format" in facts:
        facts["data_format"] = facts["lidar_data_format"]
    return facts


def _beam_origin_mm(name: str, facts: dict[str, Any]) -> tuple[float, tuple[str, ...]]:
    stated = facts.get("lidar_origin_to_beam_origin_mm")
    if stated is None and (matrix := facts.get("beam_to_lidar_transform")):
        stated = matrix[3]
    if stated is not None:
        return float(stated), ()
    product = str(facts.get("prod_line") or "")
    taken = next(mm for line, mm in _BEAM_ORIGIN_MM.items() if product.startswith(line))
    return taken, (
        f"{name} does not say where beams start; {taken:g} mm from the axis is taken, as the"
        f" maker's tools do for {product or 'a first OS1, which names no product line'}",
    )
