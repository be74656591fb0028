"""What takes long to make is made once in a session, and each who asks for it gets a copy."""

from __future__ import annotations

import fcntl
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path

from .programs import ROOT

SOURCES = ("chains", "sensors", "calib", "examples", "tests")
NAMES_FOLDERS = (".yaml", ".json")  # a run names its recordings and the run that it grew from


@dataclass(frozen=True)
class Once:
    """Makes folders, or copies of what was made before.

    Args:
        store: where the first of each is kept; all of a session's workers share it.
        place: makes an empty folder of about that name, for a copy.
    """

    store: Path
    place: Callable[[str], Path]

    def __call__(self, make: Callable[..., object], *what: object) -> Path:
        """A folder as `make(folder, *what)` fills it, which the caller may change.

        The key holds what it is made of and the text of every source: a changed program makes anew.
        """
        said = f"{make.__module__} {make.__qualname__} {what} {program()}"
        kept = self.store / sha256(said.encode()).hexdigest()[:16]
        done = kept.with_suffix(".done")
        self.store.mkdir(exist_ok=True)
        with kept.with_suffix(".lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not done.exists():
                shutil.rmtree(kept, ignore_errors=True)
                kept.mkdir()
                make(kept, *what)
                done.touch()
        folder = shutil.copytree(kept, self.place(make.__name__), dirs_exist_ok=True)
        for path in folder.rglob("*"):
            if path.suffix in NAMES_FOLDERS:
                text = path.read_text("utf-8").replace(str(kept), str(folder))
                path.write_text(text, "utf-8")
        return folder


def program() -> str:
    """A digest of every source file."""
    files = sorted(path for name in SOURCES for path in (ROOT / name).rglob("*.*"))
    texts = (path.read_bytes() for path in files if path.suffix in (".py", ".yaml"))
    return sha256(b"\0".join(texts)).hexdigest()
