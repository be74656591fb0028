"""From one look to a named effect: the best explanation is judged, then fitted, then looked past.

What scatters from stop to stop may be chance: the model gets that scatter, and all is looked at
again beside it. A blunder is an explanation like any other: its rows are left out, and the rest is
fitted and looked at again (detection, identification and adaptation: Teunissen 1990).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.blunders.aside import stray_scans
from calib.blunders.chance import LEVELS, after_looks, log_tail
from calib.blunders.judged import Blunder, LeftOut
from calib.blunders.shifts import standing_alone
from calib.diagnosis.chance import Chance
from calib.diagnosis.rejects import FEWEST_STOPS
from calib.diagnosis.score import ScoreTest, score_test
from calib.diagnosis.screen import ODDS, Candidate, Screen, rivals
from calib.diagnosis.stand import Look, Stand, tried
from calib.effects import Effect
from calib.residuals.groups import CAD, JOINTS, MESH
from calib.solve.fit import Progress

ALPHA_EFFECT = LEVELS["effect"]
ALPHA_UNNAMED = LEVELS["structure"]
ALPHA_NOISE = LEVELS["effect on the scatter"]
MOST_NEEDED = 3  # an explanation that needs more names than this is none: a choice
# Of the leading structure's evidence, for another covariate to be named too: a choice, as what has
# half of it may be the cause where covariates go together.
ALSO_NAMED = 0.5
SUSPECTS_JUDGED = 3  # of most evidence, before a look is called quiet: each costs a jackknife
ADAPTED, MENDED = 8, 2  # rounds of leaving out; of 76 fits without optimum one was mended, in two
# Of the leading blunder's evidence, from which others at other places are left out with it: a
# choice; what is left over is found by the next look.
AS_FAR = 0.1
# Of what a test says of an effect, below which a fit does not bear it out: a choice, far below the
# whole that it takes up where the test is right.
HELD_BACK = 0.1


@dataclass(frozen=True)
class NamedEffect:
    """An effect that the data confirm.

    Args:
        candidate: as it stood out before, in its best shape.
        before, after: the looks before it was fitted and after.
        judged: its test with clusters jackknifed.
        p_adjusted: as judged.
        rivals: candidates that explain as much, and what to tell them apart by.
    """

    candidate: Candidate
    before: Look
    after: Look
    judged: ScoreTest
    p_adjusted: float
    rivals: Sequence[Candidate]

    @property
    def effect(self) -> Effect:
        return self.candidate.effect

    def with_effect(self, effect: Effect | None) -> NamedEffect:
        """With another shape of its effect, if there is one."""
        if effect is None:
            return self
        return replace(self, candidate=replace(self.candidate, effect=effect))


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
    """

    looks: Sequence[Look]
    found: Sequence[NamedEffect]
    blunders: Sequence[LeftOut]
    unnamed: Sequence[Candidate]
    scatter: Candidate | None
    at_first: Sequence[Candidate] = ()
    chance: Sequence[Chance] = ()
    unsettled: Chance | None = None

    def dressed_up(self, i: int) -> bool:
        """Whether residual structure would have explained more than the i-th name did."""
        common, step = self.looks[-1].named.common, self.found[i]
        bins = (c.test.evidence(common) for c in step.before.unnamed.candidates)
        return step.candidate.test.evidence(common) < max(bins, default=0.0) - ODDS


Steps = tuple[list[Look], list[NamedEffect], list[LeftOut]]


def search(stand: Stand, progress: Progress, most: int = MOST_NEEDED) -> Search:
    """Name what is missing, one effect after another, then ask whether that is all.

    Args:
        stand: a fitted model.
        progress: as of `fit.solve`.
        most: how many effects are named at most; with none, blunders are all that is looked for:
            away from an optimum any effect, structure or scatter seems missing.
    """
    looks, found, left = plain = _steps(stand, progress, most)
    chance: list[Chance] = []
    unsettled: Chance | None = None
    while most and (strongest := next((c for c in looks[-1].chance if c.found), None)):
        others = [c for c in looks[-1].chance if c.found and c is not strongest]
        chance.append(strongest)
        widens = strongest.effect.widens
        base = looks[-1].stand if widens else stand
        added = [c.effect for c in chance[-1 if widens else 0 :]]
        beside = tried(base.with_effects, added, progress)
        if beside is None or not beside.estimate.converged:
            unsettled = chance.pop()
            break
        if widens:
            looks = [*looks, beside.look(progress)]
        else:
            looks, found, left = _steps(beside, progress, most)
        tested = {c.effect.name for c in looks[-1].chance}  # with it, and others that still can be
        near = (c for c in others if strongest.statistic - c.statistic < 2 * ODDS)
        alike = [*near, *(c for c in others if c.effect.name not in tested)]
        rivals = tuple(dict.fromkeys(c.effect.name for c in alike))
        chance[-1] = replace(strongest, rivals=rivals)
    last = looks[-1]
    still = (c.beside(last.stand.estimate) for c in chance)
    done = Search(
        looks=looks,
        found=found,
        blunders=left,
        unnamed=structures(last, progress) if most else (),
        scatter=_scatter(last, progress) if most else None,
        chance=[c for c in still if c.found],
        unsettled=unsettled,
    )
    if done.chance and done.unnamed and structures(plain[0][0], progress):
        if not plain[1] and _chance_leads(plain[0][-1]):
            plain = _steps(stand, progress, most, chance_leads=False)
        done = _without_chance(done, plain, progress)
    if done.found and done.dressed_up(0):
        return replace(done, at_first=structures(done.looks[0], progress))
    return done


def _without_chance(done: Search, steps: Steps, progress: Progress) -> Search:
    """The same without values by chance in the model, if structure is left then: values by stop
    take in most of a structure that differs from stop to stop, and what still stands beside them
    would seem to be a trace."""
    looks, found, left = steps
    if not (unnamed := structures(looks[-1], progress)):
        return done
    scatter = _scatter(looks[-1], progress)
    return replace(done, looks=looks, found=found, blunders=left, unnamed=unnamed, scatter=scatter)


def _steps(stand: Stand, progress: Progress, most: int, chance_leads: bool = True) -> Steps:
    """Effects and blunders, one after another, with no more by chance than the model has: the
    looks, and both, as `Search` has them."""
    first, looks, found, left = stand, [stand.look(progress)], [], []
    while True:
        looks[-1] = _adapted(looks[-1], left, progress, named=bool(found))
        if chance_leads and not found and _chance_leads(looks[-1]):
            break
        more = _named(looks[-1], found, progress) if len(found) < most else found
        if len(more) == len(found):
            break
        found = more
        looks.append(found[-1].after)
    looks[-1], left = _restored(first, looks[-1], left, progress) if found else (looks[-1], left)
    return looks, found, left


def _adapted(look: Look, left: list[LeftOut], progress: Progress, named: bool) -> Look:
    """A look without the blunders that explain more than any effect or structure would, or leave
    these nothing to explain; they are added to those left out. Once an effect was `named`, no value
    of CAD is left out: lengths absorb part of an effect whose name is wrong.

    Several blunders at once may look like an effect: where one of them that an effect outdoes is
    left out, and the next then outdoes it, they are left out together if nothing stands out after.
    """
    on_trial: tuple[Look, int] | None = None  # where to go back to, and how many were left out
    for _ in range(ADAPTED if look.stand.estimate.converged else MENDED):
        estimate = look.stand.estimate
        stray = list(stray_scans(estimate.problem, estimate.values, look.checked))
        wild = [] if stray else _wild(look)
        wild = [b for b in wild if not (named and b.group.kind == "frame")]
        groups = [each.blunder.group for each in stray] + [b.group for b in wild]
        if not groups or (on_trial and wild and _outdone(look, wild[0])):
            break
        if (stand := tried(look.stand.without, groups, progress)) is None:
            break
        after = stand.look(progress)
        quiet = _quiet(after)
        if on_trial is None and wild and _outdone(look, wild[0]) and not quiet:
            on_trial = look, len(left)
        elif quiet:
            on_trial = None
        left += [*stray, *_left_out(look, wild, after)]
        look = after
    if on_trial:
        look, count = on_trial
        del left[count:]
    return look


def _left_out(look: Look, wild: Sequence[Blunder], after: Look) -> Iterator[LeftOut]:
    """Blunders, each with what explained as much before, and explains nothing after."""
    loud = {b.group for b in after.blunders if b.found}
    for each in wild:
        near = (b for b in look.blunders if each.evidence - b.evidence < ODDS)
        others = [b for b in near if b.found and b.group not in {*loud, each.group}]
        others = [b for b in others if b not in wild and (b.possible or b.group.what == JOINTS)]
        yield LeftOut(each, [b.group for b in others if len(wild) == 1 or _meet(each, b)])


def _restored(
    first: Stand, last: Look, left: list[LeftOut], progress: Progress
) -> tuple[Look, list[LeftOut]]:
    """What was left out of the first fit is tested once more, beside the effects that have been
    named since: those that explain it leave no blunder there (backward elimination)."""
    aside = [each.blunder.group for each in left if each.aside]
    less = len(aside) < len(left)
    if (stand := tried(last.stand.without, aside, progress, first) if less else None) is None:
        return last, left
    look = stand.look(progress)
    found = {blunder.group for blunder in look.blunders if blunder.found}
    kept = [each for each in left if each.aside or each.blunder.group in found]
    if len(kept) == len(left):
        return last, left
    if len(kept) > len(aside):
        groups = [each.blunder.group for each in kept]
        look = last.stand.without(groups, progress, of=first).look(progress)
    return look, kept


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
            places.setdefault((each.group.recording, each.group.where), []).append(each)
    worst = [likeliest(here) for here in places.values()]
    if len(worst) < 2:
        return worst
    some = [(b.shift, b.limit) for b in sorted(worst, key=lambda b: -b.evidence)]
    alone = standing_alone(look.fitted, look.stand.estimate.problem, some)
    return [b for b in worst if b.group in alone]


def _outdone(look: Look, by: Blunder) -> bool:
    """Whether an effect or a structure explains more than a blunder, at its price: also one that
    chance by stops may make, as where stops scatter none of them is a blunder."""
    every = (*look.named.candidates, *look.unnamed.candidates)
    best = max((c.evidence - np.log(c.looks) for c in every), default=0.0)
    return by.evidence - np.log(by.looks) < best


def _chance_leads(look: Look) -> bool:
    """Whether values by chance explain more than any effect or structure does, and than wider
    sigmas, which would take in whatever is missing."""
    every = (*look.named.candidates, *look.unnamed.candidates)
    best = max((c.test.statistic for c in every), default=0.0)
    found = [c for c in look.chance if c.found]
    return bool(found) and not found[0].effect.widens and found[0].statistic > best


def _quiet(look: Look) -> bool:
    """Whether no effect and no structure is significant: bins, or a name that acts like bins, take
    on what one stop has alone, but one stop left out does not take an effect away."""
    named = any(_stands_out(c, ALPHA_EFFECT) for c in look.named.candidates)
    return not named and not any(_stands_out(c, ALPHA_UNNAMED) for c in look.unnamed.candidates)


def likeliest(here: Sequence[Blunder]) -> Blunder:
    """Of groups of one place, furthest out first, the likeliest that can stand for the first."""
    here = [b for b in here if b.possible] or here
    near = (b for b in here if here[0].evidence - b.evidence < ODDS)
    return min(near, key=lambda b: b.likely)


def _named(look: Look, found: list[NamedEffect], progress: Progress) -> list[NamedEffect]:
    """What was found, and the best candidate that is confirmed, fitted; with it others may have
    better shapes. Which one is best may change once it is fitted, as rows then scatter less."""
    for candidate in suspects(look.named, ALPHA_EFFECT):
        if more := _fitted(look, candidate, found, progress):
            likelier = _likelier(more[-1])
            return (likelier and _fitted(look, likelier, found, progress)) or more
    return found


def _fitted(
    look: Look, candidate: Candidate, found: list[NamedEffect], progress: Progress
) -> list[NamedEffect]:
    """What was found, and a candidate, fitted; nothing where it is not confirmed."""
    test, p = judged(look, candidate, progress)
    if p >= ALPHA_EFFECT:
        return []
    effect = look.stand.finest(candidate.effect, progress)
    stand = tried(look.stand.with_effects, [effect], progress)
    theta = stand.theta(effect) if stand else 0 * test.estimate()
    if look.named.taken_up(candidate, theta) < HELD_BACK:
        return []
    stand, swapped = stand.retuned([f.effect.name for f in found], progress)
    after = stand.look(progress)
    step = NamedEffect(
        candidate=replace(candidate, effect=effect, p_value=test.p_value()),
        before=look,
        after=after,
        judged=test,
        p_adjusted=p,
        rivals=rivals(look.named, candidate, max(after.named.common, test.inflation)),
    )
    return [*(f.with_effect(swapped.get(f.effect.name)) for f in found), step]


def _likelier(step: NamedEffect) -> Candidate | None:
    """A rival that explains more than the named effect does, beyond the odds of chance, where rows
    scatter as they do with that in the model."""
    scale = max(step.after.named.common, step.judged.inflation)
    best = max(step.rivals, key=lambda c: c.test.evidence(scale), default=step.candidate)
    more = best.test.evidence(scale) - step.candidate.test.evidence(scale)
    return best if more > ODDS else None


def structures(look: Look, progress: Progress) -> list[Candidate]:
    """Structure that is confirmed, strongest first; single covariates that could stand for it."""
    out: list[Candidate] = []
    for candidate in look.unnamed.candidates:
        if not _stands_out(candidate, ALPHA_UNNAMED):
            continue
        instead = out and len(candidate.effect.covariates) == 1
        instead = instead and candidate.evidence > ALSO_NAMED * out[0].evidence
        if instead or not _covered(look.unnamed, candidate, out):
            test, p = judged(look, candidate, progress)
            if p < ALPHA_UNNAMED:
                out.append(replace(candidate, p_value=test.p_value(), p_adjusted=p))
    return out


def _covered(screen: Screen, candidate: Candidate, by: Sequence[Candidate]) -> bool:
    """Whether others leave a candidate nothing to explain."""
    if not by:
        return False
    columns = np.unique(np.concatenate([c.test.columns for c in by]))
    there = score_test(screen.scores, columns)
    both = score_test(screen.scores, np.union1d(columns, candidate.test.columns))
    gain = max(both.statistic - there.statistic, 0.0) / max(screen.common, 1.0)
    more = both.dof - there.dof
    return more < 1 or -log_tail(gain, more) < np.log(candidate.looks / ALPHA_UNNAMED)


def _scatter(look: Look, progress: Progress) -> Candidate | None:
    for candidate in suspects(look.noise, ALPHA_NOISE):
        test, p = judged(look, candidate, progress)
        if p < ALPHA_NOISE:
            return replace(candidate, test=test, p_value=test.p_value(), p_adjusted=p)
    return None


def judged(look: Look, candidate: Candidate, progress: Progress) -> tuple[ScoreTest, float]:
    """A candidate's test, its clusters jackknifed, and its p-value adjusted for all tests."""
    found = look.judged(candidate, progress)
    return found, float(after_looks(found.p_value(), candidate.looks))


def suspects(screen: Screen, alpha: float) -> Iterator[Candidate]:
    """Candidates found if rows were independent, or found by clusters, best first."""
    standing_out = [c for c in screen.candidates if _stands_out(c, alpha)]
    yield from standing_out[:SUSPECTS_JUDGED]


def _stands_out(candidate: Candidate, alpha: float) -> bool:
    if candidate.test.clusters < FEWEST_STOPS:
        return False
    alone = -log_tail(candidate.test.statistic, candidate.test.dof)
    return candidate.p_adjusted < alpha or alone > np.log(candidate.looks / alpha)
