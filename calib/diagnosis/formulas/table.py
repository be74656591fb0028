"""Some of the beams at a solution, with all that they may depend on: a table to try formulas on.

A formula is a column of the range: what it adds to each beam. What of it the model absorbs
(poses, links, ring zeros, parts of surfaces) is projected off, exactly as for an effect of the
catalogue; here for so few beams that thousands of columns are tried in seconds.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular
from scipy.sparse import block_diag, csr_array, eye_array, hstack, vstack

from calib.diagnosis.formulas.factors import covariates_of
from calib.diagnosis.jackknife import Shares
from calib.diagnosis.linear import beside, other_rows
from calib.diagnosis.score import GAUGE, Scores, ScoreTest, score_test
from calib.linear.clusters import ClusteredRows, Gradients, summed
from calib.linear.layout import Layout
from calib.linear.rows import TWIST, StopRows
from calib.problem import Problem
from calib.residuals.robust import MAD
from calib.solve.added import HUBER
from calib.solve.clustered import each_stop
from calib.solve.estimate import Estimate

# Beams in the table. What limits a formula is stops and surfaces that err together, not beams: of
# `known_ring_by_temperature` the constants of 10,000, 40,000 and all beams agree to 0.3 of their
# sigma.
MOST_BEAMS = 20_000
FORMULA_DRAWS = 499  # scores of chance: 25 of them beyond the quantile that counts looks
WEIGHING_PASSES = 3  # of weighing, after which weights of a gross structure change by less than 1 %


@dataclass(frozen=True)
class BeamTable:
    """N beams, drawn at random from each stop alike.

    Args:
        covariates: name -> (N,) value, those of the stop too.
        by_stop: which of them are the same for all beams of a stop.
        residual_m, sigma_m: (N,) measured - predicted, and how far that may be off.
        stop, place: (N,) the stop of each, and the surface that it meets.
        share: of all beams that are here.
        twists: (N, V) derivative of the residual by twists of the LiDAR, stop by stop, and by the
            U unknowns that act on beams otherwise.
        chain: (V, U) of these by all unknowns.
        others: (R, U) whitened rows of trackers, targets and priors; others_b: (R,) their right
            side; others_stop, others_place: (R,) of which they are, -1 for none.
        unit: of `residual_m` and `sigma_m`: m of a range, or rad of a joint; see `joint_tables`.
        joints: which covariates are joints of the arm.
        weight_m2: of all that was measured, 1/m2; None where that is these rows.
    """

    covariates: Mapping[str, np.ndarray]
    by_stop: frozenset[str]
    residual_m: np.ndarray
    sigma_m: np.ndarray
    stop: np.ndarray
    place: np.ndarray
    share: float
    twists: csr_array
    chain: csr_array
    others: csr_array
    others_b: np.ndarray
    others_stop: np.ndarray
    others_place: np.ndarray
    unit: str = "m"
    joints: frozenset[str] = frozenset()
    weight_m2: float | None = None

    @classmethod
    def of(
        cls,
        estimate: Estimate,
        progress: Callable[[int, int], None] = lambda done, total: None,
        most: int = MOST_BEAMS,
    ) -> BeamTable:
        """The table of a fit with scans, drawn alike whenever it is drawn.

        Args:
            estimate: the fit.
            progress: called with how many stops are done, and of how many.
            most: how many beams there are at most.
        """
        problem, values = beside(estimate.problem, estimate)
        layout, scans = Layout.of(problem), problem.scans
        places = Gradients(layout.size)
        beams = sum(int(np.count_nonzero(a.part >= 0)) for a in estimate.associations)
        share = min(1.0, most / max(beams, 1))
        found = partial(_Drawn.of, share, TWIST * len(scans), layout.size)
        state = problem, layout, values, estimate.associations
        every = list(each_stop(*state, places, found, progress=progress))
        drawn, place = [d for d, _ in every], [numbers[d.met] for d, numbers in every]
        names = [n for n in drawn[0].columns if all(n in d.columns for d in drawn)]
        others, b, others_stop, others_place = rows_of_others(problem, layout, values, places)
        chains = [*(d.chain for d in drawn), eye_array(layout.size, format="csr")]
        return cls(
            covariates={n: np.concatenate([d.column(n) for d in drawn]) for n in names},
            by_stop=frozenset(n for n in names if all(len(d.columns[n]) == 1 for d in drawn)),
            residual_m=np.concatenate([d.residual_m for d in drawn]),
            sigma_m=np.concatenate([d.sigma_m for d in drawn]),
            stop=np.concatenate([np.full(len(d.residual_m), d.stop) for d in drawn]),
            place=np.concatenate(place),
            share=share,
            twists=csr_array(vstack([d.twists for d in drawn])),
            chain=csr_array(vstack(chains)),
            others=others,
            others_b=b,
            others_stop=others_stop,
            others_place=others_place,
            joints=frozenset(scans[0].stops.rig.joint_names),
        )

    def __len__(self) -> int:
        return len(self.residual_m)

    @cached_property
    def twists_T(self) -> csr_array:
        """(V, N) the same by columns, row after row: products with it are three times as fast."""
        return csr_array(self.twists.T)

    @cached_property
    def signs(self) -> np.ndarray:
        """(R, C) what the clusters' shares of a score are multiplied by to make one of chance; see
        `Scores.draws`."""
        stop, place, _ = self.cells
        return np.random.default_rng(0).standard_normal(
            (FORMULA_DRAWS, stop.max() + place.max() + 2)
        )

    @cached_property
    def of_others(self) -> tuple[np.ndarray, np.ndarray]:
        """What trackers, targets and priors say: (U, U) information, (U,) right side."""
        return (self.others.T @ self.others).toarray(), self.others.T @ self.others_b

    @cached_property
    def cells(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rows of one stop and place, of beams and then of others: the stop and the place (C,) of
        each such cell, and the cell of each row."""
        stop = np.concatenate([self.stop, self.others_stop])
        place = np.concatenate([self.place, self.others_place])
        wide = int(place.max(initial=0)) + 2
        found, cell = np.unique((stop + 1) * wide + place + 1, return_inverse=True)
        return found // wide - 1, found % wide - 1, cell

    def beside(self, columns_m: np.ndarray) -> BeamTable:
        """The table of a model that has such columns (N, F) of the range, too: its last unknowns,
        of which nothing was known."""
        more = columns_m.shape[1]
        own = csr_array(columns_m)
        chain = block_diag([self.chain, eye_array(more)], format="csr")
        others = hstack([self.others, csr_array((self.others.shape[0], more))], format="csr")
        twists = hstack([self.twists, -own], format="csr")
        return replace(self, twists=twists, chain=chain, others=others)

    def projection(self, columns_m: np.ndarray | None = None) -> Projection:
        """The model fitted to the table, with columns (N, k) of the ranges beside it or none.

        Beams are weighed as Huber has it: those far out are bounded and none is rejected, as what
        is rejected may be what is missing.

        Returns:
            The model alone, at the weights of that fit.
        """
        z = self.residual_m / self.sigma_m
        for _ in range(WEIGHING_PASSES):
            scale = max(1.0, MAD * float(np.median(np.abs(z))))
            weight = np.minimum(1.0, HUBER * scale / np.maximum(np.abs(z), 1e-300))
            out = Projection.of(self, weight / self.sigma_m**2 / self.share)
            fit = out if columns_m is None else out.fitted(columns_m)[0]
            z = fit.left_m / self.sigma_m
        return out


@dataclass(frozen=True)
class Projection:
    """The table at weights, with the model fitted to it.

    Args:
        table: that.
        weight: (N,) over variance, 1/m2, as if all beams were here.
        left_m: (N,) residuals that the model leaves.
        step: (U,) by which its unknowns go.
        factor: of its normal equations.
    """

    table: BeamTable
    weight: np.ndarray
    left_m: np.ndarray
    step: np.ndarray
    factor: tuple[np.ndarray, bool]

    @property
    def chi2(self) -> float:
        """Of these rows at their weights, and of all others."""
        away = self.table.others @ self.step - self.table.others_b
        return float(self.weight @ np.square(self.left_m) + away @ away)

    @property
    def weight_m2(self) -> float:
        """Of all that was measured, 1/m2."""
        return float(self.weight.sum()) if self.table.weight_m2 is None else self.table.weight_m2

    @classmethod
    def of(cls, table: BeamTable, weight: np.ndarray) -> Projection:
        """Fit the model at these weights (N,)."""
        T, chain = table.twists, table.chain
        gram = table.twists_T @ T.multiply(weight[:, None]).tocsr()
        information, right = table.of_others
        H = information + (chain.T @ gram @ chain).toarray()
        H[np.diag_indices(len(H))] *= 1.0 + 1e-12
        H[np.diag_indices(len(H))] += 1e-12 * np.median(np.diag(H))
        factor = cho_factor(H)  # upper
        raw = table.residual_m
        step = cho_solve(factor, right - chain.T @ (table.twists_T @ (weight * raw)))
        left_m = raw + T @ (chain @ step)
        return cls(table=table, weight=weight, left_m=left_m, step=step, factor=factor)

    def beside(self, columns_m: np.ndarray) -> Projection:
        """The projection, at the same weights, of a model that has columns (N, k), too."""
        return Projection.of(self.table.beside(columns_m), self.weight)

    def fitted(self, columns_m: np.ndarray) -> tuple[Projection, np.ndarray]:
        """With columns (N, k) fitted beside the model, and what they are multiplied by (k,); 0 of
        what the model absorbs."""
        kept, taken = left = self.off(columns_m)
        theta = self._test(columns_m, left).estimate()
        beside = replace(self, left_m=self.left_m - kept @ theta, step=self.step - taken @ theta)
        return beside, theta

    def off(self, columns_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What is left of columns (N, Q) of the range, in the beams (N, Q), and how the model's
        unknowns (U, Q) absorb the rest."""
        table, weighted = self.table, self.weight[:, None] * columns_m
        taken = cho_solve(self.factor, -(table.chain.T @ (table.twists_T @ weighted)))
        return columns_m + table.twists @ (table.chain @ taken), taken

    def explained(self, blocks: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """What blocks of columns (N, k) of the range would explain, each alone: in squared sigmas
        (B,), and in how many directions (B,)."""
        columns = np.hstack(blocks)
        weighted = self.weight[:, None] * columns
        crossed = self.table.chain.T @ (self.table.twists_T @ weighted)
        root = solve_triangular(self.factor[0], crossed, trans=1, check_finite=False)
        score = self.left_m @ weighted
        found, start = [], 0
        for block in blocks:
            at = slice(start, start := start + block.shape[1])
            whole = weighted[:, at].T @ block
            found.append(_explained(score[at], whole, whole - root[:, at].T @ root[:, at]))
        statistic, dof = zip(*found, strict=True)
        return np.array(statistic), np.array(dof)

    def scores(self, columns_m: np.ndarray) -> Scores:
        """Scores of columns (N, Q) of the range, of one candidate; see `calib.diagnosis.score`."""
        return self._scores(columns_m, self.off(columns_m))

    def test(self, columns_m: np.ndarray) -> ScoreTest:
        """The test of columns (N, q) together."""
        return self._test(columns_m, self.off(columns_m))

    def _test(self, columns_m: np.ndarray, kept: tuple[np.ndarray, np.ndarray]) -> ScoreTest:
        return score_test(self._scores(columns_m, kept), np.arange(columns_m.shape[1]))

    def _scores(self, columns_m: np.ndarray, kept: tuple[np.ndarray, np.ndarray]) -> Scores:
        """As `scores`, with what `off` gives."""
        table = self.table
        weighted = self.weight[:, None] * columns_m
        information = weighted.T @ kept[0]
        away = table.others @ self.step - table.others_b
        shares = [
            kept[0] * (self.weight * self.left_m)[:, None],
            (table.others @ kept[1]) * away[:, None],
        ]
        stop, place, cell = table.cells
        cells = summed(np.vstack(shares), cell)
        return Scores(
            at={},
            owner={},
            score=cells.sum(axis=0),
            information=(information + information.T) / 2,
            whole=weighted.T @ columns_m,
            cells=cells,
            stop=stop,
            place=place,
            weight_m2=self.weight_m2,
        )

    def judged(self, columns_m: np.ndarray) -> ScoreTest:
        """The test of columns (N, q) with its clusters left out one by one: see `jackknife`."""
        table, kept = self.table, self.off(columns_m)
        found = self._test(columns_m, kept)
        root, every = np.sqrt(self.weight), np.arange(found.dof)
        away = table.others @ self.step - table.others_b
        shares = Shares()
        for A, b, stop, place in (
            (root[:, None] * (kept[0] @ found.whiten), root * self.left_m, table.stop, table.place),
            (table.others @ (kept[1] @ found.whiten), away, table.others_stop, table.others_place),
        ):
            shares.add(ClusteredRows(A=A, b=b, columns=every, stop=stop, place=place))
        return found.judged(shares)


def _explained(score: np.ndarray, whole: np.ndarray, left: np.ndarray) -> tuple[float, int]:
    size = np.sqrt(np.maximum(np.diag(whole), 1e-300))
    values, axes = np.linalg.eigh(left / np.outer(size, size))
    seen = values > GAUGE
    along = (score / size) @ axes[:, seen]
    return float(np.sum(np.square(along) / values[seen])), int(seen.sum())


@dataclass(frozen=True, kw_only=True)
class _Drawn:
    """Beams of one stop, and nothing of its others.

    Args:
        stop: its number.
        columns: covariates (n,) of these; (1,) of the stop.
        residual_m, sigma_m, twists, chain: as of `BeamTable`.
        met: (n,) which of what any beam of the stop meets each does.
    """

    stop: int
    columns: Mapping[str, np.ndarray]
    residual_m: np.ndarray
    sigma_m: np.ndarray
    twists: csr_array
    chain: csr_array
    met: np.ndarray

    @classmethod
    def of(
        cls, share: float, begin: int, size: int, rows: StopRows, met: np.ndarray, count: int
    ) -> _Drawn:
        """A share of a stop's beams; so many columns of unknowns begin after the twists'. The last
        arguments are those of `each_stop`."""
        usable = np.flatnonzero(rows.rows.usable & np.isfinite(rows.rows.residual_m))
        drawn = np.random.default_rng(rows.stop).choice(usable, round(share * len(usable)), False)
        picked, columns = np.sort(drawn), {}
        for name, values in covariates_of(rows.rows.view):
            columns[name] = (values[picked] if len(values) > 1 else values).astype(float)
        return cls(
            stop=rows.stop,
            columns=columns,
            residual_m=rows.rows.residual_m[picked],
            sigma_m=rows.rows.sigma_m[picked],
            twists=_twists(rows, picked, TWIST * rows.stop, begin, begin + size),
            chain=_rows_over(rows.chain, rows.chain_columns, size),
            met=met[picked],
        )

    def column(self, name: str) -> np.ndarray:
        """A covariate (n,)."""
        return np.broadcast_to(self.columns[name], len(self.residual_m))


def _twists(rows: StopRows, picked: np.ndarray, first: int, begin: int, size: int) -> csr_array:
    """Derivative (n, size) of the residuals of some beams of a scan, whose twist has the columns
    from `first`; those of unknowns begin at `begin`."""
    wide = rows.dense.shape[1] - TWIST - 1
    dense = np.hstack([rows.dense[picked, :TWIST], rows.dense[picked, TWIST + 1 :]])
    own = np.concatenate([np.arange(first, first + TWIST), begin + rows.columns[:wide]])
    found = rows.index[picked]
    met = found >= 0
    sparse = begin + rows.columns[wide:][np.where(met, found, 0)] if rows.sparse else found
    at = np.hstack([np.broadcast_to(own, dense.shape), sparse])
    values = np.hstack([dense, np.where(met, rows.value[picked], 0.0)])
    ends = np.arange(len(picked) + 1) * at.shape[1]
    out = csr_array((values.ravel(), at.ravel(), ends), (len(picked), size))
    out.eliminate_zeros()
    return out


def rows_of_others(
    problem: Problem, layout: Layout, values: Mapping[str, np.ndarray], places: Gradients
) -> tuple[csr_array, np.ndarray, np.ndarray, np.ndarray]:
    """Rows of trackers, targets and priors: (R, U) whitened, (R,) their right side, and the stop
    and place (R,) of each."""
    rows = list(other_rows(problem, layout, values, places))
    A = csr_array(vstack([_rows_over(r.A, r.columns, layout.size) for r in rows]))
    b, stop, place = (np.concatenate([getattr(r, k) for r in rows]) for k in ("b", "stop", "place"))
    return A, b, stop, place


def _rows_over(A: np.ndarray | csr_array, columns: np.ndarray, size: int) -> csr_array:
    """Rows over some columns as rows over all of them."""
    found = csr_array(A)
    return csr_array((found.data, columns[found.indices], found.indptr), (found.shape[0], size))
