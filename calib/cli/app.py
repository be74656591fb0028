"""What every command shares: the app, its options, and how a result or progress is told."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer
import typer.core

Progress = Callable[[str, int, int], None]

# As people meet them; `rigcal --help` lists them so.
ORDER = (
    *("import", "simulate", "check", "fit", "diagnose", "add", "explain", "compare"),
    *("evaluate", "report", "view", "plot", "export", "apply", "effects"),
)


class _InOrder(typer.core.TyperGroup):
    def list_commands(self, ctx: Any) -> list[str]:
        return sorted(super().list_commands(ctx), key=ORDER.index)


app = typer.Typer(
    name="rigcal",
    cls=_InOrder,
    help="Calibrate a LiDAR rig as one factor graph.",
    add_completion=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)

Json = Annotated[bool, typer.Option("--json", help="Print the machine-readable result alone.")]
Out = Annotated[Path, typer.Option("-o", "--out", help="Where to write.")]
Runs = Annotated[list[Path], typer.Argument(metavar="RUN...", help="Run folders.")]


def say(document: dict[str, Any], text: str, as_json: bool) -> None:
    """Print a result: as JSON, or in words."""
    if as_json:
        print_json(document)
    else:
        print(text)


def print_json(document: Any) -> None:
    """Print a document as JSON."""
    from sensors.documents import json_text

    print(json_text(document))


@contextmanager
def progress_bar() -> Iterator[Progress]:
    """A progress bar on stderr where that is a terminal; else silence."""
    if not sys.stderr.isatty():
        yield lambda what, done, total: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("reading", total=None)
        yield lambda what, done, total: bar.update(
            task, description=what, completed=done + 1, total=total
        )
