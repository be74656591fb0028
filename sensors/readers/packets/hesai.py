"""Hesai: packets out of PCAP or ROS bags, with the maker's table of angles.

Packet formats: the user manuals of each model. A block is one azimuth, counted clockwise from y in
hundredths of a degree; each of its channels has a range in steps that the header states, and an
intensity. Channel k looks at the block's azimuth plus its own, at its own elevation, both from the
table; rings are the channels in their order, from 0. Of several returns of one direction, which
come as neighbouring blocks of one azimuth, the farthest is kept: it is the last one.

Points are as the maker's driver gives them unless told otherwise: beams start in the origin. The
maker knows an optical centre aside of it for some models; its correction is left off.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from chains.errors import InputError
from sensors.lidar import load_lidar
from sensors.readers.base import Array, Columns, Contents, Options, Progress
from sensors.readers.packets.hesai_models import MODELS, HesaiModel, find_model
from sensors.readers.packets.pcap import Capture
from sensors.readers.packets.turns import (
    Bytes,
    Packets,
    capture_packets,
    captured,
    packet_sweeps,
    steps_of_phase,
)

_FAR_OFF_DEG = 1.0  # of a unit's elevations from its model's, where 0.1 is usual
# Metres along the beam's azimuth and to its left: HesaiLidar_SDK_2.0, udp3_1_ and udp6_1_parser.
_OPTICAL_CENTRE_M = {
    "PandarQT64": (0.0298, 0.0072),
    "PandarXT-16": (0.0315, 0.013),
    "PandarXT-32": (0.0315, 0.013),
    "PandarXT-32M2X": (0.0315, 0.013),
}


@dataclass(frozen=True)
class HesaiDecoder:
    """The packets of one model whose channels point to (channels,) elevation and azimuth, rad."""

    model: HesaiModel
    elevation_rad: Array
    azimuth_rad: Array
    columns: int
    """Azimuth steps of a turn."""

    @property
    def size(self) -> int:
        """Bytes of a packet."""
        return self.model.size

    def marks(self, packets: Bytes) -> Array:
        """Return (P, B) azimuth in turns."""
        return (_blocks(self.model, packets)["azimuth"] / 36000) % 1

    def steps(self, difference: Array) -> NDArray[np.int64]:
        """Return by how many turns azimuths are ahead of those before; they begin at azimuth 0."""
        return steps_of_phase(difference)

    def points(self, packets: Bytes, wanted: NDArray[np.bool_]) -> Columns:
        """Return the farthest returns of the wanted blocks."""
        blocks = _blocks(self.model, packets)
        at = self.model.range_step_at
        step_m = 0.004 if at is None else packets[:, at].astype(float)[:, None, None] / 1000
        range_m = blocks["pixel"]["range"] * step_m
        returns = returns_per_direction(blocks["azimuth"])
        shape = (-1, returns, self.model.channels)
        range_m, intensity = range_m.reshape(shape), blocks["pixel"]["intensity"].reshape(shape)
        last = range_m.argmax(axis=1)[:, None]
        range_m, intensity = (
            np.take_along_axis(values, last, axis=1)[:, 0] for values in (range_m, intensity)
        )
        azimuth = blocks["azimuth"].reshape(-1, returns)[:, 0].astype(np.float64)
        kept = wanted.reshape(-1, returns)[:, :1] & (range_m >= self.model.shortest_m)
        return self._columns(azimuth, range_m, intensity, kept)

    def _columns(
        self, azimuth: NDArray, range_m: Array, intensity: NDArray, kept: NDArray[np.bool_]
    ) -> Columns:
        block, channel = np.nonzero(kept)
        angle = np.radians(azimuth[block] / 100) + self.azimuth_rad[channel]
        range_m = range_m[kept]
        flat_m = range_m * np.cos(self.elevation_rad[channel])
        step = np.rint(azimuth[block] * self.columns / 36000).astype(np.int64)
        return {
            "x": (flat_m * np.sin(angle)).astype(np.float32),
            "y": (flat_m * np.cos(angle)).astype(np.float32),
            "z": (range_m * np.sin(self.elevation_rad[channel])).astype(np.float32),
            "ring": channel.astype(np.uint16),
            # counted as the catalogue does, from -x, clockwise
            "column": ((step + self.columns // 4) % self.columns).astype(np.uint16),
            "intensity": intensity[kept].astype(np.float32),
        }


def returns_per_direction(azimuth: NDArray) -> int:
    """How many neighbouring blocks of a packet share one azimuth, in all packets (P, B)."""
    for n in (3, 2):
        if azimuth.shape[1] % n == 0:
            groups = azimuth.reshape(len(azimuth), -1, n)
            if np.all(groups == groups[:, :, :1]):
                return n
    return 1


def decode_hesai(
    name: str, clock: str, packets: Packets, options: Options, progress: Progress
) -> Contents:
    """Decode the packets of one sensor.

    Angles are those of `--metadata`, or else the catalogue's. Raises InputError where no packet is
    of a model known here, and where the table of angles does not fit it.
    """
    model, returns, columns = _look(name, packets)
    elevation_rad, azimuth_rad, odd = _angles(name, model, options)
    decoder = HesaiDecoder(model, elevation_rad, azimuth_rad, columns)
    sweeps = packet_sweeps(name, clock, packets, decoder, progress)
    assert sweeps is not None  # a packet of it was seen
    lidar = {
        "model": options.lidar or model.catalog,
        "columns": columns,
        "elevation_deg": np.degrees(elevation_rad).round(6).tolist(),
        "azimuth_offset_deg": (-np.degrees(azimuth_rad)).round(6).tolist(),
        "beam_origin_m": [0.0, 0.0],
    }
    understood = [
        f"{name}: Hesai {model.name}, {model.channels} rings x {columns} columns,"
        f" {len(sweeps.time_s)} turns{rate(sweeps.time_s)}; x, y, z as the maker's driver has them,"
        " timed by arrival"
    ]
    if options.lidar not in (None, model.catalog):
        odd = (
            *odd,
            f"{name}: the packets are of a {model.name} ({model.catalog}), and --lidar"
            f" {options.lidar} is taken for its ranges and noise",
        )
    if returns > 1:
        understood.append(f"{name}: {returns} returns per direction; the farthest is kept")
    if model.name in _OPTICAL_CENTRE_M:
        out, left = (1000 * value for value in _OPTICAL_CENTRE_M[model.name])
        odd = (
            *odd,
            f"{name}: the maker knows an optical centre {out:g} mm out and {left:g} mm to the left;"
            " its correction is left off, as in the maker's driver unless told: beams start in the"
            " origin",
        )
    return Contents(sweeps=(sweeps,), lidar=lidar, understood=tuple(understood), odd=odd)


def read_hesai(files: Sequence[Path], options: Options, progress: Progress) -> Contents:
    """Read PCAP files, which follow each other; `--metadata` is the table of angles (CSV)."""
    capture = Capture(files)
    model = next(filter(None, (find_model(datagram.payload) for datagram in capture)), None)
    if model is None:
        seen = {_describe(d.payload) for d, _ in zip(capture, range(1000), strict=False)}
        raise InputError(_unknown(capture.name, seen))
    packets = capture_packets(capture, model.size, options)
    name, in_mb = capture.name, capture.progress(progress)
    return captured(capture, decode_hesai(name, name, packets, options, in_mb))


def _unknown(name: str, seen: set[str]) -> str:
    known = ", ".join(dict.fromkeys(model.name for model in MODELS))
    return (
        f"{name} has no packets of a Hesai model that can be decoded ({known});"
        f" found {'; '.join(sorted(seen)) or 'no packets of points'}"
    )


def rate(time_s: Array) -> str:
    """How often something comes, for people; what stands at the ends may be in part only."""
    steps_s = np.diff(time_s)
    step_s = np.median(steps_s[1:-1] if len(steps_s) > 2 else steps_s) if len(steps_s) else 0
    return f" at {1 / step_s:.3g} Hz" if step_s > 0 else ""


def _look(name: str, packets: Packets) -> tuple[HesaiModel, int, int]:
    """The model, returns per direction, and azimuth steps of a turn, from the first packets."""
    model, first, seen = None, [], set()
    for _, payload in packets():
        model = model or find_model(payload)
        if model and len(payload) == model.size:
            first.append(payload)
        elif not model and len(payload) > 512:
            seen.add(_describe(payload))
        if len(first) == 200 or (not model and len(seen) > 20):
            break
    if model is None:
        raise InputError(_unknown(name, seen))
    azimuth = _blocks(model, np.frombuffer(b"".join(first), np.uint8).reshape(-1, model.size))
    azimuth = azimuth["azimuth"].astype(np.int64)
    returns = returns_per_direction(azimuth)
    steps = np.diff(azimuth[:, ::returns].ravel()) % 36000
    step = np.median(steps[steps > 0]) if np.any(steps > 0) else 20.0
    return model, returns, round(36000 / step)


def _describe(payload: bytes) -> str:
    version = f", Hesai's protocol {payload[2]}.{payload[3]}" if payload[:2] == b"\xee\xff" else ""
    return f"packets of {len(payload)} bytes{version}"


def _blocks(model: HesaiModel, packets: Bytes) -> NDArray:
    """(P, blocks) of `model.block`."""
    body = packets[:, model.header : model.header + model.blocks * model.block.itemsize]
    return np.ascontiguousarray(body).view(model.block)


def _angles(name: str, model: HesaiModel, options: Options) -> tuple[Array, Array, tuple[str, ...]]:
    """Elevation and azimuth (channels,) rad, clockwise, and what is odd about them."""
    lidar = load_lidar(model.catalog)
    if options.metadata is not None:
        elevation_deg, azimuth_deg = read_angles(options.metadata)
        if len(elevation_deg) != model.channels:
            raise InputError(
                f"{options.metadata} has angles of {len(elevation_deg)} channels, but {name} comes"
                f" from a {model.name}, which has {model.channels}"
            )
        off_deg = np.abs(elevation_deg - np.degrees(lidar.elevation_rad)).mean()
        if off_deg > _FAR_OFF_DEG:
            raise InputError(
                f"{options.metadata} is no table of a {model.name}'s angles, from which {name}"
                f" comes: its elevations are {off_deg:.1f} deg off that model's on average"
            )
        return np.radians(elevation_deg), np.radians(azimuth_deg), ()
    odd = (
        f"{name}: no table of angles was given, so the {model.name}'s nominal one is taken; the"
        " sensor's own (from its web page, or its driver's folder) by --metadata is better",
    )
    return lidar.elevation_rad, -lidar.azimuth_offset_rad, odd


def read_angles(path: str | Path) -> tuple[Array, Array]:
    """Read a maker's table of angles: elevation and azimuth (channels,) degrees, by channel.

    Raises InputError where the file is missing or a channel from 1 on lacks its two angles.
    """
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            rows = list(csv.reader(file))
        table = {
            int(r[0]): (float(r[1]), float(r[2])) for r in rows if r and r[0].strip().isdigit()
        }
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from None
    except (ValueError, IndexError, csv.Error):
        table = {}
    if not table or sorted(table) != list(range(1, len(table) + 1)):
        raise InputError(
            f"{path} is no table of angles; a row for every channel, from 1, was expected: channel,"
            " elevation and azimuth in degrees"
        )
    angles = np.array([table[channel] for channel in sorted(table)])
    return angles[:, 0], angles[:, 1]
