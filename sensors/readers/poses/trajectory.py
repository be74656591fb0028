"""Trajectories: TUM's (t x y z qx qy qz qw) and EuRoC's (ns, x y z, qw qx qy qz; or a gyro's).

https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats,
https://projects.asl.ethz.ch/datasets/doku.php?id=kmavvisualinertialdatasets
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from chains.errors import InputError
from sensors.readers import conventions
from sensors.readers.base import Array, Contents, Options, Progress, Track, together
from sensors.readers.tables.sheets import LENGTHS, is_number, open_sheet, seconds
from sensors.stops import POSE

_GYRO = "w_RS_S_x"


def read_tum(files: Sequence[Path], options: Options, progress: Progress) -> Contents:
    """Read TUM trajectories, separated by blanks or commas; each file is a body.

    Raises:
        InputError: a line has no 8 numbers, or a quaternion is none.
    """
    return _each(files, options, progress, "x")


def read_euroc(files: Sequence[Path], options: Options, progress: Progress) -> Contents:
    """Read EuRoC's ground truth, each file a body, or its IMU's data, of which the gyro is taken.

    Raises:
        InputError: a line has too few numbers, or a quaternion is none.
    """
    return _each(files, options, progress, "w")


def _each(files: Sequence[Path], options: Options, progress: Progress, first: str) -> Contents:
    trajectories = []
    for i, path in enumerate(files):
        progress("reading trajectories", i, len(files))
        trajectories.append(_read(path, options, first))
    return together(trajectories)


def _read(path: Path, options: Options, first: str) -> Contents:
    sheet, head = open_sheet(path)
    title = next((line for line in head if line.strip()), "")
    number, line = next(sheet.lines(), (0, ""))
    cells = sheet.cells(line)
    skip = 0 if all(is_number(c, sheet.decimal_comma) for c in cells if c) else number
    gyro = _GYRO in title
    if "qw" in title or "q_RS_w" in title:  # a header says which part stands first
        first = (
            "w"
            if title.replace("q_RS_", "q").find("qw") < title.replace("q_RS_", "q").find("qx")
            else "x"
        )
    wanted = 4 if gyro else 8
    if len(cells) < wanted:
        raise InputError(
            f"{path}:{number}: {len(cells)} numbers in a line; a trajectory has 8: t, x y z and a "
            "quaternion"
        )
    table, odd = sheet.numbers(range(wanted), skip)
    if not len(table):
        raise InputError(f"{path} has no rows")
    time_s, said = seconds(table[:, 0], None)
    order = np.argsort(time_s, kind="stable")
    if (np.diff(order) < 0).any():
        odd = (*odd, f"{path.name}: times fall in places; rows are taken in the order of time")
    values = table[order, 1:]
    rate = _rate(time_s[order])
    if gyro:
        track = Track(
            name=path.stem,
            kind="gyro",
            clock=path.stem,
            time_s=time_s[order],
            names=("x", "y", "z"),
            values=values,
        )
        line = f"{path.name}: a gyro, {rate}, {said}, rad/s"
        return Contents(tracks=(track,), understood=(line,), odd=odd)
    pose, words = _pose(path, values, first, options)
    track = Track(
        name=path.stem, kind="pose", clock=path.stem, time_s=time_s[order], names=POSE, values=pose
    )
    line = f"{path.name}: body {path.stem}, {rate}, {said}, {words}"
    return Contents(tracks=(track,), understood=(line,), odd=odd)


def _pose(path: Path, values: Array, first: str, options: Options) -> tuple[Array, str]:
    unit = options.length_unit or "m"
    conventions.check_metres(str(path), values[:, :3], options.length_unit)
    pose = conventions.poses(str(path), values[:, :3] * LENGTHS[unit], values[:, 3:], first)
    words = f"{unit}, quaternions with {'w first' if first == 'w' else 'w last'}"
    if options.up == "y":
        return conventions.z_up(pose), f"{words}, turned from y up to z up"
    return pose, words


def _rate(time_s: Array) -> str:
    span = float(np.ptp(time_s))
    rows = f"{len(time_s):,} rows"
    return f"{rows} at {(len(time_s) - 1) / span:.3g} Hz over {span:.0f} s" if span else rows
