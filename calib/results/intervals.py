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

Estimates are reported with a sigma: half the 95 % interval (t quantile) divided by 1.96.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from types import MappingProxyType

import numpy as np
from scipy import special
from scipy.linalg import solve_triangular

from calib.linear.clusters import CellSums, ClusteredRows, Gradients, summed
from calib.linear.linearise import own_rows
from calib.linear.rows import PLACES
from calib.results.errors import in_cad
from calib.solve.clustered import BeamsAlong, of_cells, of_graph, of_stops
from calib.solve.estimate import Estimate
from calib.solve.fit import Progress
from calib.solve.graph import KeptRows

REGION = "region"
# Parts of the room, whose beams share the error of the mesh or plane there.
ROOM_PARTS = (REGION, *PLACES)
# Degrees of freedom that t has at least. With fewer it grows without bound (12.7 with 1): such an
# interval would speak of the clusters, not of the estimate. With 4 stops 0.94 hold with it.
FEWEST_DOF = 2.5
NORMAL_DOF = 1e6  # degrees of freedom at which t is normal
# Of what is known of a parameter, or of a direction: a cluster with more of it is alone with it and
# leaves nothing to compare it with.
ALONE = 0.999
ROUNDED_SHARE = 1e-9  # of the same: what clusters hold of it is rounding
# Of correlations: unknowns that priors tie to each other make them near singular.
CORRELATION_ROUNDING = 1e-12
# Stops, up to which each is taken for all parameters at once; of more each holds next to nothing.
MOST_WHOLE_STOPS = 200
LEVEL = 0.975  # the quantile at which a 95 % interval ends
NORMAL = float(special.ndtri(LEVEL))


@dataclass(frozen=True)
class Intervals:
    """What is known of some unknowns, of Q tangents.

    Args:
        names, dims: of the unknowns, in order.
        graph: (Q, Q) covariance as the graph has it.
        data: (Q, Q) the part of that which is due to errors of rows; the rest is due to priors.
        paper: (Q, Q) the part of it that is due to errors of CAD.
        wider: (Q,) how many times wider than the graph has it each interval is, at least 1.
        least: how many times wider all of them are at least.
        cad: how many times wider than stated values of CAD scatter, at least 1.
    """

    names: tuple[str, ...]
    dims: tuple[int, ...]
    graph: np.ndarray
    data: np.ndarray
    paper: np.ndarray
    wider: np.ndarray
    least: float = 1.0
    cad: float = 1.0

    @property
    def covariance(self) -> np.ndarray:
        """(Q, Q). The variance on top of the graph's is correlated as the data's part is: as the
        whole is, it would go to combinations that priors alone determine. The part of CAD is as
        much larger as CAD is worse than it says."""
        share = np.diag(self.data) / np.diag(self.graph)
        more = np.maximum(np.square(self.wider) - self.least**2, 0.0)
        root = np.sqrt(
            np.where(share > ROUNDED_SHARE, more / np.maximum(share, ROUNDED_SHARE), 0.0)
        )
        paper = max(self.cad**2 - self.least**2, 0.0) * self.paper
        return self.least**2 * self.graph + np.outer(root, root) * self.data + paper

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
            wider=self.wider[some],
        )

    def over(self, estimate: Estimate, names: Sequence[str]) -> np.ndarray:
        """Joint covariance of unknowns of the estimate, in the order given. What the graph does not
        hold, as one stop alone has it, is as well known as by C."""
        known, found = estimate.problem.variables, self.least**2 * estimate.covariance_of(names)
        held = np.repeat([name in self.names for name in names], [known[n].dim for n in names])
        some = self.of([name for name in names if name in self.names])
        found[np.ix_(held, held)] += some.covariance - self.least**2 * some.graph
        return found

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
        more = max(factor - least, 0.0) * some.data + max(self.cad**2 - least, 0.0) * some.paper
        found[np.ix_(held, held)] += least * some.graph + more - some.covariance
        return found

    def at_least(self, wider: float, cad: float = 1.0) -> Intervals:
        """With every interval at least so many times wider than the graph has it, and what CAD
        adds to each so many times larger."""
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
    sums = _Sums.over(estimate.kept / np.outer(sigma, sigma))
    places, stops = Gradients(layout.size), len(layout.stops)
    problem, met = estimate.problem, estimate.associations
    tell = partial(progress, "errors in common of rows")
    beams = BeamsAlong(
        problem=problem,
        layout=layout,
        values=values,
        associations=met,
        directions=directions,
        places=places,
        kinds=ROOM_PARTS,
        progress=tell,
    )
    for cells, scatter in beams.cells():
        sums.add_stop(cells, scatter)
    others = [*of_stops(own_rows(layout, values)), *_of_cells(estimate, places)]
    frames, paper = in_cad(problem), np.zeros_like(estimate.kept)
    for block, name, rows in of_graph(estimate.graph, layout, values):
        if block is None and name in frames:
            A = rows.A @ directions[rows.columns]
            paper += A.T @ A
        if block is not None and block.kind == "target":
            rows, stops = rows._replace(stop=np.full(len(rows.b), stops)), stops + 1
        if not isinstance(block, KeptRows):
            others.append(rows)
    A = np.vstack([rows.A @ directions[rows.columns] for rows in others])
    b, stop, place = (
        np.concatenate([getattr(r, k) for r in others]) for k in ("b", "stop", "place")
    )
    every = np.arange(directions.shape[1])
    sums.add(ClusteredRows(A=A, b=b, columns=every, stop=stop, place=place))
    known = layout.outer()
    return Intervals(
        names=tuple(known),
        dims=tuple(unknown.dim for unknown in known.values()),
        graph=estimate.kept,
        data=estimate.kept - sums.priors * np.outer(sigma, sigma),
        paper=paper * np.outer(sigma, sigma),
        wider=sums.wider(),
    )


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


@dataclass
class _Clusters:
    """What clusters of one kind add to each of P parameters.

    Args:
        parameters: P.
        row: number of a cluster -> its row in what follows, of which there are more than are used.
        moved: (m, P) what the cluster's rows add.
        share: (m, P) of what is known of a parameter.
    """

    parameters: int
    row: dict[int, int] = field(default_factory=dict)
    moved: np.ndarray = field(init=False)
    share: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        self.moved, self.share = np.zeros((2, 1, self.parameters))

    def add(self, number: np.ndarray, moved: np.ndarray, share: np.ndarray) -> None:
        """Add (c, P) to the clusters of these numbers (c,), of which one may stand twice."""
        numbers, at = np.unique(number, return_inverse=True)
        rows = [self.row.setdefault(n, len(self.row)) for n in numbers.tolist()]
        if len(self.row) > len(self.moved):
            more = ((0, 2 * len(self.row) - len(self.moved)), (0, 0))
            self.moved, self.share = np.pad(self.moved, more), np.pad(self.share, more)
        self.moved[rows] += summed(moved, at)
        self.share[rows] += summed(share, at)

    def squares(
        self, known: Mapping[int, np.ndarray] = MappingProxyType({})
    ) -> tuple[np.ndarray, np.ndarray]:
        """The sum over clusters of u^2 (P,), and its degrees of freedom.

        Args:
            known: number of a cluster -> its u (P,); of the others each parameter by itself.
        """
        count = len(self.row)
        share = np.minimum(self.share[:count], ALONE)
        u = self.moved[:count] / np.sqrt(1.0 - share)
        for cluster, whole in known.items():
            u[self.row[cluster]] = whole
        product = np.square(share) / (1.0 - share)  # of two clusters' u, expected
        among = np.square(product.sum(axis=0)) - np.square(product).sum(axis=0)
        least = np.maximum(np.square(share).sum(axis=0) + among, 1e-300)
        d = np.maximum(np.square(share.sum(axis=0)) / least, 1.0)
        return np.square(u).sum(axis=0), d


@dataclass
class _Sums:
    """What clusters of rows add to each of P parameters, in units of the graph's sigma.

    Args:
        root: (P, P) lower Cholesky factor of the correlations, as the graph has them.
        priors: (P, P) products of rows that belong to no cluster.
        stops: stop -> (P, P) the same of its rows.
        by_stop, by_part: clusters. What has no stop is a cluster of its part among the stops, and
            the other way round: number n is then -1 - n.
        by_both: (P,) the sum of u^2 over cells of stop and part.
    """

    root: np.ndarray
    priors: np.ndarray
    by_stop: _Clusters
    by_part: _Clusters
    by_both: np.ndarray
    stops: dict[int, np.ndarray] = field(default_factory=dict)

    @classmethod
    def over(cls, correlation: np.ndarray) -> _Sums:
        """With no rows yet."""
        count = len(correlation)
        return cls(
            root=np.linalg.cholesky(correlation + CORRELATION_ROUNDING * np.eye(count)),
            priors=np.zeros_like(correlation),
            by_stop=_Clusters(count),
            by_part=_Clusters(count),
            by_both=np.zeros(count),
        )

    def add(self, rows: ClusteredRows) -> None:
        """Add whitened rows along the directions of the parameters: all that there are of a stop
        and part, but for beams."""
        alone = (rows.stop < 0) & (rows.place < 0)
        if alone.any():
            self.priors += rows.A[alone].T @ rows.A[alone]
        if alone.all():
            return
        A, b, stop, part = (x[~alone] for x in (rows.A, rows.b, rows.stop, rows.place))
        _, first, at = np.unique(_pairs(stop, part), True, True)
        moved, share = summed(A * b[:, None], at), summed(np.square(A), at)
        self._add_cells(stop[first], part[first], moved, share)
        for one in np.unique(stop[stop >= 0])[: MOST_WHOLE_STOPS + 1].tolist():
            mine = A[stop == one]
            self._add_products(one, mine.T @ mine)

    def add_stop(self, sums: CellSums, scatter: ClusteredRows | None = None) -> None:
        """Add the whitened rows of the beams of a stop along the directions of the parameters, as
        sums, and its rows of scatter within holds."""
        place, moved, share, products = sums.place, sums.moved, sums.share, sums.products
        if scatter is not None:
            place, at = np.unique(np.append(place, scatter.place), return_inverse=True)
            moved = summed(np.vstack([moved, scatter.A * scatter.b[:, None]]), at)
            share = summed(np.vstack([share, np.square(scatter.A)]), at)
            products = products + scatter.A.T @ scatter.A
        self._add_cells(np.full(len(place), sums.stop), place, moved, share)
        self._add_products(sums.stop, products)

    def _add_cells(
        self, stop: np.ndarray, part: np.ndarray, moved: np.ndarray, share: np.ndarray
    ) -> None:
        """Add (c, P) of cells of stop and part (c,), each of which is added once."""
        self.by_stop.add(np.where(stop >= 0, stop, -1 - part), moved, share)
        self.by_part.add(np.where(part >= 0, part, -1 - stop), moved, share)
        self.by_both += (np.square(moved) / (1.0 - np.minimum(share, ALONE))).sum(axis=0)

    def _add_products(self, stop: int, products: np.ndarray) -> None:
        if len(self.stops) <= MOST_WHOLE_STOPS:
            self.stops[stop] = self.stops.get(stop, 0.0) + products

    def wider(self) -> np.ndarray:
        """How many times wider the intervals are than the graph has them (P,)."""
        by_stop, d_stop = self.by_stop.squares(self._of_stops())
        by_part, d_part = self.by_part.squares()
        beyond = np.maximum(by_part - self.by_both, 0.0)
        variance = np.diag(self.priors) + by_stop + beyond
        d = np.square(variance) / np.maximum(by_stop**2 / d_stop + beyond**2 / d_part, 1e-300)
        wider = (
            np.sqrt(variance) * special.stdtrit(np.clip(d, FEWEST_DOF, NORMAL_DOF), LEVEL) / NORMAL
        )
        known = self.by_stop.share.sum(axis=0) > ROUNDED_SHARE
        return np.where(known, np.maximum(1.0, wider), 1.0)

    def _of_stops(self) -> dict[int, np.ndarray]:
        """Stop -> u (P,) of all parameters at once, where stops are few."""
        found = {}
        for stop, products in self.stops.items() if len(self.stops) <= MOST_WHOLE_STOPS else ():
            half = solve_triangular(self.root, products, lower=True)
            values, axes = np.linalg.eigh(solve_triangular(self.root, half.T, lower=True))
            t = self.by_stop.moved[self.by_stop.row[stop]]
            along = axes.T @ solve_triangular(self.root, t, lower=True)
            u = along / np.sqrt(1.0 - np.clip(values, 0.0, ALONE))
            found[stop] = self.root @ axes @ u
        return found


def _pairs(stop: np.ndarray, part: np.ndarray) -> np.ndarray:
    """A number of each pair of stop and part (N,), -1 for none."""
    return (stop + 1) * (int(part.max()) + 2) + part + 1
