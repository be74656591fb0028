"""From recordings to a run folder: ``rigcal fit``, and growing a run from another."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

from calib import outputs
from calib import problem as problems
from calib.diagnosis.formulas.seen import ColumnRanges
from calib.effects import Effect, is_known, load_effects, split, trust_in
from calib.linear.parallel import one_blas_thread
from calib.outputs.journal import going_on
from calib.problem import Problem
from calib.problem.model import Model, Source
from calib.problem.without import leave_out, placed
from calib.recalibration.links import Link, moved_since_cad, since
from calib.recalibration.prior import earlier, starting_from, untold
from calib.recalibration.refit import hardly_apart, solve_from
from calib.recalibration.twice import all_once, refuse_given_twice
from calib.results.errors import OF_POSITIONS, Errors, body_errors, errors_at, of_orientations
from calib.results.holdout import Keep, held_out, unit_of
from calib.results.intervals import intervals
from calib.results.misfit import (
    instrument_rows,
    misfit_by,
    redundancies,
)
from calib.results.observability import odd
from calib.results.reach import reach
from calib.results.rings import documents as odd_rings
from calib.results.sigmas import misfit, widened
from calib.results.solution import solution_of, up_of, zeros_of
from calib.results.stages import FIT, staged
from calib.runs.asked.in_place import rivals_told
from calib.runs.belief import limits
from calib.runs.reopen import (
    effects_of_prior,
    identity,
    model_of,
    proposed,
    reopened,
    start_of,
    stored_met,
)
from calib.runs.residual_table import (
    UNSEEN_FOLDER,
    residual_bytes,
    write_residuals,
    write_rows,
    write_stop,
)
from calib.runs.run import (
    COVARIANCE,
    DIAGNOSIS,
    MODEL,
    RESIDUALS,
    SOLUTION,
    SUMMARY,
    Run,
    solution_digest,
    versions,
    write_state,
)
from calib.runs.stored import RUN_FORMAT, write_covariance
from calib.solve.estimate import Estimate, Start
from calib.solve.fit import Progress, shapes_freed, solve
from chains import remote
from chains.errors import InputError, NoColumnError
from sensors.documents import write_json, write_yaml
from sensors.recording import digests


@one_blas_thread
def calibrate(
    recordings: outputs.Paths,
    out: Path | str,
    model: Model | None = None,
    hold_out: str = "location",
    folds: int = 1,
    prior: Path | str | None = None,
    progress: Progress = lambda what, done, total: None,
) -> Run:
    """Estimate a rig from its recordings and write the run folder.

    Args:
        recordings: folder, or folders; what is the same hardware is one variable.
        out: the run folder to make; an earlier run there is replaced, anything else is refused.
        model: what is estimated; where None the default effects, and those of `prior`.
        hold_out: "location", "stop" or "none": what the held-out error leaves out of its fit.
        folds: how many folds of about a fifth each the held-out error is taken over.
        prior: an earlier run, whose solution replaces CAD as what is known before.
        progress: called with what is being done, and how far it is.

    Raises:
        InputError: what is wrong with the input, in one sentence.
    """
    recordings = outputs.each(recordings)
    inputs = [*recordings, *([prior] if prior else [])]
    with outputs.folder(out, outputs.RUN, inputs) as folder:
        refuse_given_twice([r.resolve() for r in recordings])
        model = model or Model.of(None, (), (), recordings, known=effects_of_prior(prior))
        opened = [Source.open(r).of_beams(model.beams) for r in recordings]
        choices = _Choices(Path(out), hold_out, folds, prior)
        if choices.before:
            choices.before.refuse_unconverged(force=None)
            model = starting_from(model, choices.before.solution, opened)
        sources, model = placed(leave_out(opened, model.without), model)
        contents = [digests(s.recording.folder) for s in sources]
        document = _model_document(sources, model, choices, contents)
        data = choices.data(sources, contents)
        with going_on(outputs.kept(folder, document)):
            try:
                _fit(sources, model, document, folder, choices, progress, data)
            except NoColumnError as error:
                if not prior:
                    raise
                raise NoColumnError(
                    f"{error} (Without --effects the model has the effects of --prior {prior}; "
                    "with it, those that you name.)",
                    error.column,
                ) from None
    return Run.open(out, trust_in(model.effects))


@one_blas_thread
def grow(
    run: Run,
    model: Model,
    out: Path | str,
    progress: Progress = lambda what, done, total: None,
) -> Run:
    """Fit another model to a run's recordings, from where that run stood.

    Args:
        run: the run to grow from; stops are held out, and a prior is taken, as it did.
        model: what is estimated now; see `grown_model`.
        out: the run folder to make; an earlier run there is replaced, anything else is refused.
        progress: called with what is being done, and how far it is.

    Raises:
        InputError: the run's recordings are not what they were, or it is of an earlier version.
    """
    with outputs.folder(out, outputs.RUN, [run.folder, *run.inputs]) as folder:
        sources = [s.of_beams(model.beams) for s in reopened(run, model.without)]
        start = start_of(run, sources)
        _refuse_idle(model, run, sources)
        hold_out, folds = run.model["hold_out"], run.model["folds"]
        choices = _Choices(Path(out), hold_out, folds, run.prior, grown_from=run)
        contents = [digests(s.recording.folder) for s in sources]
        document = _model_document(sources, model, choices, contents)
        data = choices.data(sources, contents)
        with going_on(outputs.kept(folder, {**document, "grown_from": identity(run)})):
            _fit(sources, model, document, folder, choices, progress, data, start)
    return Run.open(out, {**run.trust, **trust_in(model.effects)})


def grown_model(run: Run, added: str | Sequence[str]) -> Model:
    """A run's model and more effects, as ``rigcal add`` names them.

    An effect that needs a shape and is given none takes the one that the run's diagnosis found
    for it, or else its usual one. Who names a Python file here trusts it, where the run has it too.
    A name that the catalogue lacks is one that the run's diagnosis printed, or that ``rig.yaml`` of
    its recordings has.

    Raises:
        InputError: an effect is unknown, or in the model already.
    """
    unknown = [text for text in split(added) if not is_known(text)]
    own = proposed(run, unknown) if unknown else ()
    found = tuple(_shaped(effect, run) for effect in load_effects(added, own=own))
    knowing = replace(run, trust={**run.trust, **trust_in(found)})
    return model_of(knowing).plus(found)


def _shaped(effect: Effect, run: Run) -> Effect:
    if not effect.shape_name or effect.name != effect.family:
        return effect
    found = run.diagnosis()
    try:
        # Best first, so that the best is what stays.
        ranked = reversed(found["candidates"] if found else [])
        names = {c["effect"]: c.get("add", "") for c in ranked}
        shape = names.get(effect.family, "").partition("@")[2]
        return effect.at(float(shape) if shape else effect.shape)
    except (ValueError, KeyError, TypeError, AttributeError):
        raise InputError(
            f"{run.folder / DIAGNOSIS} is no diagnosis of this version; write "
            f"{effect.name}@NUMBER, or diagnose again"
        ) from None


def _refuse_idle(model: Model, run: Run, sources: Sequence[Source]) -> None:
    """An effect that was asked for, and that these rigs have nothing of, would be lost unseen."""
    for effect in model.effects:
        if effect.name not in run.effects and not any(effect.params(s.rig) for s in sources):
            raise InputError(
                f"effect '{effect.name}' has nothing to act on in the recordings of {run.folder}; "
                f"'rigcal effects {effect.family}' says what it needs"
            )


@dataclass(frozen=True)
class _Choices:
    """What a fit was asked beside its model, and where its run will stand; see `calibrate`."""

    out: Path
    hold_out: str
    folds: int
    prior: Path | str | None
    grown_from: Run | None = None

    @cached_property
    def before(self) -> Run | None:
        """The run that stands for CAD."""
        return Run.open(self.prior) if self.prior else None

    def data(self, sources: Sequence[Source], contents: Sequence[remote.Digests]) -> list[str]:
        """Digests of all that the estimate rests on; see `all_once`."""
        known = self.before.rests_on if self.before else []
        return all_once(sources, [found.each for found in contents], known, self.prior)


def _fit(
    sources: Sequence[Source],
    model: Model,
    document: dict[str, Any],
    folder: Path,
    choices: _Choices,
    progress: Progress,
    data: Sequence[str],
    start: Start | None = None,
) -> None:
    """Estimate, judge by what was held out, and write the run."""
    began, before, progress = time.monotonic(), choices.before, staged(progress, FIT)
    problem = problems.build(sources, model, progress=progress)
    held = earlier(problem, before.solution, before.rests_on) if before else None
    links: list[Link] = []
    if held is None:
        estimate = solve(problem, progress=progress, start=start)
        freed = shapes_freed(estimate, model)  # the same where no effect has a shape
        known = intervals(freed, progress)
    else:
        estimate, freed, known, links = solve_from(problem, model, held, progress)
    unseen, unit = _held_out(sources, model, estimate, folder / RESIDUALS, choices, progress)
    nominal = errors_at(problem, problem.initial, progress)
    seen_at = ColumnRanges(model.effects)
    by_stop = write_residuals(folder / RESIDUALS, estimate, seen_at, progress)
    seen = sum(by_stop.values(), Errors())
    if not estimate.scans:
        seen = body_errors(problem.bodies, estimate.values, None)
    _refuse_nothing(problem, seen)
    elsewhere = held.variables if held else ()  # an earlier run stands in place of CAD
    known = widened(known, estimate, seen, elsewhere)
    calibration = known.of([v.name for v in estimate.variables])
    solution = solution_of(problem, estimate, known, held.spreads if held else {})
    write_covariance(folder / COVARIANCE, solution, data, held)
    write_state(folder, estimate.state, stored_met(estimate.start, sources))
    write_yaml(folder / MODEL, document)
    summary = _summary(problem, estimate, nominal, seen, unseen)
    doubts = untold(held, choices.prior) if held else ()
    summary["odd"] = [*odd(estimate), *doubts, *hardly_apart(problem, links)]
    write_rows(folder / RESIDUALS, rows := instrument_rows(estimate))
    if before:
        summary |= since(links, before.summary)
        summary["prior_found_wrong"] = [*before.prior_found_wrong, *before.found_wrong]
    judged = estimate.loosened(moved_since_cad(summary))
    by = {**misfit_by(judged, rows, by_stop), "limit": limits(redundancies(rows))}
    summary |= {"misfit": misfit(judged, seen), "misfit_by": by}
    reached = reach(freed.problem, freed, known)
    summary |= unseen.of_held_out
    summary |= {"sigmas_widened_by": known.least, "cad_widened_by": known.cad, "held_out_by": unit}
    summary |= {"rivals": rivals_told(choices.grown_from), "without": list(model.without)}
    summary["intervals_wider_by"] = calibration.document(solution.names)
    summary["extrapolated"] = seen_at.sentences()
    summary |= {"rings": odd_rings(sources), "set_aside": sorted(estimate.problem.set_aside)}
    summary["predicted_mm"] = reached.document(summary) if reached else None
    levels = {"up": up_of(estimate, known), "level_zeros": zeros_of(estimate, known)}
    summary |= {name: told for name, told in levels.items() if told}
    summary["seconds"] = time.monotonic() - began
    write_json(folder / SUMMARY, summary)
    warning = Run(folder, document, summary, solution).warning
    write_yaml(folder / SOLUTION, solution.document(), warning)


def _refuse_nothing(problem: Problem, seen: Errors) -> None:
    if not seen.count and not problem.blocks:
        raise InputError(
            f"{problem.sources[0].recording.folder}: no beam meets a surface and no tracked body "
            "was seen, so there is nothing to fit to; 'rigcal check' says what is missing"
        )


def _held_out(
    sources: Sequence[Source],
    model: Model,
    estimate: Estimate,
    folder: Path,
    choices: _Choices,
    progress: Progress,
) -> tuple[Errors, str | None]:
    """The errors of stops held out, whose residuals are written, and what was left out whole; of
    a fit that did not converge, none."""
    if choices.hold_out == "none" or not estimate.converged:
        return Errors(), None
    keep = Keep(residual_bytes, partial(write_stop, folder / UNSEEN_FOLDER, sources))
    how = (choices.hold_out, choices.folds, progress, estimate.start, keep)
    unseen = held_out(sources, model, *how)
    return unseen, unit_of(sources, choices.hold_out) if unseen.count else None


def _summary(
    problem: Problem, estimate: Estimate, nominal: Errors, seen: Errors, unseen: Errors
) -> dict[str, Any]:
    rows = seen.count if estimate.scans else 0
    rows += sum(block.rows for block in problem.blocks)
    free = sum(v.dim for v in problem.variables.values())
    floor = unseen if unseen.count else seen
    return {
        "points": seen.count if estimate.scans else 0,
        "stops": sum(len(s.recording.stops) for s in problem.sources),
        "scans": len(problem.scans),
        "residual": "range" if estimate.scans else OF_POSITIONS,
        "rms_mm": {
            "nominal": nominal.rms_mm,
            "fit": seen.rms_mm,
            "held_out": unseen.rms_mm,
            "noise_floor": floor.floor_mm,
        },
        **of_orientations(nominal, seen, unseen),
        "mean_mm": {"nominal": nominal.mean_mm, "fit": seen.mean_mm, "held_out": unseen.mean_mm},
        **_of_all_beams(estimate, seen, unseen),
        "std_mm": {"nominal": nominal.std_mm, "fit": seen.std_mm, "held_out": unseen.std_mm},
        "cost": estimate.cost,
        "dof": rows - free + sum(v.dim for v in estimate.variables),
        "iterations": estimate.iterations,
        "converged": estimate.converged,
    }


def _of_all_beams(estimate: Estimate, seen: Errors, unseen: Errors) -> dict[str, float | None]:
    """The errors of all beams that meet a surface, those of weight 0 included; none of bodies."""
    kinds = {"": seen, "held_out_": unseen} if estimate.scans else {"": Errors()}
    out = {f"{kind}rms_all_mm": errors.rms_all_mm for kind, errors in kinds.items()}
    return out | {f"{kind}rejected_share": errors.rejected_share for kind, errors in kinds.items()}


def recordings_document(
    sources: Sequence[Source], contents: Sequence[remote.Digests]
) -> list[dict[str, str]]:
    """Recordings as model.yaml names them: where they are, whose, and what was in them."""
    return [
        {
            "path": remote.url_of(s.recording.folder) or str(s.recording.folder.resolve()),
            "rig": s.rig.name,
            "sha256": each.whole,
        }
        for s, each in zip(sources, contents, strict=True)
    ]


def _model_document(
    sources: Sequence[Source], model: Model, choices: _Choices, contents: Sequence[remote.Digests]
) -> dict[str, Any]:
    below = choices.grown_from
    return {
        "format": RUN_FORMAT.newest,
        "recordings": recordings_document(sources, contents),
        **model.document(),
        "hold_out": choices.hold_out,
        "folds": choices.folds,
        "prior": _way(choices.out, Path(choices.prior)) if choices.prior else None,
        "prior_sha256": solution_digest(choices.before.folder) if choices.before else None,
        "grown_from": _way(choices.out, below.folder) if below else None,
        "steps": _steps(below) if below else [],
        "versions": versions(),
    }


def _way(run: Path, other: Path) -> str:
    """The way from a run's folder to another: it holds where both are moved together."""
    return Path(os.path.relpath(other.resolve(), run.resolve())).as_posix()


def _steps(below: Run) -> list[dict[str, Any]] | None:
    """The models of the run that one grows from, and of all below it, the lowest first; None where
    one of these did not write them down."""
    lower = below.model.get("steps", None if below.grown_from else [])
    return None if lower is None else [*lower, model_of(below).document()]
