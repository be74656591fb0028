"""What foreign files say before it is cut into stops, and the interface of every reader.

A reader turns files of one kind into their `Contents`: logs against a clock (`Track`), turns of the
LiDAR (`Sweeps`), rows that are stops already, an arm, a surface, sphere centres. It converts to SI
units, z up and rings from 0, says what it understood and what looked odd, and raises InputError
where something essential is ambiguous, naming the flag that decides it. What is cut into stops,
brought onto one clock and written as a recording is no reader's business.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Columns = dict[str, np.ndarray]
Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Track:
    """Numbers logged against a clock.

    Args:
        name: the body, or where the log comes from: a topic or a file.
        kind: "pose" has the columns of `sensors.stops.POSE`, T_world_body in m and unit
            quaternions; "point" has x y z in m; "joints" one per joint, rad or m; "gyro" x y z in
            rad/s; "covariate" anything else.
        clock: what counted the seconds; tracks of one clock share its name.
        time_s: (N,) s, not falling.
        names: (C,) the columns.
        values: (N, C); NaN = not seen.
    """

    name: str
    kind: Literal["pose", "point", "joints", "gyro", "covariate"]
    clock: str
    time_s: Array
    names: tuple[str, ...]
    values: Array


@dataclass(frozen=True)
class Sweep:
    """One turn of a LiDAR.

    Args:
        time_s: its middle; NaN where its file has no clock.
        points: columns (N,) as a scan file holds them: x y z (float32, m, the LiDAR's frame),
            ring and column (uint16, from 0), intensity and other covariates of points (float32).
    """

    time_s: float
    points: Columns


@dataclass(frozen=True)
class Sweeps:
    """The turns of one LiDAR in the order of time, decoded only when asked for.

    Args:
        name: the topic or the file's stem; names the stop where the file is one.
        clock: as of a `Track`.
        time_s: (S,) middle of each turn; NaN where the file has no clock: then it is one stop.
        read: given which are wanted (S,) bool, yields those, one in memory at a time.
        lost: share of its packets that are missing.
    """

    name: str
    clock: str
    time_s: Array
    read: Callable[[NDArray[np.bool_]], Iterator[Sweep]]
    lost: float = 0.0


@dataclass(frozen=True)
class ArmDescription:
    """An arm: the text of a URDF, and the links between which it moves (None = not known).

    It may end at more than the first tip: at ``others``, too.
    """

    urdf: str
    base: str | None = None
    tip: str | None = None
    others: tuple[str, ...] = ()


@dataclass(frozen=True)
class ScannedSurface:
    """A scanned surface in the scanner's frame.

    Args:
        vertices_m: (V, 3).
        triangles: (F, 3) indices.
        label: (F,) uint16, or None.
        intensity: (F,) or None.
        names: label -> name.
    """

    vertices_m: Array
    triangles: NDArray[np.int64]
    label: NDArray[np.uint16] | None = None
    intensity: Array | None = None
    names: Mapping[int, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Spheres:
    """Centres (M, 3) m of calibration spheres in the scanner's frame, by name."""

    names: tuple[str, ...]
    centre_m: Array


@dataclass(frozen=True)
class Contents:
    """What the files of one kind hold.

    Args:
        tracks: logs against a clock.
        sweeps: one for each LiDAR and clock; of files without a clock, one for each file.
        stops: rows that are stops already: the columns of stops.csv, by name.
        lidar: what rig.yaml should say of the LiDAR: `model` where it is known, fields to override.
        arm: an arm's description.
        surface: the scanned room.
        spheres: centres of the calibration spheres.
        understood: what the files hold, a line each: frames, units, counts, rates.
        odd: what looked odd, a sentence each.
    """

    tracks: tuple[Track, ...] = ()
    sweeps: tuple[Sweeps, ...] = ()
    stops: Columns | None = None
    lidar: Mapping[str, Any] | None = None
    arm: ArmDescription | None = None
    surface: ScannedSurface | None = None
    spheres: Spheres | None = None
    understood: tuple[str, ...] = ()
    odd: tuple[str, ...] = ()


@dataclass(frozen=True)
class Options:
    """What a user decided by flags of ``rigcal import``; a reader finds out whatever is None.

    Args:
        topics: names of topics or streams to take; empty = all that are of use.
        columns: our name of a column -> the file's, for files whose columns are anyone's.
        bodies: the file's name of a tracked body -> its frame in rig.yaml.
        length_unit: "m", "cm" or "mm".
        angle_unit: "rad" or "deg".
        up: the file's axis that points up: "y" or "z".
        first_ring: the number of the first ring in the file, 0 or 1.
        rings_from_elevation: whether rings may be inferred from the elevation of the points.
        lidar: a model of the catalogue.
        metadata: the sensor's own file: Ouster's JSON, Hesai's table of angles.
        base: the arm's first link; tip: its last.
        euler: the order of a table's Euler angles, as scipy writes it: "XYZ" turns about the moved
            axes, "xyz" about the fixed ones.
        rows: whether rows of a table are "stops" or a "log".
        packages: ROS package -> its folder, for xacro files.
        dh: the convention of a table of Denavit and Hartenberg: "standard" or "modified".
        sphere_radius_m: the radius of calibration spheres, to find them in clouds of more.
        joints: joint of the arm -> "revolute" or "prismatic"; no flag, but what the arm's own
            source says, which is read before all others.
    """

    topics: tuple[str, ...] = ()
    columns: Mapping[str, str] = field(default_factory=dict)
    bodies: Mapping[str, str] = field(default_factory=dict)
    length_unit: str | None = None
    angle_unit: str | None = None
    up: str | None = None
    first_ring: int | None = None
    rings_from_elevation: bool = False
    lidar: str | None = None
    metadata: Path | None = None
    base: str | None = None
    tip: str | None = None
    euler: str | None = None
    rows: str | None = None
    packages: Mapping[str, Path] = field(default_factory=dict)
    dh: str | None = None
    sphere_radius_m: float | None = None
    joints: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Reader:
    """How files of one kind are read.

    Args:
        kind: its name on the command line.
        reads: what it reads, in a line for ``rigcal import --help``.
        read: files, options and progress in, what they hold out.
        extra: the optional part of rigcal that brings its library: ``pip install 'rigcal[extra]'``.
    """

    kind: str
    reads: str
    read: Callable[[Sequence[Path], Options, Progress], Contents]
    extra: str | None = None


def together(files: Sequence[Contents]) -> Contents:
    """What the files of one source hold, as one; of the LiDAR, what the first says."""
    return Contents(
        tracks=tuple(track for file in files for track in file.tracks),
        sweeps=tuple(sweeps for file in files for sweeps in file.sweeps),
        lidar=next((file.lidar for file in files if file.lidar is not None), None),
        understood=tuple(line for file in files for line in file.understood),
        odd=tuple(dict.fromkeys(line for file in files for line in file.odd)),
    )
