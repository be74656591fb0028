"""An estimate in the words of the contract: frames, effects, and what could not be told."""

from __future__ import annotations

import numpy as np

from calib.effects import FrameOffset
from calib.forward import Term
from calib.problem import Problem
from calib.problem.model import Source
from calib.runs.run import EffectEstimate, FrameEstimate, Part, Solution, one_unit
from calib.solve.fit import Estimate
from calib.solve.observability import not_estimated
from chains import se3


def solution_of(problem: Problem, estimate: Estimate, widened: float = 1.0) -> Solution:
    """An estimate as frames and effects, with what it could not tell.

    Args:
        problem, estimate: what was estimated, and how it came out.
        widened: factor on every sigma, above 1 where residuals are larger than theirs allow.
    """
    told = widened**2 * estimate.covariance
    start = np.cumsum([0] + [v.dim for v in estimate.variables])
    at = {v.name: slice(a, a + v.dim) for v, a in zip(estimate.variables, start, strict=False)}
    shared, recordings = Part(), {}
    for source, terms in zip(problem.sources, problem.terms, strict=True):
        rig = source.rig
        for term in terms:
            own = term.variable != term.effect.name
            part = recordings.setdefault(rig.name, Part()) if own else shared
            theta = estimate.values[term.variable]
            covariance = told[at[term.variable], at[term.variable]]
            if isinstance(term.effect, FrameOffset):
                part.frames[term.effect.name] = _frame(source, term, theta, covariance)
            else:
                part.effects[term.effect.name] = _effect(source, term, theta, covariance)
        if rig.reference_frame in at:
            covariance = told[at[rig.reference_frame], at[rig.reference_frame]]
            T = estimate.values[rig.reference_frame]
            shared.frames[rig.reference_frame] = _pose(rig.world, T, covariance)
        for name, edge in zip(rig.tree.edge_names, rig.tree.edges, strict=True):
            known = name in shared.frames or name in recordings.get(rig.name, Part()).frames
            if name in rig.frame_sigma and not known:
                shared.frames[name] = _pose(edge.parent, edge.T_parent_child, np.zeros((6, 6)))
    effects = frozenset(
        t.variable
        for terms in problem.terms
        for t in terms
        if not isinstance(t.effect, FrameOffset)
    )
    touched = estimate.graph.touched(estimate.values, [v.name for v in estimate.variables])
    untold = not_estimated(estimate.variables, estimate.covariance, effects, touched)
    names = tuple(f"{v.name}.{dof}" for v in estimate.variables for dof in v.dofs)
    return Solution(shared, recordings, untold + _absent(problem), names, told)


def _frame(source: Source, term: Term, theta: np.ndarray, covariance: np.ndarray) -> FrameEstimate:
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


def _effect(
    source: Source, term: Term, theta: np.ndarray, covariance: np.ndarray
) -> EffectEstimate:
    params = term.effect.params(source.rig)
    estimate, sigma = np.zeros(len(params)), np.zeros(len(params))
    estimate[term.free] = theta
    sigma[term.free] = np.sqrt(np.diag(covariance))
    unit = one_unit([p.unit for p in params])
    return EffectEstimate(unit, tuple(p.name for p in params), estimate, sigma)


def _absent(problem: Problem) -> list[dict[str, str]]:
    """Links of the whole chain that these recordings have no instrument for."""
    rigs, sources = [s.rig for s in problem.sources], problem.sources
    out = []
    if not any(s.reference or s.recording.targets for s in sources):
        why = "neither mesh nor targets: the scanner saw nothing; add a mesh, or targets.csv"
        out.append({"name": rigs[0].reference_frame, "why": why})
    if not any(r.tracker for r in rigs):
        why = "no tracker, so poses are given in the reference's frame; add 'tracker' to rig.yaml"
        out.append({"name": "opti", "why": why})
    if not any(r.joint_names for r in rigs):
        out.append(
            {"name": "arm", "why": "the rig has no arm; add 'arm' to rig.yaml with its URDF"}
        )
    if not problem.scans:
        why = (
            "no scans, so the LiDAR's place and its offsets are not seen; add scans/<stop>.parquet"
        )
        out.append({"name": "lidar", "why": why})
    return out
