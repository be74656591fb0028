"""OptiTrack's CSV: Motive's formats 1.2 to 1.25, and 1.1 of Tracking Tools before it.

Motive names what is in a column in the rows above it: type, name, ID, in later formats parent,
then quantity and axis. https://docs.optitrack.com, Data Export: CSV. Its y points up, and the file
does not say where it was told otherwise; `--up z` does.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from chains.errors import InputError
from sensors.readers import conventions
from sensors.readers.base import Array, Contents, Options, Progress, Track, together
from sensors.readers.tables.sheets import Sheet, open_sheet, quoted
from sensors.stops import POSE

_LENGTHS = {"meters": 1.0, "centimeters": 1e-2, "millimeters": 1e-3, "inches": 0.0254}
_BODY = 11  # cells of a body in format 1.1: its number, x y z, qx qy qz qw, yaw pitch roll
_MOST_TAIL = 8  # rows of the header below the first


@dataclass(frozen=True)
class _Asset:
    """A body or marker, and in which columns its numbers stand: axis -> column."""

    kind: str
    name: str
    position: Mapping[str, int]
    rotation: Mapping[str, int]


def read_motive(files: Sequence[Path], options: Options, progress: Progress) -> Contents:
    """Read takes: rigid bodies as poses, labelled markers of no body as points.

    Raises:
        InputError: a file is no export of Motive or Tracking Tools, or its axes are left-handed.
    """
    takes = []
    for i, path in enumerate(files):
        progress("reading takes", i, len(files))
        sheet, head = open_sheet(path)
        start = head[0].strip().lower()
        if start.startswith("format version"):
            takes.append(_motive(sheet, head, options))
        elif start.startswith(("comment", "info", "righthanded", "lefthanded")):
            takes.append(_tracking_tools(sheet, options))
        else:
            raise InputError(
                f"{path} is no CSV of Motive: its first line starts with '{head[0][:30]}', and "
                "should with 'Format Version'; is it a table?"
            )
    return together(takes)


# ------------------------------------------------------------------------------------- Motive


def _motive(sheet: Sheet, head: Sequence[str], options: Options) -> Contents:
    path, cells = sheet.path, sheet.cells(head[0])
    facts = dict(zip(cells[::2], cells[1::2], strict=False))
    last, parts = _parts(sheet, head)
    bodies = [p for p in parts if p.kind == "Rigid Body" and p.rotation]
    own = {body.name for body in bodies}
    points = [
        p for p in parts
        if p.kind == "Marker" and not p.name.lower().startswith(("unlabeled", "active"))
        and (p.name.rpartition(":")[0] not in own or p.name in options.bodies)
    ]  # fmt: skip
    loose = sum(p.kind == "Marker" and p.name.lower().startswith("unlabeled") for p in parts)
    if not bodies and not points:
        raise InputError(f"{path} holds neither rigid bodies nor labelled markers; export those")
    unit, scale = _unit(path, facts, options)
    columns = [
        1,
        *(c for p in (*bodies, *points) for c in (*p.rotation.values(), *p.position.values())),
    ]
    table, odd = sheet.numbers(columns, last)
    if not len(table):
        raise InputError(f"{path} has a header and no frames")
    column = dict(zip(columns, table.T, strict=True))
    turn = facts.get("Rotation Type", "Quaternion")
    tracks = [_track(path, part, column, turn, scale, options) for part in (*bodies, *points)]
    rate = facts.get("Export Frame Rate") or facts.get("Capture Frame Rate") or "nan"
    said = [
        f"{path.name}: Motive's format {facts.get('Format Version')}, {len(table):,} frames at "
        f"{float(rate):g} Hz, {unit}, {turn if turn == 'Quaternion' else 'Euler angles ' + turn}, "
        f"{_up(options)}"
    ]
    said += [
        f"{path.name}: {t.kind} {t.name}, seen in {_seen(t):.0%} of the frames" for t in tracks
    ]
    said += [f"{path.name}: {loose} unlabelled markers are left out"] if loose else []
    if facts.get("Coordinate Space", "Global") != "Global":
        space = facts["Coordinate Space"]
        odd = (*odd, f"{path.name}: the coordinate space is {space}; export in Global")
    return Contents(tracks=tuple(tracks), understood=tuple(said), odd=odd)


def _parts(sheet: Sheet, head: Sequence[str]) -> tuple[int, list[_Asset]]:
    """The number of the last line of the header, and what the columns hold."""
    rows = [
        (n, sheet.cells(line)) for n, line in enumerate(head[: _MOST_TAIL + 2], 1) if line.strip()
    ]
    last = next((k for k, (_, row) in enumerate(rows) if row[0].lower() == "frame"), None)
    if last is None or last < 3:
        raise InputError(
            f"{sheet.path}: the header has no row that starts with 'Frame'; is it cut?"
        )
    width = len(rows[last][1])
    above = [row + [""] * (width - len(row)) for _, row in rows[1:last]]
    kinds, names, quantities, axes = above[0], above[1], above[-1], rows[last][1]
    parts: dict[tuple[str, str], _Asset] = {}
    for k in range(2, width):
        part = parts.setdefault((kinds[k], names[k]), _Asset(kinds[k], names[k], {}, {}))
        where = {"Position": part.position, "Rotation": part.rotation}.get(quantities[k])
        if where is not None:
            where.setdefault(axes[k].upper(), k)
    return rows[last][0], [p for p in parts.values() if {*"XYZ"} <= p.position.keys()]


def _unit(path: Path, facts: Mapping[str, str], options: Options) -> tuple[str, float]:
    unit = facts.get("Length Units", "").lower()
    if options.length_unit is None and unit not in _LENGTHS:
        raise InputError(f"{path}: length units are '{unit}'; say --length-unit m, cm or mm")
    if options.length_unit:
        return options.length_unit, {"m": 1.0, "cm": 1e-2, "mm": 1e-3}[options.length_unit]
    return unit, _LENGTHS[unit]


def _track(
    path: Path, part: _Asset, column: Mapping[int, Array], turn: str, scale: float, options: Options
) -> Track:
    where = f"{path}: {part.name}"
    lacking = [axis for axis in "XYZ" if axis not in part.position]
    if part.kind == "Rigid Body":
        lacking += [f"rotation {axis}" for axis in "XYZ" if axis not in part.rotation]
    if lacking:
        raise InputError(f"{where} has no column {lacking[0]}; export the take anew")
    xyz = np.stack([column[part.position[axis]] for axis in "XYZ"], axis=1) * scale
    values, kind = xyz, "point"
    if part.kind == "Rigid Body":
        axes = "WXYZ" if "W" in part.rotation else "XYZ"
        quat = np.stack([column[part.rotation[axis]] for axis in axes], axis=1)
        if axes == "XYZ":
            quat = conventions.quaternions(where, np.radians(quat), options.euler or turn)
        values, kind = conventions.poses(where, xyz, quat), "pose"
    if conventions.axis_up(options.up, "y"):
        values = conventions.z_up(values)
    return Track(
        name=part.name,
        kind=kind,
        clock=path.stem,
        time_s=column[1],
        names=POSE[: values.shape[1]],
        values=values,
    )


def _up(options: Options) -> str:
    return (
        "turned from y up to z up" if conventions.axis_up(options.up, "y") else "z up as it stands"
    )


def _seen(track: Track) -> float:
    return float(np.isfinite(track.values).all(axis=1).mean())


# ------------------------------------------------------------------------------------- 1.1


def _tracking_tools(sheet: Sheet, options: Options) -> Contents:
    """Format 1.1: a row ``frame, index, time, bodies, (number, pose)...`` names whom it saw."""
    path, names, time_s, seen = sheet.path, {}, [], []
    for number, row in _rows(sheet):
        kind = row[0].lower()
        if kind == "lefthanded":
            raise InputError(f"{path}:{number}: axes are left-handed; export them right-handed")
        try:
            if kind == "rigidbody" and not time_s:
                names[int(row[2])] = row[1].strip('"')
            elif kind == "frame":
                time_s.append(float(row[2]))
                seen += _bodies(len(time_s) - 1, row)
        except (ValueError, IndexError):
            raise InputError(
                f"{path}:{number}: this row of '{kind}' is not as in format 1.1"
            ) from None
    if not names or not time_s:
        raise InputError(f"{path} has no rigid bodies, or no frames; export those")
    table = np.array(seen, float).reshape(-1, 9)
    unit = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}[options.length_unit or "m"]
    tracks, said = [], []
    for number, name in names.items():
        pose = np.full((len(time_s), 7), np.nan)
        mine = table[table[:, 1] == number]
        pose[mine[:, 0].astype(int)] = mine[:, 2:]
        pose = conventions.poses(f"{path}: {name}", pose[:, :3] * unit, pose[:, 3:], "x")
        pose = conventions.z_up(pose) if conventions.axis_up(options.up, "y") else pose
        track = Track(
            name=name,
            kind="pose",
            clock=path.stem,
            time_s=np.array(time_s),
            names=POSE,
            values=pose,
        )
        tracks.append(track)
        said.append(f"{path.name}: pose {name}, seen in {_seen(track):.0%} of the frames")
    first = f"{path.name}: Tracking Tools' format 1.1, {len(time_s):,} frames, {_up(options)}"
    return Contents(tracks=tuple(tracks), understood=(first, *said))


def _rows(sheet: Sheet) -> Iterator[tuple[int, list[str]]]:
    for number, line in sheet.lines():
        yield number, quoted(sheet.path, line)


def _bodies(frame: int, row: Sequence[str]) -> Iterator[list[float]]:
    """Frame, number, x y z, qx qy qz qw of each body that a frame saw."""
    for k in range(int(row[3])):
        cells = row[4 + k * _BODY : 4 + k * _BODY + 8]
        if not any("#" in cell for cell in cells):
            yield [frame, *map(float, cells)]
