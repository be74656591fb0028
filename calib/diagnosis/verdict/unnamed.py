"""Formulas of what no known effect explains, and whether they stand in for names."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from calib.diagnosis.formulas import Formula, find
from calib.diagnosis.formulas.found import bare
from calib.diagnosis.formulas.why import why
from calib.diagnosis.search import Search
from calib.diagnosis.stand import Stand, tried
from calib.diagnosis.structure import what_moves
from calib.diagnosis.suggest import DESCRIBES, span, what_differs, words
from calib.diagnosis.verdict.matters import FALL_MATTERS, HELD_OUT_BY_CHANCE, as_good
from calib.effects import Effect, Site
from calib.effects.own.formula import FormulaEffect
from calib.results.errors import Errors
from calib.results.holdout import TAKEN_BACK, Fall, fall_document, from_to
from calib.solve.fit import Progress

MOST_ALIKE = 3  # other forms that are listed


@dataclass(frozen=True)
class Unnamed:
    """Formulas of what ranges, or a joint, do beyond a model and the effects named.

    Args:
        formulas: strongest first.
        instead: whether they take the place of the names, as `unnamed` has it.
        fall: how the held-out error falls once all of them are fitted; None where nobody looked.
        whole: whether the held-out error with them is what chance makes it.
        thrown: the share of the held-out beams without weight, before and after; None where that
            is not known.
        refused: a sentence, where held-out stops are predicted no better with them.
        fitted: the model with them, where they are told and somebody looked.
        needless: names of effects that predict nothing beside them.
    """

    formulas: Sequence[Formula] = ()
    instead: bool = False
    fall: Fall | None = None
    whole: bool = False
    thrown: tuple[float, float] | None = None
    refused: str = ""
    fitted: Stand | None = field(default=None, repr=False, compare=False)
    needless: Sequence[str] = ()

    def documents(self, taken: Sequence[str]) -> list[dict[str, Any]]:
        """As in diagnosis.json, to be added by names that the model has not."""
        thrown = dict(zip(("before", "after"), self.thrown or (None, None), strict=True))
        fell = fall_document(self.fall) | {"rejected_share": thrown}
        return [_document(each, taken) | fell for each in self.formulas]


def unnamed(
    found: Search,
    doubtful: bool,
    unseen: Callable[[Stand], Errors] | None,
    progress: Progress,
) -> Unnamed:
    """Look for formulas of what a search left: of the ranges, or of a joint where there are none.

    One takes the place of doubtful names if it predicts unseen stops better, or rejects far fewer
    of their beams; and of several that are functions of the same covariates of the range, which may
    make up any curve, if it predicts them as well with fewer constants. Where something seems to
    move, a formula takes the place of that only if nothing is left beside it: an error of the range
    that follows azimuth looks much like a motion, and a motion like it.

    Args:
        found: the search.
        doubtful: whether its names leave much, or much that is rejected: a formula may do more.
        unseen: errors of a fit at stops that were held out; None if nobody is to look.
        progress: as of `fit.solve`.
    """
    leading = next(iter(found.at_first or found.unnamed), None)
    moves = leading is not None and what_moves(leading.effect) is not None
    if moves and unseen is None:
        return Unnamed()
    names = [step.effect for step in found.found]
    scatters = [c.effect.per for c in (*found.chance, found.unsettled) if c]
    by_location, better = "location" in scatters, bool(names) and doubtful and not moves
    asked = unseen is not None and (better or _of_one_curve(names))
    if asked and (instead := _instead(found, by_location, better, unseen, progress)):
        return instead
    last = _bare(found, (), progress)
    formulas = find(last, progress, by_location)
    if not formulas or unseen is None:
        return Unnamed(formulas)
    fitted = with_formulas(last, formulas, progress)
    before, after = unseen(last), unseen(fitted)
    if moves and not _by_chance(after):
        return Unnamed()
    # A gross structure is rejected, not fitted: what falls then is the share of such beams.
    thrown = _thrown(before, after)
    fall = Fall.of(before.size, after.size, rejected_share=thrown)
    if fall.takes_back or fall.before_mm - fall.after_mm > FALL_MATTERS * fall.floor_mm:
        needless = _needless(_replaced(names, formulas), fitted, after, unseen, progress)
        return Unnamed(
            formulas=formulas,
            fall=fall,
            whole=_by_chance(after),
            thrown=thrown,
            fitted=fitted,
            needless=needless,
        )
    over = " and ".join(words(c) for c in formulas[0].covariates)
    return Unnamed(
        refused=f"A formula over {over} fits part of the residuals, but stops that were held out "
        f"are predicted no better with it ({from_to(fall_document(fall))})."
    )


def _instead(
    found: Search,
    by_location: bool,
    better: bool,
    unseen: Callable[[Stand], Errors],
    progress: Progress,
) -> Unnamed | None:
    """Formulas in place of the names: simpler, where these are one curve, or, where that is asked,
    `better`; None without. Other arguments as of `unnamed`."""
    names = [step.effect for step in found.found]
    less = tried(_bare, found, [effect.name for effect in names], progress)
    formulas = find(less, progress, by_location) if less else []
    fitted = tried(with_formulas, less, formulas, progress) if formulas else None
    if fitted is None:
        return None
    before, named, after = map(unseen, (less, found.looks[-1].stand, fitted))
    better = better and _better(before, named, after)
    curve = _of_one_curve(names)
    if not better and not (curve and _simpler(formulas, names, less, named, after)):
        return None
    return Unnamed(
        formulas=formulas,
        instead=True,
        fall=Fall.of(before.size, after.size),
        whole=_by_chance(after),
        thrown=_thrown(before, after),
    )


def _bare(found: Search, names: Sequence[str], progress: Progress) -> Stand:
    """The last fit of a search without some names, and without the values by chance that it found:
    these take in most of a structure that differs from stop to stop."""
    stand = found.looks[-1].stand
    gone = [*names, *(c.effect.name for c in found.chance if c.effect.name in stand.model.names)]
    return stand.lacking(gone, progress) if gone else stand


def _replaced(names: Sequence[Effect], formulas: Sequence[Formula]) -> list[Effect]:
    """Effects that formulas may take the place of: of beams, as formulas of the range are, or of a
    covariate of theirs. An offset by paint may stand for one by how dark a surface is."""
    drawn = {c for each in formulas for c in each.covariates}
    of_range = any(each.unit == "m" for each in formulas)
    return [
        effect
        for effect in names
        if drawn.intersection(effect.covariates) or (of_range and effect.site is Site.BEAM)
    ]


def _needless(
    effects: Sequence[Effect],
    fitted: Stand,
    errors: Errors,
    unseen: Callable[[Stand], Errors],
    progress: Progress,
) -> list[str]:
    """Effects without which a fit predicts unseen stops as well as it does, with these errors; what
    was named last is asked for first."""
    gone: list[str] = []
    for effect in reversed(effects):
        less = tried(fitted.lacking, [*gone, effect.name], progress)
        if less and as_good(unseen(less), errors.size.judged_mm, errors.rejected_share or 0.0):
            gone.append(effect.name)
    return gone


def _of_one_curve(names: Sequence[Effect]) -> bool:
    """Whether several effects make up one function of the same covariates for the range."""
    over = {frozenset(effect.covariates) for effect in names}
    of_range = all(e.site is Site.BEAM and "range = " in e.formula for e in names)
    return of_range and len(over) == 1 < len(names)


def _by_chance(errors: Errors) -> bool:
    """Whether errors at unseen stops are no larger than chance makes them."""
    size = errors.size
    return size.judged_mm <= HELD_OUT_BY_CHANCE * size.floor_mm


def _thrown(before: Errors, after: Errors) -> tuple[float, float]:
    """Shares of unseen beams that are rejected."""
    return before.rejected_share or 0.0, after.rejected_share or 0.0


def _better(before: Errors, named: Errors, after: Errors) -> bool:
    """Whether formulas predict unseen stops better than names did, and than neither, by as much as
    matters, and no more beams are rejected than with the names; or far fewer are, and these fit."""
    now, then = _thrown(named, after)
    best = min(named.size.judged_mm, before.size.judged_mm)
    if now - then > TAKEN_BACK:
        return _by_chance(after) or after.size.judged_mm <= best
    least = FALL_MATTERS * before.size.judged_mm
    falls = after.size.judged_mm < best - least
    return falls and then - now <= TAKEN_BACK


def _simpler(
    formulas: Sequence[Formula],
    names: Sequence[Effect],
    stand: Stand,
    named: Errors,
    after: Errors,
) -> bool:
    """Whether one formula does what several effects of the same covariates do with more constants,
    and leaves nothing.

    Args:
        formulas: from a fit without the effects.
        names: these.
        stand: that fit.
        named, after: errors at unseen stops, with the effects and with the formulas.
    """
    covariates = {c for effect in names for c in effect.covariates}
    if len(formulas) > 1 or {*formulas[0].covariates} != covariates:
        return False
    rigs = [source.rig for source in stand.sources]
    known = sum(max(len(e.params(rig)) for rig in rigs) + bool(e.shape_name) for e in names)
    as_well = as_good(after, named.size.judged_mm, named.rejected_share or 0.0)
    return formulas[0].constants < known and _by_chance(after) and as_well


def with_formulas(
    stand: Stand, formulas: Sequence[Formula], progress: Progress, names: Sequence[Effect] = ()
) -> Stand:
    """A model with formulas, and effects that were named before, fitted."""
    effects = list(names)
    taken = [*stand.model.names, *(effect.name for effect in names)]
    for each in formulas:
        effects.append(FormulaEffect.read(each.effect(taken, ""), "diagnosis.json", {}))
        taken.append(effects[-1].name)
    return stand.with_effects(effects, progress)


def _document(found: Formula, taken: Sequence[str]) -> dict[str, Any]:
    seen = " and ".join(span(name, *ends) for name, ends in found.seen.items())
    what = f"{DESCRIBES} {seen}."
    first, of_arm = found.steps[0], found.unit == "rad"
    return {
        "covariates": list(found.covariates),
        "rms_mm": 1e3 * found.rms_m,
        "p_value": first.p_value,
        "p_adjusted": first.p_adjusted,
        "says": found.says,
        "terms": [
            {"text": text, "estimate": amount, "sigma": sigma, "unit": found.unit}
            for part in found.parts
            for text, amount, sigma in zip(part.texts, part.amount, part.sigma, strict=True)
        ],
        "alike": [
            {
                "says": " + ".join(
                    f"a{i}" if text == "1" else f"a{i} * {bare(text)}"
                    for i, text in enumerate(form.term.texts, 1)
                ),
                "covariates": list(form.term.covariates),
                "separate": what_differs(found.covariates, form.term.covariates, of_arm),
            }
            for form in found.alike[:MOST_ALIKE]
        ],
        "why": why(found.covariates, found.joints, of_arm),
        "formula": found.effect(taken, what),
        "seen": {name: list(ends) for name, ends in found.seen.items()},
        "picture": found.picture,
    }
