"""Turns of the LiDAR given to the stops in whose hold they were made, and written stop by stop."""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path

import numpy as np

from calib import outputs
from calib.intake.gather import finite_times
from calib.rig.suspect import listed
from chains.errors import InputError
from sensors.readers.base import Progress, Sweep, Sweeps
from sensors.recording import table_bytes

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


def write(
    folder: Path, stops: Sequence[str], share: Share, kept: outputs.Kept, progress: Progress
) -> list[str]:
    """Write a scan for every stop that has points, each with the number of its turn in `scan`; what
    looked odd.

    Args:
        folder: to be made, for the scans.
        stops: their names.
        share: the turns of each.
        kept: the scans that an import had written before it was killed.
        progress: called with what is being done, and how far it is.

    Raises:
        InputError: no turn has any point, times of turns go back, or as readers do while they
            decode.
    """
    folder.mkdir()
    share = sorted(share, key=lambda entry: _first(entry[1]))
    every = [k for _, stop in share for k in stop[stop >= 0].tolist()]
    order, total = [k for k, _ in itertools.groupby(every)], len(every)
    if len(set(order)) < len(order):
        torn = stops[max(order, key=order.count)]
        raise InputError(
            f"turns of stop {torn} do not follow each other, so their times go back: was a clock "
            "set while the LiDAR was recorded?"
        )

    def work(some: Sequence[int]) -> Iterator[outputs.Finished]:
        lacking = {order[i] for i in some}
        done = total - sum(k in lacking for k in every)

        def told() -> Iterator[tuple[int, Sweep]]:
            for more, turn in enumerate(_in_turn(share, lacking)):
                progress("writing scans", done + more, total)
                yield turn

        for _, turns in itertools.groupby(told(), key=lambda turn: turn[0]):
            yield _scan([sweep for _, sweep in turns])

    empty = []
    for k, part in zip(order, kept.each("scans to write", len(order), work), strict=True):
        if part.told["points"]:
            part.put(folder / f"{stops[k]}.parquet")
        else:
            empty.append(stops[k])
    if empty and not any(folder.iterdir()):
        raise InputError(
            f"none of {total} turns of the LiDAR has a point: every return is missing, or nearer "
            "than it measures; is it the model that the packets say?"
        )
    return [f"stop {listed(empty)}: turns without any point, so no scan"] if empty else []


def _in_turn(share: Share, some: Collection[int]) -> Iterator[tuple[int, Sweep]]:
    """Turns of some stops, each with its stop, source after source."""
    for one, stop in share:
        wanted = np.isin(stop, list(some))
        if wanted.any():
            yield from zip(stop[wanted].tolist(), one.read(wanted), strict=True)


def _first(stop: np.ndarray) -> int:
    return int(stop[stop >= 0].min(initial=np.iinfo(int).max))


def _scan(sweeps: Sequence[Sweep]) -> outputs.Finished:
    """The turns of a stop as its file holds them, and whether they have any point."""
    names = set.intersection(*(set(sweep.points) for sweep in sweeps))
    points = {
        name: np.concatenate([sweep.points[name] for sweep in sweeps])
        for name in sweeps[0].points if name in names
    }  # fmt: skip
    sizes = [len(sweep.points["x"]) for sweep in sweeps]
    if len(sweeps) > 1:
        points["scan"] = np.repeat(np.arange(len(sweeps), dtype=np.uint16), sizes)
    there = len(points["x"]) > 0
    return {"points": there}, table_bytes(points) if there else b""
