"""The table of stops: what every log says during a hold, as one row."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from chains.se3 import Array
from sensors.readers.base import Columns, Track
from sensors.stops import POSE

BASE_MOVED_M, BASE_MOVED_RAD = 0.05, 0.05  # how far the base moves between locations at least
CREEP = 0.002  # rad or m from the beginning of a hold to its end


def table(tracks: Sequence[Track], spans_s: Array) -> tuple[Columns, list[str]]:
    """The stops of holds (H, 2) s, columns as stops.csv has them, and what looked odd.

    Joints, points and covariates are means, rotations chordal means, over what was seen; a
    covariate logged so slowly that a hold has none of it is interpolated.
    """
    columns: Columns = {
        "stop": np.array([f"s{k:03d}" for k in range(len(spans_s))]),
        "time_s": spans_s.mean(axis=1),
    }
    odd = []
    for track in (t for t in tracks if t.kind != "gyro"):
        means = np.array([_mean(track, *span) for span in spans_s])
        prefix = f"{track.name}." if track.kind in ("pose", "point") else ""
        for name, values in zip(track.names, means.T, strict=True):
            column = prefix + name
            if column in columns and track.kind == "covariate":
                column = f"{track.name.strip('/').replace('/', '_')}.{name}"
                odd.append(f"{name} is logged twice; that of {track.name} is named {column}")
            columns.setdefault(column, values)
        if track.kind in ("joints", "pose", "point"):
            crept = np.array([_crept(track, *span) for span in spans_s]) > CREEP
            if crept.any():
                names = ", ".join(columns["stop"][crept][:3])
                odd.append(
                    f"{track.name} creeps by more than {1e3 * CREEP:g} mrad or mm during "
                    f"{crept.sum()} holds ({names}); is --still too large?"
                )
    return columns, odd


def _within(track: Track, start_s: float, end_s: float) -> Array:
    """The rows of a log within a period."""
    low, high = np.searchsorted(track.time_s, [start_s, end_s])
    return track.values[low : max(high, low)]


def _mean(track: Track, start_s: float, end_s: float) -> Array:
    rows = _within(track, start_s, end_s)
    if track.kind == "covariate":
        return np.array(
            [_slow(track, k, column, start_s, end_s) for k, column in enumerate(rows.T)]
        )
    rows = rows[np.isfinite(rows).all(axis=1)]
    if not len(rows):
        return np.full(len(track.names), np.nan)
    mean = rows.mean(axis=0)
    if track.names == POSE:
        mean[3:] = (
            Rotation.from_quat(rows[:, 3:], scalar_first=True)
            .mean()
            .as_quat(scalar_first=True, canonical=True)
        )
    return mean


def _slow(track: Track, k: int, column: Array, start_s: float, end_s: float) -> float:
    """Mean of a covariate, or its value between two that stand far apart."""
    if np.isfinite(column).any():
        return float(np.nanmean(column))
    known = np.isfinite(track.values[:, k])
    middle = (start_s + end_s) / 2
    if not known.any():
        return np.nan
    return float(np.interp(middle, track.time_s[known], track.values[known, k]))


def _crept(track: Track, start_s: float, end_s: float) -> float:
    """By how much the mean of a hold's last third differs from that of its first."""
    third = (end_s - start_s) / 3
    first, last = _mean(track, start_s, start_s + third), _mean(track, end_s - third, end_s)
    if track.names == POSE:
        last[3:] *= np.sign(first[3:] @ last[3:])
        first[3:], last[3:] = 2 * first[3:], 2 * last[3:]
    change = np.abs(last - first)
    return float(change.max()) if np.isfinite(change).all() else 0.0


def locations(columns: Columns, base: str | None, blocks: int | None) -> tuple[Columns, str]:
    """The stops with a column `location`, and how they got it.

    As their files say; or else as many equal `blocks` as wanted in the order of time, or of rows
    where no time is known; or else where the tracked `base` stood, a new location where it is
    5 cm or 50 mrad from the others.
    """
    count = len(columns["stop"])
    if blocks:
        at = blocks * np.arange(count) // count
        order = "time" if "time_s" in columns else "rows"
        words = f"{min(blocks, count)} blocks in the order of {order}"
    elif "location" in columns:
        return columns, "as the table says"
    elif base is not None and f"{base}.qw" in columns:
        at = _places(np.stack([columns[f"{base}.{part}"] for part in POSE], axis=1))
        words = f"{at.max() + 1} places where {base} stood"
    else:
        at, words = np.zeros(count, int), "one: nothing says that the base moved"
    return columns | {"location": np.array([f"L{k:02d}" for k in at])}, words


def _places(pose: Array) -> Array:
    """Number (K,) of the place at which each pose (K, 7) is; where not seen, that before it."""
    places: list[Array] = []
    location = np.zeros(len(pose), int)
    for k, row in enumerate(pose):
        if not np.isfinite(row).all():
            location[k] = location[k - 1] if k else 0
            continue
        near = [
            np.linalg.norm(row[:3] - at[:3]) < BASE_MOVED_M
            and 2 * np.arccos(min(1.0, abs(row[3:] @ at[3:]))) < BASE_MOVED_RAD
            for at in places
        ]
        if not any(near):
            places.append(row)
            near.append(True)
        location[k] = near.index(True)
    return location
