"""The joint estimate: linearise every stop, solve the graph, repeat; then the honest covariance."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from calib.linear.layout import Layout, StopKey, key_of
from calib.linear.linearise import linearise
from calib.linear.parallel import in_order
from calib.linear.system import Linearisation
from calib.problem.problem import Block, Problem
from calib.problem.surfaces import with_surfaces
from calib.residuals.beams import Association
from calib.solve.estimate import SEEN, Estimate, Start, cost_of, started, values_of
from calib.solve.graph import Graph, KeptRows
from calib.solve.reweight import SETTLED as SETTLED_WEIGHT
from calib.solve.reweight import reweighted
from chains import se3
from chains.errors import InputError

Progress = Callable[[str, int, int], None]
MAX_PASSES = 40
SETTLED = 1e-4  # m and rad: after that, which triangle a beam meets is kept
CONVERGED = 1e-6  # m and rad: a tenth of the smallest sigmas, and the next step is smaller still
STRAYED = 3e-3  # m and rad: a scan that has moved further looks anew what its beams meet
# How often weights are taken anew, and the relative change of one that is none: with scans, and of
# trackers and targets alone, whose passes cost little and where few rows check each other. A change
# can be nine tenths of the one before there (four rods, one off: 0.7 sigma from the optimum after
# ten times, 0.03 once changes are below a thousandth).
REWEIGHTED, ALONE = (10, SETTLED_WEIGHT), (200, 1e-3)
LOOKS = 3  # how often, in a fit that starts from an earlier one
# By how much a further step would lower half the chi-square: 1e-3 is a step of 0.04 sigma.
AT_OPTIMUM = 1e-3
STEADY = 1e-9  # the same, of trackers and targets alone, whose steps cost little


def solve(
    problem: Problem,
    prior: Block | None = None,
    tolerance: float = CONVERGED,
    progress: Progress = lambda what, done, total: None,
    start: Start | None = None,
) -> Estimate:
    """Maximum a posteriori estimate of a problem.

    Trackers and targets alone are solved first. Then each pass linearises every stop's rows at the
    present state (robust weights and, until the fit has settled, the surface met included),
    eliminates what belongs to surfaces and stops, and takes one Gauss-Newton step of the graph of
    all that is left. From an earlier state, what the beams meet is known and a few passes are all
    there is.

    Args:
        problem: what to estimate.
        prior: a joint prior; the unknowns it speaks of then have no prior of their own.
        tolerance: largest step of the last pass, m and rad.
        progress: called with what is being done, how many stops are done, and of how many.
        start: an earlier fit to start from.

    Raises:
        InputError: nothing is left to estimate.
    """
    if not problem.calibration:
        raise InputError("nothing is left to estimate: fix fewer names, or choose an effect")
    loop = _Loop(problem, prior, progress, start)
    if loop.start.state and problem.scans:
        converged = loop.run_on(tolerance)
        return loop.estimate(loop.reweigh(converged, tolerance))
    converged = loop.reweigh(loop.solve_without_scans())
    if not problem.scans:
        return loop.estimate(converged)
    loop.run(SETTLED, associate=True)
    loop.fix_association()
    converged = loop.run(tolerance, associate=False)
    return loop.estimate(loop.reweigh(converged, tolerance))


def preview(problem: Problem, progress: Progress = lambda what, done, total: None) -> Estimate:
    """What a fit would know, from one linearisation at the start: its covariance, near enough."""
    loop = _Loop(problem, None, progress)
    loop.reweigh(loop.solve_without_scans())
    if problem.scans:
        loop.fix_association()
    return loop.estimate(converged=False)


def resume(
    problem: Problem,
    start: Start,
    progress: Progress = lambda what, done, total: None,
) -> Estimate:
    """A fit as it stood: what its beams met and its surfaces' unknowns again, and not one step.

    Args:
        problem: the problem that was solved.
        start: where that fit was left.
        progress: as of `solve`.

    Returns:
        The estimate, without a covariance.
    """
    loop = _Loop(problem, None, progress, start)
    if problem.scans:
        loop.fix_association(loop.seen_before())
    loop.take_weights()
    variables = tuple(problem.variables[name] for name in problem.calibration)
    return Estimate(
        problem=loop.problem,
        values=loop.values,
        variables=variables,
        covariance=np.zeros((0, 0)),
        associations=loop.associations,
        iterations=0,
        converged=True,
        graph=None,
        linear=None,
        seen=loop.seen,
    )


class _Loop:
    """The state of a fit while it runs."""

    def __init__(
        self,
        problem: Problem,
        prior: Block | None,
        progress: Progress,
        start: Start | None = None,
    ) -> None:
        self.given, self.problem = problem, problem
        self.progress, self.start = progress, start or Start()
        self.prior = [prior] if prior else []
        self.held = frozenset(name for block in self.prior for name in block.variables)
        self.values = values_of(problem, self.start.state)
        self.layout = self._layout()
        self.seen: dict[str, np.ndarray] = {}
        self.associations: list[Association] = []
        self.passes = 0
        self.linear: Linearisation | None = None
        self.graph: Graph | None = None

    def solve_without_scans(self) -> bool:
        """Trackers and targets alone: a good start for the beams, or all there is.

        Whether a further step would lower half the chi-square by next to nothing. Where plain steps
        do not lead downhill, GTSAM's damped ones do.
        """
        for damped in (False, True):
            if damped:
                self.values = self._damped()
            best, last = self.values, np.inf
            for _ in range(MAX_PASSES):
                before = self.values
                self._linearise(beams=False)
                self.passes += 1
                cost = cost_of(self.linear, self.graph, before)
                if not cost <= last * (1 + 1e-9) + 1e-9:
                    self.values = best
                    break
                best, last = before, cost
                _, fall = self._step()
                if fall < STEADY:
                    self.passes = 1 if self.problem.scans else self.passes
                    return True
        return fall < AT_OPTIMUM

    def _damped(self) -> dict[str, np.ndarray]:
        """The optimum of trackers and targets by Levenberg-Marquardt, from where the fit began."""
        blocks = [*self.problem.blocks, *self.prior]
        graph = Graph(list(self.problem.variables.values()), blocks, self.held)
        return graph.solve(values_of(self.problem, self.start.state))[0]

    def reweigh(self, converged: bool, tolerance: float | None = None) -> bool:
        """Go on with robust weights until these settle, where any group of rows asks for one.

        Args:
            converged: whether the fit has, with the weights that it had.
            tolerance: as of `run`; of trackers and targets alone where None.
        """
        scans = tolerance is not None
        times, settled = REWEIGHTED if scans else ALONE
        for _ in range(times):
            if not self.take_weights(settled):
                break
            converged = self.run(tolerance, False) if scans else self.solve_without_scans()
            if not (scans or converged):  # weights of a state that is no optimum lead nowhere
                break
        return converged

    def take_weights(self, settled: float = SETTLED_WEIGHT) -> bool:
        """Give every group of rows the weight that its residuals ask for; whether any changed."""
        given = reweighted(self.given, self.values, self.held, settled)
        if given is self.given:
            return False
        self.given = given
        variables = self.problem.variables | given.variables
        self.problem = replace(self.problem, blocks=given.blocks, variables=variables)
        self.layout = self._layout()
        return True

    def run(self, tolerance: float, associate: bool) -> bool:
        """Passes until the step is below tolerance; whether that was reached."""
        newton, last, misled, wait = False, np.inf, 0, 0
        for _ in range(MAX_PASSES):
            self._linearise(associate, newton)
            self.passes += 1
            step, _ = self._step()
            if step < tolerance:
                return True
            # Where a row's curvature misleads, steps grow; its weight never does. It is tried again
            # after twice as many passes each time, lest the steps go round in circles.
            if newton and step >= last:
                misled, wait = misled + 1, 2 ** (misled + 1)
            wait = max(wait - 1, 0)
            newton, last = not associate and not wait and step < last, step
        return False

    def run_on(self, tolerance: float) -> bool:
        """Passes from an earlier state, whose scans keep what they met unless they move far."""
        seen, met = self.seen_before(), self.start.met
        converged = False
        for _ in range(LOOKS):
            self.problem = self.given
            self.fix_association(seen, met)
            converged = self.run(tolerance, associate=False)
            pairs = ((scan.pose(seen), scan.pose(self.values)) for scan in self.problem.scans)
            if all(np.abs(se3.log(se3.inverse(a) @ b)).max() < STRAYED for a, b in pairs):
                break
            seen, met = self.values, {}
        return converged

    def seen_before(self) -> dict[str, np.ndarray]:
        """Where the start was when it took what its beams met."""
        known = self.problem.variables.items()
        return {n: started(v, self.start.state, self.values[n], SEEN) for n, v in known}

    def fix_association(
        self,
        seen: Mapping[str, np.ndarray] | None = None,
        met: Mapping[StopKey, np.ndarray] | None = None,
    ) -> None:
        """Settle what each beam meets, and add the unknowns of the surfaces met.

        Args:
            seen: the values at which beams look; the present ones where None.
            met: what beams are known to meet; the others look anew, and those beside a depth edge
                are dropped. Where None and `seen` is given, what the start knows.
        """
        self.seen = dict(seen or self.values)
        met = self.start.met if met is None and seen is not None else met or {}
        scans, found = self.problem.scans, []

        def work(i: int) -> Association:
            part = met.get(key_of(scans[i]))
            if part is None:
                return scans[i].associate(self.seen, near_edges=True)
            return scans[i].met(self.seen, part)

        for i, association in enumerate(in_order(work, len(scans))):
            self.progress("looking for depth edges", i, len(scans))
            found.append(association)
        self.problem, self.associations = with_surfaces(self.given, found)
        for name in self.problem.cells:
            unknown = self.problem.variables[name]
            self.values[name] = started(unknown, self.start.state, unknown.mean)
        self.layout = self._layout()

    def estimate(self, converged: bool) -> Estimate:
        """The result, with the covariance of the calibration."""
        variables = tuple(self.problem.variables[name] for name in self.problem.calibration)
        self._linearise()
        return Estimate(
            problem=self.problem,
            values=self.values,
            variables=variables,
            covariance=self.graph.covariance(self.values, self.problem.calibration),
            associations=self.associations,
            iterations=self.passes,
            converged=converged,
            graph=self.graph,
            linear=self.linear,
            seen=self.seen,
        )

    def _layout(self) -> Layout:
        return Layout.of(self.problem, kept=self.held)

    def _linearise(self, associate: bool = False, newton: bool = False, beams: bool = True) -> None:
        """Linearise everything at the present state, and graph what is left of it."""
        what = f"pass {self.passes + 1}"
        self.linear = linearise(
            self.problem,
            self.values,
            [None] * len(self.problem.scans) if associate else self.associations,
            newton,
            self.layout,
            beams=beams,
            progress=lambda done, total: self.progress(what, done, total),
        )
        blocks = [*self.layout.others, *self.prior, *KeptRows.of(self.linear)]
        self.graph = Graph(list(self.layout.outer().values()), blocks, self.held)

    def _step(self) -> tuple[float, float]:
        """One step of the graph: the largest change of the calibration, in m or rad, and by how
        much half the chi-square was to fall."""
        before = self.values
        after, moved, fall = self.graph.step(before)
        kept = np.concatenate([np.zeros(0), *(moved[n] for n in self.layout.outer())])
        own = self.linear.step(kept)
        unknowns = self.layout.unknowns
        self.values = before | after | {n: unknowns[n].moved(before[n], s) for n, s in own.items()}
        names = self.problem.calibration
        step = max(float(np.abs(unknowns[n].difference(before[n], after[n])).max()) for n in names)
        return step, fall + (self.linear.chi2 - self.linear.kept[-1, -1]) / 2
