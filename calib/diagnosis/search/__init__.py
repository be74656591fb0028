"""From one look to a named effect: the best explanation is judged, then fitted, then looked past.

What scatters from stop to stop may be chance: the model gets that scatter, and all is looked at
again beside it. A blunder is an explanation like any other: its rows are left out, and the rest is
fitted and looked at again (detection, identification and adaptation: Teunissen 1990).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from calib.blunders.judged import Blunder, LeftOut
from calib.diagnosis.candidates import one_more_wave
from calib.diagnosis.chance import Chance
from calib.diagnosis.screen import ODDS, Candidate
from calib.diagnosis.search.confirmed import (
    ALPHA_EFFECT,
    anything,
    judged,
    outdoing,
    outlasts,
    scattering,
    structures,
    suspects,
)
from calib.diagnosis.search.mishaps import adapted, blunders_alone, restored
from calib.diagnosis.search.named import NamedEffect, rivals_of
from calib.diagnosis.search.parts import in_place, likeliest_part
from calib.diagnosis.search.shapes import retuned
from calib.diagnosis.search.sways import Sways, sways
from calib.diagnosis.stand import Look, Stand, tried
from calib.effects import Effect
from calib.solve.fit import Progress

MOST_NEEDED = 3  # an explanation that needs more names than this is none: a choice
FEWEST_ALIKE = 2  # stops with a blunder each, for one effect to be asked for in their place
# Of what a test says of an effect, below which a fit does not bear it out: a choice, far below the
# whole that it takes up where the test is right.
HELD_BACK = 0.1


@dataclass(frozen=True)
class Search:
    """What was found, step by step.

    Args:
        looks: from the fit as it was, or without the blunders found in it, and after each effect.
        found: named effects, in the order in which they were added.
        blunders: what was left out, in that order.
        unnamed: structure that is confirmed after all of them, strongest first.
        scatter: the effect on the scatter that is confirmed, if one is.
        at_first: structure that is confirmed before any of them; empty, as not asked for, unless
            the first of them is dressed up, or stops that were held out speak against it.
        chance: what scatters by chance beside all that was found, strongest first.
        unsettled: what scatters beside that, and with which no fit comes to an optimum.
        beside: the last look, where blunders were judged beside formulas; see `beside_formulas`.
        scatter_judged: whether what scatters by chance was judged there, too.
        sways: the base, if its moves explain what seems to scatter.
        more: whether as many are named as are at once, and another is confirmed.
    """

    looks: Sequence[Look]
    found: Sequence[NamedEffect]
    blunders: Sequence[LeftOut]
    unnamed: Sequence[Candidate]
    scatter: Candidate | None
    at_first: Sequence[Candidate] = ()
    chance: Sequence[Chance] = ()
    unsettled: Chance | None = None
    beside: Look | None = None
    scatter_judged: bool = False
    sways: Sways | None = None
    more: bool = False

    def dressed_up(self, i: int) -> bool:
        """Whether residual structure would have explained more than the i-th name did."""
        common, step = self.looks[-1].named.common, self.found[i]
        named = likeliest_part(step.before, step.candidate, common).evidence(common)
        whole = step.candidate.test.statistic
        bins = (e for _, e in in_place(whole, step.before, step.after, common))
        return named < max(bins, default=0.0) - ODDS


Steps = tuple[list[Look], list[NamedEffect], list[LeftOut]]


def _left_behind(
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


def search(stand: Stand, progress: Progress, most: int = MOST_NEEDED) -> Search:
    """Name what is missing, one effect after another, then ask whether that is all.

    Args:
        stand: a fitted model.
        progress: as of `fit.solve`.
        most: how many effects are named at most; with none, blunders are all that is looked for:
            away from an optimum any effect, structure or scatter seems missing.
    """
    steps = plain = _steps(stand, progress, most)
    if most and not plain[1] and _chance_leads(plain[0][-1]):
        plain = _steps(stand, progress, most, begun=plain)
        steps = plain if _explain_all(plain, progress) else steps
    looks, found, left = steps
    named = [step.effect.family for step in found]
    more = bool(found) and len(found) == most and anything(looks[-1], progress)
    chance, unsettled = list[Chance](), None
    while most and (strongest := next((c for c in looks[-1].chance if c.found), None)):
        others = [c for c in looks[-1].chance if c.found and c is not strongest]
        as_much = outdoing(looks[-1], strongest.statistic)
        chance.append(strongest)
        widens = strongest.effect.widens
        base = looks[-1].stand if widens else stand
        added = [c.effect for c in chance[-1 if widens else 0 :]]
        beside = tried(base.with_effects, added, progress)
        if beside is None or not beside.estimate.converged:
            unsettled = chance.pop()
            break
        if widens:
            look, left, found = restored(stand, beside.look(progress), left, found, progress)
            look, found = _outlasting(look, found, progress)
            looks, found = _left_behind([*looks, look], found)
        else:
            looks, found, left = steps = _steps(beside, progress, most)
            if instead := _in_place_of_chance(stand, plain, steps, progress, most):
                (looks, found, left), chance = instead, []
                continue
        effects = [e for e in as_much if e.family not in {s.effect.family for s in found}]
        rivals = [*_alike(strongest, others, looks[-1]), *effects]
        chance[-1] = replace(strongest, rivals=tuple(dict.fromkeys(e.name for e in rivals)))
    last = looks[-1]
    done = Search(
        looks=looks,
        found=found,
        blunders=left,
        unnamed=structures(last, progress) if most else (),
        scatter=scattering(last, progress) if most else None,
        chance=last.still(chance),
        unsettled=unsettled,
        more=more and [step.effect.family for step in found] == named,
    )
    by_chance = [*done.chance, *([done.unsettled] if done.unsettled else [])]
    done = replace(done, sways=sways(done.looks[-1].stand, by_chance, progress))
    if done.chance and done.unnamed and structures(plain[0][0], progress):
        done = _without_chance(done, plain, progress)
    if done.found and done.dressed_up(0):
        return replace(done, at_first=structures(done.looks[0], progress))
    return done


def _alike(strongest: Chance, others: Sequence[Chance], beside: Look) -> list[Effect]:
    """Others that scatter by chance as much as the strongest, or that nothing is left of once it is
    in the model, as a look beside it has them."""
    tested, least = {c.effect.name for c in beside.chance}, strongest.statistic - 2 * ODDS
    near = [c.effect for c in others if c.statistic > least]
    return [*near, *(c.effect for c in others if c.effect.name not in tested)]


def _outlasting(
    look: Look, found: list[NamedEffect], progress: Progress
) -> tuple[Look, list[NamedEffect]]:
    """A look beside scatter that was found after some effects, and those of these that explain more
    than chance beside it; without the others, which looks after kept ones are without as well."""
    kept = [step for step in found if outlasts(look, step.candidate)]
    out = [step.effect for step in found if step not in kept]
    gone, families = [effect.name for effect in out], {effect.family for effect in out}
    less = tried(look.stand.lacking, gone, progress) if gone else None
    if less is None or not less.estimate.converged:
        return look, found
    steps: list[NamedEffect] = []
    for step in kept:
        stays = {each.effect.name for each in kept}  # of others there may be earlier shapes
        every = (e for e in step.after.stand.model.effects if e.family in families)
        there = [e.name for e in every if e.name not in stays]
        bare = tried(step.after.stand.lacking, there, progress) if there else None
        steps.append(replace(step, after=bare.look(progress)) if bare else step)
    return less.look(progress), steps


def nameless(done: Search, progress: Progress) -> Search:
    """A search without its names: what scatters by chance, alone. The same where a fit without them
    comes to no end, or structure is found in their place."""
    names = [step.effect.name for step in done.found]
    less = tried(done.looks[-1].stand.lacking, names, progress)
    if less is None or not less.estimate.converged:
        return done
    look = less.look(progress)
    if structures(look, progress):
        return done
    return replace(
        done,
        looks=[done.looks[0], look],
        found=(),
        scatter=scattering(look, progress),
        chance=look.still(done.chance),
        more=False,
    )


def beside_formulas(done: Search, stand: Stand, whole: bool, progress: Progress) -> Search:
    """A search whose blunders, and whose scatter by chance, are those beside its names and formulas
    of the structure that these leave: scatter and mishaps take in much of a structure that a model
    lacks. Its looks and its names stay: they are what the formulas were found beside. Where more
    is missing beside them, scatter stays to be judged.

    Args:
        done: the search.
        stand: a fit with these names and formulas, of all rows.
        whole: whether stops held out are predicted as well as chance lets them beside these.
        progress: as of `fit.solve`.
    """
    again = search(stand, progress)
    done = replace(done, blunders=again.blunders, beside=again.looks[-1])
    if not whole or again.found:
        return done
    by_chance = {n: getattr(again, n) for n in ("chance", "unsettled", "sways")}
    return replace(done, **by_chance, scatter_judged=True)


def _without_chance(done: Search, steps: Steps, progress: Progress) -> Search:
    """The same without values by chance in the model, if structure is left then: values by stop
    take in most of a structure that differs from stop to stop, and what still stands beside them
    would seem to be a trace."""
    looks, found, left = steps
    if not (unnamed := structures(looks[-1], progress)):
        return done
    scatter = scattering(looks[-1], progress)
    return replace(done, looks=looks, found=found, blunders=left, unnamed=unnamed, scatter=scatter)


def _steps(stand: Stand, progress: Progress, most: int, begun: Steps | None = None) -> Steps:
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
            looks, found = _left_behind([*looks, found[-1].after], found)
            continue
        if begun is None and not found and _chance_leads(looks[-1]):
            break
        more = _named(looks[-1], found, progress) if len(found) < most else found
        if len(more) > len(found):
            looks, found = _left_behind([*looks, more[-1].after], more)
            trial = True
        elif trial and len(found) < most and blunders_alone(looks[-1], progress):
            trial = False
        else:
            break
    if found:
        looks[-1], left, found = restored(stand, looks[-1], left, found, progress)
    return *_left_behind(looks, found), left


def _chance_leads(look: Look) -> bool:
    """Whether values by chance explain more than any effect or structure does, and than wider
    sigmas, which would take in whatever is missing."""
    every = (*look.named.candidates, *look.unnamed.candidates)
    best = max((c.test.statistic for c in every), default=0.0)
    found = [c for c in look.chance if c.found]
    return bool(found) and not found[0].effect.widens and found[0].statistic > best


def _in_place_of_chance(
    stand: Stand, plain: Steps, beside: Steps, progress: Progress, most: int
) -> Steps | None:
    """What is named from the fit of a stand and effects that were named beside values by chance,
    without these, if that is all there is: such values take in an effect that differs by stop.
    Nothing where the plain steps, which left something to find, began with the same names."""
    (first, *_), named, wild = plain
    _, found, left = beside
    names = [step.effect.name for step in found]
    begun_so = names == [step.effect.name for step in named[: len(found)]]
    if not 0 < len(found) < most or (begun_so and not (wild or left)):
        return None
    bare = tried(stand.with_effects, [step.effect for step in found], progress)
    if bare is None:
        return None
    looks, more, left = _steps(bare, progress, most, begun=([bare.look(progress)], found, left))
    steps = *_left_behind([first, *looks], more), left
    return steps if len(more) > len(found) and _explain_all(steps, progress) else None


def _explain_all(steps: Steps, progress: Progress) -> bool:
    """Whether a fit with all that was named has come to its end, and leaves neither structure nor
    values by chance to be found. Then these names stand: effects predict other stops, and values by
    chance do not."""
    (*_, look), found, _ = steps
    left = any(c.found and not c.effect.widens for c in look.chance)
    whole = found and look.stand.estimate.converged and not left
    return bool(whole and not structures(look, progress))


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
        return []
    sure = step.p_adjusted if likelier.test.dof <= step.candidate.test.dof else None
    return _fitted(look, likelier, found, progress, sure=sure)


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
    if p >= ALPHA_EFFECT:
        return []
    stand = tried(look.stand.with_effects, [finest.effect], progress)
    theta = stand.theta(finest.effect) if stand else 0 * finest.test.estimate()
    if near.named.taken_up(finest, theta) < HELD_BACK:
        return []
    before, finest = look.with_shape(candidate, near, finest)
    names = [*(f.effect.name for f in found), finest.effect.name]
    stand, swapped = retuned(stand, names, progress)
    after = stand.look(progress)
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
