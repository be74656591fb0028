"""Foreign files put together as a recording: clocks, holds, stops, the rig, all written once."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from calib import outputs
from calib.intake import rigfile, scans, stops, targets
from calib.intake.clocks import align
from calib.intake.gather import (
    Gathered,
    Given,
    finite_times,
    gather,
    joint_track,
    once_each,
    refuse_parts,
    section,
    sources,
)  # fmt: skip
from calib.intake.still import MIN_HOLD_S, find_holds
from calib.intake.surface import write_surface
from calib.results.check import Check, check
from calib.rig import load_rig
from calib.runs.run import versions
from chains.errors import InputError, is_file_name, shortened
from sensors.documents import write_atomically
from sensors.readers.base import Columns, Options, Progress
from sensors.stops import write_columns

__all__ = ["Choices", "Imported", "import_files", "sources"]

# Stops; with more, what can be estimated is left to `rigcal check`, for its time.
MOST_CHECKED = 500


@dataclass(frozen=True)
class Choices:
    """What a user decides about putting sources together.

    Args:
        rig: a rig.yaml of theirs, taken as it is.
        clock_offsets: clock -> s to be added to it.
        still: rad/s or m/s below which something is at rest; None = learned from the data.
        min_hold_s: shorter holds are none.
        blocks: locations as so many equal blocks in the order of time; None = found out.
        most_stops: of more stops, so many, evenly spread; None = all.
    """

    rig: Path | None = None
    clock_offsets: Mapping[str, float] = field(default_factory=dict)
    still: float | None = None
    min_hold_s: float = MIN_HOLD_S
    blocks: int | None = None
    most_stops: int | None = None


@dataclass(frozen=True)
class Imported:
    """A recording that was written, what was understood of its sources, and what looked odd."""

    folder: Path
    understood: list[str]
    odd: list[str]
    check: Check

    def document(self) -> dict[str, Any]:
        """As ``--json`` prints it."""
        return {
            "recording": str(self.folder),
            "understood": self.understood,
            "odd": self.odd,
            "check": self.check.document(),
        }


@dataclass(frozen=True)
class _Cut:
    """Sources cut into stops: their columns, and which turns of the LiDAR belong to each."""

    columns: Columns
    share: scans.Share
    understood: list[str]
    odd: list[str]


def import_files(
    given: Sequence[Given],
    out: Path | str,
    options: Options | None = None,
    choices: Choices | None = None,
    progress: Progress = lambda what, done, total: None,
) -> Imported:
    """Turn foreign files into a recording folder, whole or not at all, and check it.

    Args:
        given: kinds and their files; `sources` cuts a command line into them.
        out: the recording's folder.
        options: what readers are told.
        choices: what is decided about putting sources together.

    Raises:
        InputError: a file is wrong, something essential is ambiguous (the sentence names the flag
            that decides it), or the recording would not be one.
    """
    options, choices, out = options or Options(), choices or Choices(), Path(out)
    if choices.rig is not None and not choices.rig.is_file():
        raise InputError(f"--rig {choices.rig}: there is no such file")
    inputs = _inputs(given, options, choices)
    with outputs.folder(out, outputs.RECORDING, inputs) as folder, _called(folder, out):
        gathered = gather(given, options, choices.rig, progress)
        refuse_parts(gathered, choices.rig)
        cut = _from_rows(gathered) if gathered.stops is not None else _from_logs(gathered, choices)
        understood, odd = [*gathered.understood, *cut.understood], [*gathered.odd, *cut.odd]
        columns, share = _thinned(cut, choices.most_stops)
        odd += _write_parts(folder, gathered, choices.rig)
        if choices.rig is not None:
            columns, said, more = rigfile.matched(choices.rig, columns)
        else:
            name = out.name if is_file_name(out.name) else "rig"
            columns, said, more = rigfile.first_rig(folder, name, gathered, columns, options.lidar)
        rig = load_rig(folder)
        base = next((b for b in (rig.tracker.bodies if rig.tracker else ())
                     if b not in rig.beyond_arm), None)  # fmt: skip
        columns, words = stops.locations(columns, base if rig.arm_edges else None, choices.blocks)
        understood += [*said, f"locations: {words}"]
        odd += more
        write_columns(folder / "stops.csv", _ordered(columns))
        if share:
            _check_names(columns["stop"].tolist())
            kept = outputs.kept(folder, _asked(given, options, choices, share))
            names = columns["stop"].tolist()
            odd += scans.write(folder / "scans", names, share, kept, progress)
        rods, more = targets.join(gathered.spheres, gathered.tracks)
        odd += more
        if rods is not None:
            write_columns(folder / "targets.csv", rods)
        checked = check(folder, progress, graph=len(columns["stop"]) <= MOST_CHECKED)
        if checked.problems:
            raise InputError(". ".join([checked.problems[0].rstrip("."), *more]))
    return Imported(out, understood, odd, replace(checked, folder=out))


def _inputs(given: Sequence[Given], options: Options, choices: Choices) -> list[Path]:
    """All files and folders that an import reads."""
    files = [path for _, paths in given for path in paths]
    named = (choices.rig, options.metadata, options.lidar)
    return [*files, *options.packages.values(), *(Path(each) for each in named if each)]


def _asked(
    given: Sequence[Given], options: Options, choices: Choices, share: scans.Share
) -> dict[str, Any]:
    """All that scans depend on, as JSON holds it: what was asked, which turns each stop has, and
    files by their size and time, as logs are too long to be read once more. Beside a capture its
    reader looks for the sensor's JSON."""
    named = [path.absolute() for _, paths in given for path in paths]
    beside = {file for path in named for file in path.parent.glob("*.json")}
    within = {file for path in named if path.is_dir() for file in path.rglob("*")}
    every = beside | within | {path.absolute() for path in _inputs(given, options, choices)}
    files = []
    for file in sorted(file for file in every if file.is_file()):
        with suppress(OSError):  # which nobody could read
            files.append([str(file), file.stat().st_size, file.stat().st_mtime_ns])
    turns = hashlib.sha256()
    for one, stop in share:
        turns.update(one.time_s.tobytes() + stop.tobytes())
    asked = [repr(options), repr(choices)]
    return {"files": files, "asked": asked, "turns": turns.hexdigest(), "versions": versions()}


@contextmanager
def _called(folder: Path, name: Path) -> Iterator[None]:
    """Complaints about files of a folder name it as its reader would have found it."""
    try:
        yield
    except InputError as error:
        said = str(error).replace(str(folder), str(name))
        as_made = (
            " (of what would have been imported; nothing was written)" if said != str(error) else ""
        )
        raise InputError(f"{said}{as_made}") from None


def _from_rows(gathered: Gathered) -> _Cut:
    """Stops that a table lists, and clouds that are named after them."""
    columns = dict(gathered.stops)
    count = len(next(iter(columns.values())))
    columns.setdefault("stop", np.array([f"row{k:05d}" for k in range(count)]))
    missing = [name for name in gathered.joints if name not in columns]
    if missing:
        raise InputError(
            f"the table of stops has no column of the arm's joint {missing[0]}; say --column "
            f"{missing[0]}=THEIRS"
        )
    share, odd = (
        scans.by_name(gathered.sweeps, columns["stop"].tolist()) if gathered.sweeps else ([], [])
    )
    if gathered.tracks:
        names = ", ".join(dict.fromkeys(track.name for track in gathered.tracks))
        odd = [*odd, f"the logs {names} are left out: a table lists the stops already"]
    return _Cut(columns, share, [], odd)


def _from_logs(gathered: Gathered, choices: Choices) -> _Cut:
    """Holds found in logs; or, where nothing was logged, what the LiDAR saw as one stop or more."""
    tracks = [t for t in joint_track(gathered.tracks, gathered.joints) if not targets.is_rod(t)] \
        if gathered.tracks or gathered.joints else []  # fmt: skip
    once_each(tracks)
    timed = bool(gathered.sweeps) and finite_times(gathered.sweeps)
    if not tracks:
        return _still(gathered, timed)
    clocks = align(
        tracks, gathered.sweeps if timed else [], gathered.read_chain, choices.clock_offsets
    )
    holds = find_holds(clocks.tracks, gathered.read_chain, choices.still, choices.min_hold_s)
    columns, odd = stops.table(clocks.tracks, holds.spans_s)
    share: scans.Share = []
    if timed:
        share, more = scans.by_time(clocks.sweeps, holds.spans_s)
        odd += more
    elif gathered.sweeps:
        share, more = scans.by_name(gathered.sweeps, columns["stop"].tolist())
        odd += more
    return _Cut(columns, share, [*clocks.understood, *holds.understood], [*clocks.odd, *odd])


def _still(gathered: Gathered, timed: bool) -> _Cut:
    """Nothing but a LiDAR: one stop of all its turns, or one for every file without a clock."""
    if not gathered.sweeps:
        raise InputError("the logs say neither where something was nor what the LiDAR saw")
    scans.one_lidar(gathered.sweeps)
    names = ["still"] if timed else [one.name for one in gathered.sweeps]
    if len(set(names)) < len(names):
        raise InputError(f"two clouds are named {max(names, key=names.count)}; rename one")
    share = [
        (one, np.full(len(one.time_s), 0 if timed else k)) for k, one in enumerate(gathered.sweeps)
    ]
    columns: Columns = {"stop": np.array(names)}
    if timed:
        columns["time_s"] = gathered.sweeps[0].time_s[:1]
    what = "all turns of the LiDAR are one stop" if timed else "every cloud is a stop"
    return _Cut(columns, share, [], [f"nothing says when the rig stood still: {what}"])


def _check_names(stops: Sequence[str]) -> None:
    """Refuse stops that no file can be named after."""
    for name in stops:
        if not is_file_name(str(name)):
            raise InputError(
                f"stop {shortened(str(name))} is no name for a file; rename the file or row that "
                f"it is called after"
            )


def _thinned(cut: _Cut, most: int | None) -> tuple[Columns, scans.Share]:
    """The stops, or so many of them, evenly spread, and which turns belong to each."""
    count = len(cut.columns["stop"])
    if most is None or count <= most:
        return cut.columns, cut.share
    if most < 1:
        raise InputError(f"--most-stops {most}: at least 1 is wanted")
    kept = np.linspace(0, count - 1, most).astype(int)
    number = np.full(count + 1, -1)
    number[kept] = np.arange(most)
    share = [(one, number[stop]) for one, stop in cut.share]
    return {name: values[kept] for name, values in cut.columns.items()}, share


def _write_parts(folder: Path, gathered: Gathered, rig: Path | None) -> list[str]:
    """Arm and reference under the names that the rig has for them, and the rig itself where given;
    what looked odd."""
    name, odd = "arm.urdf", []
    if rig is not None:
        name = str(section(rig, "arm").get("urdf", name))
        if Path(name).is_absolute() or ".." in Path(name).parts or "\0" in name:
            raise InputError(
                f"{rig}: arm.urdf is {shortened(name)}, and the arm is written into the recording; "
                f"name a file there, arm.urdf say"
            )
        shutil.copyfile(rig, folder / "rig.yaml")
        for file in _files_of(rig):
            if (rig.parent / file).is_file():
                (folder / file).parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(rig.parent / file, folder / file)
    if gathered.arm:
        with write_atomically(folder / name) as path:
            path.write_text(gathered.arm.urdf, encoding="utf-8")
    if gathered.surface:
        write_surface(gathered.surface, folder)
        faces = section(rig, "reference").get("faces") if rig else None
        if gathered.surface.label is None and faces and (folder / str(faces)).is_file():
            odd.append(
                f"the mesh has no labels; taken from {rig.parent / str(faces)}, beside the rig"
            )
    return odd


def _files_of(rig: Path) -> list[str]:
    """The files that a rig.yaml names, relative to itself; the arm's is not among them."""
    files = [section(rig, "lidar").get("model")]
    files += [section(rig, "reference").get(key) for key in ("mesh", "faces", "labels")]
    inside = [f for f in files if isinstance(f, str) and "." in f and not Path(f).is_absolute()]
    return [f for f in inside if ".." not in Path(f).parts]


def _ordered(columns: Columns) -> Columns:
    """stop, location and, where it is known, time first, as people look for them."""
    first = [name for name in ("stop", "location", "time_s") if name in columns]
    return {n: columns[n] for n in first} | {n: v for n, v in columns.items() if n not in first}
