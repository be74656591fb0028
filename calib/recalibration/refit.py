"""Recalibration: a fit to newer data from what an earlier run knew."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

from calib.problem import Problem
from calib.problem.model import Model
from calib.problem.prior import JointPrior
from calib.recalibration.letgo import ALARM, let_go
from calib.recalibration.links import Link
from calib.recalibration.newer import RefittedPrior
from calib.recalibration.odds import FREEDOMS
from calib.recalibration.prior import change
from calib.results.errors import errors_at
from calib.results.intervals import Intervals, intervals
from calib.results.sigmas import widened
from calib.solve.estimate import Estimate
from calib.solve.fit import Progress, shapes_freed, solve
from calib.solve.otherwise.elsewhere import room_elsewhere
from calib.solve.otherwise.rooms import tied

# Scans, below which a LiDAR moved by 50 mm was told as a move of the room: by one scan in 3 of 3
# recordings, by three in 1 of 3, by twelve in none of 4.
FEW_SCANS = 6


class _Fit(NamedTuple):
    """What a fit tells of all that the prior holds; and all of it, as of `solve_from`."""

    told: RefittedPrior
    whole: tuple[Estimate, Estimate, Intervals]


def solve_from(
    problem: Problem, model: Model, prior: JointPrior, progress: Progress, alarm: float = ALARM
) -> tuple[Estimate, Estimate, Intervals, list[Link]]:
    """Estimate with an earlier solution as prior, letting go link by link of what has moved; the
    same with its shapes among the unknowns, the intervals of that, and what became of each link;
    see `let_go` and `shapes_freed`.

    The tests of links take errors of the prior and of the newer rows for independent. Errors of a
    mesh that both share move the two alike, so changes are smaller than these tests have it.
    """
    problem, begin = _where_the_room_is(problem, prior)
    found: list[_Fit] = []
    first: list[_Fit] = []  # of the prior as it is, with which `let_go` begins, and may end

    def fit(held: JointPrior) -> RefittedPrior:
        found.append(first[0] if first and held is prior else fit_anew(held))
        if held is prior:
            first.append(found[-1])
        return found[-1].told

    def fit_anew(prior: JointPrior) -> _Fit:
        # Trackers alone would take a frame that is let go back to where the earlier run has it.
        there = {name: problem.initial[name] for name in prior.freed if name in begin}
        held = replace(prior, means={**prior.means, **there})
        estimate = solve(problem, held, progress=progress)
        freed = shapes_freed(estimate, model, held)
        known = intervals(freed, progress)
        seen = errors_at(estimate.problem, estimate.values)
        wide = widened(known, estimate, seen, prior.variables)
        told, at_least = (each.of(prior.variables).without_repeated for each in (known, wide))
        moved, turned = change(prior, estimate.values)
        covariances = (told.graph, told.covariance, at_least.covariance)
        graph, covariance, widest = (turned @ each @ turned.T for each in covariances)
        now = RefittedPrior(
            change=moved,
            graph=graph,
            covariance=covariance,
            widened=widest,
            converged=estimate.converged,
            not_trusted=frozenset(estimate.not_trusted) & frozenset(prior.variables),
        )
        return _Fit(now, (estimate, freed, known))

    links = let_go(prior, fit, alarm, begin)
    return *found[-1].whole, links


def _where_the_room_is(problem: Problem, prior: JointPrior) -> tuple[Problem, dict[str, float]]:
    """The problem with each frame of the reference, of which only scans tell, where these lie on
    the mesh, if that is not where the earlier run has it; and by how many of its sigmas each of
    these frames may have moved."""
    values, free = problem.initial | dict(prior.means), {}
    for variable in (v for v in prior.held if v.kind == "pose"):
        T = room_elsewhere(problem, values, variable.name)
        if T is not None:
            values[variable.name], free[variable.name] = T, float(FREEDOMS[-1])
    initial = problem.initial | {name: values[name] for name in free}
    return (replace(problem, initial=initial) if free else problem), free


def hardly_apart(problem: Problem, links: Sequence[Link]) -> list[str]:
    """Frames of the reference that a few scans alone say have moved; a clause each.

    Args:
        problem: of the newer recordings.
        links: what became of each.
    """
    count = len(problem.scans)
    if count >= FEW_SCANS:
        return []
    moved = {link.name for link in links if link.moved}
    frames = {s.rig.reference_frame: None for s in problem.sources if not tied(s)}
    by = f"by {count} scan{'s' * (count != 1)} alone"
    return [
        f"that '{frame}' moved is told {by}, and a LiDAR that sits elsewhere on its mount may look "
        "the same; targets.csv, or more stops, would tell them apart"
        for frame in frames
        if frame in moved
    ]
