"""Which physical effect is missing: ``rigcal diagnose``."""

from __future__ import annotations

from dataclasses import replace

from calib.diagnosis.search import search
from calib.diagnosis.stand import Stand
from calib.diagnosis.verdict import Diagnosis, conclude
from calib.diagnosis.weak import weak_directions
from calib.problem import build
from calib.runs.reopen import model_of, reopened, start_of
from calib.runs.run import DIAGNOSIS, Run
from calib.solve.fit import Progress, resume
from calib.solve.holdout import held_out
from sensors.documents import write_json


def diagnose(
    run: Run,
    progress: Progress = lambda what, done, total: None,
    refits: bool = True,
) -> Diagnosis:
    """Find where a run's model fails and which effect it lacks; written to its diagnosis.json.

    Args:
        run: a fitted run, with its recordings where they were.
        progress: called with what is being done, and how far it is.
        refits: whether effects found are fitted without the held-out stops too.

    Raises:
        InputError: the recordings are not what they were.
    """
    from threadpoolctl import threadpool_limits

    with threadpool_limits(limits=1):
        stand = stand_of(run, progress)
        found = search(stand, progress)
        falls = {}
        before = run.summary["rms_mm"]["held_out"]
        refits = refits and run.model["hold_out"] != "none" and before is not None
        for step in found.found if refits else ():
            fitted = step.after.stand
            unseen = held_out(
                fitted.sources,
                fitted.model,
                run.model["hold_out"],
                run.model["folds"],
                progress,
                fitted.estimate.start,
            )
            falls[step.effect.name] = (before, unseen.rms_mm, unseen.floor_mm)
            before = unseen.rms_mm
    result = conclude(
        found,
        falls,
        run.summary["misfit"],
        weak_directions(run.solution, float(run.summary["sigmas_widened_by"]), found.looks[0]),
    )
    result = replace(result, sentences=[*run.warning, *result.sentences])
    write_json(run.folder / DIAGNOSIS, result.document())
    return result


def stand_of(run: Run, progress: Progress) -> Stand:
    """Where a run stands: its model, its recordings, and the state in which its fit was left.

    Raises:
        InputError: its recordings are not what they were.
    """
    sources, model = reopened(run), model_of(run)
    problem, converged = build(sources, model), run.summary["converged"]
    return Stand(
        sources, model, problem, resume(problem, start_of(run, sources), progress, converged)
    )
