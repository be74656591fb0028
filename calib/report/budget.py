"""The variance budget: what each link and effect contributes to what is measured, in mm.

With J the derivative of a range (of the three coordinates of a tracked position, added up, where
there are no scans) by one variable's parameters, C their joint covariance and theta how far they
came from paper,

    uncertain = sqrt(mean over rows of J C J^T),    moved = sqrt(mean over rows of (J theta)^2).

Both are of one variable alone, all others held. What two of them trade with each other, or with
where the rig stands at a stop, counts in each, so the parts may well exceed the error of the whole.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from calib.linear.layout import StopKey, key_of
from calib.problem import Problem
from calib.residuals.beams import Association, Columns
from calib.residuals.scan import ScanStop
from calib.residuals.tracker import TrackedBody
from calib.results.solution import Solution
from calib.solve.fit import Progress

BUDGET_STOPS, BUDGET_ROWS = 24, 2000  # of each stop that is looked at, no more rows than that

Jacobian = dict[str, np.ndarray]


@dataclass(frozen=True)
class Budget:
    """What each variable contributes, rms over rows, m.

    Args:
        uncertain_m: variable -> by what is not known of it.
        moved_m: variable -> by how far it came from paper; none where paper says nothing.
        rows: how many beams, or tracked positions, were looked at.
        stops: at how many stops; of tracked positions, in how many groups that share every unknown.
    """

    uncertain_m: Mapping[str, float]
    moved_m: Mapping[str, float]
    rows: int
    stops: int


def budget(
    problem: Problem,
    values: Mapping[str, np.ndarray],
    solution: Solution,
    progress: Progress = lambda what, done, total: None,
    met: Mapping[StopKey, np.ndarray] = MappingProxyType({}),
) -> Budget:
    """The budget at a solution, over rows drawn evenly from stops drawn evenly.

    Args:
        problem: what was solved.
        values: the solution's state.
        solution: its covariance.
        progress: called with what is being done, and how far it is.
        met: what beams are known to have met, as of `Start.met`; of others it is found anew.
    """
    at: dict[str, list[int]] = {}
    for i, key in enumerate(solution.keys):
        at.setdefault(key.unknown, []).append(i)
    drawn = [n for n in at if problem.variables[n].kind == "vector"]  # a pose has no paper
    uncertain, moved = dict.fromkeys(at, 0.0), dict.fromkeys(drawn, 0.0)
    rows, stops = 0, 0
    for J, count in _jacobians(problem, values, met, progress):
        for name in (n for n in at if n in J):
            uncertain[name] += _variance(J[name], solution.covariance[np.ix_(at[name], at[name])])
            if name in moved:
                moved[name] += float(np.square(J[name] @ values[name]).sum())
        rows, stops = rows + count, stops + 1
    rms = {n: float(np.sqrt(v / max(rows, 1))) for n, v in uncertain.items()}
    shifts = {n: float(np.sqrt(v / max(rows, 1))) for n, v in moved.items()}
    return Budget(rms, shifts, rows, stops)


def _variance(J: np.ndarray, covariance: np.ndarray) -> float:
    return float(np.einsum("ni,ij,nj->", J, covariance, J, optimize=True))


def _jacobians(
    problem: Problem,
    values: Mapping[str, np.ndarray],
    met: Mapping[StopKey, np.ndarray],
    progress: Progress,
) -> Iterator[tuple[Jacobian, int]]:
    """Per stop, variable -> (n, dim) derivative of what is measured there, m per unit; and how many
    measurements that is."""
    if problem.scans:
        chosen = np.linspace(0, len(problem.scans) - 1, BUDGET_STOPS).round().astype(int)
        for k, i in enumerate(np.unique(chosen).tolist()):
            progress("derivatives", k, len(chosen))
            scan = problem.scans[i]
            part = met.get(key_of(scan))
            known = None if part is None else scan.settled(part, values)
            jacobian = beam_jacobian(scan, values, known)
            yield jacobian, len(next(iter(jacobian.values())))
        return
    for block in problem.blocks:
        if isinstance(block, TrackedBody):
            _, d = block.evaluate(values, derivatives=True)
            width = 3 if block.is_point else 6
            of_position = np.arange(block.rows) % width >= width - 3
            jacobian = {name: block.sigma_m * each[of_position] for name, each in d.items()}
            yield jacobian, len(block.measured)


def beam_jacobian(
    scan: ScanStop, values: Mapping[str, np.ndarray], association: Association | None = None
) -> Jacobian:
    """Variable -> (n, dim) derivative of the range residuals of a stop's beams, m per unit.

    Args:
        scan: the stop; of its beams that the fit keeps, at most `BUDGET_ROWS` are taken, evenly.
        values: the state.
        association: what its beams meet; found anew where None.
    """
    rows = scan.rows(values, association)
    kept = np.flatnonzero(rows.weight > 0)
    some = kept[np.unique(np.linspace(0, len(kept) - 1, BUDGET_ROWS).round().astype(int))]
    placed = scan.stops.in_reference(scan.stops.rig.lidar_frame, values)
    out = {name: rows.by_twist[some] @ d[0] for name, d in placed.d.items()}
    out |= {name: columns[some] for name, columns in rows.dense.items()}
    for columns in rows.sparse:
        out[columns.variable] = out.get(columns.variable, 0.0) + _spread(columns, some, values)
    return out


def _spread(columns: Columns, some: np.ndarray, values: Mapping[str, np.ndarray]) -> np.ndarray:
    out = np.zeros((len(some), len(values[columns.variable])))
    index = columns.index[some]
    hit = np.flatnonzero(index >= 0)
    out[hit, columns.components[index[hit]]] = columns.value[some][hit]
    return out
