"""Renames that are taken as one: what was decided is written down first, so that a command that
was killed amid them is carried on by the next.

A folder is exchanged for another by Linux's ``renameat2(RENAME_EXCHANGE)``: one step of the kernel,
so nobody ever finds neither. Where the system has none, the old one is put aside first; then, for a
moment, only the record knows the new one, and the next command puts it in its place.
"""

from __future__ import annotations

import errno
import os
import shutil
import sys
from collections.abc import Callable, Mapping
from pathlib import Path

_AT_FDCWD, _RENAME_EXCHANGE = -100, 2  # linux/fcntl.h, linux/fs.h
_NOT_THERE = {errno.ENOSYS, errno.EINVAL, errno.ENOTSUP}
WHOLE, ENTRIES, BESIDE = "whole", "entries", "beside"
Inodes = Mapping[str, int]


def target_of(staged: str, path: Path) -> Path | None:
    """Where something staged goes; None where it may go nowhere, so that a record of somebody
    else's cannot reach other files.

    Args:
        staged: ``whole``, which becomes `path`; ``entries/NAME``, which goes into it; or
            ``beside/NAME``, beside it, where its name begins with that of `path` and a dot.
        path: what is written.
    """
    first, _, name = staged.partition("/")
    if "/" in name or name in (".", ".."):
        return None
    if first == WHOLE and not name:
        return path
    if first == ENTRIES and name:
        return path / name
    if first == BESIDE and name.startswith(f"{path.name}."):
        return path.with_name(name)
    return None


def carry_out(work: Path, path: Path, inodes: Inodes, dropped: list[str]) -> None:
    """Move what is staged to its place, or leave all as it was.

    Args:
        work: the folder that holds what is staged; what was there before ends up in it.
        path: what is written.
        inodes: of all that is staged, by its name in `work`.
        dropped: names of entries of `path` that go.

    Raises:
        OSError: one cannot be moved, and all are where they were.
    """
    undo: list[Callable[[], None]] = []
    aside = work / "aside"
    aside.mkdir(exist_ok=True)
    try:
        for name in dropped:
            if os.path.lexists(path / name):
                undo.append(_move(path / name, aside / name, aside))
        for staged, inode in inodes.items():
            target = target_of(staged, path)
            if target is not None and not stands(target, inode) and os.path.lexists(work / staged):
                undo.append(_move(work / staged, target, aside))
    except OSError:
        for back in reversed(undo):
            back()
        raise


def stands(target: Path, inode: int) -> bool:
    """Whether a path is the file or folder of that number."""
    try:
        return target.lstat().st_ino == inode
    except OSError:
        return False


def _move(source: Path, target: Path, aside: Path) -> Callable[[], None]:
    """Move to `target` what may replace something there; how to undo it."""
    if not os.path.lexists(target):
        os.replace(source, target)
        return lambda: os.replace(target, source)
    if exchange(source, target):
        return lambda: exchange(source, target)
    kept = aside / f"{target.name}.old"
    try:
        os.link(target, kept)  # so that a file, which can be written over, is never gone
    except OSError:
        os.replace(target, kept)
    os.replace(source, target)

    def back() -> None:
        os.replace(target, source)
        os.replace(kept, target)

    return back


def exchange(one: Path, other: Path) -> bool:
    """Exchange two files or folders in one step; False where the system cannot.

    Raises:
        OSError: it can, and does not: they lie on two disks, say, or may not be moved.
    """
    import ctypes

    call = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None) if os.name == "posix" \
        else None  # fmt: skip
    if call is None:
        return False
    sys.audit("os.rename", str(one), str(other), -1, -1)  # as os.rename has it
    if call(_AT_FDCWD, os.fsencode(one), _AT_FDCWD, os.fsencode(other), _RENAME_EXCHANGE) == 0:
        return True
    code = ctypes.get_errno()
    if code in _NOT_THERE:
        return False
    raise OSError(code, os.strerror(code), str(other))


def link(source: Path | str, target: Path | str) -> None:
    """The same file under another name; a copy where the disk cannot."""
    try:
        os.link(source, target, follow_symlinks=False)
    except OSError:
        shutil.copy2(source, target, follow_symlinks=False)
