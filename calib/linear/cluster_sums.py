"""What clusters of rows add to parameters, and how much wider intervals are for it; the formulas
are those of `calib.results.intervals`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np
from scipy import special
from scipy.linalg import solve_triangular

from calib.linear.clusters import CellSums, ClusteredRows, summed
from calib.linear.symmetric import eigh

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
class ClusterSums:
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
    def over(cls, correlation: np.ndarray) -> ClusterSums:
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
            values, axes = eigh(solve_triangular(self.root, half.T, lower=True))
            t = self.by_stop.moved[self.by_stop.row[stop]]
            along = axes.T @ solve_triangular(self.root, t, lower=True)
            u = along / np.sqrt(1.0 - np.clip(values, 0.0, ALONE))
            found[stop] = self.root @ axes @ u
        return found


def _pairs(stop: np.ndarray, part: np.ndarray) -> np.ndarray:
    """A number of each pair of stop and part (N,), -1 for none."""
    return (stop + 1) * (int(part.max()) + 2) + part + 1
