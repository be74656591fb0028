"""E57 files (ASTM E2807), scan by scan, each in its own scanner's frame. This is the pye57 door."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from chains.errors import InputError
from chains.sizes import check_claim
from chains.xml import parse_xml
from sensors.readers.base import Array, Columns

if TYPE_CHECKING:
    from pye57 import E57

_HEAD = struct.Struct("<8s2I4Q")  # ASTM E2807: name, version, length, where the XML is, page
_NAMES = {
    "cartesianX": "x",
    "cartesianY": "y",
    "cartesianZ": "z",
    "intensity": "intensity",
    "rowIndex": "row",
    "columnIndex": "column",
    "colorRed": "red",
    "colorGreen": "green",
    "colorBlue": "blue",
}


@dataclass(frozen=True)
class E57Scan:
    """One scan: columns (N,) of its valid points, and where its scanner stood.

    Args:
        columns: x y z [m, the scanner's frame]; as the file has them intensity, row, column, and
            red, green, blue.
        pose: (4, 4) T_file_scan, the identity where the file states no pose.
        posed: whether it states one.
    """

    columns: Columns
    pose: Array
    posed: bool

    def xyz_in_file(self) -> Array:
        """Points (N, 3) m in the frame of the file, which all its scans share."""
        xyz = np.stack([self.columns[axis] for axis in "xyz"], axis=1)
        return xyz @ self.pose[:3, :3].T + self.pose[:3, 3]


def read_e57_scans(path: str | Path) -> Iterator[E57Scan]:
    """Yield the scans of an E57 file, one in memory at a time.

    Raises InputError where the file is missing, empty, cut short or no E57, holds no scans, and
    where pye57 is not installed.
    """
    path = Path(path)
    file = _open(path)
    try:
        if not file.scan_count:
            raise InputError(f"{path} holds no scans")
        for number in range(file.scan_count):
            yield _scan(path, file, number)
    finally:
        file.close()


def _open(path: Path) -> E57:
    try:
        import pye57
    except ImportError:
        raise InputError("reading E57 needs pye57: pip install 'rigcal[e57]'") from None
    try:
        size = path.stat().st_size
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from None
    if not size:
        raise InputError(f"{path} is empty (0 bytes); an E57 file was wanted")
    _check_xml(path)
    try:
        return pye57.E57(str(path))
    except pye57.libe57.E57Exception as error:
        why = str(error).splitlines()[0]
        raise InputError(f"{path} is no whole E57 file: {why}") from None


def _check_xml(path: Path) -> None:
    """Refuse XML that defines entities, before the library's own parser sees it.

    The header says where it is; every page of the file ends in a checksum of 4 bytes.
    """
    with open(path, "rb") as file:
        head = file.read(_HEAD.size)
        if len(head) < _HEAD.size or head[:8] != b"ASTM-E57":
            raise InputError(f"{path} is no whole E57 file: it does not begin as one")
        *_, at, length, page = _HEAD.unpack(head)
        if not 4 < page <= 1 << 20 or at + length > path.stat().st_size:
            raise InputError(f"{path} is no whole E57 file: its XML is not where it says")
        file.seek(at - at % page)
        pages = length // (page - 4) + 2
        data = file.read(pages * page)
    whole = b"".join(data[k : k + page - 4] for k in range(0, len(data), page))
    parse_xml(whole[at % page : at % page + length], path, "an E57 file")


def _scan(path: Path, file: E57, number: int) -> E57Scan:
    import pye57

    try:
        header = file.get_header(number)
        count, fields = header.point_count, header.point_fields
        check_claim(path, 8 * count * len(fields), f"{count} points in scan {number}")
        raw = file.read_scan_raw(number, ignore_unsupported_fields=True)
    except pye57.libe57.E57Exception as error:
        why = str(error).splitlines()[0]
        raise InputError(f"{path}: scan {number} cannot be read: {why}") from None
    valid = np.ones(header.point_count, bool)
    for state in ("cartesianInvalidState", "sphericalInvalidState"):
        if state in raw:
            valid &= raw[state] == 0
    if "cartesianX" not in raw:
        raw |= _cartesian(path, number, raw)
    columns = {ours: raw[theirs][valid] for theirs, ours in _NAMES.items() if theirs in raw}
    pose = np.eye(4)
    if posed := header.has_pose():
        pose[:3, :3] = header.rotation_matrix
        pose[:3, 3] = header.translation
    return E57Scan(columns, pose, posed)


def _cartesian(path: Path, number: int, raw: Columns) -> Columns:
    if "sphericalRange" not in raw:
        raise InputError(f"{path}: scan {number} has neither Cartesian nor spherical coordinates")
    range_m, azimuth, elevation = (
        raw[f"spherical{name}"] for name in ("Range", "Azimuth", "Elevation")
    )
    flat = range_m * np.cos(elevation)
    return {
        "cartesianX": flat * np.cos(azimuth),
        "cartesianY": flat * np.sin(azimuth),
        "cartesianZ": range_m * np.sin(elevation),
    }
