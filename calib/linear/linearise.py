"""One pass over all rows at a state, stop by stop, into a `Linearisation`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from calib.forward import Placed, place_each
from calib.linear.assembly import KeptSums, assembly_of
from calib.linear.clusters import Gradients, summed
from calib.linear.layout import Layout
from calib.linear.own import OwnRows, own_rows
from calib.linear.parallel import over_stops
from calib.linear.rows import State, StopRows, StopSums, Weighing
from calib.linear.system import Linearisation, Values
from calib.outputs.journal import Journal
from calib.problem import Problem
from calib.residuals.beams import Association, Rows
from calib.residuals.scan import ScanStop
from calib.residuals.spread import SpreadRows

Progress = Callable[[int, int], None]


def linearise(
    problem: Problem,
    values: Values,
    associations: Sequence[Association | None],
    layout: Layout | None = None,
    gradients: Gradients | None = None,
    beams: bool = True,
    progress: Progress = lambda done, total: None,
    weighed: Sequence[Weighing] = (),
    slowed: Sequence[Weighing] = (),
    own: Sequence[OwnRows] | None = None,
    journal: Journal | None = None,
) -> Linearisation:
    """Linearise all rows of beams and tracked bodies at a state.

    Args:
        problem: what is estimated; surfaces' unknowns included where it has any.
        values: the state.
        associations: per scan, what its beams meet; found anew where None.
        layout: of the problem, if there is one already.
        gradients: takes those of the clusters of beams, where they are wanted.
        beams: False for tracked bodies alone.
        progress: called with how many stops are done, and of how many.
        weighed: how the beams were weighed at another state, where costs are to be compared.
        slowed: how they were weighed before, if robust scales are to go but half the way on, or
            to stay.
        own: the rows about stops' own unknowns, as `own_rows` has them, where they are known.
        journal: keeps what each stop adds, which follows from the state and from what was asked
            before; where it is worth that.
    """
    layout = layout or Layout.of(problem)
    count = len(problem.scans) if beams else 0
    own = own_rows(layout, values) if own is None else own
    assembly = assembly_of(layout, own, gradients is not None)
    placed = lidars(problem.scans, values) if count else []
    scans = problem.scans[:count]
    work = partial(_of_stop, layout, State(values), gradients is not None)
    each = placed, associations, slowed or [None] * count, weighed or [None] * count
    found: list[_OfStop] = []
    for i, stop in enumerate(_of_stops(work, scans, each, values, journal)):
        progress(i, count)
        found.append(stop.without_sums())
        assembly.add(stop.sums)
        if stop.scatter is not None:
            assembly.add_kept(stop.scatter)
        if gradients is not None:
            places = gradients.numbers(scans[i].room, stop.met)
            at = np.full(len(places), stop.sums.stop)
            for gradient, columns in stop.gradients:
                gradients.add(gradient, columns, at, places)
    return replace(
        assembly.done(values),
        weighed=[stop.weighed for stop in found],
        beams_cost=sum(stop.cost for stop in found),
        cost_before=sum(stop.cost_before for stop in found) if weighed else None,
    )


class ScatterRows(NamedTuple):
    """Whitened rows of the scatter within a hold: derivatives (m, n) by kept unknowns, minus the
    residuals (m,), and by which columns (n,)."""

    A: np.ndarray
    b: np.ndarray
    columns: np.ndarray

    @classmethod
    def of(cls, spread: SpreadRows, layout: Layout) -> ScatterRows:
        """Over the columns of a layout."""
        columns = layout.columns(list(spread.columns))
        return cls(np.hstack(list(spread.columns.values())), -spread.residual, columns)


@dataclass(frozen=True)
class _OfStop:
    """What a stop adds.

    Args:
        sums: of its beams; scatter: of its rows of scatter within holds, None where it has none.
        met: (G,) what its beams meet, where gradients are wanted.
        gradients: of beams, and of rows of scatter, (G, n) by what is met, and the columns (n,).
        weighed: how its beams were weighed.
        cost: of them; cost_before: the same as they were weighed before.
    """

    sums: StopSums | None
    scatter: KeptSums | None
    met: np.ndarray | None
    gradients: Sequence[tuple[np.ndarray, np.ndarray]]
    weighed: Weighing
    cost: float
    cost_before: float

    def without_sums(self) -> _OfStop:
        """What is kept of it until all stops are done."""
        return replace(self, sums=None, scatter=None, met=None, gradients=())


def _of_stops(
    work: Callable[..., _OfStop],
    scans: Sequence[ScanStop],
    each: Sequence[Sequence[Any]],
    values: Values,
    journal: Journal | None,
) -> Iterator[_OfStop]:
    """What stops add at a state, in their order; as a journal knows it, if there is one."""

    def of(some: Sequence[int]) -> Iterator[_OfStop]:
        return over_stops(work, [scans[i] for i in some], *([x[i] for i in some] for x in each))

    if journal is None:
        return of(range(len(scans)))
    stops = [f"{i} {scan.name}" for i, scan in enumerate(scans)]
    asked = {**values, "beams": [len(association.part) for association in each[1]]}
    return journal.each(asked, stops, of, OF_STOP_KINDS)


OF_STOP_KINDS = _OfStop, StopSums, KeptSums, Weighing, State


def _of_stop(
    layout: Layout,
    state: State,
    clustered: bool,
    scan: ScanStop,
    placed: Placed,
    association: Association | None,
    slowed: Weighing | None,
    weighed: Weighing | None,
) -> _OfStop:
    """Of the scan of one stop, whose LiDAR is `placed`; other arguments as of `linearise`."""
    rows = StopRows.of(scan, layout, state.values, placed, association, slowed)
    here, scatter = Weighing.of(rows.rows, state, placed.T[0]), None
    at = partial(_rows_at, scan, association)
    if rows.rows.spread is not None:
        scatter = ScatterRows.of(rows.rows.spread, layout)
    met, gradients = None, []
    if clustered:
        met, cluster = rows.places()
        gradients.append(rows.gradient(cluster, len(met)))
        if scatter is not None:
            gradients.append((summed(scatter.b[:, None] * scatter.A, cluster), scatter.columns))
    return _OfStop(
        sums=rows.sums(),
        scatter=None if scatter is None else KeptSums.of(*scatter),
        met=met,
        gradients=gradients,
        weighed=here,
        cost=here.cost(rows.rows, at),
        cost_before=0.0 if weighed is None else weighed.cost(rows.rows, at),
    )


def beams_cost(
    problem: Problem,
    values: Values,
    associations: Sequence[Association],
    weighed: Sequence[Weighing],
) -> float:
    """Half the robust chi-square of all beams at a state.

    Rows of their scatter within holds have no part in what a fit is to lower: their weights go by
    the noise that they tell of, so they come to rest where their score is 0, and not at a minimum.

    Args:
        problem: what is estimated.
        values: the state.
        associations: per scan, what its beams meet.
        weighed: per scan, how its beams are to be weighed.
    """
    placed = lidars(problem.scans, values)
    work = partial(_cost_of_stop, values)
    return sum(over_stops(work, problem.scans, placed, associations, weighed))


def _cost_of_stop(
    values: Values, scan: ScanStop, placed: Placed, association: Association, weighed: Weighing
) -> float:
    rows = scan.rows(values, association, placed.T[0])
    return weighed.cost(rows, partial(_rows_at, scan, association))


def _rows_at(
    scan: ScanStop, association: Association | None, values: Values, T: np.ndarray
) -> Rows:
    return scan.rows(values, association, T)


def lidars(scans: Sequence[ScanStop], values: Values) -> list[Placed]:
    """Where the LiDAR is at every stop, reference frame, with derivatives."""
    frames = list(dict.fromkeys(scan.stops.rig.lidar_frame for scan in scans))
    found: list[Placed | None] = [None] * len(scans)
    for frame in frames:
        some = [i for i, scan in enumerate(scans) if scan.stops.rig.lidar_frame == frame]
        each = place_each([scans[i].stops for i in some], frame, values)
        for i, placed in zip(some, each, strict=True):
            found[i] = placed
    return found
