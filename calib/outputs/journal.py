"""What long computations found on their way, for the same one to go on from where it was killed.

The same input leads the same way: a computation that is begun again asks the same questions in the
same order. Each answer, some small arrays, is kept under its number as it is found, and with a
digest of what was asked; one that is known is read and not computed.
"""

from __future__ import annotations

import hashlib
import logging
import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path

import numpy as np

from calib.outputs.parts import Kept
from sensors.documents import write_atomically

Answer = dict[str, np.ndarray]
_LOG = logging.getLogger("rigcal")
_ASKED, _OF = "asked", "of "  # names in a file: the digest, and what stands before all others


class Book:
    """The journals of one command.

    Args:
        folder: where they are.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self.begun, self.used = folder, 0, 0


_BOOK: ContextVar[Book | None] = ContextVar("book", default=None)


@contextmanager
def going_on(kept: Kept) -> Iterator[None]:
    """Keep within what computations find, and use what they had found before."""
    token = _BOOK.set(book := Book(kept.folder))
    try:
        yield
    finally:
        _BOOK.reset(token)
        if book.used:
            _LOG.info("%d answers of passes over all stops were known before, and used", book.used)


class Journal:
    """The answers of one computation; of none where nobody keeps them."""

    def __init__(self) -> None:
        self._book, self._number, self._count = _BOOK.get(), 0, 0
        if self._book is not None:
            self._book.begun += 1
            self._number = self._book.begun

    def answer(self, asked: Mapping[str, object], compute: Callable[[], Answer]) -> Answer:
        """What is known of a question, or else what is computed.

        Args:
            asked: arrays and numbers that the answer depends on, beside what was asked before.
            compute: finds it.
        """
        if self._book is None:
            return compute()
        self._count += 1
        file = self._book.folder / f"found-{self._number:03d}-{self._count:06d}.npz"
        digest = _digest(asked)
        if (found := _read(file, digest)) is not None:
            self._book.used += 1
            return found
        found = compute()
        with write_atomically(file) as temporary:
            named = {f"{_OF}{name}": x for name, x in found.items()}
            np.savez(temporary, **{_ASKED: np.array(digest)}, **named)
        return found


def _read(file: Path, digest: str) -> Answer | None:
    """The answer in a file, where it is whole and of that question."""
    try:
        with np.load(file, allow_pickle=False) as arrays:
            if str(arrays[_ASKED]) != digest:
                return None
            names = [name for name in arrays.files if name != _ASKED]
            return {name.removeprefix(_OF): arrays[name] for name in names}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None


def _digest(asked: Mapping[str, object]) -> str:
    sha = hashlib.sha256()
    for name, value in asked.items():
        array = np.ascontiguousarray(value)
        sha.update(f"{name}\0{array.dtype.str}{array.shape}\0".encode())
        sha.update(array.tobytes())
    return sha.hexdigest()
