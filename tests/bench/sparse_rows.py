"""The usual optimiser: `scipy.optimize.least_squares` with a sparse Jacobian, on frozen rows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.optimize import least_squares
from scipy.sparse import csr_matrix, vstack
from workload import Values, Work

from calib.residuals.beams import CompressedScan, Rows, compress
from calib.residuals.scan import ScanStop
from calib.solve.fit import CONVERGED, MAX_PASSES
from calib.solve.graph import Variable
from chains import se3

Part = tuple[np.ndarray, csr_matrix]


class FrozenRows:
    """A workload's rows, with their weights and what beams meet kept: plain least squares."""

    def __init__(self, work: Work) -> None:
        self.work = work
        self.weights = []
        for scan, association in zip(work.problem.scans, work.associations, strict=True):
            rows = scan.rows(work.start, association)
            self.weights.append({"weight": rows.weight, "sigma_m": rows.sigma_m})

    def rows(self, i: int, values: Values) -> Rows:
        """The rows of one stop at a state."""
        scan = self.work.problem.scans[i]
        return replace(scan.rows(values, self.work.associations[i]), **self.weights[i])

    def optimum(self) -> Values:
        """Steps of the compressed graph, until one is as small as that which ends a fit."""
        values = self.work.start
        for _ in range(MAX_PASSES):
            before = values
            values = self.work.step(before, partial(self._compressed, before))
            if max(np.abs(values[name] - before[name]).max() for name in values) < CONVERGED:
                return values
        raise RuntimeError(f"no convergence in {MAX_PASSES} steps")

    def _compressed(self, values: Values, i: int, scan: ScanStop) -> CompressedScan:
        frame, T = self.work.source.rig.lidar_frame, scan.pose(values)
        return compress(scan.name, self.rows(i, values), scan.stops, frame, T, values, False)


class SparseRows:
    """The same rows as scipy takes them, by the tangent x of all variables at the start."""

    def __init__(self, frozen: FrozenRows) -> None:
        self.frozen, self.work = frozen, frozen.work
        self.variables = self.work.problem.variables
        dims = [v.dim for v in self.variables.values()]
        self.size = sum(dims)
        starts = np.cumsum([0, *dims])
        self.at = {
            name: start + np.arange(dim)
            for name, start, dim in zip(self.variables, starts, dims, strict=False)
        }
        self._last: tuple[bytes, Part] | None = None

    def optimum(self) -> np.ndarray:
        """The optimum's x, by trust region and LSMR, tolerances as scipy has them."""
        return least_squares(
            lambda x: self.rows(x)[0],
            np.zeros(self.size),
            lambda x: self.rows(x)[1],
            method="trf",
            tr_solver="lsmr",
            x_scale="jac",
        ).x

    def values(self, x: np.ndarray) -> Values:
        """The state at x."""
        return {n: _moved(v, self.work.start[n], x[self.at[n]]) for n, v in self.variables.items()}

    def distance(self, x: np.ndarray, values: Values) -> float:
        """How many sigmas the state at x is from another, all unknowns taken together."""
        mine, charts = self.values(x), self._charts(x)
        dx = [
            np.linalg.lstsq(charts[name], _increment(v, mine[name], values[name]))[0]
            for name, v in self.variables.items()
        ]
        return float(np.linalg.norm(self.rows(x)[1] @ np.concatenate(dx)))

    def rows(self, x: np.ndarray) -> Part:
        """Whitened rows and their Jacobian; kept, as scipy asks for both at one place."""
        if self._last is None or self._last[0] != x.tobytes():
            values, charts = self.values(x), self._charts(x)
            parts = [self._prior(v, values[name], charts) for name, v in self.variables.items()]
            for block in self.work.problem.blocks:
                residual, d = block.evaluate(values, derivatives=True)
                parts.append((residual, self._sparse(d, charts)))
            parts += [self._beams(i, values, charts) for i in range(len(self.work.problem.scans))]
            residuals, jacobians = zip(*parts, strict=True)
            self._last = x.tobytes(), (np.concatenate(residuals), vstack(jacobians, "csr"))
        return self._last[1]

    def _charts(self, x: np.ndarray) -> Values:
        """Derivative of each variable's own increment by its part of x."""
        start = self.work.start
        return {n: _chart(v, start[n], x[self.at[n]]) for n, v in self.variables.items()}

    def _prior(self, v: Variable, value: np.ndarray, charts: Values) -> Part:
        # As GTSAM does, the derivative by a pose's increment is taken for one.
        across = _across(v.mean).T if v.kind == "direction" else np.eye(v.dim)
        residual = across @ _increment(v, v.mean, value) / v.sigma
        return residual, self._sparse({v.name: across / v.sigma[:, None]}, charts)

    def _beams(self, i: int, values: Values, charts: Values) -> Part:
        scan, rows = self.work.problem.scans[i], self.frozen.rows(i, values)
        root = np.sqrt(rows.weight) / rows.sigma_m
        d = scan.stops.in_reference(self.work.source.rig.lidar_frame, values).d
        d = {name: block[0] for name, block in d.items() if block.any()}
        chain = np.hstack([d[name] @ charts[name] for name in d])
        (ring,) = rows.sparse
        columns = np.empty((len(root), chain.shape[1] + 1), np.int32)
        columns[:, :-1] = np.concatenate([self.at[name] for name in d])
        columns[:, -1] = self.at[ring.variable][ring.components[ring.index]]
        derivative = np.column_stack([rows.by_twist @ chain, ring.value]) * root[:, None]
        return root * rows.residual_m, self._csr(derivative, columns)

    def _sparse(self, d: Mapping[str, np.ndarray], charts: Values) -> csr_matrix:
        derivative = np.hstack([d[name] @ charts[name] for name in d])
        columns = np.concatenate([self.at[name] for name in d])
        return self._csr(derivative, np.broadcast_to(columns, derivative.shape))

    def _csr(self, derivative: np.ndarray, columns: np.ndarray) -> csr_matrix:
        count, each = derivative.shape
        starts = each * np.arange(count + 1)
        return csr_matrix((derivative.ravel(), columns.ravel(), starts), shape=(count, self.size))


def _across(direction: np.ndarray) -> np.ndarray:
    """(3, 2) two unit vectors at right angles to a direction."""
    return np.linalg.svd(direction[None])[2][1:].T


def _moved(v: Variable, value: np.ndarray, x: np.ndarray) -> np.ndarray:
    if v.kind == "pose":
        return value @ se3.exp(x)
    if v.kind == "direction":
        moved = value + _across(value) @ x
        return moved / np.linalg.norm(moved)
    return value + x


def _chart(v: Variable, value: np.ndarray, x: np.ndarray) -> np.ndarray:
    if v.kind == "pose":
        return se3.right_jacobian(x)
    if v.kind == "direction":
        g = _moved(v, value, x)
        return (np.eye(3) - np.outer(g, g)) @ _across(value) / np.sqrt(1 + x @ x)
    return np.eye(v.dim)


def _increment(v: Variable, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return se3.log(se3.inverse(a) @ b) if v.kind == "pose" else b - a
