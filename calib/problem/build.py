"""The graph's parts: every variable, prior and block of a model on its recordings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from calib.effects import Site, View
from calib.effects.rig import DOF
from calib.forward import Stops, Term, place
from calib.problem import start
from calib.problem.model import Model, Source
from calib.residuals.scan import ScanStop
from calib.residuals.surfaces import Meeting, MeshSurface, PlaneSurface
from calib.residuals.targets import HangingTarget
from calib.residuals.tracker import TrackedBody
from calib.solve.graph import Block, Variable
from chains import se3
from chains.errors import InputError
from sensors.lidar import beams
from sensors.planes import PlaneFinder, Planes

# What is known of a pose before any data: the room it is in.
UNKNOWN_POSE = np.repeat([3.0, 10.0], 3)
GUESSED_POSE = np.repeat([0.2, 0.3], 3)
POSE_UNITS = ("rad",) * 3 + ("m",) * 3


@dataclass
class Problem:
    """Variables, their start, and blocks; `calibration` names what a user wants to know.

    Args:
        variables: by name.
        initial: values to start from.
        calibration: variables that describe the hardware, in the order in which they are shown.
        terms: per source, the model's effects.
        blocks: tracker and target rows.
        scans: one per stop with a scan.
        meetings: per source, what its beams meet.
    """

    sources: Sequence[Source]
    terms: list[list[Term]]
    variables: dict[str, Variable] = field(default_factory=dict)
    initial: dict[str, np.ndarray] = field(default_factory=dict)
    calibration: list[str] = field(default_factory=list)
    blocks: list[Block] = field(default_factory=list)
    scans: list[ScanStop] = field(default_factory=list)
    meetings: dict[int, Meeting] = field(default_factory=dict)

    def add(self, variable: Variable, value: np.ndarray | None = None) -> str:
        """Add a variable once; it starts at `value`, or at its mean."""
        if variable.name not in self.variables:
            self.variables[variable.name] = variable
            self.initial[variable.name] = variable.mean if value is None else value
        return variable.name


def build(
    sources: Sequence[Source],
    model: Model,
    use: Sequence[np.ndarray] | None = None,
    meetings: Mapping[int, Meeting] | None = None,
) -> Problem:
    """The problem of a model on its recordings.

    Args:
        sources: the recordings.
        model: what is estimated.
        use: per source, (K,) bool, which stops take part; all where None.
        meetings: per source, what beams meet, where another problem has found that already.

    Raises:
        InputError: the recording has nothing to start from, lacks what an effect needs, or leaves
            nothing to estimate.
    """
    several = len({s.rig.name for s in sources}) > 1
    problem = Problem(sources, [model.terms(s.rig, several) for s in sources])
    problem.meetings.update(meetings or {})
    for source, terms in zip(sources, problem.terms, strict=True):
        for term in terms:
            problem.calibration.append(problem.add(effect_variable(term, source)))
    problem.calibration = list(dict.fromkeys(problem.calibration))
    for i, source in enumerate(sources):
        chosen = np.ones(len(source.recording.stops), bool) if use is None else use[i]
        _Builder(problem, i, source, "" if len(sources) == 1 else f"{i}/", chosen, model).build()
    if not problem.calibration:
        raise InputError(
            f"{sources[0].rig.name}: there is nothing to estimate: no frame with a sigma, no arm "
            "and no LiDAR, or all of it is held"
        )
    return problem


def effect_variable(term: Term, source: Source) -> Variable:
    """The vector of an effect's free parameters, about zero."""
    params = term.effect.params(source.rig)
    params = [params[i] for i in term.free]
    return Variable(
        term.variable,
        "vector",
        np.zeros(len(params)),
        np.array([p.sigma for p in params]),
        tuple(p.name for p in params),
        tuple(p.unit for p in params),
    )


def pose_variable(name: str, mean: np.ndarray, sigma: np.ndarray = UNKNOWN_POSE) -> Variable:
    """A pose known to `sigma` about `mean`."""
    return Variable(name, "pose", mean, sigma, DOF, POSE_UNITS)


@dataclass
class _Builder:
    """Adds one recording to a problem."""

    problem: Problem
    number: int
    source: Source
    prefix: str
    chosen: np.ndarray
    model: Model

    def build(self) -> None:
        rig, recording = self.source.rig, self.source.recording
        self.has_lidar = rig.lidar is not None and bool(recording.has_scan[self.chosen].any())
        self.groups = self._groups()
        self.reference = self._reference()
        self.stops = {
            (name, k): index
            for name, stops in self.groups.items()
            for k, index in self._split(stops)
        }
        for name, stops in self.groups.items():
            self._add_root(name, stops)
        self.geometry = {key: self._place(key[0], index) for key, index in self.stops.items()}
        self._add_bodies()
        self._add_targets()
        if self.has_lidar:
            self._add_scans()

    def _groups(self) -> dict[str, np.ndarray]:
        """Root variable -> the stops that share it."""
        recording, moves = self.source.recording, self.source.rig.moves
        labels = {
            "stop": np.array(recording.stops),
            "location": recording.location,
            "never": np.full(len(recording.stops), "all"),
        }[moves]
        index = np.flatnonzero(self.chosen)
        names = dict.fromkeys(labels[index])
        return {f"{self.prefix}root@{name}": index[labels[index] == name] for name in names}

    def _split(self, stops: np.ndarray) -> list[tuple[int, np.ndarray]]:
        """Stops that share every variable stay together; those with joints of their own do not."""
        if self.source.rig.sigma_joint_rad and self.source.rig.joint_names:
            return [(int(k), np.array([k])) for k in stops]
        scanned = self.source.recording.has_scan[stops]
        alone = [(int(k), np.array([k])) for k in stops[scanned]]
        together = stops[~scanned]
        return alone + ([(-1, together)] if len(together) else [])

    def _reference(self) -> str | None:
        """Variable of T_world_reference, or None where the reference's frame is the world."""
        rig, recording = self.source.rig, self.source.recording
        wanted = recording.targets is not None or (self.has_lidar and self.source.reference)
        if rig.tracker is None or not wanted:
            return None
        name = rig.reference_frame
        if name in self.model.fixed:
            raise InputError(
                f"--fix {name}: its place is not known before a fit, so it cannot be held."
            )
        if name in self.problem.variables:
            return name
        T = start.reference_from_targets(self.source)
        if T is None:
            T = self._reference_from_guess()
        self.problem.calibration.append(name)
        return self.problem.add(pose_variable(name, T))

    def _reference_from_guess(self) -> np.ndarray:
        stops = np.flatnonzero(self.chosen)
        for k in stops:
            guess = start.guessed_pose(self.source, [k])
            seen = start.root_pose(self.source, [k])
            if guess is not None and seen is not None:
                return seen @ se3.inverse(guess)
        raise InputError(
            f"{self.source.recording.folder}: nothing ties '{self.source.rig.reference_frame}' to "
            f"'{self.source.rig.world}'; add targets.csv, or base_guess columns to stops.csv."
        )

    def _add_root(self, name: str, stops: np.ndarray) -> None:
        """T_world_root: unknown but for the room, or guessed, or, where nothing says, given."""
        source = self.source
        tracked = start.root_pose(source, stops)
        guess = start.guessed_pose(source, stops)
        if guess is not None and self.reference:
            guess = self.problem.initial[self.reference] @ guess
        if tracked is not None:
            variable = pose_variable(name, tracked)
        elif guess is not None:
            variable = pose_variable(name, guess, GUESSED_POSE)
        elif len(self.groups) == 1 and self.source.reference is None:
            # Nothing says where the rig is, and nothing else has a place: any choice will do.
            variable = pose_variable(name, np.eye(4), np.full(6, 1e-3))
        else:
            near = self._neighbour(stops)
            if near is None:
                stop = source.recording.stops[stops[0]]
                raise InputError(
                    f"{source.recording.folder / 'stops.csv'}: '{stop}': nothing tracks the rig"
                    f" and there is no base_guess to start from; add base_guess.x … base_guess.qz"
                )
            variable = pose_variable(name, near)
        self.problem.add(variable)

    def _neighbour(self, stops: np.ndarray) -> np.ndarray | None:
        """T_world_root of another stop at the same location, or of the nearest in time."""
        recording = self.source.recording
        k = int(stops[0])
        order = np.lexsort(
            (
                np.abs(recording.time_s - recording.time_s[k]),
                recording.location != recording.location[k],
            )
        )
        poses = (start.root_pose(self.source, [j]) for j in order)
        return next((T for T in poses if T is not None), None)

    def _place(self, root: str, index: np.ndarray) -> Stops:
        source = self.source
        columns = {name: values[index] for name, values in source.columns.items()}
        terms = self.problem.terms[self.number]
        stops = place(
            source.rig, terms, source.recording.joints[index], columns, root, self.reference
        )
        sigma = source.rig.sigma_joint_rad
        if not sigma or not source.rig.joint_names:
            return stops
        name = f"{self.prefix}joints@{source.recording.stops[index[0]]}"
        count = len(source.rig.joint_names)
        units = tuple("rad" if kind == "revolute" else "m" for kind in source.rig.joint_kinds)
        noise = Variable(
            name, "vector", np.zeros(count), np.full(count, sigma), source.rig.joint_names, units
        )
        self.problem.add(noise)
        return stops.with_joint_noise(name)

    def _add_bodies(self) -> None:
        tracker, recording = self.source.rig.tracker, self.source.recording
        for b, body in enumerate(tracker.bodies if tracker else ()):
            poses = start.body_poses(self.source, body)
            point = start.is_point(self.source, body)
            for (root, _), index in self.stops.items():
                seen = index[np.isfinite(poses[index, 0, 3])]
                if not len(seen):
                    continue
                stops = self._place(root, seen)
                name = f"{body} at {recording.stops[seen[0]]}"
                bases = {v: basis[:, b] for v, basis in self._bases(Site.TRACKER, seen).items()}
                self.problem.blocks.append(
                    TrackedBody(
                        name,
                        stops,
                        body,
                        poses[seen],
                        tracker.sigma_m,
                        tracker.sigma_rad,
                        point,
                        bases,
                        [(recording.folder, int(k)) for k in seen],
                    )
                )

    def _bases(self, site: Site, index: np.ndarray) -> dict[str, np.ndarray]:
        source = self.source
        columns = {name: values[index] for name, values in source.columns.items()}
        view = View(source.rig, len(index), columns, source.recording.joints[index])
        terms = (t for t in self.problem.terms[self.number] if t.effect.site is site)
        return {t.variable: t.basis(view) for t in terms}

    def _add_targets(self) -> None:
        targets, spec = self.source.recording.targets, self.source.rig.target
        if targets is None or spec is None or self.reference is None:
            return
        gravity = Variable(
            "gravity",
            "direction",
            start.gravity(self.source),
            np.ones(2),
            ("across_1", "across_2"),
            ("rad",) * 2,
        )
        self.problem.add(gravity)
        view = View(self.source.rig, len(targets.names), {}, np.zeros((1, 0)))
        terms = [t for t in self.problem.terms[self.number] if t.effect.site is Site.TARGET]
        shifts = {t.variable: t.basis(view) for t in terms}
        for m, name in enumerate(targets.names):
            marker = Variable(
                f"{self.prefix}target:{name}",
                "vector",
                targets.lower_m[m],
                np.full(3, 10.0),
                ("x", "y", "z"),
                ("m",) * 3,
            )
            self.problem.add(marker)
            self.problem.blocks.append(
                HangingTarget(
                    f"target {name}",
                    marker.name,
                    "gravity",
                    self.reference,
                    targets.faro_m[m],
                    targets.upper_m[m],
                    targets.lower_m[m],
                    spec.sphere_below_lower_marker_m,
                    spec.sigma_sphere_m,
                    spec.sigma_marker_m,
                    {
                        v: np.broadcast_to(b, (len(targets.names), *b.shape[1:]))[m]
                        for v, b in shifts.items()
                    },
                )
            )

    def _add_scans(self) -> None:
        source, recording = self.source, self.source.recording
        meeting = self._meeting()
        terms = [
            t
            for t in self.problem.terms[self.number]
            if t.effect.site in (Site.BEAM, Site.REFERENCE, Site.NOISE)
        ]
        sigma_m = source.rig.reference.sigma_m if source.rig.reference and source.reference else 0.0
        for (root, k), index in self.stops.items():
            if k < 0 or not recording.has_scan[k]:
                continue
            columns = {name: values[index] for name, values in source.columns.items()}
            self.problem.scans.append(
                ScanStop(
                    recording.stops[k],
                    recording,
                    k,
                    self.geometry[root, k],
                    terms,
                    columns,
                    meeting,
                    sigma_m,
                )
            )

    def _meeting(self) -> Meeting:
        """What the beams meet: the mesh, or else planes found in the scans."""
        found = self.problem.meetings.get(self.number)
        if found is None:
            lidar, reference = self.source.rig.lidar, self.source.reference
            found = (
                MeshSurface(reference, 1.5 * lidar.beam_divergence_rad)
                if reference is not None
                else PlaneSurface(self._find_planes(), f"{self.prefix}planes")
            )
            self.problem.meetings[self.number] = found
        if isinstance(found, PlaneSurface):
            self.problem.add(found.unknown)
        return found

    def _find_planes(self) -> Planes:
        recording, lidar = self.source.recording, self.source.rig.lidar
        finder = PlaneFinder(noise_m=lidar.sigma_range_m)
        for (root, k), _ in self.stops.items():
            if k < 0 or not recording.has_scan[k]:
                continue
            ray = beams(recording.scan(k).xyz_m, lidar.beam_origin_m)
            stops = self.geometry[root, k]
            T = stops.in_reference(self.source.rig.lidar_frame, self.problem.initial).T[0]
            points_m = ray.origin_m + ray.range_m[:, None] * ray.direction
            finder.add(k, se3.apply(T, points_m), T[:3, 3])
        planes = finder.planes(min_points=100)
        if not len(planes.normal):
            raise InputError(
                f"{recording.folder}: there is no mesh, and no flat patch in the scans to fit to; "
                f"add reference/mesh.ply, or scan walls"
            )
        return planes
