"""What every command shares: the app, its options, and how a result or progress is shown."""

from __future__ import annotations

import importlib.metadata
import io
import logging
import re
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stdout
from dataclasses import MISSING, fields
from inspect import Parameter, Signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TextIO, TypeVar, get_type_hints

import typer
import typer.core

from chains.escape import terminal

if TYPE_CHECKING:
    from calib.runs.run import Run

NOT_TO_BE_USED = 3  # exit code: done, but not to be used as it stands
Progress = Callable[[str, int, int], None]
T = TypeVar("T")

# As people meet them; `rigcal --help` lists them so.
ORDER = (
    *("import", "simulate", "check", "fit", "diagnose", "plan", "add", "explain"),
    *("compare", "moved", "reproduce", "evaluate", "report", "view", "plot", "export", "apply"),
    "effects",
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

# Results go there; -q takes everything else that is printed away from it.
_stdout: TextIO | None = None
_verbose = False
_pressed = False


def _print_version(asked: bool) -> None:
    """Print the version that is installed, as pyproject.toml has it, and end."""
    if asked:
        print(f"rigcal {importlib.metadata.version('rigcal')}")
        raise typer.Exit


@app.callback()
def manners(
    context: typer.Context,
    verbose: Annotated[
        bool, typer.Option("-v", "--verbose", help="Show every step on stderr, and all reasons.")
    ] = False,
    quiet: Annotated[
        bool, typer.Option("-q", "--quiet", help="Print errors and the result of --json only.")
    ] = False,
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Print the version."
        ),
    ] = False,
) -> None:
    """Take down what is said of how much is to be said."""
    global _stdout, _verbose
    _stdout, _verbose = sys.stdout, verbose
    logging.getLogger("rigcal").setLevel(logging.INFO if verbose else logging.WARNING)
    if quiet:
        context.with_resource(redirect_stdout(io.StringIO()))


def verbose() -> bool:
    """Whether everything is to be said."""
    return _verbose


def effect_names(incomplete: str) -> list[str]:
    """Names of the catalogue that begin so, for a shell to complete.

    They are read from the text of its files: importing them takes longer than a key may.
    """
    files = (Path(__file__).parents[1] / "effects").glob("*.py")
    texts = (file.read_text(encoding="utf-8") for file in sorted(files))
    names = (name for text in texts for name in re.findall(r'^    name = "(\w+)"$', text, re.M))
    return [name for name in names if name.startswith(incomplete)]


Json = Annotated[bool, typer.Option("--json", help="Print the machine-readable result alone.")]
Out = Annotated[Path, typer.Option("-o", "--out", help="Where to write.")]
Force = Annotated[bool, typer.Option("--force", help="Accept a run that has not converged.")]
Runs = Annotated[list[Path], typer.Argument(metavar="RUN...", help="Run folders.")]
Trust = Annotated[
    list[str] | None,
    typer.Option(
        "--trust",
        metavar="FILE_OR_HASH",
        help="A Python file of effects, named by the input, that may run; or its sha256.",
    ),
]
Workers = Annotated[
    int | None,
    typer.Option(
        min=1,
        metavar="N",
        help="Processes that share the stops; if not given, threads on all cores.",
        show_default=False,
    ),
]
Scheduler = Annotated[
    str | None,
    typer.Option(metavar="ADDRESS", help="A Dask cluster whose workers share them instead."),
]


def takes_fields_of(asked: type[T]) -> Callable[[Callable[[T], None]], Callable[..., None]]:
    """A command whose arguments and options are the fields of a dataclass, of which it gets one."""
    hints = get_type_hints(asked, include_extras=True)
    signature = Signature(
        Parameter(
            field.name,
            Parameter.KEYWORD_ONLY,
            default=Parameter.empty if field.default is MISSING else field.default,
            annotation=hints[field.name],
        )
        for field in fields(asked)
    )

    def of_fields(command: Callable[[T], None]) -> Callable[..., None]:
        def run(**given: Any) -> None:
            command(asked(**given))

        run.__name__, run.__doc__, run.__signature__ = command.__name__, command.__doc__, signature
        return run

    return of_fields


def say(document: dict[str, Any], text: str, as_json: bool) -> None:
    """Print a result: as JSON, or in words."""
    if as_json:
        print_json(document)
    else:
        print(terminal(text))


def warn(runs: Sequence[Run], as_json: bool) -> None:
    """Print what is to stand above everything that is shown of runs; on stderr where stdout is for
    the machine-readable result alone."""
    for run in runs:
        for sentence in run.warning:
            said = f"{run.folder}: {sentence}" if len(runs) > 1 else sentence
            print(terminal(said), file=sys.stderr if as_json else sys.stdout)


def end_unless_converged(*runs: Run) -> None:
    """End with exit code 3, and a sentence on stderr for each, where runs have not converged."""
    loose = [run for run in runs if not run.converged]
    for run in loose:
        print(terminal(f"rigcal: {run.folder}: {run.warning[0]}"), file=sys.stderr)
    if loose:
        raise SystemExit(NOT_TO_BE_USED)


def print_json(document: Any) -> None:
    """Print a document as JSON."""
    from sensors.documents import json_text

    print(json_text(document), file=_stdout)


@contextmanager
def heeding_ctrl_c() -> Iterator[None]:
    """Within, Ctrl-C ends a command even if Python drops its exception, as it does where that comes
    while an object is being freed: `progress_bar` raises it again at the next step. A shell that
    wants it ignored has its way."""
    global _pressed
    before, _pressed = signal.getsignal(signal.SIGINT), False
    mine = threading.current_thread() is threading.main_thread()  # others may not ask for signals
    if before is not signal.default_int_handler or not mine:
        yield
        return

    def interrupt(number: int, frame: object) -> None:
        global _pressed
        _pressed = True
        raise KeyboardInterrupt

    signal.signal(signal.SIGINT, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def progress_bar() -> Iterator[Progress]:
    """A progress bar on stderr where that is a terminal; else silence, or with -v a line a step."""
    with _steps_shown() as show:

        def step(what: str, done: int, total: int) -> None:
            if _pressed:
                raise KeyboardInterrupt
            show(what, done, total)

        yield step


@contextmanager
def _steps_shown() -> Iterator[Progress]:
    if not sys.stderr.isatty():
        yield _line_by_line() if _verbose else lambda what, done, total: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("reading", total=None)
        yield lambda what, done, total: bar.update(
            task, description=terminal(what), completed=done + 1, total=total
        )


def _line_by_line() -> Progress:
    """Progress as lines on stderr: seconds since the start, and what is done next."""
    start = time.monotonic()

    def tell(what: str, done: int, total: int) -> None:
        seconds = time.monotonic() - start
        said = terminal(f"{seconds:8.1f} s  {what} {done + 1}/{total}")
        print(said, file=sys.stderr, flush=True)

    return tell
