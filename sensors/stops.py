"""stops.csv and targets.csv: every cell checked, so that nothing behind them has to ask again."""

import csv
import hashlib
import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chains import escape
from chains.errors import LONGEST_NAME, InputError, is_file_name, shortened
from sensors.documents import plain, write_atomically
from sensors.numbers import read_csv

Array = NDArray[np.float64]

POSE = ("x", "y", "z", "qw", "qx", "qy", "qz")
_FELT = ("ax", "ay", "az")
# Of the usual length of what an accelerometer feels, by which a stop's may differ at rest: zero
# offsets of cheap ones are 0.08 g at most (ADXL345, MPU-6050: data sheets).
_OFF_REST = 0.1
_FARTHEST_M = 1000.0  # a choice: no tracker sees so far; in millimetres, what is a metre away is
_MEASURED = ("temperature_c", "payload_kg", "torque")  # columns, or their endings, of numbers only
_LARGEST_JOINT = 4 * math.pi  # rad or m, a choice: wrists turn twice about at most


@dataclass(frozen=True)
class Targets:
    """M calibration targets: sphere centres in the reference's frame, markers in the tracker's."""

    names: list[str]
    faro_m: Array
    """(M, 3) centre of the sphere."""
    upper_m: Array
    """(M, 3) upper marker of the rod."""
    lower_m: Array
    """(M, 3) lower marker of the rod."""

    def digests(self, of: str) -> dict[str, str]:
        """Name -> a digest (hex) of all that was measured of it, and of what that is a measurement
        of."""
        rows = np.hstack([self.faro_m, self.upper_m, self.lower_m])
        return {
            name: hashlib.sha256(of.encode() + row.tobytes()).hexdigest()
            for name, row in zip(self.names, rows, strict=True)
        }


class CsvTable:
    """A CSV table whose columns are taken one by one, each checked; `rest` gives the others."""

    def __init__(self, path: Path, key: str, text: Sequence[str] = ()) -> None:
        self.path, self._key = path, key
        self._columns = read_csv(path, text=(key, *text))
        self._names = self.text(key).tolist()

    def __contains__(self, name: str) -> bool:
        return name in self._columns

    def names(self) -> list[str]:
        """Take the names of the rows: at least one row, no empty name, none twice."""
        if not self._names:
            raise InputError(f"{self.path} has no rows; it needs one per {self._key}")
        seen: set[str] = set()
        for row, name in enumerate(self._names):
            if not is_file_name(name):
                raise InputError(
                    f"{self.path}: row {row + 1}: {shortened(name)} is no name for a file"
                )
            if name in seen:
                raise InputError(f"{self.path}: row {row + 1}: {name} is there twice; rename one")
            seen.add(name)
        return self._names

    def text(self, name: str) -> NDArray[np.str_]:
        """Take a column of text."""
        if name not in self._columns:
            raise InputError(f"{self.path}: column {name} is missing; every row needs one")
        return self._columns.pop(name)

    def numbers(
        self, name: str, why: str, largest: float = math.inf, units: str = "", gaps: bool = False
    ) -> Array:
        """Take a column of finite numbers, none beyond `largest`, which would betray its units;
        where it may have gaps, an empty cell is NaN."""
        values = self._loose(name, why)
        finite = np.isfinite(values) | (gaps & np.isnan(values))
        self.refuse(~finite, f"{name} is empty or not finite; {why}")
        wrong = np.abs(values) > largest
        self.refuse(wrong, lambda row: f"{name} is {values[row]:g}; {units}")
        return values

    def locations(self) -> NDArray[np.str_]:
        """Take the names of places, one for every row: short, and nothing in them unseen."""
        places = self.text("location")
        wrong = [
            len(place.encode("utf-8", "replace")) > LONGEST_NAME or not place.isprintable()
            for place in places.tolist()
        ]
        self.refuse(
            np.array(wrong, bool),
            lambda row: f"location {shortened(str(places[row]))} is no short name of a place",
        )
        return places

    def times(self, name: str) -> Array:
        """Take a column of times in s; NaN throughout where there is none, or nothing in it."""
        unknown = np.full(len(self._names), np.nan)
        column = self._columns.get(name, unknown)
        if column.dtype.kind == "f" and np.isnan(column).all():
            self._columns.pop(name, None)
            return unknown
        return self.numbers(name, "either every stop has its time in seconds, or none")

    def joints(self, names: Sequence[str], unread: Collection[str] = ()) -> Array:
        """Take the joints (K, J) by name, in rad or m; of those unread NaN where there is none."""
        why = "the arm's URDF has this joint, so every stop needs its value"
        units = "joints are in radians or metres, and this looks like degrees or millimetres"
        none = {name: np.full(len(self._names), np.nan) for name in unread if name not in self}
        columns = [
            none[name]
            if name in none
            else self.numbers(name, why, _LARGEST_JOINT, units, gaps=name in unread)
            for name in names
        ]
        return np.array(columns).reshape(len(names), len(self._names)).T

    def points(self, name: str, separator: str) -> Array:
        """Take three columns of positions (N, 3) in m."""
        units = "positions are in metres, and this looks like millimetres"
        names = [f"{name}{separator}{axis}" for axis in "xyz"]
        why = f"{name or 'each row'} needs {', '.join(names)}"
        return np.array([self.numbers(part, why, _FARTHEST_M, units) for part in names]).T

    def pose(self, body: str) -> Array:
        """Take a tracked body (K, 7): x y z [m] and a unit quaternion; NaN where not seen.

        Without any q column the body is a point, whose quaternion is NaN throughout.
        """
        names = [f"{body}.{part}" for part in POSE]
        if not any(name in self for name in names[3:]):
            names = names[:3]
        pose = self._whole(names, body, f"{body} was seen; give its whole pose, or leave all of it")
        self.refuse(
            (np.abs(pose[:, :3]) > _FARTHEST_M).any(axis=1),
            lambda row: (
                f"{body} is {np.abs(pose[row, :3]).max():g} m away; positions are in metres,"
                " and this looks like millimetres"
            ),
        )
        if len(names) == 3:
            return np.hstack([pose, np.full((len(pose), 4), np.nan)])
        length = np.linalg.norm(pose[:, 3:], axis=1, keepdims=True)
        self.refuse(
            np.abs(length[:, 0] - 1) > 1e-3,
            lambda row: (
                f"the quaternion {body}.qw .qx .qy .qz has length {length[row, 0]:.4g}, and"
                " a rotation has 1"
            ),
        )
        return np.hstack([pose[:, :3], pose[:, 3:] / length])

    def level(self, frame: str) -> Array:
        """Take what an accelerometer felt at rest, in any unit, as unit vectors (K, 3); NaN where
        it was not read."""
        names = level_columns(frame)
        what = f"the level in {frame}"
        felt = self._whole(names, what, f"{what} was read; give all three, or leave all of them")
        length = np.linalg.norm(felt, axis=1)
        self.refuse(length == 0, f"{', '.join(names)} are all 0; leave what was not read empty")
        usual = np.median(length[np.isfinite(length)]) if np.isfinite(length).any() else 1.0
        self.refuse(
            np.abs(length - usual) > _OFF_REST * usual,
            lambda row: (
                f"{', '.join(names)} have length {length[row]:.4g}, and {usual:.4g} at most stops; "
                "at rest it is always that of gravity, so leave this row's empty"
            ),
        )
        return felt / length[:, None]

    def _whole(self, names: Sequence[str], what: str, but: str) -> Array:
        """Take the columns (K, n) that something needs, of which a row has all or none."""
        found = np.array([self._loose(n, f"{what} needs {', '.join(names)}") for n in names]).T
        missing = ~np.isfinite(found)
        self.refuse(
            missing.any(axis=1) & ~np.isnan(found).all(axis=1),
            lambda row: (
                f"{names[np.argmax(missing[row])]} is empty or not finite, though {but} empty"
            ),
        )
        return found

    def rest(self) -> dict[str, Array]:
        """Give every other numeric column; one that is mostly numbers must be so throughout, and
        so must one that is measured in numbers; none is infinite."""
        why = "leave a cell empty where the value is unknown"
        for name, values in list(self._columns.items()):
            if values.dtype.kind == "f":
                self.refuse(np.isinf(values), f"{name} is not finite; {why}")
                continue
            numeric = [escape.is_number(cell) for cell in values.tolist() if cell]
            measured = name.rpartition(".")[2] in _MEASURED
            if not all(numeric) and (measured or 2 * sum(numeric) > len(numeric)):
                self._loose(name, why)
        return {name: column for name, column in self._columns.items() if column.dtype.kind == "f"}

    def _loose(self, name: str, why: str) -> Array:
        """Take a column of numbers, NaN where empty."""
        if name not in self._columns:
            raise InputError(f"{self.path}: column {name} is missing; {why}")
        values = self._columns[name]
        if values.dtype.kind != "f":
            wrong = np.array(
                [bool(cell) and not escape.is_number(cell) for cell in values.tolist()]
            )
            self.refuse(wrong, lambda row: f"{name} is '{values[row]}', not a number; {why}")
        return self._columns.pop(name)

    def refuse(self, wrong: NDArray[np.bool_], what: str | Callable[[int], str]) -> None:
        """Raise InputError that says what is wrong with the first row where `wrong` (N,) holds."""
        if wrong.any():
            row = int(np.argmax(wrong))
            problem = what if isinstance(what, str) else what(row)
            raise InputError(f"{self.path}: row {row + 1} ({self._names[row]}): {problem}")


def in_time(stops: Sequence[str], time_s: Array) -> list[str]:
    """Names of stops in the order in which they were made; in that of their rows where one has no
    time (K,)."""
    if not np.isfinite(time_s).all():
        return list(stops)
    return [stops[k] for k in np.argsort(time_s, kind="stable")]


def level_columns(frame: str) -> list[str]:
    """Of what an accelerometer in a frame feels."""
    return [f"{frame}.{axis}" for axis in _FELT]


def undeclared_levels(columns: Iterable[str]) -> list[str]:
    """Frames of which all three columns of an accelerometer are among these."""
    every = set(columns)
    frames = (name.removesuffix(f".{_FELT[0]}") for name in every if name.endswith(f".{_FELT[0]}"))
    return sorted(frame for frame in frames if every.issuperset(level_columns(frame)))


def read_targets(path: Path) -> Targets | None:
    """Read targets.csv, None where there is none; InputError for fewer than 3 targets."""
    if not path.exists():
        return None
    table = CsvTable(path, key="target")
    names = table.names()
    if len(names) < 3:
        raise InputError(f"{path} has {len(names)} rows; it takes 3 targets to fix a transform")
    faro, upper, lower = (table.points(part, "_") for part in ("faro", "upper", "lower"))
    table.refuse(
        np.linalg.norm(upper - lower, axis=1) < 1e-3,
        "the two markers are in one place, and so show no direction of gravity",
    )
    return Targets(names, faro, upper, lower)


def read_cameras(path: Path) -> Array:
    """Read where a tracker's cameras are (C, 3), m, in its frame: a CSV with ``camera``, a name,
    and ``x``, ``y``, ``z``; InputError for fewer than 2, which see nothing in space."""
    table = CsvTable(path, key="camera")
    names = table.names()
    if len(names) < 2:
        raise InputError(
            f"{path} has {len(names)} row; it takes 2 cameras to see a marker in space"
        )
    return table.points("", "")


def write_columns(path: str | Path, columns: Mapping[str, Iterable]) -> None:
    """Write columns of equal length as CSV; a number that is none is an empty cell, and text that
    a spreadsheet would run as a formula is marked as text."""
    with write_atomically(path) as work, open(work, "w", newline="", encoding="utf-8") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(map(escape.csv_cell, columns))
        for row in zip(*(plain(values) for values in columns.values()), strict=True):
            table.writerow(map(_cell, row))


def _cell(value: Any) -> Any:
    if isinstance(value, str):
        return escape.csv_cell(value)
    return "" if value != value else value
