"""What long computations found on their way, for the same one to go on from where it was killed.

The same input leads the same way: a computation that is begun again asks the same questions in the
same order. Each answer, some small arrays, is kept under its number as it is found, and with a
digest of what was asked; one that is known is read and not computed. Where each stop adds much to
an answer, each stop's share is kept (`Journal.each`).
"""

from __future__ import annotations

import hashlib
import io
import logging
import pickle
import shutil
import time
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path
from typing import Any

import numpy as np

from calib.outputs.parts import Kept
from calib.outputs.workshop import bytes_in
from chains.errors import InputError
from sensors.documents import write_atomically

Answer = dict[str, np.ndarray]
_LOG = logging.getLogger("rigcal")
_ASKED, _OF = "asked", "of "  # names in a file: the digest, and what stands before all others
# At most so much of the time of a pass is spent on keeping what stops add, and it may fill so much
# of the disk's free room: choices. The sums of a stop of 131,072 beams in a diagnosis, 9 MB, take
# two cores 0.7 s; those of 1,024 beams, 6 MB, are as soon computed again.
_SHARE_OF_TIME, _SHARE_OF_DISK = 0.1, 0.1
_DIGEST_BYTES = hashlib.sha256().digest_size
_OF_NUMPY = {"_reconstruct", "_frombuffer", "scalar", "ndarray", "dtype"}


class Book:
    """The journals of one command.

    Args:
        folder: where they are.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self.begun, self.used, self.stops_used = folder, 0, 0, 0
        self.room = _room(folder.parent)  # bytes that what stops add may take yet


def _room(folder: Path) -> float:
    """Bytes that what is kept in a folder, this and all that it was asked before, may take yet."""
    kept = bytes_in(folder)
    there = next(path for path in (folder, *folder.parents) if path.exists())
    try:
        return _SHARE_OF_DISK * (shutil.disk_usage(there).free + kept) - kept
    except OSError:
        return 0.0


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
        if book.stops_used:
            _LOG.info("%d sums of stops were known before, and used", book.stops_used)


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
        token = _BOOK.set(None)  # what is asked on the way to an answer is not asked again
        try:
            found = compute()
        finally:
            _BOOK.reset(token)
        with suppress(OSError, InputError), write_atomically(file) as temporary:  # or without it
            named = {f"{_OF}{name}": x for name, x in found.items()}
            np.savez(temporary, **{_ASKED: np.array(digest)}, **named)
        return found

    def each(
        self,
        asked: Mapping[str, object],
        stops: Sequence[str],
        compute: Callable[[Sequence[int]], Iterable[Any]],
        kinds: Sequence[type],
    ) -> Iterator[Any]:
        """What stops add to one answer, in their order: as known, or else as computed.

        Args:
            asked: as of `answer`.
            stops: their names.
            compute: what those with these numbers add, in their order.
            kinds: classes of which that is made, beside arrays and numbers.
        """
        if self._book is None:
            yield from compute(range(len(stops)))
            return
        self._count += 1
        kept = _Shares(self._book, f"{self._number:03d}-{self._count:06d}", _digest(asked), kinds)
        lacking = [i for i, stop in enumerate(stops) if not kept.has(stop)]
        fresh, missing = iter(compute(lacking)), set(lacking)
        for i, stop in enumerate(stops):
            if i not in missing and (found := kept.read(stop)) is not None:
                self._book.stops_used += 1
                yield found
                continue
            found = next(fresh) if i in missing else next(iter(compute([i])))
            kept.write(stop, found)
            yield found


class _Shares:
    """What stops add to one answer, a file of each.

    Args:
        book: where it is kept.
        number: of the answer.
        asked: digest of the question.
        kinds: as of `Journal.each`.
    """

    def __init__(self, book: Book, number: str, asked: str, kinds: Sequence[type]) -> None:
        self.book, self.asked, self.kinds = book, asked, kinds
        self.folder = book.folder / f"found-{number}-{asked[:16]}"
        self.begun, self.spent_s, self.last = time.monotonic(), 0.0, 0

    def has(self, stop: str) -> bool:
        """Whether there is a file."""
        return self._file(stop).exists()

    def read(self, stop: str) -> Any:
        """What a stop adds; None where its file is not whole, or of another question."""
        try:
            data = self._file(stop).read_bytes()
            digest, body = data[:_DIGEST_BYTES], memoryview(data)[_DIGEST_BYTES:]
            return _Plain(body, self.kinds).load() if digest == self._sealed(stop, body) else None
        except (OSError, EOFError, pickle.UnpicklingError):
            return None

    def write(self, stop: str, found: Any) -> None:
        """Keep what a stop adds, if there is time and room for it."""
        begun = time.monotonic()
        if self.spent_s >= _SHARE_OF_TIME * (begun - self.begun) or self.last > self.book.room:
            return
        body = pickle.dumps(found, pickle.HIGHEST_PROTOCOL)
        self.last = len(body)
        if self.last <= self.book.room:
            try:
                with write_atomically(self._file(stop)) as temporary:
                    temporary.write_bytes(self._sealed(stop, body) + body)
                self.book.room -= self.last
            except (OSError, InputError):  # the disk is full, say, and all goes on without
                self.book.room = 0.0
        self.spent_s += time.monotonic() - begun

    def _file(self, stop: str) -> Path:
        return self.folder / hashlib.sha256(stop.encode()).hexdigest()[:16]

    def _sealed(self, stop: str, body: bytes | memoryview) -> bytes:
        """Digest of a question, a stop and what it adds."""
        sha = hashlib.sha256(f"{self.asked}\0{stop}\0".encode())
        sha.update(body)
        return sha.digest()


class _Plain(pickle.Unpickler):
    """Opens what is made of arrays, numbers and a few classes, and nothing else."""

    def __init__(self, data: memoryview, kinds: Sequence[type]) -> None:
        super().__init__(io.BytesIO(data))
        self.kinds = {(kind.__module__, kind.__qualname__): kind for kind in kinds}

    def find_class(self, module: str, name: str) -> Any:
        if module.partition(".")[0] == "numpy" and name in _OF_NUMPY:
            return super().find_class(module, name)
        if (module, name) in self.kinds:
            return self.kinds[module, name]
        raise pickle.UnpicklingError(f"{module}.{name} is no part of what a stop adds")


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
