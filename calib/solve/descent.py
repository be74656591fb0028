"""Downhill: Gauss-Newton passes while beams meet what they met, none so far that the cost rises."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from calib.linear.layout import Layout
from calib.linear.linearise import linearise
from calib.linear.rows import Weighing
from calib.linear.system import Linearisation
from calib.problem.problem import Block, Problem
from calib.residuals.beams import Association
from calib.solve.estimate import cost_of
from calib.solve.graph import Graph, KeptRows
from calib.solve.torn import astray

Progress = Callable[[str, int, int], None]
MAX_PASSES = 40  # a choice: four times what good recordings take (see `SLOWED`)
# Passes over trackers and targets alone to their optimum, on good recordings (12 stops of a world
# with an arm, CAD off by its sigmas).
USUAL_PASSES = 4
# Passes of a descent, from which robust scales go half the way: they follow the state, and where
# residuals are far from normal state and scales can swing about each other for ever (stops that
# scatter by three times a beam's sigma: steps of 0.1 sigma without end). In 24 worlds of another
# simulator with nothing to find a descent took 4 to 9 passes. Before that they go half the way
# where new scales change the cost by more than the next step is to lower it.
SLOWED = 12
# By how much a further step would lower half the chi-square: 1e-3 is a step of 0.04 sigma.
AT_OPTIMUM = 1e-3
# The last step of a fit is to be so much smaller: weights follow the state, and where residuals are
# far from normal each step lowers the cost by up to two thirds of what the one before it did.
LAST = AT_OPTIMUM / 4
# While weights still change, passes end when one lowers the cost by less than so much of what the
# first was to lower it by.
ROUGHLY = 0.01
# By how much a step still lowers half the chi-square where the robust scales alone keep a fit from
# its end: 0.002 to 0.010 in 4 of 50 recordings with a structured error and 400 beams a stop, so ten
# times that. Scales are then kept, as by MM-estimates (Yohai 1987, Annals of Statistics 15).
SWAYS = 0.1
STEADY = 1e-9  # the same, of trackers and targets alone, whose steps cost little
COST_ROUNDING = 1e-14  # of a cost: what is less is rounding
UPHILL = 1e-9  # of a cost: a step that raises it by more is shortened
SHORTEST_STEP, LONGEST_STEP = 1e-3, 2.0  # of a step: how much of it may be taken


class Descent:
    """A problem at a state, and the way down from there.

    Args:
        problem: what is estimated.
        prior: a joint prior, or None.
        progress: called with what is being done, how many stops are done, and of how many.
        values: the state.
    """

    def __init__(
        self, problem: Problem, prior: Block | None, progress: Progress, values: dict
    ) -> None:
        self.problem, self.progress, self.values = problem, progress, values
        self.prior = [prior] if prior else []
        self.held = frozenset(name for block in self.prior for name in block.variables)
        self.associations: list[Association] = []
        self.passes = 0
        # Whether beams were in what was linearised last; None where that was not at plain weights.
        self.plain: bool | None = None
        self.linear: Linearisation | None = None
        self.graph: Graph | None = None
        self.scales: Sequence[Weighing] = ()  # of every scan, where they are kept
        self.lay_out()

    def cost(self) -> float:
        """Half the robust chi-square where all was linearised last, priors included."""
        return self._cost(self.linear.beams_cost)

    def _cost(self, of_beams: float) -> float:
        """The same, with the beams' part given."""
        linear = self.linear
        return cost_of(linear, self.graph, linear.values) - linear.beams_chi2 / 2 + of_beams

    def descend(
        self,
        least: float,
        size: float = np.inf,
        beams: bool = True,
        hasten: bool = True,
        passes: int | None = None,
    ) -> bool:
        """Gauss-Newton passes while beams meet what they met; whether they came to their end.

        Of each step so much is taken as lowers the cost, beams weighed as where it began.

        Args:
            least: by how much the step of the last pass may lower half the chi-square.
            size: how large it may be, m and rad.
            beams: False for trackers and targets alone.
            hasten: whether the curvature of the beams' cost may take the place of their weights.
            passes: how many at most; `MAX_PASSES` where None, and never more.
        """
        newton, last, misled, wait, part = False, np.inf, 0, 0, 1.0
        before, tangent, cost, fall = None, None, np.inf, 0.0
        swings = False
        weighed: Sequence[Weighing] = ()
        for count in range(min(passes or MAX_PASSES, MAX_PASSES)):
            if before is None:
                self.linearise_here(beams)
            else:
                slowed = self.linear.weighed if count >= SLOWED or swings else ()
                self.linearise(newton=newton, beams=beams, weighed=weighed, slowed=slowed)
            self.passes += 1
            if before is not None:
                fell = cost - self._cost_before()
                lowest = _lowest(part, fall, fell)
                if fell < -UPHILL * cost - STEADY:
                    part = min(lowest, part / 2)
                    self.values = (
                        self.moved(before, tangent, part) if part > SHORTEST_STEP else before
                    )
                    if part <= SHORTEST_STEP:
                        self.linearise(beams=beams)
                        return False
                    continue
                part = max(1.0, lowest)
            before, cost, weighed = self.values, self.cost(), self.linear.weighed
            tangent, fall = self.step()
            swings = abs(cost - self._cost_before()) > fall
            length = self.size(tangent)
            self.values = self.moved(before, tangent, part)
            if length < size and fall < max(least, COST_ROUNDING * cost):
                return True
            # Where a row's curvature misleads, steps grow; its weight never does. It is tried again
            # after twice as many passes each time, lest the steps go round in circles.
            if newton and length >= last:
                misled, wait = misled + 1, 2 ** (misled + 1)
            wait = max(wait - 1, 0)
            newton, last = hasten and beams and not wait and length < last, length
        return False

    def keep_scales(self) -> None:
        """Weigh beams from here on by the robust scales that they have now."""
        self.scales = [replace(each, kept=True) for each in self.linear.weighed]

    def descend_bodies(self, least: float) -> bool:
        """Descend by trackers and targets alone; whether that came to its end. Given up where
        bodies are far off and their cost does not fall by half in as many passes as are usual.

        Args:
            least: as of `descend`.
        """
        before = np.inf
        for _ in range(MAX_PASSES):
            if self.descend(least, beams=False, passes=USUAL_PASSES):
                return True
            if self.cost() > before / 2:
                break
            before = self.cost()
        most = SLOWED if self.problem.scans else MAX_PASSES  # what a start for scans is worth
        return not self.bodies_astray() and self.descend(least, beams=False, passes=most)

    def bodies_astray(self) -> bool:
        """Whether half of the stops have a body far from where the chain puts it."""
        return astray(self.problem, self.values)

    def descend_roughly(self, beams: bool = True) -> None:
        """Passes for as long as they lower the cost by much of what the first does."""
        self.linearise_here(beams)
        _, fall = self.step()
        if beams:
            self.descend(max(LAST, ROUGHLY * fall))
        else:
            self.descend_bodies(max(STEADY, ROUGHLY * fall))

    def _cost_before(self) -> float:
        """The cost here, beams weighed as they were before the step."""
        told = self.linear.cost_before
        return self._cost(self.linear.beams_cost if told is None else told)

    def lay_out(self) -> None:
        """Take the problem as it is now."""
        self.layout, self.plain = Layout.of(self.problem, kept=self.held), None

    def linearise_here(self, beams: bool = True) -> None:
        """Linearise everything at the present state, unless that was done last; without `beams`,
        trackers and targets alone."""
        if self.plain is not beams or self.linear.values is not self.values:
            self.linearise(beams=beams)

    def linearise(
        self,
        associate: bool = False,
        newton: bool = False,
        beams: bool = True,
        weighed: Sequence[Weighing] = (),
        slowed: Sequence[Weighing] = (),
    ) -> None:
        """Linearise everything at the present state, and graph what is left of it."""
        self.plain = None if associate or newton or slowed else beams
        slowed = self.scales if beams and self.scales else slowed
        found = [None] * len(self.problem.scans) if associate else self.associations
        self.linear, self.graph = self.linearised(
            self.values, beams, associations=found, newton=newton, weighed=weighed, slowed=slowed
        )

    def linearised(
        self,
        values: Mapping[str, np.ndarray],
        beams: bool,
        associations: Sequence[Association | None] = (),
        newton: bool = False,
        weighed: Sequence[Weighing] = (),
        slowed: Sequence[Weighing] = (),
    ) -> tuple[Linearisation, Graph]:
        """The linearisation at a state, and the graph that it is in."""
        what = f"pass {self.passes + 1}"
        linear = linearise(
            self.problem,
            values,
            associations,
            newton,
            self.layout,
            beams=beams,
            weighed=weighed,
            slowed=slowed,
            progress=lambda done, total: self.progress(what, done, total),
        )
        blocks = [*self.layout.others, *self.prior, *KeptRows.of(linear)]
        return linear, Graph(list(self.layout.outer().values()), blocks, self.held)

    def step(self) -> tuple[dict[str, np.ndarray], float]:
        """One step of the graph: the tangent step of every unknown, and by how much half the
        chi-square was to fall."""
        _, moved, fall = self.graph.step(self.values)
        kept = np.concatenate([np.zeros(0), *(moved[n] for n in self.layout.outer())])
        fall += (self.linear.chi2 - self.linear.kept[-1, -1]) / 2
        return moved | self.linear.step(kept), fall

    def moved(
        self, before: Mapping[str, np.ndarray], tangent: Mapping[str, np.ndarray], part: float = 1.0
    ) -> dict[str, np.ndarray]:
        """The state after a part of a step."""
        step = {name: part * each for name, each in tangent.items()}
        inner = {n: self.layout.unknowns[n].moved(before[n], step[n]) for n in self.layout.inner()}
        return {**before, **self.graph.moved(before, step), **inner}

    def size(self, tangent: Mapping[str, np.ndarray]) -> float:
        """The largest change of the calibration in a step, m or rad."""
        return max(float(np.abs(tangent[name]).max()) for name in self.problem.calibration)


def _lowest(part: float, fall: float, fell: float) -> float:
    """Where along a step the cost is lowest, as the parabola through what is known has it.

    Of a step a whole one lowers a quadratic cost most. Where residuals are far from normal, the
    curvature is less than the weights say, and several steps would go the same way.

    Args:
        part: how much of the step was taken.
        fall: by how much all of it was to lower the cost; at its start the slope is twice that.
        fell: by how much that part did.
    """
    bend = 2 * fall * part - fell
    return (
        float(np.clip(fall * part**2 / bend, part / 10, LONGEST_STEP)) if bend > 0 else LONGEST_STEP
    )
