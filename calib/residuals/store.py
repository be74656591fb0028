"""Scans as beams, read once: a fit walks over its stops a dozen times."""

from __future__ import annotations

from dataclasses import dataclass, field

from sensors.lidar import Beams, beams
from sensors.recording import Recording, Scan

KEPT_BYTES = 256e6  # of scans and beams of one recording; what is beyond is read again each time


@dataclass
class BeamStore:
    """The scans of a recording and their beams, as many as fit into `KEPT_BYTES`.

    Args:
        recording: whose.
        beam_origin_m: (2,) of its LiDAR, radial and tangential.
    """

    recording: Recording
    beam_origin_m: tuple[float, float]
    _kept: dict[int, tuple[Scan, Beams]] = field(default_factory=dict, repr=False)
    _bytes: float = 0.0

    def read(self, stop: int) -> tuple[Scan, Beams]:
        """The scan of one stop, by its index, and its beams.

        Raises:
            InputError: as of `sensors.recording.read_scan`.
        """
        if stop in self._kept:
            return self._kept[stop]
        scan = self.recording.scan(stop)
        found = scan, beams(scan.xyz_m, self.beam_origin_m)
        size = _size(found)
        if self._bytes + size <= KEPT_BYTES:
            self._kept[stop] = found
            self._bytes += size
        return found

    def __getstate__(self) -> dict[str, object]:
        """Without what was read: another process reads for itself."""
        return {**self.__dict__, "_kept": {}, "_bytes": 0.0}


def _size(found: tuple[Scan, Beams]) -> float:
    arrays = [a for each in found for a in vars(each).values() if hasattr(a, "nbytes")]
    return float(sum(a.nbytes for a in (*arrays, *found[0].extra.values())))
