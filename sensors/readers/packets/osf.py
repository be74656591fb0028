"""Ouster's OSF: turns as PNG images in flatbuffers, read without the maker's library.

Layout: the schemas of ouster-sdk (`ouster_osf/fb`). A header points to the metadata at the end of
the file, which lists sensors, streams and chunks; a chunk holds stamped messages, one for each
turn, whose channels are images with columns moved by `pixel_shift_by_row`. A flatbuffer's table
begins with the distance to its vtable, which has the place of every field (flatbuffers.dev,
"FlatBuffer Internals").
"""

from __future__ import annotations

import io
import mmap
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from chains.errors import InputError
from chains.sizes import most
from sensors.documents import parse_json
from sensors.readers.base import Columns, Contents, Options, Sweep, Sweeps
from sensors.readers.packets.ouster_sensor import (
    Metadata,
    describe_ouster,
    ouster_points,
    read_metadata,
)
from sensors.recording import unpack_zstd

_CONVERT = "convert it: ouster-cli source {name} save {stem}.pcap"
# What struct, numpy, zstd and PIL raise where bytes are not what they should be.
_BROKEN = (struct.error, ValueError, IndexError, KeyError, TypeError, OSError, SyntaxError)
_BROKEN += (EOFError, OverflowError, MemoryError, zlib.error)
_CHANNELS = {1: "range", 3: "signal", 5: "intensity", 7: "near_infrared"}


@dataclass(frozen=True)
class _Flatbuffer:
    """A table of a flatbuffer; fields by their number in the schema."""

    data: mmap.mmap | bytes
    at: int

    @classmethod
    def root(cls, data: mmap.mmap | bytes, at: int) -> _Flatbuffer:
        """The root of a buffer at `at`, which begins with its size."""
        return cls(data, at + 4 + struct.unpack_from("<I", data, at + 4)[0])

    def field(self, number: int) -> int | None:
        vtable = self.at - struct.unpack_from("<i", self.data, self.at)[0]
        (size,) = struct.unpack_from("<H", self.data, vtable)
        if 4 + 2 * number >= size:
            return None
        (offset,) = struct.unpack_from("<H", self.data, vtable + 4 + 2 * number)
        return self.at + offset if offset else None

    def scalar(self, number: int, kind: str, default: int = 0) -> int:
        at = self.field(number)
        return default if at is None else struct.unpack_from("<" + kind, self.data, at)[0]

    def vector(self, number: int) -> tuple[int, int]:
        """Where its items begin, and how many there are."""
        at = self.field(number)
        if at is None:
            return 0, 0
        at += struct.unpack_from("<I", self.data, at)[0]
        return at + 4, struct.unpack_from("<I", self.data, at)[0]

    def bytes(self, number: int) -> bytes:
        at, count = self.vector(number)
        return self.data[at : at + count]

    def array(self, number: int, dtype: str) -> NDArray:
        at, count = self.vector(number)
        return np.frombuffer(self.data, dtype, count, at)

    def tables(self, number: int) -> Iterator[_Flatbuffer]:
        at, count = self.vector(number)
        if at + 4 * count > len(self.data):
            raise ValueError(f"it says that it has {count} parts, and ends before")
        for k in range(count):
            place = at + 4 * k
            yield _Flatbuffer(self.data, place + struct.unpack_from("<I", self.data, place)[0])


@dataclass(frozen=True)
class _Message:
    time_s: float
    scan: _Flatbuffer


def read_osf(path: Path, options: Options) -> Contents:
    """Read an OSF file: the turns of its sensor.

    Raises InputError where the file is empty, cut short, no OSF, or coded in a way not known here,
    and where it has several sensors of which `--topic` names none.
    """
    with _damage(path):
        data = _open(path)
        sensors, messages = _contents(data)
    sensors = {key: text for key, text in sensors.items() if messages.get(key)}
    if not sensors:
        raise InputError(f"{path} holds no turns of a LiDAR")
    with _damage(path):
        key, metadata = _choose(path, sensors, options)
    facts = parse_json(sensors[key], f"{path.name}'s own metadata")
    _decode(path, metadata, facts, messages[key][0].scan)  # what cannot be decoded says so here
    sweeps = _sweeps(path, metadata, facts, messages[key])
    return describe_ouster(path.stem, sweeps, metadata, options)


def _choose(path: Path, sensors: dict[int, bytes], options: Options) -> tuple[int, Metadata]:
    """The one sensor, or the one whose product line `--topic` names."""
    own = f"{path.name}'s own metadata"
    known = {key: read_metadata(own, text.decode()) for key, text in sensors.items()}
    names = {key: metadata.product for key, metadata in known.items()}
    if len(set(names.values())) < len(names):
        names = {key: f"{name}/{key}" for key, name in names.items()}
    chosen = [key for key, name in names.items() if not options.topics or name in options.topics]
    if len(chosen) != 1:
        listed = ", ".join(names.values())
        raise InputError(f"{path} has the LiDARs {listed}; choose one by --topic")
    return chosen[0], known[chosen[0]]


@contextmanager
def _damage(path: Path) -> Iterator[None]:
    """Say of places that are not in the file what they mean."""
    try:
        yield
    except InputError:
        raise
    except _BROKEN as error:
        raise InputError(f"{path} is damaged or cut short: {error}") from None


def _hint(path: Path) -> str:
    return _CONVERT.format(name=path.name, stem=path.stem)


def _open(path: Path) -> mmap.mmap:
    try:
        with open(path, "rb") as file:
            data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from None
    except ValueError:
        raise InputError(f"{path} is empty (0 bytes); an OSF file was wanted") from None
    if data[8:12] != b"OSF$":
        raise InputError(f"{path} is no OSF file: it does not begin with OSF's header")
    return data


def _contents(data: mmap.mmap) -> tuple[dict[int, bytes], dict[int, list[_Message]]]:
    """Per sensor its metadata (JSON), and its turns in the order of time."""
    header = _Flatbuffer.root(data, 0)
    metadata_at, length = header.scalar(2, "Q", 1), header.scalar(3, "Q", 1)
    if length != len(data):
        raise ValueError(f"it should have {length} bytes and has {len(data)}")
    first_chunk = 8 + struct.unpack_from("<I", data, 0)[0]
    metadata = _Flatbuffer.root(data, metadata_at)
    sensors, streams = {}, {}
    for entry in metadata.tables(4):
        kind, number = entry.bytes(1).decode(), entry.scalar(0, "I")
        if kind.endswith("/LidarSensor"):
            sensors[number] = _Flatbuffer.root(entry.bytes(2), 0).bytes(0)
        elif kind.endswith("/LidarScanStream"):
            streams[number] = _Flatbuffer.root(entry.bytes(2), 0).scalar(0, "I")
    messages: dict[int, list[_Message]] = {}
    for offset in metadata.array(3, "<u8,<u8,<u8")["f2"]:
        for message in _Flatbuffer.root(data, first_chunk + int(offset)).tables(0):
            sensor = streams.get(message.scalar(1, "I"))
            if sensor is not None:
                at, _ = message.vector(2)
                stamped = _Message(message.scalar(0, "Q") / 1e9, _Flatbuffer.root(data, at))
                messages.setdefault(sensor, []).append(stamped)
    for turns in messages.values():
        turns.sort(key=lambda message: message.time_s)
    return sensors, messages


def _sweeps(path: Path, metadata: Metadata, facts: dict, messages: list[_Message]) -> Sweeps:
    time_s = np.array([message.time_s for message in messages])

    def read(wanted: NDArray[np.bool_]) -> Iterator[Sweep]:
        for s in np.flatnonzero(wanted):
            yield Sweep(time_s[s], _decode(path, metadata, facts, messages[s].scan))

    return Sweeps(path.stem, path.stem, time_s, read)


def _decode(path: Path, metadata: Metadata, facts: dict, scan: _Flatbuffer) -> Columns:
    """The points of one turn; only columns that the sensor calls valid."""
    with _damage(path):
        images = {
            _CHANNELS[channel]: _image(path, table.bytes(0), facts, metadata)
            for (channel, _), table in zip(scan.array(1, "u1,u1"), scan.tables(0), strict=True)
            if channel in _CHANNELS
        }
    if "range" not in images:
        raise InputError(f"{path} has turns without an image of ranges; {_hint(path)}")
    valid = scan.array(4, "<u4") & 1 == 1
    by_column = {name: image.T[valid] for name, image in images.items()}
    range_m = by_column.pop("range") / 1000
    return ouster_points(metadata, range_m, np.flatnonzero(valid), **by_column)


def _image(path: Path, data: bytes, facts: dict, metadata: Metadata) -> NDArray:
    """Whole numbers (rings, columns) by measurement id."""
    if data[:2] == b"\xf8\xfb":
        pixels = _zpng(data)
    elif data[:4] == b"\x89PNG":
        pixels = _png(data)
    else:
        raise InputError(f"{path} has images that are neither PNG nor ZPNG; {_hint(path)}")
    # the lowest byte of a number is the first of its pixel's
    image = (pixels.astype(np.int64) << (8 * np.arange(pixels.shape[2]))).sum(axis=2)
    if image.shape != (metadata.rings, metadata.columns):
        raise InputError(
            f"{path} has images of {' x '.join(map(str, image.shape))} pixels, but its sensor has"
            f" {metadata.rings} rings and {metadata.columns} columns; {_hint(path)}"
        )
    return image if data[:2] == b"\xf8\xfb" else _staggered(image, facts)


def _staggered(image: NDArray, facts: dict) -> NDArray:
    """PNGs are written with every ring's columns moved, so that they look upright."""
    shape = facts.get("lidar_data_format") or facts.get("data_format") or {}
    shift = np.array(shape.get("pixel_shift_by_row") or [0] * len(image))[:, None]
    columns = image.shape[1]
    return np.take_along_axis(image, (np.arange(columns) + shift) % columns, axis=1)


def _png(data: bytes) -> NDArray:
    """Bytes (rings, columns, bytes of a pixel) of a PNG, the lowest first."""
    from PIL import Image

    width, height = struct.unpack_from(">2I", data, 16)  # before PIL refuses it in its own way
    if 4 * width * height > most(len(data)):
        raise ValueError(f"{len(data)} bytes claim to be an image of {width} x {height} pixels")
    with Image.open(io.BytesIO(data), formats=["PNG"]) as image:
        pixels = np.asarray(image)
    if pixels.ndim == 3:
        return pixels
    return np.stack([pixels & 0xFF, pixels.astype(np.uint32) >> 8], axis=2)


def _zpng(data: bytes) -> NDArray:
    """The same of a ZPNG (github.com/catid/Zpng): zstd of differences along each row.

    Pixels of four bytes lie in four planes, the first three mixed as (b, g - b, g - r).
    """
    columns, rings, channels, width = struct.unpack_from("<2H2B", data, 2)
    size = channels * width
    plain = np.frombuffer(unpack_zstd(data[8:], rings * columns * size), np.uint8)
    if size == 4:
        b, g_b, g_r, a = plain.reshape(4, rings, columns)
        steps = np.stack([g_b + b - g_r, g_b + b, b, a], axis=2)
    else:
        steps = plain.reshape(rings, columns, size)
    return np.cumsum(steps, axis=1, dtype=np.uint8)
