"""How good a run is, on the command line: evaluate."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from calib.cli.app import (
    Json,
    Runs,
    Scheduler,
    Trust,
    Workers,
    app,
    end_unless_converged,
    print_json,
    progress_bar,
    warn,
)
from calib.linear.parallel import executing
from chains.errors import InputError

if TYPE_CHECKING:
    from calib.runs.run import Run


@app.command()
def evaluate(
    runs: Runs,
    out: Annotated[
        Path | None,
        typer.Option(
            "-o", "--out", help="Where to write, of several runs in a folder each; else the run."
        ),
    ] = None,
    raw: Annotated[bool, typer.Option("--raw", help="Of the returns before correction.")] = False,
    at: Annotated[
        Path | None,
        typer.Option(
            "--at", metavar="FILE.csv", help="Poses (stop, joints) to predict the arm's error at."
        ),
    ] = None,
    body: Annotated[
        str | None,
        typer.Option("--body", help="With --at: of which body on the arm; else the last."),
    ] = None,
    trust: Trust = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
    as_json: Json = False,
) -> None:
    """Compute accuracy and precision of every return.

    By ring, distance, incidence and label.

    With --at, where the arm truly is at poses that need not be measured, and its sigma.
    """
    from calib.evaluation import evaluate_all
    from calib.runs.run import Run

    opened = [Run.open(run, trust or ()) for run in runs]
    if body is not None and at is None:
        raise InputError("evaluate --body is with --at FILE.csv")
    if at is not None:
        _predict(opened, at, out, body, raw=raw, as_json=as_json)
        return
    with executing(workers, scheduler), progress_bar() as progress:
        evaluations = evaluate_all(opened, out, raw, progress)
    warn(opened, as_json)
    if as_json:
        print_json(evaluations if len(evaluations) > 1 else next(iter(evaluations.values())))
    else:
        from calib.show.evaluation import print_evaluations

        print_evaluations(evaluations)
    end_unless_converged(*opened)


def _predict(
    runs: list[Run], at: Path, out: Path | None, body: str | None, *, raw: bool, as_json: bool
) -> None:
    if len(runs) > 1 or raw:
        raise InputError("evaluate --at is of one run, and without --raw")
    from calib.evaluation.at_poses import evaluate_at

    with progress_bar() as progress:
        found = evaluate_at(runs[0], at, out, progress, body)
    warn(runs, as_json)
    if as_json:
        print_json(found.document())
    else:
        from calib.show.evaluation import print_predicted

        print_predicted(found.document(), out)
    end_unless_converged(*runs)
