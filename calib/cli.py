"""The command line: arguments in, one call, results out. What is heavy is imported by the call."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

# BLAS threads on shared cores cost many times what they save; set before numpy is imported.
for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import typer  # noqa: E402

from chains.errors import InputError  # noqa: E402

if TYPE_CHECKING:
    from calib.run import Run

INTERRUPTED = 130  # as shells have it: 128 and the signal's number

app = typer.Typer(
    name="rigcal",
    help="Calibrate a LiDAR rig as one factor graph.",
    add_completion=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)

Json = Annotated[bool, typer.Option("--json", help="Print the machine-readable result alone.")]
Out = Annotated[Path, typer.Option("-o", "--out", help="Where to write.")]
Recordings = Annotated[list[Path], typer.Argument(help="Recording folders.", metavar="REC...")]
Effects = Annotated[
    str | None, typer.Option(help="Effects of the model, or files of them, with commas.")
]
Fix = Annotated[
    list[str] | None, typer.Option(metavar="NAME", help="Hold a frame, effect or parameter.")
]


@app.command()
def simulate(
    spec: Annotated[
        str, typer.Argument(help="A preset, or a YAML file that says what to simulate.")
    ],
    out: Out,
    seed: Annotated[int, typer.Option(help="Same seed, same recording.")] = 0,
    hide: Annotated[
        list[str] | None, typer.Option(metavar="EFFECT=SIZE", help="An effect to hide in it.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Write a recording, and the truth beside it."""
    from calib.simulate import simulate as run

    with _progress() as progress:
        run(spec, out, seed, _sizes(hide or []), progress)
    _say(
        {"recording": str(out), "truth": f"{out}.truth.json"},
        f"wrote {out} and {out}.truth.json",
        as_json,
    )


@app.command()
def check(recording: Path, as_json: Json = False) -> None:
    """What is in a recording, what is wrong, and what can and cannot be estimated from it."""
    from calib.check import check as run

    with _progress() as progress:
        found = run(recording, progress)
    if as_json:
        _print_json(found.document())
    else:
        from calib.tables import print_check

        print_check(found)
    if found.problems:
        raise SystemExit(2)


@app.command()
def fit(
    recordings: Recordings,
    out: Out,
    effects: Effects = None,
    fix: Fix = None,
    hold_out: Annotated[str, typer.Option(help="location, stop or none.")] = "location",
    folds: Annotated[int, typer.Option(help="Folds of the held-out error.", min=1, max=5)] = 1,
    prior: Annotated[
        Path | None, typer.Option(metavar="RUN", help="An earlier run instead of CAD.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Estimate the rig jointly; several recordings share what is the same hardware."""
    if hold_out not in ("location", "stop", "none"):
        raise InputError(f"--hold-out {hold_out}: give location, stop or none")
    from calib.calibrate import calibrate
    from calib.model import Model

    chosen = Model.of(effects, fix or [])
    with _progress() as progress:
        run = calibrate(recordings, out, chosen, hold_out, folds, prior, progress)
    _tell(run, as_json)


@app.command()
def add(
    run: Path,
    effects: Annotated[
        list[str], typer.Argument(help="Effects, or files of them.", metavar="EFFECT...")
    ],
    out: Out,
    as_json: Json = False,
) -> None:
    """The model of a run and more effects, refitted from that run to the same recordings."""
    from calib.calibrate import grow, grown_model
    from calib.run import Run

    earlier = Run.open(run)
    model = grown_model(earlier, effects)
    with _progress() as progress:
        _tell(grow(earlier, model, out, progress), as_json)


@app.command()
def diagnose(
    run: Path,
    refits: Annotated[
        bool, typer.Option("--refits/--no-refits", help="Whether to take the held-out falls.")
    ] = True,
    as_json: Json = False,
) -> None:
    """Where a run's model fails and which effect it lacks; written to RUN/diagnosis.json."""
    from calib.diagnosis import diagnose as find
    from calib.run import Run

    fitted = Run.open(run)
    with _progress() as progress:
        found = find(fitted, progress, refits)
    if as_json:
        _print_json(found.document())
    else:
        from calib.diagnosis_tables import print_diagnosis

        print_diagnosis(found, fitted.summary["residual"])


@app.command()
def explain(
    recordings: Recordings,
    out: Out,
    effects: Effects = None,
    fix: Fix = None,
    as_json: Json = False,
) -> None:
    """Fit, diagnose, add, until nothing worth adding is left; every rung is kept in DIR."""
    from calib.explain import explain as climb
    from calib.model import Model

    chosen = Model.of(effects, fix or [])
    with _progress() as progress:
        found = climb(recordings, out, chosen, progress)
    if as_json:
        _print_json(found.document())
    else:
        from calib.diagnosis_tables import print_explanation

        print_explanation(found)


@app.command()
def compare(
    runs: Annotated[list[Path], typer.Argument(metavar="RUN...")], as_json: Json = False
) -> None:
    """Errors and parameters of runs side by side, and the ladder by which they grew."""
    from calib.ladder import ladder
    from calib.run import Run
    from calib.tables import comparison, print_comparison

    opened = [Run.open(run) for run in runs]
    if as_json:
        rungs = [rung.document() for rung in ladder(opened)]
        _print_json(comparison(opened) | {"ladder": rungs})
    else:
        print_comparison(opened)


@app.command()
def export(
    run: Path,
    out: Out,
    formats: Annotated[
        list[str] | None, typer.Option("--format", help="yaml; all if not given.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Write the result for others: YAML extrinsics with sigmas and provenance."""
    from calib.export import export as write
    from calib.run import Run

    files = write(Run.open(run), out, formats or [])
    _say({"files": [str(f) for f in files]}, "\n".join(f"wrote {f}" for f in files), as_json)


@app.command()
def effects(
    name: Annotated[str | None, typer.Argument(help="One effect; all if not given.")] = None,
    as_json: Json = False,
) -> None:
    """The catalogue: formula, unit, size, what an effect is confounded with, source."""
    from calib.effects import CATALOGUE, find
    from calib.tables import effect_page, print_catalogue

    chosen = [find(name)] if name else list(CATALOGUE)
    if as_json:
        _print_json([effect_page(e) for e in chosen])
    else:
        print_catalogue(chosen, whole=name is not None)


def main() -> None:
    """Run the command line: exit code 0 done, 2 bad input or usage, 1 a fault of the program."""
    try:
        code = app(sys.argv[1:] or ["--help"], prog_name="rigcal", standalone_mode=False)
    except InputError as error:
        _fail(str(error), 2)
    except KeyboardInterrupt:
        code = INTERRUPTED
    except Exception as error:
        if hasattr(error, "format_message"):  # wrong usage: typer's click, wherever that lives
            _fail(error.format_message(), 2)
        if not _interrupted(error):
            if os.environ.get("RIGCAL_TRACEBACK"):
                raise
            name = type(error).__name__
            _fail(f"internal fault: {name}: {error} (RIGCAL_TRACEBACK=1 says where)", 1)
        code = INTERRUPTED
    if code == INTERRUPTED:  # typer's answer to Ctrl-C, too
        _fail("interrupted; nothing was left half-written", code)
    raise SystemExit(code or 0)


def _interrupted(error: BaseException | None) -> bool:
    """Whether Ctrl-C is behind an error: a library that it hits while loading reports its own."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None


def _fail(message: str, code: int) -> NoReturn:
    print(f"rigcal: {message}", file=sys.stderr)
    raise SystemExit(code)


def _sizes(hide: list[str]) -> dict[str, float]:
    sizes = {}
    for item in hide:
        name, _, size = item.partition("=")
        try:
            sizes[name] = float(size)
        except ValueError:
            raise InputError(
                f"--hide {item}: give EFFECT=SIZE with a number, range_scale=1 say"
            ) from None
    return sizes


def _tell(run: Run, as_json: bool) -> None:
    """Print what a fit found."""
    if as_json:
        _print_json(run.summary | {"not_estimated": run.solution.not_estimated})
    else:
        from calib.tables import print_run

        print_run(run)


def _say(document: dict[str, Any], text: str, as_json: bool) -> None:
    if as_json:
        _print_json(document)
    else:
        print(text)


def _print_json(document: Any) -> None:
    from sensors.documents import json_text

    print(json_text(document))


@contextmanager
def _progress() -> Iterator[Callable[[str, int, int], None]]:
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
