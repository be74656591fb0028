"""Packet captures written byte by byte, as the formats' public descriptions have them."""

import struct
from collections.abc import Iterable
from pathlib import Path

Datagram = tuple[float, int, bytes]


def ethernet(payload: bytes, port: int, mtu: int | None = None, vlan: bool = False) -> list[bytes]:
    """Frames of one UDP datagram over IPv4, in fragments where it exceeds `mtu`."""
    udp = struct.pack(">4H", 40000, port, 8 + len(payload), 0) + payload
    size = (mtu - 20) // 8 * 8 if mtu else len(udp)
    frames = []
    for at in range(0, len(udp), size):
        part = udp[at : at + size]
        flags = (0x2000 if at + size < len(udp) else 0) | at // 8
        ip = struct.pack(
            ">BBHHHBBH4s4s", 0x45, 0, 20 + len(part), 77, flags, 64, 17, 0, b"abcd", b"efgh"
        )
        tag = b"\x81\x00\x00\x05" if vlan else b""
        frames.append(b"\0" * 12 + tag + b"\x08\x00" + ip + part)
    return frames


def write_pcap(
    path: Path,
    datagrams: Iterable[Datagram],
    order: str = "<",
    nanoseconds: bool = False,
    **link: object,
) -> Path:
    """A libpcap file of Ethernet frames."""
    magic, unit = (0xA1B23C4D, 1e9) if nanoseconds else (0xA1B2C3D4, 1e6)
    data = struct.pack(order + "IHHiIII", magic, 2, 4, 0, 0, 65535, 1)
    for time_s, port, payload in datagrams:
        for frame in ethernet(payload, port, **link):
            whole, part = divmod(round(time_s * unit), int(unit))
            data += struct.pack(order + "4I", whole, part, len(frame), len(frame)) + frame
    path.write_bytes(data)
    return path


def write_pcapng(path: Path, datagrams: Iterable[Datagram], **link: object) -> Path:
    """A pcapng file with one interface that counts nanoseconds."""

    def block(kind: int, body: bytes) -> bytes:
        body += b"\0" * (-len(body) % 4)
        size = struct.pack("<I", 12 + len(body))
        return struct.pack("<I", kind) + size + body + size

    data = block(0x0A0D0D0A, struct.pack("<IHHq", 0x1A2B3C4D, 1, 0, -1))
    option = struct.pack("<HHB3x", 9, 1, 9) + struct.pack("<HH", 0, 0)
    data += block(1, struct.pack("<HHI", 1, 0, 65535) + option)
    for time_s, port, payload in datagrams:
        for frame in ethernet(payload, port, **link):
            high, low = divmod(round(time_s * 1e9), 1 << 32)
            head = struct.pack("<5I", 0, high, low, len(frame), len(frame))
            data += block(6, head + frame)
    path.write_bytes(data)
    return path
