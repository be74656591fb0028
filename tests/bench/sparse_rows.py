"""The usual optimiser: `scipy.optimize.least_squares` with a sparse Jacobian, on frozen rows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares
from scipy.sparse import block_diag, csr_array, eye_array, vstack
from workload import Values, Work

from calib.forward import Placed
from calib.linear.linearise import lidars
from calib.problem.unknowns import Unknown
from calib.residuals.beams import Rows
from calib.residuals.scan import ScanStop
from calib.solve.descent import MAX_PASSES
from calib.solve.loop import CONVERGED
from chains import se3

Part = tuple[np.ndarray, csr_array]


@dataclass(frozen=True, kw_only=True)
class FrozenScan(ScanStop):
    """A stop whose rows keep the weights and sigmas that they had.

    Args:
        weights: those.
    """

    weights: Mapping[str, np.ndarray]

    def rows(self, *state: object) -> Rows:
        """The rows at a state."""
        return replace(super().rows(*state), **self.weights)


def frozen(work: Work) -> Work:
    """The work as plain least squares: weights and what beams meet are kept."""
    scans = []
    for scan, association in zip(work.problem.scans, work.associations, strict=True):
        rows = scan.rows(work.start, association)
        weights = {"weight": rows.weight, "sigma_m": rows.sigma_m}
        scans.append(FrozenScan(**vars(scan), weights=weights))
    return replace(work, problem=replace(work.problem, scans=scans))


def optimum(work: Work) -> Values:
    """Our steps, until one is as small as that which ends a fit."""
    values = work.start
    for _ in range(MAX_PASSES):
        before, values = values, work.step(values, work.associations)
        if max(np.abs(values[name] - before[name]).max() for name in values) < CONVERGED:
            return values
    raise RuntimeError(f"no convergence in {MAX_PASSES} steps")


class SparseRows:
    """The rows of a frozen work as scipy takes them, by the tangent x of all unknowns at the start.

    Derivatives are by each unknown's own increment, then by x.
    """

    def __init__(self, work: Work) -> None:
        self.work, self.unknowns = work, work.problem.variables
        self.at = _slices({n: u.dim for n, u in self.unknowns.items()})
        self.size = sum(u.dim for u in self.unknowns.values())
        self._last: tuple[bytes, Part] | None = None

    def optimum(self) -> np.ndarray:
        """The optimum's x, by trust region and LSMR, tolerances as scipy has them."""
        return least_squares(
            lambda x: self.rows(x)[0],
            np.zeros(self.size),
            lambda x: self.rows(x)[1] @ self._charts(x),
            method="trf",
            tr_solver="lsmr",
            x_scale="jac",
        ).x

    def values(self, x: np.ndarray) -> Values:
        """The state at x."""
        return {n: _moved(u, self.work.start[n], x[self.at[n]]) for n, u in self.unknowns.items()}

    def distance(self, x: np.ndarray, values: Values) -> float:
        """How many sigmas the state at x is from another, all unknowns taken together."""
        mine = self.values(x).items()
        away = [_increment(self.unknowns[n], value, values[n]) for n, value in mine]
        return float(np.linalg.norm(self.rows(x)[1] @ np.concatenate(away)))

    def rows(self, x: np.ndarray) -> Part:
        """Whitened rows and their derivatives; kept, as scipy asks for both at one place."""
        if self._last is None or self._last[0] != x.tobytes():
            values, problem = self.values(x), self.work.problem
            parts = [self._prior(u, values[name]) for name, u in self.unknowns.items()]
            for block in problem.blocks:
                residual, d = block.evaluate(values, derivatives=True)
                columns = np.concatenate([np.r_[self.at[name]] for name in d])
                parts.append((residual, self._csr(np.hstack(list(d.values())), columns)))
            placed = lidars(problem.scans, values)
            parts += [self._beams(i, values, placed[i]) for i in range(len(placed))]
            residuals, derivatives = zip(*parts, strict=True)
            self._last = x.tobytes(), (np.concatenate(residuals), vstack(derivatives, "csr"))
        return self._last[1]

    def _charts(self, x: np.ndarray) -> csr_array:
        """Derivative of the unknowns' own increments by x."""
        return block_diag([_chart(u, x[self.at[n]]) for n, u in self.unknowns.items()], "csr")

    def _prior(self, u: Unknown, value: np.ndarray) -> Part:
        # As GTSAM does, the derivative by a pose's increment is taken for one.
        rows = np.arange(u.dim)
        at = (1.0 / u.sigma, (rows, rows + self.at[u.name].start))
        residual = _increment(u, u.mean, value) / u.sigma
        return residual, csr_array(at, shape=(u.dim, self.size))

    def _beams(self, i: int, values: Values, placed: Placed) -> Part:
        rows = self.work.problem.scans[i].rows(values, self.work.associations[i])
        root = np.sqrt(rows.weight) / rows.sigma_m
        d = {name: block[0] for name, block in placed.d.items() if block.any()}
        chain = np.concatenate([np.r_[self.at[name]] for name in d])
        columns = np.empty((len(root), len(chain) + len(rows.sparse)), np.int32)
        columns[:, : len(chain)] = chain
        for g, c in enumerate(rows.sparse, len(chain)):
            columns[:, g] = self.at[c.variable].start + c.components[c.index]
        sparse = [np.where(c.index >= 0, c.value, 0.0) for c in rows.sparse]
        derivative = np.column_stack([rows.by_twist @ np.hstack(list(d.values())), *sparse])
        return root * rows.residual_m, self._csr(derivative * root[:, None], columns)

    def _csr(self, derivative: np.ndarray, columns: np.ndarray) -> csr_array:
        """Rows of as many entries each, in these columns."""
        count, each = derivative.shape
        starts = each * np.arange(count + 1)
        columns = np.broadcast_to(columns, derivative.shape).ravel()
        return csr_array((derivative.ravel(), columns, starts), shape=(count, self.size))


def _slices(sizes: Mapping[str, int]) -> dict[str, slice]:
    ends = np.cumsum([0, *sizes.values()]).tolist()
    return {n: slice(a, b) for n, a, b in zip(sizes, ends, ends[1:], strict=False)}


def _moved(u: Unknown, value: np.ndarray, x: np.ndarray) -> np.ndarray:
    return value @ se3.exp(x) if u.kind == "pose" else value + x


def _chart(u: Unknown, x: np.ndarray) -> np.ndarray | csr_array:
    return se3.right_jacobian(x) if u.kind == "pose" else eye_array(u.dim)


def _increment(u: Unknown, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return se3.log(se3.inverse(a) @ b) if u.kind == "pose" else b - a
