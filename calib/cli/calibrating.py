"""The loop on the command line: simulate, check, fit, diagnose, add, compare."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from calib.cli.app import (
    NOT_TO_BE_USED,
    Json,
    Out,
    Runs,
    Scheduler,
    Trust,
    Workers,
    app,
    effect_names,
    end_unless_converged,
    print_json,
    progress_bar,
    say,
    verbose,
)
from calib.linear.parallel import executing
from chains.errors import InputError

if TYPE_CHECKING:
    from calib.runs.run import Run

Recordings = Annotated[list[Path], typer.Argument(help="Recording folders.", metavar="REC...")]
Effects = Annotated[
    str | None, typer.Option(help="Effects of the model, or files of them, with commas.")
]
Fix = Annotated[
    list[str] | None, typer.Option(metavar="NAME", help="Hold a frame, effect or parameter.")
]
CANDIDATES_HELP = "Effects of your own that may be missing: files of them, or folders, with commas."
Without = Annotated[
    list[str] | None,
    typer.Option(metavar="STOP:BODY", help="Leave out a blunder, as 'diagnose' names it."),
]
Beams = Annotated[
    int | None,
    typer.Option(metavar="N", help="Use N beams of each scan: a first answer.", min=1),
]


@app.command()
def simulate(
    spec: Annotated[str, typer.Argument(help="A preset, or a YAML specification.")],
    out: Out,
    seed: Annotated[int, typer.Option(help="Same seed, same recording.")] = 0,
    hide: Annotated[
        list[str] | None,
        typer.Option(
            metavar="EFFECT=SIZE", help="An effect to hide in it, as many times its usual size."
        ),
    ] = None,
    trust: Trust = None,
    as_json: Json = False,
) -> None:
    """Simulate a recording, and write the truth beside it."""
    from calib.simulation import simulate as run

    with progress_bar() as progress:
        run(spec, out, seed, _sizes(hide or []), progress, trust or [])
    say(
        {"recording": str(out), "truth": f"{out}.truth.json"},
        f"wrote {out} and {out}.truth.json",
        as_json,
    )


@app.command()
def check(recording: Path, as_json: Json = False) -> None:
    """List what a recording holds and what it can determine.

    Errors in it are reported, and the parameters that are not identifiable.
    """
    from calib.results.check import check as run

    with progress_bar() as progress:
        checked = run(recording, progress)
    if as_json:
        print_json(checked.document())
    else:
        from calib.show.tables import print_check

        print_check(checked, whole=verbose())
    if checked.problems:
        raise SystemExit(2)


@app.command()
def fit(
    recordings: Recordings,
    out: Out,
    effects: Effects = None,
    fix: Fix = None,
    without: Without = None,
    hold_out: Annotated[str, typer.Option(help="location, stop or none.")] = "location",
    folds: Annotated[int, typer.Option(help="Folds of the held-out error.", min=1, max=5)] = 1,
    prior: Annotated[
        Path | None, typer.Option(metavar="RUN", help="An earlier run instead of CAD.")
    ] = None,
    beams: Beams = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
    as_json: Json = False,
) -> None:
    """Estimate all parameters of a rig jointly.

    Several recordings share the parameters of the same hardware.
    """
    if hold_out not in ("location", "stop", "none"):
        raise InputError(f"--hold-out {hold_out}: give location, stop or none")
    from calib.problem.model import Model
    from calib.runs.calibrate import calibrate
    from calib.runs.reopen import effects_of_prior

    known = effects_of_prior(prior) if effects is None else ()
    chosen = Model.of(effects, fix or [], without or [], recordings, beams, known)
    with executing(workers, scheduler), progress_bar() as progress:
        run = calibrate(recordings, out, chosen, hold_out, folds, prior, progress)
    _tell(run, as_json)


@app.command()
def add(
    run: Path,
    out: Out,
    effects: Annotated[
        list[str] | None,
        typer.Argument(
            help="Effects, or files of them.", metavar="EFFECT...", autocompletion=effect_names
        ),
    ] = None,
    without: Without = None,
    every_beam: Annotated[
        bool, typer.Option("--every-beam", help="Use all beams, where RUN used some.")
    ] = False,
    trust: Trust = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
    as_json: Json = False,
) -> None:
    """Add effects to the model of a run, and refit it."""
    if not effects and not without and not every_beam:
        raise InputError(
            "give an EFFECT to add, or what to leave out with --without, or --every-beam"
        )
    from calib.runs.add import add as grow
    from calib.runs.run import Run

    grown_from = Run.open(run, trust or ())
    with executing(workers, scheduler), progress_bar() as progress:
        grown = grow(grown_from, effects or [], out, progress, without or [], every_beam)
        _tell(grown, as_json)


@app.command()
def diagnose(
    run: Path,
    refits: Annotated[
        bool, typer.Option("--refits/--no-refits", help="Whether to refit for held-out errors.")
    ] = True,
    candidates: Annotated[
        str | None, typer.Option("--candidates", "--effects", metavar="FILE", help=CANDIDATES_HELP)
    ] = None,
    trust: Trust = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
    as_json: Json = False,
) -> None:
    """Test a run's model: missing effects, blunders, scatter.

    The result is written to RUN/diagnosis.json.
    """
    from calib.runs.diagnose import diagnose as find
    from calib.runs.run import Run

    fitted = Run.open(run, trust or ())
    with executing(workers, scheduler), progress_bar() as progress:
        diagnosis = find(fitted, progress, refits, candidates or ())
    if as_json:
        print_json(diagnosis.document())
    else:
        from calib.show.diagnosis import print_diagnosis

        print_diagnosis(diagnosis, fitted.summary["residual"], whole=verbose())
    end_unless_converged(fitted)


@app.command()
def explain(
    recordings: Recordings,
    out: Out,
    effects: Effects = None,
    fix: Fix = None,
    without: Without = None,
    candidates: Annotated[
        str | None, typer.Option("--candidates", metavar="FILE", help=CANDIDATES_HELP)
    ] = None,
    beams: Beams = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
    as_json: Json = False,
) -> None:
    """Fit, diagnose and add until nothing is missing.

    Every rung of the ladder is kept in DIR.
    """
    from calib.problem.model import Model
    from calib.runs.explain import explain as climb

    chosen = Model.of(effects, fix or [], without or [], recordings, beams)
    with executing(workers, scheduler), progress_bar() as progress:
        explanation = climb(recordings, out, chosen, progress, candidates or ())
    if as_json:
        print_json(explanation.document())
    else:
        from calib.show.diagnosis import print_explanation

        print_explanation(explanation)
    end_unless_converged(explanation.runs[-1])


@app.command()
def compare(runs: Runs, as_json: Json = False) -> None:
    """Show errors and parameters of runs side by side.

    With the ladder by which they grew.
    """
    from calib.runs.ladder import ladder
    from calib.runs.run import Run
    from calib.show.comparison import comparison, print_comparison

    opened = [Run.open(run) for run in runs]
    if as_json:
        rungs = [rung.document() for rung in ladder(opened)]
        print_json(comparison(opened) | {"ladder": rungs})
    else:
        print_comparison(opened)
    end_unless_converged(*opened)


@app.command()
def moved(
    first: Annotated[Path, typer.Argument(metavar="RUN_A", help="The earlier run.")],
    second: Annotated[Path, typer.Argument(metavar="RUN_B", help="The later run.")],
    as_json: Json = False,
) -> None:
    """Report what changed between two runs, with sigmas."""
    from calib.runs.asked.moved import moved as compare_two
    from calib.runs.run import Run
    from calib.show.comparison import moved_document, print_moved

    found = compare_two(Run.open(first), Run.open(second))
    if as_json:
        print_json(moved_document(found))
    else:
        print_moved(found)
    end_unless_converged(*found.runs)


@app.command()
def reproduce(
    run: Path,
    recordings: Annotated[
        list[Path] | None,
        typer.Option(
            "--recording", metavar="PATH", help="Where it is now; several in the run's order."
        ),
    ] = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
    trust: Trust = None,
    as_json: Json = False,
) -> None:
    """Repeat a run and compare every file of it.

    With all runs that it grew from.
    """
    from calib.runs.reproduce import reproduce as make_again
    from calib.runs.run import Run

    with executing(workers, scheduler), progress_bar() as progress:
        found = make_again(Run.open(run, trust or ()), recordings or (), progress)
    if as_json:
        print_json(found.document())
    else:
        from calib.show.reproduction import print_reproduction

        print_reproduction(found)
    if not found.identical:
        raise SystemExit(NOT_TO_BE_USED)


@app.command()
def effects(
    name: Annotated[
        str | None,
        typer.Argument(
            metavar="NAME_OR_FILE",
            help="One effect, or a file of your own; all of the catalogue if not given.",
            autocompletion=effect_names,
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="Draw what one does: .png, .svg or .pdf.")
    ] = None,
    as_json: Json = False,
) -> None:
    """List the catalogue, or show the page of one effect.

    Formula, unit, typical size, confounded effects, source.
    """
    from calib.effects import CATALOGUE, load_effects
    from calib.show.tables import effect_page, print_catalogue

    chosen = load_effects((name,)) if name else CATALOGUE
    if out is not None:
        if len(chosen) != 1:
            raise InputError(f"-o {out} draws one effect; name one")
        from calib.report.effects import draw_effect

        draw_effect(chosen[0], out)
    if as_json:
        print_json([effect_page(e) for e in chosen])
    else:
        print_catalogue(chosen, whole=name is not None)


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
        print_json(run.summary | {"not_estimated": run.solution.not_estimated})
    else:
        from calib.show.tables import print_run

        print_run(run, whole=verbose())
    end_unless_converged(run)
