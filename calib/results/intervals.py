"""Confidence intervals that allow for rows that err together.

The covariance C of the factor graph is right where rows err independently. Rows of one stop do not:
they share whatever the model lacks there. Nor do rows on one region of the room, which share the
mesh's error there, nor the rows of a target. So variances are estimated from clusters of rows. With
W the rows' weights, ``t_c = C J_c^T W b_c`` is what cluster c adds to the estimate, zero in sum at
the optimum; H_c is its information. ``u_c = (1 - K_c)^-1/2 t_c``, in coordinates where C is 1 and
K_c is H_c, are as large as errors are where rows err alone (CR2: Bell and McCaffrey 2002). In units
of a parameter's variance in C its variance is

    v = p + sum_stops u^2 + max(0, sum_regions u^2 - sum_both u^2)

with p the share of rows that belong to no cluster, priors of the hardware above all; targets are
clusters beside the stops, "both" are the cells of stop and region (Cameron, Gelbach and Miller
2011). Regions are many and each holds little, so there, and where stops are more than
`MOST_WHOLE_STOPS`, each parameter is taken by itself: ``u = t / sqrt(1 - h)``, h the cluster's
share of its information. The h also give the degrees of freedom of each sum (Bell and McCaffrey),
and Satterthwaite's formula those of v. No interval is narrower than by C.

Where stops err together 0.92 to 0.95 of 95 % intervals hold, with 4 to 30 stops and 1 to 12
parameters that differ by stop (the worlds of `tests/calib/test_intervals.py`, 600 draws each);
where rows err alone, 0.97 to 0.99.

Of a ring half or more of whose beams are rejected the others may agree by chance: its interval is
that from before the fit.

Errors of a mesh, and of spheres as they were scanned, are the same in all runs that rest on them.
They reach an estimate whose prior is an earlier run in two ways, by what that run said and by the
newer rows; and so does a sphere that was scanned once, and tracked anew for each of two recordings
of one fit. The graph takes them for different errors, so what they make together is added; see
`CommonErrors.together`. The estimate itself stays that of the graph (a consider covariance:
Schmidt 1966; Tapley, Schutz and Born 2004, Statistical Orbit Determination, ch. 6). Of errors of
rows that are `least` times larger than stated, the part that they share with the earlier run is,
too. Where the two ways work against each other, no interval gets narrower than by C.

Estimates are reported with a sigma: half the 95 % interval (t quantile) divided by 1.96.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from calib.effects import FrameOffset
from calib.linear.cluster_sums import ROUNDED_SHARE, ClusterSums
from calib.linear.clusters import ClusteredRows, Gradients
from calib.linear.own import own_rows
from calib.linear.rows import PLACES
from calib.problem import Problem
from calib.problem.prior import CommonErrors, JointPrior
from calib.problem.problem import Block
from calib.problem.unknowns import Role
from calib.residuals.targets import TARGET_PARTS, HangingTarget
from calib.solve.clustered import BeamsAlong, of_cells, of_graph
from calib.solve.estimate import Estimate
from calib.solve.fit import Progress
from calib.solve.graph import KeptRows

REGION = "region"
# Parts of the room, whose beams share the error of the mesh or plane there.
ROOM_PARTS = (REGION, *PLACES)
KNOWN_BEFORE = (Role.CALIBRATION, Role.GRAVITY, Role.ZERO)  # whose own priors are no measurements


@dataclass(frozen=True)
class Intervals:
    """What is known of some unknowns, of Q tangents.

    Args:
        names, dims: of the unknowns, in order.
        graph: (Q, Q) covariance as the graph has it.
        data: (Q, Q) the part of that which is due to errors of rows; the rest is due to priors.
        paper: (Q, Q) the part of it that is due to errors of CAD.
        given: (Q, Q) the part that is due to errors of what was known before any row: of CAD, of
            data sheets, of levels' zeros, and of an earlier run. How far residuals exceed their
            sigmas says nothing of these.
        wider: (Q,) how many times wider than the graph has it each interval is, at least 1.
        least: how many times larger than their sigmas the errors of rows are, at least 1: all but
            what is due to `given` is so much wider.
        cad: how many times wider than stated values of CAD scatter, at least 1.
        repeated: (Q, Q) what errors add that reach the estimate in several ways; 0 where none does.
        common: how it goes with errors that another run may share.
    """

    names: tuple[str, ...]
    dims: tuple[int, ...]
    graph: np.ndarray
    data: np.ndarray
    paper: np.ndarray
    given: np.ndarray
    wider: np.ndarray
    repeated: np.ndarray
    common: CommonErrors
    least: float = 1.0
    cad: float = 1.0

    @property
    def without_repeated(self) -> Intervals:
        """The same, as if in each way in which an error reaches the estimate it were another."""
        return replace(self, repeated=np.zeros_like(self.repeated))

    @property
    def covariance(self) -> np.ndarray:
        """(Q, Q). The variance on top of the graph's is correlated as the data's part is: as the
        whole is, it would go to combinations that priors alone determine. The part of CAD is as
        much larger as CAD is worse than it says."""
        least = self.graph + (self.least**2 - 1.0) * (self.graph - self.given)
        share = np.diag(self.data) / np.diag(self.graph)
        more = np.maximum(np.square(self.wider) - np.diag(least) / np.diag(self.graph), 0.0)
        root = np.sqrt(
            np.where(share > ROUNDED_SHARE, more / np.maximum(share, ROUNDED_SHARE), 0.0)
        )
        wider = np.outer(root, root) * self.data + (self.cad**2 - 1.0) * self.paper
        return self._with_repeated(least + wider)

    def _with_repeated(self, covariance: np.ndarray) -> np.ndarray:
        if not self.repeated.any():
            return covariance
        whole = covariance + self.least * self.repeated
        short = np.sqrt(np.maximum(np.diag(self.graph) / np.diag(whole), 1.0))
        return np.outer(short, short) * whole

    def of(self, names: Sequence[str]) -> Intervals:
        """Those of some of the unknowns, in the order given."""
        ends = np.cumsum([0, *self.dims])
        at = {n: np.arange(a, b) for n, a, b in zip(self.names, ends, ends[1:], strict=False)}
        some = np.concatenate([at[name] for name in names])
        return replace(
            self,
            names=tuple(names),
            dims=tuple(len(at[name]) for name in names),
            graph=self.graph[np.ix_(some, some)],
            data=self.data[np.ix_(some, some)],
            paper=self.paper[np.ix_(some, some)],
            given=self.given[np.ix_(some, some)],
            repeated=self.repeated[np.ix_(some, some)],
            common=self.common.at(some),
            wider=self.wider[some],
        )

    def over(self, estimate: Estimate, names: Sequence[str]) -> np.ndarray:
        """Joint covariance of unknowns of the estimate, in the order given. What the graph does not
        hold, as one stop alone has it, is as well known as by C."""
        known, least = estimate.problem.variables, self.least**2
        found = least * estimate.covariance_of(names)
        found -= (least - 1.0) * self._due_to_given(estimate, names)
        held = np.repeat([name in self.names for name in names], [known[n].dim for n in names])
        some = self.of([name for name in names if name in self.names])
        as_least = least * some.graph - (least - 1.0) * some.given
        found[np.ix_(held, held)] += some.covariance - as_least
        return found

    def _due_to_given(self, estimate: Estimate, names: Sequence[str]) -> np.ndarray | float:
        """The part of the joint covariance of unknowns of the estimate that is due to errors of
        what was known before: of those that the graph does not hold, by how they go with what it
        holds."""
        if self.least == 1.0:
            return 0.0
        if all(name in self.names for name in names):
            return self.of(names).given
        every = [*names, *(name for name in self.names if name not in names)]
        dims = [estimate.problem.variables[name].dim for name in every]
        ends = dict(zip(every, np.cumsum(dims).tolist(), strict=True))
        pairs = zip(self.names, self.dims, strict=True)
        at = np.concatenate([np.arange(ends[name] - dim, ends[name]) for name, dim in pairs])
        mine = np.arange(sum(dims[: len(names)]))
        sigma = np.sqrt(np.diag(self.graph))
        across = estimate.covariance_of(every)[np.ix_(mine, at)] / sigma
        by = np.linalg.solve(self.graph / np.outer(sigma, sigma), across.T).T / sigma
        return by @ self.given @ by.T

    def together(self, estimate: Estimate, names: Sequence[str]) -> np.ndarray:
        """The same for what depends on all of them together, as a place does.

        Each parameter's own factor would spoil sums that the data tell far better than their terms:
        two joints that nothing tells apart, with factors of 1.0 and 1.1, would leave a tenth of the
        sigma of each in what they do together. So all errors of rows here are larger by one factor,
        the one that comes nearest to those of the parameters (least squares in their variances).
        """
        least, found = self.least**2, self.over(estimate, names)
        held = np.repeat(
            [name in self.names for name in names],
            [estimate.problem.variables[name].dim for name in names],
        )
        some = self.of([name for name in names if name in self.names])
        share = np.diag(some.data) / np.diag(some.graph)
        factor = 1.0 + (np.square(some.wider) - 1.0) @ share / max(share @ share, ROUNDED_SHARE)
        more = max(factor - least, 0.0) * some.data + (self.cad**2 - 1.0) * some.paper
        more += least * some.graph - (least - 1.0) * some.given + self.least * some.repeated
        found[np.ix_(held, held)] += more - some.covariance
        return found

    def at_least(self, wider: float, cad: float = 1.0) -> Intervals:
        """With errors of rows that are so many times larger than their sigmas, and those of CAD."""
        return replace(self, least=wider, cad=cad)

    def document(self, names: Sequence[str]) -> dict[str, float | str]:
        """As summary.json holds how much wider they are.

        Args:
            names: (Q,) of the parameters.
        """
        most = int(np.argmax(self.wider))
        return {
            "median": float(np.median(self.wider)),
            "most": float(self.wider[most]),
            "parameter": names[most],
        }


def intervals(estimate: Estimate, progress: Progress = lambda what, done, total: None) -> Intervals:
    """The intervals of all unknowns of an estimate that are in its graph.

    Args:
        estimate: with its graph and linearisation.
        progress: called with what is being done, how many stops are done, and of how many.
    """
    linear, layout, values = estimate.linear, estimate.linear.layout, estimate.values
    sigma = np.sqrt(np.diag(estimate.kept))
    directions = linear.followed(estimate.kept / sigma)
    sums = ClusterSums.over(estimate.kept / np.outer(sigma, sigma))
    problem, places, stops = estimate.problem, Gradients(layout.size), len(layout.stops)
    beams = BeamsAlong(
        problem=problem,
        layout=layout,
        values=values,
        associations=estimate.associations,
        directions=directions,
        places=places,
        kinds=ROOM_PARTS,
        progress=partial(progress, "errors in common of rows"),
    )
    for cells, scatter in beams.cells():
        sums.add_stop(cells, scatter)
    others = [*own_rows(layout, values), *_of_cells(estimate, places)]
    frames, paper, given = in_cad(problem), *np.zeros((2, *estimate.kept.shape))
    known = layout.outer()
    before = {name: unknown.sigma for name, unknown in known.items()}
    for block, name, rows in (graph_rows := [*of_graph(estimate.graph, layout, values)]):
        stated = block is None and problem.variables[name].role in KNOWN_BEFORE
        if stated or isinstance(block, JointPrior):
            A = rows.along(directions).A
            given += A.T @ A
            paper += A.T @ A if stated and name in frames else 0.0
        before |= block.sigmas if isinstance(block, JointPrior) else {}
        if block is not None and block.kind == "target":
            rows, stops = rows._replace(stop=np.full(len(rows.b), stops)), stops + 1
        if not isinstance(block, KeptRows):
            others.append(rows)
    A = np.vstack([rows.along(directions).A for rows in others])
    b, stop, place = (
        np.concatenate([getattr(r, k) for r in others]) for k in ("b", "stop", "place")
    )
    sums.add(ClusteredRows(A=A, b=b, columns=np.arange(A.shape[1]), stop=stop, place=place))
    wider = sums.wider()
    for name, lost in estimate.not_trusted.items():
        at = np.searchsorted(layout.kept, layout.columns([name])[lost])
        wider[at] = np.maximum(wider[at], before[name][lost] / sigma[at])
    repeated, common = _in_common(estimate, graph_rows, directions, sigma)
    return Intervals(
        names=tuple(known),
        dims=tuple(unknown.dim for unknown in known.values()),
        graph=estimate.kept,
        data=estimate.kept - sums.priors * np.outer(sigma, sigma),
        paper=paper * np.outer(sigma, sigma),
        given=given * np.outer(sigma, sigma),
        wider=wider,
        repeated=repeated,
        common=common,
    )


def _in_common(
    estimate: Estimate,
    graph_rows: Sequence[tuple[Block | None, str, ClusteredRows]],
    directions: np.ndarray,
    sigma: np.ndarray,
) -> tuple[np.ndarray, CommonErrors]:
    """What errors that reach an estimate in several ways add to its covariance (Q, Q), and how it
    goes with all that other runs may share.

    Args:
        estimate: the solution.
        graph_rows: as of `of_graph`.
        directions: (U, Q) covariance of all unknowns with the parameters, over their sigmas.
        sigma: (Q,) of the parameters.
    """
    ways = _of_mesh(estimate, directions, sigma)
    for block, _, rows in graph_rows:
        if isinstance(block, JointPrior):
            ways.append(block.off_by(rows.along(directions).A * sigma))
        elif isinstance(block, HangingTarget):
            ways.append(_of_target(block, rows.along(directions).A * sigma))
    return CommonErrors.together(ways, len(sigma))


def _of_mesh(estimate: Estimate, directions: np.ndarray, sigma: np.ndarray) -> list[CommonErrors]:
    """Parts of meshes, by their kind; arguments as of `_in_common`. What an estimate is off by goes
    with the true error of a part as it goes with what is left of that, the other way."""
    found, problem = [], estimate.problem
    for unknown, cells in problem.cells.items():
        if cells.of_mesh:
            width_m = problem.meetings[cells.room].patches_m.get(cells.column, 0.0)
            mesh = f"{problem.sources[cells.room].reference.digest} {cells.column} {width_m:.4f}"
            names = [f"{mesh} {cells.axis} {part}" for part in cells.parts.tolist()]
            rows = directions[estimate.linear.layout.columns([unknown])] * sigma
            by = -rows / problem.variables[unknown].sigma[:, None]
            found.append(CommonErrors(np.array(names), by))
    return found


def _of_target(block: HangingTarget, rows: np.ndarray) -> CommonErrors:
    """What was measured of a target; from its rows, times the covariance (9, Q)."""
    parts = zip(TARGET_PARTS, block.measured_m, strict=True)
    each = [f"{part} {numbers.tobytes().hex()}" for part, numbers in parts]
    names = [f"{part} {axis}" for part in each for axis in "xyz"]
    return CommonErrors(np.array(names), -np.sqrt(block.weights)[:, None] * rows)


def in_cad(problem: Problem) -> frozenset[str]:
    """Unknowns of frames that CAD places."""
    terms = (term for terms in problem.terms for term in terms)
    return frozenset(t.variable for t in terms if isinstance(t.effect, FrameOffset))


def _of_cells(estimate: Estimate, places: Gradients) -> list[ClusteredRows]:
    """Priors of parts of the room, each with the region that it is in; those of whole surfaces are
    with nothing else, as nothing is repeated of a surface."""
    found, region = [], _regions(estimate)
    layout, values = estimate.linear.layout, estimate.values
    for cells, rows in of_cells(estimate.problem, layout, values):
        where = region.get((cells.room, cells.column), {})
        place = [
            places.place((cells.room, where[part])) if part in where else -1
            for part in cells.parts.tolist()
        ]
        found.append(rows._replace(place=np.array(place, int)))
    return found


def _regions(estimate: Estimate) -> dict[tuple[object, str], dict[int, int]]:
    """Room and kind of part -> the region that each part is in, or the first of several."""
    found: dict[tuple[object, str], dict[int, int]] = {}
    for scan, met in zip(estimate.scans, estimate.associations, strict=True):
        if REGION not in met.patches:
            continue
        for kind, part in met.patches.items():
            inner, first = np.unique(part, return_index=True)
            pairs = zip(inner.tolist(), met.patches[REGION][first].tolist(), strict=True)
            found[scan.room, kind] = dict(pairs) | found.get((scan.room, kind), {})
    return found
