"""The diagnosis: what was found, in numbers for scripts and in sentences for people."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from typing import Any

from calib.blunders import told
from calib.blunders.judged import Blunder
from calib.blunders.lasting import lasting, told_once
from calib.blunders.reach import FurthestMoved
from calib.diagnosis.candidates import concerned, lacking
from calib.diagnosis.chance.serial import ALPHA_SERIAL, drifting
from calib.diagnosis.rejects import FEWEST_STOPS, Rejects
from calib.diagnosis.screen import Candidate, Screen
from calib.diagnosis.search import Search
from calib.diagnosis.search.confirmed import ALPHA_UNNAMED, suspects
from calib.diagnosis.stand import Look
from calib.diagnosis.structure import ring_of, what_moves
from calib.diagnosis.suggest import formula, hangs_on
from calib.diagnosis.verdict.candidates import candidate_documents
from calib.diagnosis.verdict.curves import Curve, curves
from calib.diagnosis.verdict.matters import (
    ABSORBED,
    HELD_OUT_BESIDE_SCATTER,
    HELD_OUT_BY_CHANCE,
    HELD_OUT_UNSAID,
    weighed,
)
from calib.diagnosis.verdict.names import absorbed, believed, beside_scatter, dressed_up
from calib.diagnosis.verdict.sentences import (
    BAD,
    UNNAMED,
    scatters,
    sentences_of,
    stops_of,
    unconfirmed,
)
from calib.diagnosis.verdict.unnamed import Unnamed
from calib.residuals.groups import Group
from calib.results.errors import judged_mm, over_expected
from calib.results.holdout import Fall

VERDICTS = {
    "adequate": "the model is adequate",
    "missing_effect": "an effect is missing",
    UNNAMED: "structure that no effect explains",
    BAD: "something in the recording is wrong",
}
OF_TIME = frozenset({"time_s", "elapsed_s"})
ABSORBED_BY_MODEL = "not identifiable: absorbed by the model"


@dataclass(frozen=True)
class Diagnosis:
    """What is missing from a model.

    Args:
        verdict: "adequate", "missing_effect", "unexplained_structure" or "bad_data".
        sentences: the finding in words, the verdict first.
        candidates: the catalogue's effects that the model lacks, best first.
        unexplained: structure that no effect accounts for, strongest first.
        weak_directions: what the data hardly determine, and what would.
        untestable: effect -> what the recordings lack to test it.
        blunders: groups of rows that were left out, as nothing but a mishap explains them.
        lasting: those of them that follow each other, as one.
        groups: all groups of rows that were looked at, and how far out each is.
        misfit: instrument -> how many times larger than their sigmas its residuals are.
        curves: mean residual against covariates.
        too_few: whether the stops are too few to say anything, whatever the verdict.
        command: what fits the same without the blunders, or adds what is missing, ready to be
            typed; empty without any.
        plan: what plans stops that separate what these do not, ready to be typed; or empty.
        remedies: what would tell of each weak direction, of each group of effects that nothing
            tells apart and of each effect that could not be tested: `of` which of these, `names`,
            what it `needs`, and the command that plans such stops, None where no stops help.
        rejected: what the fit threw away; None without scans, or where nobody looked.
        scatter: how widely things scatter by chance, of the model and of what it lacks.
        in_place: effects that would fit as well in place of one that the model has.
        detectable: of what is no group of rows: name -> unit -> least size of a mishap to be found.
        unseen: group of rows -> how far a mishap to it that is not found could move an estimate.
    """

    verdict: str
    sentences: Sequence[str]
    candidates: Sequence[Mapping[str, Any]]
    unexplained: Sequence[Mapping[str, Any]]
    weak_directions: Sequence[Mapping[str, Any]]
    untestable: Mapping[str, str]
    misfit: Mapping[str, float]
    curves: Sequence[Curve] = field(repr=False)
    blunders: Sequence[Mapping[str, Any]] = ()
    lasting: Sequence[Mapping[str, Any]] = ()
    groups: Sequence[Blunder] = field(default=(), repr=False)
    too_few: bool = False
    command: str = ""
    plan: str = ""
    remedies: Sequence[Mapping[str, Any]] = ()
    rejected: Rejects | None = None
    scatter: Sequence[Mapping[str, Any]] = ()
    in_place: Sequence[Mapping[str, Any]] = ()
    detectable: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    unseen: Mapping[Group, FurthestMoved] = field(default_factory=dict, repr=False)

    @property
    def heading(self) -> str:
        """The verdict in words."""
        return "none, the stops are too few" if self.too_few else VERDICTS[self.verdict]

    @property
    def worth_adding(self) -> list[str]:
        """Names of the effects that were confirmed, in the order in which to add them; not those
        that stand in for residual structure."""
        return worth_adding(self.candidates)

    @property
    def formulas(self) -> dict[str, Mapping[str, Any]]:
        """Name -> the effect that draws residual structure; none beside a verdict that needs
        none."""
        found = [u for u in self.unexplained if self.verdict in (UNNAMED, "missing_effect")]
        return {u["formula"]["name"]: u["formula"] for u in found if "says" in u}

    def document(self) -> dict[str, Any]:
        """As written to diagnosis.json."""
        return {
            "verdict": self.verdict,
            "heading": self.heading,
            "too_few_stops": self.too_few,
            "sentences": list(self.sentences),
            "candidates": list(self.candidates),
            "unexplained": list(self.unexplained),
            "weak_directions": list(self.weak_directions),
            "untestable": dict(self.untestable),
            "blunders": list(self.blunders),
            "lasting": list(self.lasting),
            "command": self.command or None,
            "plan": self.plan or None,
            "remedies": list(self.remedies),
            "in_place": list(self.in_place),
            **told.groups(self.groups, self.detectable, self.unseen),
            "scatter": list(self.scatter),
            "misfit": dict(self.misfit),
            "rejected": self.rejected.document() if self.rejected else None,
            "curves": [curve.document() for curve in self.curves],
        }


def worth_adding(candidates: Sequence[Mapping[str, Any]]) -> list[str]:
    """Names of the confirmed among a diagnosis' candidates; see `calib.diagnosis.Diagnosis`."""
    confirmed = [c for c in candidates if c["step"] and not c["dressed_up"]]
    return [c["add"] for c in sorted(confirmed, key=lambda c: c["step"])]


def conclude(
    found: Search,
    held_out: Mapping[str, Fall],
    summary: Mapping[str, Any],
    weak: Sequence[Mapping[str, Any]],
    rejected: Rejects | None = None,
    forbids: Sequence[str] = (),
    plain: Sequence[Mapping[str, Any]] = (),
    formulas: Unnamed = Unnamed(),  # noqa: B008 - frozen
) -> Diagnosis:
    """Sum up a search.

    Args:
        found: the search.
        held_out: effect, or what scatters -> how the held-out error falls once it is fitted.
        summary: of the run: its errors, and its misfit by instrument.
        weak: weak directions.
        rejected: what the fit threw away.
        forbids: why the run is not to be believed, whatever its model explains; a clause each.
        plain: what is wrong whatever the search says, as blunders: rings, an arm not as drawn.
        formulas: of residual structure.
    """
    heavy = weighed(found, held_out, judged_mm(summary))
    found, first = heavy.found, found.looks[0]
    blunders = _blunders(found, rejected, plain, bool(formulas.formulas))
    hold = believed(found, held_out) and not formulas.instead
    more = formulas.formulas or found.unsettled or (heavy.refused and found.at_first)
    more = bool(more or (rejected and not rejected.explained))
    over = _over_the_expected(found, held_out, summary)
    unsure, doubt = (False, None) if blunders or more else _unconfirmed(found, over)
    calm = BAD if forbids else UNNAMED if unsure else "adequate"
    answer = hold and not formulas.needless
    verdict = BAD if blunders else _verdict(found, answer, more, unsure, calm)
    stands_in = verdict == UNNAMED or formulas.instead
    worn = dressed_up(found, held_out, hold, formulas) if stands_in else [*formulas.needless]
    unexplained = _structure(found, verdict, formulas, rejected, doubt)
    deferred = _deferred(found, verdict, unsure and doubt is None, formulas)
    candidates = candidate_documents(heavy, held_out, deferred, worn)
    untestable, said = _untestable(first), unconfirmed(doubt, over) if unsure else ""
    last = [*lasting(found.blunders, first.checked, first.stand.sources)]
    told_of = verdict, heavy, candidates, unexplained, untestable, told_once(last, blunders)
    sentences = sentences_of(*told_of, deferred=deferred, doubt=said)
    _caution(sentences, verdict, formulas, rejected, () if blunders else forbids)
    sentences += _drifts(found, unexplained)
    return Diagnosis(
        verdict=verdict,
        sentences=sentences,
        candidates=candidates,
        unexplained=unexplained,
        weak_directions=weak,
        untestable=untestable,
        blunders=blunders,
        lasting=last,
        groups=[*(left.blunder for left in found.blunders), *(found.beside or first).blunders],
        misfit=summary["misfit"],
        curves=curves(first.unnamed),
        too_few=stops_of(first) < FEWEST_STOPS,
        rejected=rejected,
        scatter=[s.document(c.effect.name) for c in scatters(found.chance) for s in c.spreads],
    )


def _deferred(found: Search, verdict: str, unknown: bool, formulas: Unnamed) -> bool:
    """Whether scatter is to be judged once what else is missing is in the model; arguments as in
    `conclude`, where nobody knows a structure that nothing confirms if it is `unknown`."""
    missing = found.more or formulas.formulas or (verdict == UNNAMED and not unknown)
    return bool(missing) and not found.scatter_judged


def _blunders(
    found: Search,
    rejected: Rejects | None,
    plain: Sequence[Mapping[str, Any]],
    described: bool,
) -> list[Mapping[str, Any]]:
    """All that is wrong in the recordings; arguments as of `conclude`. What some stops are off by
    is judged once nothing else is missing, structure that formulas have `described` included."""
    sources = found.looks[0].stand.sources
    thrown = rejected.blunders(sources, alone=not found.found) if rejected else ()
    sways = found.sways.names if found.sways else ()
    judged = not (found.more or found.unnamed or described)
    some = [c.agreements for c in found.chance if judged and c.effect.name not in sways]
    off = [each for agreed in chain(*some) if agreed for each in agreed.blunders()]
    # Stops that are off by the same move a frame between what they say and what others do.
    left = (each for each in found.blunders if not (off and each.blunder.group.kind == "frame"))
    return [*plain, *thrown, *(told.document(each, sources) for each in left), *off]


def _caution(
    sentences: list[str],
    verdict: str,
    formulas: Unnamed,
    rejected: Rejects | None,
    forbids: Sequence[str],
) -> None:
    """Add what is to be said of the run, of a formula that was refused, and of what was rejected:
    first where it is the verdict, else last. Arguments are as of `conclude`."""
    if forbids and verdict in (BAD, UNNAMED):
        sentences.insert(0 if verdict == BAD else len(sentences), _disbelief(forbids))
    sentences += [formulas.refused] if formulas.refused else []
    if rejected:
        leads = not formulas.formulas and verdict == UNNAMED and not rejected.explained
        sentences.insert(0 if leads else len(sentences), rejected.sentence)


def _drifts(found: Search, unexplained: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """What is said of tracked poses that err alike in time beside all that was found: of structure
    over the pose as little as of scatter that says it itself, but where a name goes with time."""
    last = found.beside or found.looks[-1]
    names = [step.effect.name for step in found.found if step.effect.goes_with_time]
    of_time = {c for each in unexplained for c in each["covariates"]} <= OF_TIME
    told = any(min(c.p_serial, c.p_of_pose) < ALPHA_SERIAL for c in found.chance)
    if not last.stand.estimate.converged or told or not (names or of_time):
        return iter(())
    return drifting(last.stand.estimate.problem, last.blunders, names)


def _disbelief(forbids: Sequence[str]) -> str:
    return f"This run should not be used as it stands: {'; '.join(forbids)}."


def _over_the_expected(
    found: Search, held_out: Mapping[str, Fall], summary: Mapping[str, Any]
) -> float:
    """The held-out error over the expected one, of the model with what scatters by chance; 0 where
    nothing was held out, or too few stops to tell."""
    each = summary.get("held_out_each_mm")  # which earlier versions lack
    if each is not None and len(each) < FEWEST_STOPS:
        return 0.0
    if fall := beside_scatter(found, held_out):
        return fall.after_mm / fall.floor_mm
    return 0.0 if found.chance else over_expected(summary)


def _unconfirmed(found: Search, over: float) -> tuple[bool, Candidate | None]:
    """Whether the held-out error is larger than chance makes it and no structure or effect is
    found, and structure that single beams show: so few stops, or walls, see each part of it that
    they may differ by chance as much. Without any the error has to be larger still. Not where
    beams scatter by themselves so widely that the error is as expected of them; nor of an arm
    alone, or of fewer stops than tests need, of which the limits were not measured."""
    first, last = found.looks[0], found.looks[-1]
    there = found.unnamed or found.found or found.at_first
    if there or not first.stand.estimate.scans or stops_of(first) < FEWEST_STOPS:
        return False, None
    alone = max(1.0, last.stand.beams.alone)
    if over <= (HELD_OUT_BESIDE_SCATTER if found.chance else HELD_OUT_BY_CHANCE) * alone:
        return False, None
    shown = next(suspects(last.unnamed, ALPHA_UNNAMED), None)
    return shown is not None or over > HELD_OUT_UNSAID * alone, shown


def _verdict(found: Search, hold: bool, more: bool, doubt: bool, calm: str) -> str:
    """Of a search without blunders.

    Args:
        found: the search.
        hold: whether its names are to be believed.
        more: whether there is something beside all that it found.
        doubt: whether there may be, and nothing confirms it.
        calm: the verdict where it found nothing.
    """
    if not found.found:
        if found.unnamed or more or (doubt and found.chance):
            return UNNAMED
        return "missing_effect" if found.chance else calm
    named = hold and (not found.unnamed or absorbed(found) > ABSORBED)
    return "missing_effect" if named else UNNAMED


def _without_a_name(found: Search, verdict: str) -> list[tuple[Screen, Candidate]]:
    """The residual structure that is left; as it stood at first if the first name is not to be
    believed, or was refused and none is left."""
    worn = verdict == UNNAMED and (found.dressed_up(0) if found.found else bool(found.at_first))
    left, look = (found.at_first, 0) if worn else (found.unnamed, -1)
    return [(found.looks[look].unnamed, c) for c in left]


def _structure(
    found: Search,
    verdict: str,
    formulas: Unnamed,
    rejected: Rejects | None,
    doubt: Candidate | None,
) -> list[Mapping[str, Any]]:
    """Residual structure: formulas, or bins where there are none, be they in doubt; and that of
    what was rejected."""
    thrown = rejected.unexplained() if rejected and verdict == UNNAMED else []
    taken = found.looks[0].stand.model.names
    if formulas.formulas:
        drawn = {c for each in formulas.formulas for c in each.covariates}
        return [*formulas.documents(taken), *(t for t in thrown if not drawn >= {*t["covariates"]})]
    left = _without_a_name(found, verdict)
    left += [(found.looks[-1].unnamed, doubt)] if doubt else []
    return [*thrown, *(_unexplained(c, screen, taken) for screen, c in left)]


def _unexplained(candidate: Candidate, screen: Screen, taken: Sequence[str]) -> dict[str, Any]:
    return {
        "covariates": list(hangs_on(candidate.effect)),
        "rms_mm": 1e3 * screen.rms_m(candidate),
        "p_value": candidate.p_value,
        "p_adjusted": candidate.p_adjusted,
        "formula": formula(candidate, taken),
        "seen": {name: list(ends) for name, ends in candidate.effect.seen.items()},
        "moves": what_moves(candidate.effect),
        "ring": ring_of(candidate.effect),
    }


def _untestable(look: Look) -> dict[str, str]:
    found, carried = {}, look.stand.carried
    there = {e.family for e in look.stand.model.effects}
    gauges = {g.family for g in look.named.gauges} - {
        c.effect.family for c in look.named.candidates
    }
    for effect in look.stand.catalogue:
        if effect.family in there or not concerned(effect, look.stand.sources):
            continue
        if missing := lacking(effect, look.stand.sources, carried.everywhere):
            each = (f"{m}{carried.where_not(m)}" for m in missing)
            found[effect.family] = f"the recordings lack {', '.join(each)}"
        elif effect.family in gauges:
            found[effect.family] = ABSORBED_BY_MODEL
    return found
