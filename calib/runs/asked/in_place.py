"""Effects that would fit as well in place of one that a run has: what it was named with."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from calib.diagnosis.screen import ODDS
from calib.diagnosis.stand import Stand, tried
from calib.diagnosis.verdict.sentences import odds_told
from calib.effects import Effect, find
from calib.problem.unknowns import Key
from calib.results.outstanding import shown
from calib.runs.run import Run
from calib.solve.fit import Progress
from chains.errors import InputError

MOST_IN_PLACE = 3  # rivals of an effect, as each takes a fit: a choice
_OF_RIVAL = {
    "add",
    "dof",
    "odds",
    "separate",
    "alike",
}  # not all by earlier versions


@dataclass(frozen=True)
class InPlace:
    """Another effect in place of one that the model has.

    Args:
        effect, rival: their names.
        odds: how much likelier other rows are expected to be with the effect than with the rival,
            by fits with each.
        parameter, change, unit: the estimate that differs most, in its sigmas, and by how much.
        sigmas: by how many of them.
        separate: what would separate the two.
        alike: whether both move all that is seen alike at every pose, so that no stops do.
    """

    effect: str
    rival: str
    odds: float
    parameter: str
    change: float
    unit: str
    sigmas: float
    separate: str
    alike: bool

    @property
    def sentence(self) -> str:
        """For people."""
        times, unit = shown(self.unit)
        fits = "better" if self.odds < np.exp(-ODDS) else "as well"
        return (
            f"{self.rival} in place of {self.effect} would fit {fits} "
            f"({odds_told(self.odds)}), and {self.parameter} would be "
            f"{times * abs(self.change):.3g} {unit} otherwise, {self.sigmas:.1f} of its sigmas; "
            f"{self.separate} would separate them."
        )

    def document(self) -> dict[str, Any]:
        """As diagnosis.json has it."""
        return dict(vars(self))


def rivals_told(run: Run | None) -> dict[str, dict[str, Any]]:
    """Effect -> how many parameters it has, as its test has them, and its `rivals`, as the run and
    its diagnosis tell them; empty where nothing was told."""
    if run is None:
        return {}
    try:
        candidates = (run.diagnosis() or {}).get("candidates", ())
    except InputError:  # of another version
        candidates = ()
    told = {}
    for each in candidates:
        if rivals := [r for r in each.get("rivals", ()) if r.keys() >= _OF_RIVAL]:
            told[each["add"]] = {"dof": each["dof"], "rivals": rivals}
    return {**run.summary.get("rivals", {}), **told}


def in_place(run: Run, stand: Stand, progress: Progress) -> Iterator[InPlace]:
    """Rivals of the effects of a run's model with which it would fit as well.

    Args:
        run: the run.
        stand: as it stands.
        progress: as of `fit.solve`.
    """
    every = run.summary.get("rivals", {})
    some = [effect for effect in stand.model.effects if effect.name in every]
    if some:  # as the others are fitted
        stand = stand.refitted(stand.model, stand.estimate.start, progress)
    for effect in some:
        told = every[effect.name]
        for rival in sorted(told["rivals"], key=lambda each: each["odds"])[:MOST_IN_PLACE]:
            other = _instead(stand, effect, rival["add"], progress)
            if other is None:
                continue
            priced = other.estimate.robust_cost - stand.estimate.robust_cost
            priced += rival["dof"] - told["dof"]
            if priced < ODDS:
                moved = _furthest(run, stand, other, effect)
                yield replace(
                    moved,
                    rival=rival["add"],
                    odds=float(np.exp(priced)),
                    separate=rival["separate"],
                    alike=rival["alike"],
                )


def to_be_told(some: Sequence[InPlace]) -> list[str]:
    """The first effect that stops would tell from what fits in its place, and those rivals."""
    apart = [each for each in some if not each.alike]
    return (
        [apart[0].effect, *(e.rival for e in apart if e.effect == apart[0].effect)] if apart else []
    )


def _instead(stand: Stand, effect: Effect, rival: str, progress: Progress) -> Stand | None:
    """The model's fit with a rival in place of an effect; None where there is none."""
    own = (each for each in stand.own if each.name == rival)
    try:
        other = next(own, None) or find(rival)
    except InputError:  # one's own that is given no more
        return None
    if other.family in {each.family for each in stand.model.effects}:
        return None
    model = stand.model.minus([effect.name]).plus((other,))
    fitted = tried(stand.refitted, model, stand.estimate.start, progress)
    return fitted if fitted and fitted.estimate.converged else None


def _furthest(run: Run, stand: Stand, other: Stand, effect: Effect) -> InPlace:
    """The estimate that differs most in its sigmas, of those that both have."""
    sigma = dict(zip(run.solution.keys, np.sqrt(np.diag(run.solution.covariance)), strict=True))
    there: Mapping[str, np.ndarray] = other.estimate.values
    found = []
    for unknown in stand.estimate.variables:
        if unknown.name not in there:
            continue
        change = unknown.difference(stand.estimate.values[unknown.name], there[unknown.name])
        for dof, unit, by in zip(unknown.dofs, unknown.units, change.tolist(), strict=True):
            if own := sigma.get(Key(unknown.name, dof)):
                found.append((abs(by) / own, f"{unknown.name}.{dof}", by, unit))
    sigmas, parameter, change, unit = max(found, default=(0.0, "no parameter", 0.0, ""))
    return InPlace(
        effect=effect.name,
        rival="",
        odds=np.nan,
        parameter=parameter,
        change=float(change),
        unit=unit,
        sigmas=float(sigmas),
        separate="",
        alike=False,
    )
