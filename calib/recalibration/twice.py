"""Data that would count twice: in one recording or two, or in what is known beforehand too."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from itertools import combinations
from pathlib import Path

import numpy as np

from calib.problem.model import Source
from calib.rig.inventory import copied, poses_of
from calib.rig.suspect import listed
from chains.errors import InputError

# Of rows of joints and poses that are the same: a choice, as rounded numbers may once agree.
COINCIDENCES = 1


def refuse_given_twice(recordings: Sequence[Path]) -> None:
    """Raise InputError for a folder that is given twice."""
    for recording in recordings:
        if recordings.count(recording) > 1:
            raise InputError(f"{recording} is given twice; as data it counts once")


def all_once(
    sources: Sequence[Source],
    scans: Sequence[Mapping[str, str]],
    known: Sequence[str],
    prior: Path | str | None,
) -> list[str]:
    """Digests (hex) of all that an estimate rests on, each of which counts once. Targets that
    several recordings have may be among them: `build` and `Problem.resting_on` see to these.

    Args:
        sources: the recordings, without what is left out.
        scans: of each, stop -> digest of the file of its scan.
        known: what the estimate of the earlier run rests on that is its prior.
        prior: where that run is, if there is one.

    Raises:
        InputError: a recording holds a stop twice, recordings have measurements in common, or that
            run knows some of them.
    """
    found = [_measured(source, each) for source, each in zip(sources, scans, strict=True)]
    for source, mine in zip(sources, found, strict=True):
        pairs = copied(source.recording, unseen=True)
        copies = [stop for stop, of in pairs.items() if stop in mine and mine[stop] == mine.get(of)]
        has_scan = dict(zip(source.recording.stops, source.recording.has_scan, strict=True))
        if len(copies) > COINCIDENCES or any(has_scan[stop] for stop in copies):
            raise InputError(
                f"{source.recording.folder / 'stops.csv'}: {listed(copies)} repeat other stops "
                f"({copies[0]} is {pairs[copies[0]]} again), to every digit of what was "
                "measured; as data they count once, so remove the rows that are copies"
            )
    for (one, mine), (other, theirs) in combinations(zip(sources, found, strict=True), 2):
        if same := _among(mine, theirs.values()):
            raise InputError(
                f"{one.recording.folder} and {other.recording.folder} hold the same measurements: "
                f"{listed(same)}; as data they count once, so give one recording, or leave these "
                "stops out of one"
            )
    for source, mine in zip(sources, found, strict=True):
        if same := _among(mine, known):
            raise InputError(
                f"--prior {prior}: its estimate, or that of its own prior, rests on "
                f"{listed(same)} of {source.recording.folder} already, and data count once; fit "
                f"without --prior or, for another model of these data, 'rigcal add {prior} EFFECT'"
            )
    targets = (digest for source in sources for digest in source.counted_targets)
    return sorted({*known, *targets, *(digest for each in found for digest in each.values())})


def _measured(source: Source, scans: Mapping[str, str]) -> dict[str, str]:
    """Stop -> a digest of what was measured there: of the file of its scan or, where it has none
    and a body was seen, of its row of joints and poses."""
    stops, out = source.recording, {}
    poses = poses_of(stops)
    rows, seen = np.hstack([stops.joints, poses]), np.isfinite(poses).any(axis=1)
    for k, name in enumerate(stops.stops):
        if stops.has_scan[k]:
            out[name] = scans[name]
        elif seen[k]:
            out[name] = hashlib.sha256(rows[k].tobytes()).hexdigest()
    return out


def _among(mine: Mapping[str, str], known: Iterable[str]) -> list[str]:
    """The stops of which something is known."""
    known = set(known)
    return [stop for stop, digest in mine.items() if digest in known]
