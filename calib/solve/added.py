"""Where an effect that was added to a fit begins: not always at zero.

A beam beyond Tukey's 4.685 sigma has no weight, so an effect that explains such beams feels nothing
of them at zero and would stay there. Huber's cost is convex: it has one minimum, which is found
from anywhere. So what was added begins there, all else held, if Tukey's cost is lower than at zero.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from functools import partial

import numpy as np
from scipy.sparse import csr_array, hstack

from calib.forward import Values
from calib.linear.parallel import over_stops
from calib.problem.problem import Problem
from calib.residuals.beams import Association, Columns
from calib.residuals.scan import ScanStop

HUBER = 1.345  # sigmas: 95 % efficiency on normal rows (Holland and Welsch 1977)
MOST_PASSES = 5  # a choice: the cost is convex, and it is but where the fit begins
SETTLED_SIGMAS = 0.1  # sigmas of an unknown: Tukey's steps do the rest


def begun(
    problem: Problem,
    values: Mapping[str, np.ndarray],
    associations: Sequence[Association],
    state: Mapping[str, np.ndarray],
) -> dict[str, np.ndarray]:
    """Where those unknowns begin that an earlier fit did not have and single beams feel.

    Args:
        problem: with them.
        values: where all of its unknowns are now.
        associations: per scan, what its beams meet.
        state: of the earlier fit; nothing is begun where there was none.
    """
    scans = problem.scans
    acting = {term.variable for scan in scans for term in scan.terms} - set(state)
    known = problem.variables
    names = [n for n in known if n in acting and np.array_equal(values[n], known[n].mean)]
    if not state or not names:
        return {}
    sizes = [known[name].dim for name in names]
    at = dict(zip(names, np.split(np.arange(sum(sizes)), np.cumsum(sizes)[:-1]), strict=True))
    sigma = np.concatenate([known[name].sigma for name in names])
    mean = np.concatenate([known[name].mean for name in names])

    def sums(theta: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """Normal equations of Huber's cost, priors included, and Tukey's cost."""
        here = {**values, **{name: theta[i] for name, i in at.items()}}
        information, right = np.diag(1.0 / sigma**2), (mean - theta) / sigma**2
        cost = float(np.sum(np.square((theta - mean) / sigma)) / 2)

        for gram, gradient, beams in over_stops(partial(_normal, here, at), scans, associations):
            information, right, cost = information + gram, right - gradient, cost + beams
        return information, right, cost

    theta, first = np.concatenate([values[name] for name in names]), None
    for _ in range(MOST_PASSES):
        information, right, cost = sums(theta)
        first = cost if first is None else first
        step = np.linalg.solve(information, right)
        theta = theta + step
        if np.all(np.abs(step) < SETTLED_SIGMAS / np.sqrt(np.diag(information))):
            break
    lower = sums(theta)[2] < first
    return {name: theta[i] for name, i in at.items()} if lower else {}


def declared(problem: Problem, held: Collection[str]) -> dict[str, np.ndarray]:
    """Where those unknowns begin whose effect says so, of those that single beams feel and of which
    no earlier estimate (`held`) tells."""
    known, initial = problem.variables, problem.initial
    felt = {t.variable for scan in problem.scans for t in scan.terms} & set(known) - set(held)
    return {n: initial[n] for n in felt if not np.array_equal(initial[n], known[n].mean)}


def _normal(
    values: Values, at: Mapping[str, np.ndarray], scan: ScanStop, association: Association
) -> tuple[np.ndarray, np.ndarray, float]:
    """One stop's weighted Gram matrix and gradient of some unknowns, and its cost after Tukey."""
    rows = scan.rows(values, association)
    count, parts = len(rows.residual_m), []
    for name, i in at.items():
        dense = rows.dense.get(name, np.zeros((count, len(i))))
        sparse = [_sparse(c, count, len(i)) for c in rows.sparse if c.variable == name]
        parts.append(sum(sparse, csr_array(dense)))
    A = hstack(parts, format="csr")
    z = rows.residual_m / rows.sigma_m
    huber = np.minimum(1.0, HUBER * rows.scale / np.maximum(np.abs(z), 1e-300))
    weighted = A.multiply((np.where(rows.usable, huber, 0.0) / rows.sigma_m**2)[:, None]).T.tocsr()
    return (weighted @ A).toarray(), weighted @ rows.residual_m, rows.cost


def _sparse(column: Columns, rows: int, size: int) -> csr_array:
    """A derivative with one non-zero per row (rows, size), as a matrix."""
    known = np.flatnonzero(column.index >= 0)
    at = known, column.components[column.index[known]]
    return csr_array((column.value[known], at), shape=(rows, size))
