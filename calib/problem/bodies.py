"""Rows of the tracker and of levels: bodies at stops, and targets on their rods."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from calib.effects import Site, View
from calib.forward import RowsOf, Term
from calib.problem import start
from calib.problem.places import Places
from calib.problem.problem import Problem, SourceStops
from calib.problem.unknowns import Owner, Role, vector_unknown
from calib.residuals.groups import Group, level_of
from calib.residuals.levels import Level
from calib.residuals.seen import ByPlace
from calib.residuals.targets import TARGET_PARTS, HangingTarget
from calib.residuals.tracker import TrackedBody
from chains import se3

GRAVITY = "gravity"  # the unknown of where down is: rods hang along it, levels feel it
NO_LEVEL_READ = np.array([0.0, 0.0, -1.0])  # until one is, down is where most worlds have it


def add_bodies(problem: Problem, part: SourceStops, places: Places) -> None:
    """Add a block for every tracked body and group of stops that share all unknowns."""
    tracker, recording = part.source.rig.tracker, part.source.recording
    here = _tracker_bases(part)
    for b, body in enumerate(tracker.bodies if tracker else ()):
        poses = start.body_poses(part.source, body)
        point = start.is_point(part.source, body)
        bases = {name: basis[:, b] for name, basis in here.bases.items()}
        for key, index in places.stops.items():
            seen = index[np.isfinite(poses[index, 0, 3])]
            if not len(seen):
                continue
            problem.blocks.append(
                TrackedBody(
                    name=f"{body} at {recording.stops[seen[0]]}",
                    stops=places.of(key, seen),
                    body=body,
                    measured=poses[seen],
                    sigma_m=tracker.sigma_m,
                    sigma_rad=tracker.sigma_rad,
                    is_point=point,
                    bases=RowsOf(bases, seen),
                    by_place=here.by_place(seen, b),
                    stop_names=[(recording.folder, int(k)) for k in seen],
                    groups=tuple(Group("body", recording.stops[k], body, part.label) for k in seen),
                )
            )


def add_levels(problem: Problem, part: SourceStops, places: Places) -> None:
    """Add gravity, the zeros of levels, and a block for every level and group of stops that share
    all unknowns."""
    levels, recording = part.source.rig.levels, part.source.recording
    if levels is None:
        return
    zeros = {frame: _add_zero(problem, part, frame) for frame in levels.frames}
    blocks = [
        Level(
            name=f"{level_of(frame)} at {recording.stops[read[0]]}",
            stops=places.of(key, read),
            body=frame,
            measured=felt[read],
            gravity=GRAVITY,
            sigma_rad=levels.sigma_rad,
            bases={name: turned_by_zero(felt[read]) for name in zeros[frame]},
            stop_names=[(recording.folder, int(k)) for k in read],
            groups=tuple(
                Group("level", recording.stops[k], level_of(frame), part.label) for k in read
            ),
        )
        for frame, felt in recording.levels.items()
        for key, index in places.stops.items()
        if len(read := index[np.isfinite(felt[index, 0])])
    ]
    turns = [block.seen(problem.initial).T[:, :3, :3] for block in blocks]
    ups = [np.matvec(R, b.measured).sum(axis=0) for R, b in zip(turns, blocks, strict=True)]
    _add_gravity(problem, -np.sum(ups, axis=0) if blocks else NO_LEVEL_READ)
    problem.blocks += blocks


def zero_of(prefix: str, frame: str) -> str:
    """Name of the unknown of what the axes of a frame's level read where they feel nothing; of
    several recordings, before it stands which."""
    return f"{prefix}{level_of(frame)} zero"


def _add_zero(problem: Problem, part: SourceStops, frame: str) -> list[str]:
    """Add the zeros of a level, where they may differ from none; their name."""
    sigma = part.source.rig.levels.sigma_zero_rad
    if sigma is None:
        return []
    unknown = vector_unknown(
        zero_of(part.prefix, frame),
        np.full(3, sigma),
        dofs=("x", "y", "z"),
        units=("rad",) * 3,
        role=Role.ZERO,
        owner=Owner(recording=part.label, where=frame),
    )
    return [problem.add(unknown)]


def turned_by_zero(felt: np.ndarray) -> np.ndarray:
    """The twist (K, 6, 3) of a level per unit of its zeros b, over 1 g: what it feels along m
    (K, 3) becomes ``m + b``, as if it had turned by ``b x m``."""
    return np.concatenate([-se3.skew(felt), np.zeros((len(felt), 3, 3))], axis=1)


def _add_gravity(problem: Problem, down: np.ndarray) -> None:
    """Add where down (3,) is, of any length: about there, or as some rig.yaml says."""
    said = [s.rig.levels for s in problem.sources if s.rig.levels and s.rig.levels.up]
    best = min(said, key=lambda levels: levels.sigma_up_rad, default=None)
    mean, sigma_rad = (-np.array(best.up), best.sigma_up_rad) if best else (down, 1.0)
    problem.add(
        vector_unknown(
            GRAVITY,
            np.full(3, sigma_rad),
            dofs=("x", "y", "z"),
            units=("rad",) * 3,
            mean=mean / np.linalg.norm(mean),
            role=Role.GRAVITY,
        )
    )


@dataclass(frozen=True)
class _Added:
    """What a tracker adds to bodies at all stops.

    Args:
        bases: unknown -> (K or 1, B, 6, P).
        of_place: unknown -> the effect, of those that go by where the model has a body.
        view: what effects look at.
    """

    bases: Mapping[str, np.ndarray]
    of_place: Mapping[str, Term]
    view: View

    def by_place(self, index: np.ndarray, number: int) -> ByPlace | None:
        """What goes by the place of a body at some stops."""
        if not self.of_place:
            return None
        columns = {name: column[index] for name, column in self.view.columns.items()}
        view = View(self.view.rig, len(index), columns, self.view.joints[index])
        return ByPlace(self.of_place, view, number)


def _tracker_bases(part: SourceStops) -> _Added:
    """What the tracker adds to every body at every stop of a recording."""
    source = part.source
    view = View(source.rig, len(source.recording.stops), source.columns, source.recording.joints)
    terms = [t for t in part.terms if t.effect.site is Site.TRACKER and not t.effect.widens]
    of_place = {t.variable: t for t in terms if t.effect.goes_by_place}
    bases = {t.variable: t.basis(view) for t in terms}  # of all: who lacks a column is told here
    return _Added(
        bases={t.variable: bases[t.variable] for t in terms if t.variable not in of_place},
        of_place=of_place,
        view=view,
    )


def add_targets(problem: Problem, part: SourceStops, places: Places) -> None:
    """Add gravity, and a block with its marker's place for every target. A target that an earlier
    recording has too, with the same numbers, is added only once."""
    targets, spec = part.source.recording.targets, part.source.rig.target
    if targets is None or spec is None or places.reference is None:
        return
    down, lower_m = start.gravity(part.source), start.lower_markers(targets)
    upper_m = np.where(np.isfinite(targets.upper_m), targets.upper_m, lower_m)
    parts = (targets.lower_m, targets.upper_m, targets.faro_m)
    whole = np.stack([np.isfinite(part).all(axis=1) for part in parts], axis=1)
    _add_gravity(problem, down)
    shape = len(targets.names), 3
    view = View(part.source.rig, shape[0], {"point_m": targets.faro_m}, np.zeros((1, 0)))
    shifts, scanned = (
        {t.variable: np.broadcast_to(b := t.basis(view), (*shape, b.shape[2])) for t in terms}
        for terms in (
            [t for t in part.terms if t.effect.site is Site.TARGET and not t.effect.widens],
            [t for t in part.terms if t.effect.of_scanner],
        )
    )
    view = View.of_places(part.source.rig, np.stack([lower_m, upper_m], axis=1))
    tracked = {
        t.variable: np.broadcast_to(b := t.basis(view)[:, :, 3:], (shape[0], *b.shape[1:]))
        for t in part.terms
        if t.effect.of_volume
    }
    counted = {d for s in problem.sources[: part.number] for d in s.measured_targets.values()}
    digests = part.source.measured_targets
    for m, name in enumerate(targets.names):
        if digests.get(name) in counted:
            continue
        marker = vector_unknown(
            f"{part.prefix}target:{name}",
            np.full(3, 10.0),  # m: anywhere in the room
            dofs=("x", "y", "z"),
            units=("m",) * 3,
            mean=lower_m[m],
            role=Role.TARGET,
            owner=Owner(recording=part.label, where=name),
        )
        problem.add(marker)
        problem.blocks.append(
            HangingTarget(
                name=f"target {name}",
                marker=marker.name,
                gravity=GRAVITY,
                reference=places.reference,
                faro_m=np.nan_to_num(targets.faro_m[m]),
                upper_m=upper_m[m],
                lower_m=lower_m[m],
                below_m=spec.sphere_below_lower_marker_m,
                sigma_sphere_m=spec.sigma_sphere_m,
                sigma_marker_m=spec.sigma_marker_m,
                shift={v: b[m] for v, b in shifts.items()},
                scanned={v: b[m] for v, b in scanned.items()},
                tracked={v: b[m] for v, b in tracked.items()},
                groups=tuple(Group("target", name, what, part.label) for what in TARGET_PARTS),
                weight=None if whole[m].all() else whole[m].astype(float),
            )
        )
