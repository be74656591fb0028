"""Stops that nobody has measured yet, as rows of the problem that a fit would solve.

A recording gets further rows: joints, where its bodies would be seen, and a scan, whose beams are
those that the recording's own scans hold. What they meet, how well, and what of it depends on which
unknown is computed by the residuals of the fit; only the residual itself is not known, and is 0.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace

import numpy as np

from calib.effects import View
from calib.planning.brightness import Brightness
from calib.problem import Problem
from calib.problem.model import Source
from calib.residuals.beams import Association, Rows, Surface
from calib.residuals.scan import ScanStop
from calib.residuals.seen import SeenBody
from calib.residuals.store import BeamStore
from chains import se3
from sensors.lidar import Beams, LidarModel, beams
from sensors.recording import Scan

SWEEPS = 20.0  # of a stop, where no recording says how many: 2 s at 10 Hz
SCANS_FOR_BEAMS = 8  # of a recording, from which the directions of its beams are taken
# Share of recorded beams that are shorter than those of planned stops that are counted on.
SHORTER_BEAMS = 0.01
ANY_WAY = np.array([0.0, 0.0, 1.0])  # what a planned level reads until the fit's state says better
MARK = "~"  # after the name of a location that is visited again: the base stands elsewhere by then


@dataclass(frozen=True)
class Poses:
    """Where the rig may stand, and how its arm may be bent, at n stops.

    Args:
        location: (n,) names.
        joints: (n, J) rad or m.
        Ts_world_root: (n, 4, 4).
    """

    location: np.ndarray
    joints: np.ndarray
    Ts_world_root: np.ndarray

    def some(self, index: Sequence[int] | np.ndarray) -> Poses:
        """Those of the stops, in that order."""
        at = np.asarray(index, int)
        return Poses(self.location[at], self.joints[at], self.Ts_world_root[at])


@dataclass(eq=False)
class PlannedStore(BeamStore):
    """The scans of a recording, and of the stops planned after its last: directions without ranges.

    Args:
        given: of the recording as it is.
        patterns: scans of planned stops, the next for each stop, and again from the first.
    """

    given: BeamStore | None = None
    patterns: Sequence[tuple[Scan, Beams]] = ()

    def read(self, stop: int) -> tuple[Scan, Beams]:
        """The scan of one stop, by its index, and its beams."""
        first = len(self.given.recording.stops)
        if stop < first:
            return self.given.read(stop)
        return self.patterns[(stop - first) % len(self.patterns)]

    @property
    def median_intensity(self) -> float:
        """As of the recording."""
        return self.given.median_intensity


@dataclass(frozen=True)
class PlannedScan(ScanStop):
    """A scan without residuals; a beam that meets nothing within its LiDAR's range weighs nothing.

    Args:
        each: how many beams of a recorded scan each of these is worth.
        nearest_m: shorter beams are not counted on, whatever the model's data sheet says.
        brightness: of its beams; None where nothing is known of it.
    """

    each: float = field(default=1.0, kw_only=True)
    nearest_m: float = field(default=0.0, kw_only=True)
    brightness: Brightness | None = field(default=None, kw_only=True)

    @classmethod
    def of(cls, scan: ScanStop, **changed: object) -> PlannedScan:
        """A scan of a problem, planned."""
        own = {f.name: getattr(scan, f.name) for f in fields(ScanStop)}
        return cls(**{**own, **changed})

    def rows(
        self,
        values: Mapping[str, np.ndarray],
        association: Association | None = None,
        T: np.ndarray | None = None,
    ) -> Rows:
        """The stop's rows at a state; arguments as of `ScanStop.rows`."""
        found, lidar = super().rows(values, association, T), self.lidar
        range_m = np.asarray(found.view["range_m"])
        nearest_m = max(self.nearest_m, lidar.min_range_m)
        usable = found.usable & (range_m > nearest_m) & (range_m < lidar.max_range_m)
        return replace(
            found,
            residual_m=np.zeros(len(range_m)),
            weight=np.where(usable, self.each, 0.0),
            usable=usable,
            scale=1.0,
            spread=None,
        )

    def _view(self, scan: Scan, ray: Beams, surface: Surface) -> View:
        view = super()._view(scan, ray, surface)
        if self.brightness is None:
            return view

        def intensity() -> np.ndarray:
            return self.brightness.at(view["label"], surface.predicted_m, surface.cosine)

        return replace(view, columns={**view.columns, "intensity": intensity})

    def _associate(
        self, T: np.ndarray, ray: Beams, values: Mapping[str, np.ndarray], near_edges: bool
    ) -> Association:
        return self.meeting.associate(T, ray, values, near_edges)  # it may meet nothing


def pattern(source: Source) -> tuple[Scan, Beams, float]:
    """Every beam that some scans of a recording hold, each once, as it pointed there, and the
    range, m, below which they hold next to none.

    Sweeps, and columns of the maker's own, are as they are in the median.
    """
    scanned = np.flatnonzero(source.recording.has_scan)
    some = scanned[np.unique(np.linspace(0, len(scanned) - 1, SCANS_FOR_BEAMS).round().astype(int))]
    store = source.of_beams(None).store
    read = [store.read(k) for k in some.tolist()]
    ring, column, count = (
        np.concatenate([getattr(scan, name) for scan, _ in read])
        for name in ("ring", "column", "count")
    )
    _, first = np.unique(ring * (column.max() + 1) + column, return_index=True)
    origin, direction = (
        np.concatenate([getattr(rays, name) for _, rays in read])[first]
        for name in ("origin_m", "direction")
    )
    extra = {
        name: np.full(len(first), np.nanmedian(np.concatenate([s.extra[name] for s, _ in read])))
        for name in read[0][0].extra
        if all(name in scan.extra for scan, _ in read)
    }
    nearest_m = float(
        np.quantile(np.concatenate([rays.range_m for _, rays in read]), SHORTER_BEAMS)
    )
    found = _scan(origin, direction, ring[first], column[first], float(np.median(count)), extra)
    return *found, nearest_m


def drawn(lidar: LidarModel) -> tuple[Scan, Beams, float]:
    """The same of a LiDAR of which no scan is there, as its model has it."""
    grid = np.meshgrid(np.arange(lidar.rings), np.arange(lidar.columns), indexing="ij")
    ring, column = (each.ravel() for each in grid)
    far = beams(lidar.max_range_m * lidar.directions(ring, column), lidar.beam_origin_m)
    found = _scan(far.origin_m, far.direction, ring, column, SWEEPS, {})
    return *found, lidar.min_range_m


def _scan(
    origin: np.ndarray,
    direction: np.ndarray,
    ring: np.ndarray,
    column: np.ndarray,
    count: float,
    extra: Mapping[str, np.ndarray],
) -> tuple[Scan, Beams]:
    unknown, size = np.full(len(ring), np.nan), len(ring)
    scan = Scan(
        xyz_m=origin + direction,
        ring=ring,
        column=column,
        intensity=unknown,
        count=np.full(size, count),
        range_std_m=unknown,
        extra=dict(extra),
    )
    return scan, Beams(origin, direction, np.ones(size))


def thinned(whole: tuple[Scan, Beams], most: int) -> list[tuple[Scan, Beams]]:
    """Parts of a pattern of about so many beams, spread evenly over each ring, every ring from
    another column on; together they hold all."""
    scan, rays = whole
    step = max(1, round(len(scan.ring) / most))
    order = np.lexsort((scan.column, scan.ring))
    starts = np.searchsorted(scan.ring[order], scan.ring[order])
    # Golden section: rings and parts begin as far from each other as they can.
    phase = np.floor(step * ((0.618034 * scan.ring[order]) % 1.0)).astype(int)
    turn = (np.arange(len(order)) - starts + phase) % step
    out, count = [], float(scan.count[0])
    for part in range(step):
        at = order[turn == part]
        origin, direction = rays.origin_m[at], rays.direction[at]
        extra = {name: values[at] for name, values in scan.extra.items()}
        out.append(_scan(origin, direction, scan.ring[at], scan.column[at], count, extra))
    return out


def extended(
    source: Source,
    poses: Poses,
    patterns: Sequence[tuple[Scan, Beams]],
    T_world_reference: np.ndarray,
    apart: bool,
) -> Source:
    """A recording with planned stops after its own.

    What effects may ask of a stop beside its joints (temperature, load) stays as at the last stop;
    its time is one stop later. Bodies that were ever tracked are seen, and levels read.

    Args:
        source: the recording.
        poses: of the planned stops.
        patterns: of their scans; empty without a LiDAR.
        T_world_reference: (4, 4).
        apart: whether each planned stop is a visit of its own, where the base moves by location.
    """
    recording, count = source.recording, len(poses.joints)
    location = poses.location.astype(str)
    if source.rig.moves == "location":
        visits = [f"{MARK}{k}" if apart else MARK for k in range(count)]
        location = np.char.add(location, visits)
    later = np.full(count, np.nan)
    if recording.timed and len(recording.time_s):
        gaps = np.diff(np.sort(recording.time_s))
        later[:] = recording.time_s.max() + (np.median(gaps) if len(gaps) else 0.0)
    guess = se3.inverse(T_world_reference) @ poses.Ts_world_root
    bodies = {
        body: np.concatenate([seen, _seen(source, body, poses)])
        for body, seen in recording.bodies.items()
    }
    longer = replace(
        recording,
        stops=[*recording.stops, *(f"{MARK}{k}" for k in range(count))],
        location=np.concatenate([recording.location, location]),
        time_s=np.concatenate([recording.time_s, later]),
        joints=np.concatenate([recording.joints, poses.joints]),
        bodies=bodies,
        levels={
            frame: np.concatenate([felt, np.tile(ANY_WAY, (count, 1))])
            for frame, felt in recording.levels.items()
        },
        base_guess=None
        if recording.base_guess is None
        else np.concatenate([recording.base_guess, _pose(guess)]),
        covariates={
            name: np.concatenate([column, np.full(count, column[-1])])
            for name, column in recording.covariates.items()
        },
        has_scan=np.concatenate([recording.has_scan, np.full(count, bool(patterns))]),
    )
    out = replace(source, recording=longer)
    if patterns:
        out.__dict__["store"] = PlannedStore(
            longer, source.rig.lidar.beam_origin_m, given=source.store, patterns=patterns
        )
    return out


def _seen(source: Source, body: str, poses: Poses) -> np.ndarray:
    """About where a body would be seen (n, 7); NaN where it never was, or as a point."""
    seen = source.recording.bodies[body]
    ever = np.isfinite(seen).any(axis=0) | (len(seen) == 0)
    placed = source.rig.tree.place(body, poses.joints).Ts_root_frame
    return np.where(ever, _pose(poses.Ts_world_root @ placed), np.nan)


def _pose(T: np.ndarray) -> np.ndarray:
    return np.concatenate([T[:, :3, 3], se3.to_quat_wxyz(T)], axis=1)


def at_their_places(
    problem: Problem,
    known: Mapping[str, np.ndarray],
    source: Source,
    first: int,
    poses: Poses,
    **planned: object,
) -> tuple[Problem, dict[str, np.ndarray]]:
    """A problem in which planned stops lie where they are planned, and are seen there.

    Args:
        problem: with them.
        known: the values of the fit.
        source: the recording with them, from this stop on (`first`).
        first: number of the first planned stop.
        poses: of the planned stops.
        planned: fields of `PlannedScan`.

    Returns:
        The problem, and all values.
    """
    folder = source.recording.folder
    values = {n: u.mean for n, u in problem.variables.items()} | problem.initial | dict(known)
    roots = [(s.stops.root, s.index) for s in problem.scans if s.recording.folder == folder]
    roots += [(b.stops.root, k) for b in problem.seen for at, k in b.stop_names if at == folder]
    for root, k in roots:
        if k >= first and root not in known:
            values[root] = poses.Ts_world_root[k - first]
    scans = [
        PlannedScan.of(scan, **planned)
        if scan.recording.folder == folder and scan.index >= first
        else scan
        for scan in problem.scans
    ]
    return replace(
        problem,
        scans=scans,
        blocks=[
            b.as_predicted(values, _planned(b, folder, first)) if isinstance(b, SeenBody) else b
            for b in problem.blocks
        ],
    ), values


def _planned(block: SeenBody, folder: object, first: int) -> np.ndarray:
    """Which (K,) of a block's stops are planned."""
    return np.array([at == folder and k >= first for at, k in block.stop_names])
