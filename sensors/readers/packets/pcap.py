"""UDP payloads out of a packet capture, one at a time: a file of any size needs little memory.

Formats: libpcap (tcpdump.org, "Libpcap File Format": either byte order, microseconds or
nanoseconds) and pcapng (IETF draft-ietf-opsawg-pcapng: enhanced packet blocks); Ethernet with VLAN
tags, Linux cooked, raw IP and loopback frames; IPv4, its fragments put together, and IPv6.
"""

import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from chains.errors import InputError
from sensors.readers.base import Progress


class Datagram(NamedTuple):
    """What one sender sent to a port."""

    time_s: float
    """When it was captured, since 1970."""
    stream: str
    """Sender and port it was sent to: 192.168.1.201:2368."""
    payload: bytes


_PCAP = {
    b"\xd4\xc3\xb2\xa1": ("<", 1e-6),
    b"\xa1\xb2\xc3\xd4": (">", 1e-6),
    b"\x4d\x3c\xb2\xa1": ("<", 1e-9),
    b"\xa1\xb2\x3c\x4d": (">", 1e-9),
}
_SUFFIXES = (".pcap", ".pcapng", ".cap")
_PCAPNG = b"\x0a\x0d\x0d\x0a"
# Length of the link's own header, and where in it the type of what follows stands.
_LINKS = {1: (14, 12), 113: (16, 14), 276: (20, 0)}
_RAW_IP = {0: 4, 101: 0, 228: 0, 229: 0}
_LARGEST = 1 << 20  # bytes of a packet: a choice, four times what capture programs ever keep
_LARGEST_DATAGRAM = 1 << 17  # twice what IPv4 can carry


class Capture:
    """Capture files of one time after another, or folders of such; iterating yields their
    `Datagram`s, anew each time.

    Files are in the order of their first packets. Raises InputError where one is missing, empty or
    no capture, and where a folder holds none. Once it was iterated, `cut_short` has the files that
    end within a packet, which is then left out, `back_s` by how much the clock was set back within
    a file at most, and `overlap_s` by how much files overlap.
    """

    def __init__(self, paths: Sequence[Path]) -> None:
        given = list(dict.fromkeys(file for path in paths for file in _files_of(path)))
        for path in given:
            _check(path)
        self.paths = sorted(given, key=_begins_s)
        self.reordered = self.paths != given
        self.cut_short: list[Path] = []
        self.back_s = self.overlap_s = 0.0
        self._sizes = [path.stat().st_size for path in self.paths]
        self._read = 0

    @property
    def name(self) -> str:
        """That of the first file, without its suffix."""
        return self.paths[0].stem

    def progress(self, progress: Progress) -> Progress:
        """Progress in MB of the files, whatever counts it is given."""
        total = sum(self._sizes) >> 20
        return lambda what, done, _: progress(f"{what}, MB", self._read >> 20, total)

    def __iter__(self) -> Iterator[Datagram]:
        fragments: dict[bytes, dict[int, bytes]] = {}
        self.cut_short, self.back_s, self.overlap_s, last_s = [], 0.0, 0.0, -np.inf
        for number, path in enumerate(self.paths):
            before, first = sum(self._sizes[:number]), True
            with open(path, "rb") as file:
                try:
                    for time_s, link, frame in _frames(path, file):
                        self._read = before + file.tell()
                        if first:
                            self.overlap_s = max(self.overlap_s, last_s - time_s)
                        else:
                            self.back_s = max(self.back_s, last_s - time_s)
                        first, last_s = False, time_s
                        packet = _ip_packet(link, frame)
                        if packet and (datagram := _udp(packet, fragments)):
                            yield Datagram(time_s, *datagram)
                except _CutShortError:
                    self.cut_short.append(path)


def _files_of(path: Path) -> list[Path]:
    """The captures in a folder; of a file, itself."""
    if not path.is_dir():
        return [path]
    files = sorted(file for file in path.iterdir() if file.suffix.lower() in _SUFFIXES)
    if not files:
        raise InputError(
            f"{path} is a folder without captures; they end in {' or '.join(_SUFFIXES)}"
        )
    return files


def _begins_s(path: Path) -> float:
    """When the first packet of a file was captured; the last of all times where it has none."""
    with open(path, "rb") as file:
        try:
            return next(_frames(path, file), (np.inf,))[0]
        except _CutShortError:
            return np.inf


def _frames(path: Path, file: BinaryIO) -> Iterator[tuple[float, int, bytes]]:
    """Time [s], link type and frame of every packet, of either format."""
    return (_pcapng if _magic(file) == _PCAPNG else _pcap)(path, file)


def _check(path: Path) -> None:
    try:
        with open(path, "rb") as file:
            magic = _magic(file)
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from None
    if magic not in (*_PCAP, _PCAPNG):
        fault = "is no packet capture" if magic else "is empty"
        raise InputError(f"{path} {fault}; it should be PCAP or PCAPNG, as tcpdump writes")


def _magic(file: BinaryIO) -> bytes:
    magic = file.read(4)
    file.seek(0)
    return magic


def _pcap(path: Path, file: BinaryIO) -> Iterator[tuple[float, int, bytes]]:
    """Those of libpcap's format."""
    head = _take(file, 24)
    order, unit_s = _PCAP[head[:4]]
    (link,) = struct.unpack_from(order + "I", head, 20)
    while head := file.read(16):
        if len(head) < 16:
            raise _CutShortError
        seconds, parts, length, _ = struct.unpack(order + "4I", head)
        if length > _LARGEST:
            raise InputError(
                f"{path} is damaged at byte {file.tell() - 16}: a packet of {length} bytes cannot"
                " be; capture it anew"
            )
        yield seconds + parts * unit_s, link & 0xFFFF, _take(file, length)


def _pcapng(path: Path, file: BinaryIO) -> Iterator[tuple[float, int, bytes]]:
    """Those of enhanced packet blocks."""
    order, links = "<", []
    while head := file.read(8):
        if len(head) < 8:
            raise _CutShortError
        if head[:4] == _PCAPNG:
            order = "<" if _take(file, 4) == b"\x4d\x3c\x2b\x1a" else ">"
            file.seek(-4, 1)
            links = []
        kind, length = struct.unpack(order + "2I", head)
        if not 12 <= length <= 16 * _LARGEST:
            raise InputError(
                f"{path} is damaged at byte {file.tell() - 8}: a block of {length} bytes cannot"
                " be; capture it anew"
            )
        body = _take(file, length - 8)
        if kind == 1:
            links.append(_interface(order, body))
        elif kind == 6:
            interface, high, low, size = struct.unpack_from(order + "4I", body)
            if interface >= len(links):
                raise InputError(f"{path} has packets of an interface that it does not describe")
            link, unit_s = links[interface]
            yield ((high << 32) + low) * unit_s, link, body[20 : 20 + size]


class _CutShortError(Exception):
    """The file ends within a packet."""


def _take(file: BinaryIO, size: int) -> bytes:
    data = file.read(size)
    if len(data) < size:
        raise _CutShortError
    return data


def _interface(order: str, body: bytes) -> tuple[int, float]:
    """Link type, and seconds per tick: option 9 of an interface block, a microsecond if absent."""
    (link,) = struct.unpack_from(order + "H", body)
    at, unit_s = 8, 1e-6
    while at + 4 <= len(body) - 4:
        option, size = struct.unpack_from(order + "2H", body, at)
        if option == 9:
            tick = body[at + 4]
            unit_s = 2.0 ** -(tick & 0x7F) if tick & 0x80 else 10.0**-tick
        at += 4 + size + -size % 4
    return link, unit_s


def _ip_packet(link: int, frame: bytes) -> bytes | None:
    """The IP packet in a link's frame."""
    if link in _RAW_IP:
        return frame[_RAW_IP[link] :]
    if link not in _LINKS:
        return None
    size, at = _LINKS[link]
    while frame[at : at + 2] in (b"\x81\x00", b"\x88\xa8"):
        size, at = size + 4, at + 4
    return frame[size:] if frame[at : at + 2] in (b"\x08\x00", b"\x86\xdd") else None


def _udp(packet: bytes, fragments: dict) -> tuple[str, bytes] | None:
    """Stream and payload, once every fragment is there."""
    if len(packet) < 28:
        return None
    if packet[0] >> 4 == 6:
        sender = packet[8:24].hex(":", 2)
        return _payload(f"[{sender}]", packet[40:]) if packet[6] == 17 else None
    if packet[0] >> 4 != 4 or packet[9] != 17:
        return None
    (total,), (flags,) = struct.unpack_from(">H", packet, 2), struct.unpack_from(">H", packet, 6)
    data = packet[(packet[0] & 15) * 4 : total or len(packet)]
    sender = ".".join(map(str, packet[12:16]))
    offset, more = (flags & 0x1FFF) * 8, bool(flags & 0x2000)
    if not offset and not more:
        return _payload(sender, data)
    whole = _join(fragments, packet[4:6] + packet[12:20], offset, more, data)
    return _payload(sender, whole) if whole else None


def _join(fragments: dict, key: bytes, offset: int, more: bool, data: bytes) -> bytes | None:
    """Add a fragment; the datagram once it has no gap. Only the latest few wait for their rest."""
    parts = fragments.setdefault(key, {})
    parts[offset] = data
    if not more:
        parts[-1] = (offset + len(data)).to_bytes(4, "big")
    if -1 in parts and sum(map(len, parts.values())) > _LARGEST_DATAGRAM:
        del fragments[key]
        return None
    whole = b"".join(parts[at] for at in sorted(parts) if at >= 0) if -1 in parts else b""
    if -1 in parts and len(whole) == int.from_bytes(parts[-1], "big"):
        del fragments[key]
        return whole
    if len(fragments) > 64:
        del fragments[next(iter(fragments))]
    return None


def _payload(sender: str, data: bytes) -> tuple[str, bytes] | None:
    if len(data) < 8:
        return None
    port, length = struct.unpack_from(">2H", data, 2)
    return f"{sender}:{port}", data[8 : length or len(data)]
