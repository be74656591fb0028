"""Other programs' files on the command line: import."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer
import typer.core

from calib.cli.app import Json, Out, app, print_json, progress_bar, verbose
from chains.errors import InputError

if TYPE_CHECKING:
    from calib.intake import Imported

T = TypeVar("T")


class _ListsKinds(typer.core.TyperCommand):
    """Shows below its options which kinds there are, what each reads and what it needs."""

    def format_epilog(self, ctx: Any, formatter: Any) -> None:
        from sensors.readers import READERS

        rows = []
        for kind, reader in sorted(READERS.items()):
            needs = f"; needs pip install 'rigcal[{reader.extra}]'" if reader.extra else ""
            rows.append((kind, reader.reads + needs))
        with formatter.section("Kinds"):
            formatter.write_dl(rows)


def _flag(name: str, help: str, metavar: str | None = None) -> Any:
    return typer.Option(f"--{name}", help=help, metavar=metavar)


Words = Annotated[list[str], typer.Argument(metavar="KIND FILE... [KIND FILE...]...")]
Some, Many = str | None, list[str] | None
Rig = Annotated[Path | None, _flag("rig", "Your rig.yaml, with CAD; else one is begun.")]
Body = Annotated[Many, _flag("body", "The rig's frame of a tracked body.", "NAME=FRAME")]
Column = Annotated[Many, _flag("column", "Name a table's column; m.*=pose_*[mm].", "OURS=THEIRS")]
Topic = Annotated[Many, _flag("topic", "Take this topic or stream.", "T")]
Length = Annotated[Some, _flag("length-unit", "m, cm or mm, where a file does not say.")]
Angle = Annotated[Some, _flag("angle-unit", "rad or deg, where a file does not say.")]
Euler = Annotated[Some, _flag("euler", "XYZ about moved axes, xyz about fixed; or vector.")]
Rows = Annotated[Some, _flag("rows", "Rows of a table are stops, or a log.")]
Dh = Annotated[Some, _flag("dh", "Denavit and Hartenberg: standard or modified.")]
Up = Annotated[Some, _flag("up", "The tracker's axis that points up: y or z.")]
First = Annotated[int | None, _flag("first-ring", "The number of the first ring: 0 or 1.")]
Infer = Annotated[bool, typer.Option("--rings-from-elevation", help="Infer rings from points.")]
Lidar = Annotated[Some, _flag("lidar", "A model of the catalogue.", "MODEL")]
Radius = Annotated[float | None, _flag("sphere-radius", "Of spheres in clouds.", "METRES")]
Metadata = Annotated[Path | None, _flag("metadata", "The sensor's own file.")]
Base = Annotated[Some, _flag("base", "The arm's first link.", "LINK")]
Tip = Annotated[Some, _flag("tip", "The arm's last link.", "LINK")]
Package = Annotated[Many, _flag("package", "The folder of a ROS package.", "NAME=DIR")]
Clock = Annotated[Many, _flag("clock-offset", "What to add to a clock.", "NAME=SECONDS")]
Still = Annotated[float | None, _flag("still", "What is slower is at rest.", "RAD_PER_S")]
MinHold = Annotated[float, _flag("min-hold", "What is shorter is no hold.", "SECONDS")]
Blocks = Annotated[int | None, _flag("locations", "Locations are so many blocks of time.", "N")]
Most = Annotated[int | None, _flag("most-stops", "Keep N of more stops, evenly spread.", "N")]


@app.command("import", cls=_ListsKinds)
def import_command(
    words: Words, out: Out, rig: Rig = None, body: Body = None, column: Column = None,
    topic: Topic = None, length_unit: Length = None, angle_unit: Angle = None, euler: Euler = None,
    rows: Rows = None, dh: Dh = None, up: Up = None, first_ring: First = None,
    rings_from_elevation: Infer = False, lidar: Lidar = None, metadata: Metadata = None,
    base: Base = None, tip: Tip = None, package: Package = None, clock_offset: Clock = None,
    sphere_radius: Radius = None, still: Still = None, min_hold: MinHold = 1.0,
    locations: Blocks = None, most_stops: Most = None, as_json: Json = False,
) -> None:  # fmt: skip
    """Turn other programs' files into a recording."""
    from calib.intake import Choices, import_files, sources
    from sensors.readers.base import Options

    options = Options(
        topics=tuple(topic or ()),
        columns=_pairs("--column", column, str),
        bodies=_pairs("--body", body, str),
        length_unit=_one_of("--length-unit", length_unit, ("m", "cm", "mm")),
        angle_unit=_one_of("--angle-unit", angle_unit, ("rad", "deg")),
        up=_one_of("--up", up, ("y", "z")),
        first_ring=_one_of("--first-ring", first_ring, (0, 1)),
        rings_from_elevation=rings_from_elevation,
        lidar=lidar,
        metadata=metadata,
        base=base,
        tip=tip,
        euler=euler,
        rows=_one_of("--rows", rows, ("stops", "log")),
        packages=_pairs("--package", package, Path),
        dh=_one_of("--dh", dh, ("standard", "modified")),
        sphere_radius_m=sphere_radius,
    )
    offsets = _pairs("--clock-offset", clock_offset, float)
    choices = Choices(
        rig=rig,
        clock_offsets=offsets,
        still=still,
        min_hold_s=min_hold,
        blocks=locations,
        most_stops=most_stops,
    )
    with progress_bar() as progress:
        done = import_files(sources(words), out, options, choices, progress)
    _tell(done, as_json)


def _pairs(flag: str, items: Sequence[str] | None, kind: Callable[[str], T]) -> dict[str, T]:
    """Options of the form NAME=VALUE, by name."""
    values = {}
    for item in items or ():
        name, equals, value = item.partition("=")
        try:
            if not name or not equals or not value:
                raise ValueError
            values[name] = kind(value)
        except ValueError:
            what = "a number" if kind is float else "something"
            raise InputError(f"{flag} {item}: give NAME=VALUE, with {what} on the right") from None
    return values


def _one_of(flag: str, value: T | None, allowed: Sequence[T]) -> T | None:
    if value is not None and value not in allowed:
        raise InputError(f"{flag} {value}: give {' or '.join(map(str, allowed))}")
    return value


def _tell(done: Imported, as_json: bool) -> None:
    """Print what was understood, what looked odd, and what the recording then is."""
    if as_json:
        print_json(done.document())
        return
    from calib.show.tables import print_check, print_pairs, terminal

    console = terminal()
    print_pairs(console, "what was understood", [("", line) for line in done.understood])
    if done.odd:
        print_pairs(console, "what looked odd", [("", line) for line in done.odd])
    console.print(f"wrote {done.folder}\n", style="bold", soft_wrap=True)
    if done.check.can or done.check.cannot:
        print_check(done.check, whole=verbose())
    else:
        console.print(f"rigcal check {done.folder} tells what can be estimated from it")
