"""Rows that nothing but a mishap explains are left out, and the rest is looked at again: detection,
identification and adaptation (Teunissen 1990)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from calib.blunders.aside import stray_scans
from calib.blunders.judged import Blunder, LeftOut
from calib.blunders.shifts import standing_alone
from calib.diagnosis.screen import ODDS
from calib.diagnosis.search.confirmed import (
    ALPHA_EFFECT,
    ALPHA_UNNAMED,
    stands_out,
    structures,
)
from calib.diagnosis.search.named import NamedEffect
from calib.diagnosis.search.shapes import retuned
from calib.diagnosis.stand import Look, Stand, tried
from calib.residuals.groups import CAD, JOINTS, MESH
from calib.solve.fit import Progress

ADAPTED, MENDED = 8, 2  # rounds of leaving out; of 76 fits without optimum one was mended, in two
# Of the leading blunder's evidence, from which others at other places are left out with it: a
# choice; what is left over is found by the next look.
AS_FAR = 0.1


def adapted(
    look: Look, left: list[LeftOut], progress: Progress, named: bool, trial: bool = True
) -> Look:
    """A look without the blunders that explain more than any effect or structure would, or leave
    these nothing to explain; they are added to those left out. Once an effect was `named`, no value
    of CAD is left out: lengths absorb part of an effect whose name is wrong.

    Several blunders at once may look like an effect: where one of them that an effect outdoes is
    left out, and the next then outdoes it, they are left out together if nothing stands out after.
    Where `trial` is False they are left out at once: what stood out was tried and not confirmed.
    """
    on_trial: tuple[Look, int] | None = None  # where to go back to, and how many were left out
    first, known = look, len(left)
    for _ in range(ADAPTED if look.stand.estimate.converged else MENDED):
        estimate = look.stand.estimate
        stray = list(stray_scans(estimate.problem, estimate.values, look.checked))
        wild = [] if stray else _wild(look)
        wild = [b for b in wild if not (named and b.group.kind == "frame")]
        groups = [each.blunder.group for each in stray] + [b.group for b in wild]
        outdone = trial and bool(wild) and _outdone(look, wild[0])
        if not groups or (on_trial and outdone):
            break
        if (stand := tried(look.stand.without, groups, progress)) is None:
            break
        after = stand.look(progress)
        quiet = _quiet(after)
        if on_trial is None and outdone and not quiet:
            on_trial = look, len(left)
        elif quiet:
            on_trial = None
        left += [*stray, *_left_out(look, wild, after)]
        look = after
    if on_trial:
        look, count = on_trial
        del left[count:]
    return _blamed_on_others(first, look, left, known, progress)


def _blamed_on_others(
    first: Look, last: Look, left: list[LeftOut], known: int, progress: Progress
) -> Look:
    """The last look without the parts of the mesh that were left out since the first one, where
    they stand out no more once all else is left out: what a scan says of them moves and tilts them,
    and then they seem worse than the scan.

    Args:
        first: where nothing but those `known` was left out.
        last: where all of them are.
        left: what was left out, from which the parts are taken.
        known: how many of these the first look was without.
        progress: as of `adapted`.
    """
    of_mesh = [each for each in left[known:] if each.blunder.group.where == MESH]
    others = [each for each in left[known:] if each.blunder.group.where != MESH]
    if not of_mesh or not others:
        return last
    stand = tried(first.stand.without, [each.blunder.group for each in others], progress)
    if stand is None or not stand.estimate.converged:
        return last
    look = stand.look(progress)
    loud = {blunder.group for blunder in look.blunders if blunder.found}
    if any(each.blunder.group in loud for each in of_mesh):
        return last
    left[known:] = others
    return look


def blunders_alone(look: Look, progress: Progress) -> bool:
    """Whether there are blunders, and neither structure nor anything that scatters by chance."""
    found = any(b.found for b in look.blunders) and not any(c.found for c in look.chance)
    return found and not structures(look, progress)


def _left_out(look: Look, wild: Sequence[Blunder], after: Look) -> Iterator[LeftOut]:
    """Blunders, each with what explained as much before, and explains nothing after."""
    loud = {b.group for b in after.blunders if b.found}
    for each in wild:
        near = (b for b in look.blunders if each.evidence - b.evidence < ODDS)
        others = [b for b in near if b.found and b.group not in {*loud, each.group}]
        others = [b for b in others if b not in wild and (b.possible or b.group.what == JOINTS)]
        others = [b for b in others if len(wild) == 1 or _meet(each, b)]
        yield LeftOut(each, [b.group for b in others if _may_be(look, each, b)])


def _may_be(look: Look, blunder: Blunder, other: Blunder) -> bool:
    """Whether nothing of a blunder stands out once the other is left out in its place. Of one
    place, they err in the same rows."""
    if blunder.group.place == other.group.place:
        return True
    both = [(b.shift, b.limit) for b in (other, blunder)]
    return blunder.group not in standing_alone(look.others, both)


def restored(
    first: Stand,
    last: Look,
    left: list[LeftOut],
    found: list[NamedEffect],
    progress: Progress,
) -> tuple[Look, list[LeftOut], list[NamedEffect]]:
    """What was left out of the first fit is tested once more, beside the effects that have been
    named since, in the shapes that are best with it: those that explain it leave no blunder there
    (backward elimination).

    Args:
        first: the first fit.
        last: the last look.
        left: what was left out.
        found: these effects.
        progress: as of `fit.solve`.

    Returns:
        The last look with what is no blunder, what is one, and the effects.
    """
    aside = {each.blunder.group.token for each in left if each.aside}
    if (stand := tried(last.stand.without, [], progress, first, aside) if left else None) is None:
        return last, left, found
    still = aside & stand.estimate.problem.set_aside
    if len(still) == len(left):
        return last, left, found
    stand, swapped = retuned(stand, [step.effect.name for step in found], progress)
    look = stand.look(progress)
    loud = {blunder.group for blunder in look.blunders if blunder.found}
    kept = [
        e for e in left if (e.blunder.group.token in still if e.aside else e.blunder.group in loud)
    ]
    if len(kept) == len(left):
        return last, left, found
    if kept:
        groups = [each.blunder.group for each in kept]
        look = stand.without(groups, progress, of=first).look(progress)
    steps = [step.with_effect(swapped.get(step.effect.name)) for step in found]
    if swapped:
        steps[-1] = replace(steps[-1], after=look)
    return look, kept, steps


def _meet(a: Blunder, b: Blunder) -> bool:
    """Whether two groups are of one place, or either of them is of none."""
    fixed = {CAD, MESH}
    return a.group.where == b.group.where or not fixed.isdisjoint({a.group.where, b.group.where})


def _wild(look: Look) -> list[Blunder]:
    """Blunders to leave out now: the worst of each place, as far out as the worst of all, of those
    that stand out beside each other."""
    found = [b for b in look.blunders if b.found]
    places: dict[tuple[str, str], list[Blunder]] = {}
    for each in found:
        if each.evidence > AS_FAR * found[0].evidence:
            places.setdefault(each.group.place, []).append(each)
    worst = [likeliest(here) for here in places.values()]
    if len(worst) < 2:
        return worst
    some = [(b.shift, b.limit) for b in sorted(worst, key=lambda b: -b.evidence)]
    alone = standing_alone(look.others, some)
    return [b for b in worst if b.group in alone]


def _outdone(look: Look, by: Blunder) -> bool:
    """Whether an effect or a structure explains more than a blunder, at its price: also one that
    chance by stops may make, as where stops scatter none of them is a blunder."""
    every = (*look.named.candidates, *look.unnamed.candidates)
    best = max((c.evidence - np.log(c.looks) for c in every), default=0.0)
    return by.evidence - np.log(by.looks) < best


def _quiet(look: Look) -> bool:
    """Whether no effect and no structure is significant: bins, or a name that acts like bins, take
    on what one stop has alone, but one stop left out does not take an effect away."""
    named = any(stands_out(c, ALPHA_EFFECT) for c in look.named.candidates)
    return not named and not any(stands_out(c, ALPHA_UNNAMED) for c in look.unnamed.candidates)


def likeliest(here: Sequence[Blunder]) -> Blunder:
    """Of groups of one place, furthest out first, the likeliest that can stand for the first."""
    here = [b for b in here if b.possible] or here
    near = (b for b in here if here[0].evidence - b.evidence < ODDS)
    return min(near, key=lambda b: b.likely)
