"""What was found, in sentences for people."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from calib.diagnosis.chance import Chance
from calib.diagnosis.rejects import FEWEST_STOPS
from calib.diagnosis.screen import ODDS, Candidate
from calib.diagnosis.search import NamedEffect, Search
from calib.diagnosis.stand import Look
from calib.diagnosis.suggest import all_of, in_words, words
from calib.diagnosis.verdict.alike import columns_alike
from calib.diagnosis.verdict.matters import Weighed
from calib.results.holdout import TAKEN_BACK, from_to

UNNAMED, BAD = "unexplained_structure", "bad_data"
MOST_LISTED = 6  # untestable effects and rivals that a sentence names
# What moves, by what `diagnosis.json` calls it, as a sentence says it.
WHAT_MOVES = {
    "mount": "the mount moved",
    "lidar": "the LiDAR moved on its mount",
    "body": "the tracked body beyond the arm moved",
    "base": "the tracked body before the arm moved",
    "tracker": "the tracker moved, or the place where the base stands",
    "stand": "what the rig stands on moved",
    "elevation": "beams pointed higher or lower than they should",
    "azimuth": "beams pointed to the side of where they should",
}
LONGEST_FORM = 60  # letters of another form that a sentence has


def sentences_of(
    verdict: str,
    heavy: Weighed,
    candidates: Sequence[Mapping[str, Any]],
    unexplained: Sequence[Mapping[str, Any]],
    untestable: Mapping[str, str],
    blunders: Sequence[Mapping[str, Any]],
    deferred: bool = False,
    doubt: str = "",
) -> list[str]:
    """The finding in words, the verdict first; arguments as `conclude` has made them, `doubt` being
    what is said of structure that nothing confirms, and `deferred` as of `candidate_documents`."""
    found, traces = heavy.found, heavy.traces
    look = found.looks[0]
    residual = _residual(look)
    out = _first_sentences(verdict, look, bool(traces or heavy.refused))
    out += [each["sentence"] for each in blunders[:MOST_LISTED]]
    if len(blunders) > MOST_LISTED:
        out.append(f"And {len(blunders) - MOST_LISTED} more, in diagnosis.json.")
    formulas = [each for each in unexplained if "says" in each]
    for i, step in enumerate(found.found):
        candidate = next(c for c in candidates if c["add"] == step.effect.name)
        if not (formulas and candidate["dressed_up"]):  # what was tried before is of no use then
            out += _step_sentences(step, candidate, found.dressed_up(i))
    scatter = _scatter_sentences(found, deferred)
    # After the structure that it speaks of.
    told_later = deferred and bool(formulas) and verdict != UNNAMED
    out += [] if told_later else scatter
    out += [found.unsettled.unsettled] if found.unsettled and not found.sways else []
    out += [*heavy.refused, *traces]
    named = [c["add"] for c in candidates if c["step"] and not c["dressed_up"]]
    beside = f"Beside {all_of(named)}, there" if named else "There"
    structure = [
        f"{beside} is residual structure that no known effect explains.",
        *(line for each in formulas for line in _formula_sentences(each, residual)),
    ]
    if doubt:
        out = [doubt, *out]
    elif verdict == UNNAMED:
        out = [*structure, *out]
    elif formulas:
        out += [*structure, *(scatter if told_later else ())]
    out += _structure_sentences([each for each in unexplained if "says" not in each], residual)
    if found.scatter is not None:
        what = " and ".join(words(c) for c in found.scatter.effect.covariates)
        out.append(
            f"The noise depends on {what} otherwise than the LiDAR's noise model says: "
            f"{found.scatter.effect.name} would improve the weights of the rows; it does not "
            "change the mean."
        )
    gone = [name for name, why in untestable.items() if why.startswith("the recordings")]
    if gone:
        more = f" and {len(gone) - MOST_LISTED} more" if len(gone) > MOST_LISTED else ""
        out.append(
            f"Could not be tested on these recordings: {', '.join(gone[:MOST_LISTED])}{more}."
        )
    return out + look.stand.carried.sentences()


def scatters(some: Sequence[Chance]) -> list[Chance]:
    """Those of which something scatters, and that are not a few stops that are off."""
    return [chance for chance in some if not chance.agreed]


def _scatter_sentences(found: Search, deferred: bool) -> list[str]:
    """What is said of scatter by chance, and of a base that sways in place of some of it."""
    if found.sways:
        rest = (c for c in scatters(found.chance) if c.effect.name not in found.sways.names)
        return [found.sways.sentence, *(each.sentence for each in rest)]
    beside = ", ".join(each.effect.name for each in found.chance)
    if deferred and found.more:
        scatter = f"; random scatter ({beside}) is judged then" if beside else ""
        return [f"More effects are missing beside these: add them, and diagnose again{scatter}."]
    if deferred and beside:
        return [f"Random scatter ({beside}) is judged once that structure is in the model."]
    return [each.sentence for each in scatters(found.chance)]


def unconfirmed(candidate: Candidate | None, over: float) -> str:
    """Of structure that too few stops see for any test to confirm it, or of none, where the
    held-out error is so many times the expected one."""
    much = f"The held-out error is {over:.1f} times as large as expected, and no test "
    if candidate is None:
        return (
            f"{much}says why. No known effect and no structure in the residuals explains it: "
            "something else is wrong, or an instrument is noisier than rig.yaml says."
        )
    what = in_words(candidate.effect)
    return (
        f"{much}confirms why. Taken one by one, the beams show residuals that depend on {what}, "
        "but too few stops or surfaces see each part of that dependence to rule out chance. Stops "
        "that face other surfaces would decide it."
    )


def _first_sentences(verdict: str, look: Look, beside: bool) -> list[str]:
    """That nothing can be said, or that nothing is missing, `beside` what is significant and does
    not matter."""
    stops = stops_of(look)
    if stops < FEWEST_STOPS:
        return [
            f"No test is possible: {stops} stops are too few to name an effect, as all of them "
            f"may share one error; {FEWEST_STOPS} are the least, and 20 are better."
        ]
    if verdict != "adequate":
        return []
    out = [
        f"The model is adequate: of {len(look.named.candidates)} known effects and "
        f"{len(look.unnamed.candidates)} kinds of structure none "
        f"{'that matters ' if beside else ''}is significant."
    ]
    scans = len(look.stand.estimate.scans)
    if 0 < scans < FEWEST_STOPS:
        out.append(
            f"That says nothing of the LiDAR: scans of {scans} stop{'s' * (scans > 1)} are too few "
            f"to name an effect of it, and {FEWEST_STOPS} are the least."
        )
    described = [effect.name for effect in look.stand.model.effects if effect.seen]
    if described:
        out.append(
            f"Part of it is an empirical description without a known cause: {', '.join(described)}."
        )
    return out


def _structure_sentences(unexplained: Sequence[Mapping[str, Any]], residual: str) -> list[str]:
    """Of residual structure."""
    out = []
    for each in unexplained[:2]:
        ring, on = each.get("ring"), each["covariates"]
        what = " and ".join(words(c) for c in on if c != "ring" or ring is None)
        what += "" if ring is None else f", most clearly in ring {ring}"
        moves = f", as if {WHAT_MOVES[each['moves']]}" if each.get("moves") else ""
        out.append(
            f"The residual structure depends on {what}{moves}: {each['rms_mm']:.2f} mm rms of "
            f"{residual}."
        )
        if each["formula"]:
            out.append(
                f"An empirical effect for it can be added by its name, '{each['formula']['name']}'."
                f" {each['formula']['what']}"
            )
    return out


def _formula_sentences(each: Mapping[str, Any], residual: str) -> list[str]:
    """Of structure whose formula was found: what it does, how it is added, and why it may be so."""
    went = from_to(each)
    fall = f" The held-out error goes from {went}." if went else ""
    was, now = (each["rejected_share"][k] for k in ("before", "after"))
    if None not in (was, now) and was - now > TAKEN_BACK:
        fall += f" Rejected beams go from {100 * was:.1f} to {100 * now:.1f} %."
    out = [
        f"Its formula: {each['says']}.",
        f"Of its effect on {residual}, {each['rms_mm']:.2f} mm rms is not absorbed by the model "
        f"(adjusted p = {each['p_adjusted']:.1g}).{fall}",
        f"It can be added by its name, '{each['formula']['name']}'. {each['formula']['what']}",
    ]
    for other in each["alike"][:1]:
        out.append(
            f"On these data it is not distinguishable from {_other(other)}; {other['separate']} "
            "would separate them."
        )
    return [*out, *_why_sentences(each["why"])]


def _other(form: Mapping[str, Any]) -> str:
    """Another form: as it is where it is short, else by what it depends on."""
    if len(form["says"]) <= LONGEST_FORM:
        return form["says"]
    return f"another formula, over {' and '.join(words(c) for c in form['covariates'])}"


def _why_sentences(why: Mapping[str, Any]) -> list[str]:
    """What could be behind a formula, and what would confirm it."""
    out = [
        f"What {words(name)} may do: {what}. To confirm it: {why['experiments'][name]}."
        for name, what in why["mechanisms"].items()
    ]
    if why["known"]:
        out.append(
            f"Known effects of the same columns may look like it on other recordings: "
            f"{', '.join(why['known'][:MOST_LISTED])}."
        )
    return out


def _step_sentences(step: NamedEffect, candidate: Mapping[str, Any], worn: bool) -> list[str]:
    """Of a named effect; `worn` where bins explain more than it does."""
    went = from_to(candidate)
    if candidate["dressed_up"]:
        why = "a generic function (bins) explains more, or as much by fewer parameters"
        if went and not worn:
            why = f"most of the held-out error stays ({went})"
        return [
            f"{step.effect.name} was tried and rejected: it absorbs part of the residuals, but "
            f"{why}."
        ]
    fall = f"; the held-out error goes from {went}" if went else ""
    was, now = (candidate["rejected_share"][k] for k in ("before", "after"))
    fall += "" if was is None else f", rejected beams from {100 * was:.1f} to {100 * now:.1f} %"
    out = [
        f"{step.effect.name} is missing: it changes {_residual(step.before)} by "
        f"{candidate['rms_mm']:.2f} mm rms, of which {candidate['unabsorbed_rms_mm']:.2f} mm is "
        f"not absorbed by the model (adjusted p = {step.p_adjusted:.1g}){fall}."
    ]
    if step.effect.twin:
        out.append(f"Nothing that was measured tells it from {step.effect.twin}.")
    out += [
        f"At these stops {other} goes with {name}, so nothing tells which of the "
        "two the error follows."
        for name, other in columns_alike(step)
    ]
    out += [
        f"Nothing that was measured tells it from {all_of(pair['effects'])} together."
        for pair in candidate["together"][:MOST_LISTED]
    ]
    return [*out, *map(rival_sentence, candidate["rivals"][:MOST_LISTED])]


def rival_sentence(rival: Mapping[str, Any]) -> str:
    """Of a rival of an effect, as `rivals` of diagnosis.json has it."""
    told = odds_told(odds := rival["odds"])
    said = f"On these data it is not distinguishable from {rival['effect']} ({told})"
    if odds < np.exp(-ODDS):
        said = f"{rival['effect']} explains more ({told})"
    return f"{said}; {rival['separate']} would separate them."


def odds_told(odds: float) -> str:
    """Odds of one effect to another, in words."""
    ratio = max(odds, 1.0 / max(odds, 1e-300))
    many = "more than a million" if ratio > 1e6 else f"{ratio:,.{1 if ratio < 100 else 0}f}"
    return f"odds {many} to 1" if odds >= 1.0 else f"odds 1 to {many}"


def _residual(look: Look) -> str:
    return "the ranges" if look.stand.estimate.scans else "the tracked poses"


def stops_of(look: Look) -> int:
    """How many stops were measured."""
    return look.linear.whole.layout.measured
