"""Parts of an output that are done, for the same command to go on from where it was killed.

What a stop adds to an output depends on that stop and on what was asked alone. Each is kept beside
the draft as it is done: under another name first, then renamed, with a digest of its bytes. The
folder's name is a digest of all that was asked, and of the program: a command that was asked
anything else finds nothing there, and removes it. `workshop` sweeps it when the output stands.
"""

from __future__ import annotations

import hashlib
import json
import logging
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from calib.outputs.moves import link
from calib.outputs.workshop import KEPT
from sensors.documents import plain, write_atomically

Finished = tuple[Any, bytes]  # what is told of a part, as JSON holds it, and what its file holds
_LOG = logging.getLogger("rigcal")


class KeptPart(NamedTuple):
    """A part that is done.

    Args:
        told: of it, as JSON holds it.
        file: what it is.
    """

    told: Any
    file: Path

    def put(self, target: Path) -> None:
        """Let it stand elsewhere as well."""
        target.parent.mkdir(parents=True, exist_ok=True)
        link(self.file, target)


class Kept:
    """Parts that are kept.

    Args:
        folder: where; of this command, asked for this.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self._asked = folder, 0

    def of(self, asked: Mapping[str, Any]) -> Kept:
        """What is kept of one of several things that a command does, asked for this."""
        return Kept(self.folder / _key(asked))

    def each(
        self,
        name: str,
        count: int,
        work: Callable[[Sequence[int]], Iterable[Finished]],
        progress: Callable[[int, int], None] = lambda done, total: None,
    ) -> Iterator[KeptPart]:
        """Parts ``0, 1, …`` in this order, of which one at a time is in memory.

        Args:
            name: of what they are of, for messages.
            count: how many.
            work: does those with these numbers, in their order.
            progress: called with how many are done, and of how many.
        """
        self._asked += 1  # the same each time, as commands ask in the same order
        files = [self.folder / f"{self._asked:03d}-{i:06d}" for i in range(count)]
        lacking = [i for i, file in enumerate(files) if not self._is_whole(file)]
        if len(lacking) < count:
            done = count - len(lacking)
            _LOG.info("%s: %d of %d were done before, and are used", name, done, count)
        fresh, missing = iter(work(lacking)), set(lacking)
        for i, file in enumerate(files):
            progress(i, count)
            if i in missing:
                self._keep(file, *next(fresh))
            yield KeptPart(self._told(file)["told"], file)

    def _keep(self, file: Path, told: Any, data: bytes) -> None:
        record = {"told": told, "sha256": hashlib.sha256(data).hexdigest()}
        for path, content in ((file, data), (_beside(file), json.dumps(record).encode())):
            with write_atomically(path) as temporary:
                temporary.write_bytes(content)

    def _told(self, file: Path) -> dict[str, Any]:
        return json.loads(_beside(file).read_bytes())

    def _is_whole(self, file: Path) -> bool:
        try:
            found = self._told(file)["sha256"]
            return found == hashlib.sha256(file.read_bytes()).hexdigest()
        except (OSError, ValueError, KeyError, TypeError):
            return False


def _beside(file: Path) -> Path:
    return file.with_name(f"{file.name}.json")


@cache
def _program() -> str:
    """A digest that changes with the program: names of its files, their sizes and times."""
    root, sha = Path(__file__).parents[2], hashlib.sha256()
    packages = (root / name for name in ("chains", "sensors", "calib"))
    for path in sorted(path for package in packages for path in package.rglob("*.py")):
        stat = path.stat()
        sha.update(f"{path.relative_to(root)}\0{stat.st_size}\0{stat.st_mtime_ns}\0".encode())
    return sha.hexdigest()


def _key(asked: Mapping[str, Any]) -> str:
    everything = json.dumps([plain(asked), _program()], sort_keys=True)
    return hashlib.sha256(everything.encode()).hexdigest()


def kept(draft: Path, asked: Mapping[str, Any]) -> Kept:
    """What a command that was asked the same had done before it was killed, and will have done.

    Args:
        draft: the folder to fill, as `calib.outputs.folder` or `entries` gave it.
        asked: all that the parts depend on, as JSON holds it.
    """
    here = draft.parent / KEPT / _key(asked)
    for other in here.parent.glob("*"):
        if other != here:
            shutil.rmtree(other, ignore_errors=True)
    return Kept(here)
