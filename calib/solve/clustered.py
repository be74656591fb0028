"""All rows along some directions, each with what it errs with: its stop, and what it looks at.

Rows of one stop err together, and so do those that meet one part of the room: a stop's pose, its
air and its hour are the same for all its rows, and the mesh is as wrong for every beam that meets
it there.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np
from scipy.sparse import csr_array, diags_array

from calib.linear.clusters import ClusteredRows, Gradients
from calib.linear.layout import Layout, keys_of
from calib.linear.linearise import lidars, own_rows, spread_rows
from calib.linear.parallel import in_order
from calib.linear.rows import PLACES, StopRows
from calib.problem.problem import Block, Problem, SurfaceCells
from calib.residuals.beams import Association
from calib.residuals.tracker import TrackedBody
from calib.solve.graph import Graph

Values = Mapping[str, np.ndarray]


def of_beams(
    problem: Problem,
    layout: Layout,
    values: Values,
    associations: Sequence[Association],
    directions: np.ndarray,
    places: Gradients,
    kinds: Sequence[str] = PLACES,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Iterator[ClusteredRows]:
    """Rows of beams, weighted; no more than a few stops' in memory.

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
    scans, placed = problem.scans, lidars(problem.scans, values)
    every = np.arange(directions.shape[1])

    def work(i: int) -> tuple[np.ndarray, np.ndarray, list[ClusteredRows]]:
        rows = StopRows.of(scans[i], layout, values, placed[i], associations[i])
        root = np.sqrt(rows.weight)
        parts, cluster = rows.places(kinds)
        stop = np.full(len(root), rows.stop)
        A, b = rows.along(directions) * root[:, None], root * rows.b
        found = [ClusteredRows(A, b, every, stop, cluster)]
        if rows.rows.spread is not None:
            more = spread_rows(rows.rows.spread, layout)
            A, b = more.A @ directions[more.columns], more.b
            found.append(ClusteredRows(A, b, every, stop, cluster))
        return parts, cluster, found

    for i, (parts, cluster, found) in enumerate(in_order(work, len(scans))):
        progress(i, len(scans))
        place = places.numbers(scans[i].room, parts)[cluster]  # here: threads would race for them
        yield from (rows._replace(place=place) for rows in found)


def of_stops(layout: Layout, values: Values) -> Iterator[ClusteredRows]:
    """Rows about what stops alone have: tracked bodies, and priors."""
    for stop, found in own_rows(layout, values).items():
        for rows in found.values():
            every = np.full(len(rows.b), stop), np.full(len(rows.b), -1)
            yield ClusteredRows(rows.A, rows.b, rows.columns, *every)


def of_cells(
    problem: Problem, layout: Layout, values: Values
) -> Iterator[tuple[SurfaceCells, ClusteredRows]]:
    """Parts of surfaces, and the priors of how far these stand off: of no stop, and of no place as
    long as nobody says of which."""
    for name, cells in problem.cells.items():
        sigma = problem.variables[name].sigma
        A, b = csr_array(diags_array(1.0 / sigma)), -values[name] / sigma
        nowhere = np.full(len(b), -1)
        yield cells, ClusteredRows(A, b, np.r_[layout.at[name]], nowhere, nowhere)


def of_graph(
    graph: Graph, layout: Layout, values: Values
) -> Iterator[tuple[Block | None, str, ClusteredRows]]:
    """Rows of a graph that are in no linearisation: their block, none for a prior; the first of
    their unknowns; and the rows, of a stop where they are of one, and of no place."""
    for block, by, b in graph.linear_rows(values):
        A, columns, name = np.hstack(list(by.values())), layout.columns(list(by)), next(iter(by))
        stop = nowhere = np.full(len(b), -1)
        if isinstance(block, TrackedBody):
            numbers = [layout.stops[key] for key in keys_of(block)]
            stop = np.repeat(numbers, len(b) // len(numbers))
        elif block is None:
            # The prior of an unknown that one stop alone touches belongs to that stop.
            known = layout.touched.get(name, frozenset())
            stop = np.full(len(b), *known) if len(known) == 1 else nowhere
        yield block, name, ClusteredRows(A, b, columns, stop, nowhere)
