"""What all rows of a fit say, against which some of them are held."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import csr_array

from calib.blunders.rows import GraphRows, GroupRows, group_rows
from calib.linear.clusters import Entries, over_all
from calib.linear.layout import positions
from calib.linear.symmetric import eigh
from calib.linear.system import Linearisation
from calib.problem.problem import Problem
from calib.residuals.groups import Group
from calib.solve.graph import Graph

# Of I - w H: below this a direction is held by the group alone (rounding of C is some 1e-9 of it).
HELD_ALONE = 1e-6
ROWS_TOGETHER = 400  # rows whose covariance is computed at once: bounds the memory


class Held(NamedTuple):
    """Rows of one place, as they are weighed, against all others.

    Args:
        rows: of each of its groups.
        H: (m, m) their hat matrix, b: (m,) their right side at the optimum.
    """

    rows: Sequence[GroupRows]
    H: np.ndarray
    b: np.ndarray


class Alike(NamedTuple):
    """Rows of K places that make the same groups, and had they not lost any weight.

    Args:
        number: (K,) of each among all.
        rows: (K,) the rows.
        left: (K, m, m) their redundancy, or of sums the information that is left of a shift.
        b: (K, m) their right side, or (K, m, P) columns in place of it.
    """

    number: Sequence[int]
    rows: Sequence[GroupRows]
    left: np.ndarray
    b: np.ndarray

    def groups(self) -> Iterator[tuple[Group, ...]]:
        """Groups (K,) that have the same directions in their rows, one of each place."""
        return zip(*(rows.groups for rows in self.rows), strict=True)

    def size(self, own: np.ndarray) -> np.ndarray:
        """Root (K, r) of what the rows say of offsets in directions (m, r), all else known."""
        raw = np.stack([rows.own_information for rows in self.rows])
        return np.sqrt(np.maximum(np.einsum("ir,kij,jr->kr", own, raw, own), 1e-300))


@dataclass(frozen=True)
class Others:
    """What all rows of a fit say, against which some of them are held.

    Args:
        whole: they, linearised at its solution, with its scans.
        problem: of that fit; candidates beside it change nothing.
        graph_rows: those of the kept unknowns that are not in it.
        kept: (S, S) covariance of the kept unknowns.
        step: (U,) one more step of all unknowns.
    """

    whole: Linearisation
    problem: Problem
    graph_rows: GraphRows
    kept: np.ndarray
    step: np.ndarray

    @classmethod
    def of(cls, whole: Linearisation, problem: Problem) -> Others:
        """All rows at the solution of a fit."""
        layout = whole.layout
        graph = Graph(list(layout.outer().values()), layout.others, layout.unbounded)
        graph_rows = list(graph.linear_rows(whole.values))
        kept = _kept_covariance(whole, graph_rows)
        step = _step(whole, graph_rows, kept)
        return cls(whole, problem, graph_rows, kept=kept, step=step)

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

    def every(self) -> Iterator[GroupRows]:
        """The rows of all groups."""
        return group_rows(self.whole, self.problem, self.graph_rows)

    @cached_property
    def held(self) -> Sequence[Held]:
        """All groups of rows, those of one place together."""
        sets: dict[tuple[str, str], list[GroupRows]] = {}
        for rows in self.every():
            sets.setdefault(rows.at, []).append(rows)
        found = []
        for batch in _batches(sets.values()):
            H, b = self.against([rows for some in batch for rows in some])
            for some, mine in zip(batch, parts(batch), strict=True):
                found.append(Held(some, H[mine, mine].copy(), b[mine].copy()))
        return found

    def alike(self, towards: np.ndarray | None = None) -> Iterator[Alike]:
        """All groups of rows; with columns `towards` (U, P) of the covariance of all unknowns,
        what the rows say along these in place of their right side."""
        found: dict[object, list[tuple[int, GroupRows, np.ndarray, np.ndarray]]] = {}
        number = 0
        for some, H, b in self.held:
            columns = b if towards is None else self.spread(some) @ towards
            H, columns = at_their_sigmas(some, H, columns)
            for rows, here in zip(some, parts([rows] for rows in some), strict=True):
                left = rows.own_information - H[here, here]
                found.setdefault(rows.like, []).append((number, rows, left, columns[here]))
                number += 1
        for each in found.values():
            numbers, rows, left, columns = zip(*each, strict=True)
            yield Alike(numbers, rows, left=np.stack(left), b=np.stack(columns))


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


def whitening(M: np.ndarray, size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What takes scores (..., r) of informations M (..., r, r) to independent ones of unit variance
    (..., r, r), in units of `size` (..., r): 0 along directions that nothing contradicts; and along
    how many (...) something does."""
    values, axes, seen = contradicted(M / (size[..., :, None] * size[..., None, :]))
    over = np.sqrt(np.divide(1.0, values, out=np.zeros_like(values), where=seen))
    return axes * over[..., None, :] / size[..., :, None], seen.sum(axis=-1)


def contradicted(M: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Eigenvalues (..., r) and eigenvectors (..., r, r) of redundancies (..., r, r), and along
    which of these (..., r) anything contradicts."""
    one = M.shape[-1] == 1
    values, axes = (M[..., 0], np.ones_like(M)) if one else eigh(M)
    return values, axes, values > HELD_ALONE


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
