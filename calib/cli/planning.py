"""What to measure next."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from calib.cli.app import (
    Json,
    Trust,
    app,
    end_unless_converged,
    print_json,
    progress_bar,
    warn,
)
from calib.linear.parallel import workers as threads
from chains.errors import InputError

UNTIL = "The fewest stops until sigmas are so small: 'lidar 0.3 mm, rings 1 mm'."
FOR = (
    "all; workspace, to predict best wherever the arm goes; reliability, against blunders; "
    "scatter, of stops; names to know better, with commas; effects to separate."
)

Stops = Annotated[
    int | None,
    typer.Option(
        metavar="N",
        min=1,
        help="How many; with --until how many at most.",
        show_default="5, 30",
    ),
]
For = Annotated[
    str | None, typer.Option("--for", metavar="WHAT", help=FOR, show_default="what diagnose found")
]
Until = Annotated[str | None, typer.Option(metavar="SIGMAS", help=UNTIL, show_default=False)]
Hung = Annotated[
    int | None,
    typer.Option(metavar="N", min=1, help="Instead: where so many targets should hang."),
]
Out = Annotated[
    Path | None,
    typer.Option(
        "-o", "--out", metavar="OUT", help="FILE.csv of them; or a folder, with a picture."
    ),
]
Threads = Annotated[
    int | None,
    typer.Option(
        min=1, metavar="N", help="Threads, all cores if not given; the result is the same."
    ),
]
Region = Annotated[
    tuple[float, float, float, float] | None,
    typer.Option(metavar="X0 Y0 X1 Y1", help="Where the base may stand, or targets hang, m."),
]


@app.command()
def plan(
    run: Annotated[
        Path, typer.Argument(metavar="RUN_OR_RIG", help="A run; or a rig's folder, with --region.")
    ],
    stops: Stops = None,
    purpose: For = None,
    until: Until = None,
    targets: Hung = None,
    region: Region = None,
    out: Out = None,
    candidates: Annotated[
        int, typer.Option(metavar="N", min=1, max=3000, help="Random poses that are looked at.")
    ] = 500,
    seed: Annotated[int, typer.Option(min=0, help="Same seed, same stops.")] = 0,
    trust: Trust = None,
    workers: Threads = None,
    as_json: Json = False,
) -> None:
    """Plan the next stops, and predict what they determine."""
    from calib import outputs
    from calib.outputs.kinds import PLANNED
    from calib.planning import inputs_of, is_rig
    from calib.planning import plan as choose
    from calib.planning.room.hanging import plan_targets as hang
    from calib.report.planned import write_plan
    from calib.runs.run import Run

    if targets is not None and (stops is not None or until is not None):
        raise InputError("give --targets, or --stops and --until; not both")
    opened = run if is_rig(run) else Run.open(run, trust or ())
    more = {"purpose": purpose, "region": region, "candidates": candidates, "seed": seed}
    # A run's name may have a dot, v1.2, and its plan's is v1.2-plan.
    folder = out if out is not None and not out.suffix[1:].isalpha() else None
    if folder is not None:
        outputs.refuse(folder, PLANNED, inputs_of(opened))
    with threads(workers), progress_bar() as progress:
        more |= {"out": None if folder else out, "progress": progress}
        if targets is None:
            found = choose(opened, stops, until=until, **more)
        else:
            found = hang(opened, targets, **more)
        if folder is not None:
            write_plan(found, folder, opened)
    of = [opened] if isinstance(opened, Run) else []
    warn(of, as_json)
    if as_json:
        print_json(found.document())
    else:
        from calib.show import plan as show

        show.print_plan(found) if targets is None else show.print_targets(found)
    end_unless_converged(*of)
