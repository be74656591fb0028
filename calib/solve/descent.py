"""Downhill: Gauss-Newton passes while beams meet what they met, none so far that the cost rises."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from calib.linear.layout import Layout
from calib.linear.linearise import linearise
from calib.linear.parallel import over_stops
from calib.linear.rows import State, Weighing
from calib.linear.system import Linearisation
from calib.outputs.journal import Answer, Journal
from calib.problem.problem import Block, Problem
from calib.problem.unknowns import Unknown
from calib.residuals.beams import Association
from calib.residuals.scan import ScanStop
from calib.solve.estimate import rest_of
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
STEADY = 1e-9  # the same, of trackers and targets alone, whose steps cost little
COST_ROUNDING = 1e-14  # of a cost: what is less is rounding
UPHILL = 1e-9  # of a cost: a step that raises it by more is shortened
SHORTEST_STEP, LONGEST_STEP = 1e-3, 2.0  # of a step: how much of it may be taken


class Pass:
    """One pass at a state: what the way on depends on, and all the rest where it is asked for.

    Args:
        values: the state.
        compute: linearises everything there: that, and the graph that it is in.
        journal: of the fit; None where the pass is not worth keeping.
        asked: what the linearisation depends on beside the state and what was asked before.
        of_noise: as of `rest_of`.
    """

    def __init__(
        self,
        values: Mapping[str, np.ndarray],
        compute: Callable[[], tuple[Linearisation, Graph]],
        journal: Journal | None,
        asked: Mapping[str, object],
        of_noise: Sequence[Unknown] = (),
    ) -> None:
        self.of_noise = of_noise
        self.values, self._compute, self._journal = values, compute, journal
        self._whole: tuple[Linearisation, Graph] | None = None
        self._found = self._answer(asked, self._summary)
        self._weighed: Sequence[Weighing] | None = None

    def _answer(self, asked: Mapping[str, object], compute: Callable[[], Answer]) -> Answer:
        if self._journal is None:
            return compute()
        return self._journal.answer({**asked, **self.values}, compute)

    @property
    def whole(self) -> tuple[Linearisation, Graph]:
        """The linearisation, and the graph; computed now where the journal knew the summary."""
        if self._whole is None:
            self._whole = self._compute()
            del self._compute  # and with it how beams were weighed before
        return self._whole

    def _summary(self) -> Answer:
        linear, graph = self.whole
        before = np.nan if linear.cost_before is None else linear.cost_before
        return {
            "of_rest": np.float64(rest_of(linear, graph, self.values, self.of_noise)),
            "of_beams": np.float64(linear.beams_cost),
            "before": np.float64(before),
            "T": np.array([each.T for each in linear.weighed]),
            "scale": np.array([each.scale for each in linear.weighed]),
        }

    @property
    def beams_cost(self) -> float:
        """Half the robust chi-square of the beams, as they are weighed here."""
        return float(self._found["of_beams"])

    @property
    def cost(self) -> float:
        """Half the robust chi-square of all that a fit is to lower: see `rest_of`."""
        return float(self._found["of_rest"]) + self.beams_cost

    @property
    def cost_before(self) -> float:
        """The same with beams weighed as they were elsewhere, where that was asked for."""
        before = float(self._found["before"])
        return self.cost if np.isnan(before) else float(self._found["of_rest"]) + before

    @property
    def scale(self) -> np.ndarray:
        """(K,) how many sigmas wide the bulk of each scan's residuals is."""
        return self._found["scale"]

    @property
    def weighed(self) -> Sequence[Weighing]:
        """How the beams of each scan are weighed."""
        if self._whole is not None:
            return self._whole[0].weighed
        if self._weighed is None:
            state, pairs = State(self.values), zip(self._found["T"], self.scale, strict=True)
            self._weighed = [Weighing(state, T, float(scale), None) for T, scale in pairs]
        return self._weighed

    def step(self, outer: Sequence[str]) -> tuple[dict[str, np.ndarray], float]:
        """One step of the graph, as of `Descent.step`.

        Args:
            outer: the unknowns that are in the graph.
        """

        def compute() -> Answer:
            linear, graph = self.whole
            _, moved, fall = graph.step(self.values)
            kept = np.concatenate([np.zeros(0), *(moved[n] for n in outer)])
            fall += (linear.chi2 - linear.kept[-1, -1]) / 2
            return {"": np.float64(fall), **moved, **linear.step(kept)}

        found = dict(self._answer({}, compute))
        return {name: x for name, x in found.items() if name}, float(found[""])


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
        self.journal = Journal()
        self.here: Pass | None = None  # where everything was linearised last
        self.scales: Sequence[Weighing] = ()  # of every scan, where they are kept
        self.lay_out()

    @property
    def linear(self) -> Linearisation:
        """All that was linearised last."""
        return self.here.whole[0]

    @property
    def graph(self) -> Graph:
        """The graph that it is in."""
        return self.here.whole[1]

    def cost(self) -> float:
        """Half the robust chi-square where all was linearised last: see `rest_of`."""
        return self.here.cost

    @property
    def of_noise(self) -> list[Unknown]:
        """The unknowns of effects on the noise that have priors of their own."""
        return [u for u in self.problem.of_noise if u.name not in self.held]

    def descend(
        self,
        least: float,
        size: float = np.inf,
        beams: bool = True,
        passes: int | None = None,
    ) -> bool:
        """Gauss-Newton passes while beams meet what they met; whether they came to their end.

        Of each step so much is taken as lowers the cost, beams weighed as where it began.

        Args:
            least: by how much the step of the last pass may lower half the chi-square.
            size: how large it may be, m and rad.
            beams: False for trackers and targets alone.
            passes: how many at most; `MAX_PASSES` where None, and never more.
        """
        before, tangent, cost, fall, part = None, None, np.inf, 0.0, 1.0
        swings = False
        weighed: Sequence[Weighing] = ()
        for count in range(min(passes or MAX_PASSES, MAX_PASSES)):
            if before is None:
                self.linearise_here(beams)
            else:
                slowed = self.here.weighed if count >= SLOWED or swings else ()
                self.linearise(beams=beams, weighed=weighed, slowed=slowed)
            self.passes += 1
            if before is not None:
                fell = cost - self.here.cost_before
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
            before, cost, weighed = self.values, self.cost(), self.here.weighed
            tangent, fall = self.step()
            swings = abs(cost - self.here.cost_before) > fall
            length = self.size(tangent)
            self.values = self.moved(before, tangent, part)
            if length < size and fall < max(least, COST_ROUNDING * cost):
                return True
        return False

    def keep_scales(self) -> None:
        """Weigh beams from here on by the robust scales that they have now."""
        self.scales = [replace(each, kept=True) for each in self.here.weighed]

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

    def lay_out(self) -> None:
        """Take the problem as it is now."""
        self.layout, self.plain = Layout.of(self.problem, kept=self.held), None
        outer = self.layout.outer()
        self._space = Graph(list(outer.values()), (), frozenset(outer))  # in which steps are taken

    def linearise_here(self, beams: bool = True) -> None:
        """Linearise everything at the present state, unless that was done last; without `beams`,
        trackers and targets alone."""
        if self.plain is not beams or self.here.values is not self.values:
            self.linearise(beams=beams)

    def linearise(
        self,
        associate: bool = False,
        beams: bool = True,
        weighed: Sequence[Weighing] = (),
        slowed: Sequence[Weighing] = (),
    ) -> None:
        """Linearise everything at the present state, and graph what is left of it."""
        self.plain = None if associate or slowed else beams
        slowed = self.scales if beams and self.scales else slowed
        found = [None] * len(self.problem.scans) if associate else self.associations
        how = {"associations": found, "weighed": weighed, "slowed": slowed}
        asked = {"associate": associate}
        asked |= {"slowed": [(each.scale, each.kept) for each in slowed]}
        asked |= {"weighed": [each.scale for each in weighed]}
        worth = beams and bool(self.problem.scans)  # trackers and targets alone cost little
        compute = self.linearising(self.values, beams, **how)
        journal = self.journal if worth else None
        self.here = Pass(self.values, compute, journal, asked=asked, of_noise=self.of_noise)

    def linearising(
        self,
        values: Mapping[str, np.ndarray],
        beams: bool,
        associations: Sequence[Association | None] = (),
        weighed: Sequence[Weighing] = (),
        slowed: Sequence[Weighing] = (),
    ) -> Callable[[], tuple[Linearisation, Graph]]:
        """What computes the linearisation at a state, and the graph that it is in: of the problem
        as it is now, whatever becomes of it until then."""
        what, problem, layout = f"pass {self.passes + 1}", self.problem, self.layout

        def compute() -> tuple[Linearisation, Graph]:
            linear = linearise(
                problem,
                values,
                associations,
                layout,
                beams=beams,
                weighed=weighed,
                slowed=slowed,
                progress=lambda done, total: self.progress(what, done, total),
            )
            blocks = [*layout.others, *self.prior, *KeptRows.of(linear)]
            return linear, Graph(list(layout.outer().values()), blocks, self.held)

        return compute

    def looked(
        self, seen: Mapping[str, np.ndarray], parts: Sequence[np.ndarray | None]
    ) -> list[Association]:
        """What the beams of each scan meet at a state: these parts, or where None is given, as they
        look; what they then saw, the journal keeps."""
        found: list[Association] = []

        def look() -> Answer:
            work = partial(ScanStop.settled, values=seen)
            for i, association in enumerate(over_stops(work, self.problem.scans, parts)):
                self.progress("looking for depth edges", i, len(parts))
                found.append(association)
            return {str(i): association.part for i, association in enumerate(found)}

        known = self.journal.answer(seen, look)
        if not found:
            parts = list(known.values())
            look()
        return found

    def step(self) -> tuple[dict[str, np.ndarray], float]:
        """One step of the graph: the tangent step of every unknown, and by how much half the
        chi-square was to fall."""
        return self.here.step(list(self.layout.outer()))

    def moved(
        self, before: Mapping[str, np.ndarray], tangent: Mapping[str, np.ndarray], part: float = 1.0
    ) -> dict[str, np.ndarray]:
        """The state after a part of a step."""
        step = {name: part * each for name, each in tangent.items()}
        inner = {n: self.layout.unknowns[n].moved(before[n], step[n]) for n in self.layout.inner()}
        return {**before, **self._space.moved(before, step), **inner}

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
