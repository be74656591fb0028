"""Turns of the LiDAR given to the stops in whose hold they were made, and written stop by stop."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from calib.intake.gather import finite_times
from calib.rig.suspect import listed
from chains.errors import InputError
from sensors.readers.base import Progress, Sweep, Sweeps
from sensors.recording import write_table

Share = list[tuple[Sweeps, np.ndarray]]
"""Of each `Sweeps`, the stop (S,) of every turn, -1 where it belongs to none."""


def by_time(sweeps: Sequence[Sweeps], spans_s: np.ndarray) -> tuple[Share, list[str]]:
    """Give turns to the holds (H, 2) s in which their middles lie; what looked odd.

    Raises:
        InputError: several LiDARs turned at the same time.
    """
    one_lidar(sweeps)
    share, odd = [], []
    for one in sweeps:
        stop = np.searchsorted(spans_s[:, 0], one.time_s, side="right") - 1
        within = (stop >= 0) & (one.time_s <= spans_s[np.maximum(stop, 0), 1])
        share.append((one, np.where(within, stop, -1)))
    counts = np.zeros(len(spans_s), int)
    for _, stop in share:
        counts += np.bincount(stop[stop >= 0], minlength=len(spans_s))
    if not counts.any():
        raise InputError(
            "no turn of the LiDAR falls into a hold; are the clocks right? --clock-offset "
            "NAME=SECONDS moves one"
        )
    if (counts == 0).any():
        odd.append(f"{np.count_nonzero(counts == 0)} of {len(counts)} holds have no LiDAR data")
    return share, odd


def by_name(sweeps: Sequence[Sweeps], stops: Sequence[str]) -> tuple[Share, list[str]]:
    """Give clouds without a clock, one file for a stop, to stops by name, or else in order.

    Raises:
        InputError: names do not match, and there are not as many files as stops.
    """
    names = [one.name for one in sweeps]
    if set(names) & set(stops):
        index = {name: k for k, name in enumerate(stops)}
        if strange := [name for name in names if name not in index]:
            raise InputError(
                f"cloud {strange[0]} is named after no stop, though others are; stops are "
                f"{', '.join(list(stops)[:3])} ..."
            )
        order, odd = [index[name] for name in names], []
    elif len(names) == len(stops):
        order = np.argsort(np.argsort(names)).tolist()
        odd = [f"{len(names)} clouds have no time; they are given to the stops in order of name"]
    else:
        raise InputError(
            f"{len(names)} clouds have no time, and there are {len(stops)} stops: name each file "
            f"after its stop ({', '.join(list(stops)[:3])} ...), or say --still or --min-hold so "
            "that there are as many holds as clouds"
        )
    return [(s, np.full(len(s.time_s), k)) for s, k in zip(sweeps, order, strict=True)], odd


def one_lidar(sweeps: Sequence[Sweeps]) -> None:
    """Refuse several LiDARs: logs of one follow each other.

    Raises:
        InputError: two turned at the same time; the flag is --topic.
    """
    if not finite_times(sweeps):
        return
    spans = sorted((s.time_s.min(), s.time_s.max(), s.name) for s in sweeps if len(s.time_s))
    for (_, end, a), (start, _, b) in itertools.pairwise(spans):
        if start < end:
            raise InputError(
                f"{a} and {b} are of two LiDARs at once; say --topic for the one wanted"
            )


def write(folder: Path, stops: Sequence[str], share: Share, progress: Progress) -> list[str]:
    """Write a scan for every stop that has points, each with the number of its turn in `scan`; what
    looked odd.

    Raises:
        InputError: no turn has any point, or as readers do while they decode.
    """
    folder.mkdir()
    total = sum(int((stop >= 0).sum()) for _, stop in share)

    def told() -> Iterator[tuple[int, Sweep]]:
        for done, each in enumerate(_in_turn(share)):
            progress("writing scans", done, total)
            yield each

    empty = [
        stops[k]
        for k, turns in itertools.groupby(told(), key=lambda each: each[0])
        if not _write_one(folder, stops[k], [sweep for _, sweep in turns])
    ]
    if empty and not any(folder.iterdir()):
        raise InputError(
            f"none of {total} turns of the LiDAR has a point: every return is missing, or nearer "
            "than it measures; is it the model that the packets say?"
        )
    return [f"stop {listed(empty)}: turns without any point, so no scan"] if empty else []


def _in_turn(share: Share) -> Iterator[tuple[int, Sweep]]:
    """Turns and their stops, stop by stop as long as each source is in order of time."""
    for one, stop in sorted(share, key=lambda entry: _first(entry[1])):
        wanted = stop >= 0
        yield from zip(stop[wanted].tolist(), one.read(wanted), strict=True)


def _first(stop: np.ndarray) -> int:
    return int(stop[stop >= 0].min(initial=np.iinfo(int).max))


def _write_one(folder: Path, stop: str, sweeps: Sequence[Sweep]) -> bool:
    """Write the turns of a stop; whether they have any point."""
    names = set.intersection(*(set(sweep.points) for sweep in sweeps))
    points = {
        name: np.concatenate([sweep.points[name] for sweep in sweeps])
        for name in sweeps[0].points if name in names
    }  # fmt: skip
    sizes = [len(sweep.points["x"]) for sweep in sweeps]
    if len(sweeps) > 1:
        points["scan"] = np.repeat(np.arange(len(sweeps), dtype=np.uint16), sizes)
    if len(points["x"]):
        write_table(folder / f"{stop}.parquet", points)
    return len(points["x"]) > 0
