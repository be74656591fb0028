"""From one look to named effects: the best explanation is judged, then fitted, then looked past.

A blunder is an explanation like any other: its rows are left out, and the rest is fitted and looked
at again (detection, identification and adaptation: Teunissen 1990).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calib.blunders.judged import Blunder, LeftOut
from calib.diagnosis.candidates import one_more_wave
from calib.diagnosis.screen import ODDS, Candidate
from calib.diagnosis.search.confirmed import (
    ALPHA_EFFECT,
    judged,
    judged_as_fitted,
    suspects,
)
from calib.diagnosis.search.mishaps import adapted, blunders_alone, restored
from calib.diagnosis.search.named import NamedEffect, rivals_of
from calib.diagnosis.search.shapes import retuned
from calib.diagnosis.stand import Look, Stand, tried
from calib.solve.fit import Progress

FEWEST_ALIKE = 2  # stops with a blunder each, for one effect to be asked for in their place
# Of what a test says of an effect, below which a fit does not bear it out: a choice, far below the
# whole that it takes up where the test is right.
HELD_BACK = 0.1
# Of a test that does not confirm an effect of the LiDAR, the p-value before all looks from which it
# is fitted, and tested as it was fitted: by convention. Were no beams rejected for it, that test
# would say the same, as it does of all other effects.
ASKED_AGAIN = 0.05
RIVALS_FITTED = 3  # rivals of a name: a choice, as each takes a fit and a look

Steps = tuple[list[Look], list[NamedEffect], list[LeftOut]]


def steps_from(stand: Stand, progress: Progress, most: int, begun: Steps | None = None) -> Steps:
    """Effects and blunders, one after another, with no more by chance than the model has: the
    looks, and both, as `Search` has them. They end where values by chance lead at first; those that
    have `begun` so go on from there."""
    looks, found, left = map(list, begun or ([stand.look(progress)], [], []))
    trial = True
    while True:
        before, mishaps = looks[-1], len(left)
        looks[-1] = adapted(before, left, progress, bool(found), trial)
        wild = [each.blunder for each in left[mishaps:] if not each.aside]
        if len(found) < most and (more := _one_for_all(before, wild, found, progress)):
            del left[mishaps:]
            found, looks[-1] = more, before
            looks, found = left_behind([*looks, found[-1].after], found)
            continue
        if begun is None and not found and chance_leads(looks[-1]):
            break
        more = _named(looks[-1], found, progress) if len(found) < most else found
        if len(more) > len(found):
            looks, found = left_behind([*looks, more[-1].after], more)
            trial = True
        elif trial and len(found) < most and blunders_alone(looks[-1], progress):
            trial = False
        else:
            break
    if found:
        looks[-1], left, found = restored(stand, looks[-1], left, found, progress)
    return *left_behind(looks, found), left


def left_behind(
    looks: Sequence[Look], found: Sequence[NamedEffect]
) -> tuple[list[Look], list[NamedEffect]]:
    """Looks, and what was found at them; all but the first and the last are thinned, as each holds
    far more than a fit."""
    now = {id(look): look for look in (looks[0], looks[-1])}

    def of(look: Look) -> Look:
        if id(look) not in now:
            now[id(look)] = look.thinned()
        return now[id(look)]

    steps = [replace(s, before=of(s.before), after=of(s.after)) for s in found]
    return [of(each) for each in looks], steps


def chance_leads(look: Look) -> bool:
    """Whether values by chance explain more than any effect or structure does, and than wider
    sigmas, which would take in whatever is missing."""
    every = (*look.named.candidates, *look.unnamed.candidates)
    best = max((c.test.statistic for c in every), default=0.0)
    found = [c for c in look.chance if c.found]
    return bool(found) and not found[0].effect.widens and found[0].statistic > best


def _named(look: Look, found: list[NamedEffect], progress: Progress) -> list[NamedEffect]:
    """What was found, and the best candidate that is confirmed, fitted; with it others may have
    better shapes. Which one is best may change once it is fitted, as rows then scatter less. One
    more wave of a kind that the model has comes after all else."""
    model, every = look.stand.model, suspects(look.named, ALPHA_EFFECT)
    for candidate in sorted(every, key=lambda each: one_more_wave(each.effect, model)):
        if more := _fitted(look, candidate, found, progress):
            return _by_likelier(look, more[-1], found, progress) or more
    return found


def _by_likelier(
    look: Look, step: NamedEffect, found: list[NamedEffect], progress: Progress
) -> list[NamedEffect]:
    """What was found, and a rival that explains more than the effect just named, fitted; nothing
    where there is none.

    That something of the kind is missing is as sure as the effect named first has it. So a rival of
    no more parameters need not be confirmed by itself.
    """
    likelier = step.likelier
    if likelier is None:
        return _by_fits(look, step, found, progress)
    sure = step.p_adjusted if likelier.test.dof <= step.candidate.test.dof else None
    return _fitted(look, likelier, found, progress, sure=sure)


def _by_fits(
    look: Look, step: NamedEffect, found: list[NamedEffect], progress: Progress
) -> list[NamedEffect]:
    """What was found, and of the rivals that explain more than the effect just named the one that
    fits best, if it also fits far better once both are fitted; nothing where none does.

    Four effects of an arm's joints may do nearly the same at a few poses, and a test that leaves
    out stops confirms that of fewest parameters. Links are then off by what tells it from the
    others. That something of the kind is missing is as sure as the effect named first has it.
    """
    some, best = step.doubted_by[:RIVALS_FITTED], []
    least = -ODDS - np.log(max(len(some), 1))  # that of several one fits so much better
    for each in some:
        more = _fitted(look, each, found, progress, sure=step.p_adjusted)
        if more and more[-1].after.stand.estimate.converged:
            odds = step.log_odds(more[-1], progress)
            best, least = (more, odds) if odds < least else (best, least)
    return best


def _one_for_all(
    look: Look, wild: Sequence[Blunder], found: list[NamedEffect], progress: Progress
) -> list[NamedEffect]:
    """What was found, and one effect that leaves none of several blunders a blunder, with fewer
    parameters than they have; nothing where there is none.

    What slips late is seen by few stops, and these may seem to be as many mishaps: a robust fit
    gives them little weight, so an effect explains less than each of them at first.
    """
    if len({(b.group.recording, b.group.stop) for b in wild if b.group.stop}) < FEWEST_ALIKE:
        return []
    for candidate in suspects(look.named, ALPHA_EFFECT):
        fewer = candidate.test.dof < sum(len(b.shift.offset) for b in wild)
        if fewer and (more := _fitted(look, candidate, found, progress, wild)):
            return more
    return []


def _fitted(
    look: Look,
    candidate: Candidate,
    found: list[NamedEffect],
    progress: Progress,
    instead: Sequence[Blunder] = (),
    sure: float | None = None,
) -> list[NamedEffect]:
    """What was found, and a candidate, fitted; nothing where it is not confirmed. One that is tried
    `instead` of blunders is confirmed if it leaves no blunder, at their p-value; where another has
    confirmed what it explains, at that of the other (`sure`)."""
    near, finest = look.closely(candidate, progress)
    test, p = judged(near, finest, progress)
    # Few rows tell of the exact place of what jumps.
    if p >= ALPHA_EFFECT and finest.effect.jumps and finest is not candidate:
        p = min(p, 2.0 * judged(look, candidate, progress)[1])
    p = max((b.p_adjusted for b in instead), default=p if sure is None else min(p, sure))
    again = p >= ALPHA_EFFECT and not instead and finest.effect.of_lidar
    again = again and test.p_value() < ASKED_AGAIN
    if p >= ALPHA_EFFECT and not again:
        return []
    stand = tried(look.stand.with_effects, [finest.effect], progress)
    theta = stand.theta(finest.effect) if stand else 0 * finest.test.estimate()
    if near.named.taken_up(finest, theta) < HELD_BACK:
        return []
    before, finest = look.with_shape(candidate, near, finest)
    names = [*(f.effect.name for f in found), finest.effect.name]
    stand, swapped = retuned(stand, names, progress)
    after = stand.look(progress)
    if again:
        there = swapped.get(finest.effect.name, finest.effect)
        test, p = judged_as_fitted(after, there, 2.0 * finest.looks, progress)  # a second test
        if p >= ALPHA_EFFECT:
            return []
    if instead and any(b.found for b in after.blunders):
        return []
    scale = max(after.named.common, test.inflation)
    step = NamedEffect(
        candidate=replace(finest, p_value=min(test.p_value(), p)),
        before=before,
        after=after,
        judged=test,
        p_adjusted=p,
        rivals=rivals_of(look, candidate, before, finest, scale),
    )
    return [f.with_effect(swapped.get(f.effect.name)) for f in (*found, step)]
