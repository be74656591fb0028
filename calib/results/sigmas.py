"""How right sigmas are: how far residuals exceed them, and intervals that are wider for it."""

from __future__ import annotations

from collections.abc import Collection, Container, Mapping, Sequence

import numpy as np

from calib.problem.problem import Block
from calib.problem.unknowns import Role, Unknown
from calib.residuals.groups import CAD
from calib.residuals.seen import SeenBody, evaluated
from calib.results.errors import Errors
from calib.results.intervals import Intervals, in_cad
from calib.solve.estimate import Estimate
from calib.solve.reweight import unweighted

# Residuals so much larger than their sigmas are no accident: what rows tell is less certain.
TOLERATED = 1.2
# Redundancy of all that CAD says of frames, below which nothing is told of how right it is: with
# less than one row's worth, chance alone puts the ratio anywhere.
CHECKED = 1.0


def widened(
    known: Intervals, estimate: Estimate, beams: Errors, elsewhere: Collection[str] = ()
) -> Intervals:
    """Intervals to which rows add more where the residuals of an instrument exceed its sigmas, and
    CAD where frames are further from it than its sigmas allow; one wild row widens none.

    Args:
        known: the intervals.
        estimate, beams, elsewhere: as of `misfit`.
    """
    bulk = misfit(estimate, beams, elsewhere, weighted=True)
    large = {kind: times for kind, times in bulk.items() if times > TOLERATED}
    cad = large.pop(CAD, 1.0)
    return known.at_least(max([1.0, *large.values()]), cad)


def misfit(
    estimate: Estimate, beams: Errors, elsewhere: Collection[str] = (), weighted: bool = False
) -> dict[str, float]:
    """How many times larger than their sigmas allow the residuals are, by kind of instrument.

    For instruments that see bodies or targets the root of chi-square over its degrees of freedom,
    their own unknowns taken off; for beams the rms of inliers over what is expected of them; for
    the reference how far its surfaces had to be moved, over how far they may be off; for CAD the
    root of chi-square of how far frames moved from there, over the redundancy of these moves. About
    1 or less when all is well: an effect that is missing in the LiDAR may be laid on beams or on
    surfaces, and shows in either.

    Args:
        estimate: the solution.
        beams: of all scans, as fitted.
        elsewhere: frames of whose places something other than CAD tells.
        weighted: whether groups of rows that are further off than chance puts one, and whose pull
            is bounded by a robust weight, are left out: what is left tells how right sigmas are. Of
            CAD, which has few, they count with their weight.
    """
    values, unknowns = estimate.values, estimate.problem.variables
    out = {}
    # Beams, where there are any, hold where the rig stands; what is a level's own is not there.
    place = set() if beams.count else {Role.PLACE}
    level = {Role.GRAVITY, Role.ZERO}
    owners = {"tracker": place, "level": level, "target": {Role.TARGET, Role.GRAVITY}}
    for kind, own in owners.items():
        blocks = [b for b in estimate.problem.blocks if b.kind == kind]
        if blocks:
            out[kind] = _of_blocks(estimate, blocks, own, weighted)
    if beams.count and estimate.scans:
        out["beams"] = beams.misfit
    surfaces = [u for u in unknowns.values() if u.role is Role.SURFACE]
    if surfaces:
        worst = max(_prior_cost(u, values[u.name]) / u.dim for u in surfaces)
        out["reference"] = float(np.sqrt(worst))
    return out | _of_cad(estimate, elsewhere, weighted)


def _of_blocks(
    estimate: Estimate, blocks: Sequence[Block], own: Container[Role], weighted: bool
) -> float:
    """Of trackers, levels or targets; see `misfit`.

    Args:
        estimate: the solution.
        blocks: of one kind.
        own: roles of the unknowns that are these rows' own.
        weighted: as of `misfit`. Where most groups would be left out, nothing tells which are good,
            and all count with their weights.
    """
    values, unknowns = estimate.values, estimate.problem.variables
    counted = list(blocks if weighted else map(unweighted, blocks))
    rows = [(b, r, _bulk(b)) for b, r in zip(counted, _rows_of(counted, values), strict=True)]
    if weighted:
        told = sum(int(bulk.sum()) for *_, bulk in rows)
        if 2 * told > sum(b.rows for b in blocks):
            rows = [(b, r[bulk], bulk[bulk]) for b, r, bulk in rows if bulk.any()]
    seen = [unknowns[n] for n in {n: None for b, *_ in rows for n in b.variables}]
    joints = [u for u in seen if u.role is Role.JOINTS]
    free = sum(u.told for u in seen if u.role in own) + sum(u.unread for u in joints)
    if weighted:
        free += sum(u.dim - u.unread for u in joints if u.weight < 1.0)
        joints = [u for u in joints if u.weight >= 1.0]
    chi2 = sum(float(r @ r) for _, r, _ in rows)
    chi2 += sum(_prior_cost(u, values[u.name]) for u in joints)
    return float(np.sqrt(chi2 / max(1, sum(len(r) for _, r, _ in rows) - free)))


def _rows_of(blocks: Sequence[Block], values: Mapping[str, np.ndarray]) -> list[np.ndarray]:
    """Whitened rows of each of some blocks of one kind."""
    if isinstance(blocks[0], SeenBody):
        return [rows for rows, _ in evaluated(blocks, values)]
    return [block.evaluate(values, False)[0] for block in blocks]


def _bulk(block: Block) -> np.ndarray:
    """Which rows (N,) of a block have their full weight."""
    if block.weight is None:
        return np.ones(block.rows, bool)
    return np.repeat(block.weight >= 1.0, block.rows // len(block.weight))


def _of_cad(estimate: Estimate, elsewhere: Collection[str], weighted: bool) -> dict[str, float]:
    """Of the places that frames have in CAD, as far as others contradict them (Birge 1932)."""
    frames = in_cad(estimate.problem) - set(elsewhere)
    start = np.cumsum([0, *(u.dim for u in estimate.variables)])
    variance = np.diag(estimate.covariance)
    chi2 = left = 0.0
    for unknown, first in zip(estimate.variables, start, strict=False):
        if unknown.name in frames:
            weight = unknown.weight if weighted else 1.0
            chi2 += weight * _prior_cost(unknown, estimate.values[unknown.name])
            told = variance[first : first + unknown.dim] / np.square(unknown.sigma)
            left += float(np.sum(np.maximum(1.0 - weight * told, 0.0)))
    return {CAD: float(np.sqrt(chi2 / left))} if left > CHECKED else {}


def _prior_cost(unknown: Unknown, value: np.ndarray) -> float:
    return float(np.sum(np.square((value - unknown.mean) / unknown.sigma)))
