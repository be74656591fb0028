"""Which physical effect is missing: ``rigcal diagnose``."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from calib import outputs
from calib.blunders import told
from calib.blunders.reach import FurthestMoved, hardly_checked, reaches
from calib.diagnosis.chance import Spread
from calib.diagnosis.rejects import Rejects, rejects
from calib.diagnosis.search import Search, beside_formulas, nameless, search
from calib.diagnosis.search.confirmed import structures
from calib.diagnosis.stand import Look, Stand, tried
from calib.diagnosis.verdict import Diagnosis, conclude
from calib.diagnosis.verdict.known import by_name
from calib.diagnosis.verdict.matters import HELD_OUT_BY_CHANCE, borne_out, unchecked, weighed
from calib.diagnosis.verdict.names import believed
from calib.diagnosis.verdict.sentences import UNNAMED
from calib.diagnosis.verdict.unnamed import Unnamed, unnamed, with_formulas
from calib.diagnosis.weak import to_be_told_apart, weak_directions
from calib.effects.reference import FaroScale
from calib.linear.parallel import one_blas_thread
from calib.outputs.journal import going_on
from calib.problem.spread import names_of
from calib.recalibration.between import contradictions
from calib.residuals.groups import MESH, Group
from calib.results.errors import Errors, held_out_size, judged_mm, over_expected, tells_of_poses
from calib.results.holdout import Fall, gains_m2, held_out
from calib.results.observability import not_heard, seen_alone, shown_by_no_other
from calib.results.outstanding import moves
from calib.results.rings import detectable, misnumbered
from calib.results.sigmas import TOLERATED
from calib.results.stages import DIAGNOSE as DIAGNOSE_STAGES
from calib.results.stages import staged
from calib.runs.asked.commands import (
    can_be_planned_for,
    command_to_plan,
    next_command,
    remedies,
)
from calib.runs.asked.in_place import InPlace, Untried, in_place, to_be_told
from calib.runs.belief import cautions, forbids
from calib.runs.reopen import identity, stand_of
from calib.runs.run import DIAGNOSIS, Run
from calib.solve.fit import Progress
from calib.solve.otherwise.rooms import rooms_turned
from sensors.documents import write_json


@one_blas_thread
def diagnose(
    run: Run,
    progress: Progress = lambda what, done, total: None,
    refits: bool = True,
    candidates: str | Sequence[str] = (),
    kept: outputs.Kept | None = None,
) -> Diagnosis:
    """Find where a run's model fails and which effect it lacks; written to its diagnosis.json.

    Args:
        run: a fitted run, with its recordings where they were.
        progress: called with what is being done, and how far it is.
        refits: whether effects found are fitted without the held-out stops too.
        candidates: files of effects of the user's own, tested beside the catalogue and those that
            ``rig.yaml`` names; see `calib.effects.load_effects`.
        kept: what to go on from, and to add to; beside the run until it is done where None.

    Raises:
        InputError: the recordings are not what they were, or a file of effects is wrong.
    """
    with outputs.entries(run.folder, outputs.RUN) as entries:
        stand = stand_of(run, progress := staged(progress, DIAGNOSE_STAGES), candidates)
        asked = {**identity(run), "refits": refits, "own": [e.document() for e in stand.own]}
        with going_on(kept.of(asked) if kept else outputs.kept(entries, asked)):
            result = _found(run, stand, refits, progress)
        write_json(entries / DIAGNOSIS, result.document())
    return result


def _found(run: Run, stand: Stand, refits: bool, progress: Progress) -> Diagnosis:
    """As `diagnose`, and nothing is written."""
    rings = misnumbered(stand.sources)
    apart = [each.label for each in rings if each.apart]
    # Away from an optimum every effect that moves the state towards one looks missing, beams are
    # rejected for no reason of their own, and groups far out that are not to blame.
    found = search(stand, progress) if run.converged else search(stand, progress, most=0)
    suspect = []
    if found.blunders and not (run.converged or found.looks[-1].stand.estimate.converged):
        suspect = [told.suspect(found.blunders[0])]
        found = replace(found, looks=found.looks[:1], blunders=())
    refits &= run.summary["rms_mm"]["held_out"] is not None and run.model["hold_out"] != "none"
    if between := contradictions(stand, found, run.converged, progress, apart):
        kept = {} if run.converged else {"looks": found.looks[:1], "blunders": ()}
        found, suspect = replace(_of_one_rig(found, between), **kept), []
    found, falls, formulas, rejected = _answer(run, stand, found, refits, progress)
    if between or apart:
        found, formulas = _of_one_rig(found, between), Unnamed()
    result = conclude(
        found,
        falls,
        run.summary,
        weak_directions(run.solution, found.looks[0]),
        rejected,
        forbids(run),
        [
            *(told.of_rings(r.source.rig.lidar.name, r.label, r.finding) for r in rings),
            *_not_as_drawn(run, found),
            *(told.of_scan(s, shown_by_no_other([s])) for s in seen_alone(stand.estimate)),
            *_rooms(stand),
            *between,
        ],
        formulas,
    )
    result = replace(result, unseen=_reaches(found.looks[0], run) if run.converged else {})
    described = bool(found.found or formulas.formulas)
    others = []
    if result.verdict == "adequate":
        others = [*in_place(run, stand, found.looks[0].named.common, progress)]
    fitting = [each for each in others if isinstance(each, InPlace)]
    if any(each.is_better for each in fitting):
        result = replace(result, verdict=UNNAMED, sentences=result.sentences[1:])
    apart = to_be_told(fitting) or to_be_told_apart(result.candidates, result.weak_directions)
    return replace(
        result,
        plan=command_to_plan(run, apart) if apart and can_be_planned_for(stand) else "",
        remedies=list(remedies(run, result, can_be_planned_for(stand))),
        scatter=[*_scatter(run, stand), *result.scatter],
        detectable={**detectable(stand.sources), **_scale_detectable(result)},
        in_place=[each.document() for each in fitting],
        sentences=[*run.doubts, *suspect, *_said(run, found, result, others, described)],
        command=next_command(run, result, fitting),
    )


def _said(
    run: Run,
    found: Search,
    result: Diagnosis,
    others: Sequence[InPlace | Untried],
    described: bool,
) -> Iterator[str]:
    """The sentences of a diagnosis, and what else is to be said of its run.

    Args:
        run: the run.
        found: the search.
        result: what was concluded.
        others: what would fit, or may, in place of effects that the model has.
        described: whether names or formulas were found.
    """
    last, said = found.beside or found.looks[-1], result.sentences
    first = int(result.verdict == "adequate")
    yield from (*said[:first], *(each.sentence for each in others), *said[first:])
    if run.converged:
        yield from told.uneven(last.blunders)
    yield from unchecked(found.looks[0], run.solution)
    yield from not_heard(run.solution.not_estimated)
    yield from hardly_checked(result.unseen)
    yield from _noisier(run, found.looks[-1].stand, described)
    yield from map(told.whole, _cautions(run, result, last))
    yield from found.looks[0].linear.beams_drawn
    yield from run.omissions


def _rooms(stand: Stand) -> Iterator[dict[str, Any]]:
    """Rooms that a guess has the wrong way round, as blunders."""
    rooms = rooms_turned(stand.problem, stand.estimate.values)
    yield from (told.of_room(r.frame, r.sentence) for r in rooms if r.is_better)


def _of_one_rig(found: Search, between: Sequence[Mapping[str, Any]]) -> Search:
    """A search where something moved `between` two recordings, or their rings have other numbers:
    that seems to scatter, and has structure over whatever differs between the two, as a day's
    temperature does. What is there besides, fits of each recording alone tell; so they do of an
    effect that is one recording's."""
    told = {each["name"] for each in between}
    named = [step for step in found.found if step.effect.name not in told]
    return replace(found, found=named, chance=(), unnamed=(), at_first=())


def _answer(
    run: Run, stand: Stand, found: Search, refits: bool, progress: Progress
) -> tuple[Search, Mapping[str, Fall], Unnamed, Rejects | None]:
    """A search as stops that were held out have it, and what is asked after it: how the error of
    these falls with each name, formulas of what the names leave, and what is rejected beside them;
    arguments as of `diagnose`."""
    at_first = rejects(found.looks[0].stand, progress) if run.converged else None

    def beside_names() -> Rejects | None:
        settled = not found.found or at_first is None or at_first.explained
        return at_first if settled else rejects(found.looks[-1].stand, progress)

    rejected = beside_names()
    falls = _falls(found, stand, run, progress) if refits else {}
    unseen = partial(_unseen, run=run, progress=progress) if refits else None
    doubtful = not believed(found, falls) or (rejected is not None and not rejected.explained)
    formulas = unnamed(found, doubtful, unseen, progress) if run.converged else Unnamed()
    known = by_name(found, formulas, unseen, progress) if unseen else None
    if known and believed(*known) and weighed(*known, judged_mm(run.summary)).found.found:
        (found, falls), formulas = known, Unnamed()
        rejected = beside_names()
    if fitted := with_formulas_and_names(stand, found, formulas, rejected, progress):
        found = beside_formulas(found, fitted, formulas.whole, progress)
        rejected = rejects(fitted, progress)
    elif formulas.instead:
        rejected = at_first
    again = _as_held_out(found, falls, formulas, run, progress)
    if len(again.found) < len(found.found):
        falls = _falls(again, stand, run, progress)
        rejected = rejected if again.found else at_first
    return again, falls, formulas, rejected


def with_formulas_and_names(
    stand: Stand, found: Search, formulas: Unnamed, rejected: Rejects | None, progress: Progress
) -> Stand | None:
    """A run's fit with formulas that stops held out bear out, and the names that stand beside them;
    None where nothing is to be judged beside these, or they come to no optimum."""
    wrong = rejected is not None and rejected.wrong
    if formulas.fall is None or not (found.chance or found.blunders or wrong):
        return None
    named = () if formulas.instead else found.found
    names = [s.effect for s in named if s.effect.name not in formulas.needless]
    whole = tried(with_formulas, stand, formulas.formulas, progress, names)
    return whole if whole and whole.estimate.converged else None


def _as_held_out(
    found: Search, falls: Mapping[str, Fall], formulas: Unnamed, run: Run, progress: Progress
) -> Search:
    """A search as stops that were held out have it.

    Beside scatter by chance names say nothing if these stops bear out none, most of the error stays
    and no structure is found. A name with which the error rises says nothing by itself: is there
    structure without it?
    """
    structured = formulas.formulas or found.unnamed or found.at_first
    scatters = found.chance or any(e.by_chance for e in found.looks[-1].stand.model.effects)
    named = [falls[s.effect.name] for s in found.found if s.effect.name in falls]
    if falls and scatters and not structured and not any(map(borne_out, named)):
        kept = weighed(found, falls, judged_mm(run.summary)).found
        bare = found if believed(kept, falls) else nameless(found, progress)
        if not bare.found:
            return bare
    if any(fall.rises for fall in named) and not found.at_first:
        return replace(found, at_first=structures(found.looks[0], progress))
    return found


def _falls(found: Search, stand: Stand, run: Run, progress: Progress) -> dict[str, Fall]:
    """How the held-out error falls with each name that was found, after those before it, or beside
    all others where it rises after those; and with all that scatters by chance, beside names or
    where it is larger than expected."""
    falls = {}
    before, each_m2 = held_out_size(run.summary), run.unseen_m2
    as_it_was = found.looks[0].stand is stand and tells_of_poses(run.summary)
    if found.found and not as_it_was:
        unseen = _unseen(found.looks[0].stand, run, progress)
        before, each_m2 = unseen.size, unseen.each_m2
    for step in found.found:
        unseen = _unseen(step.after.stand, run, progress)
        gain = gains_m2(each_m2, unseen.each_m2)
        falls[step.effect.name] = Fall.of(before, unseen.size, gain)
        before, each_m2 = unseen.size, unseen.each_m2
    for step in found.found[:-1]:
        # What is named first may predict nothing as long as what is named later is missing.
        name, whole = step.effect.name, found.found[-1].after.stand
        if falls[name].rises and (less := tried(whole.lacking, [name], progress)):
            unseen = _unseen(less, run, progress)
            gain = gains_m2(unseen.each_m2, each_m2)
            falls[name] = Fall.of(unseen.size, before, gain)
    last = found.looks[-1].stand
    scatter = [c.effect.name for c in found.chance if c.effect.name in last.model.names]
    alone = not found.unnamed and over_expected(run.summary) > HELD_OUT_BY_CHANCE
    if scatter and (found.found or alone):
        # What scatters is in the expected error only once the model has it.
        unseen = _unseen(last, run, progress)
        falls[scatter[-1]] = Fall.of(before, unseen.size)
    return falls


def _not_as_drawn(run: Run, found: Search) -> Iterator[dict[str, Any]]:
    """Angles of the arm that are far from where they are drawn, of a fit that has come to its end;
    not those that were found to be blunders."""
    named = {left.blunder.group.what for left in found.blunders}
    drawn = told.not_as_drawn(moves(run.summary) if run.converged else {})
    yield from (each for each in drawn if each["name"] not in named)


def _noisier(run: Run, stand: Stand, explained: bool) -> list[str]:
    """That beams scatter more than the noise model of the LiDAR says, with what was found in the
    model; of what they have in common nothing where something was found."""
    noisier = run.converged and run.summary["misfit"].get("beams", 0.0) > TOLERATED
    if not noisier or max(stand.beams.alone, 0.0 if explained else stand.beams.times) <= TOLERATED:
        return []
    return [stand.beams.sentence]


def _cautions(run: Run, found: Diagnosis, look: Look) -> list[str]:
    """What is to be looked at besides, without what was found to be wrong, or scatters as far as
    what is near it does."""
    wrong = [(each["where"], each["name"]) for each in found.blunders]
    uneven = [(b.group.where, b.group.what) for b in look.blunders if b.uneven and not b.found]
    named = tuple(f"{where}, {what}:" for where, what in (*wrong, *uneven))
    said = {each["sentence"] for each in found.blunders}
    every = (each for each in cautions(run) if not each.startswith(named))
    return [each for each in every if told.whole(each) not in said]


def _scatter(run: Run, stand: Stand) -> Iterator[dict[str, Any]]:
    """How widely things scatter by chance, as the run's model has it."""
    parts = [run.solution.shared, *run.solution.recordings.values()]
    for effect in (e for e in stand.model.effects if e.by_chance):
        terms = (t for some in stand.problem.terms for t in some if t.effect.name == effect.name)
        of = {s.name: s.of for t in terms for s in names_of(stand.problem, t).values()}
        for found in (part.effects[effect.name] for part in parts if effect.name in part.effects):
            numbers = zip(found.estimate.tolist(), found.sigma.tolist(), strict=True)
            for name, unit, each in zip(found.names, found.units, numbers, strict=True):
                sd, sigma = each
                spread = Spread(of=of[name], unit=unit, sd=sd, sigma=sigma)
                yield spread.document(effect.name)


def _scale_detectable(found: Diagnosis) -> dict[str, dict[str, float]]:
    """From which size a wrong scale of the mesh is found, where the model does not have it: as the
    effect that it is."""
    sizes = {c["effect"]: c["smallest_detectable"] for c in found.candidates}
    size = sizes.get(FaroScale.name)
    return {f"{MESH}:scale": {FaroScale.unit: size}} if size and np.isfinite(size) else {}


def _reaches(look: Look, run: Run) -> dict[Group, FurthestMoved]:
    """How far mishaps that are not found could move what a run reports."""
    sigma = np.sqrt(np.diag(run.solution.covariance)).tolist()
    known = dict(zip(run.solution.names, sigma, strict=True))
    return reaches(look.others, look.blunders, known)


def _unseen(stand: Stand, run: Run, progress: Progress) -> Errors:
    """Residuals of stops that a model was not fitted to, left out as the run left them out."""
    by, count = run.model["hold_out"], run.model["folds"]
    return held_out(stand.sources, stand.model, by, count, progress, stand.estimate.start)
