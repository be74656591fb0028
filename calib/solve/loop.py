"""The state of a fit while it runs: linearise every stop, solve the graph, step downhill, repeat.

Three things end a fit that does not end well: its last step would still lower the cost, what its
beams meet changes as often as it is looked at, or half of the stops are hopelessly far off. None of
them is called converged.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from calib.linear.layout import Layout, StopKey, key_of
from calib.linear.linearise import beams_cost, linearise
from calib.linear.parallel import in_order
from calib.linear.rows import Weighing
from calib.linear.system import Linearisation
from calib.problem.problem import Block, Problem
from calib.problem.surfaces import with_surfaces
from calib.residuals.beams import Association
from calib.residuals.tracker import TrackedBody
from calib.solve.added import begun
from calib.solve.estimate import DOFS, SEEN, Estimate, Start, cost_of, started, values_of
from calib.solve.graph import Graph, KeptRows
from calib.solve.reweight import reweighted
from chains import se3

Progress = Callable[[str, int, int], None]
MAX_PASSES = 40
SETTLED = 1e-4  # m and rad: after that, which triangle a beam meets is kept
CONVERGED = 1e-6  # m and rad: a tenth of the smallest sigmas, and the next step is smaller still
STRAYED = 3e-3  # m and rad: a scan that has moved further looks anew what its beams meet
LOOKS = 3  # how often, before a fit is given up
# By how much a further step would lower half the chi-square: 1e-3 is a step of 0.04 sigma.
AT_OPTIMUM = 1e-3
# The last step of a fit is to be so much smaller: weights follow the state, and where residuals are
# far from normal each step lowers the cost by up to two thirds of what the one before it did.
LAST = AT_OPTIMUM / 4
STEADY = 1e-9  # the same, of trackers and targets alone, whose steps cost little
DIGITS = 1e-14  # of a cost: what is less is rounding
UPHILL = 1e-9  # of a cost: a step that raises it by more is shortened
REWEIGHTED = 10  # how often weights are taken anew; their distance halves each time or better
SHORTEST, LONGEST = 1e-3, 2.0  # of a step: how much of it may be taken
# Bodies half of whose stops are so far (m, rad) from where the chain puts them after a fit are not
# described by it: CAD and encoders are good to millimetres. Measured on the independent recordings:
# 0.002 at most; with two bodies exchanged, or the quaternions' order wrong, 0.2 or more.
ASTRAY = 0.05
# So often is looked what beams meet before it is asked whether that leads anywhere, and so often
# at most: good recordings, and
# one with the LiDAR 0.13 m from where CAD has it, settle in 2 to 6 passes ...
HOPEFUL, LOOKED = 8, 15
# ... with scales of 1 to 4 sigmas (median over the stops); with scans at wrong stops it is 85.
HOPELESS = 30.0


class Loop:
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
        self.given, self.problem = problem, problem
        self.progress, self.start = progress, start or Start()
        self.prior = [prior] if prior else []
        self.held = frozenset(name for block in self.prior for name in block.variables)
        self.values = values_of(problem, self.start.state)
        self.layout = self._layout()
        self.seen: dict[str, np.ndarray] = {}
        self.associations: list[Association] = []
        self.passes = 0
        self.lost = False  # whether the fit is given up
        self._plain = False  # whether all was last linearised as for a result
        self.linear: Linearisation | None = None
        self.graph: Graph | None = None

    def solve_without_scans(self, start: Mapping[str, np.ndarray] | None = None) -> None:
        """Trackers and targets alone: a good start for the beams, or all there is.

        Where plain steps end short of the optimum, GTSAM's damped ones go on from the start, unless
        bodies are far off, and another start is what is wanted.

        Args:
            start: another state to start from; its optimum is kept if it costs less.
        """
        ended = (np.inf, self.values) if start is None else (self.cost(), self.values)
        self.values = first = self.values if start is None else dict(start)
        settled = self._descend(STEADY, beams=False)
        if not settled and not self.bodies_astray():
            ended = min(ended, (self.cost(), self.values), key=lambda each: each[0])
            self.values = self._damped(first)
            self._descend(STEADY, beams=False)
        if ended[0] < self.cost():
            self.values = ended[1]
            self._linearise(beams=False)
        if self.problem.scans:
            self.passes = 1  # what is counted are passes over the scans

    def _damped(self, first: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """The optimum of trackers and targets by Levenberg-Marquardt."""
        blocks = [*self.problem.blocks, *self.prior]
        graph = Graph(list(self.problem.variables.values()), blocks, self.held)
        return graph.solve(first)[0]

    def reweigh(self, tolerance: float | None = None) -> None:
        """Go on with robust weights until these settle, where any group of rows asks for one.

        Args:
            tolerance: as of `settle`; of trackers and targets alone where None.
        """
        for _ in range(REWEIGHTED):
            if self.lost or not self.take_weights():
                break
            if tolerance is None:
                self.solve_without_scans()
            else:
                self.settle(tolerance, self.seen, self._met())

    def take_weights(self) -> bool:
        """Give every group of rows the weight that its residuals ask for; whether any changed."""
        given = reweighted(self.given, self.values, self.held)
        if given is self.given:
            return False
        self.given = given
        variables = self.problem.variables | given.variables
        self.problem = replace(self.problem, blocks=given.blocks, variables=variables)
        self.layout, self._plain = self._layout(), False
        return True

    def _met(self) -> dict[StopKey, np.ndarray]:
        """What beams meet now."""
        pairs = zip(self.problem.scans, self.associations, strict=True)
        return {key_of(scan): association.part for scan, association in pairs}

    def bodies_astray(self) -> bool:
        """Whether half of the stops have a body far from where the chain puts it."""
        off: dict[str, list[np.ndarray]] = {}
        for block in (b for b in self.problem.blocks if isinstance(b, TrackedBody)):
            T = block.stops.in_world(block.body, self.values).T
            away = np.linalg.norm(block.measured[:, :3, 3] - T[:, :3, 3], axis=1)
            if not block.is_point:
                turn = se3.so3_log(T[:, :3, :3].mT @ block.measured[:, :3, :3])
                away = np.maximum(away, np.linalg.norm(turn, axis=1))
            off.setdefault(block.body, []).append(away)
        return any(np.median(np.concatenate(away)) > ASTRAY for away in off.values())

    def look_around(self) -> bool:
        """Passes that look each time anew what beams meet, until they settle; False where the fit
        is hopeless."""
        for count in range(1, LOOKED + 1):
            self._linearise(associate=True)
            self.passes += 1
            scale = np.median([each.scale for each in self.linear.weighed])
            if count > HOPEFUL and scale > HOPELESS:
                return False
            tangent, _ = self._step()
            self.values = self._moved(self.values, tangent)
            if self._size(tangent) < SETTLED:
                break
        return True

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
        for _ in range(LOOKS):
            self.fix_association(seen, met)
            if self.lost:
                return
            if not self._descend(tolerance):
                return
            pairs = ((scan.pose(self.seen), scan.pose(self.values)) for scan in self.problem.scans)
            if all(np.abs(se3.log(se3.inverse(a) @ b)).max() < STRAYED for a, b in pairs):
                return
            seen, met = None, None
        self.lost = True

    def go_on(self, tolerance: float) -> None:
        """From an earlier state to the optimum; the cost does not end above that of the state."""
        self.settle(tolerance, self.seen_before(), self.start.met)
        if not self._raised():
            return
        self.values = values_of(self.problem, self.start.state)
        self._descend(tolerance, hasten=False)
        if self._raised():
            self.values = values_of(self.problem, self.start.state)

    def _raised(self) -> bool:
        """Whether the cost is above that of the start, all beams weighed as they are here."""
        self._linearise_here()
        first, cost = values_of(self.problem, self.start.state), self.cost()
        linear, graph = self._linearised(first, beams=False)
        beams = beams_cost(self.problem, first, self.associations, self.linear.weighed)
        return cost > (cost_of(linear, graph, first) + beams) * (1 + UPHILL)

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
            self.values[name] = started(unknown, known, unknown.mean)
        if not self.passes:  # later, the fit itself knows better
            self.values |= begun(self.problem, self.values, self.associations, self.start.state)
        self.layout = self._layout()

    def _cells(self) -> dict[str, np.ndarray]:
        """The present state of the surfaces' unknowns, of those that there are."""
        found = [self.problem.variables[name] for name in self.problem.cells]
        dofs = {f"{v.name}{DOFS}": np.array(v.dofs, np.str_) for v in found}
        return dofs | {v.name: self.values[v.name] for v in found}

    def estimate(self) -> Estimate:
        """The result, with the covariance of the calibration."""
        self._linearise_here()
        _, fall = self._step()
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

    def cost(self) -> float:
        """Half the robust chi-square where all was linearised last, priors included."""
        return self._cost(self.linear.beams_cost)

    def _cost(self, of_beams: float) -> float:
        """The same, with the beams' part given."""
        linear = self.linear
        return cost_of(linear, self.graph, linear.values) - linear.beams_chi2 / 2 + of_beams

    def _descend(self, tolerance: float, beams: bool = True, hasten: bool = True) -> bool:
        """Gauss-Newton passes while beams meet what they met; whether they came to their end.

        Of each step so much is taken as lowers the cost, beams weighed as where it began.

        Args:
            tolerance: of beams, the largest step of the last pass, m and rad; of trackers and
                targets alone, by how much it may lower half the chi-square.
            beams: False for trackers and targets alone.
            hasten: whether the curvature of the beams' cost may take the place of their weights.
        """
        newton, last, misled, wait, part = False, np.inf, 0, 0, 1.0
        before, tangent, cost, fall = None, None, np.inf, 0.0
        weighed: Sequence[Weighing] = ()
        for _ in range(MAX_PASSES):
            self._linearise(newton=newton, beams=beams, weighed=weighed)
            self.passes += 1
            if before is not None:
                fell = cost - self._cost_before()
                lowest = _lowest(part, fall, fell)
                if fell < -UPHILL * cost - STEADY:
                    part = min(lowest, part / 2)
                    self.values = self._moved(before, tangent, part) if part > SHORTEST else before
                    if part <= SHORTEST:
                        self._linearise(beams=beams)
                        return False
                    continue
                part = max(1.0, lowest)
            before, cost, weighed = self.values, self.cost(), self.linear.weighed
            tangent, fall = self._step()
            size = self._size(tangent)
            self.values = self._moved(before, tangent, part)
            if size < tolerance and fall < LAST if beams else fall < max(tolerance, DIGITS * cost):
                return True
            # Where a row's curvature misleads, steps grow; its weight never does. It is tried again
            # after twice as many passes each time, lest the steps go round in circles.
            if newton and size >= last:
                misled, wait = misled + 1, 2 ** (misled + 1)
            wait = max(wait - 1, 0)
            newton, last = hasten and beams and not wait and size < last, size
        return False

    def _cost_before(self) -> float:
        """The cost here, beams weighed as they were before the step."""
        told = self.linear.cost_before
        return self._cost(self.linear.beams_cost if told is None else told)

    def _layout(self) -> Layout:
        return Layout.of(self.problem, kept=self.held)

    def _linearise_here(self) -> None:
        """Linearise everything at the present state, unless that was done last."""
        if not self._plain or self.linear.values is not self.values:
            self._linearise()

    def _linearise(
        self,
        associate: bool = False,
        newton: bool = False,
        beams: bool = True,
        weighed: Sequence[Weighing] = (),
    ) -> None:
        """Linearise everything at the present state, and graph what is left of it."""
        self._plain = beams and not associate and not newton
        found = [None] * len(self.problem.scans) if associate else self.associations
        self.linear, self.graph = self._linearised(
            self.values, beams, associations=found, newton=newton, weighed=weighed
        )

    def _linearised(
        self,
        values: Mapping[str, np.ndarray],
        beams: bool,
        associations: Sequence[Association | None] = (),
        newton: bool = False,
        weighed: Sequence[Weighing] = (),
    ) -> tuple[Linearisation, Graph]:
        what = f"pass {self.passes + 1}"
        linear = linearise(
            self.problem,
            values,
            associations,
            newton,
            self.layout,
            beams=beams,
            weighed=weighed,
            progress=lambda done, total: self.progress(what, done, total),
        )
        blocks = [*self.layout.others, *self.prior, *KeptRows.of(linear)]
        return linear, Graph(list(self.layout.outer().values()), blocks, self.held)

    def _step(self) -> tuple[dict[str, np.ndarray], float]:
        """One step of the graph: the tangent step of every unknown, and by how much half the
        chi-square was to fall."""
        _, moved, fall = self.graph.step(self.values)
        kept = np.concatenate([np.zeros(0), *(moved[n] for n in self.layout.outer())])
        fall += (self.linear.chi2 - self.linear.kept[-1, -1]) / 2
        return moved | self.linear.step(kept), fall

    def _moved(
        self, before: Mapping[str, np.ndarray], tangent: Mapping[str, np.ndarray], part: float = 1.0
    ) -> dict[str, np.ndarray]:
        """The state after a part of a step."""
        step = {name: part * each for name, each in tangent.items()}
        inner = {n: self.layout.unknowns[n].moved(before[n], step[n]) for n in self.layout.inner()}
        return {**before, **self.graph.moved(before, step), **inner}

    def _size(self, tangent: Mapping[str, np.ndarray]) -> float:
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
    return float(np.clip(fall * part**2 / bend, part / 10, LONGEST)) if bend > 0 else LONGEST
