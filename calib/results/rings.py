"""Whether the rings of a recording are numbered as the table of its LiDAR's model has them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict
from typing import Any, NamedTuple

import numpy as np

from calib.problem.model import Source, labels
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


class Misnumbered(NamedTuple):
    """A recording of a fit whose rings are numbered so that offsets by ring are of no use there.

    Args:
        source: it.
        label: what it is called beside others; empty where it is the only one.
        finding: how they are numbered.
        apart: whether another recording of the same rig has them otherwise.
    """

    source: Source
    label: str
    finding: RingFinding
    apart: bool


def misnumbered(sources: Sequence[Source]) -> list[Misnumbered]:
    """Those recordings of a fit: as by `harmful`, or as another of the same rig is numbered
    otherwise."""
    found = {id(source): each for source, each in odd_rings(sources)}
    how = {id(s): found[id(s)].what if id(s) in found else "" for s in sources}
    out = []
    for source, label in zip(sources, labels(sources), strict=True):
        if finding := found.get(id(source)):
            same = [s for s in sources if s.rig.name == source.rig.name]
            apart = len({how[id(s)] for s in same if s.recording.has_scan.any()}) > 1
            if harmful(finding.what) or apart:
                name = label if len(sources) > 1 else ""
                out.append(Misnumbered(source, name, finding, apart))
    return out


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
