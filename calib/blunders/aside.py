"""Scans that a fit set aside: which of them were taken somewhere else."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping

import numpy as np

from calib.blunders.chance import after_looks, at_least, log_tail
from calib.blunders.judged import Blunder, LeftOut
from calib.blunders.shifts import Shift
from calib.problem.problem import Problem
from calib.residuals.groups import ALONG_BEAMS, JOINTS, Group
from calib.residuals.robust import MAD
from calib.residuals.scan import ScanStop
from calib.solve.torn import CONTRADICTS
from chains.errors import InputError

# Of a scan's misfit where it is said to be: at another stop's place it belongs there.
BELONGS_THERE = 0.1


def stray_scans(
    problem: Problem, values: Mapping[str, np.ndarray], checked: Collection[Group]
) -> Iterator[LeftOut]:
    """The scans that a fit set aside, and where they fit. Its size is how far its points lie from
    the surfaces that they should be on (robust rms), and its sigma how far they should.

    Args:
        problem: of the fit.
        values: its solution.
        checked: groups that anything contradicts or could. A body, or the joints, of the stop that
            are none of them alone say where the LiDAR was, and may be wrong as well.
    """
    looks = len(problem.scans) + len(problem.aside)
    bodies = [group for body in problem.bodies for group in body.groups]
    for scan in problem.aside:
        off_m, sigma_m = _off(scan, values, scan.pose(values))
        others = [other for other in problem.aside if other is not scan]
        there = [_off_there(scan, values, other) for other in others]
        best = int(np.argmin(there)) if there else -1
        fits = bool(there) and there[best] < BELONGS_THERE * off_m
        chance = log_tail((off_m / sigma_m) ** 2, 1.0)
        p = at_least(np.exp(chance))
        blunder = Blunder(
            shift=_distance(scan.group, off_m, sigma_m),
            p_value=p,
            p_adjusted=float(after_looks(p, looks)),
            evidence=-chance,
            limit=CONTRADICTS**2,
            enough=CONTRADICTS**2,
            detectable={"m": CONTRADICTS * sigma_m},
            looks=looks,
        )
        place = (scan.group.recording, scan.group.where)
        here = [g for g in (*bodies, *_joints(scan)) if (g.recording, g.where) == place]
        here = [g for g in here if g not in checked]
        there = others[best].group if fits else None
        yield LeftOut(blunder, [] if fits else here, there, aside=True)


def _joints(scan: ScanStop) -> list[Group]:
    """The joints of a scan's stop."""
    where, recording = scan.group.where, scan.group.recording
    return [Group("joints", where, JOINTS, recording)] if scan.stops.rig.joint_names else []


def _distance(group: Group, off_m: float, sigma_m: float) -> Shift:
    """How far a scan's points lie off, as the shift of its group."""
    return Shift(
        group=group,
        statistic=(off_m / sigma_m) ** 2,
        dof=1,
        offset=np.array([off_m]),
        covariance=np.array([[sigma_m**2]]),
        information=np.array([[sigma_m**-2]]),
        axes=(ALONG_BEAMS,),
        units=("m",),
    )


def _off_there(scan: ScanStop, values: Mapping[str, np.ndarray], other: ScanStop) -> float:
    """How far the points lie off from another stop; infinite where no beam meets anything."""
    try:
        return _off(scan, values, other.pose(values))[0]
    except InputError:
        return np.inf


def _off(scan: ScanStop, values: Mapping[str, np.ndarray], T: np.ndarray) -> tuple[float, float]:
    """How far the points lie off, the LiDAR being there, and how far they should."""
    rows = scan.rows(values, None, T)
    return MAD * rows.median_m, float(np.median(rows.sigma_m[rows.usable]))
