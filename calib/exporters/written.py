"""What an exporter leaves behind: files, what they could not hold, and how every file begins."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from calib.runs.run import Run
from chains import escape
from chains.errors import InputError
from sensors.documents import write_atomically

LINE_WIDTH = 90
NO_PLACE_FOR_SIGMAS = "sigmas: this format has no place for them; extrinsics.yaml has"


@dataclass(frozen=True)
class Written:
    """The files of one format, and a sentence for each thing that they could not hold."""

    files: list[Path] = field(default_factory=list)
    not_held: list[str] = field(default_factory=list)


class Unheld(InputError):
    """A run has nothing that a format could hold; the message says why."""


def write_text(path: Path, text: str | bytes) -> None:
    """Write a text file, whole or not at all; bytes as they are, else UTF-8."""
    with write_atomically(path) as temporary:
        temporary.write_bytes(text if isinstance(text, bytes) else text.encode())


def warnings(run: Run) -> list[str]:
    """What stands above everything that is written of a run, in short lines."""
    return [line for sentence in run.before_use for line in textwrap.wrap(sentence, LINE_WIDTH)]


def head(run: Run, rig: str, conventions: Iterable[str], not_held: Iterable[str]) -> list[str]:
    """The lines that explain a rig's file to its reader, to be written as its comments."""
    version = run.model["versions"]["rigcal"]
    untold = "; ".join(entry["name"] for entry in run.solution.not_estimated)
    return [
        *warnings(run),
        f"Written by rigcal {version}, from the run {run.folder.resolve().name} of {rig}.",
        *conventions,
        *_listed("Not held here:", not_held),
        *_listed(
            "Not identifiable from the data alone (why: solution.yaml):",
            textwrap.wrap(untold, LINE_WIDTH),
        ),
    ]


def commented(lines: Iterable[str]) -> str:
    """Lines as comments of YAML, Python or CSV."""
    return "".join(f"# {escape.line(line)}\n" for line in lines)


def _listed(title: str, sentences: Iterable[str]) -> list[str]:
    lines = [f"  {sentence}" for sentence in sentences]
    return [title, *lines] if lines else []
