"""Files for other programs on the command line: export."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from calib.cli.app import Json, Out, app, say


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
    say({"files": [str(f) for f in files]}, "\n".join(f"wrote {f}" for f in files), as_json)
