"""What is known of a set of effects before it is fitted: from what was fitted already, or from one
linearisation.

A diagnosis fits what it names, one effect after another, to all stops but those held out, and says
what becomes of the error there. A run on the workbench may have the very set.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any

from calib.runs.run import Run
from calib.view.desk import Findings
from calib.view.shown.columns import comparable

SAME = 1e-6  # relative: one error, read from two files
# What two runs must share, beside recordings and effects, for one to tell of the other.
ASKED = ("fixed", "without", "hold_out", "folds", "prior_sha256")
NOT_KNOWN_YET = "The held-out error is not known before the refit."
Effects = Mapping[str, Any]  # name -> name, or document of a formula


def told(run: Run, wanted: Effects, findings: Findings | None, runs: Mapping[str, Run]) -> str:
    """What is known, in a sentence, of the error of stops held out were a run's model to have other
    effects.

    Args:
        run: the run.
        wanted: the effects.
        findings: of the run; None where it was not diagnosed.
        runs: by name, others that may have been fitted with these effects.
    """
    added, dropped = difference(run.effects, wanted)
    before = run.summary["rms_mm"]["held_out"]
    if not added and not dropped:
        return "These are the effects of the run. Tick others, or untick some."
    if before is None:
        return "No stop was held out of this run, so no error is expected."
    for name, other in runs.items():
        after = other.summary["rms_mm"]["held_out"]
        if after is not None and _is_of(other, run, wanted):
            return f"{_fall(before, after)}: so it was fitted, as {name}."
    if findings is not None and not dropped:
        after = fitted(findings, before).get(frozenset(added))
        if after is not None:
            return f"{_fall(before, after)}: so the diagnosis fitted it."
        sizes = {c["add"]: c["unabsorbed_rms_mm"] for c in findings.candidates}
        alone = sizes.get(next(iter(added))) if len(added) == 1 else None
        if alone is not None:
            return f"It explains {alone:.2f} mm rms of what this fit left. {NOT_KNOWN_YET}"
    return NOT_KNOWN_YET


def linearised(before: float, after: float | None) -> str:
    """What is told of an error that one linearisation leads to; None where there is none."""
    if after is None:
        return NOT_KNOWN_YET
    return f"{_fall(before, after)}, by one step of the linearised fit."


def fitted(findings: Findings, before_mm: float) -> dict[frozenset[str], float]:
    """Effects that a diagnosis added together -> the held-out error with them, mm.

    Args:
        findings: what it found.
        before_mm: the held-out error of the run. A fit that began elsewhere, as without what is
            wrong in the recording, tells nothing of the run's.
    """
    known = {frozenset[str](): before_mm}
    added = [({c["add"]}, c["held_out_rms_mm"]) for c in _steps(findings.candidates)]
    formulas = [each for each in findings.unexplained if each.get("formula")]
    if formulas:  # fitted together, after the names or in their place
        names = {each["formula"]["name"] for each in formulas}
        added.append((names, formulas[0].get("held_out_rms_mm") or {}))
    for names, fall in added:
        start, after = fall.get("before"), fall.get("after")
        if start is not None and after is not None:
            under = [some for some, mm in known.items() if math.isclose(mm, start, rel_tol=SAME)]
            known |= {some | names: after for some in under[-1:]}
    del known[frozenset()]
    return known


def _steps(candidates: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    return sorted((c for c in candidates if c["step"]), key=lambda c: c["step"])


def _is_of(other: Run, run: Run, wanted: Effects) -> bool:
    """Whether a run is what another would be with these effects."""
    if not comparable(run, other) or set(other.effects) != set(wanted):
        return False
    if any(other.model.get(key) != run.model.get(key) for key in ASKED):
        return False
    theirs = dict(zip(other.effects, other.model["effects"], strict=True))
    return all(_alike(theirs[name], what) for name, what in wanted.items())


def _alike(one: Any, other: Any) -> bool:
    """Whether two documents are of one effect: a name, or a formula, may be called as another."""
    if isinstance(one, Mapping) and isinstance(other, Mapping):
        return all(one.get(key) == other.get(key) for key in ("site", "basis", "python"))
    return isinstance(one, str) == isinstance(other, str)


def _fall(before: float, after: float) -> str:
    return f"Expected held-out error: {before:.2f} → {after:.2f} mm"


def difference(own: Collection[str], wanted: Effects) -> tuple[dict[str, Any], list[str]]:
    """What is added to a model's own effects, as `rigcal add` takes it, and what is taken away."""
    added = {name: what for name, what in wanted.items() if name not in own}
    return added, [name for name in own if name not in wanted]
