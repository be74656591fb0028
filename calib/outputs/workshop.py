"""The place beside an output in which it is made: ``.NAME.rigcal``, one process's at a time.

It holds a lock, which the system lets go when its process ends, however that is; so what lies in
one that is not locked was left by a command that was killed, and whoever comes next carries on
what was decided, or sweeps it away.
"""

from __future__ import annotations

import errno
import json
import logging
import os
import re
import shutil
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from calib.outputs.moves import BESIDE, ENTRIES, WHOLE, carry_out, stands, target_of
from chains.errors import CutShortError, InputError

try:
    import fcntl
except ImportError:  # Windows: nothing is locked there
    fcntl = None  # type: ignore[assignment]

DRAFT, LOCK = "draft", "lock"
TO_GO_ON = "for the same command to go on from"
KEPT = "kept"  # parts that are done, which outlive the draft of a command that was killed
_OURS = (DRAFT, WHOLE, ENTRIES, BESIDE, "aside")  # nothing else in a workshop is ever touched
_ATTEMPTS = 100  # a workshop may be taken away while it is entered, by the one who leaves
_LOG = logging.getLogger("rigcal")
# What the machine, and no fault of the program, may answer.
_MACHINE = {
    errno.EACCES, errno.EBUSY, errno.EDQUOT, errno.EEXIST, errno.EFBIG, errno.EIO, errno.EISDIR,
    errno.ELOOP, errno.EMFILE, errno.ENAMETOOLONG, errno.ENOENT, errno.ENOSPC, errno.ENOTDIR,
    errno.ENOTEMPTY, errno.EPERM, errno.EROFS, errno.ESTALE, errno.EXDEV, None,
}  # fmt: skip


@dataclass(frozen=True)
class Workshop:
    """A workshop that is this process's own.

    Args:
        path: what is written, links and ``..`` followed.
        work: the folder.
        lock: descriptor of its lock, which holds a record of what was decided, too.
    """

    path: Path
    work: Path
    lock: int

    @property
    def draft(self) -> Path:
        """The folder in which to write."""
        return self.work / DRAFT

    def commit(self, dropped: list[str] | None = None) -> None:
        """Move all that is staged to its place: all of it, or nothing.

        Raises:
            OSError: something cannot be moved.
        """
        inodes = {staged: (self.work / staged).lstat().st_ino for staged in self._staged()}
        self._record(inodes, dropped or [])
        try:
            carry_out(self.work, self.path, inodes, dropped or [])
        except OSError:
            self._record({}, [])
            raise

    def _staged(self) -> list[str]:
        names = [WHOLE] if os.path.lexists(self.work / WHOLE) else []
        for folder in (ENTRIES, BESIDE):
            inner = sorted((self.work / folder).glob("*"), key=lambda path: path.is_file())
            names += [f"{folder}/{path.name}" for path in inner]
        return names

    def _record(self, inodes: dict[str, int], dropped: list[str]) -> None:
        """Write down what is decided; a record that is cut off decides nothing."""
        text = json.dumps({"process": os.getpid(), "inodes": inodes, "dropped": dropped})
        os.ftruncate(self.lock, 0)
        os.pwrite(self.lock, text.encode(), 0)


@contextmanager
def workshop(path: Path) -> Iterator[Workshop]:
    """A workshop for `path`, which `kinds.refuse` has let through, and nothing left in it after.

    Raises:
        InputError: another process is writing there, or the machine does not let us.
    """
    work = _work_of(path)
    made = [above for above in work.parents if not above.exists()]
    with in_sentences(path, work):
        lock = _locked(work, path)
        shop = Workshop(path, work, lock)
        try:
            _settle(shop)
            shop._record({}, [])
            yield shop
            _remove(work / KEPT)
        except Exception as error:  # and not Ctrl-C: as after a kill, it may be asked for again
            if not isinstance(error, CutShortError | MemoryError):
                _remove(work / KEPT)
            raise
        finally:
            if os.path.lexists(work / KEPT):
                said = "%s: what was done of it is kept, %s (%.0f MB in %s)"
                _LOG.warning(said, path, TO_GO_ON, bytes_in(work / KEPT) / 1e6, work.name)
            _leave(work, lock)
            for above in made:
                with suppress(OSError):
                    above.rmdir()


def settle(path: Path | str) -> None:
    """Finish what a killed command left of a file or folder that is now to be read.

    What a living process is writing is left alone; and so is what may not be touched.
    """
    path = Path(path).resolve()
    work = _work_of(path)
    if not work.is_dir() or work.is_symlink():
        return
    try:
        lock = _locked(work, path)
    except (OSError, InputError):
        return
    try:
        with in_sentences(path, work):
            _settle(Workshop(path, work, lock))
    finally:
        _leave(work, lock)


def _work_of(path: Path) -> Path:
    return path.with_name(f".{path.name}.rigcal")


def _locked(work: Path, path: Path) -> int:
    """Enter a workshop: descriptor of its lock."""
    for _ in range(_ATTEMPTS):
        with suppress(FileNotFoundError):  # taken away by the one who has just left
            work.mkdir(parents=True, exist_ok=True)
            if work.is_symlink():
                raise InputError(f"{work} is a link, which no command of rigcal made; remove it")
            flags = os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0)
            lock = os.open(work / LOCK, flags, 0o666)
            if not stat.S_ISREG(os.fstat(lock).st_mode):
                os.close(lock)
                raise InputError(f"{work / LOCK} is no file of rigcal's; remove {work}")
            if _lock(lock) and stands(work / LOCK, os.fstat(lock).st_ino):
                return lock
            process = _read(lock)[0]
            busy = stands(work / LOCK, os.fstat(lock).st_ino)
            os.close(lock)
            if busy:
                who = f"process {process}" if process else "another process"
                raise InputError(
                    f"{path} is being written by {who}; wait for it, or give another -o"
                )
    if not work.exists():
        raise InputError(f"{path} cannot be made: no folder can be made in {work.parent}")
    raise InputError(f"{path} is being written by other processes; try again")


def _lock(descriptor: int) -> bool:
    """Whether a file could be locked; where a disk knows no locks, all go ahead."""
    try:
        if fcntl is not None:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:
        if error.errno not in (errno.ENOLCK, errno.ENOTSUP, errno.EINVAL, errno.ENOSYS):
            raise
    return True


def _leave(work: Path, lock: int) -> None:
    """Take a workshop away, its lock last, so that nobody enters before it is empty."""
    try:
        left = [name for name in _OURS if os.path.lexists(work / name)]
        for name in left:
            _remove(work / name)
        if any(os.path.lexists(work / name) for name in left):
            _LOG.warning("%s could not be removed; it is of no use any more", work)
            return
        with suppress(OSError):
            os.unlink(work / LOCK)
            os.rmdir(work)
    finally:
        os.close(lock)


def bytes_in(folder: Path) -> int:
    """How much the files in a folder take; those that vanish meanwhile take nothing."""
    total = 0
    for path in folder.rglob("*"):
        with suppress(OSError):
            total += path.lstat().st_size if path.is_file() else 0
    return total


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with suppress(OSError):
            path.unlink()


def _read(lock: int) -> tuple[int | None, dict[str, int], list[str]]:
    """The record: which process wrote it, and what was decided; nothing where it was cut off."""
    try:
        record = json.loads(os.pread(lock, 1 << 20, 0))
        inodes = {str(name): int(inode) for name, inode in record["inodes"].items()}
        names = [str(name) for name in record["dropped"]]
        dropped = [n for n in names if target_of(f"{ENTRIES}/{n}", Path(LOCK)) is not None]
        return int(record["process"]), inodes, dropped
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return None, {}, []


def _settle(shop: Workshop) -> None:
    """Carry on what a killed command had decided, sweep what it left, and say what stands."""
    path, work = shop.path, shop.work
    if not any(os.path.lexists(work / name) for name in _OURS):
        return
    _, inodes, dropped = _read(shop.lock)
    if inodes:
        carry_out(work, path, inodes, dropped)
        _remove(work / KEPT)
        stand = "the new one stands, whole"
    elif os.path.lexists(path):
        stand = "the earlier one stands, whole"
    else:
        stand = "none stands yet" if os.path.lexists(work / KEPT) else "nothing of it was kept"
    if os.path.lexists(work / KEPT):
        stand += f", and what it had done is kept, {TO_GO_ON}"
    shop._record({}, [])
    for name in _OURS:
        _remove(work / name)
    _LOG.warning("%s: a command that wrote it was cut short; %s", path, stand)


@contextmanager
def in_sentences(path: Path | str, work: Path) -> Iterator[None]:
    """What the machine refuses while something is made, as an InputError that says what and where.

    Args:
        path: what is written.
        work: its workshop, of which nobody needs to know.
    """
    try:
        yield
    except OSError as error:
        if error.errno not in _MACHINE:
            raise
        raise InputError(_sentence(error, Path(path), work)) from error


def _sentence(error: OSError, path: Path, work: Path) -> str:
    if isinstance(error, shutil.Error):  # of a whole folder: all that went wrong, as text
        name, _, text = error.args[0][0]
        found = re.search(r"\[Errno (\d+)\]", text)
        error = OSError(int(found[1]) if found else None, text, name)
    why = os.strerror(error.errno) if error.errno else str(error).splitlines()[0]
    name = os.fsdecode(error.filename) if isinstance(error.filename, str | bytes) else ""
    inside = str(Path(os.path.abspath(name))).startswith(str(work)) if name else True
    if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        return f"{path} cannot be written: {why}; nothing was changed, make room and try again"
    if inside or Path(name) in (path, *path.parents):
        return f"{path} cannot be written ({why}); nothing was changed, give another -o"
    return f"{name}: {why}; {path} was not written"
