"""What a fit says of stops that it never saw."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from scipy import special

from calib import problem as problems
from calib.forward import Stops
from calib.linear.parallel import over_stops
from calib.problem import Problem
from calib.problem.model import Model, Source
from calib.problem.prior import JointPrior
from calib.problem.spread import spread_of, with_spread
from calib.problem.surfaces import cells_of
from calib.problem.unknowns import Role
from calib.residuals.beams import Rows
from calib.residuals.scan import ScanStop
from calib.residuals.seen import SeenBody
from calib.residuals.surfaces import PlaneSurface
from calib.results.errors import Errors, ErrorSize, Foretold, body_errors, row_errors
from calib.solve.estimate import Estimate, Start
from calib.solve.fit import Progress, solve

Values = Mapping[str, np.ndarray]

FOLDS = 5  # a fit leaves out about a fifth of the locations
POSE_BLOCKS = 3 * FOLDS  # of poses: a fold leaves out three, far from each other
BY_CHANCE = 0.05  # level at which a fall of the held-out error is called one: by convention
# Of all beams, fewer of which are rejected: a hundredth, as of an error (`FALL_MATTERS`).
TAKEN_BACK = 0.01


@dataclass(frozen=True)
class Fall:
    """How the held-out error falls once something is added to a model.

    Args:
        before_mm, after_mm: its rms, as models are compared by it.
        floor_mm: what is expected of it.
        gain_m2: how much the mean square [m2] of each stop, or of each tracked pose, falls;
            empty where that is not known.
        rejected_share: of the beams held out, before and after, where it may take some back.
        sizes: how large errors are before and after; None where that is not told apart.
    """

    before_mm: float
    after_mm: float
    floor_mm: float
    gain_m2: tuple[float, ...] = ()
    rejected_share: tuple[float, float] | None = None
    sizes: tuple[ErrorSize, ErrorSize] | None = None

    @classmethod
    def of(
        cls,
        before: ErrorSize,
        after: ErrorSize,
        gain_m2: tuple[float, ...] = (),
        rejected_share: tuple[float, float] | None = None,
    ) -> Fall:
        """From one size to another."""
        return cls(
            before_mm=before.judged_mm,
            after_mm=after.judged_mm,
            floor_mm=after.floor_mm,
            gain_m2=gain_m2,
            rejected_share=rejected_share,
            sizes=(before, after),
        )

    @property
    def rises(self) -> bool:
        """Whether stops that were held out are predicted worse with it."""
        return self.after_mm > self.before_mm and not self.takes_back

    @property
    def takes_back(self) -> bool:
        """Whether so many fewer beams are rejected with it that its error is of others."""
        before, after = self.rejected_share or (0.0, 0.0)
        return before - after > TAKEN_BACK

    @property
    def explained(self) -> float:
        """Share of what the error has above what is expected; from -1, where it rises by as much as
        there was above that, or by more, to 1."""
        squares = np.square([self.before_mm, self.after_mm, self.floor_mm])
        before, after, floor = squares.tolist()
        return (before - after) / max(before - floor, abs(before - after), 1e-12)

    @property
    def spread_mm(self) -> float | None:
        """Standard error of the fall of the rms, by stops; None where fewer than two tell."""
        if len(self.gain_m2) < 2:
            return None
        return 1e6 * self._spread_m2 / max(self.before_mm + self.after_mm, 1e-12)

    @property
    def by_chance(self) -> bool:
        """Whether stops differ so much that the fall may be chance: by Student's t and, as a few
        that lie far from all others can have most of the error, by signed ranks (Wilcoxon 1945);
        on one side, each at half the level."""
        if len(self.gain_m2) < 2:
            return False
        limit = special.stdtrit(len(self.gain_m2) - 1, 1.0 - BY_CHANCE / 2)
        if np.mean(self.gain_m2) > limit * self._spread_m2:
            return False
        if not any(self.gain_m2):
            return True
        from scipy.stats import wilcoxon  # seldom needed, and slow to import

        return bool(wilcoxon(self.gain_m2, alternative="greater").pvalue >= BY_CHANCE / 2)

    @property
    def _spread_m2(self) -> float:
        return float(np.std(self.gain_m2, ddof=1) / np.sqrt(len(self.gain_m2)))


def fall_document(fall: Fall | None) -> dict[str, dict[str, float | None]]:
    """As diagnosis.json has it: the rms, and that of orientations, before and after; nothing in
    them where nobody looked."""
    both = turned = (None, None)
    if fall is not None:
        both = fall.before_mm, fall.after_mm
        if fall.sizes is not None:
            both, turned = zip(*((s.rms_mm, s.turned_mrad) for s in fall.sizes), strict=True)
    pairs = {"held_out_rms_mm": both, "held_out_rms_mrad": turned}
    return {key: dict(zip(("before", "after"), some, strict=True)) for key, some in pairs.items()}


def from_to(document: Mapping[str, Any]) -> str:
    """What `fall_document` says, in words; empty of a fall that is not known."""
    told = []
    for unit in ("mm", "mrad"):
        ends = document.get(f"held_out_rms_{unit}") or {}  # earlier versions wrote no mrad
        if None not in (before := ends.get("before"), after := ends.get("after")):
            told.append(f"{before:.2f} to {after:.2f} {unit}")
    return " and, of orientations, from ".join(told)


def gains_m2(before: Sequence[float], after: Sequence[float]) -> tuple[float, ...]:
    """How much the mean squares [m2] of stops fall; none where they are not the same stops."""
    gain = np.subtract(before, after) if len(before) == len(after) else np.zeros(0)
    return tuple(gain[np.isfinite(gain)].tolist())


@dataclass(frozen=True)
class Keep:
    """What becomes of the rows of a stop that a fit left out.

    Args:
        of: makes what is kept of them: a function of a module, as `over_stops` has it.
        take: takes that, here.
    """

    of: Callable[[Rows], Any]
    take: Callable[[ScanStop, Any], None]


def folds(sources: Sequence[Source], by: str) -> list[list[np.ndarray]]:
    """Which stops each fold leaves out: per fold, per source, (K,) bool.

    Args:
        sources: the recordings.
        by: as `unit_of` has it.
    """
    of = {
        "location": lambda s: s.recording.location,
        "stop": lambda s: np.array(s.recording.stops),
        "poses": pose_blocks,
    }[unit_of(sources, by)]
    labels = [of(source) for source in sources]
    names = list(dict.fromkeys(str(x) for found in labels for x in found))
    if len(names) < 3:
        return []
    count = min(FOLDS, len(names))
    return [[np.isin(found, names[i::count]) for found in labels] for i in range(count)]


def unit_of(sources: Sequence[Source], by: str) -> str:
    """What a fold leaves out whole: "location", "stop", or "poses".

    Where there is one location only, stops are left out one by one. Of an arm under a tracker
    alone, whose base stands still, blocks of neighbouring poses are: a pose with others close
    around it is predicted by them, whatever the model lacks, so single poses say how well the fit
    interpolates; blocks all over the workspace say what it does where no pose was.

    Args:
        sources: the recordings.
        by: "location" or "stop", as a user says.
    """
    if by == "stop":
        return by
    one = len({str(x) for s in sources for x in s.recording.location}) < 2
    still = one or all(s.rig.moves == "never" for s in sources)
    alone = not any(s.rig.lidar and s.recording.has_scan.any() for s in sources)
    if still and alone and any(s.rig.carried for s in sources):
        return "poses"
    return "stop" if one else by


def pose_blocks(source: Source) -> np.ndarray:
    """The block of neighbours (K,) that each pose of an arm is of, as text.

    By k-means over the positions, as tracked, of the bodies beyond the joints, from poses that lie
    as far apart as can be: the same poses give the same blocks.
    """
    seen = [source.recording.bodies[body][:, :3] for body in source.rig.carried]
    at = np.hstack([np.zeros((len(source.recording.stops), 0)), *seen])
    at = at[:, np.isfinite(at).any(axis=0)]
    at = np.where(np.isfinite(at), at, np.nanmean(at, axis=0))
    middles: list[int] = []
    away = np.linalg.norm(at - at.mean(axis=0), axis=1)
    while len(middles) < POSE_BLOCKS and away.max(initial=0.0) > 0:
        middles.append(int(np.argmax(away)))
        away = np.linalg.norm(at[:, None] - at[middles], axis=2).min(axis=1)
    if not middles:
        return np.array(source.recording.stops)
    from scipy.cluster.vq import kmeans2  # late: it loads much, and few recordings need it

    _, block = kmeans2(at, at[middles], iter=20, minit="matrix")
    return np.char.mod("block %02d", block)


def near(trained: Problem, progress: Progress, start: Start | None = None) -> Estimate:
    """The fit of a fold, from that of all stops, which knows how widely things scatter; where that
    leads to no optimum, from nothing."""
    if start is not None:
        estimate = solve(trained, progress=progress, start=start, spread=False)
        if estimate.converged:
            return estimate
    return solve(trained, progress=progress)


def held_out(
    sources: Sequence[Source],
    model: Model,
    by: str,
    count: int,
    progress: Progress,
    start: Start | None = None,
    keep: Keep | None = None,
    fit: Callable[..., Estimate] = near,
) -> Errors:
    """Residuals of stops left out of the fit, their poses told by tracker and arm alone.

    Args:
        sources: the recordings.
        model: what is estimated.
        by: "location" or "stop"; see `unit_of`.
        count: how many folds to evaluate.
        progress: as of `fit.solve`.
        start: a fit of all stops: each fold's fit is near it, and starts from there.
        keep: what becomes of the rows of every stop left out, where there are scans.
        fit: `near`, or `fit.stepped` for what is known from one linearisation.
    """
    out = Errors()
    for number, fold in enumerate(folds(sources, by)[:count], 1):

        def tell(what: str, done: int, total: int, number: int = number) -> None:
            progress(f"without fold {number}: {what}", done, total)

        trained = problems.build(sources, model, [~left for left in fold])
        estimate = fit(trained, progress=tell, start=_without_planes(trained, start))
        unseen = problems.build(sources, model, fold, trained.meetings)
        unseen = with_spread(unseen, spread_of(estimate.problem))
        out += predict(unseen, trained, estimate, keep)
    return out


def _without_planes(trained: Problem, start: Start | None) -> Start | None:
    """A start less the planes found in the scans: other scans, other planes. How uneven walls are,
    others tell as well."""
    found = [m for m in trained.meetings.values() if isinstance(m, PlaneSurface)]
    if start is None or not found:
        return start
    return start.without([name for each in found for name in (each.variable, *cells_of(each))])


def predict(
    unseen: Problem,
    trained: Problem,
    estimate: Estimate,
    keep: Keep | None = None,
) -> Errors:
    """Residuals of a problem whose calibration comes from an estimate of another; see `placed`."""
    scans, bodies = unseen.scans, unseen.bodies
    predicted, told = placed(unseen, trained, estimate)
    if not scans:
        beyond = [b for b in bodies if b.stops.rig.joints_to(b.body)]
        judged = [b for b in beyond if told(b.stops)]
        return body_errors(judged, predicted.values, predicted)
    known = [Foretold.of(s, predicted) if told(s.stops) else None for s in scans]
    work, out = partial(_unseen, predicted.values, keep and keep.of), Errors()
    for scan, (errors, kept) in zip(scans, over_stops(work, scans, known), strict=True):
        out += errors
        if keep is not None:
            keep.take(scan, kept)
    return out


def placed(
    unseen: Problem, trained: Problem, estimate: Estimate
) -> tuple[Estimate, Callable[[Stops], bool]]:
    """Where stops stand whose calibration comes from an estimate of another problem.

    Poses of the unseen stops are found from their tracked bodies and levels; where no body is seen,
    or joints are not read and no body beyond them is seen, from their own beams with the
    calibration held.

    Args:
        unseen: the stops' problem; what does not place them is taken out of it.
        trained, estimate: the other problem, and what was estimated from it.

    Returns:
        The estimate, and whether tracked bodies or the other problem told where stops stand.
    """
    shared = [n for n in trained.variables if n in unseen.variables]
    held = [trained.variables[n] for n in shared]
    names = [v.name for v in held]
    covariance = estimate.covariance_of(names)
    prior = JointPrior(held, {n: estimate.values[n] for n in names}, covariance)
    scans, seen = unseen.scans, unseen.seen
    # Without a LiDAR, bodies before the joints tell where the rig is; those beyond are judged, and
    # tell of themselves no more than how joints stand that nothing reads.
    unseen.blocks = [b for b in seen if scans or _places(b)]
    roots = {block.stops.root for block in unseen.bodies} | set(shared)
    turned = {b.stops.noise for b in unseen.bodies if b.stops.rig.joints_to(b.body)}
    joints = {name for name, v in unseen.variables.items() if v.role is Role.JOINTS and v.unread}

    def told(stops: Stops) -> bool:
        return stops.root in roots and (stops.noise not in joints or stops.noise in turned)

    unseen.scans = [scan for scan in scans if not told(scan.stops)]
    return solve(unseen, prior, spread=False), told


def _places(block: SeenBody) -> bool:
    """Whether a stop without a scan is placed by this, too."""
    rig = block.stops.rig
    return bool(rig.passive) or not rig.joints_to(block.body)


def _unseen(
    values: Values, of: Callable[[Rows], Any] | None, scan: ScanStop, known: Foretold | None
) -> tuple[Errors, Any]:
    """Range residuals of a stop's beams that meet a surface, and what is kept `of` its rows."""
    rows = scan.rows(values, scan.associate(values, near_edges=True))
    return row_errors(rows, known), None if of is None else of(rows)
