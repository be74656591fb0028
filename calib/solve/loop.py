"""The state of a fit while it runs: linearise every stop, solve the graph, step downhill, repeat.

Three things end a fit that does not end well: its last step would still lower the cost, what its
beams meet changes as often as it is looked at, or bodies, beams or rows of trackers and targets are
hopelessly far off. None of them is called converged.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from calib.linear.layout import StopKey, key_of
from calib.outputs.journal import Answer
from calib.problem.prior import JointPrior
from calib.problem.problem import Block, Problem
from calib.problem.spread import by_chance, widening, with_spread
from calib.problem.surfaces import well_seen, with_surfaces
from calib.problem.unknowns import Unknown
from calib.solve.added import anew, begun, rejected
from calib.solve.components import squares, wider
from calib.solve.components.told import sds, told
from calib.solve.descent import AT_OPTIMUM, LAST, SLOWED, STEADY, Descent, Progress
from calib.solve.estimate import DOFS, SEEN, Estimate, Start, started, values_of
from calib.solve.graph import Graph
from calib.solve.reweight import SETTLED_WEIGHT, reweighted
from calib.solve.torn import doubted, strayed

CONVERGED = 1e-6  # m and rad: a tenth of the smallest sigmas, and the next step is smaller still
# By how much a step still lowers half the chi-square where the robust scales alone keep a fit from
# its end: by the one, or by the other share of it. It was 0.002 to 0.010 in 4 of 50 recordings with
# a structured error and 400 beams a stop, so ten times that; and up to 2e-4 of it where 12 stops
# are up to 6 mm off, each by itself, so five times that. Scales are then kept, as by MM-estimates
# (Yohai 1987, Annals of Statistics 15).
SWAYS, SWAYS_OF_COST = 0.1, 1e-3
DESCENTS = 3  # how often a descent is tried before a fit is given up: a choice
# By how much new weights may still lower half the chi-square, and of it: a hundredth of what an
# optimum allows, as each round may go but a tenth of the way; where nothing fits, it never ends.
STILL_FALL, AS_GOOD = AT_OPTIMUM / 100, 1e-8
BEFORE_SCANS = 2  # times: bodies are then a start for the scans, and no result
# How often weights are taken anew, and the relative change of one that is none: with scans, and of
# trackers and targets alone, whose passes cost little and where few rows check each other. A change
# can be nine tenths of the one before there (four rods, one off: 0.7 sigma from the optimum after
# ten times, 0.03 once changes are below a thousandth).
REWEIGHTED, REWEIGHTED_ALONE = (10, SETTLED_WEIGHT), (200, 1e-3)
# After so many rounds of weights it is asked whether these lead anywhere.
HOPEFUL = 8
# How many sigmas wide the residuals of most stops may be in the end: in good recordings 1 to 4,
# with scans at wrong stops 85. And so wide may rows of trackers and targets be, as weighed, where a
# fit has not settled: of the 90 kinds of damage it is 10 at most (a joint scaled, the mesh scaled),
# and 80 with the markers of all targets exchanged.
HOPELESS = 30.0
# Relative change of a spread that is none; and one for which the passes to the optimum are not
# worth doing again, as 50 members tell it no better.
SETTLED_SPREAD, NEAR_SPREAD = 0.01, 0.1
SPREAD = 8  # times: where rows do not scatter, each halves what they were thought to


class Loop(Descent):
    """A fit of a problem.

    Args:
        problem: what is estimated.
        prior: a joint prior, or None.
        progress: called with what is being done, how many stops are done, and of how many.
        start: an earlier fit to start from.
    """

    def __init__(
        self,
        problem: Problem,
        prior: Block | None,
        progress: Progress,
        start: Start | None = None,
    ) -> None:
        start = start or Start()
        problem = problem.setting_aside(start.aside)
        self._earlier: Mapping[str, tuple[float, float]] = {}  # spreads
        if isinstance(prior, JointPrior):
            problem = problem.resting_on(prior.rests_on, prior.variables)
            self._earlier = prior.spreads
        problem = with_spread(problem, start.spread(problem))
        super().__init__(problem, prior, progress, values_of(problem, start.state))
        self.given, self.start = self.problem, start
        self.seen: dict[str, np.ndarray] = {}
        self.lost = False  # whether the fit is given up

    def doubt_bodies(self) -> None:
        """Begin with next to no weight on the bodies of stops where one is grossly off."""
        self.give(doubted(self.given, self.values))

    def give(self, given: Problem) -> None:
        """Take a problem with other weights, or fewer scans, in place of that which was given."""
        if given is not self.given:
            self.given = self.problem = given
            self.lay_out()

    def solve_without_scans(self, start: Mapping[str, np.ndarray] | None = None) -> None:
        """Trackers and targets alone: a good start for the beams, or all there is.

        Where plain steps end short of the optimum, GTSAM's damped ones go on from the start, unless
        bodies are far off, and another start is what is wanted.

        Args:
            start: another state to start from; its optimum is kept if it costs less.
        """
        ended = (np.inf, self.values) if start is None else (self.cost(), self.values)
        self.values = first = self.values if start is None else dict(start)
        settled = self.descend_bodies(AT_OPTIMUM if self.problem.scans else STEADY)
        if not settled and not self.problem.scans and not self.bodies_astray():
            ended = min(ended, (self.cost(), self.values), key=lambda each: each[0])
            self.values = self._damped(first)
            self.descend(STEADY, beams=False)
        if ended[0] < self.cost():
            self.values = ended[1]
            self.linearise(beams=False)
        if self.problem.scans:
            self.passes = 1  # what is counted are passes over the scans

    def _damped(self, first: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """The optimum of trackers and targets by Levenberg-Marquardt."""
        blocks = [*self.problem.blocks, *self.prior]
        graph = Graph(list(self.problem.variables.values()), blocks, self.held)
        return graph.solve(first)[0]

    def reweigh(self, beams: bool) -> bool:
        """Go on with robust weights until these settle, where any group of rows asks for one, or
        rows stay hopelessly wide; whether any did.

        Args:
            beams: False for trackers and targets alone.
        """
        times, settled = REWEIGHTED if self.problem.scans else REWEIGHTED_ALONE
        times = BEFORE_SCANS if self.problem.scans and not beams else times
        changed, last = False, np.inf
        for count in range(times):
            before = self.given, self.problem
            if self.lost or not self.take_weights(settled):
                break
            self.linearise(beams=beams)
            if count % HOPEFUL == HOPEFUL - 1:
                if self.rows_hopeless() and self.cost() > last / 2:
                    break
                last = self.cost()
            tangent, fall = self.step()
            if fall < max(STILL_FALL, AS_GOOD * self.cost()):
                self.given, self.problem = before
                self.lay_out()
                break
            changed = True
            if beams:  # whose own weights change with every step as well
                self.values = self.moved(self.values, tangent)
                self.passes += 1
            else:
                self.descend_roughly(beams=False)
        if changed and not beams:
            self.solve_without_scans()
        return changed

    def take_weights(self, settled: float = SETTLED_WEIGHT) -> bool:
        """Give every group of rows the weight that its residuals ask for; whether any changed."""
        given = reweighted(self.given, self.values, self.held, settled)
        if given is self.given:
            return False
        self.given, variables = given, self.problem.variables | given.variables
        self.problem = replace(self.problem, blocks=given.blocks, variables=variables)
        self.lay_out()
        return True

    def take_spread(self, tolerance: float) -> None:
        """Estimate how widely values by chance scatter, and go on with that, until it settles, and
        so do the robust weights, which are relative to it.

        Args:
            tolerance: as of `settle`.
        """
        for _ in range(SPREAD):
            if not self._near_spread(settled=True):
                return
            weighed = self.reweigh(beams=bool(self.problem.scans))
            if self.problem.scans:
                self.settle_on(tolerance)
            if not weighed:
                return

    def begin_spread(self) -> None:
        """The same once it is known what beams meet, and before the passes to the optimum: most of
        these are then with spreads that last."""
        if not self.lost and self._by_chance():
            self.fix_association()
            self._near_spread(settled=False)

    def _near_spread(self, settled: bool) -> bool:
        """Estimate spreads, with a step before each, until they settle; whether they changed.

        Args:
            settled: whether this begins where no step leads further.
        """
        first, least = self.given, SETTLED_SPREAD
        if settled and self.problem.scans:
            least = NEAR_SPREAD
        for _ in range(0 if self.lost or not self._by_chance() else SPREAD):
            self.linearise_here()
            if self.problem.scans and not (settled and self.given is first):
                self.passes += 1
                self.values = self.moved(self.values, self.step()[0])
            answer = self.journal.answer(self.values, self._spread)
            found = {key: float(sd) for key, sd in answer.items()}
            given = with_spread(self.given, found, least)
            if given is self.given:
                break
            self.given, self.problem = given, with_spread(self.problem, found, least)
            self.lay_out()
            least = SETTLED_SPREAD
            if not self.problem.scans:
                self.descend(STEADY, beams=False)
        return self.given is not first

    def _by_chance(self) -> list[str]:
        """Names of the unknowns, and keys of what widens rows, whose spread is estimated."""
        return [*(u.name for u in self._drawn()), *widening(self.problem)]

    def _drawn(self) -> list[Unknown]:
        """The unknowns by chance that no prior holds to an earlier estimate."""
        return [u for u in by_chance(self.problem) if u.name not in self.held]

    def _spread(self) -> Answer:
        """Key of a spread -> what it is, as all rows have it where they were linearised last."""
        some, out = self._drawn(), {}
        if some:
            names = [u.name for u in some]
            found = told(some, self.values, self.graph.covariance(self.values, names))
            now = sds(some)
            earlier = [self._earlier.get(key, (0.0, 0.0)) for key in now]
            sd = found.spread(np.array(list(now.values())), earlier)
            out |= dict(zip(now, sd.tolist(), strict=True))
        if widening(self.problem):
            sums = squares(self.as_it_stands(True, whole=True))
            out |= wider(self.problem, sums, self._earlier)
        return {key: np.float64(sd) for key, sd in out.items()}

    @property
    def met(self) -> dict[StopKey, np.ndarray]:
        """What beams meet now."""
        pairs = zip(self.problem.scans, self.associations, strict=True)
        return {key_of(scan): association.part for scan, association in pairs}

    def settle(
        self,
        tolerance: float,
        seen: Mapping[str, np.ndarray] | None = None,
        met: Mapping[StopKey, np.ndarray] | None = None,
    ) -> None:
        """Passes to the optimum: scans keep what they met unless they move far.

        Args:
            tolerance: largest step of the last pass, m and rad.
            seen, met: as of `fix_association`.
        """
        for _ in range(DESCENTS):
            self.fix_association(seen, met)
            if self.lost:
                return
            near = self.descend(LAST, tolerance, passes=SLOWED) or self.strayed()
            if not (near or self.descend(LAST, tolerance)) or not self.strayed():
                return
            seen, met = None, None
        self.lost = True

    def settle_on(self, tolerance: float) -> None:
        """The same from here: scans keep what they met, unless one has moved far already."""
        self.settle(tolerance, *(() if self.strayed() else (self.seen, self.met)))

    def strayed(self) -> bool:
        """Whether a scan has moved far since it took what its beams meet."""
        return strayed(self.problem.scans, self.associations, self.seen, self.values)

    def rows_hopeless(self) -> bool:
        """Whether rows of trackers and targets, as weighed, were hopelessly wide a step ago."""
        rows = sum(block.rows for block in self.problem.blocks)
        return 0 < rows * HOPELESS**2 < 2 * (self.cost() - self.here.beams_cost)

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
        known = {**self.start.state, **self._cells()}
        self.problem, self.seen = self.given, dict(seen or self.values)
        met = self.start.met if met is None and seen is not None else met or {}
        parts = [met.get(key_of(scan)) for scan in self.problem.scans]
        self.associations = well_seen(self.given, self.looked(self.seen, parts))
        self.problem = with_surfaces(self.given, self.associations)
        for name in self.problem.cells:
            unknown = self.problem.variables[name]
            self.values[name] = started(unknown, known, unknown.mean)
        if not self.passes:  # later, the fit itself knows better
            self.values |= begun(self.problem, self.values, self.associations, self.start.state)
        self.lay_out()

    def kept(self) -> tuple[Any, ...]:
        """Where the fit is now, for `go_back`."""
        return self.given, self.problem, dict(self.values), self.associations, self.seen

    def go_back(self, kept: tuple[Any, ...]) -> None:
        """Be where the fit was, before it was lost if it is."""
        self.given, self.problem, self.values, self.associations, self.seen = kept
        self.lost = False
        self.lay_out()

    def begin_rejected(self) -> bool:
        """Take parameters half or more of whose beams have no weight to where these would have
        them, if the cost is lower there; whether any moved. What an earlier run tells of stays, if
        it cannot have moved."""
        freed = (prior.freed for prior in self.prior if isinstance(prior, JointPrior))
        stay = self.held.difference(*freed)

        def compute() -> Answer:
            here = self.problem, self.values, self.associations
            return anew(*here, {n: x for n, x in rejected(*here).items() if n not in stay})

        moved = self.journal.answer({**self.values, "": "rejected"}, compute)
        if moved:
            self.values = {**self.values, **moved}
        return bool(moved)

    def _cells(self) -> dict[str, np.ndarray]:
        """The present state of the surfaces' unknowns, of those that there are."""
        found = [self.problem.variables[name] for name in self.problem.cells]
        dofs = {f"{v.name}{DOFS}": np.array(v.dofs, np.str_) for v in found}
        return dofs | {v.name: self.values[v.name] for v in found}

    def estimate(self, tolerance: float | None = None) -> Estimate:
        """The result, with the covariance of the calibration.

        Args:
            tolerance: of the passes after it is estimated how widely things scatter by chance, as
                of `settle`; None where that is not to be estimated.
        """
        if tolerance is not None:
            self.take_spread(tolerance)
        self.linearise_here()
        _, fall = self.step()
        sways = AT_OPTIMUM <= fall < max(SWAYS, SWAYS_OF_COST * self.cost())
        if sways and self.problem.scans and not self.lost:
            self.keep_scales()
            any(self.descend(LAST) for _ in range(DESCENTS))  # redescending weights have plateaus
            self.linearise()
            _, fall = self.step()
        return self.as_it_stands(fall < AT_OPTIMUM and not self.lost, whole=True)

    def as_it_stands(self, converged: bool, whole: bool = False) -> Estimate:
        """The result; with its linearisation and covariance where they are wanted."""
        names = self.problem.calibration
        return Estimate(
            problem=self.problem,
            values=self.values,
            variables=tuple(self.problem.variables[name] for name in names),
            covariance=self.graph.covariance(self.values, names) if whole else np.zeros((0, 0)),
            associations=self.associations,
            iterations=self.passes,
            converged=converged,
            graph=self.graph if whole else None,
            linear=self.linear if whole else None,
            seen=self.seen,
        )
