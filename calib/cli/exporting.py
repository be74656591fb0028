"""Files for other programs on the command line: export."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from calib.cli.app import (
    Force,
    Json,
    Out,
    Scheduler,
    Trust,
    Workers,
    app,
    print_json,
    progress_bar,
    say,
)
from calib.linear.parallel import executing


@app.command()
def export(
    run: Path,
    out: Out,
    formats: Annotated[
        list[str] | None,
        typer.Option(
            "--format",
            help="yaml, urdf, dh, ros2, autoware, kalibr, rings, hesai, ouster, tree, latex, "
            "markdown, with commas; all that have anything to hold if not given.",
        ),
    ] = None,
    trust: Trust = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Write the result as YAML, URDF, ROS 2, ring tables, ..."""
    from calib.blunders.told import whole
    from calib.effects import split
    from calib.exporters import export as write
    from calib.runs.reopen import effects_that_may_run
    from calib.runs.run import Run

    opened = Run.open(run, trust or ())
    done = write(opened, out, split(formats or ()), force)
    document = {
        "warnings": opened.before_use,
        "files": [str(file) for file in done.files],
        "not_held": done.not_held,
        "left_out": done.left_out,
    }
    if as_json:
        print_json(document)
        return
    from calib.show.tables import print_pairs, terminal

    console = terminal()
    for sentence in (*opened.before_use, *map(whole, opened.odd_rings)):
        console.print(sentence)
    for file in done.files:
        console.print(f"wrote {file}", soft_wrap=True)
    if missing := effects_that_may_run(opened)[1]:
        console.print(missing)
    if done.left_out:
        print_pairs(console, "left out", done.left_out.items())
    lacks = {
        name: ", ".join(sentence.partition(":")[0] for sentence in sentences)
        for name, sentences in done.not_held.items()
    }
    if rows := [(name, what) for name, what in lacks.items() if what]:
        print_pairs(console, "what files do not hold", rows)
    console.print("Why, in whole sentences: --json, and the head of each file that has comments.")


@app.command()
def apply(
    run: Path,
    clouds: Annotated[
        list[Path], typer.Argument(metavar="CLOUD...", help="PCD, PLY, Parquet, or recordings.")
    ],
    out: Out,
    rig: Annotated[
        str | None, typer.Option(metavar="NAME", help="Whose LiDAR, where the run has several.")
    ] = None,
    trust: Trust = None,
    force: Force = False,
    workers: Workers = None,
    scheduler: Scheduler = None,
    as_json: Json = False,
) -> None:
    """Correct point clouds by the estimated effects of a run."""
    from calib.evaluation.apply import apply as correct
    from calib.runs.run import Run

    opened = Run.open(run, trust or ())
    with executing(workers, scheduler), progress_bar() as progress:
        done = correct(opened, clouds, out, rig, progress, force)
    document = {
        "warnings": opened.before_use,
        "clouds": [
            {"file": str(a.path), "points": a.points, "moved_rms_mm": 1e3 * a.rms_m}
            | {"not_corrected": a.left_out, "extrapolated": list(a.extrapolated)}
            | {"remarks": list(a.remarks)}
            for a in done
        ],
    }
    lines = [*opened.doubts, *opened.omissions, *opened.found_wrong]
    for a in done:
        lines += [*a.remarks, *a.extrapolated]
        lines.append(f"wrote {a.path}: {a.points} points, moved by {1e3 * a.rms_m:.2f} mm rms")
        lines += [f"  not corrected: {name}, which {why}" for name, why in a.left_out.items()]
    say(document, "\n".join(lines), as_json)
