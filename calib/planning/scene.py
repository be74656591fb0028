"""A run's fit with planned stops beside its own: what each of them says, and what all say."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from calib.diagnosis.everywhere import Everywhere
from calib.diagnosis.linear import beside
from calib.diagnosis.stand import Stand
from calib.effects import Effect
from calib.forward import Term
from calib.linear.layout import key_of
from calib.linear.parallel import in_order
from calib.planning.brightness import Brightness
from calib.planning.information import Information, of_all, of_each
from calib.planning.room.places import roots_of
from calib.planning.stops import (
    PlannedScan,
    PlannedStore,
    Poses,
    at_their_places,
    drawn,
    extended,
    pattern,
    thinned,
)
from calib.problem import Problem, build
from calib.problem.model import Source
from calib.problem.prior import JointPrior
from calib.problem.surfaces import with_surfaces
from calib.problem.unknowns import Key, Role
from calib.residuals.beams import Association
from calib.solve.estimate import started
from calib.solve.reweight import weighted_as
from sensors.lidar import Beams
from sensors.recording import Scan

# How many beams of a candidate stop are looked at; they stand for all. Of the 8,192 of an OS0-128,
# with 300, 600, 1200 the gains of 40 stops have ranks that are correlated by 0.92, 0.96, 0.99 with
# those of all, and sigmas after five stops are at most 6, 3, 1 % off; 16, 17, 25 ms each, all 51.
BEAMS_A_STOP = 600
# Stops that scatter by chance, looked at together: each has columns of its own at all of them.
SCATTERING = 50
COMPARED = 6  # stops that were measured, by which it is found how many one of them is worth


@dataclass(frozen=True)
class PlanningScene:
    """A fit, and effects that it lacks but whose columns are wanted; planned stops are of the first
    of its recordings.

    Args:
        stand: the fit.
        added: those effects.
        prior: an earlier estimate that stands for paper; None where paper does.
    """

    stand: Stand
    added: Sequence[Effect] = ()
    prior: JointPrior | None = None

    @property
    def source(self) -> Source:
        """The recording that planned stops are added to."""
        return self.stand.sources[0]

    @property
    def values(self) -> dict[str, np.ndarray]:
        """Of the fit."""
        return self.stand.estimate.values

    @property
    def T_world_reference(self) -> np.ndarray:
        """(4, 4) as estimated; none where both are one frame."""
        return self.values.get(self.source.rig.reference_frame, np.eye(4))

    @cached_property
    def everywhere(self) -> Everywhere | None:
        """What its geometry moves that is seen, at any pose of the arm."""
        return Everywhere.of(self.stand)

    @cached_property
    def _wide(self) -> tuple[Problem, dict[str, np.ndarray]]:
        problem = self.stand.problem_of(self.stand.model.plus(tuple(self.added)))
        known = self.stand.estimate.problem
        for name in (n for n in known.calibration if n not in problem.variables):
            problem.calibration.append(problem.add(known.variables[name]))
        return beside(problem, self.stand.estimate)

    @property
    def problem(self) -> Problem:
        """Of the recordings as they are, with the added effects."""
        return self._wide[0]

    @property
    def calibration(self) -> list[str]:
        """Unknowns of the model that describe the hardware."""
        return self.stand.estimate.problem.calibration

    def terms_of(self, name: str) -> list[Term]:
        """Those of an effect, or of a frame: one, or one for each rig."""
        every = (t for some in self.problem.terms for t in some)
        found = {t.variable: t for t in every if name in (t.effect.name, t.effect.family)}
        return list(found.values())

    def unit_of(self, name: str) -> str:
        """Of an effect's parameters; the first one's, where they differ."""
        return self.terms_of(name)[0].effect.params(self.source.rig)[0].unit

    @property
    def unbounded(self) -> list[str]:
        """Unknowns of the added effects, but of those by chance."""
        known = self.stand.estimate.values
        some = self._wide[0].variables.items()
        return [n for n, u in some if n not in known and u.role is not Role.SCATTER]

    @cached_property
    def now(self) -> Information:
        """What the recordings say."""
        return self.told_by(*self.together(None))

    @cached_property
    def _pattern(self) -> tuple[Scan, Beams, float]:
        alone = not self.source.recording.stops
        return drawn(self.source.rig.lidar) if alone else pattern(self.source)

    @property
    def scanned(self) -> bool:
        """Whether stops are scanned, on a mesh."""
        some = bool(self.stand.estimate.scans) or not self.source.recording.stops
        return some and self.source.rig.lidar is not None and self.source.reference is not None

    @cached_property
    def _compared(self) -> list[int]:
        """Numbers of some scans of its recording that were fitted to."""
        folder = self.source.recording.folder
        scans = enumerate(self.stand.estimate.scans)
        mine = [i for i, scan in scans if scan.recording.folder == folder]
        some = np.linspace(0, max(len(mine) - 1, 0), COMPARED).round().astype(int)
        return [mine[k] for k in np.unique(some)] if mine else []

    @cached_property
    def measured(self) -> Poses:
        """The stops of the recording, where they were."""
        roots = roots_of(self.stand.estimate.problem, self.source.recording)
        at, recording = np.array(sorted(roots), int), self.source.recording
        Ts = [self.values[roots[k]] for k in at.tolist()]
        return Poses(recording.location[at], recording.joints[at], np.reshape(Ts, (-1, 4, 4)))

    @cached_property
    def brightness(self) -> Brightness | None:
        """Of beams; None where no scan says."""
        estimate, some = self.stand.estimate, self._compared
        rows = (estimate.scans[i].rows(self.values, estimate.associations[i]) for i in some)
        return Brightness.of(rows) if some else None

    def worth(self, patterns: Sequence[tuple[Scan, Beams]]) -> float:
        """How many beams of a recorded scan one of a pattern is worth, in the median: the sums of
        weights over variances of scans that were recorded, and of the pattern there. Where none
        was recorded, as many as it stands for."""
        if not self.source.recording.stops:
            return len(self._pattern[0].ring) / len(patterns[0][0].ring)
        estimate, some = self.stand.estimate, self._compared

        def ratio(k: int) -> float:
            i = some[k]
            real = estimate.scans[i].rows(self.values, estimate.associations[i])
            there = self.anew(i, patterns)
            planned = there.rows(self.values, there.associate(self.values, near_edges=True))
            told, wanted = (float(np.sum(r.weight_m2)) for r in (planned, real))
            return wanted / max(told, 1e-300)

        return float(np.median(list(in_order(ratio, len(some)))))

    def anew(
        self, scan: int, patterns: Sequence[tuple[Scan, Beams]], **planned: object
    ) -> PlannedScan:
        """A scan that was measured, by its number in the problem, planned where it was."""
        source, recording = self.source, self.source.recording
        origin = source.rig.lidar.beam_origin_m
        store = PlannedStore(recording, origin, given=source.store, patterns=patterns)
        known = {"nearest_m": self._pattern[2], "store": store, "index": len(recording.stops)}
        return PlannedScan.of(self.stand.estimate.scans[scan], **known, **planned)

    def each(self, poses: Poses, keys: Sequence[Key]) -> np.ndarray:
        """What each of some planned stops says by itself (n, S, S), of the components `keys`."""
        first, count = len(self.source.recording.stops), len(poses.joints)
        together = SCATTERING if any(e.by_chance for e in self.added) else max(count, 1)
        parts = []
        for start in range(0, count, together):
            some = poses.some(range(start, min(start + together, count)))
            problem, values = self.planned_alone(some)
            size = len(some.joints)
            parts.append(of_each(problem, values, keys, first, size, self.unbounded))
        return np.concatenate(parts)

    def planned_alone(self, poses: Poses) -> tuple[Problem, dict[str, np.ndarray]]:
        """The problem of some planned stops, each a visit of its own, and where all of it lies."""
        patterns = thinned(self._pattern[:2], BEAMS_A_STOP) if self.scanned else []
        return self._with(poses, patterns, apart=True, alone=True)

    def after(self, poses: Poses) -> Information:
        """What the recordings and planned stops say together."""
        return self.told_by(*self.together(poses))

    def together(
        self, poses: Poses | None
    ) -> tuple[Problem, dict[str, np.ndarray], Sequence[Association]]:
        """The problem of what was measured and of planned stops, if there are any: with the
        surfaces' unknowns, where all of it lies, and what each scan meets."""
        if poses is None:
            return *self._wide, self.stand.estimate.associations
        patterns = [self._pattern[:2]] if self.scanned else []
        problem, values = self._with(poses, patterns, apart=False, alone=False)
        estimate = self.stand.estimate
        pairs = zip(estimate.scans, estimate.associations, strict=True)
        known = {key_of(scan): met for scan, met in pairs}

        def meets(i: int) -> Association:
            scan = problem.scans[i]
            met = known.get(key_of(scan))
            return met or scan.associate(values, near_edges=True)

        found = list(in_order(meets, len(problem.scans)))
        problem = with_surfaces(problem, found)
        for name in problem.cells:
            unknown = problem.variables[name]
            values[name] = started(unknown, estimate.state, unknown.mean)
        return problem, values, found

    def told_by(
        self,
        problem: Problem,
        values: Mapping[str, np.ndarray],
        associations: Sequence[Association],
    ) -> Information:
        """What all rows of a problem say, with the earlier estimate, if there is one, in the place
        of paper; arguments as of `of_all`."""
        if self.prior is None:
            return of_all(problem, values, associations, self.unbounded)
        problem = problem.resting_on(self.prior.rests_on, self.prior.variables)
        return of_all(problem, values, associations, self.unbounded).believing(self.prior)

    def _with(
        self, poses: Poses, patterns: Sequence[tuple[Scan, Beams]], apart: bool, alone: bool
    ) -> tuple[Problem, dict[str, np.ndarray]]:
        """The problem of all stops, or of the planned ones alone, and where all of it lies."""
        stand, first = self.stand, len(self.source.recording.stops)
        source = extended(self.source, poses, patterns, self.T_world_reference, apart)
        sources = [source, *stand.sources[1:]]
        use = None
        if alone:
            use = [np.zeros(len(s.recording.stops), bool) for s in sources]
            use[0][first:] = True
        model = stand.model.plus(tuple(self.added))
        problem = build(sources, model, use, meetings=stand.problem.meetings)
        problem = weighted_as(problem, stand.estimate.problem)
        problem = problem.setting_aside(stand.estimate.problem.set_aside)
        planned = {}
        if patterns:
            planned = {
                "each": self.worth(patterns),
                "nearest_m": self._pattern[2],
                "brightness": self.brightness,
            }
        known = {
            name: started(unknown, stand.estimate.state, problem.initial[name])
            for name, unknown in problem.variables.items()
            if name in self.values
        }
        return at_their_places(problem, known, source, first, poses, **planned)
