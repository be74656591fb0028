"""Numbers in files: in text, in the columns of a CSV, and in the files of NumPy."""

import csv
import warnings
import zipfile
import zlib
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from functools import lru_cache
from io import BytesIO
from pathlib import Path
from tokenize import TokenError
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from chains import escape
from chains.errors import InputError
from chains.sizes import check_claim
from sensors.documents import read_text

if TYPE_CHECKING:
    import pandas

LONGEST_NUMBER = 32  # characters
# Of columns, as spreadsheets write them, and what they are called.
OTHER_SEPARATORS = {";": "';'", "\t": "tabs"}


def parse_numbers(text: bytes) -> NDArray[np.float64]:
    """The numbers (N,) of a text, with white space between them, up to the first word that is none.

    Who knows how many there should be tells from the count whether all were.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)  # numpy before 2.4 only warns
        try:
            return np.fromstring(text.decode("latin-1"), np.float64, sep=" ")
        except (ValueError, DeprecationWarning):
            return np.array(list(_until_none(text)), np.float64)


def _until_none(text: bytes) -> Iterator[float]:
    for word in text.split():
        try:
            yield float(word)
        except ValueError:
            return


def read_csv(path: str | Path, text: Collection[str] = ()) -> dict[str, np.ndarray]:
    """Read a comma-separated table with one header row into columns.

    A column is float64 where every cell is a number or empty (NaN), otherwise text; the columns
    named in `text` are text always. Raises InputError naming the row of a ragged line, or the
    column that stands in the header twice.
    """
    whole = read_text(path)
    if not whole.strip():
        raise InputError(f"{path}: the file is empty; its first line has to name the columns")
    lines = csv.reader(whole.splitlines())
    try:
        return _columns_of(path, lines, text)
    except csv.Error as error:
        raise InputError(f"{path}:{lines.line_num}: is no row of a table: {error}") from None


def _columns_of(path: str | Path, lines: Any, text: Collection[str]) -> dict[str, np.ndarray]:
    header = [escape.from_csv_cell(name.strip()) for name in next(lines, [])]
    times = Counter(header)
    for mark, name in (OTHER_SEPARATORS if len(header) <= 1 else {}).items():
        if mark in "".join(header):
            raise InputError(
                f"{path}:1: columns are separated by {name} here; separate them by commas"
            )
    for name in header:
        if not name or times[name] > 1:
            raise InputError(f"{path}:1: every column needs its own name, and {name!r} is not one")
    rows = []
    for row in lines:
        if any(cell.strip() for cell in row):
            if len(row) != len(header):
                raise InputError(
                    f"{path}:{lines.line_num}: {len(row)} cells where the header names"
                    f" {len(header)} columns; write an empty cell for what is unknown"
                )
            rows.append([escape.from_csv_cell(cell.strip()) for cell in row])
    columns = list(zip(*rows, strict=True)) if rows else ((),) * len(header)
    for name, cells in zip(header, columns, strict=True):
        longest = max(map(len, cells), default=0)  # of which all cells of a column take the room
        if longest > LONGEST_NUMBER:
            check_claim(Path(path), 4 * longest * len(cells), f"cells as long as one of {name}")
    return {
        name: np.array(cells, dtype=np.str_) if name in text else _numbers_or_text(cells)
        for name, cells in zip(header, columns, strict=True)
    }


def _numbers_or_text(cells: Collection[str]) -> np.ndarray:
    try:
        return np.array([float(cell or "nan") for cell in cells], dtype=np.float64)
    except ValueError:
        return np.array(cells, dtype=np.str_)


def read_arrays(path: str | Path) -> np.ndarray | dict[str, np.ndarray]:
    """The array of a .npy file, or those of an .npz file by their names; never any object.

    Raises:
        InputError: the file is missing, is none of these or not whole, or claims to hold more than
            it can.
    """
    path = Path(path)
    try:
        if not path.is_file():
            raise InputError(f"{path} does not exist")
        with open(path, "rb") as file:
            if file.read(2) == b"PK":
                return _archive(path)
            file.seek(0)
            return _array(path, file, path.stat().st_size)
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror or error}") from None
    except InputError:
        raise
    except _DAMAGE as error:
        why = (str(error).splitlines() or [type(error).__name__])[0]
        raise InputError(f"{path} is no whole NumPy file: {why}") from None


# What numpy, zipfile and its decompressors raise where bytes are not what they should be.
_DAMAGE = (
    *(ValueError, TypeError, KeyError, IndexError, EOFError, OverflowError, SyntaxError),
    *(RuntimeError, MemoryError, zipfile.BadZipFile, zlib.error, TokenError),
)


def _archive(path: Path) -> dict[str, np.ndarray]:
    with zipfile.ZipFile(path) as archive:
        members = archive.infolist()
        claimed = sum(member.file_size for member in members)
        check_claim(path, claimed, f"{len(members)} arrays")
        arrays = {}
        for member in members:
            with archive.open(member) as file:
                name = member.filename.removesuffix(".npy")
                arrays[name] = _array(path, file, member.file_size)
        return arrays


# Version of a file -> bytes of the length of its header, and what reads that.
_HEADERS = {
    1: (2, np.lib.format.read_array_header_1_0),
    2: (4, np.lib.format.read_array_header_2_0),
}


@lru_cache(maxsize=64)
def _header(version: int, header: bytes) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Shape, whether in Fortran's order, and dtype. A run's state has the same few headers
    thousands of times, and each is parsed as Python."""
    _, read = _HEADERS[version]
    return read(BytesIO(header))


def _array(path: Path, file: BinaryIO, size: int) -> np.ndarray:
    """One array, of a file or member of `size` bytes."""
    version, _ = np.lib.format.read_magic(file)
    if version not in _HEADERS:
        raise InputError(f"{path}: version {version} of NumPy's files is not read; save it anew")
    size_of, _ = _HEADERS[version]
    length = file.read(size_of)
    header = length + file.read(int.from_bytes(length, "little"))
    shape, fortran, dtype = _header(version, header)
    if dtype.hasobject:
        raise InputError(f"{path} holds Python objects, which are not read; save numbers")
    count = 1
    for length in shape:  # exact, where numpy's product would run over
        count *= length
    if min(shape, default=0) < 0 or count * dtype.itemsize + file.tell() > size:
        raise InputError(
            f"{path} claims an array {shape} of {dtype}, and holds {size} bytes of it; get the "
            f"whole file"
        )
    values = np.frombuffer(file.read(count * dtype.itemsize), dtype, count)
    return values.reshape(shape[::-1]).T if fortran else values.reshape(shape)


def connected(count: int, a: NDArray[np.int64], b: NDArray[np.int64]) -> NDArray[np.int64]:
    """Which part of a graph each of its nodes (count,) is in, counted by their first nodes.

    Each node takes the lowest number among its neighbours' and its own, and then that which the
    node of this number has (Shiloach and Vishkin 1982), until none is lowered.

    Args:
        count: how many nodes there are.
        a, b: (n,) nodes that an edge joins.
    """
    lowest = np.arange(count)
    while True:
        new = lowest.copy()
        joined = np.minimum(lowest[a], lowest[b])
        for ends in (a, b):
            np.minimum.at(new, lowest[ends], joined)
        new = new[new]
        if np.array_equal(new, lowest):
            return np.unique(lowest, return_inverse=True)[1].astype(np.int64)
        lowest = new


def data_frame(columns: Mapping[str, np.ndarray]) -> "pandas.DataFrame":
    """Columns (N,) as a `pandas.DataFrame`; InputError where pandas is not installed."""
    try:
        import pandas
    except ImportError:
        raise InputError("a table needs pandas: pip install pandas") from None
    return pandas.DataFrame(dict(columns))
