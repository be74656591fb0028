"""Where the rig stands and how its arm was bent: the unknowns that place every stop."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from calib.forward import Stops, place
from calib.problem import start
from calib.problem.model import Model, Source, labels
from calib.problem.problem import Problem, SourceStops
from calib.problem.unknowns import (
    EXACT,
    UNKNOWN_POSE,
    UNREAD,
    Owner,
    Role,
    pose_unknown,
    vector_unknown,
)
from calib.residuals.groups import Group
from chains import se3
from chains.errors import InputError, UntiedError

GUESSED_POSE = np.repeat([0.2, 0.3], 3)  # rad, m: a base_guess is set up by hand


def standing(source: Source) -> np.ndarray:
    """Label (K,) of each stop: those with one share where the rig stands."""
    recording = source.recording
    return {
        "stop": np.array(recording.stops),
        "location": recording.location,
        "never": np.full(len(recording.stops), "all"),
    }[source.rig.moves]


def _joints(prefix: str, stop: str) -> str:
    return f"{prefix}joints@{stop}"


def joints_at(problem: Problem, group: Group) -> str:
    """Name of what encoders misreport at the stop that a group is of."""
    called = labels(problem.sources)
    return _joints(f"{called.index(group.recording)}/" if len(called) > 1 else "", group.where)


@dataclass
class Places:
    """Adds what places the stops of one recording to a problem, and binds its geometry.

    Args:
        problem: added to.
        part: the recording, and which of its stops take part.
        model: what is estimated.
    """

    problem: Problem
    part: SourceStops
    model: Model
    groups: dict[str, np.ndarray] = field(init=False)
    stops: dict[tuple[str, int], np.ndarray] = field(init=False)
    reference: str | None = field(init=False)
    _all: Stops = field(init=False)
    _geometry: dict[tuple[str, int], Stops] = field(init=False)

    def __post_init__(self) -> None:
        self.groups = self._groups()
        self.reference = self._reference()
        source = self.part.source
        joints, columns = source.recording.joints, source.columns
        self._all = place(source.rig, self.part.terms, joints, columns, "", self.reference)
        self.stops = {
            (name, k): index
            for name, stops in self.groups.items()
            for k, index in self._split(stops)
        }
        for name, stops in self.groups.items():
            self._add_root(name, stops)
        self._geometry = {key: self._bind(key[0], index) for key, index in self.stops.items()}

    def scanned(self) -> list[tuple[int, Stops]]:
        """The stops with a scan: number, and geometry."""
        has_scan = self.part.source.recording.has_scan
        return [(k, self._geometry[root, k]) for root, k in self.stops if k >= 0 and has_scan[k]]

    def _groups(self) -> dict[str, np.ndarray]:
        """Unknown of the root -> the stops that share it."""
        labels, index = standing(self.part.source), np.flatnonzero(self.part.chosen)
        names = dict.fromkeys(labels[index])
        return {f"{self.part.prefix}root@{name}": index[labels[index] == name] for name in names}

    def _split(self, stops: np.ndarray) -> list[tuple[int, np.ndarray]]:
        """Stops that share every unknown stay together; those with joints of their own do not."""
        if self.part.source.rig.sigma_joint_rad and self.part.source.rig.joint_names:
            return [(int(k), np.array([k])) for k in stops]
        recording = self.part.source.recording
        unread = {stop for stop, _ in self.part.source.unread}
        single = recording.has_scan[stops] | [recording.stops[k] in unread for k in stops]
        alone = [(int(k), np.array([k])) for k in stops[single]]
        together = stops[~single]
        return alone + ([(-1, together)] if len(together) else [])

    def _reference(self) -> str | None:
        """Unknown of T_world_reference, or None where the reference's frame is the world."""
        rig, recording = self.part.source.rig, self.part.source.recording
        wanted = recording.targets is not None or (
            self.part.has_lidar and self.part.source.reference
        )
        if rig.tracker is None or not wanted:
            return None
        name = rig.reference_frame
        if name in self.model.fixed:
            raise InputError(
                f"--fix {name}: its place is not known before a fit, so it cannot be held."
            )
        if name in self.problem.variables:
            return name
        # Targets of another recording tell of the same frame.
        others = (s for s in self.problem.sources if s.rig.reference_frame == name)
        each = map(start.reference_from_targets, (self.part.source, *others))
        T = next((T for T in each if T is not None), None)
        if T is None:
            T = self._reference_from_guess()
        self.problem.calibration.append(name)
        return self.problem.add(pose_unknown(name, T))

    def _reference_from_guess(self) -> np.ndarray:
        source = self.part.source
        for k in np.flatnonzero(self.part.chosen):
            guess, seen = start.guessed_pose(source, [k]), start.root_pose(source, [k])
            if guess is not None and seen is not None:
                return seen @ se3.inverse(guess)
        T = start.reference_from_targets(source.whole)  # good enough to start from
        if T is not None:
            return T
        known = self.model.starts.get(source.rig.reference_frame)
        if known is not None:
            return se3.from_xyz_quat(known[:3], known[3:])
        raise UntiedError(
            f"{source.recording.folder}: nothing ties '{source.rig.reference_frame}' to "
            f"'{source.rig.world}'; add targets.csv, or base_guess columns to stops.csv, or give a "
            "run that knows it as --prior."
        )

    def _add_root(self, name: str, stops: np.ndarray) -> None:
        """T_world_root: unknown but for the room, or guessed, or, where nothing says, given."""
        source = self.part.source
        tracked = start.root_pose(source, stops)
        place = standing(source)
        guess = start.guessed_pose(source, stops)
        if guess is None:  # one at another stop at which it stands alike will do
            guess = start.guessed_pose(source, np.flatnonzero(place == place[stops[0]]))
        if guess is not None and self.reference:
            guess = self.problem.initial[self.reference] @ guess
        sigma = UNKNOWN_POSE
        if tracked is not None:
            T = tracked
        elif guess is not None:
            T, sigma = guess, GUESSED_POSE
        elif len(self.groups) == 1 and self.part.source.reference is None:
            # Nothing says where the rig is, and nothing else has a place: any choice will do.
            T, sigma = np.eye(4), np.full(6, 1e-3)
        else:
            T = self._neighbour(stops)
            if T is None:
                stop = source.recording.stops[stops[0]]
                raise InputError(
                    f"{source.recording.folder / 'stops.csv'}: '{stop}': nothing tracks the rig"
                    f" and there is no base_guess to start from; add base_guess.x … base_guess.qz"
                )
        owner = Owner(recording=self.part.label, where=str(place[stops[0]]))
        self.problem.add(pose_unknown(name, T, sigma, Role.PLACE, owner))

    def _neighbour(self, stops: np.ndarray) -> np.ndarray | None:
        """T_world_root of another stop at the same location, or of the nearest in time or row."""
        recording = self.part.source.recording
        k = int(stops[0])
        when = recording.time_s if recording.timed else np.arange(len(recording.stops))
        order = np.lexsort((np.abs(when - when[k]), recording.location != recording.location[k]))
        poses = (start.root_pose(self.part.source, [j]) for j in order)
        return next((T for T in poses if T is not None), None)

    def of(self, key: tuple[str, int], some: np.ndarray) -> Stops:
        """The geometry of some of the stops that stand under a key."""
        whole = len(some) == len(self.stops[key])
        return self._geometry[key] if whole else self._bind(key[0], some)

    def _bind(self, root: str, index: np.ndarray) -> Stops:
        """The geometry of some stops that share a root."""
        source = self.part.source
        stops = self._all.some(index, root)
        sigma = self._joint_sigma(index)
        if not sigma.any():
            return stops
        stop = source.recording.stops[index[0]]
        units = tuple(source.rig.joint_units.values())
        name = self.problem.add(
            vector_unknown(
                _joints(self.part.prefix, stop),
                np.where(sigma > 0, sigma, EXACT),
                dofs=source.rig.joint_names,
                units=units,
                role=Role.JOINTS,
                owner=Owner(recording=self.part.label, where=stop),
            )
        )
        return stops.with_joint_noise(name)

    def _joint_sigma(self, index: np.ndarray) -> np.ndarray:
        """How well the encoders (J,) are known at stops that share all unknowns; readings that
        there are not are free."""
        source = self.part.source
        (stop, *others), names = [source.recording.stops[k] for k in index], source.rig.joint_names
        if others or not source.unread:
            return np.full(len(names), source.rig.sigma_joint_rad)
        free = [(stop, name) in source.unread for name in names]
        return np.where(free, UNREAD, source.rig.sigma_joint_rad)
