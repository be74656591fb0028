"""How many beams there are, and which of them are rejected, in bins of every covariate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from calib.diagnosis.rejects.rejected import Rejected
from calib.diagnosis.stand import Stand
from calib.diagnosis.structure import STOPS_A_BIN
from calib.effects import View
from calib.forward import Values
from calib.linear.parallel import over_stops
from calib.linear.rows import PLACES
from calib.residuals.beams import Association
from calib.residuals.robust import TUKEY
from calib.residuals.scan import ScanStop
from calib.solve.fit import Progress
from sensors.stops import in_time

CELLS, REJECT_BINS = 240, 12  # of a covariate: where an interval may end, and what is tested


@dataclass(frozen=True)
class CellAxis:
    """A covariate cut into cells, where an interval may end, and bins of these, which are tested.

    Args:
        name: column.
        edges: (C - 1,) ascending values between the cells.
        ends: (C + 1,) where cells begin and end; the first and last value seen at the ends.
        bins: (C,) the bin of each cell.
        names: of the cells, where each is a thing and neighbours have nothing in common.
        wraps: whether the last cell is beside the first.
    """

    name: str
    edges: np.ndarray
    ends: np.ndarray
    bins: np.ndarray
    names: tuple[str, ...] = ()
    wraps: bool = False

    @classmethod
    def of(cls, name: str, values: np.ndarray, bins: int = REJECT_BINS) -> CellAxis:
        """Cells of about equal count, of equal width for azimuth, one for each of few values."""
        values = values[np.isfinite(values)].astype(float)
        distinct = np.unique(values)
        turn = name == "azimuth_rad"
        if turn:
            edges = np.linspace(-np.pi, np.pi, CELLS + 1)[1:-1]
        elif len(distinct) <= CELLS:
            edges = (distinct[1:] + distinct[:-1]) / 2
        else:
            edges = np.unique(np.quantile(values, np.arange(1, CELLS) / CELLS))
        outer = (-np.pi, np.pi) if turn else (distinct[:1], distinct[-1:])
        count = len(edges) + 1
        return cls(
            name=name,
            edges=edges,
            ends=np.hstack([outer[0], edges, outer[1]]),
            bins=np.arange(count) * min(bins, count) // count,
            wraps=turn,
        )

    @classmethod
    def of_things(
        cls, name: str, names: Sequence[str], numbers: Sequence[int] | None = None
    ) -> CellAxis:
        """A cell, and a bin, for each of some things; of ascending numbers, from 0 if not given."""
        at = np.arange(len(names)) if numbers is None else np.asarray(numbers)
        edges = (at[1:] + at[:-1]) / 2
        ends = np.hstack([at[:1], edges, at[-1:]])
        own = np.arange(len(at))
        return cls(name=name, edges=edges, ends=ends, bins=own, names=tuple(names))

    @property
    def ordered(self) -> bool:
        """Whether neighbouring cells belong together."""
        return not self.names

    def interval(self, cells: np.ndarray) -> tuple[float, float]:
        """Where some neighbouring cells (C,) begin and end; the first ends after the second where
        the interval goes round."""
        at = np.flatnonzero(cells)
        first, last = at[0], at[-1] + 1
        if self.wraps and cells[0] and cells[-1] and not cells.all():
            gap = np.flatnonzero(~cells)
            first, last = gap[-1] + 1, gap[0]
        return float(self.ends[first]), float(self.ends[last])

    def names_of(self, cells: np.ndarray) -> tuple[str, ...]:
        """The things of some cells (C,)."""
        return tuple(self.names[i] for i in np.flatnonzero(cells)) if self.names else ()

    @property
    def count(self) -> int:
        """How many bins."""
        return int(self.bins.max(initial=-1)) + 1

    @cached_property
    def bin_of(self) -> np.ndarray:
        """(C + 1,) the bin of each cell; the last, of what is not known, is B."""
        return np.append(self.bins, self.count)

    def cells(self, values: np.ndarray) -> np.ndarray:
        """The cell (N,) of each value; C where it is not known."""
        found = np.searchsorted(self.edges, values)
        known = np.isfinite(values)
        return found if known.all() else np.where(known, found, len(self.bins))


@dataclass(frozen=True)
class Counts:
    """All beams that meet a surface, counted, and the rejected ones.

    Args:
        axes: covariates, A of them.
        stops, places: per axis (K, B) and (P, B) beams of each stop, and of each place, by bins.
        cells: per axis (C,) beams by cells.
        met: (K, S) beams of each stop on each surface.
        met_places: (K, P) the same at each place: a region of a surface of a mesh, or of a plane.
        rank: (K,) which stop came when, by time if that is known of all, else by rows; NaN of
            several recordings.
        stop_names, surface_names: by number; place_names: likewise, empty without a mesh.
        rejected: the rejected ones.
    """

    axes: Sequence[CellAxis]
    stops: Sequence[np.ndarray]
    places: Sequence[np.ndarray]
    cells: Sequence[np.ndarray]
    met: np.ndarray
    met_places: np.ndarray
    rank: np.ndarray
    stop_names: Sequence[str]
    surface_names: Sequence[str]
    place_names: Sequence[str]
    rejected: Rejected


def count(stand: Stand, progress: Progress) -> Counts:
    """Count the beams of a fit at its solution."""
    scans, axes = stand.estimate.scans, _axes(stand)
    places, surfaces = _Numbers(), _Numbers()
    stops, rejected = [[] for _ in axes], []
    by_place = [np.zeros((0, axis.count), int) for axis in axes]
    cells = [np.zeros(len(axis.bins), int) for axis in axes]
    met, met_places = np.zeros((2, len(scans), 0), int)
    work = partial(_count_stop, stand.estimate.values, axes)
    of_each = over_stops(work, scans, stand.estimate.associations, range(len(scans)))
    for i, found in enumerate(of_each):
        progress("looking at what was rejected", i, len(scans))
        place, surface = (
            numbers.of(scans[i].room, parts)
            for numbers, parts in ((places, found.places), (surfaces, found.surfaces))
        )
        own, beams = found.rejected, found.beams
        rejected.append(replace(own, place=place[own.place], surface=surface[own.surface]))
        met = _grown(met.T, len(surfaces.known)).T
        met[i, surface] = found.met
        met_places = _grown(met_places.T, len(places.known)).T
        met_places[i, place] = beams
        for a, (table, fine) in enumerate(zip(found.tables, found.cells, strict=True)):
            stops[a].append(table.sum(axis=0))
            by_place[a] = _grown(by_place[a], len(places.known))
            by_place[a][place] += table
            cells[a] += fine
    return Counts(
        axes=axes,
        stops=[np.stack(each) for each in stops],
        places=by_place,
        cells=cells,
        met=met,
        met_places=met_places,
        rank=_rank(scans),
        stop_names=[scan.name for scan in scans],
        surface_names=[str(part) for _, part in surfaces.known],
        place_names=[str(part) for _, part in places.known] if meshed(stand) else [],
        rejected=Rejected.of(rejected),
    )


def _rank(scans: Sequence[ScanStop]) -> np.ndarray:
    first = scans[0].recording
    if any(scan.recording is not first for scan in scans):
        return np.full(len(scans), np.nan)
    when = {stop: k for k, stop in enumerate(in_time(first.stops, first.time_s))}
    return np.array([when[scan.name] for scan in scans], float)


def meshed(stand: Stand) -> bool:
    """Whether beams meet a mesh, and not planes found in the scans."""
    return all(source.reference for source in stand.sources)


class _Numbers:
    """Numbers for parts of rooms, in the order in which they are first seen."""

    def __init__(self) -> None:
        self.known: dict[tuple[object, int], int] = {}

    def of(self, room: object, parts: np.ndarray) -> np.ndarray:
        known = self.known
        return np.array([known.setdefault((room, p), len(known)) for p in parts.tolist()], int)


def _grown(table: np.ndarray, rows: int) -> np.ndarray:
    return np.pad(table, ((0, rows - len(table)), (0, 0)))


@dataclass(frozen=True)
class _Counted:
    """One stop's beams: by places and their bins, by cells, and by surfaces."""

    places: np.ndarray
    beams: np.ndarray
    surfaces: np.ndarray
    met: np.ndarray
    tables: Sequence[np.ndarray]
    cells: Sequence[np.ndarray]
    rejected: Rejected


def _count_stop(
    values: Values, axes: Sequence[CellAxis], scan: ScanStop, association: Association, i: int
) -> _Counted:
    rows = scan.rows(values, association)
    used, view = np.flatnonzero(rows.usable), rows.view
    kinds = [name for name in ("region", *PLACES) if name in view.columns]
    places, place = _numbered(np.asarray(view[kinds[0]])[used])
    surfaces, surface = _numbered(np.asarray(view[kinds[min(1, len(kinds) - 1)]])[used])
    thrown = np.flatnonzero(rows.weight[used] == 0.0)
    tables, cells, at = [], [], np.zeros((len(thrown), len(axes)), np.int32)
    for a, axis in enumerate(axes):
        values = np.asarray(view[axis.name])
        if len(values) == 1:  # the stop's own
            cell = np.full(len(used), axis.cells(values)[0])
        else:
            cell = axis.cells(values[used])
        at[:, a] = cell[thrown]
        size = axis.count + 1
        known = np.bincount(place * size + axis.bin_of[cell], minlength=len(places) * size)
        tables.append(known.reshape(len(places), size)[:, :-1])
        cells.append(np.bincount(cell, minlength=len(axis.bins))[: len(axis.bins)])
    some = used[thrown]
    rejected = Rejected(
        stop=np.full(len(some), i),
        place=place[thrown],
        surface=surface[thrown],
        cells=at,
        residual_m=rows.residual_m[some],
        reach_m=TUKEY * rows.scale * rows.sigma_m[some],
        slant=np.cos(np.broadcast_to(view["incidence_rad"], len(rows.usable))[some]),
        beside=_beside(view, used, rows.weight[used] == 0.0)[thrown],
    )
    return _Counted(
        places=places,
        beams=np.bincount(place),
        surfaces=surfaces,
        met=np.bincount(surface),
        tables=tables,
        cells=cells,
        rejected=rejected,
    )


def _beside(view: View, used: np.ndarray, thrown: np.ndarray) -> np.ndarray:
    """Whether the beam before or after each of those that are used (N,), in its ring, is thrown
    (N,)."""
    ring, azimuth = (np.asarray(view[name])[used] for name in ("ring", "azimuth_rad"))
    order = np.lexsort((azimuth, ring))
    next_to = np.diff(ring[order]) == 0
    sorted_out, found = thrown[order], np.zeros(len(used), bool)
    found[order[:-1]] = sorted_out[1:] & next_to
    found[order[1:]] |= sorted_out[:-1] & next_to
    return found


def _numbered(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distinct whole numbers from -1 up, and which of these each value is; they are few."""
    found = np.flatnonzero(np.bincount(values + 1))
    number = np.zeros(values.max(initial=-1) + 2, int)
    number[found] = np.arange(len(found))
    return found - 1, number[values + 1]


def _axes(stand: Stand) -> list[CellAxis]:
    """The covariates of points and stops that change, cut into cells and bins."""
    scans = stand.estimate.scans
    sample = stand.carried.sample
    rings = max(scan.lidar.rings for scan in scans)
    out = [CellAxis.of("ring", np.arange(rings))]
    for name, values in sorted(sample.items()):
        told = [scan.columns[name] for scan in scans if name in scan.columns]
        if name == "label":
            out.append(_labels(stand, values))
        elif len(told) == len(scans):  # of stops
            bins = max(2, min(REJECT_BINS, len(scans) // STOPS_A_BIN))
            out.append(CellAxis.of(name, np.concatenate(told), bins))
        else:
            out.append(
                CellAxis.of(name, values, 2 * REJECT_BINS if name == "azimuth_rad" else REJECT_BINS)
            )
    return [axis for axis in out if axis.count > 1]


def _labels(stand: Stand, values: np.ndarray) -> CellAxis:
    names = {n: text for source in stand.sources for n, text in source.rig.labels.items()}
    numbers = sorted({*names, *np.unique(values).astype(int).tolist()})
    return CellAxis.of_things("label", [names.get(n, str(n)) for n in numbers], numbers)
