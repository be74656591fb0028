"""From recordings to a run folder: the whole of ``rigcal fit``."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from calib import problem as problems
from calib.effects import FrameOffset
from calib.errors import Errors, body_errors, scan_errors
from calib.fit import Estimate, Progress, solve
from calib.forward import Term
from calib.holdout import held_out
from calib.model import Model, Source
from calib.observability import not_estimated
from calib.problem import Problem
from calib.recalibrate import Link, earlier, solve_from
from calib.residuals.tracker import TrackedBody
from calib.run import (
    COVARIANCE,
    MODEL,
    RESIDUALS,
    SOLUTION,
    SUMMARY,
    EffectEstimate,
    FrameEstimate,
    Part,
    Run,
    Solution,
    versions,
)
from chains import se3
from sensors.documents import replace_folder, write_json, write_yaml
from sensors.recording import write_table


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
    with threadpool_limits(limits=1), replace_folder(out, MODEL) as folder:
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
        seen = _write_residuals(problem, estimate, folder / RESIDUALS, progress)
        solution = solution_of(problem, estimate)
        write_yaml(folder / SOLUTION, solution.document())
        np.savez(folder / COVARIANCE, names=np.array(solution.names), covariance=solution.covariance)
        write_yaml(folder / MODEL, _model_document(sources, model, hold_out, folds, prior))
        summary = _summary(problem, estimate, seen, unseen, time.monotonic() - began)
        if links is not None:
            summary["links"] = [_link_document(link) for link in links]
        write_json(folder / SUMMARY, summary)
    return Run.open(out)


def solution_of(problem: Problem, estimate: Estimate) -> Solution:
    """An estimate as frames and effects, with what it could not tell."""
    start = np.cumsum([0] + [v.dim for v in estimate.variables])
    at = {
        v.name: slice(a, a + v.dim) for v, a in zip(estimate.variables, start, strict=False)
    }
    shared, recordings = Part(), {}
    for source, terms in zip(problem.sources, problem.terms, strict=True):
        rig = source.rig
        for term in terms:
            own = term.variable != term.effect.name
            part = recordings.setdefault(rig.name, Part()) if own else shared
            theta = estimate.values[term.variable]
            covariance = estimate.covariance[at[term.variable], at[term.variable]]
            if isinstance(term.effect, FrameOffset):
                part.frames[term.effect.name] = _frame(source, term, theta, covariance)
            else:
                part.effects[term.effect.name] = _effect(source, term, theta, covariance)
        if rig.reference_frame in at:
            covariance = estimate.covariance[at[rig.reference_frame], at[rig.reference_frame]]
            T = estimate.values[rig.reference_frame]
            shared.frames[rig.reference_frame] = _pose(rig.world, T, covariance)
        for name, edge in zip(rig.tree.edge_names, rig.tree.edges, strict=True):
            known = name in shared.frames or name in recordings.get(rig.name, Part()).frames
            if name in rig.frame_sigma and not known:
                shared.frames[name] = _pose(edge.parent, edge.T_parent_child, np.zeros((6, 6)))
    effects = frozenset(
        t.variable for terms in problem.terms for t in terms if not isinstance(t.effect, FrameOffset)
    )
    touched = estimate.graph.touched(estimate.values, [v.name for v in estimate.variables])
    untold = not_estimated(estimate.variables, estimate.covariance, effects, touched)
    names = tuple(f"{v.name}.{dof}" for v in estimate.variables for dof in v.dofs)
    return Solution(shared, recordings, untold + _absent(problem), names, estimate.covariance)


def _frame(source: Any, term: Term, theta: np.ndarray, covariance: np.ndarray) -> FrameEstimate:
    tree = source.rig.tree
    edge = tree.edges[tree.edge_names.index(term.effect.name)]
    xi, full = np.zeros(6), np.zeros((6, 6))
    xi[term.free] = theta
    full[np.ix_(term.free, term.free)] = covariance
    turn = se3.right_jacobian(xi)
    return _pose(edge.parent, edge.T_parent_child @ se3.exp(xi), turn @ full @ turn.T)


def _pose(parent: str, T: np.ndarray, covariance: np.ndarray) -> FrameEstimate:
    R = T[:3, :3]
    position = R @ covariance[3:, 3:] @ R.T
    return FrameEstimate(
        parent, T, np.sqrt(np.diag(position)), np.sqrt(np.diag(covariance[:3, :3]))
    )


def _effect(source: Any, term: Term, theta: np.ndarray, covariance: np.ndarray) -> EffectEstimate:
    params = term.effect.params(source.rig)
    estimate, sigma = np.zeros(len(params)), np.zeros(len(params))
    estimate[term.free] = theta
    sigma[term.free] = np.sqrt(np.diag(covariance))
    unit = ", ".join(dict.fromkeys(p.unit for p in params))
    return EffectEstimate(unit, tuple(p.name for p in params), estimate, sigma)


def _absent(problem: Problem) -> list[dict[str, str]]:
    """Links of the whole chain that these recordings have no instrument for."""
    rigs, sources = [s.rig for s in problem.sources], problem.sources
    out = []
    if not any(s.reference or s.recording.targets for s in sources):
        why = "neither a mesh nor targets, so the scanner saw nothing; add reference/mesh.ply or targets.csv"
        out.append({"name": rigs[0].reference_frame, "why": why})
    if not any(r.tracker for r in rigs):
        why = "no tracker, so poses are given in the reference's frame; add 'tracker' to rig.yaml"
        out.append({"name": "opti", "why": why})
    if not any(r.joint_names for r in rigs):
        out.append({"name": "arm", "why": "the rig has no arm; add 'arm' to rig.yaml with its URDF"})
    if not problem.scans:
        why = "no scans, so the LiDAR's place and its offsets are not seen; add scans/<stop>.parquet"
        out.append({"name": "lidar", "why": why})
    return out


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
        names += ("intensity", "label", "surface", "patch", "plane")
        columns = {n: view[n] for n in names if n in view.columns}
        columns |= {
            "residual_m": rows.residual_m,
            "sigma_m": np.hypot(rows.sigma_m, rows.reference_sigma_m),
            "weight": rows.weight,
        }
        name = f"{scan.stops.rig.name}.{scan.name}" if several else scan.name
        columns = {n: _compact(column[rows.usable]) for n, column in columns.items()}
        write_table(folder / f"{name}.parquet", columns)
        total += scan_errors(scan, estimate.values, association, None)
    if not estimate.scans:
        bodies = [b for b in problem.blocks if isinstance(b, TrackedBody)]
        total = body_errors(bodies, estimate.values, None)
    return total


def _compact(column: np.ndarray) -> np.ndarray:
    return column.astype(np.int32 if column.dtype.kind in "iu" else np.float32)


def _summary(
    problem: Problem, estimate: Estimate, seen: Errors, unseen: Errors, seconds: float
) -> dict[str, Any]:
    rows = seen.count if estimate.scans else 0
    rows += sum(block.rows for block in problem.blocks)
    free = sum(v.dim for v in problem.variables.values())
    floor = unseen if unseen.count else seen
    return {
        "points": seen.count if estimate.scans else 0,
        "stops": sum(len(s.recording.stops) for s in problem.sources),
        "residual": "range" if estimate.scans else "tracked position",
        "rms_mm": {"fit": seen.rms_mm, "held_out": unseen.rms_mm, "noise_floor": floor.floor_mm},
        "mean_mm": {"fit": seen.mean_mm, "held_out": unseen.mean_mm},
        "std_mm": {"fit": seen.std_mm, "held_out": unseen.std_mm},
        "cost": estimate.graph.error(estimate.values),
        "dof": rows - free + sum(v.dim for v in estimate.variables),
        "iterations": estimate.iterations,
        "converged": estimate.converged,
        "seconds": seconds,
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
        "effects": list(model.effects),
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

