"""What rosbags unpacks, bounded: a chunk of a few kilobytes can unpack to as many gigabytes.

rosbags takes whatever its decompressors give. While it reads they give no more than the sizes in
`chains.sizes` allow, and a database holds tables alone: a view can be made of rows without end.
"""

from __future__ import annotations

import bz2
import sqlite3
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from chains.errors import InputError
from chains.sizes import most


def check_database(path: Path) -> None:
    """Refuse a bag of SQLite that holds anything but tables of stored columns.

    Raises:
        InputError: it has a view, a trigger, a virtual table or a column that is calculated.
    """
    try:
        with closing(sqlite3.connect(f"{path.absolute().as_uri()}?immutable=1", uri=True)) as base:
            base.execute("PRAGMA trusted_schema = OFF")
            kinds = base.execute("SELECT type, name, sql FROM sqlite_master").fetchall()
            for kind, name, sql in kinds:
                virtual = str(sql or "").upper().split()[:2] == ["CREATE", "VIRTUAL"]
                if kind not in ("table", "index") or virtual or _calculated(base, kind, name):
                    raise InputError(
                        f"{path} is no bag as ROS writes it: {name} is calculated, not stored"
                    )
    except (sqlite3.Error, OverflowError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        why = " ".join(str(error).split())
        raise InputError(f"{path} cannot be read as a bag: {why}") from None


def _calculated(base: sqlite3.Connection, kind: str, name: str) -> bool:
    if kind != "table":
        return False
    rows = base.execute("SELECT hidden FROM pragma_table_xinfo(?)", (name,))
    return any(hidden for (hidden,) in rows)


def _unpacked(
    data: bytes, unpack: Callable[[bytes, int], bytes], done: Callable[[], bool]
) -> bytes:
    """Data unpacked; ValueError where it is more than it may be, or is not whole."""
    limit = most(len(data))
    plain = unpack(data, limit)
    if not done():
        what = "more than it may" if len(plain) >= limit else "cut short"
        raise ValueError(f"a chunk of {len(data)} bytes unpacks to {what}: {len(plain)} bytes")
    return plain


def unpack_bz2(data: bytes) -> bytes:
    """bzip2, bounded; ValueError where it is none, cut short or too long."""
    state = bz2.BZ2Decompressor()
    return _unpacked(data, state.decompress, lambda: state.eof)


def unpack_lz4(data: bytes) -> bytes:
    """Frames of LZ4, bounded; errors as of `unpack_bz2`."""
    from lz4.frame import LZ4FrameDecompressor

    state = LZ4FrameDecompressor()
    return _unpacked(data, state.decompress, lambda: state.eof)


def unpack_zstd(data: bytes) -> bytes:
    """Zstandard, bounded; errors as of `unpack_bz2`."""
    state = _library().ZstdDecompressor()
    return _unpacked(data, state.decompress, lambda: state.eof)


def _library() -> Any:
    try:
        from compression import zstd
    except ImportError:  # before Python 3.14
        from backports import zstd
    return zstd


@contextmanager
def open_zstd(file: Any, mode: str) -> Iterator[Any]:
    """A file as it is unpacked, that ends with an error where it becomes too long."""
    size = file.seek(0, 2)
    file.seek(0)
    with _library().open(file, mode) as plain:
        yield SimpleNamespace(read=_until(plain.read, most(size)))


def _until(read: Callable[[int], bytes], limit: int) -> Callable[[int], bytes]:
    given = [0]

    def bounded_read(size: int = -1) -> bytes:
        part = read(size if size >= 0 else limit + 1)
        given[0] += len(part)
        if given[0] > limit:
            raise ValueError(f"the file unpacks to more than {limit} bytes")
        return part

    return bounded_read


def databases(paths: Iterable[Path]) -> Iterator[Path]:
    """The databases among bags, and in their folders."""
    for path in paths:
        yield from sorted(path.glob("*.db3")) if path.is_dir() else [path]
