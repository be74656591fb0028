"""Parts of a mesh of which it cannot be judged whether they are where the mesh has them.

Beams that pass the edge of a narrow part by a millimetre meet it by what the mesh says, and
something else in the room. Where these are more than half, the others are no sample of the part.
Of a few beams all may end before it. And a part that most of all beams meet is what all else is
held against: nothing contradicts it.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from functools import partial

import numpy as np

from calib.effects.basis import place_of
from calib.linear.parallel import over_stops
from calib.residuals.beams import Association
from calib.residuals.groups import Group, kind_and_number
from calib.residuals.scan import ScanStop
from calib.solve.estimate import Estimate

KEPT_BEAMS = 0.5  # of those that meet a part: with fewer, their median is of something else
# Beams of a scan that meet a part, on average of those that do: with fewer, none has others on both
# sides, and all may be at its edges.
INSIDE_BEAMS = 3.0
# Beams that a fit must keep on a part to judge it: where people hide 40 % of the walls, about one
# beam in 250 ends by chance just before what it should meet. One or two such made sound patches, of
# two and six beams, 9 and 5 mm off at five sigmas. Three such of five would be one in a million.
FEWEST_KEPT = 5
MOST_OF_ALL = 0.5  # of the beams in a room: if more meet a part, no majority contradicts it
Numbers = Mapping[str, np.ndarray]
"""Kind of part -> the numbers (n,) of some parts, ascending."""


def unjudged(estimate: Estimate, parts: Collection[Group]) -> set[Group]:
    """Those of some parts of the mesh that are narrow, and of whose beams a fit rejects most; and
    those that most of all beams in their room meet, or next to none that it keeps."""
    if not parts:
        return set()
    groups = {kind_and_number(group.what): group for group in parts}
    kinds = {kind for kind, _ in groups}
    numbers = {kind: np.array(sorted(n for k, n in groups if k == kind)) for kind in kinds}
    work = partial(_counted, estimate.values, numbers)
    rooms = {scan.room: {} for scan in estimate.scans}
    found = over_stops(work, estimate.scans, estimate.associations)
    for scan, of_scan in zip(estimate.scans, found, strict=True):
        of_room = rooms[scan.room]
        for kind, count in of_scan.items():
            of_room[kind] = of_room.get(kind, 0) + count
    judged: dict[Group, list[bool]] = {}
    for counts in rooms.values():
        for kind, some in numbers.items():
            for number, each in zip(some.tolist(), counts[kind].T.tolist(), strict=True):
                if each[0]:
                    judged.setdefault(groups[kind, number], []).append(_is_judged(*each))
    return {group for group, in_rooms in judged.items() if not any(in_rooms)}


def _is_judged(scans: int, every: int, met: int, kept: int) -> bool:
    """Of a part, in how many scans it is met, how many beams these and all others of its room have,
    how many meet it, and how many of them a fit keeps."""
    narrow = kept < KEPT_BEAMS * met and met < INSIDE_BEAMS * scans
    return not narrow and kept >= FEWEST_KEPT and met <= MOST_OF_ALL * every


def _counted(
    values: Mapping[str, np.ndarray], numbers: Numbers, scan: ScanStop, association: Association
) -> dict[str, np.ndarray]:
    """Of each part (4, n), whether any beam of a scan meets it, how many beams the scan has, how
    many of them meet it, and how many of these have any weight."""
    rows, counts = scan.rows(values, association), {}
    for kind, some in numbers.items():
        at = place_of(scan.parts(association, kind), some)
        beams = (at[which & (at >= 0)] for which in (rows.usable, rows.weight > 0))
        met, kept = (np.bincount(each, minlength=len(some)) for each in beams)
        every = np.full(len(some), np.count_nonzero(rows.usable))
        counts[kind] = np.stack([met > 0, every, met, kept])
    return counts
