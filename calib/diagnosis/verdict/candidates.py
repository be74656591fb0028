"""Candidates as the contract has them: what each would explain, and beside what."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Any

import numpy as np

from calib.diagnosis.everywhere import Everywhere
from calib.diagnosis.screen import Candidate, angle_deg
from calib.diagnosis.search import NamedEffect, Search
from calib.diagnosis.search.confirmed import ALPHA_EFFECT, ALPHA_NOISE
from calib.diagnosis.search.named import Rival
from calib.diagnosis.suggest import what_separates
from calib.diagnosis.verdict.matters import Weighed
from calib.effects import Site
from calib.results.holdout import Fall, fall_document
from calib.results.solution import one_unit

# Of what an effect explains, from which on others do the same. Of a tracker's scale, those of LiDAR
# and scanner explain 0.9999 together, the next pair 0.92 (30 stops of a rig of the whole chain).
THE_SAME = 0.99
LOST_BY_CHANCE = 6.6  # squared sigmas that one parameter explains by chance once in a hundred times
ALIKE = (
    "no stops (at every pose of the arm both move all that is seen alike), but a measurement of "
    "one of them itself"
)


def candidate_documents(
    heavy: Weighed,
    held_out: Mapping[str, Fall],
    deferred: bool,
    worn: Sequence[str],
) -> list[dict[str, Any]]:
    """All of them, those first that were confirmed.

    Args:
        heavy: what of the search matters.
        held_out: as of `conclude`.
        deferred: whether scatter by chance is to be judged once what else is missing is in the
            model.
        worn: names that stand in for it.
    """
    found = heavy.found
    named, out = len(found.found), [_candidate(c, found, held_out) for c in _ranked(found)]
    for each in out:
        told_of = heavy.matter.get(each["add"])
        each["matters"] = told_of.document() if told_of else None
        each["dressed_up"] = bool(each["step"]) and each["add"] in worn
    # Residual structure may be random scatter: that is judged once it is in the model.
    no_step = [deferred or each.agreed for each in found.chance]
    chance = [
        each.document(None if no else named + i)
        for i, (each, no) in enumerate(zip(found.chance, no_step, strict=True), 1)
    ]
    beside = found.beside if found.scatter_judged else found.looks[-1]
    others = [each.document(None) for each in beside.chance]
    return [*out[:named], *chance, *out[named:], *others]


def _ranked(found: Search) -> list[Candidate]:
    """Those confirmed first, in the order in which they were; then by what they explain."""
    confirmed = [step.candidate for step in found.found]
    families = {c.effect.family for c in confirmed}
    rest = (c for c in found.looks[0].named.candidates if c.effect.family not in families)
    noise = found.looks[-1].noise.candidates
    if found.scatter is not None:
        family = found.scatter.effect.family
        noise = [found.scatter, *(c for c in noise if c.effect.family != family)]
    return [*confirmed, *rest, *noise]


def _candidate(candidate: Candidate, found: Search, held_out: Mapping[str, Fall]) -> dict[str, Any]:
    """As the contract has it."""
    effect, test, look = candidate.effect, candidate.test, found.looks[0].named
    step = next((i for i, s in enumerate(found.found, 1) if s.effect.name == effect.name), None)
    if step:
        look = found.found[step - 1].before.named
    rig = next(s.rig for s in found.looks[0].stand.sources if effect.params(s.rig))
    params = [p for p in effect.params(rig) if p.sigma]
    whole = len(params) == len(test.columns)
    fall = held_out.get(effect.name)
    noise = effect.site is Site.NOISE
    clean = (found.looks[-1].noise if noise else found.looks[-1].named).common
    rivals = _rivals(found.found[step - 1]) if step else []
    estimate, sigma = test.estimate(), test.sigma(max(clean, 1.0))
    if step:
        estimate = found.looks[-1].stand.theta(effect)
        sigma = found.looks[-1].stand.sigma(effect)
    level = ALPHA_NOISE if noise else ALPHA_EFFECT
    alpha = -np.expm1(np.log1p(-level) / candidate.looks)
    document = effect.document()
    return {
        "effect": effect.family,
        "add": effect.name,
        # Of a user's own: what `rigcal add` reads, wherever its file is by then.
        **({} if isinstance(document, str) else {"document": document}),
        "site": "range" if effect.site is Site.BEAM else effect.site.value,
        "p_value": candidate.p_value,
        "p_adjusted": found.found[step - 1].p_adjusted if step else candidate.p_adjusted,
        "statistic": test.statistic,
        "dof": test.dof,
        "step": step,
        "dressed_up": False,
        **fall_document(fall),
        "held_out_spread_mm": fall.spread_mm if fall else None,
        "rejected_share": _shares(fall),
        "error_explained": None if fall is None or fall.takes_back else fall.explained,
        "rms_mm": None if noise else 1e3 * look.size_m(candidate),
        "unabsorbed_rms_mm": None if noise else 1e3 * look.rms_m(candidate),
        "parameters": {
            "unit": one_unit([p.unit for p in params]),
            "names": [p.name for p in params] if whole else [],
            "estimate": estimate if whole else [],
            "sigma": sigma if whole else [],
        },
        "smallest_detectable": test.smallest_detectable(clean, alpha),
        "indistinguishable_from": [r["effect"] for r in rivals],
        "rivals": rivals,
        "together": _pairs(found.found[step - 1]) if step else [],
    }


def _shares(fall: Fall | None) -> dict[str, float | None]:
    """Of the beams held out that were rejected, where it takes some back."""
    both = fall.rejected_share if fall and fall.takes_back else None
    return dict(zip(("before", "after"), both or (None, None), strict=True))


def _rivals(step: NamedEffect) -> list[dict[str, Any]]:
    screen, family = step.before.named, step.effect.family
    on_grid = next((c for c in screen.candidates if c.effect.family == family), step.candidate)
    alike = {other.effect.name for other in step.rivals if _alike(step, other)}
    return [
        {
            "effect": other.effect.family,
            "add": other.effect.name,
            "dof": other.candidate.test.dof,
            "angle_deg": angle_deg(screen, on_grid, other.candidate),
            "odds": float(np.exp(other.log_odds)),
            "separate": (
                ALIKE if other.effect.name in alike else what_separates(step.effect, other.effect)
            ),
            "alike": other.effect.name in alike,
        }
        for other in step.rivals
    ]


def _pairs(step: NamedEffect) -> list[dict[str, Any]]:
    """Two effects that together do to all that is measured what one of one parameter does, though
    neither of them does alone: as the scales of three instruments, of which only ratios show."""
    screen, columns = step.before.named, step.candidate.test.columns
    if len(columns) > 1 or step.effect.shape_name:  # its finest shape is known by itself alone
        return []
    column, lost = columns[0], LOST_BY_CHANCE * screen.common / step.candidate.test.statistic
    alone = {step.effect.family, *(rival.effect.family for rival in step.rivals)}
    single = [c for c in screen.candidates if len(c.test.columns) == 1]
    information, size = screen.scores.information, float(step.candidate.test.estimate()[0])
    out = []
    for pair in combinations([c for c in single if c.effect.family not in alone], 2):
        both = np.concatenate([c.test.columns for c in pair])
        each = np.linalg.lstsq(information[np.ix_(both, both)], information[both, column])[0]
        share = each @ information[both, column] / information[column, column]
        if 1.0 - share <= min(lost, 1.0 - THE_SAME):
            names = [c.effect.family for c in pair]
            out.append({"effects": names, "estimate": (size * each).tolist()})
    return out


def _alike(step: NamedEffect, other: Rival) -> bool:
    """Whether an effect and a rival move alike all that is seen, at every pose of the arm."""
    both = (step.effect, other.effect)
    if not all(effect.site in (Site.EDGE, Site.JOINTS) for effect in both):
        return False
    everywhere = Everywhere.of(step.before.stand, both)
    return everywhere is not None and everywhere.alike(*(effect.name for effect in both))
