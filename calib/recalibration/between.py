"""What moved between recordings that one fit takes for the same rig."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

from calib.blunders.chance import at_least
from calib.blunders.mixed import mixed_targets
from calib.blunders.told import of_recording, otherwise, size_told, whole
from calib.diagnosis.search import Search
from calib.diagnosis.stand import Stand
from calib.effects.rig import DOF
from calib.problem import build
from calib.problem.model import Model, Source, labels
from calib.recalibration.letgo import ALARM
from calib.recalibration.links import Link
from calib.recalibration.prior import earlier
from calib.recalibration.refit import solve_from
from calib.results.errors import errors_at
from calib.results.intervals import intervals
from calib.results.sigmas import widened
from calib.results.solution import Solution, solution_of
from calib.solve.fit import Progress, shapes_freed, solve
from chains.errors import InputError

FIT_EACH = "fit each alone, the later with the run of the first as its --prior"
FIT_APART = "fit each alone"
OTHER_FRAME = "give that frame another name in one rig.yaml, if the scanner stood elsewhere"


class _Alone(NamedTuple):
    """What one recording alone knows; None where its fit comes to no optimum, or where it `can_fit`
    nothing: it has nothing to start from, or lacks what an effect needs."""

    known: Solution | None
    can_fit: bool
    targets: frozenset[str] = frozenset()
    """Digests of the targets that it rests on."""


def contradictions(
    stand: Stand,
    found: Search,
    converged: bool,
    progress: Progress,
    numbered: Collection[str] = (),
) -> list[dict[str, Any]]:
    """What everything else that stands out may follow from, as blunders of `diagnosis.json`:
    targets that are mixed up, where a fit has not converged, or else what recordings contradict
    each other by.

    Args:
        stand: a model, fitted to all recordings.
        found: what a search of it found.
        converged: whether that fit has an optimum.
        progress: as of `calib.solve.fit.solve`.
        numbered: recordings, by their labels, whose rings have other numbers than those of others:
            what each ring has of its own differs for that.
    """
    mixed = [] if converged else list(mixed_targets(stand.sources))
    calm = converged and not (found.found or found.unnamed or found.blunders or found.chance)
    moved = moved_between(stand, found.looks[-1].stand, calm, progress, numbered)
    return mixed or list(moved)


def moved_between(
    stand: Stand, last: Stand, calm: bool, progress: Progress, numbered: Collection[str] = ()
) -> Iterator[dict[str, Any]]:
    """The links that moved between the first recording of a rig and a later one, as blunders of
    `diagnosis.json`: as a fit of the later one, with that of the first as its prior, finds them.
    Where anything is wrong, it is also asked what moved of the parts that rigs of other names
    share, as the scanner's frame. Where the fit to all has no optimum, recordings that have none
    by themselves are named as well.

    Args:
        stand: a model, fitted to all recordings.
        last: with what it was found to lack. What scatters by chance is none of that here: a link
            that moved once seems to.
        calm: whether the fit to all has an optimum, and nothing was found that it lacks.
        progress: as of `calib.solve.fit.solve`.
        numbered: as of `contradictions`.
    """
    chance = {e.name for e in last.model.effects if e.by_chance} - set(stand.model.names)
    model = replace(last.model.minus(list(chance)), moved={})
    by_ring = {effect.name for effect in model.effects if "ring" in effect.covariates}
    of_day = {effect.name for effect in model.effects if effect.goes_with_time}
    named = dict(zip(labels(last.sources), last.sources, strict=True))
    of_rigs: dict[str, list[str]] = {}
    for label, source in named.items():
        of_rigs.setdefault(source.rig.name, []).append(label)
    alarm = ALARM / max(1, len(named) - (len(of_rigs) if calm else 1))
    firsts: dict[str, _Alone] = {}  # of rigs before, to compare with
    for mine in of_rigs.values():
        before = next((label for label in firsts if _shared(stand, label, mine[0])), None)
        if len(mine) == 1 and (calm or len(of_rigs) == 1):
            continue
        alone = {}
        if len(mine) > 1 or before is None or not stand.estimate.converged:
            ask = mine[:1] if stand.estimate.converged else mine
            alone = {label: _alone(model, named[label], progress) for label in ask}
        bad = [label for label, each in alone.items() if each.can_fit and not each.known]
        first = next((label for label in mine if label not in alone or alone[label].known), None)
        yield from (of_recording(label, first or before) for label in bad if first or before)
        if first is None:
            continue
        for label in (each for each in mine if each not in (first, *bad)):
            for link in _since(alone[first], model, named[label], alarm, progress):
                if link.name in by_ring and not {first, label}.isdisjoint(numbered):
                    continue
                told = _told(stand, first, label, link, FIT_EACH)
                yield told if link.name not in of_day else _of_one_day(told, first)
        if before is not None:
            common = _shared(stand, before, first)
            for link in _since(firsts[before], model, named[first], alarm, progress, common):
                yield _told(stand, before, first, link, FIT_APART)
        if first in alone and not calm:
            firsts[first] = alone[first]


def _shared(stand: Stand, *of: str) -> set[str]:
    """Unknowns of the hardware that recordings, called so, have in common in a fit to all."""
    each = [{*_names_in_all(stand, label).values()} for label in of]
    return set.intersection(*each)


def _names_in_all(stand: Stand, label: str) -> dict[str, str]:
    """What the unknowns of a recording's hardware are called when it is fitted alone -> in a fit to
    all."""
    problem = stand.problem
    i = labels(problem.sources).index(label)
    frame = problem.sources[i].rig.reference_frame
    own = {term.effect.name: term.variable for term in problem.terms[i]}
    return own | ({frame: frame} if frame in problem.variables else {})


def _told(stand: Stand, first: str, later: str, link: Link, remedy: str) -> dict[str, Any]:
    """A link that moved between two recordings that one fit takes for the same, as a blunder: by
    its parameter that shows it best, had that alone moved, or by how much all changed alike.

    Args:
        stand: of that fit.
        first, later: what the recordings are called.
        link: it.
        remedy: what to do, a clause.
    """
    names, unit = _names_in_all(stand, later), link.units[link.parameters.index(link.shown_by)]
    axis, (change, sigma) = link.shown_by, link.alone
    if link.of_mean:
        axis, (change, sigma) = "all alike", link.of_mean
    name, *instead = (names.get(each, each) for each in (link.name, *link.instead))
    if link.name in {source.rig.reference_frame for source in stand.sources}:
        remedy = f"{remedy}, or {OTHER_FRAME}"
    by = f"{axis} by {'-' if change < 0 else ''}{size_told(abs(change), sigma, unit)}"
    other = f" (or, in its place, {' or '.join(instead)})" if instead else ""
    said = (
        f"between {first} and {later} {name} {'moved' if axis in DOF else 'changed'}, {by}{other}, "
        f"and one fit takes it for the same; {remedy}"
    )
    return {
        **otherwise("frame", name, later, whole(said)),
        "recording": later,
        "size": abs(change),
        "unit": unit,
        "sigma": sigma,
        "axis": axis,
        "p_value": at_least(link.p_value),
        "p_adjusted": at_least(link.p_value),
        "indistinguishable_from": instead,
    }


def _of_one_day(told: Mapping[str, Any], first: str) -> dict[str, Any]:
    """The same of what goes with time, and so with one recording's: in a fit of several it has one
    time for all, and so neither its time nor its size.

    Args:
        told: as of `_told`, with the name that it has in that fit.
        first: what the first recording is called.
    """
    name, later = told["name"], told["recording"]
    said = (
        f"{name} belongs to {later} alone, or has another size there than in {first}, and one fit "
        f"takes it for the same; {FIT_APART}, which tells its time and size"
    )
    return {**told, "sentence": whole(said)} | dict.fromkeys(("size", "unit", "sigma", "axis"))


def _alone(model: Model, source: Source, progress: Progress) -> _Alone:
    """Of a recording, fitted by itself."""
    try:
        problem = build([source], model)
        estimate = solve(problem, progress=progress)
    except InputError:
        return _Alone(None, can_fit=False)
    if not estimate.converged:
        return _Alone(None, can_fit=True)
    seen = errors_at(estimate.problem, estimate.values)
    known = widened(intervals(shapes_freed(estimate, model), progress), estimate, seen)
    solution = solution_of(problem, estimate, known)
    return _Alone(solution, can_fit=True, targets=source.counted_targets)


def _since(
    first: _Alone,
    model: Model,
    source: Source,
    alarm: float,
    progress: Progress,
    common: Collection[str] | None = None,
) -> list[Link]:
    """The links that moved from what a first recording tells to another; none where this cannot be
    fitted; of all that both have, or of some unknowns alone; other arguments as of `let_go`."""
    try:
        problem = build([source], model)
        prior = earlier(problem, first.known, first.targets, common)
        estimate, _, _, links = solve_from(problem, model, prior, progress, alarm)
    except InputError:
        return []
    return [link for link in links if link.moved] if estimate.converged else []
