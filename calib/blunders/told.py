"""Blunders in numbers for scripts and in sentences for people."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from calib.blunders.chance import LEAST_P, at_least
from calib.blunders.judged import TELLING, Blunder, LeftOut
from calib.blunders.reach import FurthestMoved
from calib.problem.beams import same_mesh
from calib.problem.model import Source, labels
from calib.residuals.groups import ALONG_BEAMS, CAD, JOINTS, MESH, SCAN, Group
from calib.residuals.surfaces import part_centre_m
from calib.rig import Rig
from calib.rig.suspect import listed
from sensors.rings import RingFinding

SHOWN = {"m": ("mm", 1e3), "rad": ("mrad", 1e3), "1": ("", 1.0)}
LARGE_SIZE = 1000.0  # mm or mrad, from which on metres and radians are read more easily
# Where an angle of an arm is not as drawn: a choice, ten times what arms are off by at most.
DRAWN_OTHERWISE_RAD = 0.5
SIGN = 0.05  # of twice a value on paper, within which it is off as a wrong sign would have it


def groups(
    looked_at: Iterable[Blunder],
    others: Mapping[str, Mapping[str, float]],
    unseen: Mapping[Group, FurthestMoved],
) -> dict[str, Any]:
    """How far out every group that was looked at is, the size from which a mishap to it, or to what
    is no group of rows, is found, and how far one that is not would move an estimate, as in
    diagnosis.json; of a group that is there twice, as it is at first."""
    first: dict[str, Blunder] = {}
    sizes: dict[str, dict[str, float]] = {}
    for blunder in looked_at:
        first.setdefault(blunder.group.token, blunder)
        if not blunder.shift.of_ranges:  # the size of a scan's shift is that of its place
            sizes.setdefault(blunder.group.token, dict(blunder.detectable))
    return {
        "groups": [
            {
                "token": token,
                "kind": b.group.kind,
                "statistic": b.shift.statistic,
                "dof": b.shift.dof,
                "limit": b.limit,
                "p_value": b.p_value,
                "unseen": unseen[b.group].document() if b.group in unseen else None,
            }
            for token, b in first.items()
        ],
        "detectable": {**sizes, **others},
    }


def document(left: LeftOut, sources: Sequence[Source]) -> dict[str, Any]:
    """A blunder as diagnosis.json has it.

    Args:
        left: it, and what else could be wrong in its place.
        sources: the recordings, of which it is in one.
    """
    blunder, group, shift = left.blunder, left.blunder.group, left.blunder.shift
    size, sigma, unit, axis = blunder.leading()
    of = dict(zip(labels(sources), sources, strict=True)).get(group.recording, sources[0])
    wrong_sign, at_m = _wrong_sign(left, of.rig), _at_m(group, sources)
    return {
        "kind": group.kind,
        "name": group.what,
        "where": group.where,
        "stop": group.stop,
        "recording": group.recording or None,
        "size": size,
        "unit": unit,
        "sigma": sigma,
        "axis": axis or None,
        "at_m": at_m,
        "wrong_sign": wrong_sign,
        "offset": {
            "names": list(shift.axes),
            "units": list(shift.units),
            "estimate": shift.offset,
            "sigma": np.sqrt(np.maximum(np.diag(shift.covariance), 0.0)),
        },
        "p_value": blunder.p_value,
        "p_adjusted": blunder.p_adjusted,
        "detectable": dict(blunder.detectable),
        "indistinguishable_from": [other.token for other in left.rivals],
        "belongs_to": left.belongs.where if left.belongs else None,
        "without": group.token,
        "sentence": _sentence(left, wrong_sign, _about(at_m), _mirrored(left, of)),
    }


def of_rings(lidar: str, recording: str, found: RingFinding) -> dict[str, Any]:
    """Rings with wrong numbers, in the same form; of several recordings, this one is named. As
    sigma, how far off the best numbers leave elevations."""
    said = f"{recording}: {found.sentence}." if recording else whole(found.sentence)
    return {
        **otherwise("rings", lidar, "rings", said),
        "recording": recording or None,
        "size": found.off_rad,
        "unit": "rad",
        "sigma": found.left_rad,
    }


def of_room(frame: str, sentence: str) -> dict[str, Any]:
    """A room, of this frame, that a guess has the wrong way round, in the same form."""
    return otherwise("frame", frame, CAD, whole(sentence))


def not_as_drawn(moved: Mapping[str, Mapping[str, Any]]) -> Iterator[dict[str, Any]]:
    """Angles of an arm that are far from where they are drawn, in the same form: no arm is built so
    far off, and a fit gets there where joints are read otherwise than the URDF has them.

    Args:
        moved: ``prior`` of ``misfit_by`` of a run's summary.
    """
    for name, found in moved.items():
        off_rad = abs(found["change"])
        drawn = found.get("drawn", False) and found["unit"] == "rad"
        if drawn and off_rad > DRAWN_OTHERWISE_RAD:
            group = Group("frame", CAD, name)
            said = (
                f"{group} is {np.degrees(off_rad):.0f} deg from where it is drawn; is each joint "
                "read as the URDF has it? 'rigcal check' tries other signs and orders"
            )
            off = {"size": off_rad, "unit": "rad", "sigma": found["sigma"]}
            yield {**otherwise("frame", name, CAD, whole(said)), **off}


def of_recording(recording: str, other: str) -> dict[str, Any]:
    """One of several recordings of a rig that no fit comes to an optimum with, in the same form.

    Args:
        recording: what it is called.
        other: one that a fit to it alone does.
    """
    said = (
        f"a fit to {recording} alone comes to no optimum, and one to {other} alone does: look for "
        f"what is wrong in {recording} first, by itself"
    )
    found = otherwise("recording", recording, recording, whole(said))
    return {**found, "recording": recording}


@dataclass(frozen=True)
class Elsewhere:
    """Where a part of the mesh is instead: so much farther (m) along the beams or its normal, with
    the sigma of that, NaN where it is not known; and when, in words, if not at all stops."""

    away_m: float
    sigma_m: float
    along: str = ALONG_BEAMS
    when: str = ""

    @property
    def said(self) -> str:
        """In words."""
        size = size_told(abs(self.away_m), self.sigma_m, "m")
        if self.along == ALONG_BEAMS:
            return f"its beams read {size} {'long' if self.away_m > 0 else 'short'}"
        return f"it stands {size} {'farther' if self.away_m > 0 else 'nearer'}"


def of_part(
    name: str, sources: Sequence[Source], off: Elsewhere | None, p: float
) -> dict[str, Any]:
    """A part of the mesh whose beams were rejected, in the same form.

    Args:
        name: as of `Group.what`.
        sources: the recordings.
        off: where they agree on another place.
        p: by chance, all looks paid for.
    """
    group = Group("surface", MESH, name)
    at_m = _at_m(group, sources)
    where, found = f"{group}{_about(at_m)}", {}
    if off is None:
        said = f"beams do not end at {where}, but at all distances, as they do at glass or a mirror"
    else:
        found = {"size": abs(off.away_m), "unit": "m", "sigma": off.sigma_m, "axis": off.along}
        when = f", {off.when}" if off.when else ""
        said = f"{where} is not where it was scanned{when}: {off.said}"
    return {
        **otherwise("surface", name, MESH, whole(said)),
        **found,
        "at_m": at_m,
        "p_value": p,
        "p_adjusted": p,
        "without": group.token,
    }


def of_many_parts(parts: Sequence[str], when: str) -> dict[str, Any]:
    """So many parts of the mesh that seem to have moved that it may not be they that did, in the
    same form; there is nothing to leave out.

    Args:
        parts: as of `Group.what`.
        when: of the first, as of `Elsewhere`.
    """
    since = f", {parts[0]} {when}" if when else ""
    said = (
        f"{len(parts)} parts of the mesh seem to stand elsewhere, {listed(parts)} among them"
        f"{since}: were they moved, was what carries the LiDAR pushed, or is its place at some "
        "stops wrong?"
    )
    return otherwise("surface", "many parts", MESH, whole(said))


def of_scan(scan: Group, said: str) -> dict[str, Any]:
    """A scan of which a clause says what is wrong with it as a whole, in the same form."""
    found = otherwise("scan", scan.what, scan.where, whole(said))
    recording = scan.recording or None
    return {**found, "stop": scan.where, "recording": recording, "without": scan.token}


def otherwise(kind: str, name: str, where: str, sentence: str) -> dict[str, Any]:
    """What was not found as a group of rows, with the keys of `document`."""
    return {
        "kind": kind,
        "name": name,
        "where": where,
        "stop": None,
        "recording": None,
        "axis": None,
        "at_m": None,
        "wrong_sign": None,
        "offset": None,
        **dict.fromkeys(("p_value", "p_adjusted"), LEAST_P),  # what chance does not do
        "detectable": {},
        "indistinguishable_from": [],
        "belongs_to": None,
        "without": None,
        "size": None,
        "unit": None,
        "sigma": None,
        "sentence": sentence,
    }


def whole(clause: str) -> str:
    """A clause, or a question, as a sentence of its own; a name with a dot or the like, with which
    it begins, is left as it is written."""
    begins = clause[0].upper() if clause.partition(" ")[0].isalpha() else clause[0]
    return f"{begins}{clause[1:]}{'' if clause.endswith('?') else '.'}"


def uneven(blunders: Iterable[Blunder]) -> list[str]:
    """What scatters more at some stops than at others, a sentence for each body, and for scans."""
    each = {
        b.group.what: b.uneven
        for b in blunders
        if b.uneven and b.group.kind in ("body", "scan") and not b.shift.of_ranges
    }
    return [
        f"The scatter of {'the place of the LiDAR' if what == SCAN else what} "
        f"{'changes with time' if found.along == 'time' else 'depends on where it is'}: it is "
        f"{found.times:.1f} times as large at some stops as at others (p = "
        f"{at_least(found.p_value):.1g}). All rows of it are weighted alike, which costs precision."
        for what, found in each.items()
    ]


def tokens(blunders: Iterable[Mapping[str, Any]]) -> list[str]:
    """What ``--without`` takes, of blunders as diagnosis.json has them: of all that can be left
    out."""
    return list(dict.fromkeys(each["without"] for each in blunders if each["without"]))


def _at_m(group: Group, sources: Sequence[Source]) -> list[float] | None:
    """About where a part of the mesh is; None of several meshes, whose parts are numbered alike."""
    meshes = [source.reference for source in sources if source.reference is not None]
    if group.where != MESH or any(not same_mesh(mesh, meshes[0]) for mesh in meshes):
        return None
    return part_centre_m(meshes[0], group.what).tolist()


def _about(at_m: Sequence[float] | None) -> str:
    return f" (about {', '.join(f'{m:.1f}' for m in at_m)} m)" if at_m else ""


def _mirrored(left: LeftOut, source: Source) -> str:
    """What may be off in place of a scan that seems to be, as the same rows say: where the tracker
    alone tells where the rig stood, all bodies that it saw there, together. Empty if nothing."""
    group, rig = left.blunder.group, source.rig
    if group.kind != "scan" or left.aside or left.blunder.shift.of_ranges or rig.moves != "stop":
        return ""
    k, bodies = source.recording.stops.index(group.where), source.recording.bodies
    seen = [body for body, poses in bodies.items() if np.isfinite(poses[k, 0])]
    return f"{listed(seen, len(seen), ' and ')} together" if len(seen) > 1 else ""


def _sentence(left: LeftOut, wrong_sign: str | None, about: str, mirrored: str) -> str:
    *size, axis = left.blunder.leading()
    told = axis.startswith(("about ", "along "))
    along = f" {axis}" if told else f" in {axis}" if axis else ""
    along = "" if left.blunder.group.what.endswith(f".{axis}") else along
    sign = f", as if the sign of its {wrong_sign} were wrong" if wrong_sign else ""
    group = str(left.blunder.group)
    group = f"T{group[1:]}" if group.startswith("the ") else group
    verb = "are" if left.blunder.group.what == JOINTS else "is"
    off = f"{size_told(*size)} off{along}, against everything else"
    shift = left.blunder.shift
    if np.all(np.abs(shift.offset) < TELLING * np.sqrt(np.diag(shift.covariance))):
        off = (
            "off in several directions together, none of which is known by itself, against "
            "everything else"
        )
    if not left.blunder.possible:
        off = "so far from everything else that no number tells by how much"
    out = f"{group}{about} {verb} {off}"
    if left.belongs:
        return f"{out}: it was taken at {left.belongs.where}."
    if rivals := [*map(str, left.rivals), *([mirrored] if mirrored else [])]:
        others = ", or ".join(rivals)
        return f"{out}{sign}; or it is {others}: nothing measured here tells them apart."
    return f"{out}{sign}."


def suspect(left: LeftOut) -> str:
    """Of what is furthest out, where a fit without it has no optimum either."""
    return (
        f"Furthest from everything else: {left.blunder.group}. Without it the fit does not "
        "converge either, so it need not be the cause; look at it first. 'rigcal check' tries "
        "signs, axes and columns that may be mixed up in the whole recording."
    )


def size_told(size: float, sigma: float, unit: str) -> str:
    """A size in m or rad and its sigma, as people read it."""
    name, scale = SHOWN.get(unit, (unit, 1.0))
    if name and scale * size >= LARGE_SIZE:
        in_deg = f" ({np.degrees(size):.3g} deg)" if unit == "rad" else ""
        return f"{size:.3g} {unit}{in_deg}"
    known = f" ± {scale * sigma:.2g}" if np.isfinite(sigma) else ""
    return f"{scale * size:.3g}{known} {name}".rstrip()


def _wrong_sign(left: LeftOut, rig: Rig) -> str | None:
    """Which coordinate of a frame on paper is off by twice its own value, if one is."""
    group, shift = left.blunder.group, left.blunder.shift
    tree = rig.tree
    if group.kind != "frame" or group.what not in tree.edge_names:
        return None
    T_parent_child = tree.edges[tree.edge_names.index(group.what)].T_parent_child
    child, sigma = np.zeros(3), np.zeros(3)
    for k, axis in enumerate(("tx", "ty", "tz")):
        if axis in shift.axes:
            at = list(shift.axes).index(axis)
            child[k], sigma[k] = shift.offset[at], np.sqrt(shift.covariance[at, at])
    offset, paper = T_parent_child[:3, :3] @ child, T_parent_child[:3, 3]
    limit = 3.0 * sigma.max() + SIGN * 2 * np.abs(paper)
    like = (np.abs(offset - 2 * paper) < limit) & (np.abs(paper) > 5.0 * sigma.max())
    others_fine = [np.abs(np.delete(offset, i)).max() < limit[i] for i in range(3)]
    found = [axis for i, axis in enumerate("xyz") if like[i] and others_fine[i]]
    return found[0] if len(found) == 1 else None
