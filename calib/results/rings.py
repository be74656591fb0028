"""Whether the rings of a recording are numbered as the table of its LiDAR's model has them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from calib.problem.model import Source
from calib.rig.scanned import ScanSums, numbering
from sensors.rings import REVERSED, RingFinding, least_off_rad

LOOKED = 3  # scans of a recording from which the numbers are checked: each holds all rings


def odd_rings(sources: Iterable[Source]) -> Iterator[tuple[Source, RingFinding]]:
    """Recordings whose rings are numbered otherwise than their LiDAR's model has them."""
    for source in sources:
        scanned = np.flatnonzero(source.recording.has_scan)[:LOOKED]
        if source.rig.lidar is not None and len(scanned):
            sums = ScanSums(source.rig.lidar)
            store = source.of_beams(None).store
            for k in scanned.tolist():
                sums.add(source.recording.stops[k], store.read(k)[0])
            found = numbering(sums)
            if found is not None:
                yield source, found


def harmful(what: str) -> bool:
    """Whether offsets by ring are of no use; where rings are counted from the other end, as many
    drivers do, they are right, and only a table by the LiDAR's own channels has another order."""
    return what != REVERSED


def misnumbered(sources: Sequence[Source]) -> Iterator[tuple[Source, RingFinding]]:
    """Recordings of a fit whose rings are numbered so that offsets by ring are of no use: as by
    `harmful`, or otherwise than in another recording of the same rig."""
    found = {id(source): each for source, each in odd_rings(sources)}
    numbered = {id(s): found[id(s)].what if id(s) in found else "" for s in sources}
    for source in (s for s in sources if id(s) in found):
        scanned = (s for s in sources if s.rig.name == source.rig.name)
        alike = {numbered[id(s)] for s in scanned if s.recording.has_scan.any()}
        if harmful(found[id(source)].what) or len(alike) > 1:
            yield source, found[id(source)]


def detectable(sources: Iterable[Source]) -> dict[str, dict[str, float]]:
    """From which rms of elevations other numbers of rings are told, of all LiDARs."""
    lidars = [s.rig.lidar for s in sources if s.rig.lidar and s.recording.has_scan.any()]
    sizes = [size for size in map(least_off_rad, lidars) if np.isfinite(size)]
    return {"rings": {"rad": max(sizes)}} if sizes else {}


def documents(sources: Iterable[Source]) -> list[dict[str, Any]]:
    """The same as summary.json holds it: of which rig and LiDAR, and what was found."""
    return [
        {"rig": source.rig.name, "lidar": source.rig.lidar.name, **asdict(found)}
        for source, found in odd_rings(sources)
    ]
