"""Leaving out what a mishap spoiled, ``--without WHERE:WHAT``, and scans that nothing places.

A recording without a body at a stop is a recording in which that body was not seen, so everything
that follows (where a fit starts, what is held out, what is tested) needs to know nothing of it.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from calib.effects import DEFAULT, Effect, Site, find
from calib.problem import start
from calib.problem.build import build
from calib.problem.model import Model, Source, labels
from calib.problem.places import standing
from calib.residuals.groups import (
    CAD,
    JOINTS,
    MESH,
    SCAN,
    Group,
    level_of,
    part_of_mesh,
)
from calib.residuals.scan import ScanStop
from calib.residuals.surfaces import part_counts
from calib.residuals.targets import TARGET_PARTS
from calib.rig.inventory import FAR_OFF_M
from chains.errors import InputError
from sensors.documents import nearest
from sensors.recording import RecordedStops
from sensors.stops import Targets

ROD = "rod"  # of a target: all of it
_LOG = logging.getLogger("rigcal")


def leave_out(sources: Sequence[Source], tokens: Sequence[str]) -> list[Source]:
    """The recordings without what some tokens name; see `Group.token`.

    Raises:
        InputError: a token names nothing that any recording has, or something in several; of a
            target that several share, measured once, one name means that of all.
    """
    out, called = list(sources), labels(sources)
    for token in tokens:
        every = enumerate(zip(out, called, strict=True))
        found = [(i, g) for i, (s, label) in every for g in _matching(s, label, token)]
        target = _sharing_a_target([(out[i], g) for i, g in found], out, called)
        found = target or found
        if len(target) > 1 and all(group in out[i].without for i, group in target):
            continue  # by another of its names
        if any(group in out[i].without for i, group in found):
            raise InputError(f"--without {token}: that is left out already; name it once")
        shared = found and (target or found[0][1].where in (CAD, MESH))
        if not found or (len(found) > 1 and not shared):
            raise InputError(_refusal(out, token, [called[i] for i, _ in found]))
        for i, group in found:
            out[i] = _left_out(out[i], group)
    return out


def _matching(source: Source, label: str, token: str) -> list[Group]:
    """What a token names in a recording: one group, or none. What belongs to a recording may bear
    its name, or what it is called beside others."""
    bare = {token, *(token.removeprefix(f"{n}/") for n in (label, source.recording.folder.name))}
    every = (*source.without, *_groups(source, label))
    return list(dict.fromkeys(g for g in every if g.bare in bare))


def _sharing_a_target(
    found: Sequence[tuple[Source, Group]], sources: Sequence[Source], called: Sequence[str]
) -> list[tuple[int, Group]]:
    """Where all that was found is one target, that of every recording that has what was measured of
    it, by their numbers; else nothing."""
    if any(group.kind != "target" for _, group in found):
        return []
    digests = {source.measured_targets.get(group.where) for source, group in found}
    if len(digests) != 1 or None in digests:
        return []
    return [
        (i, replace(found[0][1], where=name, recording=label))
        for i, (source, label) in enumerate(zip(sources, called, strict=True))
        for name, digest in source.measured_targets.items()
        if digest in digests
    ]


def _groups(source: Source, label: str = "") -> list[Group]:
    """All that can be left out of a recording that is called so."""
    rig, recording = source.rig, source.recording
    out, read = [], [name for name in rig.joint_names if name not in rig.passive]
    for k, stop in enumerate(recording.stops):
        out += [Group("body", stop, b, label) for b in recording.bodies if _seen(recording, b)[k]]
        felt = (f for f, each in recording.levels.items() if np.isfinite(each[k, 0]))
        out += [Group("level", stop, level_of(frame), label) for frame in felt]
        out += [Group("scan", stop, SCAN, label)] if recording.has_scan[k] else []
        if rig.joint_names:
            out += [Group("joints", stop, what, label) for what in (JOINTS, *read)]
    for target in recording.targets.names if recording.targets else ():
        out += [Group("target", target, what, label) for what in (*TARGET_PARTS, ROD)]
    out += [Group("frame", CAD, frame) for frame in rig.frame_sigma]
    out += [Group("frame", CAD, f"{e}.{p}") for e, p in on_paper(source)]
    if source.reference is not None:
        for kind, count in part_counts(source.reference).items():
            out += [Group("surface", MESH, part_of_mesh(kind, n)) for n in range(count)]
    return out


def on_paper(source: Source) -> list[tuple[str, str]]:
    """Effect and parameter of what the URDF says of the arm: lengths, and where joints are zero."""
    return [(e.name, p.name) for e in of_the_arm() for p in e.params(source.rig) if p.sigma]


def of_the_arm() -> list[Effect]:
    """What every model has of an arm: how far its drawing, and its zeros, are off."""
    return [e for e in map(find, DEFAULT) if e.site in (Site.EDGE, Site.JOINTS)]


def _seen(recording: RecordedStops, body: str) -> np.ndarray:
    return np.isfinite(recording.bodies[body][:, :3]).all(axis=1)


def _left_out(source: Source, group: Group) -> Source:
    recording = source.recording
    if group.kind == "body":
        at = recording.stops.index(group.where)
        seen = recording.bodies[group.what].copy()
        seen[at] = np.nan
        recording = replace(recording, bodies=recording.bodies | {group.what: seen})
    elif group.kind == "level":
        levels = {frame: felt.copy() for frame, felt in recording.levels.items()}
        frame = next(frame for frame in levels if level_of(frame) == group.what)
        levels[frame][recording.stops.index(group.where)] = np.nan
        recording = replace(recording, levels=levels)
    elif group.kind == "scan":
        has_scan = recording.has_scan.copy()
        has_scan[recording.stops.index(group.where)] = False
        recording = replace(recording, has_scan=has_scan)
    elif group.kind == "target":
        recording = replace(recording, targets=_targets(recording.targets, group))
    return source.changed(recording, group)


def _targets(targets: Targets, group: Group) -> Targets | None:
    """The targets without a part of one, which is NaN, or without one: a rod that has lost both of
    its markers hangs nowhere."""
    at = targets.names.index(group.where)
    other = {"lower": targets.upper_m, "upper": targets.lower_m}.get(group.what)
    if group.what == ROD or (other is not None and not np.isfinite(other[at]).all()):
        kept = np.delete(np.arange(len(targets.names)), at)
        if not len(kept):
            return None
        parts = {f: getattr(targets, f)[kept] for f in ("faro_m", "upper_m", "lower_m")}
        return Targets([targets.names[i] for i in kept], **parts)
    name = {"sphere": "faro_m"}.get(group.what, f"{group.what}_m")
    part = getattr(targets, name).copy()
    part[at] = np.nan
    return replace(targets, **{name: part})


def _refusal(sources: Sequence[Source], token: str, called: Sequence[str]) -> str:
    """Of a token that names something in none of the recordings, or in all of those called so."""
    if called:
        what = token.rpartition("/")[2]
        choice = " or ".join(f"{label}/{what}" for label in called)
        return f"--without {token}: several recordings have that; say which: {choice}"
    known = [g.token for s in sources for g in _groups(s) if g.where != MESH]
    return (
        f"--without {token}: no recording has that; write STOP:BODY, STOP:FRAME.level, STOP:scan, "
        "STOP:joints, STOP:JOINT, TARGET:sphere, lower, upper or rod, cad:FRAME, "
        "cad:EFFECT.PARAMETER, mesh:surface_N, mesh:region_N or mesh:patch_N"
        f"{nearest(token, known)}"
    )


def placed(sources: Sequence[Source], model: Model) -> tuple[list[Source], Model]:
    """The recordings, and a model of them, without scans that nothing places.

    Where no tracked body and no guess tells of a stop, its scan starts from where the rig stood at
    the stop nearest in time, of the same location if there is one. That will do where the base
    hardly moved. Where half of the beams end more than `FAR_OFF_M` from the surface that they
    should meet, it will not: what a fit then finds is wrong for all others too. Without a mesh
    nothing tells, as such scans meet planes of their own. So these scans are left out, and the log
    of `rigcal` says so.

    Raises:
        InputError: as of `build`; or nothing places any scan.
    """
    lost = list(_lost(sources, model))
    if not lost:
        return list(sources), model
    tokens = [group.token for group in lost]
    if len(lost) == sum(int(source.recording.has_scan.sum()) for source in sources):
        raise InputError(
            f"{sources[0].recording.folder / 'stops.csv'}: no tracked body is seen at any stop "
            "that has a scan, and there is no base_guess; add base_guess.x … base_guess.qz"
        )
    _LOG.warning(
        "%s left out: no tracked body is seen there, and beams miss the room from where the rig "
        "stood at the stop nearest in time, or there is no mesh to tell; base_guess columns in "
        "stops.csv would place them",
        ", ".join(tokens),
    )
    without = replace(model, without=(*model.without, *tokens))
    return leave_out(sources, tokens), without


def _lost(sources: Sequence[Source], model: Model) -> Iterator[Group]:
    """Scans that nothing places, and that are far off where they start; those of stops at which the
    rig stands alike are so together."""
    nowhere: dict[tuple[str, str], tuple[str, str]] = {}
    for source, label in zip(sources, labels(sources), strict=True):
        for stop, where in _nowhere(source):
            if source.reference is None:
                yield Group("scan", stop, SCAN, label)
            else:
                nowhere[label, stop] = label, where
    if not nowhere:
        return
    problem = build(sources, model)
    scans = [s for s in problem.scans if (s.group.recording, s.group.where) in nowhere]
    at = [nowhere[scan.group.recording, scan.group.where] for scan in scans]
    off_m = [_off_m(scan, problem.initial) for scan in scans]
    for scan, where in zip(scans, at, strict=True):
        together = [off for off, there in zip(off_m, at, strict=True) if there == where]
        if np.median(together) > FAR_OFF_M:
            yield scan.group


def _off_m(scan: ScanStop, values: Mapping[str, np.ndarray]) -> float:
    """How far half of a scan's beams end from what they meet, at least; infinite if they meet
    nothing."""
    try:
        return scan.rows(values).median_m
    except InputError:
        return np.inf


def _nowhere(source: Source) -> Iterator[tuple[str, str]]:
    """Stops with a scan that are tracked by nothing and guessed by nothing, and where each stands,
    as `standing` has it; none where no stop has a place, as then any will do, or `build` asks."""
    recording = source.recording
    if source.rig.lidar is None or not recording.has_scan.any():
        return
    where = standing(source)
    posed = [b for b in recording.bodies if not start.is_point(source, b)]
    known = np.any([np.zeros(len(where), bool), *(_seen(recording, b) for b in posed)], axis=0)
    names, at = np.unique(where, return_inverse=True)
    unseen = np.setdiff1d(np.arange(len(names)), at[known])
    each = {str(names[i]): np.flatnonzero(at == i) for i in unseen}
    lost = [name for name, stops in each.items() if start.root_pose(source, stops) is None]
    lost = [name for name in lost if start.guessed_pose(source, each[name]) is None]
    for name in lost if len(lost) < len(names) else ():
        yield from ((recording.stops[k], name) for k in each[name] if recording.has_scan[k])
