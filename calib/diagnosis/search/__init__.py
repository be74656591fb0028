"""The search for what is missing: named effects, blunders, and what scatters by chance.

What scatters from stop to stop may be chance: the model gets that scatter, and all is looked at
again beside it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from calib.blunders.judged import LeftOut
from calib.diagnosis.chance import Chance
from calib.diagnosis.screen import ODDS, Candidate
from calib.diagnosis.search.confirmed import (
    anything,
    outdoing,
    outlasts,
    scattering,
    structures,
)
from calib.diagnosis.search.mishaps import restored
from calib.diagnosis.search.named import NamedEffect
from calib.diagnosis.search.parts import in_place, likeliest_part
from calib.diagnosis.search.steps import Steps, chance_leads, left_behind, steps_from
from calib.diagnosis.search.sways import Sways, sways
from calib.diagnosis.stand import Look, Stand, tried
from calib.effects import Effect
from calib.solve.fit import Progress

MOST_NEEDED = 3  # an explanation that needs more names than this is none: a choice


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


def search(stand: Stand, progress: Progress, most: int = MOST_NEEDED) -> Search:
    """Name what is missing, one effect after another, then ask whether that is all.

    Args:
        stand: a fitted model.
        progress: as of `fit.solve`.
        most: how many effects are named at most; with none, blunders are all that is looked for:
            away from an optimum any effect, structure or scatter seems missing.
    """
    steps = plain = steps_from(stand, progress, most)
    if most and not plain[1] and chance_leads(plain[0][-1]):
        plain = steps_from(stand, progress, most, begun=plain)
        steps = plain if _explain_all(plain, progress) else steps
    looks, found, left = steps
    named = [step.effect.family for step in found]
    more = bool(found) and len(found) == most and anything(looks[-1], progress)
    chance, unsettled = list[Chance](), None
    nowhere = [] if plain[2] else [[step.effect.name for step in plain[1]]]
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
            looks, found = left_behind([*looks, look], found)
        else:
            looks, found, left = steps = steps_from(beside, progress, most)
            if instead := _in_place_of_chance(stand, plain[0][0], steps, progress, most, nowhere):
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


def _in_place_of_chance(
    stand: Stand,
    first: Look,
    beside: Steps,
    progress: Progress,
    most: int,
    nowhere: list[list[str]],
) -> Steps | None:
    """What is named from the fit of a stand and effects that were named beside values by chance,
    without these, if that is all there is: such values take in an effect that differs by stop.
    Names that led `nowhere`, no blunders being left out, are not tried again, and added to."""
    _, found, left = beside
    names, clean = [step.effect.name for step in found], not left
    known = clean and any(names == other[: len(names)] for other in nowhere)
    if known or not 0 < len(found) < most:
        return None
    bare = tried(stand.with_effects, [step.effect for step in found], progress)
    if bare is None:
        return None
    looks, more, left = steps_from(bare, progress, most, begun=([bare.look(progress)], found, left))
    steps = *left_behind([first, *looks], more), left
    if len(more) > len(found) and _explain_all(steps, progress):
        return steps
    nowhere += [names] if clean else []
    return None


def _explain_all(steps: Steps, progress: Progress) -> bool:
    """Whether a fit with all that was named has come to its end, and leaves neither structure nor
    values by chance to be found. Then these names stand: effects predict other stops, and values by
    chance do not."""
    (*_, look), found, _ = steps
    left = any(c.found and not c.effect.widens for c in look.chance)
    whole = found and look.stand.estimate.converged and not left
    return bool(whole and not structures(look, progress))
