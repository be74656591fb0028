"""Scans as beams, read once: a fit walks over its stops a dozen times."""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from threading import Lock
from typing import Any
from weakref import WeakSet

import numpy as np

from sensors.lidar import Beams, beams
from sensors.recording import RecordedStops, Scan

LEAST_KEPT_BYTES = 256e6
# Of the memory: a choice. What a look of 360 stops holds besides is half of 24 GB.
KEPT_SHARE = 0.25


def _kept_bytes(processes: int) -> float:
    """Of scans and beams of all recordings together, in each of so many processes of a machine;
    what is beyond is read again each time."""
    memory = float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    with suppress(OSError, ValueError):  # there is no such file, or it says "max"
        memory = min(memory, float(Path("/sys/fs/cgroup/memory.max").read_text(encoding="ascii")))
    return max(LEAST_KEPT_BYTES, KEPT_SHARE * memory / processes)


KEPT_BYTES = _kept_bytes(1)
_STORES: WeakSet[BeamStore] = WeakSet()  # that share it


def share_memory() -> None:
    """Keep as much as leaves room for a process on each core of the machine."""
    global KEPT_BYTES
    KEPT_BYTES = _kept_bytes(os.cpu_count() or 1)


@dataclass(eq=False)
class BeamStore:
    """The scans of a recording and their beams, as many as fit into `KEPT_BYTES`
    beside those of other recordings.

    Args:
        recording: whose.
        beam_origin_m: (2,) of its LiDAR, radial and tangential.
        most: how many beams of each scan there are at most; all where None.
    """

    recording: RecordedStops
    beam_origin_m: tuple[float, float]
    most: int | None = None
    _kept: dict[int, tuple[Scan, Beams]] = field(default_factory=dict, repr=False)
    _bytes: float = 0.0
    _lock: Lock = field(default_factory=Lock, repr=False)

    def __post_init__(self) -> None:
        _STORES.add(self)

    def read(self, stop: int) -> tuple[Scan, Beams]:
        """The scan of one stop, by its index, and its beams.

        Raises:
            InputError: as of `sensors.recording.read_scan`.
        """
        if stop in self._kept:
            return self._kept[stop]
        scan = self._scan(stop)
        found = scan, beams(scan.xyz_m, self.beam_origin_m)
        size = _size(found)
        with self._lock:
            full = sum(store._bytes for store in list(_STORES)) + size > KEPT_BYTES
            if stop not in self._kept and not full:
                self._kept[stop] = found
                self._bytes += size
        return found

    def _scan(self, stop: int) -> Scan:
        """A scan, to look at once: it takes no place of those that are asked for in each pass."""
        if stop in self._kept:
            return self._kept[stop][0]
        scan = self.recording.scan(stop)
        return scan if self.most is None else _thinned(scan, self.most, stop)

    @cached_property
    def median_intensity(self) -> float:
        """Of all returns of the recording, however many beams are used; NaN where none has an
        intensity, or most are dark."""
        scanned = np.flatnonzero(self.recording.has_scan).tolist()
        scan = self._scan if self.most is None else self.recording.scan
        found = np.concatenate([np.zeros(0), *(scan(k).intensity for k in scanned)])
        found = found[np.isfinite(found)]
        median = float(np.median(found)) if len(found) else 0.0
        return median if median > 0 else float("nan")

    def __getstate__(self) -> dict[str, object]:
        """Without what was read: another process reads for itself."""
        return {n: getattr(self, n) for n in ("recording", "beam_origin_m", "most")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(**state)


def drawn_evenly(count: int, most: int, seed: int) -> np.ndarray:
    """Which of so many (most,), ascending, one drawn from each of as many equal parts; all of them
    where they are no more."""
    if count <= most:
        return np.arange(count)
    ends = np.linspace(0, count, most + 1).astype(int)
    return np.random.default_rng(seed).integers(ends[:-1], ends[1:])


def drawn_of_each(group: np.ndarray, most: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """About so many rows, ascending: one drawn from every few that stand side by side in a group
    (N,), and how many these are. None of no group, which are at -1."""
    known = np.flatnonzero(group >= 0)
    theirs = group[known].astype(np.min_scalar_type(int(group.max(initial=0))))  # sorts faster
    order, size = known[np.argsort(theirs, kind="stable")], np.bincount(theirs)
    step, start = max(len(known) / most, 1.0), np.cumsum(size) - size
    parts = np.ceil(size / step).astype(int)
    each = np.arange(parts.sum()) - np.repeat(np.cumsum(parts) - parts, parts)
    start, size, parts = (np.repeat(of, parts) for of in (start, size, parts))
    low, high = start + each * size // parts, start + (each + 1) * size // parts
    some = order[np.random.default_rng(seed).integers(low, high)]
    ascending = np.argsort(some)
    return some[ascending], (high - low)[ascending]


@dataclass(frozen=True)
class SomeBeams:
    """Some beams (n,) of a scan of a store."""

    store: BeamStore
    some: np.ndarray

    def read(self, stop: int) -> tuple[Scan, Beams]:
        """As of the store."""
        scan, ray = self.store.read(stop)
        return _only(scan, self.some), ray.only(self.some)


def _thinned(scan: Scan, most: int, stop: int) -> Scan:
    """So many beams of a scan: scans are stored by ring or by column, so that beams drawn evenly
    are spread over all directions."""
    return _only(scan, drawn_evenly(len(scan.ring), most, stop))


def _only(scan: Scan, some: np.ndarray) -> Scan:
    """A scan of some beams (n,)."""
    columns = {n: c[some] for n, c in vars(scan).items() if isinstance(c, np.ndarray)}
    return replace(scan, **columns, extra={n: c[some] for n, c in scan.extra.items()})


def common_median(stores: Sequence[BeamStore]) -> float:
    """The median intensity that recordings by one LiDAR share, as they share its range zero."""
    return float(np.median([store.median_intensity for store in stores]))


def _size(found: tuple[Scan, Beams]) -> float:
    arrays = [a for each in found for a in vars(each).values() if hasattr(a, "nbytes")]
    return float(sum(a.nbytes for a in (*arrays, *found[0].extra.values())))
