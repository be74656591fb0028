"""Runs for people to look at: report, plot, view."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from calib.cli.app import (
    Json,
    Out,
    Runs,
    Scheduler,
    Trust,
    Workers,
    app,
    end_unless_converged,
    print_json,
    progress_bar,
    say,
    warn,
)
from calib.linear.parallel import executing
from chains.errors import InputError


@app.command()
def report(
    runs: Runs,
    out: Out,
    trust: Trust = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
    as_json: Json = False,
) -> None:
    """Write a report: one HTML page that needs no network."""
    from calib.report import report as write
    from calib.runs.run import Run

    opened = [Run.open(run, trust or ()) for run in runs]
    with executing(workers, scheduler), progress_bar() as progress:
        written = write(opened, out, progress)
    warn(opened, as_json)
    say(written.document(), f"wrote {out}: {written.summary}", as_json)
    end_unless_converged(*opened)


@app.command()
def plot(
    run: Path,
    name: Annotated[str | None, typer.Argument(help="Which figure; --list names them.")] = None,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="A .png, .svg or .pdf file.")
    ] = None,
    listed: Annotated[bool, typer.Option("--list", help="Which figures this run has.")] = False,
    trust: Trust = None,
    as_json: Json = False,
) -> None:
    """Write one figure of a run's report."""
    from calib.report import Evidence, refuse_figure
    from calib.report import listed as figures
    from calib.report import plot as draw
    from calib.runs.run import Run

    opened = Run.open(run, trust or ())
    if out is not None and not listed:
        refuse_figure([opened], out)
    with progress_bar() as progress:
        evidence = Evidence.of([opened], progress)
        if listed:
            charts = [chart.document() for chart in figures(evidence)]
    if listed:
        if as_json:
            print_json({"charts": charts})
        else:
            from calib.show.tables import print_pairs, terminal

            names = [(chart["id"], chart["title"]) for chart in charts]
            print_pairs(terminal(), f"figures of {run}", names)
        return
    if name is None or out is None:
        raise InputError("give a figure's NAME and -o FILE.png, .svg or .pdf; --list names them")
    with progress_bar() as progress:
        chart = draw(evidence, name, out)
    warn([opened], as_json)
    say(chart.document() | {"file": str(out)}, f"wrote {out}: {chart.title}", as_json)
    end_unless_converged(opened)


@app.command()
def view(
    runs: Runs,
    port: Annotated[
        int, typer.Option(help="Where to serve; 0 is any free port.", min=0, max=65535)
    ] = 0,
    show: Annotated[
        bool, typer.Option("--open/--no-open", help="Whether to open it in a browser.")
    ] = True,
    trust: Trust = None,
    as_json: Json = False,
) -> None:
    """Open the workbench in a browser, until Ctrl-C."""
    from calib.view import view as serve

    def tell(url: str, look_url: str) -> None:
        text = f"{url} (Ctrl-C ends it)\n{look_url} is for others: it cannot change anything"
        say({"url": url, "look_url": look_url}, text, as_json)
        sys.stdout.flush()

    serve(runs, port, show, tell, trust or ())
