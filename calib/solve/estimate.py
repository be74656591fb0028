"""What a fit found, and where another one may start from."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from calib.linear.clusters import Entries, over_all
from calib.linear.layout import StopKey, key_of
from calib.linear.system import Linearisation
from calib.problem.problem import Problem
from calib.problem.spread import spread_of
from calib.problem.unknowns import Unknown
from calib.residuals.beams import Association
from calib.residuals.scan import ScanStop
from calib.solve.added import rejected
from calib.solve.graph import FactorGraph, Graph

# Of a state, beside an unknown's NAME: the parameters of a vector, and the value at which the beams
# looked what they meet.
DOFS, SEEN = ".dofs", ".seen"
SD = ".sd"  # and, after a key of `problem.spread`, how widely something scatters by chance


@dataclass(frozen=True)
class Start:
    """Where a fit starts from: an earlier one of much the same problem.

    Args:
        state: `Estimate.state` of that; what it does not know starts at its mean.
        met: stop -> which part of the surface each of its beams met (N,), where that is known.
        aside: tokens of the scans and bodies that it had set aside.
    """

    state: Mapping[str, np.ndarray] = field(default_factory=dict)
    met: Mapping[StopKey, np.ndarray] = field(default_factory=dict)
    aside: frozenset[str] = frozenset()

    def spread(self, problem: Problem) -> dict[str, float]:
        """How widely things scatter by chance in a problem, by the keys of `problem.spread`; of
        those that the state knows."""
        known = {key: self.state.get(f"{key}{SD}") for key in spread_of(problem)}
        return {key: float(sd) for key, sd in known.items() if sd is not None}

    def without(self, names: Collection[str]) -> Start:
        """The same, with nothing known of some unknowns."""
        gone = {f"{name}{ending}" for name in names for ending in ("", DOFS, SEEN)}
        return Start({n: x for n, x in self.state.items() if n not in gone})


@dataclass(frozen=True)
class Estimate:
    """What a fit found.

    Args:
        problem: what was estimated, the unknowns of surfaces included.
        values: every unknown, at the optimum.
        variables: the calibration's, in order.
        covariance: (P, P) joint marginal of their tangents, with stop, surface and patch errors as
            unknowns of the graph.
        associations: per scan, which part of the surface each beam met.
        iterations: passes over the scans (or of the solver, where there are none).
        converged: whether a further step would change next to nothing.
        graph: the factor graph of the kept unknowns, as it was last linearised; None of a fit that
            was resumed.
        linear: the linearisation whose rows are in it; None likewise.
        seen: the values at which the scans were associated; empty where there are none.
    """

    problem: Problem
    values: dict[str, np.ndarray]
    variables: tuple[Unknown, ...]
    covariance: np.ndarray
    associations: Sequence[Association]
    iterations: int
    converged: bool
    graph: Graph | None
    linear: Linearisation | None
    seen: dict[str, np.ndarray]

    @property
    def scans(self) -> Sequence[ScanStop]:
        """The stops with beams."""
        return self.problem.scans

    @property
    def cost(self) -> float:
        """Half the weighted chi-square, priors included."""
        return cost_of(self.linear, self.graph, self.values)

    @property
    def robust_cost(self) -> float:
        """The same with half the robust chi-square of beams in place of the weighted one."""
        return rest_of(self.linear, self.graph, self.values, ()) + self.linear.beams_cost

    def loosened(self, moved: Mapping[str, float]) -> Estimate:
        """The same estimate, as it is held against CAD where unknowns have moved since that told
        of them; see `Model.moved`."""
        problem = self.problem.loosened(moved)
        variables = tuple(problem.variables[v.name] for v in self.variables)
        return replace(self, problem=problem, variables=variables)

    def handed_out(self) -> FactorGraph:
        """The graph at the optimum, as GTSAM has it."""
        return self.graph.handed_out(self.values, self.linear.chi2)

    @property
    def start(self) -> Start:
        """Where another fit of much the same problem may start from."""
        pairs = zip(self.scans, self.associations, strict=True)
        met = {key_of(scan): met.part for scan, met in pairs}
        return Start(self.state, met, self.problem.set_aside)

    @property
    def state(self) -> dict[str, np.ndarray]:
        """All values; per vector ``NAME.dofs``, its parameters; ``NAME.seen``, the value at which
        the scans were associated; and ``KEY.sd``, how widely things scatter by chance."""
        known = self.problem.variables.values()
        dofs = {f"{v.name}{DOFS}": np.array(v.dofs, np.str_) for v in known if v.kind == "vector"}
        spread = {f"{k}{SD}": np.float64(sd) for k, sd in spread_of(self.problem).items()}
        seen = {f"{name}{SEEN}": x for name, x in self.seen.items()}
        return self.values | dofs | spread | seen

    def touched(self) -> np.ndarray:
        """Whether any measurement depends on each parameter of the calibration: (P,) bool."""
        layout, seen = self.linear.layout, self.linear.touched.copy()
        for block in layout.others:
            derivative = block.evaluate(self.values, derivatives=True)[1]
            for name in (n for n in derivative if n in layout.at):
                columns = layout.columns([name])
                seen[columns] |= layout.moves(derivative[name], columns)
        return seen[layout.columns([v.name for v in self.variables])]

    @cached_property
    def not_trusted(self) -> dict[str, np.ndarray]:
        """Unknown of the calibration -> which of its parameters (P,) hang on beams half or more of
        which are rejected; of unknowns with any."""
        found = rejected(self.problem, self.values, self.associations)
        return {v.name: found[v.name] for v in self.variables if v.name in found}

    def covariance_of(self, names: Sequence[str]) -> np.ndarray:
        """Joint marginal covariance of unknowns that are no surface's, in the order given."""
        layout = self.linear.layout
        outer = layout.outer()
        if all(name in outer for name in names):
            return self.graph.covariance(self.values, names)
        columns = layout.columns(names)
        rows = over_all([Entries.one_each(np.ones(len(columns)), columns)], layout.size)
        return self.linear.covariance(rows, self.kept)

    def variances(self, some: Sequence[Mapping[str, np.ndarray]]) -> list[np.ndarray]:
        """Variances (m,) of sets of rows; see `Linearisation.variances`."""
        return self.linear.variances(some, self.kept)

    @cached_property
    def kept(self) -> np.ndarray:
        """Covariance (S, S) of what no elimination has taken out of the graph."""
        return self.graph.covariance(self.values, list(self.linear.layout.outer()))


def cost_of(linear: Linearisation, graph: Graph, values: Mapping[str, np.ndarray]) -> float:
    """Half the weighted chi-square at the state of a linearisation, priors included: of its own
    rows, and of those of the graph that it is in."""
    return linear.chi2 / 2 + graph.error(values, measured=True)


def rest_of(
    linear: Linearisation,
    graph: Graph,
    values: Mapping[str, np.ndarray],
    of_noise: Sequence[Unknown],
) -> float:
    """What of that a fit is to lower beside the cost of beams: nothing by which rows are weighed.
    Where noise is estimated, its priors and the rows of scatter that tell of it have no part.

    Args:
        linear, graph, values: as of `cost_of`.
        of_noise: unknowns of effects on the noise that have priors of their own.
    """
    moved = ((values[u.name] - u.mean) / u.sigma for u in of_noise)
    aside = linear.beams_chi2 + sum(float(each @ each) for each in moved)
    return cost_of(linear, graph, values) - aside / 2


def values_of(problem: Problem, state: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Where a state puts a problem's unknowns; those that it lacks are where they start."""
    known = problem.variables.items()
    return {n: started(v, state, problem.initial[n]) for n, v in known}


def started(
    unknown: Unknown, start: Mapping[str, np.ndarray], otherwise: np.ndarray, kind: str = ""
) -> np.ndarray:
    """The unknown's value in a state, parameter by parameter where it names them."""
    found, dofs = start.get(f"{unknown.name}{kind}"), start.get(f"{unknown.name}{DOFS}")
    if found is None or (dofs is None and found.shape != otherwise.shape):
        return otherwise
    if dofs is None:
        return found
    known = dict(zip(dofs.tolist(), found, strict=True))
    pairs = zip(unknown.dofs, otherwise, strict=True)
    return np.array([known.get(dof, value) for dof, value in pairs], float)
