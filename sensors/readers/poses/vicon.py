"""Vicon's CSV: blocks of Trajectories (markers) and of Segments or Objects (bodies).

A block is its title, its rate in Hz, a row of names, a row of axes, one of units, then the rows,
and ends with an empty line. Bodies have a quaternion, RX RY RZ RW, or three numbers of which the
file does not say whether they are a rotation vector or Euler angles; ``--euler`` does.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from chains.errors import InputError
from sensors.readers import conventions
from sensors.readers.base import Array, Contents, Options, Progress, Track, together
from sensors.readers.tables.sheets import ANGLES, LENGTHS, Sheet, open_sheet
from sensors.stops import POSE

_BODIES = ("segments", "objects")
_TITLES = (*_BODIES, "trajectories")


@dataclass
class _Block:
    """One block, its cells still text."""

    title: str
    rate_hz: float
    names: list[str]
    axes: list[str]
    units: list[str]
    rows: list[list[str]]


def read_vicon(files: Sequence[Path], options: Options, progress: Progress) -> Contents:
    """Read exports of Nexus or Tracker: bodies as poses, markers that have a label as points.

    Raises:
        InputError: a file is no such export, or what its rotations are is not said.
    """
    exports = []
    for i, path in enumerate(files):
        progress("reading takes", i, len(files))
        sheet, _ = open_sheet(path)
        blocks = list(_blocks(sheet))
        if not blocks:
            raise InputError(
                f"{path} is no CSV of Vicon: no line of it reads Segments, Objects or Trajectories"
            )
        exports += [_read(path, block, options) for block in blocks]
    return together(exports)


def _blocks(sheet: Sheet) -> Iterator[_Block]:
    lines = sheet.lines()
    block, head = None, []
    for number, line in lines:
        cells = sheet.cells(line)
        if cells[0].lower() in _TITLES and not any(cells[1:]):
            if block is not None:
                yield block
            block, head = (
                _Block(
                    title=cells[0].lower(), rate_hz=np.nan, names=[], axes=[], units=[], rows=[]
                ),
                [],
            )
        elif block is not None and len(head) < 4:
            head.append(cells)
            if len(head) == 4:
                rate, block.names, block.axes, block.units = head
                block.rate_hz = _rate(sheet.path, number - 3, rate[0])
        elif block is not None:
            block.rows.append(cells)
    if block is not None and len(head) == 4:
        yield block


def _rate(path: Path, number: int, cell: str) -> float:
    try:
        rate = float(cell)
    except ValueError:
        rate = 0.0
    if not rate > 0:
        raise InputError(
            f"{path}:{number}: '{cell}' is no rate in Hz; a block has one on its 2nd line"
        )
    return rate


def _read(path: Path, block: _Block, options: Options) -> Contents:
    odd: tuple[str, ...] = ()
    width = max(map(len, (block.names, block.axes)))
    if block.rows and len(block.rows[-1]) < len(block.axes) - 1:
        block.rows.pop()
        odd = (f"{path.name} breaks off within its last line, which is left out",)
    width += 6  # a body that the file breaks off lacks up to 6 columns of its 7
    for cells in (block.axes, block.units):
        cells += [""] * (width - len(cells))
    try:
        table = np.array(
            [[float(c) if c else np.nan for c in row + [""] * (width - len(row))][:width]
             for row in block.rows]
        ).reshape(-1, width)  # fmt: skip
    except ValueError as error:
        raise InputError(f"{path}: {block.title}: {error}; a number is wanted") from None
    if not len(table):
        raise InputError(f"{path}: {block.title} has no frames")
    time_s = (table[:, 0] - 1) / block.rate_hz  # frames of one take, whatever block they stand in
    tracks = []
    for k, name in enumerate(block.names):
        name = name.rpartition(":")[2] or name
        if not name or name.startswith("*") or name.isdigit() or "Acceleration" in name:
            continue
        if block.title in _BODIES:
            tracks.append(_body(path, name, k, block, table, time_s, options))
        else:
            tracks.append(_marker(path, name, k, block, table, time_s, options))
    said = f"{path.name}: {block.title} of {len(table):,} frames at {block.rate_hz:g} Hz: "
    return Contents(tuple(tracks), understood=(said + ", ".join(t.name for t in tracks),), odd=odd)


def _body(
    path: Path, name: str, k: int, block: _Block, table: Array, time_s: Array, options: Options
) -> Track:
    axes = [axis.upper() for axis in block.axes[k : k + 7]]
    where = f"{path}: {name}"
    wanted = ["RX", "RY", "RZ", "RW", "TX", "TY", "TZ"]
    if axes == wanted:
        quat, at = table[:, [k + 3, k, k + 1, k + 2]], k + 4
    elif axes[:6] == [a for a in wanted if a != "RW"]:
        quat, at = _rotation(where, table[:, k : k + 3], block.units[k], options), k + 3
    else:
        raise InputError(
            f"{where}: its columns are {', '.join(axes)}; {', '.join(wanted)} are wanted"
        )
    xyz = table[:, at : at + 3] * _length(where, block.units[at], options)
    pose = conventions.poses(where, xyz, quat)
    pose = conventions.z_up(pose) if options.up == "y" else pose
    return Track(name=name, kind="pose", clock=path.stem, time_s=time_s, names=POSE, values=pose)


def _rotation(where: str, values: Array, unit: str, options: Options) -> Array:
    """Quaternions (N, 4) of three numbers, as a rotation vector or as Euler angles."""
    angles = values * ANGLES.get(unit.lower(), 1.0)
    if options.euler != "vector":
        if options.euler is None:
            raise InputError(
                f"{where}: RX RY RZ are a rotation vector or Euler angles, and the file does not "
                "say which; say --euler vector, or --euler XYZ"
            )
        return conventions.quaternions(where, angles, options.euler)
    seen = np.isfinite(angles).all(axis=1)
    quat = np.full((len(angles), 4), np.nan)
    quat[seen] = Rotation.from_rotvec(angles[seen]).as_quat(scalar_first=True)
    return quat


def _marker(
    path: Path, name: str, k: int, block: _Block, table: Array, time_s: Array, options: Options
) -> Track:
    where = f"{path}: {name}"
    xyz = table[:, k : k + 3] * _length(where, block.units[k], options)
    xyz = conventions.z_up(xyz) if options.up == "y" else xyz
    return Track(
        name=name, kind="point", clock=path.stem, time_s=time_s, names=POSE[:3], values=xyz
    )


def _length(where: str, unit: str, options: Options) -> float:
    unit = options.length_unit or unit.lower()
    if unit not in LENGTHS:
        raise InputError(f"{where}: positions are in '{unit}'; say --length-unit m, cm or mm")
    return LENGTHS[unit]
