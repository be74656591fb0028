"""Parts of the mesh that stand elsewhere, at all stops or at some.

Where a wall stands 100 mm from where it was scanned, or a cupboard was moved on the third day, all
beams on it are rejected, and their residuals are as far from each other as their incidences: no
error along the beam explains them. Along the normal they agree. What merely stands in front of a
part leaves some of it to be seen, or is no plane along it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from calib.blunders import told
from calib.blunders.chance import LEAST_P
from calib.diagnosis.rejects.counts import Counts
from calib.diagnosis.rejects.rejected import AGREES, Rejected
from calib.problem.model import Source
from calib.residuals.groups import ALONG_NORMAL, REGION_PART, SURFACE, part_of_mesh
from calib.rig.suspect import listed

# Share of a part's beams at a stop that end elsewhere, from which the part itself does. A box on
# the floor hid up to 78 % of a region at a stop, and its top is as flat as the floor; somebody hid
# all of a region, at all distances.
WHOLE_SHARE = 0.9
FEWEST_MET = 20  # of a part at a stop: with fewer, mixed pixels at edges are all there is
NO_PART = "-1"  # as beams that meet no part are counted
MOST_NAMED = 6  # stops or parts that a sentence names
FEWEST_MOVED = 2  # stops: at one alone, something flat may stand in front


@dataclass(frozen=True)
class MovedPart:
    """A part of the mesh that stands elsewhere.

    Args:
        part: as of `part_of_mesh`.
        stops: at which; none where at all that see it. since: whether at all from the first on.
        away_m: how much farther than the mesh; sigma_m: of that.
        along: the beams, or the normal.
        rejected: share of all beams that is rejected there.
    """

    part: str
    stops: tuple[str, ...]
    since: bool
    away_m: float
    sigma_m: float
    along: str
    rejected: float

    @property
    def when(self) -> str:
        """In words; empty if at all stops."""
        at = f"at stop {listed(self.stops, MOST_NAMED)}" if self.stops else ""
        return f"from stop {self.stops[0]} on" if self.since else at

    def blunder(self, sources: Sequence[Source]) -> dict[str, Any]:
        """As a blunder in diagnosis.json."""
        off = told.Elsewhere(self.away_m, self.sigma_m, self.along, self.when)
        return told.of_part(self.part, sources, off, LEAST_P)

    def document(self) -> dict[str, Any]:
        """As in diagnosis.json."""
        return {
            "part": self.part,
            "stops": list(self.stops),
            "away_mm": 1e3 * self.away_m,
            "sigma_mm": 1e3 * self.sigma_m,
            "along": self.along,
            "share": self.rejected,
        }


def moved(counts: Counts, left: np.ndarray) -> list[tuple[MovedPart, np.ndarray]]:
    """Parts of the mesh that stand elsewhere, and which of the rejected (R,) that explains. Regions
    of a surface that moved as it did belong to it.

    Args:
        counts: the beams.
        left: (R,) the rejected that nothing explains yet.
    """
    if not counts.place_names:  # planes found in the scans are where these have them
        return []
    found: list[_Found] = []
    rejected, left = counts.rejected, left.copy()
    kinds = (
        (SURFACE, rejected.surface, counts.met, counts.surface_names),
        (REGION_PART, rejected.place, counts.met_places, counts.place_names),
    )
    for kind, part, met, names in kinds:
        ends = np.zeros(met.shape, int)  # how many of its beams end elsewhere
        np.add.at(ends, (rejected.stop[left], part[left]), 1)
        whole = (met >= FEWEST_MET) & (ends > WHOLE_SHARE * met)
        whole &= [name != NO_PART for name in names]
        for p in np.flatnonzero(whole.any(axis=0)):
            mine = left & (part == p) & whole[rejected.stop, p]
            for some, along in _agreeing(rejected, mine):
                here = _Found(kind, int(p), along, some)
                if not any(each.takes(here, rejected) for each in found):
                    found.append(here)
                left &= ~some
    found = [each for each in found if len(np.unique(rejected.stop[each.some])) >= FEWEST_MOVED]
    return [(each.told(counts), each.some) for each in found]


@dataclass
class _Found:
    """Rejected beams (R,) `some` of the part `number` of a kind that agree on another place."""

    kind: str
    number: int
    along: str
    some: np.ndarray

    def takes(self, other: _Found, rejected: Rejected) -> bool:
        """Take in what is of a region of this surface that stands where it does; whether it is."""
        if self.kind != SURFACE or other.kind == SURFACE:
            return False
        here, there = rejected[self.some], rejected[other.some]
        away_m = np.median(here.along(ALONG_NORMAL).residual_m)
        off_m = np.abs(there.along(ALONG_NORMAL).residual_m - away_m)
        mine = (there.surface == self.number) & (off_m < there.along(ALONG_NORMAL).reach_m)
        if mine.mean() <= AGREES:
            return False
        self.some = self.some | other.some
        return True

    def told(self, counts: Counts) -> MovedPart:
        """As people are told."""
        surface = self.kind == SURFACE
        met = (counts.met if surface else counts.met_places)[:, self.number]
        names = counts.surface_names if surface else counts.place_names
        stops = np.unique(counts.rejected.stop[self.some])
        others = np.setdiff1d(np.flatnonzero(met >= FEWEST_MET), stops)
        stops = stops[np.argsort(counts.rank[stops], kind="stable")]
        since = np.min(counts.rank[stops]) > np.max(counts.rank[others], initial=-1.0)
        here = counts.rejected[self.some].along(self.along)
        return MovedPart(
            part=part_of_mesh(self.kind, names[self.number]),
            stops=tuple(counts.stop_names[i] for i in stops) if len(others) else (),
            since=bool(len(others) and since),
            away_m=float(np.median(here.residual_m)),
            sigma_m=here.sigma_m,
            along=self.along,
            rejected=float(self.some.sum() / counts.met.sum()),
        )


def _agreeing(rejected: Rejected, mine: np.ndarray) -> Iterator[tuple[np.ndarray, str]]:
    """Of some rejected beams (R,) of one part those of stops at which it stands in one place, for
    each such place; and whether they agree along the beams or along the normal."""
    along = rejected[mine].steadier
    by = rejected[mine].along(along)
    of_stop = {stop: by[by.stop == stop] for stop in np.unique(by.stop)}
    at_m = {stop: np.median(here.residual_m) for stop, here in of_stop.items() if here.coherent}
    reach_m = np.median(by.reach_m)
    while at_m:
        near = max(
            ([s for s, m in at_m.items() if abs(m - here) <= reach_m] for here in at_m.values()),
            key=len,
        )
        yield mine & np.isin(rejected.stop, near), along
        at_m = {stop: m for stop, m in at_m.items() if stop not in near}
