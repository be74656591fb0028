"""The steps of a plan: candidates, what each would tell, which to take, what they are worth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np

from calib.planning.criteria import Criterion, PredictionVariance, chosen
from calib.planning.found import Found, would_be_found
from calib.planning.information import Information, inverse
from calib.planning.purpose import WORKSPACE, Purpose
from calib.planning.room.clear import Clear
from calib.planning.room.poses import reachable
from calib.planning.room.ways import Leg, way_over
from calib.planning.room.workspace import moved_anywhere
from calib.planning.scene import PlanningScene
from calib.planning.stops import Poses
from calib.planning.worth import Known, Pair, alike, criterion
from calib.problem.unknowns import Key, Role
from calib.results.solution import Solution
from calib.solve.fit import Progress
from chains import se3
from chains.errors import InputError

# Times that all candidates are measured for what no number of stops gets beyond.
ENDLESS_TIMES = 1e4
# Poses that stand for all that an arm can reach: with eight draws of so many the predicted error of
# a UR10 is within 2.2 % of the mean.
ANYWHERE = 400


@dataclass(frozen=True)
class Step:
    """How far from their tolerances sigmas are with so many stops.

    Args:
        stops: measured and planned; None for any number.
        worst: the largest sigma, in its tolerance.
        parameter: whose that is.
    """

    stops: int | None
    worst: float
    parameter: str

    def document(self) -> dict[str, Any]:
        """As JSON has it."""
        return {"stops": self.stops, "worst": self.worst, "parameter": self.parameter}


@dataclass(frozen=True)
class Planner:
    """Plans stops for a run, or for a rig of which nothing was measured yet.

    Args:
        folder: of the run, or of the rig.
        scene: the fit.
        aim: what stops are for.
        places: location -> T_world_root (4, 4) where the base may stand.
        solution: what the run found; None without one.
        diagnosed: effect -> size from which the run's diagnosis would have found it.
        progress: called with what is being done, and how far it is.
        cameras_m: (C, 3) of the tracker, world frame; None where nothing says where they are.
    """

    folder: Path
    scene: PlanningScene
    aim: Purpose
    places: Mapping[str, np.ndarray]
    solution: Solution | None
    diagnosed: Mapping[str, float]
    progress: Progress
    cameras_m: np.ndarray | None = None

    def candidates(self, count: int, seed: int) -> Poses:
        """So many random poses; see `reachable`."""
        rng, T = np.random.default_rng(seed), self.scene.T_world_reference
        return reachable(self.clear, self.places, T, count, rng, self.cameras_m)

    @cached_property
    def clear(self) -> Clear:
        """What keeps the arm from a pose."""
        return Clear.of(self.scene.source, self.places, self.scene.T_world_reference)

    def look(self, poses: Poses, stops: int) -> np.ndarray:
        """What each of some poses tells (n, S, S), so many of which are wanted.

        Raises:
            InputError: there are fewer.
        """
        if len(poses.joints) < stops:
            raise InputError(
                f"{len(poses.joints)} of the poses that were drawn are clear of the arm itself and "
                f"of the mesh, which is less than {stops} stops; ask for fewer, or draw more"
            )
        self.progress("looking at candidates", 0, 1)
        return self.scene.each(poses, self.lasting.keys)

    def choose(self, poses: Poses, each: np.ndarray, stops: int, exchange: bool = True) -> Poses:
        """The best of some poses, from what each tells; without `exchange` the best first."""
        by, tell = self.criterion(each), partial(self.progress, "choosing")
        return poses.some(chosen(by, each, stops, tell, exchange))

    def criterion(self, each: np.ndarray) -> Criterion:
        """By what stops are chosen, from what each of those tells that there are. Rivals that
        do next to the same at all of them play no part, unless there are no others."""
        if self.aim.text == WORKSPACE:
            return PredictionVariance(
                self.lasting, moved_anywhere(self.scene, self.lasting, self._anywhere)
            )
        apart = set(permutations(self.aim.rivals, 2)) - set(self.alike(each))
        return criterion(self.scene, self.aim, self.lasting, apart or None)

    def alike(self, each: np.ndarray) -> dict[Pair, float]:
        """Rivals that do next to the same at all stops; see `calib.planning.worth.alike`."""
        most = replace(self.lasting, data=self.lasting.data + each.sum(axis=0))
        return alike(self.scene, self.aim, most)

    @cached_property
    def _anywhere(self) -> Poses:
        """Poses all over what the arm can reach."""
        return self.candidates(ANYWHERE, seed=ANYWHERE)

    def endless(self, each: np.ndarray) -> Known:
        """What all candidates tell, measured again and again: no stops of the arm tell more. As the
        mesh's errors are taken to differ from stop to stop, even these may not tell as much."""
        base = self.lasting
        return self.known(replace(base, data=base.data + ENDLESS_TIMES * each.sum(axis=0)), 0)

    def enough(self, poses: Poses, each: np.ndarray, most: int) -> tuple[Poses, list[Step]]:
        """The fewest stops, one best after another, with which every tolerance is kept, or `most`
        where that many do not; and what was known with how many of them, the last of it with any
        number."""
        best = self.choose(poses, each, most, exchange=False)
        curve = {0: self._step(self.now)}

        def kept(count: int) -> bool:
            if count not in curve:
                self.progress("how many are enough", len(curve), most)
                curve[count] = self._step(self.after(best.some(range(count))))
            return curve[count].worst <= 1.0

        low, high = (0, most) if kept(most) else (most - 1, most)
        while high - low > 1 and not kept(0):
            middle = (low + high) // 2
            low, high = (low, middle) if kept(middle) else (middle, high)
        needed = 0 if kept(0) else high
        last = replace(self._step(self.endless(each)), stops=None)
        return best.some(range(needed)), [*(curve[n] for n in sorted(curve)), last]

    def _step(self, known: Known) -> Step:
        at = [self.keys.index(key) for key in self.aim.components]
        over = known.sigma[at] / np.array(self.aim.tolerance)
        worst = int(np.argmax(over))
        return Step(known.stops, float(over[worst]), self.names[at[worst]])

    def in_order(self, poses: Poses, among: Poses) -> tuple[Poses, list[Leg]]:
        """Some poses in the order in which to drive to them, and how to get from each to the next;
        see `way_over`."""
        T_reference_world = se3.inverse(self.scene.T_world_reference)
        order, legs = way_over(poses, among, self.clear, T_reference_world, list(self.places))
        return poses.some(order), legs

    @cached_property
    def lasting(self) -> Information:
        """What is known now of all that planned stops speak of; targets hang where they hang."""
        roles, now = self.scene.problem.variables, self.scene.now
        alone = [u.name for u in roles.values() if u.role is Role.TARGET]
        alone += [u.name for u in roles.values() if u.owner.effect in self._by_chance]
        gone = set(alone)
        keep = [i for i, (name, _) in enumerate(now.keys) if name not in gone]
        return now.onto(np.array(keep))

    @property
    def _by_chance(self) -> list[str]:
        """Effects that the plan has scatter by chance: what each is at a stop, no other knows."""
        return [effect.name for effect in self.aim.added if effect.by_chance]

    @cached_property
    def keys(self) -> list[Key]:
        """(P,) of the parameters of the calibration."""
        now = self.scene.now
        return [now.keys[i] for i in now.at(self.scene.calibration)]

    @property
    def names(self) -> list[str]:
        """(P,) of those."""
        return [key.name for key in self.keys]

    @cached_property
    def units(self) -> list[str]:
        """(P,) of those."""
        known: Mapping = self.scene.problem.variables
        return [unit for name in self.scene.calibration for unit in known[name].units]

    @cached_property
    def now(self) -> Known:
        """What is known without any planned stop."""
        return self.known(self.scene.now, 0)

    def after(self, poses: Poses) -> Known:
        """What will be known with planned stops, by one linearisation of all."""
        return self.known(self.scene.after(poses), len(poses.joints))

    def found(self, known: Known, poses: Poses | None) -> Found:
        """What would be found with planned stops, or without any, of which this is known."""
        sigma = dict(zip(self.keys, known.sigma.tolist(), strict=True))
        return would_be_found(self.scene, poses, sigma, self.progress)

    def found_now_and_after(self, after: Known, poses: Poses) -> tuple[Found, Found]:
        """What would be found without planned stops and with them. As rows of a stop err
        together, a diagnosis finds effects from larger sizes on than independent rows have it; they
        are taken to go on doing so."""
        now, then = self.found(self.now, None), self.found(after, poses)
        times = {
            name: self.diagnosed[name] / size
            for name, size in now.effects.items()
            if np.isfinite(size) and name in self.diagnosed
        }
        return now.wider(times), then.wider(times)

    def known(self, information: Information, more: int) -> Known:
        """What all rows say, in the words of a run; of so many stops more."""
        stops = len(self.scene.source.recording.stops) + more
        known = Known.of(self.scene, self.aim, information, stops, self._wider)
        if self.aim.text != WORKSPACE:
            return known
        model = information.without(self.scene.unbounded)
        at, wider = model.at(self.scene.calibration), np.ones(len(model.keys))
        wider[at] = self._wider
        W = moved_anywhere(self.scene, model, self._anywhere) * np.outer(wider, wider)
        square_m2 = np.sum(W * inverse(model.data + model.paper, np.arange(len(wider))))
        return replace(known, predicted_m=float(np.sqrt(square_m2)))

    @cached_property
    def _wider(self) -> np.ndarray:
        """(P,) how many times wider than the graph has them the run reports its sigmas, as rows of
        a stop err together; they are taken to go on doing so."""
        if self.solution is None:
            return np.ones(len(self.keys))
        solution = self.solution
        sigma = dict(zip(solution.keys, np.sqrt(np.diag(solution.covariance)), strict=True))
        model = self.scene.now.without(self.scene.unbounded)
        graph = model.covariance(model.at(self.scene.calibration))
        return np.array([sigma[key] for key in self.keys]) / np.sqrt(np.diag(graph))
