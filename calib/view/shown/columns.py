"""The beams of a stop or of several, with all that is known of each: what its point says, what its
stop says, what a fit without its stop left of its range, and what another run left."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np

from calib.effects.own.expression import ALIASES, Expression
from calib.runs.run import Run
from calib.view.scene import MOST_POINTS, Points, Scene
from sensors.documents import nearest

HELD_OUT, LESS_FITTED = "held_out_m", "held_out_less_fitted_m"
OTHER, DIFFERENCE = "other_m", "difference_m"
OTHER_HELD_OUT, HELD_OUT_DIFFERENCE = "other_held_out_m", "held_out_difference_m"
COMPARED_COLUMNS = (HELD_OUT, LESS_FITTED, OTHER, DIFFERENCE, OTHER_HELD_OUT, HELD_OUT_DIFFERENCE)
STOP, LOCATION = "stop", "location"
AS_IN_CAD = "as in CAD"  # in the place of another run
UNITS = ("_m", "_rad", "_s", "_c")  # what a column's name may be written without
_BEAM = ("ring", "column", "scan", "azimuth_rad", "elevation_rad")  # the same in every run
_ODD = np.uint64(0x9E3779B97F4A7C15)  # 2**64 over the golden ratio: Knuth's multiplicative hashing


def comparable(run: Run, other: Run) -> bool:
    """Whether two runs were fitted to the same recordings, in one order."""
    a, b = ([each["sha256"] for each in r.model["recordings"]] for r in (run, other))
    return a == b


def gathered(
    scene: Scene,
    recording: int,
    stops: Sequence[str],
    other: Run | Literal["as in CAD"] | None = None,
    most: int = MOST_POINTS,
) -> Points | None:
    """The beams of these stops; None where none of them was scanned.

    Of several stops, every so many beams of each, so that there are `most` at most. Columns of the
    stops are among the columns: `stop`, its number from 1, and `location`, numbered from 0, too.

    Args:
        scene: of the run.
        recording: its number.
        stops: by name.
        other: a run of the same recordings, or `AS_IN_CAD`, for `OTHER`, its residual of each beam,
            and `DIFFERENCE`, by how much this run's is larger; NaN where it has not that beam.
        most: beams.

    Raises:
        InputError: a table is gone, or of another version.
    """
    parts = []
    for stop in stops:
        points = scene.points(recording, stop)
        if points is not None:
            many = 1 if len(stops) == 1 else max(1, -(-len(points.xyz_m) * len(stops) // most))
            rows = slice(None, None, many)
            columns = dict(points.columns)
            columns |= _compared(scene, recording, stop, columns, other)
            columns = {name: values[rows] for name, values in columns.items()}
            columns |= _of_stop(scene, recording, stop, columns)
            parts.append(Points(points.xyz_m[rows], points.eye_m, columns, len(points.xyz_m)))
    return _together(parts) if parts else None


def location_names(scene: Scene, recording: int) -> dict[int, str]:
    """Number of a location -> its name."""
    names = np.unique(scene.sources[recording].recording.location)
    return {i: str(name) for i, name in enumerate(names)}


def kept(points: Points, text: str) -> np.ndarray:
    """Which beams (N,) a formula is not 0 for; all where there is none.

    Raises:
        InputError: it is no formula, or looks at what there is not.
    """
    if not text.strip():
        return np.ones(len(points.xyz_m), bool)
    value = value_of(points, Expression(text, "'Only where'"))
    return np.isfinite(value) & (value != 0)


def value_of(points: Points, expression: Expression) -> np.ndarray:
    """A formula's value (N,) at beams; units of columns need not be written.

    Raises:
        InputError: it looks at what there is not.
    """

    def column(name: str) -> np.ndarray:
        found = next((n for n in (name, *(name + u for u in UNITS)) if n in points.columns), None)
        if found is None:
            shown = {full: short for short, full in ALIASES.items()}
            known = [shown.get(n, n.removesuffix("_m")) for n in points.columns]
            raise expression.wrong(f"there is no column {name} here{nearest(name, known)}")
        return points.columns[found].astype(float)

    return np.broadcast_to(expression.value(column), len(points.xyz_m))


def _of_stop(
    scene: Scene, recording: int, stop: str, known: Mapping[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """What is known of the stop, at each of its beams; what is known of those, they know better."""
    source, count = scene.sources[recording], len(known["ring"])
    k = source.recording.stops.index(stop)
    at = np.unique(source.recording.location, return_inverse=True)[1][k]
    values = {STOP: k + 1, LOCATION: at} | {
        name: column[k]
        for name, column in source.columns.items()
        if column.ndim == 1 and column.dtype.kind in "biuf" and name not in known
    }
    return {name: np.full(count, value) for name, value in values.items()}


def _compared(
    scene: Scene,
    recording: int,
    stop: str,
    columns: Mapping[str, np.ndarray],
    other: Run | str | None,
) -> dict[str, np.ndarray]:
    """Residuals of the same beams held out and in another run, and their differences."""
    seen, at = columns["residual_m"].astype(float), (recording, stop)
    unseen = _of_same(columns, scene.table(*at, scene.run, unseen=True))
    out = {HELD_OUT: unseen, LESS_FITTED: unseen - seen}
    if other == AS_IN_CAD:
        there = _of_same(columns, scene.nominal(*at))
        return out | {OTHER: there, DIFFERENCE: seen - there}
    if other is not None:
        there, held_out = (_of_same(columns, scene.table(*at, other, u)) for u in (False, True))
        out |= {OTHER: there, DIFFERENCE: seen - there}
        out |= {OTHER_HELD_OUT: held_out, HELD_OUT_DIFFERENCE: unseen - held_out}
    return out


def _of_same(
    columns: Mapping[str, np.ndarray], other: Mapping[str, np.ndarray] | None
) -> np.ndarray:
    """Residuals (N,) of the same beams in another table; NaN throughout where there is none."""
    there = np.full(len(columns["ring"]), np.nan)
    if other is not None and len(other["ring"]):
        names = [name for name in _BEAM if name in columns and name in other]
        mine, theirs = (_keys([table[name] for name in names]) for table in (columns, other))
        distinct, first, count = np.unique(theirs, return_index=True, return_counts=True)
        at = np.searchsorted(distinct, mine)
        at[at == len(distinct)] = 0
        # Two beams that nothing tells apart are left out.
        same = np.flatnonzero((distinct[at] == mine) & (count[at] == 1))
        there[same] = other["residual_m"][first[at[same]]]
    return there


def _keys(columns: Sequence[np.ndarray]) -> np.ndarray:
    """A number (N,) for each row, by the bits of its columns: two rows share one by a chance of
    1 in 2**64."""
    keys = np.zeros(len(columns[0]), np.uint64)
    for column in columns:
        bits = column.astype(np.float32).view(np.uint32).astype(np.uint64)
        keys = (keys ^ bits) * _ODD
        keys ^= keys >> np.uint64(32)
    return keys


def _together(parts: Sequence[Points]) -> Points:
    names = [n for n in parts[0].columns if all(n in part.columns for part in parts)]
    columns = {name: np.concatenate([part.columns[name] for part in parts]) for name in names}
    xyz_m = np.concatenate([part.xyz_m for part in parts])
    return Points(xyz_m, parts[0].eye_m, columns, sum(part.measured for part in parts))
