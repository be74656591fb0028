"""The joint estimate: linearise every stop, solve the graph, repeat; then the honest covariance."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.effects import SurfaceShift
from calib.forward import Term
from calib.problem.build import Problem, effect_variable
from calib.problem.model import Source
from calib.residuals.beams import Association, SharedSum
from calib.residuals.scan import ScanStop
from calib.solve.graph import Block, Graph, Variable
from chains import se3
from chains.errors import InputError
from sensors.reference import Reference

Progress = Callable[[str, int, int], None]
MAX_PASSES = 40
# Variance of the steps between surfaces, and between their cells, as shares of the reference's. It
# is more than all of it: steps must stand for the slopes of an error that is smooth over metres.
SURFACE_SHARES = {"surface": 0.6, "region": 0.6, "patch": 2.0}
SETTLED = 1e-4  # m and rad: after that, which triangle a beam meets is kept
CONVERGED = 1e-6  # m and rad: a tenth of the smallest sigma in sight, and steps shrink fast
STRAYED = 3e-3  # m and rad: a scan that has moved further looks anew what its beams meet
LOOKS = 3  # how often, in a fit that starts from an earlier one
# Of a state, beside a variable's NAME: the parameters of a vector, and the value at which the beams
# looked what they meet.
DOFS, SEEN = ".dofs", ".seen"


@dataclass(frozen=True)
class Estimate:
    """What a fit found.

    Args:
        values: every variable of the graph, at the optimum.
        variables: the calibration's, in order.
        covariance: (P, P) joint marginal of their tangents, with stop, surface and patch errors as
            unknowns of the graph.
        associations: per scan, which part of the surface each beam met.
        scans: the scans as linearised last, the surface's unknowns included.
        iterations: passes over the scans (or of the solver, where there are none).
        converged: whether the last step was below tolerance.
        graph: the last linearisation, for marginals of other variables.
        seen: the values at which the scans were associated; empty where there are none.
    """

    values: dict[str, np.ndarray]
    variables: tuple[Variable, ...]
    covariance: np.ndarray
    associations: Sequence[Association]
    scans: Sequence[ScanStop]
    iterations: int
    converged: bool
    graph: Graph
    seen: dict[str, np.ndarray]

    @property
    def state(self) -> dict[str, np.ndarray]:
        """Enough for another fit to start from: all values; per vector ``NAME.dofs``, its
        parameters; and ``NAME.seen``, the value at which the scans were associated."""
        vectors = (v for v in self.graph.variables.values() if v.kind == "vector")
        dofs = {f"{v.name}{DOFS}": np.array(v.dofs, np.str_) for v in vectors}
        return self.values | dofs | {f"{name}{SEEN}": x for name, x in self.seen.items()}


def solve(
    problem: Problem,
    prior: Block | None = None,
    tolerance: float = CONVERGED,
    progress: Progress = lambda what, done, total: None,
    start: Mapping[str, np.ndarray] | None = None,
) -> Estimate:
    """Maximum a posteriori estimate of a problem.

    Trackers and targets alone are solved first. Then each pass linearises every stop's rows at the
    present state (robust weights and, until the fit has settled, the surface met included),
    compresses them, and takes one Gauss-Newton step of the whole graph. From an earlier state, what
    the beams meet is known and a few passes are all there is.

    Args:
        problem: what to estimate.
        prior: a joint prior; the variables it speaks of then have no prior of their own.
        tolerance: largest step of the last pass, m and rad.
        progress: called with what is being done, how many stops are done, and of how many.
        start: a state to start from, ``Estimate.state`` of a fit of much the same problem; what it
            does not know starts at its mean.

    Raises:
        InputError: nothing is left to estimate.
    """
    if not problem.calibration:
        raise InputError("nothing is left to estimate: fix fewer names, or choose an effect")
    loop = _Loop(problem, prior, progress, start)
    if start and problem.scans:
        return loop.estimate(loop.run_on(tolerance))
    loop.solve_without_scans()
    if not problem.scans:
        return loop.estimate(converged=True)
    loop.run(problem.scans, SETTLED, associate=True)
    loop.fix_association()
    loop.add_surface_unknowns()
    return loop.estimate(loop.run(loop.scans, tolerance, associate=False))


def preview(problem: Problem, progress: Progress = lambda what, done, total: None) -> Estimate:
    """What a fit would know, from one linearisation at the start: its covariance, near enough."""
    loop = _Loop(problem, None, progress)
    loop.solve_without_scans()
    if problem.scans:
        loop.fix_association()
        loop.add_surface_unknowns()
    return loop.estimate(converged=False)


def resume(
    problem: Problem,
    start: Mapping[str, np.ndarray],
    progress: Progress = lambda what, done, total: None,
) -> Estimate:
    """A fit as it stood: what its beams met and its surfaces' unknowns again, and not one step.

    Args:
        problem: the problem that was solved.
        start: its state.
        progress: as of `solve`.

    Returns:
        The estimate, without a covariance.
    """
    loop = _Loop(problem, None, progress, start)
    loop.stand()
    names = problem.calibration
    variables = tuple(loop.variables[name] for name in names)
    return Estimate(
        loop.values,
        variables,
        np.zeros((0, 0)),
        loop.associations,
        loop.scans,
        0,
        True,
        loop.graph,
        loop.seen,
    )


class _Loop:
    """The state of a fit while it runs."""

    def __init__(
        self,
        problem: Problem,
        prior: Block | None,
        progress: Progress,
        start: Mapping[str, np.ndarray] | None = None,
    ) -> None:
        self.problem, self.progress, self.start = problem, progress, start or {}
        self.prior = [prior] if prior else []
        self.without = frozenset(prior.variables) if prior else frozenset()
        self.variables = dict(problem.variables)
        self.values = values_of(problem, self.start)
        self.scans = list(problem.scans)
        self.seen: dict[str, np.ndarray] = {}
        self.associations: list[Association] = []
        self.passes = 0
        self.graph: Graph | None = None

    def solve_without_scans(self) -> None:
        """Trackers and targets alone: a good start for the beams, or all there is."""
        self._link([])
        self.values, iterations = self.graph.solve(self.values)
        self.passes = iterations if not self.scans else 1

    def run(self, scans: Sequence[ScanStop], tolerance: float, associate: bool) -> bool:
        """Passes until the step is below tolerance; whether that was reached."""
        newton, last, misled, wait = False, np.inf, 0, 0
        for _ in range(MAX_PASSES):
            self._linearise(scans, associate, newton)
            self.passes += 1
            step = self._step()
            if step < tolerance:
                return True
            # Where a row's curvature misleads, steps grow; its weight never does. It is tried again
            # after twice as many passes each time, lest the steps go round in circles.
            if newton and step >= last:
                misled, wait = misled + 1, 2 ** (misled + 1)
            wait = max(wait - 1, 0)
            newton, last = not associate and not wait and step < last, step
        return False

    def stand(self) -> None:
        """Where the start was left."""
        if self.scans:
            self.fix_association(self._seen_before())
            self.add_surface_unknowns()
        self._link([])

    def run_on(self, tolerance: float) -> bool:
        """Passes from an earlier state, whose scans keep what they met unless they move far."""
        seen = self._seen_before()
        converged = False
        for _ in range(LOOKS):
            self.scans, self.variables = list(self.problem.scans), dict(self.problem.variables)
            self.fix_association(seen)
            self.add_surface_unknowns()
            converged = self.run(self.scans, tolerance, associate=False)
            pairs = ((scan.pose(seen), scan.pose(self.values)) for scan in self.scans)
            if all(np.abs(se3.log(se3.inverse(a) @ b)).max() < STRAYED for a, b in pairs):
                break
            seen = self.values
        return converged

    def _seen_before(self) -> dict[str, np.ndarray]:
        """Where the start was when it took what its beams met."""
        known = self.variables.items()
        return {n: _started(v, self.start, self.values[n], SEEN) for n, v in known}

    def _linearise(self, scans: Sequence[ScanStop], associate: bool, newton: bool) -> None:
        """Link the graph anew, with every stop's beams linearised at the present state."""
        poses, shared = [], SharedSum()
        for i, scan in enumerate(scans):
            self.progress(f"pass {self.passes + 1}", i, len(scans))
            association = None if associate else self.associations[i]
            compressed = scan.compress(self.values, association, newton)
            poses.append(compressed.pose)
            shared.add(compressed)
        self._link([*poses, *shared.rows()])

    def fix_association(self, seen: Mapping[str, np.ndarray] | None = None) -> None:
        """Keep what each beam meets, here or at other values; drop beams beside a depth edge."""
        self.associations, self.seen = [], dict(seen or self.values)
        for i, scan in enumerate(self.scans):
            self.progress("looking for depth edges", i, len(self.scans))
            self.associations.append(scan.associate(self.seen, near_edges=True))

    def add_surface_unknowns(self) -> None:
        """Errors of the reference, common to the points of a surface or cell, as unknowns."""
        for number, scans in self._by_mesh().items():
            sigma_m = self.scans[scans[0]].reference_sigma_m
            if not sigma_m:
                continue
            seen: dict[str, list[np.ndarray]] = {column: [] for column in SURFACE_SHARES}
            for i in scans:
                view = self.scans[i].rows(self.values, self.associations[i]).view
                for column, parts in seen.items():
                    parts.append(np.unique(view[column]))
            for column, found in seen.items():
                parts = np.unique(np.concatenate(found))
                parts = parts[parts >= 0]
                each = sigma_m * np.sqrt(SURFACE_SHARES[column])
                effect = SurfaceShift(f"{number}/reference_{column}", column, parts, each)
                self._switch_on(effect, self.problem.sources[number], scans)

    def _by_mesh(self) -> dict[int, list[int]]:
        """First source with a mesh -> the scans on that mesh, of whatever recording."""
        sources = self.problem.sources
        meshes = [s.reference for s in sources]
        first = {
            id(s.recording): next(
                i for i, mesh in enumerate(meshes) if same_mesh(mesh, s.reference)
            )
            for s in sources
        }
        found: dict[int, list[int]] = {}
        for i, scan in enumerate(self.scans):
            found.setdefault(first[id(scan.recording)], []).append(i)
        return found

    def _switch_on(self, effect: SurfaceShift, source: Source, scans: Sequence[int]) -> None:
        term = Term(effect, effect.name, np.arange(len(effect.parts)))
        variable = effect_variable(term, source)
        self.variables[effect.name] = variable
        self.values[effect.name] = _started(variable, self.start, variable.mean)
        for i in scans:
            self.scans[i] = replace(self.scans[i], terms=[*self.scans[i].terms, term])

    def estimate(self, converged: bool) -> Estimate:
        """The result, with the covariance of the calibration."""
        variables = tuple(self.variables[name] for name in self.problem.calibration)
        if self.scans:
            self._linearise(self.scans, associate=False, newton=False)
        covariance = self.graph.covariance(self.values, self.problem.calibration)
        return Estimate(
            self.values,
            variables,
            covariance,
            self.associations,
            self.scans,
            self.passes,
            converged,
            self.graph,
            self.seen,
        )

    def _link(self, rows: Sequence[Block]) -> None:
        blocks = [*self.problem.blocks, *self.prior, *rows]
        self.graph = Graph(list(self.variables.values()), blocks, self.without)

    def _step(self) -> float:
        """One step of the graph; the largest change of the calibration, in m or rad."""
        before, self.values = self.values, self.graph.step(self.values)
        names = self.problem.calibration
        return max(_change(self.variables[n], before[n], self.values[n]) for n in names)


def values_of(problem: Problem, state: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Where a state puts a problem's variables; those that it lacks are where they start."""
    known = problem.variables.items()
    return {n: _started(v, state, problem.initial[n]) for n, v in known}


def same_mesh(a: Reference | None, b: Reference | None) -> bool:
    """Whether two references are one: their errors are then the same too."""
    if a is None or b is None:
        return a is b
    return np.array_equal(a.vertices_m, b.vertices_m) and np.array_equal(a.triangles, b.triangles)


def _started(
    variable: Variable, start: Mapping[str, np.ndarray], otherwise: np.ndarray, kind: str = ""
) -> np.ndarray:
    """The variable's value in a state, parameter by parameter where it names them."""
    found, dofs = start.get(f"{variable.name}{kind}"), start.get(f"{variable.name}{DOFS}")
    if found is None or (dofs is None and found.shape != otherwise.shape):
        return otherwise
    if dofs is None:
        return found
    known = dict(zip(dofs.tolist(), found, strict=True))
    pairs = zip(variable.dofs, otherwise, strict=True)
    return np.array([known.get(dof, value) for dof, value in pairs], float)


def _change(variable: Variable, before: np.ndarray, after: np.ndarray) -> float:
    if variable.kind == "pose":
        return float(np.abs(se3.log(se3.inverse(before) @ after)).max())
    return float(np.abs(after - before).max())
