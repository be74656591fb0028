"""What a fit says of stops that it never saw."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calib import problem as problems
from calib.problem import Problem
from calib.problem.model import Model, Source
from calib.problem.prior import JointPrior
from calib.problem.problem import Block
from calib.residuals.scan import ScanStop
from calib.residuals.surfaces import PlaneSurface
from calib.residuals.tracker import TrackedBody
from calib.solve.errors import Errors, body_errors, scan_errors
from calib.solve.estimate import Estimate, Start
from calib.solve.fit import Progress, solve

FOLDS = 5  # a fit leaves out about a fifth of the locations


def folds(sources: Sequence[Source], by: str) -> list[list[np.ndarray]]:
    """Which stops each fold leaves out: per fold, per source, (K,) bool.

    Args:
        sources: the recordings.
        by: "location", or "stop"; by stop too where there is one location only.
    """
    labels = [s.recording.location if by == "location" else s.recording.stops for s in sources]
    names = list(dict.fromkeys(str(x) for found in labels for x in found))
    if len(names) < 2 and by == "location":
        return folds(sources, "stop")
    if len(names) < 3:
        return []
    count = min(FOLDS, len(names))
    return [[np.isin(found, names[i::count]) for found in labels] for i in range(count)]


def held_out(
    sources: Sequence[Source],
    model: Model,
    by: str,
    count: int,
    progress: Progress,
    start: Start | None = None,
) -> Errors:
    """Residuals of stops left out of the fit, their poses told by tracker and arm alone.

    Args:
        sources: the recordings.
        model: what is estimated.
        by: "location" or "stop".
        count: how many folds to evaluate.
        progress: as of `fit.solve`.
        start: a fit of all stops: each fold's fit is near it, and starts from there.
    """
    out = Errors()
    for number, fold in enumerate(folds(sources, by)[:count], 1):

        def tell(what: str, done: int, total: int, number: int = number) -> None:
            progress(f"without fold {number}: {what}", done, total)

        trained = problems.build(sources, model, [~left for left in fold])
        estimate = solve(trained, progress=tell, start=_without_planes(trained, start))
        unseen = problems.build(sources, model, fold, trained.meetings)
        out += predict(unseen, trained, estimate)
    return out


def _without_planes(trained: Problem, start: Start | None) -> Start | None:
    """A start less the planes found in the scans: other scans, other planes."""
    found = [m for m in trained.meetings.values() if isinstance(m, PlaneSurface)]
    if start is None or not found:
        return start
    planes = {meeting.variable for meeting in found}
    return Start({name: x for name, x in start.state.items() if name not in planes})


def predict(unseen: Problem, trained: Problem, estimate: Estimate) -> Errors:
    """Residuals of a problem whose calibration comes from an estimate of another; see `placed`."""
    scans, bodies = unseen.scans, [b for b in unseen.blocks if isinstance(b, TrackedBody)]
    predicted, told = placed(unseen, trained, estimate)
    if not scans:
        judged = [b for b in bodies if not _among(b, unseen.blocks) and b.stops.root in told]
        return body_errors(judged, predicted.values, predicted)
    return sum((_scan(scan, predicted, scan.stops.root in told) for scan in scans), Errors())


def _among(block: Block, blocks: Sequence[Block]) -> bool:
    """Whether it is one of them, itself."""
    return any(block is each for each in blocks)


def placed(unseen: Problem, trained: Problem, estimate: Estimate) -> tuple[Estimate, set[str]]:
    """Where stops stand whose calibration comes from an estimate of another problem.

    Poses of the unseen stops are found from their tracked bodies; where no body is seen, from
    their own beams with the calibration held.

    Args:
        unseen: the stops' problem; what does not place them is taken out of it.
        trained, estimate: the other problem, and what was estimated from it.

    Returns:
        The estimate, and the poses' variables that tracked bodies or the other problem told.
    """
    shared = [n for n in trained.variables if n in unseen.variables]
    held = [trained.variables[n] for n in shared if trained.variables[n].kind != "direction"]
    names = [v.name for v in held]
    covariance = estimate.covariance_of(names)
    prior = JointPrior(held, {n: estimate.values[n] for n in names}, covariance)
    scans, bodies = unseen.scans, [b for b in unseen.blocks if isinstance(b, TrackedBody)]
    # Without a LiDAR, bodies before the joints tell where the rig is; those beyond are judged.
    unseen.blocks = bodies if scans else [b for b in bodies if not b.stops.rig.joints_to(b.body)]
    told = {block.stops.root for block in unseen.blocks} | set(shared)
    unseen.scans = [scan for scan in scans if scan.stops.root not in told]
    return solve(unseen, prior), told


def _scan(scan: ScanStop, predicted: Estimate, told: bool) -> Errors:
    association = scan.associate(predicted.values, near_edges=True)
    return scan_errors(scan, predicted.values, association, predicted if told else None)
