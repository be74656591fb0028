"""A formula that is a known effect.

Where most beams that an effect moves were rejected, nothing is left for a test of it by its name. A
formula is found all the same, as its fit takes these beams back. Beside that fit, effects of the
same covariates are held against it: one that does the same, and predicts stops that were held out
as well in its place, is its name.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from calib.diagnosis.candidates import finer
from calib.diagnosis.score import information_left, score_test
from calib.diagnosis.screen import Candidate
from calib.diagnosis.search import NamedEffect, Search
from calib.diagnosis.search.confirmed import as_fitted, structures
from calib.diagnosis.stand import Look, Stand, tried, variables_of
from calib.diagnosis.verdict.matters import as_good
from calib.diagnosis.verdict.unnamed import Unnamed
from calib.effects import Effect, Site
from calib.linear.symmetric import pinv
from calib.problem.build import shapes_of
from calib.results.errors import Errors
from calib.results.holdout import Fall
from calib.solve.fit import Progress

# Of what a formula does, in squared sigmas, which an effect does too: a choice. What it leaves is
# judged by stops that were held out.
SAME_AS_FORMULA = 0.9
ZOOMS = 3  # on the best shape, each to a quarter of the interval


def by_name(
    found: Search, formulas: Unnamed, unseen: Callable[[Stand], Errors], progress: Progress
) -> tuple[Search, dict[str, Fall]] | None:
    """A search with the effect that formulas describe, and how the held-out error falls with it;
    None where there is none, or an effect was named.

    Args:
        found: the search.
        formulas: what stands for the structure that it left.
        unseen: errors of a fit at stops that were held out.
        progress: as of `fit.solve`.
    """
    if found.found or formulas.fitted is None:
        return None
    look, (before, with_formulas) = found.looks[-1], formulas.fall.sizes
    drawn = {c for each in formulas.formulas for c in each.covariates}
    alike = [c for c in look.named.candidates if {*c.effect.covariates} == drawn]
    alike = [c for c in alike if c.effect.site is Site.BEAM]
    if not alike:
        return None
    effect = _doing_the_same(formulas.fitted, look.stand.model.names, alike, progress)
    if effect is None or (stand := tried(look.stand.with_effects, [effect], progress)) is None:
        return None
    errors, (thrown, still) = unseen(stand), formulas.thrown or (0.0, 0.0)
    if not as_good(errors, with_formulas.judged_mm, still):
        return None
    after, sure = stand.look(progress), formulas.formulas[0].steps[0]
    candidate = next(c for c in alike if c.effect.family == effect.family)
    candidate = replace(candidate, effect=effect, p_value=sure.p_value)
    step = _as_fitted(candidate, look, after, sure.p_adjusted)
    unnamed = structures(after, progress)
    named = replace(found, looks=[*found.looks, after], found=[step], unnamed=unnamed)
    share = (thrown, errors.rejected_share or 0.0)
    fall = Fall.of(before, errors.size, rejected_share=share)
    return named, {effect.name: fall}


def _as_fitted(candidate: Candidate, before: Look, after: Look, p_adjusted: float) -> NamedEffect:
    """A candidate as its fit has it, with the beams that this takes back."""
    scores, theta = as_fitted(after, candidate.effect)
    told = scores.information @ theta
    own = score_test(scores, np.arange(len(theta)))
    test = replace(
        candidate.test,
        statistic=float(theta @ told),
        whiten=own.whiten,
        chances=own.chances,
        clusters=own.clusters,
        score=told,
    )
    changed = before.named.scores.told_as(test.columns, scores, np.arange(len(theta)))
    taken_back = replace(changed, weight_m2=scores.weight_m2)
    return NamedEffect(
        candidate=replace(candidate, test=test),
        before=replace(before, named=replace(before.named, scores=taken_back)),
        after=after,
        judged=test,
        p_adjusted=p_adjusted,
        rivals=(),
    )


def _doing_the_same(
    stand: Stand, without: Sequence[str], alike: Sequence[Candidate], progress: Progress
) -> Effect | None:
    """Of candidates the one that is most like the formulas of a stand, in its best shape; None
    where none is like them."""
    formulas = [e for e in stand.model.effects if e.name not in without]
    shaped = [
        c.effect.at(shape) if c.effect.shape_name else c.effect
        for c in alike
        for shape in (shapes_of(c.effect, stand.sources) if c.effect.shape_name else [None])
    ]
    likeness = _likeness(stand, formulas, shaped, progress)
    best = max(shaped, key=lambda e: likeness[e.name])
    grid = sorted(e.shape for e in shaped if e.family == best.family and e.shape_name)
    for _ in range(ZOOMS if grid else 0):
        shaped = finer(best, grid)
        grid = [e.shape for e in shaped]
        likeness = _likeness(stand, formulas, shaped, progress)
        best = max(shaped, key=lambda e: likeness[e.name])
    return best if likeness[best.name] > SAME_AS_FORMULA else None


def _likeness(
    stand: Stand, formulas: Sequence[Effect], candidates: Sequence[Effect], progress: Progress
) -> dict[str, float]:
    """Candidate -> the share of what formulas of the model do that it can do in their place, in
    squared sigmas, all that the rest of the model absorbs taken off."""
    linear, at, _ = stand.linearise(candidates, progress)
    own = variables_of(stand.problem, {e.name for e in formulas})
    drawn = [name for names in own.values() for name in names]
    information = information_left(linear, [*drawn, *linear.candidates])
    theta = np.concatenate([stand.estimate.values[name] for name in drawn])
    count = len(theta)
    whole = theta @ information[:count, :count] @ theta
    share = {}
    for name, columns in at.items():
        these = count + columns
        cross = information[these, :count] @ theta
        took = cross @ pinv(information[np.ix_(these, these)]) @ cross
        share[name] = float(took / max(whole, 1e-300))
    return share
