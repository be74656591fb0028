"""Data that would count twice: in two recordings, or in one and in what is known beforehand."""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Mapping, Sequence
from itertools import combinations
from pathlib import Path

import numpy as np

from calib.problem.model import Source
from calib.rig.suspect import listed
from chains import remote
from chains.errors import InputError


def refuse_given_twice(recordings: Sequence[Path]) -> None:
    """Refuse a folder that is given twice."""
    for recording in recordings:
        if recordings.count(recording) > 1:
            raise InputError(f"{recording} is given twice; as data it counts once")


def refuse_copies(sources: Sequence[Source]) -> None:
    """Refuse recordings of a fit that have stops in common."""
    for one, other in combinations(sources, 2):
        if same := _in_common(one, other):
            raise InputError(
                f"{one.recording.folder} and {other.recording.folder} hold the same: scans or "
                f"rows of {listed(same)}; as data they count once, so give one of them, or leave "
                "these stops out of one"
            )


def refuse_known(sources: Sequence[Source], earlier: Mapping[Path, Sequence[Source]]) -> None:
    """Refuse recordings whose stops an earlier run was fitted to.

    Args:
        sources: the recordings.
        earlier: that run, and all that it knew before, each with its recordings.
    """
    for run, of_run in earlier.items():
        for source, known in ((s, k) for s in sources for k in of_run):
            if same := _in_common(source, known):
                raise InputError(
                    f"--prior: {run} was fitted to {listed(same)} of {source.recording.folder} as "
                    "well, and data count once; fit without --prior, or, for another model of the "
                    f"same data, use 'rigcal add {run} EFFECT'"
                )


def _in_common(one: Source, other: Source) -> list[str]:
    """The stops of a recording that the other holds too, by whatever name."""
    theirs = _by_size(other)
    mine = {size: paths for size, paths in _by_size(one).items() if size in theirs}
    known = {_contents(path) for size in mine for path in theirs[size].values()}
    same = {n for paths in mine.values() for n, path in paths.items() if _contents(path) in known}
    if not (one.rig.lidar or other.rig.lidar):
        rows = set(_rows(other).values())
        same = {stop for stop, row in _rows(one).items() if row in rows}
    return [stop for stop in one.recording.stops if stop in same]


def _by_size(source: Source) -> dict[int, dict[str, Path]]:
    """Size of a file -> the stops whose scans have it, and where these are."""
    out: dict[int, dict[str, Path]] = defaultdict(dict)
    stops = set(source.recording.stops)
    for path in remote.files(source.recording.folder, "scans/*.parquet"):
        if path.stem in stops:
            out[remote.size(path)][path.stem] = path
    return out


def _contents(path: Path) -> bytes:
    with open(remote.fetched(path), "rb") as file:
        return hashlib.file_digest(file, "sha256").digest()


def _rows(source: Source) -> dict[str, bytes]:
    """What was measured at each stop, beside its scan."""
    stops = source.recording
    columns = np.hstack([stops.joints, *stops.bodies.values()])
    return {name: row.tobytes() for name, row in zip(stops.stops, columns, strict=True)}
