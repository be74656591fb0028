"""All rows along some directions, each with what it errs with: its stop, and what it looks at.

Rows of one stop err together, and so do those that meet one part of the room: a stop's pose, its
air and its hour are the same for all its rows, and the mesh is as wrong for every beam that meets
it there.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeVar

import numpy as np
from scipy.sparse import csr_array, diags_array

from calib.forward import Placed
from calib.linear.clusters import CellSums, ClusteredRows, Gradients
from calib.linear.layout import Layout, keys_of
from calib.linear.linearise import ScatterRows, lidars
from calib.linear.parallel import over_stops
from calib.linear.rows import PLACES, StopRows
from calib.problem.problem import Block, Problem, SurfaceCells
from calib.residuals.beams import Association
from calib.residuals.scan import ScanStop
from calib.residuals.seen import SeenBody
from calib.solve.graph import Graph

T = TypeVar("T")
Values = Mapping[str, np.ndarray]
Found = Callable[[StopRows, np.ndarray, int], T]


@dataclass(frozen=True)
class BeamsAlong:
    """Beams along some directions, all or some of each stop; a few stops' in memory at a time.

    Args:
        problem: with its scans.
        layout: of its unknowns.
        values: the state.
        associations: per scan, what its beams meet.
        directions: (U, r) in all unknowns, along which derivatives are wanted.
        places: numbers what beams look at.
        kinds: columns that say what a beam looks at; the first there is.
        progress: called with how many stops are done, and of how many.
    """

    problem: Problem
    layout: Layout
    values: Values
    associations: Sequence[Association]
    directions: np.ndarray
    places: Gradients
    kinds: Sequence[str] = PLACES
    progress: Callable[[int, int], None] = lambda done, total: None

    def rows(self, most: int | None = None) -> Iterator[ClusteredRows]:
        """Weighted rows of every beam or, of a stop with more than `most` of them, of about so many
        that are drawn (see `ScanStop.some`). Their information is about that of all beams; their
        gradient is not."""
        for (A, b, more, stop, cluster), place in self._each_stop(_rows_along, most):
            at = np.full(len(cluster), stop), place[cluster]
            yield self._clustered(A, b, *at)
            if more is not None:
                yield self._clustered(*more, *at)

    def cells(self) -> Iterator[tuple[CellSums, ClusteredRows | None]]:
        """Sums of the weighted rows of each stop, by what they look at; and its rows of scatter
        within holds, where there are any."""
        for (sums, more, stop, cluster), place in self._each_stop(_cells_along):
            found = None
            if more is not None:
                found = self._clustered(*more, np.full(len(cluster), stop), place[cluster])
            yield CellSums(stop=stop, place=place, **sums), found

    def _clustered(
        self, A: np.ndarray, b: np.ndarray, stop: np.ndarray, place: np.ndarray
    ) -> ClusteredRows:
        along = np.arange(self.directions.shape[1])
        return ClusteredRows(A=A, b=b, columns=along, stop=stop, place=place)

    def _each_stop(
        self, found: Callable[..., T], most: int | None = None
    ) -> Iterator[tuple[T, np.ndarray]]:
        state = self.problem, self.layout, self.values, self.associations
        along = partial(found, self.layout, self.directions)
        return each_stop(*state, self.places, along, self.kinds, self.progress, most)


def _rows_along(
    layout: Layout, directions: np.ndarray, rows: StopRows, cluster: np.ndarray, count: int
) -> tuple[Any, ...]:
    root = np.sqrt(rows.weight)
    A = rows.along(directions) * root[:, None]
    return A, root * rows.b, _scatter(layout, directions, rows), rows.stop, cluster


def _cells_along(
    layout: Layout, directions: np.ndarray, rows: StopRows, cluster: np.ndarray, count: int
) -> tuple[Any, ...]:
    gradient, columns = rows.gradient(cluster, count)
    sums = {
        "moved": gradient @ directions[columns],
        "share": rows.squares_along(directions, cluster, count),
        "products": rows.sums().along(directions),
    }
    scatter = _scatter(layout, directions, rows)
    # Which row meets what is asked of rows of scatter alone.
    return sums, scatter, rows.stop, None if scatter is None else cluster


def _scatter(
    layout: Layout, directions: np.ndarray, rows: StopRows
) -> tuple[np.ndarray, np.ndarray] | None:
    """Derivatives and right side of the rows of scatter within holds."""
    if rows.rows.spread is None:
        return None
    more = ScatterRows.of(rows.rows.spread, layout)
    return more.A @ directions[more.columns], more.b


def each_stop(
    problem: Problem,
    layout: Layout,
    values: Values,
    associations: Sequence[Association],
    places: Gradients,
    found: Found[T],
    kinds: Sequence[str] = PLACES,
    progress: Callable[[int, int], None] = lambda done, total: None,
    most: int | None = None,
) -> Iterator[tuple[T, np.ndarray]]:
    """What is found of the rows of each stop, and the numbers of what they meet; arguments as of
    `BeamsAlong`.

    Args:
        found: a function of a module, or a partial of one, called with the rows of a stop, which of
            what they meet each meets, and how many there are.
        most: about so many beams of each stop are drawn (see `ScanStop.some`); all where None.
    """
    scans = problem.scans
    work = partial(_of_rows, layout, values, found, kinds, most)
    of_each = over_stops(work, scans, lidars(scans, values), associations)
    for i, (parts, told) in enumerate(of_each):
        progress(i, len(scans))
        yield told, places.numbers(scans[i].room, parts)  # here: their order is that of the stops


def _of_rows(
    layout: Layout,
    values: Values,
    found: Found[T],
    kinds: Sequence[str],
    most: int | None,
    scan: ScanStop,
    placed: Placed,
    association: Association,
) -> tuple[np.ndarray, T]:
    times = None
    if most is not None:
        scan, association, times = scan.some(association, most)
    rows = StopRows.of(scan, layout, values, placed, association, times=times)
    parts, cluster = rows.places(kinds)
    return parts, found(rows, cluster, len(parts))


def of_cells(
    problem: Problem, layout: Layout, values: Values
) -> Iterator[tuple[SurfaceCells, ClusteredRows]]:
    """Parts of surfaces, and the priors of how far these stand off: of no stop, and of no place as
    long as nobody says of which."""
    for name, cells in problem.cells.items():
        sigma = problem.variables[name].sigma
        A, b = csr_array(diags_array(1.0 / sigma)), -values[name] / sigma
        nowhere = np.full(len(b), -1)
        columns = np.r_[layout.at[name]]
        yield cells, ClusteredRows(A=A, b=b, columns=columns, stop=nowhere, place=nowhere)


def of_graph(
    graph: Graph, layout: Layout, values: Values
) -> Iterator[tuple[Block | None, str, ClusteredRows]]:
    """Rows of a graph that are in no linearisation: their block, none for a prior; the first of
    their unknowns; and the rows, of a stop where they are of one, and of no place."""
    for block, by, b in graph.linear_rows(values):
        A, columns, name = np.hstack(list(by.values())), layout.columns(list(by)), next(iter(by))
        stop = nowhere = np.full(len(b), -1)
        if isinstance(block, SeenBody):
            numbers = [layout.stops[key] for key in keys_of(block)]
            stop = np.repeat(numbers, len(b) // len(numbers))
        elif block is None:
            # The prior of an unknown that one stop alone touches belongs to that stop.
            known = layout.touched.get(name, frozenset())
            stop = np.full(len(b), *known) if len(known) == 1 else nowhere
        rows = ClusteredRows(A=A, b=b, columns=columns, stop=stop, place=nowhere)
        yield block, name, rows
