"""Other programs' files on the command line: import."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer
import typer.core

from calib.cli.app import Json, Out, app, print_json, progress_bar, takes_fields_of, verbose
from chains.errors import InputError

if TYPE_CHECKING:
    from calib.intake import Choices, Imported
    from sensors.readers.base import Options

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


Some, Many = str | None, list[str] | None


@dataclass(frozen=True)
class Asked:
    """What to import, and how: each field is an argument or an option of the command."""

    words: Annotated[list[str], typer.Argument(metavar="KIND FILE... [KIND FILE...]...")]
    out: Out
    rig: Annotated[Path | None, _flag("rig", "Your rig.yaml, with CAD; else one is begun.")] = None
    body: Annotated[Many, _flag("body", "The rig's frame of a tracked body.", "NAME=FRAME")] = None
    column: Annotated[
        Many, _flag("column", "Name a table's column; m.*=pose_*[mm].", "OURS=THEIRS")
    ] = None
    topic: Annotated[Many, _flag("topic", "Take this topic or stream.", "T")] = None
    length_unit: Annotated[
        Some, _flag("length-unit", "m, cm or mm, where a file does not say.")
    ] = None
    angle_unit: Annotated[Some, _flag("angle-unit", "rad or deg, where a file does not say.")] = (
        None
    )
    euler: Annotated[Some, _flag("euler", "XYZ about moved axes, xyz about fixed; or vector.")] = (
        None
    )
    rows: Annotated[Some, _flag("rows", "Rows of a table are stops, or a log.")] = None
    dh: Annotated[Some, _flag("dh", "Denavit and Hartenberg: standard or modified.")] = None
    up: Annotated[Some, _flag("up", "The tracker's axis that points up: y or z.")] = None
    first_ring: Annotated[
        int | None, _flag("first-ring", "The number of the first ring: 0 or 1.")
    ] = None
    rings_from_elevation: Annotated[
        bool, typer.Option("--rings-from-elevation", help="Infer rings from points.")
    ] = False
    lidar: Annotated[Some, _flag("lidar", "A model of the catalogue.", "MODEL")] = None
    metadata: Annotated[Path | None, _flag("metadata", "The sensor's own file.")] = None
    base: Annotated[Some, _flag("base", "The arm's first link.", "LINK")] = None
    tip: Annotated[Some, _flag("tip", "The arm's last link.", "LINK")] = None
    package: Annotated[Many, _flag("package", "The folder of a ROS package.", "NAME=DIR")] = None
    clock_offset: Annotated[
        Many, _flag("clock-offset", "What to add to a clock.", "NAME=SECONDS")
    ] = None
    sphere_radius: Annotated[
        float | None, _flag("sphere-radius", "Of spheres in clouds.", "METRES")
    ] = None
    still: Annotated[
        float | None, _flag("still", "Below it, things count as at rest.", "RAD_PER_S")
    ] = None
    min_hold: Annotated[float, _flag("min-hold", "What is shorter is no hold.", "SECONDS")] = 1.0
    locations: Annotated[
        int | None, _flag("locations", "Locations are so many blocks of time.", "N")
    ] = None
    most_stops: Annotated[
        int | None, _flag("most-stops", "Keep N of more stops, evenly spread.", "N")
    ] = None
    as_json: Json = False

    def options(self) -> Options:
        """How readers are to take the files."""
        from sensors.readers.base import Options

        return Options(
            topics=tuple(self.topic or ()),
            columns=_pairs("--column", self.column, str),
            bodies=_pairs("--body", self.body, str),
            length_unit=_one_of("--length-unit", self.length_unit, ("m", "cm", "mm")),
            angle_unit=_one_of("--angle-unit", self.angle_unit, ("rad", "deg")),
            up=_one_of("--up", self.up, ("y", "z")),
            first_ring=_one_of("--first-ring", self.first_ring, (0, 1)),
            rings_from_elevation=self.rings_from_elevation,
            lidar=self.lidar,
            metadata=self.metadata,
            base=self.base,
            tip=self.tip,
            euler=self.euler,
            rows=_one_of("--rows", self.rows, ("stops", "log")),
            packages=_pairs("--package", self.package, Path),
            dh=_one_of("--dh", self.dh, ("standard", "modified")),
            sphere_radius_m=self.sphere_radius,
        )

    def choices(self) -> Choices:
        """How a recording is made of what they read."""
        from calib.intake import Choices

        return Choices(
            rig=self.rig,
            clock_offsets=_pairs("--clock-offset", self.clock_offset, float),
            still=self.still,
            min_hold_s=self.min_hold,
            blocks=self.locations,
            most_stops=self.most_stops,
        )


@app.command("import", cls=_ListsKinds)
@takes_fields_of(Asked)
def import_command(asked: Asked) -> None:
    """Turn other programs' files into a recording."""
    from calib.intake import import_files, sources

    options, choices = asked.options(), asked.choices()
    with progress_bar() as progress:
        done = import_files(sources(asked.words), asked.out, options, choices, progress)
    _tell(done, asked.as_json)


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
