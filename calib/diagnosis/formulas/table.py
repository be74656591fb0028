"""Some of the beams at a solution, with all that they may depend on: a table to try formulas on.

A formula is a column of the range: what it adds to each beam. What of it the model absorbs
(poses, links, ring zeros, parts of surfaces) is projected off, exactly as for an effect of the
catalogue; here for so few beams that thousands of columns are tried in seconds.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from scipy import linalg
from scipy.sparse import block_diag, csr_array, diags_array, eye_array, hstack, issparse, vstack

from calib.diagnosis.formulas.drawn import DrawnBeams
from calib.diagnosis.judges import Shares
from calib.diagnosis.linear import beside, other_rows
from calib.diagnosis.score import GAUGE, Scores, ScoreTest, score_test
from calib.linear.arrow import Arrow, apart, cheapest
from calib.linear.clusters import Gradients, over_all, summed
from calib.linear.layout import Layout
from calib.linear.own import own_rows
from calib.linear.rows import TWIST
from calib.linear.symmetric import eigh
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
Matrix = csr_array | np.ndarray
COLUMNS_AT_ONCE = 64  # what fits into a processor's cache; 400 take half as long again
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
        others: (R, U) whitened rows of trackers, targets and priors; like `twists` and `chain`
            sparse of beams, and dense of an arm, all of whose unknowns act on each pose; others_b:
            (R,) their right
            side; others_stop, others_place: (R,) of which they are, -1 for none.
        unit: of `residual_m` and `sigma_m`: m of a range, m or rad of a joint; see `joint_tables`.
        joints: which covariates are joints of the arm; turning: which of them turn.
        weight_m2: of all that was measured, 1/m2; None where that is these rows.
        own: sets of unknowns of which no row depends on two: those that only one stop has, of each
            stop, or parts of surfaces, of each surface.
    """

    covariates: Mapping[str, np.ndarray]
    by_stop: frozenset[str]
    residual_m: np.ndarray
    sigma_m: np.ndarray
    stop: np.ndarray
    place: np.ndarray
    share: float
    twists: Matrix
    chain: Matrix
    others: Matrix
    others_b: np.ndarray
    others_stop: np.ndarray
    others_place: np.ndarray
    unit: str = "m"
    joints: frozenset[str] = frozenset()
    turning: frozenset[str] = frozenset()
    weight_m2: float | None = None
    own: Sequence[np.ndarray] = ()

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
        found = partial(DrawnBeams.of, share, TWIST * len(scans), layout.size)
        state = problem, layout, values, estimate.associations
        every = list(each_stop(*state, places, found, progress=progress))
        drawn, place = [d for d, _ in every], [numbers[d.met] for d, numbers in every]
        names = [n for n in drawn[0].columns if all(n in d.columns for d in drawn)]
        others, b, others_stop, others_place = rows_of_others(problem, layout, values, places)
        twists = csr_array(vstack([d.twists for d in drawn]))
        chain = csr_array(vstack([*(d.chain for d in drawn), eye_array(layout.size, format="csr")]))
        cells = np.concatenate([np.zeros(0, int), *layout.cells])
        surfaces = apart(csr_array(vstack([twists @ chain, others])), cells)
        return cls(
            covariates={n: np.concatenate([d.column(n) for d in drawn]) for n in names},
            by_stop=frozenset(n for n in names if all(len(d.columns[n]) == 1 for d in drawn)),
            residual_m=np.concatenate([d.residual_m for d in drawn]),
            sigma_m=np.concatenate([d.sigma_m for d in drawn]),
            stop=np.concatenate([np.full(len(d.residual_m), d.stop) for d in drawn]),
            place=np.concatenate(place),
            share=share,
            twists=twists,
            chain=chain,
            others=others,
            others_b=b,
            others_stop=others_stop,
            others_place=others_place,
            joints=frozenset(scans[0].stops.rig.joint_names),
            turning=scans[0].stops.rig.turning,
            own=cheapest(layout.size, list(layout.own.values()), surfaces),
        )

    def __len__(self) -> int:
        return len(self.residual_m)

    @cached_property
    def twists_T(self) -> Matrix:
        """(V, N) the same by columns, row after row: products with it are three times as fast."""
        return self.twists.T.tocsr() if issparse(self.twists) else self.twists.T

    @cached_property
    def signs(self) -> np.ndarray:
        """(R, C) what the clusters' shares of a score are multiplied by to make one of chance; see
        `Scores.draws`. In single precision, which is enough for it."""
        stop, place, _ = self.cells
        shape = FORMULA_DRAWS, stop.max() + place.max() + 2
        return np.random.default_rng(0).standard_normal(shape).astype(np.float32)

    @cached_property
    def of_others(self) -> tuple[Matrix, np.ndarray]:
        """What trackers, targets and priors say: (U, U) information, (U,) right side."""
        return self.others.T @ self.others, self.others.T @ self.others_b

    @cached_property
    def cells(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rows of one stop and place, of beams and then of others: the stop and the place (C,) of
        each such cell, and the cell of each row."""
        stop = np.concatenate([self.stop, self.others_stop])
        place = np.concatenate([self.place, self.others_place])
        wide = int(place.max(initial=0)) + 2
        found, cell = np.unique((stop + 1) * wide + place + 1, return_inverse=True)
        return found // wide - 1, found % wide - 1, cell

    def clustered(self, label: np.ndarray) -> BeamTable:
        """The same where stops (S,) of one label err together, as one stop does."""
        others = np.where(self.others_stop >= 0, label[self.others_stop], -1)
        return replace(self, stop=label[self.stop], others_stop=others)

    def beside(self, columns_m: np.ndarray) -> BeamTable:
        """The table of a model that has such columns (N, F) of the range, too: its last unknowns,
        of which nothing was known."""
        more = columns_m.shape[1]
        if issparse(self.chain):
            chain = block_diag([self.chain, eye_array(more)], format="csr")
        else:
            chain = linalg.block_diag(self.chain, np.eye(more))
        others = _wider(self.others, np.zeros((len(self.others_b), more)))
        twists = _wider(self.twists, -columns_m)
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
    factor: Arrow

    @property
    def chi2(self) -> float:
        """Of these rows at their weights, and of all others."""
        return float(self.weight @ np.square(self.left_m) + self._away @ self._away)

    @property
    def weight_m2(self) -> float:
        """Of all that was measured, 1/m2."""
        return float(self.weight.sum()) if self.table.weight_m2 is None else self.table.weight_m2

    @classmethod
    def of(cls, table: BeamTable, weight: np.ndarray) -> Projection:
        """Fit the model at these weights (N,)."""
        T, chain = table.twists, table.chain
        gram = table.twists_T @ (T * weight[:, None])
        information, right = table.of_others
        H = information + chain.T @ gram @ chain
        size = H.diagonal()
        factor = Arrow.of(H + diags_array(1e-12 * (size + np.median(size))), table.own)
        raw = table.residual_m
        step = factor.solve(right - chain.T @ (table.twists_T @ (weight * raw)))
        left_m = raw + T @ (chain @ step)
        return cls(table=table, weight=weight, left_m=left_m, step=step, factor=factor)

    def beside(self, columns_m: np.ndarray) -> Projection:
        """The projection, at the same weights, of a model that has columns (N, k), too."""
        return Projection.of(self.table.beside(columns_m), self.weight)

    def fitted(self, columns_m: np.ndarray) -> tuple[Projection, np.ndarray]:
        """With columns (N, k) fitted beside the model, and what they are multiplied by (k,); 0 of
        what the model absorbs."""
        (kept, taken), theta = self.off(columns_m), self.test(columns_m).estimate()
        beside = replace(self, left_m=self.left_m - kept @ theta, step=self.step - taken @ theta)
        return beside, theta

    def off(self, columns_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What is left of columns (N, Q) of the range, in the beams (N, Q), and how the model's
        unknowns (U, Q) absorb the rest."""
        taken = self.factor.solve(-self._crossed(self.weight[:, None] * columns_m))
        return columns_m + self.table.twists @ (self.table.chain @ taken), taken

    def _crossed(self, weighted: np.ndarray) -> np.ndarray:
        """Products (U, Q) of the model's unknowns with weighted columns (N, Q)."""
        return self.table.chain.T @ (self.table.twists_T @ weighted)

    def explained(self, blocks: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """What blocks of columns (N, k) of the range would explain, each alone: in squared sigmas
        (B,), and in how many directions (B,)."""
        columns = np.hstack(blocks)
        weighted = self.weight[:, None] * columns
        crossed = self._crossed(weighted)
        root = self.factor.root(crossed)
        score = self.left_m @ weighted
        found, start = [], 0
        for block in blocks:
            at = slice(start, start := start + block.shape[1])
            whole = weighted[:, at].T @ block
            found.append(_explained(score[at], whole, whole - root[:, at].T @ root[:, at]))
        statistic, dof = zip(*found, strict=True)
        return np.array(statistic), np.array(dof)

    @cached_property
    def _away(self) -> np.ndarray:
        """(R,) what the model leaves of the other rows."""
        return self.table.others @ self.step - self.table.others_b

    @cached_property
    def _by_cell(self) -> Matrix:
        """(C, U) what the rows of each cell say of the model's unknowns."""
        table, (stop, _, cell) = self.table, self.table.cells
        right = np.concatenate([self.weight * self.left_m, self._away])
        stacked = vstack if issparse(table.twists) else np.vstack
        rows = stacked([table.twists @ table.chain, table.others])
        return csr_array((right, (cell, np.arange(len(cell)))), (len(stop), len(cell))) @ rows

    def scores(self, columns_m: np.ndarray) -> Scores:
        """Scores of columns (N, Q) of the range, of one candidate; see `calib.diagnosis.score`."""
        table, weighted = self.table, self.weight[:, None] * columns_m
        (stop, place, cell), crossed = table.cells, self._crossed(weighted)
        taken, whole = self.factor.solve(-crossed), weighted.T @ columns_m
        information = whole + crossed.T @ taken
        cells = self._by_cell @ taken
        own = summed(weighted * self.left_m[:, None], cell[: len(table)])
        cells[: len(own)] += own
        return Scores(
            at={},
            owner={},
            score=cells.sum(axis=0),
            information=(information + information.T) / 2,
            felt=np.diag(whole),
            whole={},
            cells=cells,
            stop=stop,
            place=place,
            weight_m2=self.weight_m2,
        )

    def test(self, columns_m: np.ndarray) -> ScoreTest:
        """The test of columns (N, q) together."""
        return score_test(self.scores(columns_m), np.arange(columns_m.shape[1]))

    def judged(self, columns_m: np.ndarray) -> ScoreTest:
        """The test of columns (N, q) with its clusters left out one by one: see `jackknife`."""
        table, (kept, taken) = self.table, self.off(columns_m)
        scores = self.scores(columns_m)
        found = score_test(scores, np.arange(columns_m.shape[1]))
        root, shares = np.sqrt(self.weight)[:, None], Shares()
        shares.add(root * (kept @ found.whiten), table.stop, table.place)
        others = table.others @ (taken @ found.whiten)
        shares.add(others, table.others_stop, table.others_place)
        return found.judged(shares, scores)


def together(blocks: Iterable[np.ndarray]) -> Iterator[list[np.ndarray]]:
    """Blocks of columns (N, k), in order, as many at a time as are best multiplied at once."""
    some: list[np.ndarray] = []
    for block in blocks:
        if some and sum(each.shape[1] for each in (*some, block)) > COLUMNS_AT_ONCE:
            yield some
            some = []
        some.append(block)
    if some:
        yield some


def _wider(left: Matrix, right: np.ndarray) -> Matrix:
    """Columns (N, k) beside a matrix (N, n), which stays as it is, sparse or dense."""
    if issparse(left):
        return csr_array(hstack([left, csr_array(right)]))
    return np.hstack([left, right])


def _explained(score: np.ndarray, whole: np.ndarray, left: np.ndarray) -> tuple[float, int]:
    size = np.sqrt(np.maximum(np.diag(whole), 1e-300))
    values, axes = eigh(left / np.outer(size, size))
    seen = values > GAUGE
    along = (score / size) @ axes[:, seen]
    return float(np.sum(np.square(along) / values[seen])), int(seen.sum())


def rows_of_others(
    problem: Problem, layout: Layout, values: Mapping[str, np.ndarray], places: Gradients
) -> tuple[csr_array, np.ndarray, np.ndarray, np.ndarray]:
    """Rows of trackers, targets and priors: (R, U) whitened, (R,) their right side, and the stop
    and place (R,) of each."""
    rows = list(other_rows(problem, layout, values, places, own_rows(layout, values)))
    A = over_all([r.entries() for r in rows], layout.size)
    b, stop, place = (np.concatenate([getattr(r, k) for r in rows]) for k in ("b", "stop", "place"))
    return A, b, stop, place
