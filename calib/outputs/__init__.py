"""Where a command may write, and how: whole or not at all, whatever happens meanwhile.

Every command that writes does it through one of these: `folder`, `file`, `entries`, `remove`.
Each refuses what is not its own to write before any work is done, keeps other processes off, and
makes what it writes beside its place, into which it is moved when all went well. A command that is
killed leaves a whole old or a whole new one: see `workshop`, and `moves` for how. What it had done
of the new one by then is `kept`, where it comes in parts.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from calib.outputs.kinds import (
    CLOUDS,
    CLOUDS_MARK,
    EVALUATION,
    EXPORT,
    LADDER,
    RECORDING,
    RUN,
    SIMULATED,
    FolderKind,
    is_exported,
    refuse,
)
from calib.outputs.moves import BESIDE, ENTRIES, WHOLE, link
from calib.outputs.parts import Finished, Kept, KeptPart, kept
from calib.outputs.workshop import settle, workshop
from chains import remote

__all__ = [
    "CLOUDS",
    "CLOUDS_MARK",
    "EVALUATION",
    "EXPORT",
    "LADDER",
    "RECORDING",
    "RUN",
    "SIMULATED",
    "Finished",
    "FolderKind",
    "Kept",
    "KeptPart",
    "Paths",
    "each",
    "entries",
    "file",
    "folder",
    "is_exported",
    "kept",
    "refuse",
    "remove",
    "settle",
]

Inputs = Iterable[Path | str]
Paths = Path | str | Iterable[Path | str]


def each(paths: Paths) -> list[Path]:
    """One path, or several, in a list; a URL as the folder here that stands for it."""
    several = [paths] if isinstance(paths, Path | str) else paths
    return [remote.here(path, anew=True) for path in several]


@contextmanager
def folder(
    path: Path | str, kind: FolderKind, inputs: Inputs = (), beside: Iterable[str] = ()
) -> Iterator[Path]:
    """Give an empty folder to fill, which becomes `path` when all went well.

    A folder already there is replaced if it is empty or of that kind; what somebody else has put
    into it stays (see `FolderKind.parts`).

    Args:
        path: the folder to make.
        kind: what it will be.
        inputs: files and folders that are read meanwhile.
        beside: names of files in it that are to stand beside it, as ``<path>.<name>``.

    Raises:
        InputError: it is not to be written (see `refuse`), another process is writing it, or the
            machine refuses: no room, no right.
    """
    with workshop(refuse(path, kind, inputs)) as shop:
        shop.draft.mkdir()
        yield shop.draft
        for name in beside:
            (shop.work / BESIDE).mkdir(exist_ok=True)
            os.replace(shop.draft / name, shop.work / BESIDE / f"{shop.path.name}.{name}")
        refuse(path, kind)  # it may have become something else meanwhile
        if not shop.path.is_dir():
            os.replace(shop.draft, shop.work / WHOLE)
            shop.commit()
        elif _is_fixed(shop.path):
            os.replace(shop.draft, shop.work / ENTRIES)
            new = {entry.name for entry in (shop.work / ENTRIES).iterdir()}
            old = (entry.name for entry in shop.path.iterdir())
            shop.commit([name for name in old if kind.holds(name) and name not in new])
        else:
            _take_over(shop.path, shop.draft, kind)
            os.replace(shop.draft, shop.work / WHOLE)
            shop.commit()


@contextmanager
def file(path: Path | str, inputs: Inputs = ()) -> Iterator[Path]:
    """Give a path to write a file to, which becomes `path` when all went well; as `folder`."""
    with workshop(refuse(path, None, inputs)) as shop:
        shop.draft.mkdir()
        draft = shop.draft / Path(path).name
        yield draft
        refuse(path, None)
        os.replace(draft, shop.work / WHOLE)
        shop.commit()


@contextmanager
def entries(path: Path | str, kind: FolderKind, inputs: Inputs = ()) -> Iterator[Path]:
    """Give an empty folder; what is in it at the end goes into `path`, all of it or nothing.

    Args:
        path: a folder of that kind, or one that is yet to be made.
        kind: what it is.
        inputs: as of `folder`.

    Raises:
        InputError: as `folder`.
    """
    with workshop(refuse(path, kind, inputs, anywhere=True)) as shop:
        shop.draft.mkdir()
        yield shop.draft
        refuse(path, kind, anywhere=True)
        if any(shop.draft.iterdir()):
            os.replace(shop.draft, shop.work / (ENTRIES if shop.path.is_dir() else WHOLE))
            shop.commit()


def remove(path: Path | str) -> None:
    """Remove a folder: it is there, whole, or it is gone."""
    with workshop(Path(path).resolve()) as shop:
        os.replace(shop.path, shop.draft)


def _is_fixed(path: Path) -> bool:
    """Whether a folder must stay the one that it is, and only what lies in it can be replaced: a
    mounted disk cannot be moved, and a shell that stands in a folder would stand in a removed one.
    """
    try:
        return path.is_mount() or path.samefile(os.curdir)
    except FileNotFoundError:  # the shell's folder is gone
        return False


def _take_over(old: Path, new: Path, kind: FolderKind) -> None:
    """Give a new folder what the old one has beyond its kind's parts, and who may read it."""
    shutil.copymode(old, new)
    for entry in old.iterdir():
        target = new / entry.name
        if kind.holds(entry.name) or os.path.lexists(target):
            continue
        if entry.is_dir() and not entry.is_symlink():
            shutil.copytree(entry, target, symlinks=True, copy_function=link)
        else:
            link(entry, target)
