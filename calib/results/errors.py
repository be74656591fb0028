"""How large the residuals are, and how large they should be if the model were right."""

from __future__ import annotations

import operator
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from scipy import special
from scipy.linalg import block_diag
from scipy.sparse import csr_array, hstack

from calib.forward import Values
from calib.linear.parallel import over_stops
from calib.linear.rows import TWIST
from calib.problem import Problem
from calib.problem.unknowns import Role
from calib.residuals.beams import Rows
from calib.residuals.scan import ScanStop
from calib.residuals.seen import evaluated
from calib.residuals.surfaces import PlaneSurface
from calib.residuals.tracker import TrackedBody
from calib.solve.estimate import Estimate
from calib.solve.fit import Progress
from calib.solve.reweight import unweighted

EXCEEDED = 0.01  # how often a right model may have a larger error: by convention
OF_POSITIONS = "tracked position"  # what is told of in mm where there are no scans


@dataclass(frozen=True)
class Squares:
    """Sums over squares of residuals, of any unit.

    Args:
        count: how many residuals.
        total: of their squares.
        expected: of the variances that their sigmas lead one to expect.
    """

    count: int = 0
    total: float = 0.0
    expected: float = 0.0

    def __add__(self, other: Squares) -> Squares:
        return Squares(*map(operator.add, vars(self).values(), vars(other).values()))

    @property
    def rms(self) -> float | None:
        return float(np.sqrt(self.total / self.count)) if self.count else None

    @property
    def floor(self) -> float | None:
        """What is expected of the rms."""
        return float(np.sqrt(self.expected / self.count)) if self.count else None


@dataclass(frozen=True)
class Errors:
    """Sums over residuals: ranges of beams, or positions of bodies.

    Args:
        count: how many there are, those of weight 0 left out, as from the next three sums.
        total_m, squares_m2: sum [m] and sum of squares [m2].
        expected_m2: sum of the variances [m2] that their sigmas lead one to expect.
        foretold_m2, swing_m2: of this the part that is due to what was foretold of them, and its
            standard deviation, as all of it may be the error of a few unknowns.
        rejected: how many have weight 0: their beams meet a surface, and they were rejected.
        rejected_m2: sum of the squares of those [m2].
        each_m2: mean square [m2] of each stop, or of each tracked pose as in `poses`, in order;
            NaN where a stop has none.
        turned: of bodies, the angles [rad] between orientations as tracked and as predicted.
        poses: of bodies, positions and orientations [m] together; see `body_errors`.
    """

    count: int = 0
    total_m: float = 0.0
    squares_m2: float = 0.0
    expected_m2: float = 0.0
    foretold_m2: float = 0.0
    swing_m2: float = 0.0
    rejected: int = 0
    rejected_m2: float = 0.0
    each_m2: tuple[float, ...] = ()
    turned: Squares = Squares()
    poses: Squares = Squares()

    def __add__(self, other: Errors) -> Errors:
        return Errors(**{name: mine + getattr(other, name) for name, mine in vars(self).items()})

    @property
    def rms_mm(self) -> float | None:
        return 1e3 * float(np.sqrt(self.squares_m2 / self.count)) if self.count else None

    @property
    def mean_mm(self) -> float | None:
        return 1e3 * self.total_m / self.count if self.count else None

    @property
    def std_mm(self) -> float | None:
        if not self.count:
            return None
        return float(np.sqrt(max(0.0, self.rms_mm**2 - self.mean_mm**2)))

    @property
    def rejected_share(self) -> float | None:
        """Of all residuals, those of weight 0."""
        every = self.count + self.rejected
        return self.rejected / every if every else None

    @property
    def rms_all_mm(self) -> float | None:
        """Of all residuals, those of weight 0 included."""
        every = self.count + self.rejected
        return 1e3 * float(np.sqrt((self.squares_m2 + self.rejected_m2) / every)) if every else None

    @property
    def misfit(self) -> float | None:
        """The rms over what is expected of it."""
        return float(np.sqrt(self.squares_m2 / self.expected_m2)) if self.count else None

    @property
    def floor_mm(self) -> float | None:
        return 1e3 * float(np.sqrt(self.expected_m2 / self.count)) if self.count else None

    @property
    def by_chance_mm(self) -> float | None:
        """The rms that a right model exceeds once in a hundred times, where something was foretold:
        that part has a chi-square distribution of as many degrees as its standard deviation says.
        """
        if not self.swing_m2:
            return None
        degrees = 2.0 * (self.foretold_m2 / self.swing_m2) ** 2
        most_m2 = self.foretold_m2 * special.chdtri(degrees, EXCEEDED) / degrees
        return 1e3 * float(np.sqrt((self.expected_m2 - self.foretold_m2 + most_m2) / self.count))

    @property
    def of_held_out(self) -> dict[str, Any]:
        """For a run's summary, of stops held out: how large each one's are, and by chance all."""
        each_mm = (1e3 * np.sqrt(self.each_m2)).tolist()
        return {"held_out_each_mm": each_mm, "held_out_by_chance_mm": self.by_chance_mm}

    @property
    def size(self) -> ErrorSize:
        """How large they are; of some."""
        mm, floor_mm = self.rms_mm, self.floor_mm
        if not self.turned.count:
            return ErrorSize(mm, mm, floor_mm)
        return ErrorSize(
            mm, 1e3 * self.poses.rms, 1e3 * self.poses.floor, turned_mrad=1e3 * self.turned.rms
        )


@dataclass(frozen=True)
class ErrorSize:
    """How large errors are.

    Args:
        rms_mm: of ranges, or of positions.
        judged_mm, floor_mm: by which models are compared, and what is expected of it: the same, or
            that of positions and orientations together.
        turned_mrad: rms of orientations, where these are seen.
    """

    rms_mm: float
    judged_mm: float
    floor_mm: float
    turned_mrad: float | None = None


def of_orientations(nominal: Errors, seen: Errors, unseen: Errors) -> dict[str, Any]:
    """For a run's summary: the rms of orientations where a tracker sees some, and of the poses of
    bodies where there are no scans; before the fit, after it, and of stops held out."""
    floor = unseen if unseen.count else seen
    kinds = {"nominal": nominal, "fit": seen, "held_out": unseen}
    out = {}
    for key, of in (("rms_mrad", "turned"), ("rms_pose_mm", "poses")):
        if not getattr(floor, of).count:
            continue
        every = {kind: getattr(errors, of).rms for kind, errors in kinds.items()}
        every["noise_floor"] = getattr(floor, of).floor
        out[key] = {kind: None if rms is None else 1e3 * rms for kind, rms in every.items()}
    return out


def judged_mm(summary: Mapping[str, Any]) -> Mapping[str, float | None]:
    """Of a run's summary the rms by which models are compared: ``fit``, ``held_out``, and the
    ``noise_floor`` that is expected; see `ErrorSize`."""
    return summary.get("rms_pose_mm") or summary["rms_mm"]


def over_expected(summary: Mapping[str, Any]) -> float:
    """The held-out error of a run over the expected one, and no more than 1 where a right model has
    one as large once in a hundred times, as other stops cannot tell it; 0 where nothing was held
    out."""
    judged = judged_mm(summary)
    error, floor = judged.get("held_out"), judged["noise_floor"]
    if not error or not floor:
        return 0.0
    chance = summary.get("held_out_by_chance_mm") or floor  # which earlier versions lack
    return min(error / floor, 1.0) if error <= chance else error / floor


def tells_of_poses(summary: Mapping[str, Any]) -> bool:
    """Whether the errors by which models are compared are of orientations, too, where these are
    seen: earlier versions told of positions alone."""
    return summary["residual"] != OF_POSITIONS or "rms_pose_mm" in summary


def held_out_size(summary: Mapping[str, Any]) -> ErrorSize | None:
    """Of a run's summary how large the errors of stops held out are; None where none were."""
    rms_mm, judged = summary["rms_mm"]["held_out"], judged_mm(summary)
    if rms_mm is None:
        return None
    turned = (summary.get("rms_mrad") or {}).get("held_out")
    return ErrorSize(rms_mm, judged["held_out"], judged["noise_floor"], turned)


def row_errors(rows: Rows, known: Foretold | None = None) -> Errors:
    """Range residuals of a stop's beams that meet a surface; of one that was foretold, how well it
    was."""
    inlier, lost = rows.weight > 0, rows.usable & (rows.weight == 0)
    expected = np.square(rows.sigma_m) + np.square(rows.reference_sigma_m)
    foretold_m2, swing_m2 = (0.0, 0.0) if known is None else known.of_rows(rows, inlier)
    r, out = rows.residual_m[inlier], rows.residual_m[lost]
    return Errors(
        count=len(r),
        total_m=float(r.sum()),
        squares_m2=float(r @ r),
        expected_m2=float(expected[inlier].sum()) + foretold_m2,
        foretold_m2=foretold_m2,
        swing_m2=swing_m2,
        rejected=len(out),
        rejected_m2=float(out @ out),
        each_m2=(float(r @ r) / len(r) if len(r) else np.nan,),
    )


@dataclass(frozen=True)
class Foretold:
    """How well it is known where a stop stands that was predicted, and not fitted to its scan.

    Args:
        beside: the unknowns that its beams depend on, P numbers: the effects, and planes that were
            found in the scans. Other stops need not tell an effect; and where neither tracker nor
            mesh is there, all may be shifted, or be longer, together, and no beam reads otherwise.
        covariance: (6 + P, 6 + P) of the LiDAR's right increment, and of these.
        chance: unknown -> (n,) variances of what chance does anew to each stop or location, which
            no other tells.
    """

    beside: Mapping[str, slice]
    covariance: np.ndarray
    chance: Mapping[str, np.ndarray]

    @classmethod
    def of(cls, scan: ScanStop, predicted: Estimate) -> Foretold:
        """By an estimate's marginals."""
        placed = scan.stops.in_reference(scan.stops.rig.lidar_frame, predicted.values)
        names, known = list(placed.d), predicted.problem.variables
        acting = [t.variable for t in scan.terms if t.variable in known]
        drawn = [name for name in acting if known[name].role is Role.SCATTER]
        beside, end = {}, TWIST
        planes = [scan.meeting.variable] if isinstance(scan.meeting, PlaneSurface) else []
        for name in dict.fromkeys([*planes, *acting]):
            if name in known and name not in (*drawn, *names):
                beside[name] = slice(end, end := end + known[name].dim)
        d = np.hstack([placed.d[name][0] for name in names])
        d = block_diag(d, np.eye(end - TWIST))
        return cls(
            beside=beside,
            covariance=d @ predicted.covariance_of([*names, *beside]) @ d.T,
            chance={name: np.diag(predicted.covariance_of([name])) for name in drawn},
        )

    def of_rows(self, rows: Rows, some: np.ndarray) -> tuple[float, float]:
        """What that adds to the sum of squares that is expected of some (N,) of the residuals, and
        its standard deviation; what chance does anew has none of note."""
        by = [csr_array(rows.by_twist), *(self._by(rows, name) for name in self.beside)]
        moves = hstack(by, format="csr")[some]
        spread = (moves.T @ moves) @ self.covariance  # of a quadratic form
        sum_m2, swing_m2 = np.trace(spread), np.sqrt(2.0 * np.einsum("ij,ji->", spread, spread))
        for column in (c for c in rows.sparse if c.variable in self.chance):
            met = np.flatnonzero(some & (column.index >= 0))
            variance = self.chance[column.variable][column.components[column.index[met]]]
            sum_m2 += np.square(column.value[met]) @ variance
        return float(sum_m2), float(swing_m2)

    def _by(self, rows: Rows, name: str) -> csr_array:
        """Derivative (N, n) of the residuals by one of the unknowns beside."""
        at = self.beside[name]
        shape = len(rows.by_twist), at.stop - at.start
        if name in rows.dense:
            return csr_array(rows.dense[name])
        out = csr_array(shape)
        for column in (c for c in rows.sparse if c.variable == name):
            met = np.flatnonzero(column.index >= 0)
            to = column.components[column.index[met]]
            out += csr_array((column.value[met], (met, to)), shape=shape)
        return out


def body_errors(
    blocks: Sequence[TrackedBody],
    values: Mapping[str, np.ndarray],
    predicted: Estimate | None,
) -> Errors:
    """Distances between tracked and predicted positions of bodies, and angles between orientations.

    In `Errors.poses` an angle counts as far as it moves a point at `TrackedBody.turns_at_m`.

    Rows that the estimate rests on have less error than their noise, by what it takes from them:
    their residuals' covariance is R - A C A^T, and R + A C A^T that of other rows.

    Args:
        blocks: of the bodies.
        values: the state.
        predicted: where their place was predicted and not fitted, the estimate whose marginals say
            how well; its share belongs to what is expected.
    """
    out, own = Errors(), set() if predicted is None else set(map(id, predicted.problem.blocks))
    found = evaluated([unweighted(block) for block in blocks], values)
    known = [np.zeros(1)] * len(blocks)
    if predicted is not None:
        known = predicted.variances([d for _, d in found])
    for block, (residual, _), variance in zip(blocks, found, known, strict=True):
        more = np.broadcast_to(variance, residual.shape) * (-1.0 if id(block) in own else 1.0)
        out += _of_body(block, np.square(residual), 1.0 + more)
    return out


def _of_body(block: TrackedBody, squares: np.ndarray, expected: np.ndarray) -> Errors:
    """Of a body's whitened rows (m,): their squares, and what is expected of these."""
    count, rad = len(block.measured), np.array(block.units) == "rad"
    each, should = (x.reshape(count, -1) * np.square(block.sigma) for x in (squares, expected))
    moved = (each[:, ~rad].sum(axis=1), should[:, ~rad].sum(axis=1))
    turned = (each[:, rad].sum(axis=1), should[:, rad].sum(axis=1))
    pose = [m + block.turns_at_m**2 * t for m, t in zip(moved, turned, strict=True)]
    return Errors(
        count=count,
        total_m=float(np.sqrt(moved[0]).sum()),
        squares_m2=float(moved[0].sum()),
        expected_m2=float(moved[1].sum()),
        each_m2=tuple(pose[0].tolist()),
        turned=Squares(0 if block.is_point else count, *(float(t.sum()) for t in turned)),
        poses=Squares(count, *(float(p.sum()) for p in pose)),
    )


def errors_at(
    problem: Problem, values: Values, progress: Progress = lambda what, done, total: None
) -> Errors:
    """Of all beams at these values, or of tracked bodies where there are no scans."""
    if not problem.scans:
        return body_errors(problem.bodies, values, None)
    total = Errors()
    for i, found in enumerate(over_stops(partial(_of_scan, values), problem.scans)):
        progress("residuals of beams", i, len(problem.scans))
        total += found
    return total


def _of_scan(values: Values, scan: ScanStop) -> Errors:
    return row_errors(scan.rows(values))
