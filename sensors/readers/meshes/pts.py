"""Leica's and FARO's clouds as text, PTS and PTX, in blocks, so that a file of any size will do.

PTS: a line with the number of points, then that many lines x y z [intensity] [r g b]; again for
the next scan. PTX: for each scan its columns, its rows, where the scanner stood and its axes
(4 lines), the matrix that takes a row x y z 1 to the common frame (4 lines), then columns times
rows lines x y z intensity [r g b] in the scanner's frame, 0 0 0 where nothing came back.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import BinaryIO

import numpy as np

from chains.errors import InputError
from sensors.numbers import parse_numbers
from sensors.readers.base import Array

BLOCK_LINES = 1 << 18  # read at once: bounds the memory to some 20 MB


@dataclass(frozen=True)
class PointBlock:
    """Some points of one scan, in the units and axes of their file.

    Args:
        scan: number of the scan within its file, from 0.
        points: (N, 3) in the common frame.
        intensity: (N,) or None.
        normal: (N, 3) or None.
        origin: (3,) where the scanner stood, None = not known.
    """

    scan: int
    points: np.ndarray
    intensity: np.ndarray | None = None
    normal: np.ndarray | None = None
    origin: Array | None = None


def read_pts(path: Path) -> Iterator[PointBlock]:
    """Read a PTS file, or lines x y z … without a count; InputError with the line that is wrong."""
    _check(path)
    with open(path, "rb") as file:
        lines = _Lines(path, file)
        scan = 0
        while (first := lines.peek()) is not None:
            count = int(first[0]) if len(first) == 1 and first[0] >= 0 else None
            if count is not None:
                lines.take(1)
            for rows in lines.rows(count):
                yield PointBlock(scan, rows[:, :3], _intensity(rows))
            scan += 1


def read_ptx(path: Path) -> Iterator[PointBlock]:
    """Read a PTX file; InputError with the line that is wrong."""
    _check(path)
    with open(path, "rb") as file:
        lines = _Lines(path, file)
        scan = 0
        while lines.peek() is not None:
            head = lines.take(10)
            if [len(row) for row in head] != [1, 1, 3, 3, 3, 3, 4, 4, 4, 4]:
                raise InputError(
                    f"{path}:{lines.number - 9}: no PTX header: columns, rows, 4 lines of 3 "
                    "numbers and 4 lines of 4 are wanted"
                )
            T_row = np.array(head[6:])
            for rows in lines.rows(int(head[0][0] * head[1][0])):
                rows = rows[rows[:, :3].any(axis=1)]
                points = rows[:, :3] @ T_row[:3, :3] + T_row[3, :3]
                yield PointBlock(scan, points, _intensity(rows), origin=T_row[3, :3])
            scan += 1


def _intensity(rows: np.ndarray) -> np.ndarray | None:
    return rows[:, 3] if rows.shape[1] in (4, 7) else None


def _check(path: Path) -> None:
    if not path.is_file():
        raise InputError(f"{path} does not exist; name a cloud")
    if path.stat().st_size == 0:
        raise InputError(f"{path} is empty (0 bytes); a cloud was wanted")


class _Lines:
    """Lines of numbers, counted."""

    def __init__(self, path: Path, file: BinaryIO) -> None:
        self.path, self.file, self.number = path, file, 0
        self._next: bytes | None = None

    def peek(self) -> list[float] | None:
        """The numbers of the next line that has any; None at the end."""
        while self._next is None or not self._next.strip() or self._next.startswith((b"#", b"//")):
            self._next = self.file.readline()
            if not self._next:
                return None
            self.number += 1
        return _numbers(self._next, self.path, self.number).tolist()

    def take(self, count: int) -> list[list[float]]:
        """The numbers of the next lines."""
        taken = []
        for _ in range(count):
            row = self.peek()
            if row is None:
                raise InputError(f"{self.path} ends too early, after line {self.number}")
            taken.append(row)
            self._next = None
        return taken

    def rows(self, count: int | None) -> Iterator[np.ndarray]:
        """The next `count` lines, all if None, as blocks (n, C) of numbers."""
        first = self.peek() if count != 0 else []
        if count == 0:
            return
        if first is None or len(first) < 3:
            raise InputError(f"{self.path}:{self.number}: x, y and z are wanted")
        left = count
        while left is None or left > 0:
            wanted = BLOCK_LINES if left is None else min(BLOCK_LINES, left)
            lines = [] if self._next is None else [self._next]
            number = self.number + 1 - len(lines)
            lines += islice(self.file, wanted - len(lines))
            self._next, self.number = None, number + len(lines) - 1
            while lines and not lines[-1].strip():
                lines.pop()
            if not lines:
                break
            yield self._table(lines, len(first), number)
            left = None if left is None else left - len(lines)
        if left:
            there = count - left
            raise InputError(
                f"{self.path} ends too early: {there} of {count} points are there; get all of it"
            )

    def _table(self, lines: list[bytes], columns: int, number: int) -> np.ndarray:
        """Numbers (n, C) of lines, the first of which is line `number` of the file."""
        values = _parse(b"".join(lines))
        if values.size != len(lines) * columns:
            for k, line in enumerate(lines, number):
                cells = len(_numbers(line, self.path, k))
                if cells != columns:
                    raise InputError(
                        f"{self.path}:{k}: {cells} numbers, but the lines above have {columns}; is "
                        "the file cut off?"
                    )
        return values.reshape(-1, columns)


def _numbers(line: bytes, path: Path, number: int) -> np.ndarray:
    values, words = _parse(line), line.replace(b",", b" ").split()
    if len(values) != len(words):
        text = line.decode("latin-1").strip()[:40]
        raise InputError(f"{path}:{number}: `{text}` is no line of numbers, as a cloud has them")
    return values


def _parse(text: bytes) -> np.ndarray:
    """All numbers of a text, with blanks or commas between them, up to what is none."""
    return parse_numbers(text.replace(b",", b" "))
