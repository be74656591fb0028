"""Ouster: packets out of PCAP or ROS bags, with the sensor's own metadata (JSON); and OSF."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from chains.errors import InputError
from sensors.documents import read_text
from sensors.readers.base import Array, Columns, Contents, Options, Progress, together
from sensors.readers.packets.osf import read_osf
from sensors.readers.packets.ouster_sensor import (
    PROFILES,
    Metadata,
    Profile,
    describe_ouster,
    ouster_points,
    read_metadata,
)
from sensors.readers.packets.pcap import Capture
from sensors.readers.packets.turns import Bytes, Packets, capture_packets, captured, packet_sweeps


@dataclass(frozen=True)
class OusterDecoder:
    """The packets of a sensor with this metadata."""

    metadata: Metadata

    @property
    def size(self) -> int:
        """Bytes of a packet."""
        p = self._profile
        return p.header + self.metadata.columns_per_packet * self._column.itemsize + p.footer

    @property
    def _profile(self) -> Profile:
        return PROFILES[self.metadata.profile]

    @property
    def _column(self) -> np.dtype:
        p, rings = self._profile, self.metadata.rings
        pixel = np.dtype(
            {
                "names": ["range", "reflectivity", "near_infrared"],
                "formats": [p.range_type, p.reflectivity[1], p.near_infrared[1]],
                "offsets": [0, p.reflectivity[0], p.near_infrared[0]],
                "itemsize": p.pixel,
            }
        )
        size = p.column_header + rings * p.pixel + p.column_footer
        status = (size - 4, "<u4") if p.column_footer else (10, "<u2")
        return np.dtype(
            {
                "names": ["index", "frame", "status", "pixels"],
                "formats": ["<u2", "<u2", status[1], (pixel, rings)],
                "offsets": [8, 10, status[0], p.column_header],
                "itemsize": size,
            }
        )

    def _columns(self, packets: Bytes) -> NDArray:
        p = self._profile
        body = packets[:, p.header : self.size - p.footer]
        return np.ascontiguousarray(body).view(self._column)

    def marks(self, packets: Bytes) -> Array:
        """Return (P, B) the sensor's number of the turn, a 16-bit counter."""
        if self._profile.header:
            frame = np.ascontiguousarray(packets[:, 2:4]).view("<u2")
        else:
            frame = self._columns(packets)["frame"][:, :1]
        shape = (len(packets), self.metadata.columns_per_packet)
        return np.broadcast_to(frame, shape).astype(float)

    def steps(self, difference: Array) -> NDArray[np.int64]:
        """Return by how many turns a counter is ahead, its overflow taken out."""
        return (difference.astype(np.int64) + 0x8000) % 0x10000 - 0x8000

    def points(self, packets: Bytes, wanted: NDArray[np.bool_]) -> Columns:
        """Return the first returns of the wanted columns that the sensor calls valid."""
        columns = self._columns(packets)
        wanted = wanted & (columns["status"] & 1 == 1)
        columns = columns[wanted]
        pixels = columns["pixels"]
        range_m = (pixels["range"] & self._profile.range_mask) * self._profile.range_step_m
        return ouster_points(
            self.metadata,
            range_m,
            columns["index"],
            intensity=pixels["reflectivity"],
            near_infrared=pixels["near_infrared"],
        )


def decode_ouster(
    name: str,
    clock: str,
    packets: Packets,
    metadata: Metadata,
    options: Options,
    progress: Progress,
) -> Contents:
    """Decode the packets of one sensor; InputError where none has the size its metadata tells."""
    decoder = OusterDecoder(metadata)
    sweeps = packet_sweeps(name, clock, packets, decoder, progress)
    if sweeps is None:
        raise InputError(
            f"{name} has no packets of {decoder.size} bytes, which {metadata.name} tells to expect"
            f" (profile {metadata.profile}, {metadata.rings} rings); is it the right sensor's?"
        )
    return describe_ouster(name, sweeps, metadata, options)


def read_ouster(files: Sequence[Path], options: Options, progress: Progress) -> Contents:
    """Read OSF files, or PCAP files that follow each other, of one Ouster sensor.

    The metadata of a PCAP is `--metadata`, a JSON among the files, or the JSON beside it whose name
    begins as the PCAP's.
    Raises InputError as `decode_ouster` and `read_metadata` do, and where no JSON is found.
    """
    sources = [read_osf(path, options) for path in files if path.suffix.lower() == ".osf"]
    told = [path for path in files if path.suffix.lower() == ".json"]
    if len(told) > 1 or (told and options.metadata):
        raise InputError(f"{told[-1]} is one JSON too many; give that of this sensor alone")
    pcaps = [path for path in files if path.suffix.lower() not in (".osf", ".json")]
    if told and not pcaps:
        raise InputError(f"{told[0]} is a sensor's metadata, and its PCAP is not given")
    if pcaps:
        capture = Capture(pcaps)  # no capture is a plainer mistake than no metadata
        beside = options.metadata or (told[0] if told else _beside(capture.paths[0]))
        metadata = read_metadata(beside.name, read_text(beside))
        packets = capture_packets(capture, OusterDecoder(metadata).size, options)
        name, in_mb = capture.name, capture.progress(progress)
        decoded = decode_ouster(name, name, packets, metadata, options, in_mb)
        sources.append(captured(capture, decoded))
    return together(sources)


def _beside(path: Path) -> Path:
    """The JSON in the folder that shares most of the PCAP's name."""
    jsons = sorted(path.parent.glob("*.json"), key=lambda p: len(p.stem), reverse=True)
    for candidate in jsons:
        if path.stem.startswith(candidate.stem):
            return candidate
    there = f"; there is {', '.join(p.name for p in jsons[:5])}" if jsons else ""
    raise InputError(
        f"{path} needs the sensor's metadata: give its JSON by --metadata, or put it beside as"
        f" {path.stem}.json{there}"
    )
