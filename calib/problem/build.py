"""From a model and its recordings to a problem; and the shapes of the model's effects there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from calib.effects import Effect, ShapeStep, View
from calib.forward import Term
from calib.problem.beams import Progress, add_beams
from calib.problem.bodies import add_bodies, add_levels, add_targets
from calib.problem.model import Model, Source, labels
from calib.problem.places import Places
from calib.problem.problem import Problem, SourceStops
from calib.problem.unknowns import Owner, Role, Unknown, vector_unknown
from calib.residuals.groups import CAD
from calib.residuals.surfaces import Meeting
from calib.rig import Rig
from calib.rig.suspect import listed
from chains.errors import InputError

# m, and in rotations: files that were written with angles to a thousandth of a degree are the same,
# and no sigma of a frame is as small.
SAME_CAD = 2e-5
FREE_SIGMA = 1.0  # m or rad: what is known of a value on paper that is left out, the rig's own size


def build(
    sources: Sequence[Source],
    model: Model,
    use: Sequence[np.ndarray] | None = None,
    meetings: Mapping[int, Meeting] | None = None,
    progress: Progress = lambda what, done, total: None,
) -> Problem:
    """The problem of a model on its recordings.

    Args:
        sources: the recordings.
        model: what is estimated.
        use: per source, (K,) bool, which stops take part; all where None.
        meetings: per source, what beams meet, where another problem has found that already.
        progress: called with what is being done, how many stops are done, and of how many.

    Raises:
        InputError: the recording has nothing to start from, lacks what an effect needs, or leaves
            nothing to estimate.
    """
    _refuse_other_cad(sources)
    several = len({s.rig.name for s in sources}) > 1
    terms = with_members([model.terms(s.rig, several) for s in sources], sources)
    problem = Problem(sources, terms)
    problem.meetings.update(meetings or {})
    for source, terms in zip(sources, problem.terms, strict=True):
        for term in (t for t in terms if not t.effect.widens):
            unknown = effect_unknown(term, source)
            _refuse_other_hardware(problem.variables.get(unknown.name), unknown, source)
            unknown = unknown.loosened(model.moved.get(unknown.name, 0.0))
            params = term.effect.params(source.rig)
            problem.add(unknown, np.array([params[i].start for i in term.free], float))
            if unknown.role is Role.CALIBRATION:
                problem.calibration.append(unknown.name)
    problem.calibration = list(dict.fromkeys(problem.calibration))
    for i, (source, label) in enumerate(zip(sources, labels(sources), strict=True)):
        chosen = np.ones(len(source.recording.stops), bool) if use is None else use[i]
        prefix = "" if len(sources) == 1 else f"{i}/"
        part = SourceStops(
            number=i,
            source=source,
            terms=problem.terms[i],
            chosen=chosen,
            prefix=prefix,
            label=label,
        )
        places = Places(problem, part, model)
        add_bodies(problem, part, places)
        add_targets(problem, part, places)
        add_levels(problem, part, places)  # rods show where down is whatever the rig's pose
        if part.has_lidar:
            add_beams(problem, part, places, progress)
    if not problem.calibration:
        raise InputError(
            f"{sources[0].rig.name}: there is nothing to estimate: no frame with a sigma, no arm "
            "and no LiDAR, or all of it is held"
        )
    return problem


def _refuse_other_cad(sources: Sequence[Source]) -> None:
    """Refuse recordings whose rigs have one name, and differ in where CAD has their frames: what is
    estimated is how far these are from there."""
    first: dict[str, Source] = {}
    for source in sources:
        other = first.setdefault(source.rig.name, source)
        if other is source:
            continue
        mine, theirs = (
            dict(zip(rig.tree.edge_names, rig.tree.edges, strict=True))
            for rig in (source.rig, other.rig)
        )
        for name in (n for n in mine if n in theirs):
            poses = mine[name].T_parent_child, theirs[name].T_parent_child
            if not np.allclose(*poses, rtol=0.0, atol=SAME_CAD):
                raise InputError(
                    f"{source.recording.folder}: rig.yaml, or its URDF, has {name} elsewhere than "
                    f"that of {other.recording.folder}, and both are of rig '{source.rig.name}'; "
                    "give both the right one, or call one rig otherwise"
                )


def _refuse_other_hardware(known: Unknown | None, unknown: Unknown, source: Source) -> None:
    """Refuse a recording whose rig has a name, but not the hardware, of one before it."""
    if known is not None and known.dofs != unknown.dofs:
        of_one = sorted(set(known.dofs) ^ set(unknown.dofs)) or ["in another order"]
        raise InputError(
            f"{source.recording.folder}: {unknown.owner.effect} has other parameters here than in "
            f"a recording before it ({listed(of_one)}), so LiDAR, arm or labels are others; call "
            f"this rig otherwise in rig.yaml than '{source.rig.name}', or fit each alone"
        )


def effect_unknown(term: Term, source: Source) -> Unknown:
    """The vector of an effect's free parameters, about zero; what is left out of paper is free."""
    params = term.effect.params(source.rig)
    params = [params[i] for i in term.free]
    lacks, name = source.lacks("frame"), term.effect.name
    free = [not lacks.isdisjoint({(CAD, name), (CAD, f"{name}.{p.name}")}) for p in params]
    return vector_unknown(
        term.variable,
        np.where(free, FREE_SIGMA, [p.sigma for p in params]),
        dofs=(p.name for p in params),
        units=(p.unit for p in params),
        role=Role.SCATTER if term.effect.by_chance else Role.CALIBRATION,
        owner=Owner(effect=name, rig=term.rig),
        of_members=term.effect.of_members,
    )


def with_members(terms: Sequence[Sequence[Term]], sources: Sequence[Source]) -> list[list[Term]]:
    """Terms of each source, those by chance with a parameter for every member of its group, in all
    recordings that share their spread."""
    labelled = [f"{label}/" if label else "" for label in labels(sources)]
    members: dict[str, list[str]] = {}
    for some, source, label in zip(terms, sources, labelled, strict=True):
        for term in (t for t in some if t.effect.by_chance and not t.effect.widens):
            names = source.columns[term.effect.per].tolist()
            members.setdefault(term.variable, []).extend(f"{label}{name}" for name in names)

    def bound(term: Term, label: str, rig: Rig) -> Term:
        if term.variable not in members:
            return term
        effect = term.effect.among(members[term.variable], label)
        return replace(term, effect=effect, free=np.arange(len(effect.params(rig))))

    rigs = [source.rig for source in sources]
    return [
        [bound(t, label, rig) for t in some]
        for some, label, rig in zip(terms, labelled, rigs, strict=True)
    ]


def shapes_of(effect: Effect, sources: Sequence[Source]) -> list[float]:
    """The shapes worth trying, ascending. Of several recordings, as of times at which something
    slipped, no more than of the one that has most: evenly among those of all."""
    each = [effect.shapes(stops_view(source)) for source in sources]
    every = sorted(set().union(*each))
    chosen = np.linspace(0, len(every) - 1, max(map(len, each))).round().astype(int)
    return [every[i] for i in np.unique(chosen)]


def stops_view(source: Source) -> View:
    """The stops of a recording as effects see them."""
    count = len(source.recording.stops)
    return View(source.rig, count, source.columns, source.recording.joints)


def shape_steps(
    problem: Problem, model: Model, values: Mapping[str, np.ndarray]
) -> list[ShapeStep]:
    """What moves the shapes of a model's effects, at a state.

    Before any data a shape is anywhere among those worth trying, evenly in its logarithm.
    """
    return [
        ShapeStep(effect, theta_of(problem, effect, values), _width(effect, problem.sources))
        for effect in model.effects
        if effect.has_derivative_by_shape
    ]


def theta_of(
    problem: Problem, effect: Effect, values: Mapping[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """Parameters (P,) of an effect at a state, those that are held included, by the rig's name."""
    found = {}
    for terms, source in zip(problem.terms, problem.sources, strict=True):
        for term in (t for t in terms if t.effect.name == effect.name):
            theta = np.zeros(len(effect.params(source.rig)))
            theta[term.free] = values[term.variable]
            found[source.rig.name] = theta
    return found


def _width(effect: Effect, sources: Sequence[Source]) -> float:
    """Standard deviation of the logarithm of a shape that is anywhere among those worth trying."""
    tried = [shape for shape in (*shapes_of(effect, sources), effect.shape) if shape > 0]
    return float(np.log(max(tried, default=1.0) / min(tried, default=1.0)) / np.sqrt(12.0))
