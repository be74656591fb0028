"""Tables as other programs write them: whatever separates cells, whatever marks decimals.

Lines are streamed, so that a log of any length takes no more memory than the numbers wanted of it.
"""

from __future__ import annotations

import codecs
import csv
import re
from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import islice
from pathlib import Path

import numpy as np

from chains.errors import InputError
from sensors.readers.base import Array

SAMPLE_LINES = 200  # of a file, from which its form is told: headers have some ten
LENGTHS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
ANGLES = {"rad": 1.0, "deg": np.pi / 180}
TIME_UNITS = {"s": 1.0, "sec": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_BOMS = (
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d+)?$|[-+]?(nan|inf)$", re.I)
_WITH_COMMA = re.compile(r"[-+]?\d*,\d+(e[-+]?\d+)?$", re.I)
_UNIT = re.compile(r"(.*?)\s*[\[(]\s*(\w+)\s*[\])]$|(.*?)[_ ](mm|cm|m|deg|rad|ms|us|ns|s)$", re.I)
_EPOCH = ((1e17, 1e-9), (1e14, 1e-6), (1e11, 1e-3))  # from there on: ns, us, ms since 1970


@dataclass(frozen=True)
class Sheet:
    """How the cells of a table stand in its file.

    Args:
        path: the file.
        encoding: of its text.
        separator: between cells; None = any white space.
        decimal_comma: whether 1,5 is one and a half.
    """

    path: Path
    encoding: str
    separator: str | None
    decimal_comma: bool

    def lines(self, skip: int = 0) -> Iterator[tuple[int, str]]:
        """Each line after `skip` that is neither empty nor a comment, and its number, from 1."""
        with open(self.path, encoding=self.encoding, newline=None) as file:
            try:
                for number, line in enumerate(file, 1):
                    line = line.rstrip("\n\0")  # some loggers end each line with a zero
                    if number > skip and line.strip() and line.lstrip()[0] not in "#%":
                        yield number, line
            except UnicodeError:
                raise InputError(f"{self.path} is not a text file; a table is wanted") from None

    def cells(self, line: str) -> list[str]:
        """The cells of a line, without the blanks and quotes around them."""
        if self.separator is None:
            return line.split()
        if '"' in line:
            return [cell.strip() for cell in quoted(self.path, line, self.separator)]
        return [cell.strip() for cell in line.split(self.separator)]

    def numbers(self, columns: Sequence[int], skip: int = 0) -> tuple[Array, tuple[str, ...]]:
        """The numbers (N, C) of some columns, NaN where a cell is empty, and what looked odd.

        A last line that breaks off is left out. Raises InputError naming the line where a cell is
        no number, or where cells are missing.
        """
        values, short, width, most = array("d"), None, 0, max(columns, default=-1)
        for number, line in self.lines(skip):
            if short is not None and short[1] <= most:
                raise InputError(f"{self.path}:{short[0]}: cells are missing; the row is cut off")
            cells = self.cells(line.replace(",", ".") if self.decimal_comma else line)
            width = width or len(cells)
            short = (number, len(cells)) if len(cells) < width else None
            try:
                row = [float(cells[c]) if cells[c] else np.nan for c in columns if c < len(cells)]
            except ValueError as error:
                raise InputError(f"{self.path}:{number}: {error}; a number is wanted") from None
            values.extend(row + [np.nan] * (len(columns) - len(row)))
        table = np.frombuffer(values, float).reshape(-1, len(columns)) if len(values) else None
        if table is None:
            return np.zeros((0, len(columns))), ()
        if short is None:
            return table, ()
        return table[:-1], (f"{self.path.name} breaks off in line {short[0]}, which is left out",)

    def text(self, column: int, skip: int = 0) -> list[str]:
        """The cells of one column as they stand, of the rows that reach it."""
        rows = (self.cells(line) for _, line in self.lines(skip))
        return [row[column] for row in rows if len(row) > column]


def open_sheet(path: Path) -> tuple[Sheet, list[str]]:
    """Find out how a table is written; with it come its first lines as they stand, 200 at most.

    Raises:
        InputError: the file is missing, empty, or no text.
    """
    try:
        with open(path, "rb") as file:
            start = file.read(4)
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}); name a file") from None
    encoding = next((name for bom, name in _BOMS if start.startswith(bom)), "utf-8")
    try:
        head = _head(path, encoding)
    except UnicodeError:
        head = _head(path, encoding := "latin-1")
    if any("\0" in line for line in head):
        raise InputError(f"{path} is not a text file; a table is wanted")
    if not any(line.strip() for line in head):
        raise InputError(f"{path} is empty; a table is wanted")
    rows = [line for line in head if line.strip() and line.lstrip()[0] not in "#%"]
    separator = _separator(rows[len(rows) // 2 :] or head)
    comma = separator != "," and any(
        _WITH_COMMA.match(cell.strip()) for line in rows[1:] for cell in line.split(separator)
    )
    return Sheet(path, encoding, separator, comma), head


def is_number(cell: str, decimal_comma: bool = False) -> bool:
    """Whether a cell holds a number."""
    return bool(_NUMBER.match(cell.replace(",", ".") if decimal_comma else cell))


def split_unit(header: str) -> tuple[str, str | None]:
    """A header without its unit, and the unit: ``x [mm]``, ``x (mm)`` and ``x_mm`` are in mm."""
    match = _UNIT.match(header.strip())
    if not match or not (match[2] or match[4]):
        return header.strip(), None
    name, unit = (match[1], match[2]) if match[2] else (match[3], match[4])
    unit = {"degree": "deg", "degrees": "deg", "meters": "m"}.get(unit.lower(), unit.lower())
    known = unit in LENGTHS or unit in ANGLES or unit in TIME_UNITS
    return (name.strip(), unit) if known else (header.strip(), None)


def seconds(values: Array, unit: str | None) -> tuple[Array, str]:
    """Times (N,) in s, and how they were understood in words.

    By the unit of the header; without one, stamps such as 20200714163904 are dates, and numbers
    too large for seconds since 1970 are milli-, micro- or nanoseconds.
    """
    size = np.nanmedian(np.abs(values)) if np.isfinite(values).any() else 0.0
    if unit in TIME_UNITS:
        return values * TIME_UNITS[unit], f"times in {unit}"
    if 1.9e13 < size < 2.2e13 and (dates := _dates(values)) is not None:
        return dates, "times as dates, YYYYMMDDhhmmss"
    factor = next((factor for least, factor in _EPOCH if size > least), 1.0)
    return (
        values * factor,
        f"times in {dict((f, u) for u, f in TIME_UNITS.items() if u != 'sec')[factor]}",
    )


def _dates(values: Array) -> Array | None:
    """Seconds since 1970 of stamps YYYYMMDDhhmmss; None where one is no date, or all are alike."""
    if len(values) > 1 and np.ptp(values) == 0:
        return None
    try:
        stamps = [datetime.strptime(f"{v:.0f}", "%Y%m%d%H%M%S") for v in values]
    except ValueError:
        return None
    return np.array([stamp.replace(tzinfo=UTC).timestamp() for stamp in stamps])


def _head(path: Path, encoding: str) -> list[str]:
    with open(path, encoding=encoding, newline=None) as file:
        return [line.rstrip("\n\0") for line in islice(file, SAMPLE_LINES)]


def _separator(rows: Sequence[str]) -> str | None:
    """The first of ; tab and comma that stands in half of the rows; else white space."""
    half = len(rows) / 2  # not in all: the last may be cut off
    return next((mark for mark in ";\t," if sum(mark in row for row in rows) >= half), None)


def quoted(path: Path, line: str, separator: str = ",") -> list[str]:
    """The cells of a line, some of which may stand in quotes; InputError where one has no end."""
    try:
        return next(csv.reader([line], delimiter=separator))
    except csv.Error as error:
        raise InputError(f"{path} is no table: {error}") from None
