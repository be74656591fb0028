"""What all rows of a fit say, against which some of them are held."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import csr_array

from calib.blunders.rows import GraphRows, GroupRows, group_rows
from calib.linear.clusters import Entries, over_all
from calib.linear.layout import positions
from calib.linear.system import Linearisation
from calib.problem.problem import Problem
from calib.solve.graph import Graph

# Of I - w H: below this a direction is held by the group alone (rounding of C is some 1e-9 of it).
HELD_ALONE = 1e-6
ROWS_TOGETHER = 400  # rows whose covariance is computed at once: bounds the memory


@dataclass(frozen=True)
class Others:
    """What all rows of a fit say, against which some of them are held.

    Args:
        whole: they, linearised.
        graph_rows: those of the kept unknowns that are not in it.
        kept: (S, S) covariance of the kept unknowns.
        step: (U,) one more step of all unknowns.
    """

    whole: Linearisation
    graph_rows: GraphRows
    kept: np.ndarray
    step: np.ndarray

    @classmethod
    def of(cls, whole: Linearisation) -> Others:
        """All rows at the solution of a fit."""
        layout = whole.layout
        graph = Graph(list(layout.outer().values()), layout.others, layout.unbounded)
        graph_rows = list(graph.linear_rows(whole.values))
        kept = _kept_covariance(whole, graph_rows)
        return cls(whole, graph_rows, kept, step=_step(whole, graph_rows, kept))

    def against(self, every: Sequence[GroupRows]) -> tuple[np.ndarray, np.ndarray]:
        """H and b of these rows."""
        A = self.spread(every)
        b = np.concatenate([rows.b for rows in every]) - A @ self.step
        return self.whole.covariance(A, self.kept), b

    def spread(self, every: Sequence[GroupRows]) -> csr_array:
        """The same rows (m, U) over all unknowns."""
        return over_all(
            [Entries.of(rows.A, rows.columns) for rows in every], self.whole.layout.size
        )

    def groups(self, problem: Problem) -> Iterator[list[Sequence[GroupRows]]]:
        """All groups of rows, those of one place in a set; no more sets at once than memory should
        hold."""
        sets: dict[tuple[str, str], list[GroupRows]] = {}
        for rows in group_rows(self.whole, problem, self.graph_rows):
            sets.setdefault(rows.at, []).append(rows)
        yield from _batches(sets.values())


def parts(some: Iterable[Sequence[GroupRows]]) -> Iterator[slice]:
    """Where the rows of each set are among those of all, one set after another."""
    first = 0
    for each in some:
        yield slice(first, first := first + sum(len(rows.A) for rows in each))


def _batches(sets: Iterable[Sequence[GroupRows]]) -> Iterator[list[Sequence[GroupRows]]]:
    batch, count = [], 0
    for some in sets:
        batch.append(some)
        count += sum(len(rows.A) for rows in some)
        if count > ROWS_TOGETHER:
            yield batch
            batch, count = [], 0
    if batch:
        yield batch


def at_their_sigmas(
    some: Sequence[GroupRows], H: np.ndarray, b: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """H and b had these rows not lost any weight: only so is the one that did judged as the others
    that it contradicts. Rows g that get the weight 1 - w back change what is known by
    ``C' = C - C A_g^T (1 / (1 - w) + A_g C A_g^T)^-1 A_g C``. As b, any columns (m, r) of ``A C``
    change alike."""
    back = np.concatenate([1.0 - rows.weight for rows in some])
    g = np.flatnonzero(back > 0)
    if not len(g):
        return H, b
    gain = np.linalg.solve(np.diag(1.0 / back[g]) + H[np.ix_(g, g)], H[g])
    H = H - H[:, g] @ gain
    return H, b - H[:, g] @ (back[g] * b[g].T).T


def whitening(M: np.ndarray, size: np.ndarray) -> np.ndarray:
    """What takes a score (r,) of information M (r, r) to independent ones (dof,) of unit variance,
    in the directions that anything contradicts, in units of `size` (r,)."""
    values, axes = contradicted(M / np.outer(size, size))
    return axes / np.sqrt(values) / size[:, None]


def contradicted(M: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Eigenvalues (dof,) and eigenvectors (r, dof) of a redundancy (r, r), in the directions that
    anything contradicts."""
    values, axes = (M[0], np.eye(1)) if len(M) == 1 else np.linalg.eigh(M)
    seen = values > HELD_ALONE
    return values[seen], axes[:, seen]


def _kept_covariance(whole: Linearisation, graph_rows: GraphRows) -> np.ndarray:
    """Covariance (S, S) of what was kept, with every prior at its word; 0 for candidates."""
    layout = whole.layout
    information, at = whole.kept[:-1, :-1].copy(), positions(layout.size, layout.kept)
    for _, by, _ in graph_rows:
        columns = layout.columns(list(by))
        rows = np.hstack(list(by.values())) * layout.sigma[columns]
        information[np.ix_(at[columns], at[columns])] += rows.T @ rows
    candidates = at[layout.columns(sorted(layout.unbounded))]
    model = np.setdiff1d(np.arange(len(information)), candidates)
    out = np.zeros_like(information)
    block = cho_factor(information[np.ix_(model, model)])
    out[np.ix_(model, model)] = cho_solve(block, np.eye(len(model)))
    return out * np.outer(layout.sigma[layout.kept], layout.sigma[layout.kept])


def _step(whole: Linearisation, graph_rows: GraphRows, kept: np.ndarray) -> np.ndarray:
    """The step (U,) to the optimum of all rows as they were linearised and weighted: next to
    nothing where the fit had converged."""
    layout = whole.layout
    at, right = positions(layout.size, layout.kept), whole.kept[:-1, -1].copy()
    for _, by, b in graph_rows:
        columns = layout.columns(list(by))
        right[at[columns]] += (np.hstack(list(by.values())) * layout.sigma[columns]).T @ b
    unit = layout.sigma[layout.kept]
    scaled = (kept @ (right / unit)) / unit
    return whole.directions(np.append(scaled, -1.0)[:, None])[:, 0] * layout.sigma
