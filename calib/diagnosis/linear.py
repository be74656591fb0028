"""All rows at the solution of a fit, with candidates beside the model, and the cluster of each.

At the solution every row is linear in what the model estimates and in what it does not:
``b = J d + Z g + noise``, whitened. The tests need two things of a million such rows: the Gram
matrix of ``[J | Z]``, and the gradient ``[J | Z]^T b`` of each cluster of rows that err together.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_array

from calib.diagnosis.leverage import Leverage
from calib.linear.assembly import alone
from calib.linear.clusters import ClusteredRows, Gradients
from calib.linear.elimination import square
from calib.linear.layout import Layout, positions
from calib.linear.linearise import linearise
from calib.linear.own import OwnRows, own_rows
from calib.linear.system import Linearisation
from calib.outputs.journal import Journal
from calib.problem.problem import Problem
from calib.problem.unknowns import Owner
from calib.residuals.beams import Association
from calib.residuals.compiled import add_at
from calib.solve.clustered import BeamsAlong, of_cells, of_graph
from calib.solve.estimate import Estimate
from calib.solve.fit import Progress
from calib.solve.graph import Graph
from calib.solve.reweight import weighted_as

# Priors of the hardware (CAD, data sheets) are no evidence against a candidate. Their sigmas are
# widened by this factor: what only a prior could tell from a candidate then counts as a gauge.
WIDENED = 100.0
# Beams of all scans together that tell what is missing, and of each scan at any rate; all, if they
# are no more. Both are choices: the sigma of one of 128 parameters by four million beams of 2 mm is
# 0.01 mm, and errors of stops and of the mesh are larger.
LOOKED_BEAMS, FEWEST_LOOKED = 2**22, 4096
# All beams looked at judge a candidate if their rows take no more numbers than this (268 MB), one
# for each direction: of each stop and surface no more rows are kept than there are directions.
JUDGING_NUMBERS = 2**25
# Else beams are drawn whose rows take so many numbers, and at least so many of each stop; both are
# choices. By n beams that tell of a direction, the variance of a score of k sigmas in it is told
# larger by 2 k^2 / n, as the share of each stop in the information is known less well.
DRAWN_NUMBERS = 2**26
FEWEST_DRAWN = 1024
NONE = np.zeros(0, int)  # the stops, or places, of no clusters


@dataclass(frozen=True)
class Linear:
    """Normal equations of S unknowns about a solution, and their right side by clusters of rows.

    What belongs to stops and surfaces is eliminated from the equations, and expressed by the S in
    the gradients. These are made of residuals as large as errors are (`leverage`).

    Args:
        candidates: unknowns that the model does not have; they have no prior.
        owner: unknown -> whose it is.
        at: unknown -> its columns among the S, of those that were not eliminated.
        columns: unknown -> its columns among all U.
        information: (S, S) of all rows; the priors of the hardware widened.
        raw: unknown -> (n, n) the same of it alone, before anything was eliminated.
        gradient: (C, S) of each cluster of rows.
        score: (S,) the whole gradient, of residuals as they are.
        others: all rows but those of beams, of residuals as large as errors are.
        stop: (C,) which stop the rows of a cluster belong to, -1 for none.
        place: (C,) which part of the room they look at, -1 for none.
        places: part of the room -> its number.
        weight_m2: sum of the beams' weights over their variances [1/m2]; without beams that of the
            tracked positions.
        looked, beams: how many beams are looked at, and how many meet anything.
        whole: the linearisation that these are made of.

    Where nothing more is to be judged, `raw` and `whole` are None, and there are no clusters.
    """

    candidates: tuple[str, ...]
    owner: Mapping[str, Owner]
    at: Mapping[str, np.ndarray]
    columns: Mapping[str, slice]
    information: np.ndarray
    raw: Mapping[str, np.ndarray] | None
    gradient: np.ndarray
    score: np.ndarray
    others: Sequence[ClusteredRows | OwnRows]
    stop: np.ndarray
    place: np.ndarray
    places: dict[object, int]
    weight_m2: float
    whole: Linearisation | None
    looked: int = 0
    beams: int = 0

    @property
    def beams_drawn(self) -> list[str]:
        """A sentence that says in how many of the beams what is missing was looked for; none where
        it was in all."""
        if self.looked == self.beams:
            return []
        share = f"{self.looked:,} of {self.beams:,} beams"
        return [f"What is missing was looked for in {share}, drawn evenly from every surface."]

    def among(self, names: Sequence[str]) -> np.ndarray:
        """Columns of some unknowns among the S, in the order given."""
        return np.concatenate([self.at[name] for name in names])

    def thinned(self) -> Linear:
        """Without all that only judging needs."""
        return replace(
            self,
            raw=None,
            gradient=self.gradient[:0].copy(),
            others=(),
            stop=NONE,
            place=NONE,
            whole=None,
        )


def _count(association: Association) -> int:
    """How many beams meet anything."""
    return int(np.count_nonzero(association.part >= 0))


def beams_looked_at(associations: Sequence[Association]) -> int:
    """How many beams of each scan, at most, tell what is missing; of scans with fewer, all do."""
    met = np.sort([_count(each) for each in associations])
    before = np.concatenate([[0], np.cumsum(met)[:-1]])
    level = (LOOKED_BEAMS - before) // np.arange(len(met), 0, -1)  # if those before have fewer
    some = level[level < met]
    return max(int(some[0]) if len(some) else LOOKED_BEAMS, FEWEST_LOOKED)


def rows_along(
    linear: Linear,
    wide: Problem,
    estimate: Estimate,
    away: np.ndarray,
    progress: Callable[[int, int], None],
) -> Iterator[ClusteredRows]:
    """Weighted rows along some directions: all that are of no beam, and of `beams_looked_at` or,
    where these are too many, of fewer beams (see `JUDGING_NUMBERS`).

    Args:
        linear: that knows these directions, and the rows that are of no beam.
        wide: the model's problem with the unknowns added that beams are to be differentiated by.
        estimate: the model's solution.
        away: (U, r) the directions.
        progress: called with how many stops are done, and of how many.
    """
    for rows in linear.others:
        yield rows.along(away)
    if not wide.scans:
        return
    wide, values = beside(wide, estimate)
    most, count = beams_looked_at(estimate.associations), away.shape[1]
    wide, associations = _drawn(wide, estimate.associations, most)
    candidates = [name for name in wide.variables if name not in estimate.values]
    layout = Layout.of(wide, unbounded=candidates)
    beams = BeamsAlong(
        problem=wide,
        layout=layout,
        values=values,
        associations=associations,
        directions=np.concatenate([away[linear.columns[name]] for name in layout.at]),
        places=Gradients(layout.size, linear.places),
        progress=progress,
    )
    fewer, cells = None, np.count_nonzero((linear.stop >= 0) & (linear.place >= 0))
    if cells * count**2 > JUDGING_NUMBERS:
        fewer = max(DRAWN_NUMBERS // (count * len(wide.scans)), FEWEST_DRAWN)
    yield from beams.rows(fewer)


def beside(wide: Problem, estimate: Estimate) -> tuple[Problem, dict[str, np.ndarray]]:
    """A problem with candidates at a model's solution: with the surfaces' unknowns and the robust
    weights of that, and the candidates at zero."""
    cells, wide = estimate.problem.cells, weighted_as(wide, estimate.problem)
    wide = wide.setting_aside(estimate.problem.set_aside)
    wide = wide.with_cells([estimate.problem.variables[name] for name in cells], cells)
    absent = {n: u.mean for n, u in wide.variables.items() if n not in estimate.values}
    return wide, absent | estimate.values


def linearise_with(
    wide: Problem,
    estimate: Estimate,
    candidates: Sequence[str],
    progress: Progress,
    most: int,
) -> Linear:
    """Linearise a problem that holds candidates beside the model, at the model's solution.

    Args:
        wide: the model's problem with the candidates' unknowns added.
        estimate: the model's solution.
        candidates: unknowns that the model does not have; they have no prior here.
        progress: called with what is being done, how many stops are done, and of how many.
        most: about how many beams of each scan at most.
    """
    wide, values = beside(wide, estimate)
    wide, associations = _drawn(wide, estimate.associations, most)
    layout = Layout.of(wide, unbounded=candidates)
    gradients, own = Gradients(layout.size), own_rows(layout, values)
    linear = linearise(
        wide,
        values,
        associations,
        layout=layout,
        gradients=gradients,
        own=own,
        journal=Journal(),
        progress=lambda done, total: progress("testing what is missing", done, total),
    )
    information, raw = linear.kept[:-1, :-1].copy(), linear.raw
    others = list(other_rows(wide, layout, values, gradients, own))
    _add_others(others, layout, information, raw)
    grown = Leverage.of(information, layout, values, WIDENED).grown(others, layout)
    more = np.zeros(layout.size)
    for rows, larger in zip(others, grown, strict=True):
        gradients.add_entries(*larger.gradients())
        rows.add_gradient(larger.b - rows.b, more)
    _in_own_units(layout, information, raw)
    table, stop, place = gradients.table()
    whole, at = csr_array(table.sum(axis=0)[None] - more), positions(layout.size, layout.kept)
    return Linear(
        candidates=tuple(candidates),
        owner={name: unknown.owner for name, unknown in wide.variables.items()},
        at={name: at[np.r_[layout.at[name]]] for name in layout.outer()},
        columns=layout.at,
        information=information,
        raw=raw,
        gradient=linear.reduced(table),
        others=grown,
        score=linear.reduced(whole)[0],
        stop=stop,
        place=place,
        places=gradients.places,
        weight_m2=linear.weight_m2 or sum(len(b.measured) / b.sigma_m**2 for b in wide.bodies),
        whole=replace(linear, raw=None, layout=replace(layout, bodies=(), others=())),  # all here
        looked=sum(map(_count, associations)),
        beams=sum(map(_count, estimate.associations)),
    )


def _drawn(
    problem: Problem, associations: Sequence[Association], most: int
) -> tuple[Problem, Sequence[Association]]:
    """A problem with about so many beams of each scan, drawn from those on each surface, and what
    they meet; all of no more."""
    met = zip(problem.scans, associations, strict=True)
    some = [scan.some(association, most) for scan, association in met]
    return replace(problem, scans=[s for s, _, _ in some]), [a for _, a, _ in some]


def _add_others(
    others: Sequence[ClusteredRows | OwnRows],
    layout: Layout,
    information: np.ndarray,
    raw: Mapping[str, np.ndarray],
) -> None:
    """Add rows that are about kept unknowns alone, the others being in a linearisation, to what
    that tells of these together, and of each alone."""
    at = positions(layout.size, layout.kept)
    alike: dict[bytes, list[ClusteredRows]] = {}  # of the same unknowns, as most poses of an arm
    for rows in (r for r in others if isinstance(r, ClusteredRows)):
        if (at[rows.columns] >= 0).all():
            alike.setdefault(rows.columns.tobytes(), []).append(rows)
    for some in alike.values():
        columns = some[0].columns
        A = np.vstack([rows.A for rows in some]) if len(some) > 1 else some[0].A
        unit = layout.sigma[columns]
        found = square(A) * unit * unit[:, None]
        add_at(information, at[columns], at[columns], found)
        for name, mine, its in alone(layout, columns):
            raw[name][np.ix_(its, its)] += found[mine, mine]


def _in_own_units(layout: Layout, information: np.ndarray, raw: Mapping[str, np.ndarray]) -> None:
    """Turn information in units of sigmas, of all kept unknowns and of each alone, into such in
    their own; in its place, as there may be thousands of columns."""
    for told, unit in [
        (information, layout.sigma[layout.kept]),
        *((block, layout.sigma[layout.at[name]]) for name, block in raw.items()),
    ]:
        told /= unit
        told /= unit[:, None]


def other_rows(
    wide: Problem,
    layout: Layout,
    values: Mapping[str, np.ndarray],
    places: Gradients,
    own: Sequence[OwnRows],
) -> Iterator[ClusteredRows | OwnRows]:
    """Rows of tracked bodies, targets and priors, with the stop and place that each errs with: each
    target, and each row of a prior that no stop has for itself, is a place of its own."""
    yield from own
    for cells, rows in of_cells(wide, layout, values):
        yield rows._replace(place=places.numbers(cells.room, cells.surface))
    graph = Graph(list(layout.outer().values()), layout.others, layout.unbounded)
    for block, name, rows in of_graph(graph, layout, values):
        if block is None and name in wide.calibration:
            rows = rows._replace(A=rows.A / WIDENED, b=rows.b / WIDENED)
        if block is not None and rows.stop[0] < 0:
            rows = rows._replace(place=np.full(len(rows.b), places.place(block.name)))
        elif rows.stop[0] < 0:
            each = [places.place((name, dof)) for dof in wide.variables[name].dofs]
            rows = rows._replace(place=np.array(each))
        yield rows
