"""The factor graph: variables, blocks of rows, the solution and its marginals (the gtsam door).

Everything else speaks numpy: a value is an array, a block returns residuals and derivatives as
arrays, and this module alone turns them into GTSAM factors and back.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import gtsam
import numpy as np
from scipy.linalg import solve_triangular

from calib.forward import Derivatives
from calib.linear.elimination import square_root
from calib.linear.layout import positions
from calib.linear.system import Linearisation
from calib.problem.problem import Block
from calib.problem.unknowns import Unknown, UnknownKind

Values = Mapping[str, np.ndarray]


@dataclass(frozen=True)
class KeptRows:
    """What a linearisation says of the kept unknowns, as whitened linear rows of the graph.

    Args:
        constant: (m,) residuals at the state of linearisation.
        by: unknown -> (m, dim).
    """

    constant: np.ndarray
    by: dict[str, np.ndarray]

    name = "all stops"
    kind = "beams"

    @classmethod
    def of(cls, linear: Linearisation) -> list[KeptRows]:
        """Those rows; none where nothing in it speaks of any kept unknown."""
        layout = linear.layout
        root = square_root(linear.kept)
        place = positions(layout.size, layout.kept)
        by = {
            name: root[:, place[layout.at[name]]] / layout.sigma[layout.at[name]]
            for name in layout.outer()
        }
        spoken = {name: d for name, d in by.items() if d.any()}
        return [cls(-root[:, -1], spoken)] if spoken else []

    @property
    def variables(self) -> tuple[str, ...]:
        return tuple(self.by)

    @property
    def rows(self) -> int:
        return len(self.constant)

    @property
    def cost(self) -> float:
        """Half their sum of squares, where they were linearised."""
        return float(self.constant @ self.constant) / 2

    def plus(self, chi2: float) -> KeptRows:
        """With a row of so much chi-square that no unknown changes."""
        by = {name: np.vstack([d, np.zeros(d.shape[1])]) for name, d in self.by.items()}
        return KeptRows(np.append(self.constant, np.sqrt(max(chi2, 0.0))), by)

    def evaluate(self, values: Values, derivatives: bool) -> tuple[np.ndarray, Derivatives | None]:
        """The rows as they were linearised: a Gauss-Newton step asks for nothing else."""
        return self.constant, dict(self.by) if derivatives else None


class FactorGraph(NamedTuple):
    """A fit as GTSAM has it, to go on from.

    Args:
        graph: priors; rows of trackers and targets, and of an earlier run that was the prior, as
            they are; and one linear factor, which holds what beams, and tracked bodies at stops
            whose place only they know, say of all others. Its error is half the chi-square.
        values: the optimum, of what is in the graph: vectors, and poses as `gtsam.Pose3`.
        keys: unknown -> its key.
    """

    graph: gtsam.NonlinearFactorGraph
    values: gtsam.Values
    keys: dict[str, int]


class Graph:
    """Blocks and priors as one `gtsam.NonlinearFactorGraph`.

    Args:
        variables: the unknowns; each has a prior, weak where little is known.
        blocks: the rows.
        without_prior: variables that have none of their own, as a block stands for it.
    """

    def __init__(
        self,
        variables: Sequence[Unknown],
        blocks: Sequence[Block],
        without_prior: frozenset[str] = frozenset(),
    ) -> None:
        self.variables = {v.name: v for v in variables}
        self._key = {name: k for k, name in enumerate(self.variables)}
        self.blocks = blocks
        self._summed: tuple[Values | None, float] = (None, 0.0)  # the last state, and its error
        self._graph = gtsam.NonlinearFactorGraph()
        for variable in variables:
            if variable.name not in without_prior:
                self._graph.add(self._prior(variable))
        for block in blocks:
            self._graph.add(self._factor(block))
        # What few blocks touch is eliminated first: a target's place, then what all share.
        degree = Counter(name for block in blocks for name in block.variables)
        self._by_degree = sorted(self.variables, key=lambda name: degree[name])

    def error(self, values: Values, measured: bool = False) -> float:
        """Half the sum of squared whitened rows, priors included.

        Args:
            values: the state.
            measured: whether what a linearisation says is left out.
        """
        kept = (b for b in self.blocks if measured and isinstance(b, KeptRows))
        return self._error(values) - sum(b.cost for b in kept)

    def _error(self, values: Values) -> float:
        """Of a state that is asked for again it is known: a pass of a descent asks four times."""
        if self._summed[0] is not values:
            self._summed = values, self._graph.error(self._to_gtsam(values))
        return self._summed[1]

    def solve(self, initial: Values, max_iterations: int = 50) -> tuple[dict[str, np.ndarray], int]:
        """The maximum a posteriori values, by Levenberg-Marquardt, and its iterations.

        GTSAM's default tolerance is relative to the cost: where rows are many, it stops sigmas
        short of the optimum. Here the last step must lower half the chi-square by less than 1e-9.
        """
        params = gtsam.LevenbergMarquardtParams()
        params.setMaxIterations(max_iterations)
        params.setRelativeErrorTol(0.0)
        params.setAbsoluteErrorTol(1e-9)
        # GTSAM's Cholesky gives up where data outweigh a prior by some 1e7; its QR does not.
        params.setLinearSolverType("MULTIFRONTAL_QR")
        # Damping in units of what the rows tell of each unknown: with one number for metres,
        # radians and rad/(N m) alike it gives up far from the optimum.
        params.setDiagonalDamping(True)
        params.setlambdaUpperBound(1e12)
        params.setOrdering(self._ordering())
        start = self._to_gtsam(initial)
        optimizer = gtsam.LevenbergMarquardtOptimizer(self._graph, start, params)
        return self._from_gtsam(optimizer.optimize()), optimizer.iterations()

    def handed_out(self, values: Values, chi2: float) -> FactorGraph:
        """The graph for who goes on from it: rows of a linearisation change with the values there.

        Args:
            values: the state of the linearisation.
            chi2: of all rows in it, those that were eliminated included.
        """
        at, graph = self._to_gtsam(values), gtsam.NonlinearFactorGraph()
        first = self._graph.size() - len(self.blocks)
        for i in range(self._graph.size()):
            block = self.blocks[i - first] if i >= first else None
            if isinstance(block, KeptRows):
                linear = self._factor(block.plus(chi2 - 2 * block.cost)).linearize(at)
                graph.add(gtsam.LinearContainerFactor(linear, at))
            else:
                graph.add(self._graph.at(i))
        return FactorGraph(graph, at, dict(self._key))

    def step(self, values: Values) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray], float]:
        """One Gauss-Newton step: the values after it, the tangent step of each unknown, and by how
        much half the chi-square was to fall."""
        at = self._to_gtsam(values)
        linear = self._graph.linearize(at)
        found = linear.optimize(self._ordering(), gtsam.EliminateQR)
        moved = {name: found.at(self._key[name]) for name in self.variables}
        fall = self._error(values) - linear.error(found)
        return self._from_gtsam(at.retract(found)), moved, fall

    def moved(self, values: Values, step: Values) -> dict[str, np.ndarray]:
        """The values after a tangent step of each unknown."""
        tangent = gtsam.VectorValues()
        for name, key in self._key.items():
            tangent.insert(key, step[name])
        return self._from_gtsam(self._to_gtsam(values).retract(tangent))

    def covariance(self, values: Values, names: Sequence[str]) -> np.ndarray:
        """Joint marginal covariance of the named variables' tangents, in the order given.

        GTSAM eliminates all other variables first; what the Bayes net then says of those named is
        the square root R of the inverse of this covariance.
        """
        linear = self._graph.linearize(self._to_gtsam(values))
        net = linear.eliminateSequential(self._ordering(names), gtsam.EliminateQR)
        at = self._positions(net)
        found = np.sort(np.concatenate([at[name] for name in names]))
        root = solve_triangular(net.matrix()[0][np.ix_(found, found)], np.eye(len(found)))
        order = np.searchsorted(found, np.concatenate([at[name] for name in names]))
        return (root @ root.T)[np.ix_(order, order)]

    def _positions(self, net: gtsam.GaussianBayesNet) -> dict[str, np.ndarray]:
        """Rows of each variable in the net's matrix: unconnected parts come one by one."""
        names = list(self.variables)
        at, start = {}, 0
        for i in range(net.size()):
            name = names[net.at(i).keys()[0]]
            at[name] = np.arange(start, start + self.variables[name].dim)
            start += self.variables[name].dim
        return at

    def linear_rows(
        self, values: Values
    ) -> Iterator[tuple[Block | None, dict[str, np.ndarray], np.ndarray]]:
        """Block (none for a prior), whitened derivative by each variable (m, n), and right side
        (m,), minus the residual, of everything in the graph."""
        now, names = self._to_gtsam(values), list(self.variables)
        for i in range(self._graph.size() - len(self.blocks)):
            prior = self._graph.at(i).linearize(now)
            A, b = prior.jacobian()
            yield None, {names[prior.keys()[0]]: A}, b
        # As GTSAM calls them, but without its copies: a look's rows have thousands of columns.
        for block in self.blocks:
            residual, derivatives = self._evaluated(block, now, True)
            yield block, derivatives, -residual

    def _ordering(self, last: Sequence[str] = ()) -> gtsam.Ordering:
        ordering = gtsam.Ordering()
        for name in [*(n for n in self._by_degree if n not in last), *last]:
            ordering.push_back(self._key[name])
        return ordering

    def _prior(self, v: Unknown) -> gtsam.NonlinearFactor:
        if not np.all(np.asarray(v.sigma) > 0):
            # GTSAM would take it for a constraint, and call all of this variable's marginals zero.
            raise ValueError(f"variable '{v.name}' has a sigma of 0; leave out what is held")
        noise = gtsam.noiseModel.Gaussian.SqrtInformation(v.prior_root)
        make = {
            "vector": gtsam.PriorFactorVector,
            "pose": gtsam.PriorFactorPose3,
        }[v.kind]
        return make(self._key[v.name], _wrap(v.kind, v.mean), noise)

    def _factor(self, block: Block) -> gtsam.CustomFactor:
        if len(set(block.variables)) != len(block.variables):
            raise ValueError(f"block '{block.name}' names a variable twice")
        keys = [self._key[name] for name in block.variables]
        noise = gtsam.noiseModel.Unit.Create(block.rows)
        return gtsam.CustomFactor(noise, keys, self._callback(block))

    def _callback(self, block: Block) -> Callable:
        def rows(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: list | None) -> np.ndarray:
            residual, derivatives = self._evaluated(block, values, jacobians is not None)
            for i, name in enumerate(block.variables if jacobians is not None else ()):
                jacobians[i] = np.asfortranarray(derivatives[name])
            return residual

        return rows

    def _evaluated(
        self, block: Block, values: gtsam.Values, derivatives: bool
    ) -> tuple[np.ndarray, Derivatives]:
        """A block's rows (m,) and, if wanted, their derivatives (m, n) by each of its variables, in
        its order."""
        variables = [self.variables[name] for name in block.variables]
        now = {v.name: _read(v.kind, values, self._key[v.name]) for v in variables}
        residual, by = block.evaluate(now, derivatives)
        _check_finite(block, residual, "residual")
        for v in variables if derivatives else ():
            if by[v.name].shape != (block.rows, v.dim):
                raise ValueError(
                    f"block '{block.name}': derivative by '{v.name}' has shape "
                    f"{by[v.name].shape}, not {(block.rows, v.dim)}"
                )
            _check_finite(block, by[v.name], f"derivative by '{v.name}'")
        return residual, {v.name: by[v.name] for v in variables} if derivatives else {}

    def _to_gtsam(self, values: Values) -> gtsam.Values:
        out = gtsam.Values()
        for name, v in self.variables.items():
            out.insert(self._key[name], _wrap(v.kind, values[name]))
        return out

    def _from_gtsam(self, values: gtsam.Values) -> dict[str, np.ndarray]:
        return {n: _read(v.kind, values, self._key[n]) for n, v in self.variables.items()}


def _check_finite(block: Block, values: np.ndarray, what: str) -> None:
    # A NaN makes GTSAM return the start without a word.
    if not np.isfinite(values).all():
        raise FloatingPointError(f"block '{block.name}' has a {what} that is not finite")


def _wrap(kind: UnknownKind, value: np.ndarray) -> np.ndarray | gtsam.Pose3:
    if kind == "vector":
        return np.asarray(value, float)
    # Pose3(4x4) keeps a rotation as given; make it orthonormal.
    return gtsam.Pose3(gtsam.Rot3.ClosestTo(value[:3, :3]), value[:3, 3])


def _read(kind: UnknownKind, values: gtsam.Values, key: int) -> np.ndarray:
    if kind == "vector":
        return values.atVector(key)
    return values.atPose3(key).matrix()
