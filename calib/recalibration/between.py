"""What moved between recordings that one fit takes for the same rig."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

from calib.blunders import told
from calib.blunders.mixed import mixed_targets
from calib.diagnosis.search import Search
from calib.diagnosis.stand import Stand
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
OTHER_FRAME = (
    f"{FIT_EACH}, or give that frame another name in one rig.yaml, if the scanner stood elsewhere"
)


class _Alone(NamedTuple):
    """What one recording alone knows; None where its fit comes to no optimum, or where it `can_fit`
    nothing: it has nothing to start from, or lacks what an effect needs."""

    known: Solution | None
    can_fit: bool
    targets: frozenset[str] = frozenset()
    """Digests of the targets that it rests on."""


def contradictions(
    stand: Stand, found: Search, converged: bool, progress: Progress
) -> list[dict[str, Any]]:
    """What drags all else along, as blunders of `diagnosis.json`: targets that are mixed up, where
    a fit has not converged, or else what recordings contradict each other by.

    Args:
        stand: a model, fitted to all recordings.
        found: what a search of it found.
        converged: whether that fit has an optimum.
        progress: as of `calib.solve.fit.solve`.
    """
    mixed = [] if converged else list(mixed_targets(stand.sources))
    calm = converged and not (found.found or found.unnamed or found.blunders or found.chance)
    return mixed or list(moved_between(stand, found.looks[-1].stand, calm, progress))


def moved_between(
    stand: Stand, last: Stand, calm: bool, progress: Progress
) -> Iterator[dict[str, Any]]:
    """The links that moved between the first recording of a rig and a later one, as blunders of
    `diagnosis.json`: as a fit of the later one, with that of the first as its prior, finds them.
    Where anything is wrong, so of what recordings of different rigs share, as the scanner's frame;
    and where the fit to all has no optimum, recordings that have none by themselves.

    Args:
        stand: a model, fitted to all recordings.
        last: with what it was found to lack. What scatters by chance is none of that here: a link
            that moved once seems to.
        calm: whether the fit to all has an optimum, and nothing was found that it lacks.
        progress: as of `calib.solve.fit.solve`.
    """
    chance = {e.name for e in last.model.effects if e.by_chance} - set(stand.model.names)
    model = replace(last.model.minus(list(chance)), moved={})
    named = dict(zip(labels(last.sources), last.sources, strict=True))
    of_rigs: dict[str, list[str]] = {}
    for label, source in named.items():
        of_rigs.setdefault(source.rig.name, []).append(label)
    alarm = ALARM / max(1, len(named) - (len(of_rigs) if calm else 1))
    of_all: tuple[str, _Alone] | None = None  # the first recording, of whatever rig
    for rig, mine in of_rigs.items():
        if len(mine) == 1 and (calm or len(of_rigs) == 1):
            continue
        ask = mine[:1] if stand.estimate.converged else mine
        alone = {label: _alone(model, named[label], progress) for label in ask}
        first = next((label for label, each in alone.items() if each.known), None)
        if first is None:
            continue
        bad = [label for label, each in alone.items() if each.can_fit and not each.known]
        yield from (told.of_recording(label, first) for label in bad)
        for label in (each for each in mine if each not in (first, *bad)):
            for link in _since(alone[first], model, named[label], alarm, progress):
                yield _told(named, first, label, link, f"{rig}/" if len(of_rigs) > 1 else "")
        if of_all is not None and not calm:
            common = _shared(stand, of_all[0], first)
            for link in _since(of_all[1], model, named[first], alarm, progress, common):
                yield _told(named, of_all[0], first, link)
        of_all = of_all or (first, alone[first])


def _shared(stand: Stand, *of: str) -> set[str]:
    """Unknowns of the hardware that recordings, called so, have in common in a fit to all."""
    problem = stand.problem
    every = zip(labels(problem.sources), problem.sources, problem.terms, strict=True)
    each = [
        {source.rig.reference_frame, *(term.variable for term in terms if not term.rig)}
        for label, source, terms in every
        if label in of
    ]
    return set.intersection(*each)


def _told(
    named: Mapping[str, Source], first: str, later: str, link: Link, rig: str = ""
) -> dict[str, Any]:
    """As a blunder, by the parameter, or the mean of them, that shows it best."""
    best = link.parameters.index(link.shown_by)
    way = link.parameters[best], link.change[best], link.sigma[best], link.units[best]
    if link.of_mean:
        way = "all alike", *link.of_mean, link.units[0]
    frame = named[later].rig.reference_frame
    return told.of_link(
        first,
        later,
        frame if link.name == frame else f"{rig}{link.name}",
        way,
        p=link.p_value,
        instead=[f"{rig}{name}" for name in link.instead],
        remedy=OTHER_FRAME if link.name == frame else FIT_EACH,
    )


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
    targets = frozenset(source.measured_targets.values())
    return _Alone(solution_of(problem, estimate, known), can_fit=True, targets=targets)


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
        prior = earlier(problem, first.known, first.targets)
        if common is not None:
            prior = prior.of(common)
        estimate, _, _, links = solve_from(problem, model, prior, progress, alarm)
    except InputError:
        return []
    return [link for link in links if link.moved] if estimate.converged else []
