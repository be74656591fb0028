"""Any table with a header: a log of joints, bodies or covariates, or a row for every stop.

A column is ours by its name (`time_s`, `stop`, `location`, a joint of the arm, `body.x`), or by
`--column OURS=THEIRS`; with such a map, all others are left out. THEIRS may end in its unit,
``joint_1=q1[deg]``, and a ``*`` stands for the parts of a pose, ``mount.*=measurement_*``.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path

import numpy as np

from chains.errors import InputError
from sensors.documents import nearest
from sensors.readers import conventions
from sensors.readers.base import Array, Columns, Contents, Options, Progress, Track
from sensors.readers.tables.sheets import (
    ANGLES,
    LENGTHS,
    Sheet,
    is_number,
    open_sheet,
    seconds,
    split_unit,
)  # fmt: skip
from sensors.stops import POSE

EULER = ("rx", "ry", "rz")
TEXT = ("stop", "location")
# From row to row, a choice: logs have 5 Hz and more, arms take seconds; between them is asked.
LOG_BELOW_S, STOPS_ABOVE_S = 0.2, 1.5
_TIMES = ("time_s", "time", "timestamp", "stamp", "t", "sec", "secs", "seconds")
_POSITIONS = {"position", "pos", "q", "actual", "joint_states", "joint", ""}


@dataclass(frozen=True)
class _Column:
    """Where one of our columns stands in the file, and the unit that is written there."""

    index: int
    theirs: str
    unit: str | None


def read_table(files: Sequence[Path], options: Options, progress: Progress) -> Contents:
    """Read tables, each a log on a clock of its own or a list of stops.

    Raises:
        InputError: a file, line or column is wrong, or what it means is ambiguous.
    """
    tables = []
    for i, path in enumerate(files):
        progress("reading tables", i, len(files))
        tables.append(_read(path, options))
    stops = [part.stops for part in tables if part.stops is not None]
    if any(part.keys() != stops[0].keys() for part in stops[1:]):
        raise InputError(
            f"{files[0]} and the tables after it have other columns of stops; give one"
        )
    for k, table in enumerate(stops):
        if len(stops) > 1:
            table["stop"] = np.array([f"{k}_{name}" for name in table["stop"]])
    return Contents(
        tracks=tuple(track for part in tables for track in part.tracks),
        stops={k: np.concatenate([s[k] for s in stops]) for k in stops[0]} if stops else None,
        understood=tuple(line for part in tables for line in part.understood),
        odd=tuple(line for part in tables for line in part.odd),
    )


def _read(path: Path, options: Options) -> Contents:
    sheet, head = open_sheet(path)
    names, skip = _header(sheet, head)
    columns = _ours(path, names, options)
    numeric = [name for name in columns if name not in TEXT]
    first = next(iter(sheet.lines(skip)), (0, ""))[1]
    cells = sheet.cells(first)
    dated = "time_s" in columns and not _is_number(cells, columns["time_s"].index, sheet)
    numeric = [n for n in numeric if not (dated and n == "time_s")]
    mapped = any(name in columns for name in _spelled_out(options.columns, names))
    if not mapped:  # whatever else is a number may explain something
        numeric = [n for n in numeric if _is_number(cells, columns[n].index, sheet)]
    values, odd = sheet.numbers([columns[name].index for name in numeric], skip)
    odd = (*odd, *_unmapped_poses(path, names, columns, mapped))
    table: Columns = dict(zip(numeric, values.T, strict=True))
    for name in [n for n in TEXT if n in columns]:
        table[name] = np.array(sheet.text(columns[name].index, skip)[: len(values)], np.str_)
    said = [f"{path.name}: {len(values):,} rows of {len(names)} columns" + _dialect(sheet)]
    if not len(values):
        raise InputError(f"{path} has a header and no rows")
    time = _time(sheet, skip, table.pop("time_s", None), columns.get("time_s"), len(values))
    joints = [name for name in options.joints if name in table]
    table, words = _in_si(path, table, columns, joints, options)
    said += words
    taken = {c.theirs for name, c in columns.items() if name in (*numeric, *TEXT, "time_s")}
    left = [n for n in names if n not in taken]
    said += [f"{path.name}: not taken: {', '.join(left)}"] if left else []
    if _are_stops(path, table, time, options.rows):
        return _stops(path, table, time, tuple(said), odd)
    return _tracks(path, table, time, joints, tuple(said), odd)


# ------------------------------------------------------------------------------- what is where


def _header(sheet: Sheet, head: Sequence[str]) -> tuple[list[str], int]:
    """Names of the columns, and the number of the line that has them."""
    for number, line in enumerate(head, 1):
        cells = [c.strip() for c in sheet.cells(line.lstrip("#% "))]
        if (
            len(cells) > 1
            and sum(is_number(c, sheet.decimal_comma) for c in cells) <= len(cells) / 4
        ):
            names = [name or f"column {k + 1}" for k, name in enumerate(cells)]
            twice = next((n for n in names if names.count(n) > 1), None)
            if twice:
                raise InputError(f"{sheet.path}:{number}: column '{twice}' stands there twice")
            return names, number
        if len(cells) > 1:
            break
    raise InputError(
        f"{sheet.path} has no header that names its columns; add a first line that does"
    )


def _ours(path: Path, names: Sequence[str], options: Options) -> dict[str, _Column]:
    """Our columns by name: those mapped, those that bear our names, and, without a map, all."""
    own = {name: split_unit(name) for name in names}
    chosen: dict[str, _Column] = {}
    for ours, theirs in _spelled_out(options.columns, names).items():
        column = theirs if theirs in own else split_unit(theirs)[0]
        if column in own:
            unit = own[theirs][1] if theirs in own else split_unit(theirs)[1]
            chosen[ours] = _Column(names.index(column), column, unit)
    mapped = bool(chosen)
    for ours in (*options.joints, "time_s", *TEXT):  # a joint called T is no time
        taken = {column.theirs for column in chosen.values()}
        column = _called(ours, {name: said for name, said in own.items() if name not in taken})
        if ours not in chosen and column is not None:
            chosen[ours] = _Column(names.index(column), column, own[column][1])
    taken = {column.theirs for column in chosen.values()}
    for name in (n for n in names if n not in taken):
        base, part = split_unit(name)[0].rpartition(".")[::2]
        if (part in (*POSE, *EULER) and base) or not mapped:
            short, unit = own[name] if part in (*POSE, *EULER) else (name, None)
            chosen[short] = _Column(names.index(name), name, unit)
    _all_joints(path, chosen, names, options.joints)
    return chosen


def _spelled_out(columns: Mapping[str, str], names: Sequence[str]) -> dict[str, str]:
    """A map of columns, with each ``body.*`` written out for the parts of a pose there are."""
    out = {}
    for ours, theirs in columns.items():
        if not ours.endswith(".*") or theirs.count("*") != 1:
            out[ours] = theirs
            continue
        for part in (*POSE, *EULER):
            name = theirs.replace("*", part)
            if name in names or split_unit(name)[0] in names:
                out[f"{ours[:-1]}{part}"] = name
    return out


def _called(ours: str, own: Mapping[str, tuple[str, str | None]]) -> str | None:
    """The one header that means our column: by our name, or, of the time, by another's."""
    for name, (short, _) in own.items():
        if ours in (name, short):
            return name
    if ours == "time_s":
        return next((name for name, (short, _) in own.items() if _is_time(short)), None)
    words = {name: re.split(r"[./:\s]+", name) for name in own}
    close = [n for n, w in words.items() if ours in w and set(w) - {ours} <= _POSITIONS]
    return close[0] if len(close) == 1 else None


def _is_time(short: str) -> bool:
    """Whether a header means the time; a capital T alone is more often a temperature."""
    return short != "T" and short.lower() in _TIMES


def _all_joints(
    path: Path, chosen: Mapping[str, _Column], names: Sequence[str], joints: Mapping[str, str]
) -> None:
    """Refuse a table that has some of the arm's joints and lacks others."""
    missing = [joint for joint in joints if joint not in chosen]
    if missing and len(missing) < len(joints):
        raise InputError(
            f"{path}: the arm's joint {missing[0]} is not among the columns"
            f"{nearest(missing[0], names)}; say --column {missing[0]}=THEIRS"
        )


def _unmapped_poses(
    path: Path, names: Sequence[str], columns: Mapping[str, _Column], mapped: bool
) -> list[str]:
    """What to say of columns that end in x, y, z as a pose's do, and that nobody called one."""
    short = {split_unit(name)[0] for name in names}
    known = {column.theirs for ours, column in columns.items() if ours.endswith(".x")}
    triples = [n[:-1] for n in names if re.fullmatch(r".+[_ :/-]x", split_unit(n)[0])]
    triples = [n for n in triples if {f"{n}y", f"{n}z"} <= short and f"{n}x" not in known]
    if mapped or not triples:
        return []
    like = min(triples, key=lambda n: (f"{n}rx" not in short, len(n)))
    turned = " and --euler, if its angles are Euler's" if f"{like}rx" in short else ""
    return [
        f"{path.name}: columns {', '.join(f'{n}x, y, z' for n in triples)} may be where something"
        f" was tracked, and are taken for covariates; say --column BODY.*={like}*{turned}"
    ]


def _is_number(cells: Sequence[str], index: int, sheet: Sheet) -> bool:
    return index < len(cells) and (not cells[index] or is_number(cells[index], sheet.decimal_comma))


def _dialect(sheet: Sheet) -> str:
    mark = {";": "semicolons", "\t": "tabs", ",": "commas", None: "blanks"}[sheet.separator]
    return f", separated by {mark}{', with decimal commas' if sheet.decimal_comma else ''}"


# ------------------------------------------------------------------------------- what it means


def _time(
    sheet: Sheet, skip: int, values: Array | None, column: _Column | None, rows: int
) -> tuple[Array | None, str]:
    """Seconds (N,), or None where there are none or they are ruined, and what was understood."""
    if column is None:
        return None, "no column of times"
    if values is None:
        cells = sheet.text(column.index, skip)[:rows]
        try:
            return np.array(
                [datetime.fromisoformat(c).timestamp() for c in cells]
            ), "times as dates"
        except ValueError as error:
            raise InputError(f"{sheet.path}: column {column.theirs}: {error}") from None
    time_s, said = seconds(values, column.unit)
    if not np.isfinite(time_s).all() or (rows > 1 and len(np.unique(time_s)) < rows / 2):
        return None, f"column {column.theirs} tells no times: cells are empty or alike"
    return time_s, said


def _in_si(
    path: Path, table: Columns, columns: Mapping[str, _Column], joints: Sequence[str],
    options: Options,
) -> tuple[Columns, list[str]]:  # fmt: skip
    """Joints and bodies in SI units, Euler angles as quaternions, and what was understood."""
    said, out = [], dict(table)
    for joint in joints:
        length = options.joints[joint] == "prismatic"
        out[joint], unit = _joint(path, joint, table[joint], columns[joint], length, options)
        said += [f"{path.name}: {joint} in {unit}"] if unit not in ("rad", "m") else []
    for body in dict.fromkeys(n.rpartition(".")[0] for n in table if n.endswith((".x", ".rx"))):
        part = {p: out.pop(f"{body}.{p}") for p in (*POSE, *EULER) if f"{body}.{p}" in out}
        where = f"{path}: {body}"
        if body == "gyro":
            out |= _gyro(part, columns, options)
            continue
        if not {"x", "y", "z"} <= part.keys():
            raise InputError(
                f"{where} needs {body}.x, {body}.y and {body}.z; say --column for each"
            )
        xyz, unit = _metres(where, part, columns[f"{body}.x"].unit, options)
        words = f"in {unit}"
        if {"qw", "qx", "qy", "qz"} <= part.keys():
            quat = np.stack([part[p] for p in POSE[3:]], axis=1)
        elif set(EULER) <= part.keys():
            angles, angle = _radians(part, columns[f"{body}.rx"].unit, options.angle_unit)
            quat = conventions.quaternions(where, angles, options.euler)
            words += f" and {angle}, Euler angles {options.euler}"
        else:
            quat, words = None, f"a point, {words}"
        pose = xyz if quat is None else conventions.poses(where, xyz, quat)
        if options.up == "y":
            pose, words = conventions.z_up(pose), f"{words}, turned from y up to z up"
        out |= {f"{body}.{p}": pose[:, k] for k, p in enumerate(POSE[: pose.shape[1]])}
        said.append(f"{path.name}: {body} {words}")
    return out, said


def _joint(
    path: Path, name: str, values: Array, column: _Column, length: bool, options: Options
) -> tuple[Array, str]:
    """A joint's values in rad or m, and the unit they were in."""
    if length:
        unit = column.unit or options.length_unit or "m"
        return values * LENGTHS.get(unit, 1.0), unit
    unit = column.unit or options.angle_unit
    with np.errstate(invalid="ignore"):
        if unit is None and np.nanmax(np.abs(values), initial=0) > 4 * np.pi:
            raise InputError(
                f"{path}: joint {name} goes to {np.nanmax(np.abs(values)):.4g}, which looks like "
                f"degrees; say --column '{name}={column.theirs}[deg]' if it alone is in degrees, "
                "--angle-unit deg if all joints are, or rad if it turns that far"
            )
    return values * ANGLES.get(unit or "rad", 1.0), unit or "rad"


def _metres(
    where: str, part: Mapping[str, Array], written: str | None, options: Options
) -> tuple[Array, str]:
    xyz = np.stack([part[axis] for axis in "xyz"], axis=1)
    unit = written if written in LENGTHS else options.length_unit
    conventions.check_metres(where, xyz, unit)
    return xyz * LENGTHS[unit or "m"], unit or "m"


def _radians(
    part: Mapping[str, Array], written: str | None, choice: str | None
) -> tuple[Array, str]:
    """Euler angles (N, 3) rad; beyond a full turn they can only be degrees."""
    angles = np.stack([part[p] for p in EULER], axis=1)
    with np.errstate(invalid="ignore"):
        beyond = np.nanmax(np.abs(angles), initial=0) > 2 * np.pi + 1e-3
    unit = written if written in ANGLES else choice or ("deg" if beyond else "rad")
    return angles * ANGLES[unit], unit


def _gyro(
    part: Mapping[str, Array], columns: Mapping[str, _Column], options: Options
) -> dict[str, Array]:
    unit = columns["gyro.x"].unit or options.angle_unit or "rad"
    return {f"gyro.{axis}": part[axis] * ANGLES.get(unit, 1.0) for axis in "xyz"}


def _are_stops(
    path: Path, table: Columns, time: tuple[Array | None, str], choice: str | None
) -> bool:
    """Whether every row is a stop, rather than an instant of a log."""
    if choice or "stop" in table or time[0] is None:
        if choice == "log" and time[0] is None:
            raise InputError(f"{path}: {time[1]}, and a log needs them; say --column time_s=THEIRS")
        return choice != "log"
    step_s = float(np.median(np.abs(np.diff(time[0])))) if len(time[0]) > 1 else np.inf
    if LOG_BELOW_S < step_s < STOPS_ABOVE_S:
        raise InputError(
            f"{path}: a row every {step_s:.2g} s may be a stop or an instant of a log; say --rows "
            "stops or --rows log"
        )
    return step_s >= STOPS_ABOVE_S


def _stops(
    path: Path, table: Columns, time: tuple[Array | None, str], said: tuple[str, ...],
    odd: tuple[str, ...],
) -> Contents:  # fmt: skip
    """The rows as stops, in the order of time where there is one."""
    time_s, words = time
    rows = len(next(iter(table.values())))
    stops: Columns = {"stop": np.array([f"row{k:05d}" for k in range(rows)])} | table
    order = np.arange(rows)
    if time_s is None:
        odd = (*odd, f"{path.name}: {words}; what changes with time cannot be determined from it")
    else:
        order = np.argsort(time_s, kind="stable")
        stops["time_s"] = time_s
    said = (*said, f"{path.name}: a row is a stop: {rows:,} stops")
    return Contents(stops={k: v[order] for k, v in stops.items()}, understood=said, odd=odd)


def _tracks(
    path: Path, table: Columns, time: tuple[Array | None, str], joints: Sequence[str],
    said: tuple[str, ...], odd: tuple[str, ...],
) -> Contents:  # fmt: skip
    """The rows as a log: bodies, joints and covariates, all on the file's clock."""
    time_s, words = time
    order = np.argsort(time_s, kind="stable")
    if (order[1:] < order[:-1]).any():
        odd = (*odd, f"{path.name}: times fall in places; rows are taken in the order of time")
    bodies = dict.fromkeys(n.rpartition(".")[0] for n in table if n.endswith(".x"))
    track = Track(
        name="",
        kind="covariate",
        clock=path.stem,
        time_s=time_s[order],
        names=(),
        values=np.zeros((0, 0)),
    )

    def cut(name: str, kind: str, columns: Sequence[str], names: Sequence[str]) -> Track:
        values = np.stack([table.pop(column) for column in columns], axis=1)[order]
        return replace(track, name=name, kind=kind, names=tuple(names), values=values)

    tracks = [cut(path.stem, "joints", joints, joints)] if joints else []
    for body in bodies:
        parts = POSE if f"{body}.qw" in table else POSE[:3]
        kind = "gyro" if body == "gyro" else "pose" if len(parts) == 7 else "point"
        tracks.append(cut(body, kind, [f"{body}.{p}" for p in parts], parts))
    rest = [name for name, values in table.items() if values.dtype.kind == "f"]
    tracks += [cut(path.stem, "covariate", rest, rest)] if rest else []
    span = float(np.ptp(time_s))
    rate = f"{(len(time_s) - 1) / span:.3g} Hz over {span:.0f} s" if span else "one instant"
    said = (*said, f"{path.name}: a log at {rate}, {words}: {', '.join(t.name for t in tracks)}")
    return Contents(tracks=tuple(tracks), understood=said, odd=odd)
