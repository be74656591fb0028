"""PLY files with every property of every element, in its own type.

Open3D skips properties of half the types that the format has, `ring` as unsigned short among them,
and knows none of a face. The format is G. Turk's (The PLY Polygon File Format, 1994): a header of
text that names elements and their properties, then a record each, as text or binary.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from chains.errors import InputError
from chains.sizes import check_claim
from sensors.documents import write_atomically
from sensors.numbers import parse_numbers

Columns = dict[str, np.ndarray]

_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2",
    "int": "i4", "uint": "u4", "float": "f4", "double": "f8",
    "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2",
    "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8",
}  # fmt: skip
_NAMES = {kind: name for name, kind in reversed(_TYPES.items())}
_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
_LONGEST_HEADER = 1 << 16  # bytes: a choice; headers have a line of some 20 for each property
_BLOCK_ROWS = 1 << 20  # rows read at once: bounds the memory to some 50 MB


@dataclass
class _Element:
    """What a header says of one element; a property is (name, type, type of a list's length)."""

    name: str
    count: int
    properties: list[tuple[str, str, str | None]] = field(default_factory=list)


def read_ply(path: str | Path) -> dict[str, Columns]:
    """Read every element of a PLY file: its properties by name, each (N,) in its own type.

    A list is (N, k) with the k of the longest; a shorter one ends in -1, or NaN where it holds
    floats. Raises InputError for a file that is missing, is no PLY, or ends too early.
    """
    path = Path(path)
    order, elements, start = _read_header(path)
    data = _as_numbers(path, start) if order == "=" else _as_bytes(path, start)
    tables, offset = {}, 0
    for element in elements:
        tables[element.name], offset = _read_element(path, data, offset, element, order)
    return tables


def fans(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Triangles (F, 3) of polygons (P, k), -1 behind the last corner, and each one's polygon."""
    if corners.ndim != 2 or corners.dtype.kind not in "iu" or corners.shape[1] < 3:
        return np.zeros((0, 3), np.int64), np.zeros(0, np.int64)
    corners = corners.astype(np.int64)
    first, second = np.nonzero(corners[:, 2:] != -1)
    fans = [corners[first, 0], corners[first, second + 1], corners[first, second + 2]]
    return np.stack(fans, axis=1), first


def write_ply(path: str | Path, elements: Mapping[str, Mapping[str, np.ndarray]]) -> None:
    """Write elements as a binary PLY file, whole or not at all; a column (N, k) is a list.

    Raises InputError for a column that no type of the format can hold without loss.
    """
    lines, parts = ["ply", "format binary_little_endian 1.0"], []
    for element, columns in elements.items():
        stored = {name: _storable(path, name, values) for name, values in columns.items()}
        count = len(next(iter(stored.values()), ()))
        lines.append(f"element {element} {count}")
        fields = []
        for name, values in stored.items():
            kind = _NAMES[values.dtype.str[1:]]
            if values.ndim == 2:
                fields.append((_length_of(name), "u1"))
                kind = f"list uchar {kind}"
            fields.append((name, values.dtype, values.shape[1:]))
            lines.append(f"property {kind} {name}")
        records = np.empty(count, np.dtype(fields))
        for name, values in stored.items():
            records[name] = values
            if values.ndim == 2:
                records[_length_of(name)] = values.shape[1]
        parts.append(records)
    with write_atomically(path) as temporary, open(temporary, "wb") as file:
        file.write(("\n".join([*lines, "end_header"]) + "\n").encode("ascii"))
        for records in parts:
            records.tofile(file)


def _storable(path: str | Path, name: str, values: np.ndarray) -> np.ndarray:
    """The column in the nearest type that a PLY file has, little-endian."""
    values = np.asarray(values)
    if values.dtype == bool or values.dtype == np.float16:
        values = values.astype(np.uint8 if values.dtype == bool else np.float32)
    if values.dtype.str[1:] in ("i8", "u8"):
        fits = np.can_cast(np.min_scalar_type(values.max(initial=0)), np.int32) and np.can_cast(
            np.min_scalar_type(values.min(initial=0)), np.int32
        )
        exact = values.astype(np.int32 if fits else np.float64)
        if not np.array_equal(exact.astype(values.dtype), values):
            raise InputError(f"{path}: {name} has whole numbers beyond 2^53, which PLY cannot hold")
        values = exact
    if values.dtype.str[1:] not in _NAMES:
        raise InputError(f"{path}: {name} is {values.dtype}; a PLY file holds numbers only")
    return values.astype(values.dtype.newbyteorder("<"), copy=False)


def _read_header(path: Path) -> tuple[str, list[_Element], int]:
    """Byte order ("=" for text), elements, and where the records begin."""
    try:
        with open(path, "rb") as file:
            head = file.read(_LONGEST_HEADER)
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from None
    if not head:
        raise InputError(f"{path} is empty (0 bytes); a PLY file was wanted")
    end = re.search(rb"^end_header[ \t]*\r?\n?", head, re.MULTILINE)
    if not head.startswith(b"ply") or end is None:
        raise InputError(f"{path} is no PLY file: it has no header from `ply` to `end_header`")
    order, elements = None, []
    for line in head[: end.start()].decode("latin-1").splitlines()[1:]:
        try:
            order = _read_line(line.split(), elements) or order
        except (KeyError, ValueError, IndexError):
            raise InputError(f"{path}: `{line.strip()}` is no line of a PLY header") from None
    for element in elements:
        names = [name for name, _, _ in element.properties]
        if twice := [name for name in names if names.count(name) > 1]:
            raise InputError(f"{path}: its element {element.name} has {twice[0]} twice")
    if order is None:
        raise InputError(f"{path}: its header has no line `format`, as every PLY file does")
    return order, elements, end.end()


def _read_line(words: list[str], elements: list[_Element]) -> str | None:
    """Add what a line of the header says to the elements; return the order that it states."""
    match words:
        case ["format", name, *_]:
            return _ORDERS[name]
        case ["element", name, count]:
            elements.append(_Element(name, int(count)))
        case ["property", "list", length, kind, name]:
            elements[-1].properties.append((name, _TYPES[kind], _TYPES[length]))
        case ["property", kind, name]:
            elements[-1].properties.append((name, _TYPES[kind], None))
        case [] | ["comment" | "obj_info", *_]:
            pass
        case _:
            raise ValueError
    return None


def _as_bytes(path: Path, start: int) -> np.ndarray:
    """Everything behind the header, read only as it is used."""
    if path.stat().st_size == start:
        return np.empty(0, np.uint8)
    return np.memmap(path, np.uint8, mode="r", offset=start)


def _as_numbers(path: Path, start: int) -> np.ndarray:
    """The numbers behind the header as bytes of doubles, which hold all types exactly."""
    with open(path, "rb") as file:
        file.seek(start)
        return parse_numbers(file.read()).view(np.uint8)


def _read_element(
    path: Path, data: np.ndarray, offset: int, element: _Element, order: str
) -> tuple[Columns, int]:
    """The columns of an element whose records begin at `offset`, and where the next one's do.

    Records are read in runs: as many at once as have lists of the same lengths.
    """
    runs, done, block = [], 0, _BLOCK_ROWS
    while done < element.count:
        try:
            record = _record(data, offset, element, order)
        except _NoLengthError:
            raise InputError(
                f"{path}: row {done + 1} of its element {element.name} has a list of no length that"
                f" can be; get the whole file"
            ) from None
        there = 0 if record is None else (len(data) - offset) // record.itemsize
        if there == 0:
            raise InputError(
                f"{path} ends too early: {done} of {element.count} rows of its element "
                f"{element.name} are there; get the whole file"
            )
        rows = np.frombuffer(data, record, min(there, block, element.count - done), offset)
        rows = rows[: _alike(rows)]
        runs.append({name: rows[name] for name, _, _ in element.properties})
        offset += record.itemsize * len(rows)
        done += len(rows)
        block = min(2 * len(rows), _BLOCK_ROWS)
    for name, _, length in element.properties:  # a list takes as much room as the longest
        longest = max((run[name].shape[1] for run in runs if length is not None), default=0)
        check_claim(path, 8 * longest * done, f"{done} lists as long as one of {name}")
    return {name: _join(runs, name, kind) for name, kind, _ in element.properties}, offset


def _record(data: np.ndarray, offset: int, element: _Element, order: str) -> np.dtype | None:
    """The record at `offset`, its lists as long as they are there; None beyond the end."""
    fields: list[tuple] = []
    for name, kind, length in element.properties:
        count = ()
        if length is not None:
            at = offset + np.dtype(fields).itemsize
            size = _stored(length, order)
            if at + size.itemsize > len(data):
                return None
            count = (_length(np.frombuffer(data, size, 1, at)[0], len(data)),)
            fields.append((_length_of(name), size))
        fields.append((name, _stored(kind, order), count))
    record = np.dtype(fields)
    return record if 0 < record.itemsize <= len(data) - offset else None


def _length(stored: np.generic, most: int) -> int:
    """The length of a list, no longer than the file; -1 and the like are no length."""
    if not 0 <= stored <= most:
        raise _NoLengthError
    return int(stored)


class _NoLengthError(Exception):
    """A list claims to be longer than its file, or shorter than nothing."""


def _stored(kind: str, order: str) -> np.dtype:
    """How a number of that type is stored; one of a text as a double."""
    return np.dtype("f8" if order == "=" else order + kind)


def _length_of(name: str) -> str:
    """The field that holds the length of a list."""
    return f"length of {name}"


def _alike(rows: np.ndarray) -> int:
    """How many rows from the first on have lists as long as the first row's."""
    alike = len(rows)
    for name in rows.dtype.names:
        if rows.dtype[name].ndim and _length_of(name) in rows.dtype.names:
            length = rows[_length_of(name)][:alike]
            other = np.flatnonzero(length != length[0])
            alike = int(other[0]) if len(other) else alike
    return alike


def _join(runs: list[Columns], name: str, kind: str) -> np.ndarray:
    """One column of all runs, in its own type and the machine's order."""
    parts = [run[name] for run in runs]
    longest = max((part.shape[1] for part in parts if part.ndim == 2), default=0)
    if any(part.ndim == 2 and part.shape[1] != longest for part in parts):
        fill, kind = (np.nan, kind) if kind[0] == "f" else (-1, "i8")
        parts = [
            np.pad(p.astype(kind), ((0, 0), (0, longest - p.shape[1])), constant_values=fill)
            for p in parts
        ]
    return np.concatenate(parts).astype(kind) if parts else np.empty(0, kind)
