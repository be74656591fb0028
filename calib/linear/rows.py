"""One stop's beams as linear rows over the columns of a layout, and their sums.

Of the columns most are dense: the twist of the LiDAR, minus the residual, effects. Others come in
groups of which a row touches one column only: ring offsets, surfaces, patches. Their products are
summed without zeros. Sums here are in the unknowns' own units; `assembly` scales them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.sparse import csr_array

from calib.forward import Placed, Values
from calib.linear.elimination import square
from calib.linear.layout import Layout, key_of
from calib.residuals.beams import Association, Rows
from calib.residuals.compiled import cluster_sums, cross_sums, renumber, square_sums
from calib.residuals.robust import tukey_cost
from calib.residuals.scan import ScanStop

PLACES = ("surface", "plane")  # beams that meet the same one share its error
TWIST = 6  # columns of a stop's rows that come first; minus the residual is the next
BLOCK = 8192  # rows that are weighted at once: bounds the memory
STACKED_ROWS = 1024  # rows that are put together at once: those of 200 columns fit a core's cache
ZERO = "range_offset"  # the effect that lengthens all ranges alike


@dataclass(frozen=True, eq=False)
class State:
    """The values of all unknowns, which many stops are asked at."""

    values: Mapping[str, np.ndarray]


@dataclass(frozen=True, eq=False)
class Weighing:
    """How the beams of one stop were weighed at a state, so that another can be held against it.

    Sigmas and robust scale follow the state; a cost can be compared only at the same ones. The
    sigmas stay in the process that computed them; another computes them anew from the state.

    Args:
        state: where the rows were.
        T: (4, 4) where the LiDAR was then.
        scale: how many sigmas wide the bulk was.
        sigma_m: (N,) single precision: it is kept for every stop while a fit runs.
        kept: whether that scale is to stay as it is wherever the state goes.
    """

    state: State
    T: np.ndarray
    scale: float
    sigma_m: np.ndarray | None
    kept: bool = False

    @classmethod
    def of(cls, rows: Rows, state: State, T: np.ndarray) -> Weighing:
        """As these rows are weighed."""
        return cls(state, T, rows.scale, rows.sigma_m.astype(np.float32))

    def cost(self, rows: Rows, at: Callable[[Values, np.ndarray], Rows]) -> float:
        """Half the robust chi-square of rows of that stop, at any state.

        Args:
            rows: these.
            at: gives the rows of the stop at a state where its LiDAR is at T (4, 4).
        """
        sigma_m = self.sigma_m
        if sigma_m is None:
            sigma_m = at(self.state.values, self.T).sigma_m.astype(np.float32)
        return tukey_cost(np.where(rows.usable, rows.residual_m / sigma_m, 0.0), self.scale)

    @property
    def nbytes(self) -> int:
        """What it takes here."""
        return 0 if self.sigma_m is None else self.sigma_m.nbytes

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "sigma_m": None}


@dataclass(frozen=True)
class StopRows:
    """The beams of one stop, linear in the twist of the LiDAR and in unknowns.

    Args:
        stop: its number in the layout.
        dense: (N, 7 + d) [twist | minus the residual, m | d columns of unknowns].
        weight: (N,) over variance, 1/m2.
        index: (N, g) which of all sparse columns a row touches in each of g groups; -1 for none.
        value: (N, g) its entry there.
        columns: (d + s,) columns of the layout that the dense and the sparse ones are.
        last: where among the sparse columns the last group begins; see `compiled.cross_sums`.
        chain: (6, n) derivative of the twist by what places the LiDAR, chain_columns: (n,) those.
        zero: the dense column that lengthens all ranges alike, in a list; or none.
        rows: what this is made of.
    """

    stop: int
    dense: np.ndarray
    weight: np.ndarray
    index: np.ndarray
    value: np.ndarray
    columns: np.ndarray
    last: int
    chain: np.ndarray
    chain_columns: np.ndarray
    zero: Sequence[int]
    rows: Rows

    @classmethod
    def of(
        cls,
        scan: ScanStop,
        layout: Layout,
        values: Mapping[str, np.ndarray],
        placed: Placed,
        association: Association | None,
        slowed: Weighing | None = None,
        times: np.ndarray | None = None,
    ) -> StopRows:
        """The rows of a scan, linearised at a state where its LiDAR is `placed`, each as heavy as
        so many `times` (N,) where these are given; other arguments as of `linearise`."""
        rows = scan.rows(values, association, placed.T[0])
        if slowed is not None:
            scale = slowed.scale if slowed.kept else (slowed.scale + rows.scale) / 2
            rows = rows.scaled(scale)
        if times is not None:
            rows = rows.heavier(times)
        weight, residual = rows.weight_m2, rows.residual_m
        columns = [layout.columns(list(rows.dense))]
        index = np.empty((len(weight), len(rows.sparse)), np.int32)
        value = np.empty(index.shape)
        start = last = 0
        for g, c in enumerate(rows.sparse):
            used = renumber(c.index, len(c.components), start, index[:, g])
            value[:, g] = c.value
            columns.append(layout.at[c.variable].start + c.components[used])
            last, start = start, start + len(used)
        return cls(
            stop=layout.stops[key_of(scan)],
            dense=_beside([rows.by_twist, -residual[:, None], *rows.dense.values()]),
            weight=weight,
            index=index,
            value=value,
            columns=np.concatenate([np.zeros(0, int), *columns]),
            last=last,
            chain=np.hstack([d[0] for d in placed.d.values()]),
            chain_columns=layout.columns(list(placed.d)),
            zero=list(_zero(scan, rows)),
            rows=rows,
        )

    @property
    def b(self) -> np.ndarray:
        """(N,) minus the residual, m."""
        return self.dense[:, TWIST]

    @property
    def sparse(self) -> int:
        """How many sparse columns there are."""
        return len(self.columns) - (self.dense.shape[1] - TWIST - 1)

    def sums(self) -> StopSums:
        """Their Gram matrix, in its parts."""
        with_dense, with_sparse, own = cross_sums(
            self.dense, self.weight, self.index, self.value, self.sparse, self.last
        )
        return StopSums(
            stop=self.stop,
            dense=_gram(self.dense, self.weight),
            with_dense=with_dense,
            with_sparse=with_sparse,
            own=own,
            columns=self.columns,
            chain=self.chain,
            chain_columns=self.chain_columns,
            zero=self.zero,
            weight_m2=float(self.weight.sum()),
        )

    def places(self, kinds: Sequence[str] = PLACES) -> tuple[np.ndarray, np.ndarray]:
        """What the rows meet, (G,) surfaces or planes, or others of these kinds, and which of these
        each row meets (N,)."""
        view = self.rows.view
        kind = next(name for name in kinds if name in view.columns)
        met = view[kind] + 1  # counting, as there are few of them: -1 is nothing
        parts = np.flatnonzero(np.bincount(met))
        number = np.zeros(parts[-1] + 1, int)
        number[parts] = np.arange(len(parts))
        return parts - 1, number[met]

    def gradient(self, cluster: np.ndarray, clusters: int) -> tuple[np.ndarray, np.ndarray]:
        """``J^T W b`` (clusters, n) of the rows of each cluster (N,), and its columns (n,)."""
        found = cluster_sums(
            self.dense, self.weight * self.b, self.index, self.value, self.sparse, cluster, clusters
        )
        columns = np.concatenate([self.chain_columns, self.columns])
        return np.hstack([found[:, :TWIST] @ self.chain, found[:, TWIST + 1 :]]), columns

    def squares_along(
        self, directions: np.ndarray, cluster: np.ndarray, clusters: int
    ) -> np.ndarray:
        """Weighted squares (clusters, q) of the rows along directions (U, q) in all unknowns, added
        up by the cluster (N,) of each."""
        by_dense, by_sparse = _by_column(directions, self)
        at = self.dense, self.weight, self.index, self.value
        return square_sums(*at, by_dense, by_sparse, cluster, clusters)

    def along(self, directions: np.ndarray) -> np.ndarray:
        """The rows (N, q) along directions (U, q) in all unknowns."""
        by_dense, by_sparse = _by_column(directions, self)
        derivatives = np.arange(self.dense.shape[1]) != TWIST
        out = self.dense[:, derivatives] @ by_dense[derivatives]
        if self.sparse:
            rows, each = self.index.shape
            value = np.where(self.index >= 0, self.value, 0.0).ravel()  # index -1: none
            columns = np.maximum(self.index, 0).ravel()
            entries = value, columns, each * np.arange(rows + 1)
            out += csr_array(entries, shape=(rows, self.sparse)) @ by_sparse
        return out


@dataclass(frozen=True)
class StopSums:
    """The Gram matrix of one stop's weighted rows.

    Args:
        stop: its number in the layout.
        dense: (7 + d, 7 + d) over [twist | b | d columns].
        with_dense: (s, 7 + d) sparse by dense columns.
        with_sparse: (l, s) sparse by sparse of different groups, see `compiled.cross_sums`.
        own: (s,) each sparse column by itself.
        columns, chain, chain_columns, zero: as of `StopRows`.
        weight_m2: sum of the weights over their variances, 1/m2.
    """

    stop: int
    dense: np.ndarray
    with_dense: np.ndarray
    with_sparse: np.ndarray
    own: np.ndarray
    columns: np.ndarray
    chain: np.ndarray
    chain_columns: np.ndarray
    zero: Sequence[int]
    weight_m2: float

    def alone(self) -> OwnSums:
        """What they say of a twist of the LiDAR, and of a range zero, that this stop alone has."""
        own = [*range(TWIST), *self.zero]
        by_chain = self.dense[own, :TWIST] @ self.chain
        return OwnSums(
            information=self.dense[np.ix_(own, own)],
            score=self.dense[own, TWIST],
            cross=np.hstack([by_chain, self.dense[own, TWIST + 1 :], self.with_dense[:, own].T]),
            columns=np.concatenate([self.chain_columns, self.columns]),
        )

    def along(self, directions: np.ndarray) -> np.ndarray:
        """Products (q, q) of the rows along directions (U, q) in all unknowns."""
        by_dense, by_sparse = _by_column(directions, self)
        between = by_sparse.T @ self.with_dense @ by_dense
        between += by_sparse[: len(self.with_sparse)].T @ self.with_sparse @ by_sparse
        own = by_sparse.T @ (self.own[:, None] * by_sparse)
        return by_dense.T @ self.dense @ by_dense + own + between + between.T

    def __getstate__(self) -> dict[str, Any]:
        """Without zeros: of the products of sparse columns few are not (1 in 22 where there are 303
        by 817), and they are most of what a stop sends."""
        at = np.flatnonzero(self.with_sparse).astype(np.int32)
        kept = self.with_sparse.shape, at, self.with_sparse.ravel()[at]
        return {**vars(self), "with_sparse": kept}

    def __setstate__(self, state: dict[str, Any]) -> None:
        shape, at, entries = state["with_sparse"]
        dense = np.zeros(shape)
        dense.ravel()[at] = entries
        vars(self).update(state, with_sparse=dense)

    def whole(self) -> np.ndarray:
        """(7 + d + s, same) over [twist | b | d columns | s columns]."""
        both = np.diag(self.own)
        count = len(self.with_sparse)
        both[:count] += self.with_sparse
        both[:, :count] += self.with_sparse.T
        return np.block([[self.dense, self.with_dense.T], [self.with_dense, both]])


def _beside(columns: Sequence[np.ndarray]) -> np.ndarray:
    """Columns (N, …) beside each other, block by block, so that what is written stays in a core's
    cache."""
    ends = np.cumsum([each.shape[1] for each in columns])
    out = np.empty((len(columns[0]), ends[-1]))
    for at in range(0, len(out), STACKED_ROWS):
        for each, end in zip(columns, ends.tolist(), strict=True):
            out[at : at + STACKED_ROWS, end - each.shape[1] : end] = each[at : at + STACKED_ROWS]
    return out


def _gram(dense: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Weighted products (m, m) of columns (N, m), so many rows at once."""
    blocks = range(0, max(len(dense), 1), BLOCK)
    some = ((dense[at : at + BLOCK], np.sqrt(weight[at : at + BLOCK])) for at in blocks)
    return sum(square(rows * root[:, None]) for rows, root in some)


def _by_column(directions: np.ndarray, of: StopRows | StopSums) -> tuple[np.ndarray, np.ndarray]:
    """Directions (U, q) in all unknowns: by the dense columns (7 + d, q), with 0 for the right
    side, and by the sparse ones (s, q)."""
    mine, wide = directions[of.columns], of.dense.shape[1] - TWIST - 1
    twist = of.chain @ directions[of.chain_columns]
    right = np.zeros((1, directions.shape[1]))
    return np.vstack([twist, right, mine[:wide]]), mine[wide:]


@dataclass(frozen=True)
class OwnSums:
    """What a stop's beams say of a shift that nothing else shares: a twist of its LiDAR and, where
    the linearisation has such a column, a range zero.

    Args:
        information: (7, 7) or (6, 6), score: (7,) or (6,) of that shift.
        cross: (7, n) or (6, n) its products with unknowns, columns: (n,) which; one may stand
            twice.
    """

    information: np.ndarray
    score: np.ndarray
    cross: np.ndarray
    columns: np.ndarray

    def onto(self, to: np.ndarray) -> OwnSums:
        """The same beside fewer unknowns: `to` (U,) says where each column is then, -1 where it is
        not."""
        there = to[self.columns] >= 0
        return replace(self, cross=self.cross[:, there], columns=to[self.columns[there]])


def _zero(scan: ScanStop, rows: Rows) -> Iterator[int]:
    """Where among the dense columns all ranges are lengthened alike."""
    at = TWIST + 1
    mine = {term.variable for term in scan.terms if term.effect.family == ZERO}
    for name, columns in rows.dense.items():
        if name in mine:
            yield at
        at += columns.shape[1]
