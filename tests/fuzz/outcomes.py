"""What comes of a file that nobody wrote, damaged or made to do harm, and what must never.

Of any of them a reader gives a result, or one sentence that names the file; never another
exception, a crash, a process that does not end, or memory without end.
"""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from .zygote import ROOT

MOST_MB = 700  # more than the interpreter with all libraries has; the samples take up to 90
MOST_S = 10  # on the processor; the largest real sample takes 2


@dataclass(frozen=True)
class Sample:
    """A file to be read, or to be damaged first.

    Args:
        kind: of an import, or of `zygote.TASKS`.
        path: the file.
        options: of the import.
        beside: the files that are read with it.
    """

    kind: str
    path: Path
    options: dict[str, Any] = field(default_factory=dict)
    beside: tuple[Path, ...] = ()


@dataclass(frozen=True)
class Outcome:
    """What came of a sample, how much memory it took (MB) and how much of the processor (s)."""

    outcome: str
    said: str
    mb: float
    seconds: float

    def fault(self, path: Path) -> str:
        """What is wrong with it; empty where it is a result, or a sentence that names the file."""
        if self.outcome in ("raised", "killed"):
            return f"{self.outcome}: {self.said}"
        if self.mb > MOST_MB:
            return f"took {self.mb:.0f} MB"
        named = (path.name, path.stem, f"{path.parent.name}:")  # a run by its folder
        if self.outcome == "refused" and not any(name in self.said for name in named):
            return f"the sentence does not name the file: {self.said}"
        if "\n" in self.said:
            return f"more than one line: {self.said}"
        return ""


class Zygote:
    """The process, to be asked."""

    def __init__(self, process: subprocess.Popen) -> None:
        self._process = process

    def read(self, sample: Sample, seconds: int = MOST_S) -> Outcome:
        """What comes of reading a sample."""
        task = {
            "kind": sample.kind,
            "files": [str(sample.path), *map(str, sample.beside)],
            "options": sample.options,
            "mb": MOST_MB,
            "seconds": seconds,
        }
        self._process.stdin.write(json.dumps(task) + "\n")
        self._process.stdin.flush()
        return Outcome(**json.loads(self._process.stdout.readline()))


@contextmanager
def zygote() -> Iterator[Zygote]:
    """A zygote while the tests of a module run."""
    environment = os.environ | {
        "OPENBLAS_NUM_THREADS": "1",
        "OMP_NUM_THREADS": "1",
        "MALLOC_ARENA_MAX": "1",
        "ARROW_DEFAULT_MEMORY_POOL": "system",
    }
    with subprocess.Popen(
        [sys.executable, Path(__file__).with_name("zygote.py")],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        cwd=ROOT,
        env=environment,
        text=True,
    ) as process:
        yield Zygote(process)
        process.stdin.close()
