"""Where unknowns begin of which only beams tell that have no weight.

A beam beyond Tukey's 4.685 sigma has no weight, so an unknown that explains such beams feels
nothing of them and would stay where it is: an effect that was added to a fit, or the offset of a
ring all of whose beams are far off. Huber's cost is convex: it has one minimum, which is found from
anywhere. So such an unknown begins there, all else held, if Tukey's cost is lower than where it is.
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
from calib.residuals.robust import tukey_costs
from calib.residuals.scan import ScanStop

HUBER = 1.345  # sigmas: 95 % efficiency on normal rows (Holland and Welsch 1977)
MOST_PASSES = 5  # a choice: the cost is convex, and it is but where the fit begins
SETTLED_SIGMAS = 0.1  # sigmas of an unknown: Tukey's steps do the rest
# Of the beams of a ring, from which on those that are left may agree by chance: where half of the
# rows are bad, no estimate is robust. Of rings that meet clutter, spread over a tenth of the range
# or more, 88 to 97 % were rejected, and the rest held offsets 5 to 45 sigmas off; where people
# stood before 40 % of the walls, 39 to 46 % of any ring's.
MOST_REJECTED = 0.5


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
    if not state:
        return {}
    known = problem.variables
    new = [n for n in known if n not in state and np.array_equal(values[n], known[n].mean)]
    return anew(problem, values, associations, {n: np.ones(known[n].dim, bool) for n in new})


def rejected(
    problem: Problem, values: Values, associations: Sequence[Association]
) -> dict[str, np.ndarray]:
    """The parameters that a part of the beams feel each, as rings do, and of whose beams half or
    more have no weight.

    Args:
        problem, values, associations: as of `begun`.

    Returns:
        Unknown -> (P,) bool, of unknowns with any.
    """
    acting = _acting(problem)
    counts = {n: np.zeros((2, u.dim)) for n, u in problem.variables.items() if n in acting}
    for found in over_stops(partial(_felt, values), problem.scans, associations):
        for name in (n for n in found if n in counts):
            counts[name] += found[name]
    most = {
        n: (lost > 0) & (lost >= MOST_REJECTED * usable) for n, (usable, lost) in counts.items()
    }
    return {name: some for name, some in most.items() if np.any(some)}


def anew(
    problem: Problem,
    values: Values,
    associations: Sequence[Association],
    free: Mapping[str, np.ndarray],
) -> dict[str, np.ndarray]:
    """Where Huber's cost of the beams is least, all but some parameters held; of these, those for
    which Tukey's cost is lower there than where they are, if it is so for all together.

    Args:
        problem, values, associations: as of `begun`.
        free: unknown -> (P,) which of its parameters may move.

    Returns:
        Unknown -> (P,), of unknowns that moved.
    """
    scans, known = problem.scans, problem.variables
    acting = _acting(problem)
    names = [n for n in known if n in acting and n in free and np.any(free[n])]
    if not names:
        return {}
    sizes = [known[name].dim for name in names]
    at = dict(zip(names, np.split(np.arange(sum(sizes)), np.cumsum(sizes)[:-1]), strict=True))
    sigma = np.concatenate([known[name].sigma for name in names])
    mean = np.concatenate([known[name].mean for name in names])
    moves = np.flatnonzero(np.concatenate([free[name] for name in names]))

    def sums(theta: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Normal equations of Huber's cost; and Tukey's cost of the beams that feel each parameter,
        last of all beams, priors included."""
        here = {**values, **{name: theta[i] for name, i in at.items()}}
        information, right = np.diag(1.0 / sigma**2), (mean - theta) / sigma**2
        prior = np.square((theta - mean) / sigma) / 2
        cost = np.append(prior, prior.sum())
        for gram, gradient, beams in over_stops(partial(_normal, here, at), scans, associations):
            information, right, cost = information + gram, right - gradient, cost + beams
        return information, right, cost

    theta = before = np.concatenate([values[name] for name in names])
    first = None
    for _ in range(MOST_PASSES):
        information, right, cost = sums(theta)
        first = cost if first is None else first
        told = information[np.ix_(moves, moves)]
        step = np.linalg.solve(told, right[moves])
        theta = theta + np.bincount(moves, step, len(theta))
        if np.all(np.abs(step) < SETTLED_SIGMAS / np.sqrt(np.diag(told))):
            break
    last = sums(theta)[2]
    lower = last[:-1] < first[:-1]
    if not np.all(lower[moves]):
        theta = np.where(lower, theta, before)
        last = sums(theta)[2]
    if last[-1] >= first[-1]:
        return {}
    return {name: theta[i] for name, i in at.items() if np.any(theta[i] != before[i])}


def declared(problem: Problem, held: Collection[str]) -> dict[str, np.ndarray]:
    """Where those unknowns begin whose effect says so, of those that single beams feel and of which
    no earlier estimate (`held`) tells."""
    known, initial = problem.variables, problem.initial
    felt = _acting(problem) & set(known) - set(held)
    return {n: initial[n] for n in felt if not np.array_equal(initial[n], known[n].mean)}


def _acting(problem: Problem) -> set[str]:
    """The unknowns of effects that single beams may feel."""
    return {term.variable for scan in problem.scans for term in scan.terms}


def _normal(
    values: Values, at: Mapping[str, np.ndarray], scan: ScanStop, association: Association
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """One stop's weighted Gram matrix and gradient of some unknowns; and Tukey's cost of the beams
    that feel each of their parameters, last of all beams."""
    rows = scan.rows(values, association)
    count, parts = len(rows.residual_m), []
    for name, i in at.items():
        dense = rows.dense.get(name, np.zeros((count, len(i))))
        sparse = [_sparse(c, count, len(i)) for c in rows.sparse if c.variable == name]
        parts.append(sum(sparse, csr_array(dense)))
    A = hstack(parts, format="csr")
    z = np.where(rows.usable, rows.residual_m / rows.sigma_m, 0.0)
    huber = np.minimum(1.0, HUBER * rows.scale / np.maximum(np.abs(z), 1e-300))
    weighted = A.multiply((np.where(rows.usable, huber, 0.0) / rows.sigma_m**2)[:, None]).T.tocsr()
    costs = tukey_costs(z, rows.scale)
    felt = (A != 0).T.astype(float) @ costs
    return (weighted @ A).toarray(), weighted @ rows.residual_m, np.append(felt, costs.sum())


def _felt(values: Values, scan: ScanStop, association: Association) -> dict[str, np.ndarray]:
    """Unknown -> (2, P) how many beams of a stop feel each parameter, of unknowns of which a beam
    feels one parameter; and how many of these have no weight."""
    rows, out = scan.rows(values, association), {}
    lost = rows.usable & (rows.weight == 0.0)
    for column in rows.sparse:
        counts = np.zeros((2, column.components.max(initial=-1) + 1))
        for n, some in enumerate((rows.usable, lost)):
            known = column.index[some & (column.index >= 0)]
            counts[n] += np.bincount(column.components[known], minlength=counts.shape[1])
        out[column.variable] = counts
    return out


def _sparse(column: Columns, rows: int, size: int) -> csr_array:
    """A derivative with one non-zero per row (rows, size), as a matrix."""
    known = np.flatnonzero(column.index >= 0)
    at = known, column.components[column.index[known]]
    return csr_array((column.value[known], at), shape=(rows, size))
