"""From recordings to a run folder: the whole of ``rigcal fit``."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from calib import problem as problems
from calib.errors import Errors, body_errors, misfit, row_errors, scan_errors
from calib.fit import Estimate, Progress, solve
from calib.holdout import held_out
from calib.model import Model, Source
from calib.problem import Problem
from calib.recalibrate import Link, earlier, solve_from
from calib.residuals.tracker import TrackedBody
from calib.run import (
    COVARIANCE,
    MODEL,
    RESIDUALS,
    SOLUTION,
    SUMMARY,
    Run,
    versions,
)
from calib.solution import solution_of
from chains.errors import InputError
from sensors.documents import replace_folder, write_json, write_yaml
from sensors.recording import write_table

# Residuals so much larger than their sigmas are no accident: the result's sigmas are widened.
TOLERATED = 1.2


def calibrate(
    recordings: Sequence[Path | str],
    out: Path | str,
    model: Model = Model(),  # noqa: B008 - frozen
    hold_out: str = "location",
    folds: int = 1,
    prior: Path | str | None = None,
    progress: Progress = lambda what, done, total: None,
) -> Run:
    """Estimate a rig from its recordings and write the run folder.

    Args:
        recordings: folders; what is the same hardware is one variable.
        out: the run folder to make; an earlier run there is replaced, anything else is refused.
        model: what is estimated.
        hold_out: "location", "stop" or "none": what the held-out error leaves out of its fit.
        folds: how many folds of about a fifth each the held-out error is taken over.
        prior: an earlier run, whose solution replaces CAD as what is known before.
        progress: called with what is being done, and how far it is.

    Raises:
        InputError: what is wrong with the input, in one sentence.
    """
    from threadpoolctl import threadpool_limits

    began = time.monotonic()
    with threadpool_limits(limits=1), replace_folder(out, MODEL, "run") as folder:
        _refuse_twice([Path(r).resolve() for r in recordings])
        sources = [Source.open(r) for r in recordings]
        before = Run.open(prior).solution if prior else None
        problem = problems.build(sources, model)
        links: list[Link] | None = None
        if before is None:
            estimate = solve(problem, progress=progress)
        else:
            estimate, links = solve_from(problem, earlier(problem, before), progress)
        unseen = Errors()
        if hold_out != "none":
            unseen = held_out(sources, model, hold_out, folds, progress)
        nominal = _nominal(problem, progress)
        seen = _write_residuals(problem, estimate, folder / RESIDUALS, progress)
        worse = misfit(estimate.graph, estimate.values, seen)
        widened = max([1.0, *(x for x in worse.values() if x > TOLERATED)])
        solution = solution_of(problem, estimate, widened)
        write_yaml(folder / SOLUTION, solution.document())
        np.savez(
            folder / COVARIANCE, names=np.array(solution.names), covariance=solution.covariance
        )
        write_yaml(folder / MODEL, _model_document(sources, model, hold_out, folds, prior))
        summary = _summary(problem, estimate, nominal, seen, unseen)
        summary |= {"misfit": worse, "sigmas_widened_by": widened}
        summary["seconds"] = time.monotonic() - began
        if links is not None:
            summary["links"] = [_link_document(link) for link in links]
        write_json(folder / SUMMARY, summary)
    return Run.open(out)


def _refuse_twice(recordings: Sequence[Path]) -> None:
    for recording in recordings:
        if recordings.count(recording) > 1:
            raise InputError(f"{recording} is given twice; as data it counts once")


def _nominal(problem: Problem, progress: Progress) -> Errors:
    """Residuals with every frame and effect as on paper, the rig where it then seems to be."""
    if not problem.scans:
        return body_errors(_bodies(problem), problem.initial, None)
    total = Errors()
    for i, scan in enumerate(problem.scans):
        progress("nominal residuals", i, len(problem.scans))
        total += scan_errors(scan, problem.initial, None, None)
    return total


def _bodies(problem: Problem) -> list[TrackedBody]:
    return [b for b in problem.blocks if isinstance(b, TrackedBody)]


def _write_residuals(
    problem: Problem, estimate: Estimate, folder: Path, progress: Progress
) -> Errors:
    """Write every row's residual, stop by stop; their sums, or those of bodies without scans."""
    folder.mkdir()
    total = Errors()
    several = len(problem.sources) > 1
    for i, (scan, association) in enumerate(
        zip(estimate.scans, estimate.associations, strict=True)
    ):
        progress("writing residuals", i, len(estimate.scans))
        rows = scan.rows(estimate.values, association)
        view = rows.view
        names = ("ring", "column", "range_m", "incidence_rad", "azimuth_rad", "elevation_rad")
        names += ("intensity", "label", "surface", "region", "patch", "plane")
        columns = {n: view[n] for n in names if n in view.columns}
        columns |= {
            "residual_m": rows.residual_m,
            "sigma_m": np.hypot(rows.sigma_m, rows.reference_sigma_m),
            "weight": rows.weight,
        }
        name = f"{scan.stops.rig.name}.{scan.name}" if several else scan.name
        columns = {n: _compact(column[rows.usable]) for n, column in columns.items()}
        write_table(folder / f"{name}.parquet", columns)
        total += row_errors(rows)
    if not estimate.scans:
        total = body_errors(_bodies(problem), estimate.values, None)
    return total


def _compact(column: np.ndarray) -> np.ndarray:
    return column.astype(np.int32 if column.dtype.kind in "iu" else np.float32)


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
        "residual": "range" if estimate.scans else "tracked position",
        "rms_mm": {
            "nominal": nominal.rms_mm,
            "fit": seen.rms_mm,
            "held_out": unseen.rms_mm,
            "noise_floor": floor.floor_mm,
        },
        "mean_mm": {"nominal": nominal.mean_mm, "fit": seen.mean_mm, "held_out": unseen.mean_mm},
        "std_mm": {"nominal": nominal.std_mm, "fit": seen.std_mm, "held_out": unseen.std_mm},
        "cost": estimate.graph.error(estimate.values),
        "dof": rows - free + sum(v.dim for v in estimate.variables),
        "iterations": estimate.iterations,
        "converged": estimate.converged,
    }


def _model_document(
    sources: Sequence[Source], model: Model, hold_out: str, folds: int, prior: Path | str | None
) -> dict[str, Any]:
    return {
        "recordings": [
            {
                "path": str(s.recording.folder.resolve()),
                "rig": s.rig.name,
                "sha256": s.recording.digest(),
            }
            for s in sources
        ],
        "effects": list(model.names),
        "fixed": list(model.fixed),
        "hold_out": hold_out,
        "folds": folds,
        "prior": str(Path(prior).resolve()) if prior else None,
        "grown_from": None,
        "versions": versions(),
    }


def _link_document(link: Link) -> dict[str, Any]:
    return {
        "name": link.name,
        "moved": link.moved,
        "p_value": link.p_value,
        "parameters": link.parameters,
        "units": link.units,
        "change": link.change,
        "sigma": link.sigma,
    }
