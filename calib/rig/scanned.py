"""What the scans hold, summed up one by one, and what of it looks wrong before any fit."""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from calib.rig import Rig
from calib.rig.suspect import Suspect, listed
from sensors.holds import SET_ASIDE, spread_known
from sensors.lidar import LARGEST_REFLECTANCE, LidarModel, beams
from sensors.recording import RecordedStops, Scan
from sensors.rings import RingFinding, odd_rings, ring_elevations

FULL_SCALES = {LARGEST_REFLECTANCE: ", a reflectance", 255.0: " of 255", 65535.0: " of 65535"}
DOUBLED = 1 / 3  # a choice: of points by chance none repeats another; of a copy half do
PRIMES = (2, 3, 5, 7)  # by whose roots columns are added up: no two rows come to one number
FLOAT32 = 4e-7  # of the largest: float32 has 6e-8, and a length has that of three numbers, rounded
FEWEST_SCANS = 4  # by which it is seen how rings are usually numbered
MOST_RENUMBERED = 2  # rings by which a scan's numbers may be off
RENUMBERED = 0.25  # of how far its rings point from where others of their numbers do
LEAST_VALUES = 20  # different ones in a column, for its repetition to be no chance


@dataclass
class ScanSums:
    """What the readable scans hold, summed up while only one of them is in memory.

    Args:
        lidar: the rig's, if it has one.
        points: scan -> number of points.
        sweeps: the most returns that were averaged into a point.
        rings: (R,) points by ring.
        elevation_rad: (R,) sum of the beams' elevations by ring.
        by_scan: scan -> (R,) mean elevation by ring, NaN of those that are not seen.
        columns: names of the per-point covariates.
        intensity: scan -> its largest intensity, where it has any.
        darkest: the least intensity.
        doubled: scans of which more than a third of the points are there once more.
        rounded: scans more than half of whose spreads are 0, see `spread_known`.
        rounded_m: scan -> the step that all its ranges are multiples of, where they are.
        reach_m: the largest distance below which nineteen in twenty returns of a scan lie.
        contents: (column, digest of its values) -> the scans that hold it, of columns that vary;
            "points" stands for x, y and z.
    """

    lidar: LidarModel | None = None
    points: dict[str, int] = field(default_factory=dict)
    sweeps: int = 0
    rings: np.ndarray = field(default_factory=lambda: np.zeros(0, int))
    elevation_rad: np.ndarray = field(default_factory=lambda: np.zeros(0))
    by_scan: dict[str, np.ndarray] = field(default_factory=dict)
    columns: dict[str, None] = field(default_factory=dict)
    intensity: dict[str, float] = field(default_factory=dict)
    darkest: float = np.inf
    rounded: list[str] = field(default_factory=list)
    doubled: list[str] = field(default_factory=list)
    rounded_m: dict[str, float] = field(default_factory=dict)
    reach_m: float = 0.0
    contents: dict[tuple[str, str], list[str]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.lidar:
            self.rings = np.zeros(self.lidar.rings, int)
            self.elevation_rad = np.zeros(self.lidar.rings)

    def add(self, name: str, scan: Scan) -> None:
        """Take in one scan."""
        self.points[name] = len(scan.ring)
        self.sweeps = max(self.sweeps, int(scan.count.max()))
        rings = np.bincount(scan.ring, minlength=len(self.rings))
        rings[: len(self.rings)] += self.rings
        self.rings = rings
        if self.lidar:
            up_rad = beams(scan.xyz_m, self.lidar.beam_origin_m).elevation_rad
            total = np.bincount(scan.ring, up_rad, len(self.elevation_rad))
            self.elevation_rad += total
            seen = np.bincount(scan.ring, minlength=len(total))
            self.by_scan[name] = np.where(seen, total / np.maximum(seen, 1), np.nan)
        away_m = np.linalg.norm(scan.xyz_m, axis=1)
        self.reach_m = max(self.reach_m, float(np.quantile(away_m, 0.95)))
        if step_m := step_of(away_m):
            self.rounded_m[name] = step_m
        self.columns |= dict.fromkeys(scan.extra)
        if np.isfinite(scan.intensity).any():
            self.intensity[name] = float(np.nanmax(scan.intensity))
            self.darkest = min(self.darkest, float(np.nanmin(scan.intensity)))
        if _alike(np.column_stack([scan.xyz_m, scan.ring])) > DOUBLED:
            self.doubled.append(name)
        still = (scan.range_std_m == 0.0) & (scan.count > 1)
        if still.any() and not spread_known(scan.range_std_m, scan.count).any():
            self.rounded.append(name)
        for column, values in {
            "points": scan.xyz_m,
            "intensity": scan.intensity,
            "range_std_m": scan.range_std_m,
            **scan.extra,
        }.items():
            if len(np.unique(values[:1000])) >= LEAST_VALUES:
                key = column, hashlib.sha256(np.ascontiguousarray(values)).hexdigest()
                self.contents.setdefault(key, []).append(name)


def step_of(values: np.ndarray) -> float:
    """The step of which values (N,), as float32 has them, are multiples; 0 where they are not, or
    it is less than a hundred times what float32 tells of the largest: 4 mm of 100 m."""
    apart, least = np.diff(np.unique(values)), FLOAT32 * float(np.max(values, initial=0.0))
    apart = apart[apart > least]
    if len(apart) < LEAST_VALUES:
        return 0.0
    step, above = float(apart.min()), np.sort(values) - np.min(values)
    for far in above[np.searchsorted(above, step * np.geomspace(1, above[-1] / step, 40)) - 1]:
        step = far / np.rint(far / step) if far > step / 2 else step  # known better the further
    off = np.abs(above / step - np.rint(above / step)) * step
    # Of values by chance, steps as small as float32 can tell have no meaning.
    return float(f"{step:.3g}") if step > 100 * least and off.max() < step / 10 else 0.0


def _alike(rows: np.ndarray) -> float:
    """The share of rows (N, n) that repeat another one."""
    mixed = sum(by * column for by, column in zip(np.sqrt(PRIMES), rows.T, strict=True))
    return 1.0 - len(np.unique(mixed)) / len(rows)


def of_scans(scans: ScanSums) -> Iterator[tuple[str, str]]:
    """Scans, their points, rings, intensity and covariates."""
    low, high = min(scans.points.values()), max(scans.points.values())
    points = f"{low:,}" if low == high else f"{low:,} to {high:,}"
    sweeps = f", up to {scans.sweeps} sweeps averaged" if scans.sweeps > 1 else ""
    yield "scans", f"{len(scans.points)} of {points} points{sweeps}"
    yield "rings", f"{np.count_nonzero(scans.rings)} of {len(scans.rings)} seen"
    if scans.intensity:
        largest = max(scans.intensity.values())
        unit = next((words for full, words in FULL_SCALES.items() if largest <= full), "")
        yield "intensity", f"up to {largest:.3g}{unit}"
    if scans.columns:
        names = (f"{n} (made by averaging)" if n == SET_ASIDE else n for n in scans.columns)
        yield "per-point covariates", ", ".join(names)


def odd_scans(rig: Rig, recording: RecordedStops, scans: ScanSums) -> Iterator[str | Suspect]:
    """Scans without stop, stops without scan, rings without points or with wrong numbers, scans
    or columns that are there twice, and intensities of no known unit."""
    if stray := sorted(scans.points.keys() - set(recording.stops)):
        yield f"scans/ holds {listed(stray)}, but stops.csv has no such stop; they are not used"
    if not scans.points:
        return
    if rig.lidar is None:
        yield "there are scans, but no 'lidar' in rig.yaml, so they are not used"
        return
    if not recording.has_scan.all():
        missing = np.array(recording.stops)[~recording.has_scan]
        yield f"there is no scan of {listed(missing)}, though of other stops"
    if (silent := np.flatnonzero(scans.rings == 0)).size:
        yield f"no point comes from ring {listed(silent)}; rings are counted from 0"
    numbered = numbering(scans)
    if numbered is not None:
        yield Suspect("rings", rig.lidar.name, numbered.sentence, size=numbered.off_rad, unit="rad")
    yield from _renumbered(scans)
    if scans.doubled:
        yield (
            f"points of {listed(scans.doubled)} are there twice, and would count as independent; "
            "were they recorded twice?"
        )
    yield from _coarse(scans, rig.lidar)
    if scans.rounded:
        yield (
            f"more than half of range_std_m is 0 at {listed(scans.rounded)}, so it is not used "
            "there; leave it empty where it is unknown"
        )
    yield from _at_once(recording)
    yield from _twice(scans)
    yield from _intensities(scans)


def numbering(scans: ScanSums) -> RingFinding | None:
    """How rings are numbered otherwise than their LiDAR's model has it, if they are."""
    return odd_rings(scans.lidar, ring_elevations(scans.elevation_rad, scans.rings))


def _renumbered(scans: ScanSums) -> Iterator[Suspect]:
    """Scans whose rings are numbered otherwise than those of most, by so many."""
    if len(scans.by_scan) < FEWEST_SCANS:
        return
    each = np.array(list(scans.by_scan.values()))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of rings that no scan shows
        usual = np.nanmedian(each, axis=0)
        off_rad = np.nanmedian(np.abs(each - usual), axis=1)
        found: dict[int, list[str]] = {}
        for by in (b for b in range(-MOST_RENUMBERED, MOST_RENUMBERED + 1) if b):
            there = np.roll(usual, -by)
            there[-by if by > 0 else 0 : None if by > 0 else -by] = np.nan
            near = np.nanmedian(np.abs(each - there), axis=1) < RENUMBERED * off_rad
            for name, one in zip(scans.by_scan, near, strict=True):
                if one:
                    found.setdefault(by, []).append(name)
    for by, names in found.items():
        if len(names) < len(each) / 2:
            said = (
                f"rings of the scans of {listed(names)} are numbered {abs(by)} "
                f"{'lower' if by > 0 else 'higher'} than those of the others, by where they point"
            )
            yield Suspect("scan", names[0], said, stops=tuple(names))


def _coarse(scans: ScanSums, lidar: LidarModel) -> Iterator[str]:
    """Ranges that were rounded to more than the LiDAR's noise, and than its model knows."""
    known_m = max(lidar.sigma_range_m, lidar.quantum_m)
    if coarse := [name for name, step_m in scans.rounded_m.items() if step_m > known_m]:
        step_m = scans.rounded_m[coarse[0]]
        yield (
            f"ranges are multiples of {1e3 * step_m:.3g} mm at {listed(coarse)}, a step larger "
            f"than the LiDAR's noise; give it as 'quantum_m: {step_m:g}' under 'lidar' in rig.yaml"
        )


def _at_once(recording: RecordedStops) -> Iterator[str]:
    """Stops with scans at one and the same time."""
    at = np.flatnonzero(recording.has_scan & recording.timed)
    _, same, count = np.unique(recording.time_s[at], return_inverse=True, return_counts=True)
    for each in np.flatnonzero(count > 1):
        stops = [recording.stops[k] for k in at[same == each]]
        yield (
            f"the scans of {' and '.join(stops)} were made at one time, time_s: is the clock "
            "right, and is none a copy?"
        )


def _twice(scans: ScanSums) -> Iterator[Suspect]:
    """Scans that are copies of each other, and columns that are copied from another scan. What most
    scans have alike, as a number of each point, was not measured."""
    copies = {tuple(names) for (c, _), names in scans.contents.items() if c == "points"}
    for names in sorted(copies):
        if len(names) > 1:
            said = f"the scans of {' and '.join(names)} are one and the same; which stop is it of?"
            yield Suspect("scan", names[0], said, stops=names)
    every = len(set().union(*scans.contents.values()))
    for (column, _), names in scans.contents.items():
        few = 1 < len(names) < every and len(names) <= max(every / 2, 2)
        if few and column != "points" and tuple(names) not in copies:
            said = f"column {column} of the scans of {' and '.join(names)} is one and the same"
            yield Suspect("scan", names[0], said, stops=tuple(names))


def _intensities(scans: ScanSums) -> Iterator[Suspect]:
    """Units of intensity that differ from scan to scan, or are none that makers use."""
    if not scans.intensity:
        return
    largest = max(scans.intensity.values())
    small = [name for name, most in scans.intensity.items() if most <= LARGEST_REFLECTANCE]
    if small and largest > LARGEST_REFLECTANCE:
        said = (
            f"intensity is a reflectance of 0 to 1 at {listed(small)}, and goes to {largest:g} at "
            "other stops; give all in one unit"
        )
        yield Suspect("intensity", "intensity", said, stops=tuple(small))
    elif largest > max(FULL_SCALES) or scans.darkest < 0:
        said = (
            f"intensity lies between {scans.darkest:g} and {largest:g}, which is neither a "
            "reflectance of 0 to 1 nor a count of 8 or 16 bits; effects of it want a linear unit"
        )
        yield Suspect("intensity", "intensity", said)
