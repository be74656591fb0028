"""The smallest effect, and the smallest mishap, that would be found with some stops."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from calib.blunders.judged import Blunder, judge
from calib.blunders.others import Others
from calib.blunders.reach import FurthestMoved, reaches
from calib.diagnosis.candidates import known_effects
from calib.diagnosis.linear import WIDENED
from calib.effects import Effect, Site
from calib.linear.clusters import Gradients
from calib.linear.layout import Layout
from calib.linear.linearise import linearise
from calib.linear.system import Linearisation
from calib.planning.criteria import found_from
from calib.planning.scene import PlanningScene
from calib.planning.stops import MARK, Poses
from calib.problem import Problem
from calib.problem.unknowns import Key
from calib.residuals.groups import CAD, JOINTS, Group, kind_and_number
from calib.solve.fit import Progress

TARGET_WORDS = {"lower": "lower marker", "upper": "upper marker"}


@dataclass(frozen=True)
class Size:
    """From which size a mishap of a kind is found, m or rad.

    Args:
        median: of all groups of rows of the kind.
        worst: where it hides best.
    """

    median: float
    worst: float

    def document(self) -> dict[str, float]:
        """As JSON has it."""
        return {"median": self.median, "worst": self.worst}


@dataclass(frozen=True)
class Found:
    """What would be found.

    Args:
        effects: effect that the model lacks -> root mean square size of its parameters from which
            it is found, in its unit; infinite where nothing tells it from the model. Those of which
            parameters have several units have no such size.
        units: of these.
        mishaps: what may be off -> unit -> from which size.
        unseen: which estimate a mishap that is not found could move furthest; None without rows.
        by: whose mishap that is, in words.
    """

    effects: Mapping[str, float]
    units: Mapping[str, str]
    mishaps: Mapping[str, Mapping[str, Size]]
    unseen: FurthestMoved | None = None
    by: str = ""

    def furthest(self) -> dict[str, Any] | None:
        """What a mishap that is not found could do, as JSON has it."""
        return {**self.unseen.document(), "by": self.by} if self.unseen else None

    def wider(self, times: Mapping[str, float]) -> Found:
        """The same where some effects are found from so many times the size on."""
        sizes = {name: size * times.get(name, 1.0) for name, size in self.effects.items()}
        return replace(self, effects=sizes)


def would_be_found(
    scene: PlanningScene, poses: Poses | None, sigma: Mapping[Key, float], progress: Progress
) -> Found:
    """What would be found with some stops more; with None of what was measured.

    Args:
        scene: the fit.
        poses: of the stops.
        sigma: of every parameter of the calibration, with them.
        progress: called with what is being done, and how far it is.
    """
    if poses is None and not scene.source.recording.stops:
        return Found(effects={}, units={}, mishaps={})
    progress("what would be found", 0, 2)
    every = _lacking(scene, poses)
    effects = dict(_of_effects(scene, poses, every))
    progress("what would be found", 1, 2)
    planned = {} if poses is None else {f"{MARK}{k}": k + 1 for k in range(len(poses.joints))}
    blunders, unseen = _blunders(scene, poses, planned, sigma)
    checked = {g: each for g, each in unseen.items() if g.where != CAD}
    worst = max(checked, key=lambda g: checked[g].sigmas, default=None)
    units = {name: unit for name, (_, unit) in every.items()}
    return Found(
        effects=effects,
        units=units,
        mishaps=_sizes(blunders),
        unseen=checked.get(worst),
        by=_told(worst, planned) if worst else "",
    )


def _of_effects(
    scene: PlanningScene, poses: Poses | None, every: Mapping[str, tuple[Effect, str]]
) -> Iterator[tuple[str, float]]:
    """Effects that the model lacks, and the size of each from which it is found beside it."""
    wide = replace(scene, added=[effect for effect, _ in every.values()])
    known = wide.now if poses is None else wide.after(poses)
    others = known.at(wide.unbounded)
    for name, (effect, _) in every.items():
        variables = [term.variable for term in wide.terms_of(effect.name)]
        of = known.at(variables)
        size = found_from(known, of, np.setdiff1d(others, of), len(every))
        usual = np.concatenate([wide.problem.variables[v].sigma for v in variables])
        # Beyond this it is paper, widened as it is, that tells the effect, and not the stops.
        most = WIDENED * np.sqrt(np.mean(np.square(usual)))
        yield name, size if size < most else np.inf


def _lacking(scene: PlanningScene, poses: Poses | None) -> dict[str, tuple[Effect, str]]:
    """Family -> one effect of each that moves a mean and that the stops can show, and the one unit
    of its parameters; of those that have a shape the middle one."""
    stand, rig = scene.stand, scene.source.rig
    columns, sources = stand.carried.everywhere, stand.sources
    if not scene.source.recording.stops:  # as planned stops have them
        problem, values, met = scene.together(poses)
        seen = [s.rows(values, m).view for s, m in zip(problem.scans[:1], met, strict=False)]
        sources = problem.sources
        columns = frozenset(sources[0].columns).union(*(view.columns for view in seen))
    families: dict[str, list[Effect]] = {}
    there = {effect.family for effect in stand.model.effects}
    catalogue = [effect for effect in stand.catalogue if effect.family not in there]
    for effect in known_effects(stand.model, sources, columns, catalogue):
        if effect.site is not Site.NOISE and not effect.by_chance:
            families.setdefault(effect.family, []).append(effect)
    middle = {name: some[len(some) // 2] for name, some in families.items()}
    units = {n: {p.unit for p in e.params(rig) if p.sigma} for n, e in middle.items()}
    return {n: (e, *units[n]) for n, e in middle.items() if len(units[n]) == 1}


def _blunders(
    scene: PlanningScene,
    poses: Poses | None,
    planned: Collection[str],
    sigma: Mapping[Key, float],
) -> tuple[list[Blunder], dict[Group, FurthestMoved]]:
    """All groups of rows, and how far a mishap to each that is not found moves an estimate."""
    others = Others.of(*_linear(scene, poses))
    blunders = judge(others, planned)
    known = {key.name: size for key, size in sigma.items()}
    return blunders, reaches(others, blunders, known)


def _linear(scene: PlanningScene, poses: Poses | None) -> tuple[Linearisation, Problem]:
    problem, values, met = scene.together(poses)
    layout = Layout.of(problem, unbounded=scene.unbounded)
    gradients = Gradients(layout.size)
    return linearise(problem, values, met, layout=layout, gradients=gradients), problem


def _sizes(blunders: Sequence[Blunder]) -> dict[str, dict[str, Size]]:
    """Of mishaps by what may be off, and by unit."""
    found: dict[str, dict[str, list[float]]] = {}
    for blunder in blunders:
        for unit, size in {} if blunder.shift.of_ranges else blunder.detectable.items():
            found.setdefault(_kind(blunder.group), {}).setdefault(unit, []).append(size)
    return {
        kind: {u: Size(float(np.median(some)), max(some)) for u, some in by.items()}
        for kind, by in sorted(found.items())
    }


def _kind(group: Group) -> str:
    """What may be off, wherever it is."""
    if group.kind == "surface":
        return f"a {kind_and_number(group.what)[0]} of the mesh"
    if group.kind == "joints":
        return "all joints of a stop" if group.what == JOINTS else "a joint"
    said = {
        "body": group.what,
        "level": group.what,
        "target": f"a target's {TARGET_WORDS.get(group.what, group.what)}",
        "frame": "paper: a frame or a length",
    }
    return said.get(group.kind, f"a {group.kind}")


def _told(group: Group, planned: Mapping[str, int]) -> str:
    """A group in words; of planned stops by their numbers."""
    number = planned.get(group.where)
    return str(replace(group, where=f"planned stop {number}") if number else group)


def effects_document(now: Found, after: Found) -> dict[str, Any]:
    """From which size effects are found, as JSON has it: of those never found, None."""

    def size(found: Found, name: str) -> float | None:
        each = found.effects.get(name, np.inf)
        return each if np.isfinite(each) else None

    return {
        name: {"unit": unit, "now": size(now, name), "after": size(after, name)}
        for name, unit in sorted(after.units.items())
    }


def mishaps_document(now: Found, after: Found) -> dict[str, Any]:
    """From which size mishaps are found, as JSON has it: of those never found, None."""

    def size(found: Found, kind: str, unit: str) -> dict[str, float] | None:
        each = found.mishaps.get(kind, {}).get(unit)
        return each.document() if each else None

    return {
        kind: {u: {"now": size(now, kind, u), "after": size(after, kind, u)} for u in sizes}
        for kind, sizes in after.mishaps.items()
    }
