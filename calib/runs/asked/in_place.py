"""Effects that would fit as well in place of one that a run has: what it was named with."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from calib.diagnosis.screen import ODDS
from calib.diagnosis.search.named import log_odds
from calib.diagnosis.stand import Stand, tried
from calib.diagnosis.verdict.sentences import odds_told
from calib.effects import Effect, find
from calib.problem.unknowns import Key
from calib.results.outstanding import shown
from calib.runs.run import Run
from calib.solve.fit import Progress
from chains.errors import InputError

MOST_IN_PLACE = 3  # rivals of an effect, as each takes a fit: a choice
_OF_RIVAL = {"add", "dof", "odds", "separate", "alike"}  # not all by earlier versions


@dataclass(frozen=True)
class InPlace:
    """Another effect in place of one that the model has.

    Args:
        effect, rival: their names.
        odds: how much likelier other rows are expected to be with the effect than with the rival,
            by fits with each.
        change: what that does to the estimate that it moves furthest.
        separate: what would separate the two.
        alike: whether both move all that is seen alike at every pose, so that no stops do.
    """

    effect: str
    rival: str
    odds: float
    change: OtherEstimate
    separate: str
    alike: bool

    @property
    def is_better(self) -> bool:
        """Whether the model has the wrong one of the two."""
        return self.odds < np.exp(-ODDS)

    @property
    def sentence(self) -> str:
        """For people."""
        times, unit = shown(self.change.unit)
        fits = "far better" if self.is_better else "as well"
        return (
            f"{self.rival} in place of {self.effect} would fit {fits} "
            f"({odds_told(self.odds)}), and {self.change.parameter} would be "
            f"{times * abs(self.change.change):.3g} {unit} otherwise, {self.change.sigmas:.1f} of "
            f"its sigmas; {self.separate} would separate them."
        )

    def document(self) -> dict[str, Any]:
        """As diagnosis.json has it."""
        own = {name: x for name, x in vars(self).items() if name != "change"}
        return own | self.change._asdict()


class OtherEstimate(NamedTuple):
    """By how much an estimate differs between two fits.

    Args:
        parameter: which.
        change, unit: by how much, in its unit.
        sigmas: in its sigmas.
    """

    parameter: str = "no parameter"
    change: float = 0.0
    unit: str = ""
    sigmas: float = 0.0


@dataclass(frozen=True)
class Untried:
    """Another effect that may fit in place of one that the model has, and was not fitted.

    Args:
        effect, rival: their names.
        why: a clause.
    """

    effect: str
    rival: str
    why: str

    @property
    def sentence(self) -> str:
        """For people."""
        return (
            f"When {self.effect} was named, {self.rival} explained as much; whether it would fit "
            f"as well in its place is not known, as {self.why}."
        )


def rivals_told(run: Run | None) -> dict[str, dict[str, Any]]:
    """Effect -> how many parameters it has, as its test has them, and its `rivals`, as the run and
    its diagnosis tell them; empty where nothing was told. A rival has the effect as its own, as
    either may be added."""
    if run is None:
        return {}
    try:
        candidates = (run.diagnosis() or {}).get("candidates", ())
    except InputError:  # of another version
        candidates = ()
    told: dict[str, dict[str, Any]] = {}
    for each in candidates:
        if rivals := [r for r in each.get("rivals", ()) if r.keys() >= _OF_RIVAL]:
            told[each["add"]] = {"dof": each["dof"], "rivals": rivals}
    turned: dict[str, dict[str, Any]] = {}
    for name, each in told.items():
        for rival in (r for r in each["rivals"] if r["add"] not in told):
            of = {"add": name, "dof": each["dof"], "odds": 1.0 / max(rival["odds"], 1e-300)}
            other = turned.setdefault(rival["add"], {"dof": rival["dof"], "rivals": []})
            other["rivals"].append({**rival, **of})
    return {**run.summary.get("rivals", {}), **turned, **told}


def in_place(
    run: Run, stand: Stand, common: float, progress: Progress
) -> Iterator[InPlace | Untried]:
    """Rivals of the effects of a run's model with which it would fit as well.

    Args:
        run: the run.
        stand: as it stands.
        common: the inflation of its rows.
        progress: as of `fit.solve`.
    """
    every = run.summary.get("rivals", {})
    some = [effect for effect in stand.model.effects if effect.name in every]
    if some and not run.prior:  # as the others are fitted
        stand = stand.refitted(stand.model, stand.estimate.start, progress)
    there = {each.family for each in stand.model.effects}
    for effect in some:
        told = every[effect.name]
        for rival in sorted(told["rivals"], key=lambda each: each["odds"])[:MOST_IN_PLACE]:
            name = rival["add"]
            known = _known(stand, name)
            if known and known.family in there:
                continue
            other = _instead(run, stand, effect, known, progress)
            if isinstance(other, str):
                yield Untried(effect.name, name, other)
                continue
            priced = log_odds(stand, other, rival["dof"] - told["dof"], common)
            if priced < ODDS:
                yield InPlace(
                    effect=effect.name,
                    rival=name,
                    odds=float(np.exp(priced)),
                    change=_furthest(run, stand, other),
                    separate=rival["separate"],
                    alike=rival["alike"],
                )


def to_be_told(some: Sequence[InPlace]) -> list[str]:
    """The first effect that stops would tell from what fits in its place, and those rivals."""
    apart = [each for each in some if not each.alike]
    return (
        [apart[0].effect, *(e.rival for e in apart if e.effect == apart[0].effect)] if apart else []
    )


def _known(stand: Stand, name: str) -> Effect | None:
    """The effect of that name; None where it is of a file that is given no more."""
    own = (each for each in stand.own if each.name == name)
    try:
        return next(own, None) or find(name)
    except InputError:
        return None


def _instead(
    run: Run, stand: Stand, effect: Effect, other: Effect | None, progress: Progress
) -> Stand | str:
    """The model's fit with another effect in place of one; why there is none."""
    if run.prior:
        return "this run rests on an earlier one"
    if other is None:
        return "its file is not among the candidates"
    model = stand.model.minus([effect.name]).plus((other,))
    fitted = tried(stand.compared, model, stand.estimate.start, progress)
    if fitted is None or not fitted.estimate.converged:
        return "the fit with it comes to no optimum"
    return fitted


def _furthest(run: Run, stand: Stand, other: Stand) -> OtherEstimate:
    """Of the estimates that both have the one that differs most in its sigmas."""
    sigma = dict(zip(run.solution.keys, np.sqrt(np.diag(run.solution.covariance)), strict=True))
    there: Mapping[str, np.ndarray] = other.estimate.values
    found = []
    for unknown in (u for u in stand.estimate.variables if u.name in there):
        change = unknown.difference(stand.estimate.values[unknown.name], there[unknown.name])
        for dof, unit, by in zip(unknown.dofs, unknown.units, change.tolist(), strict=True):
            if own := sigma.get(key := Key(unknown.name, dof)):
                found.append(OtherEstimate(key.name, by, unit, float(abs(by) / own)))
    return max(found, key=lambda each: each.sigmas, default=OtherEstimate())
