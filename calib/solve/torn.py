"""Stops whose bodies contradict each other grossly: what to begin with, and what their scan says;
and scans that have moved far since it was settled what they meet.

A tracker's placeholder, a pose that it held on to or a stuck encoder puts two bodies of one stop
metres apart. Huber's weights bound what each of them does to the estimate, and leave open which is
right; the scan knows.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.special import ndtri

from calib.linear.layout import StopKey, key_of
from calib.linear.parallel import over_stops
from calib.problem.problem import Problem
from calib.residuals.beams import Association
from calib.residuals.groups import Group
from calib.residuals.robust import robust_scale
from calib.residuals.scan import ScanStop
from calib.residuals.seen import BodiesTogether
from calib.residuals.tracker import TrackedBody
from chains import se3
from chains.errors import InputError, NothingMetError

# Bodies half of whose stops are so far (m, rad) from where the chain puts them after a fit are not
# described by it: CAD and encoders are good to millimetres. Measured on the independent recordings:
# 0.004 at most, though effects were missing; 0.09 with rows of zeros, 0.6 with the quaternions'
# order wrong, 0.8 with two bodies exchanged.
ASTRAY = 0.05
# A scan whose residuals are so many times wider than those of most, where trackers and targets put
# the LiDAR, was not taken there. On the recordings of the independent simulator it is 1.8 at most,
# and 206 and 208 of two scans that were exchanged. So it is of a body, against most stops of it.
CONTRADICTS = 10.0
SCANS_ALIKE = 2.0  # and by less than this scans differ that were taken where they are said to be
MOST_OF_BEAMS = 0.9  # of a scan's beams; a tenth and more meet the walls across any axis of a room
DOUBTED = 1e-6  # weight: a body a metre off then pulls as hard as one a millimetre off
# A scan that moved further, m and rad, looks anew what its beams meet: a choice; if these tell it
# by more than so many sigmas. Scans along a corridor, of which nothing but its bumps tells, moved
# by 18 mm from look to look, 0.7 to 2.1 sigmas; 22 to 43 before it was known what they meet.
STRAYED, STRAYED_SIGMAS = 3e-3, 3.0

Values = Mapping[str, np.ndarray]


def away(problem: Problem, values: Values) -> dict[str, list[tuple[TrackedBody, np.ndarray]]]:
    """Body -> its blocks, and at each of their K stops how far (K,) it was seen from where the
    chain puts it, in m or rad, whichever is more."""
    off: dict[int, np.ndarray] = {}
    for some in BodiesTogether.of(problem.bodies):
        T, measured = np.concatenate(list(some.in_world(values))), some.whole.measured
        far = np.linalg.norm(measured[:, :3, 3] - T[:, :3, 3], axis=1)
        if not some.whole.is_point:
            turn = se3.so3_log(T[:, :3, :3].mT @ measured[:, :3, :3])
            far = np.maximum(far, np.linalg.norm(turn, axis=1))
        off |= zip(map(id, some.blocks), far.reshape(len(some.blocks), -1), strict=True)
    out: dict[str, list[tuple[TrackedBody, np.ndarray]]] = {}
    for block in problem.bodies:
        out.setdefault(block.body, []).append((block, off[id(block)]))
    return out


def astray(problem: Problem, values: Values) -> bool:
    """Whether half of the stops have a body far from where the chain puts it."""
    every = ([far for _, far in found] for found in away(problem, values).values())
    return any(np.median(np.concatenate(each)) > ASTRAY for each in every)


def doubted(problem: Problem, values: Values) -> Problem:
    """The problem with next to no weight on the bodies of stops where one is grossly off; itself
    where none is.

    A fit begins with it: at their sigmas, placeholders would draw the first solution to them by
    metres, and weights taken there find the way back slowly.
    """
    wild_at: set[StopKey] = set()
    for found in away(problem, values).values():
        median = float(np.median(np.concatenate([far for _, far in found])))
        for block, far in found:
            wild = np.flatnonzero(far > max(CONTRADICTS * median, ASTRAY))
            wild_at |= {block.stop_names[k] for k in wild}
    blocks = []
    for block in problem.blocks:
        if isinstance(block, TrackedBody) and not wild_at.isdisjoint(block.stop_names):
            wild = np.array([key in wild_at for key in block.stop_names])
            block = replace(block, weight=np.where(wild, DOUBTED, 1.0))
        blocks.append(block)
    return replace(problem, blocks=blocks) if wild_at else problem


def borne_out(problem: Problem, values: Values) -> tuple[set[str], dict[str, np.ndarray]]:
    """What scans say of stops at which bodies contradict each other grossly.

    Args:
        problem: with the weights that residuals of bodies ask for.
        values: the state.

    Returns:
        Tokens of the bodies that are wrong there, and where the rig stands as the right ones say.
    """
    roots = Counter(scan.stops.root for scan in problem.scans)
    asked = [scan for scan in torn(problem) if roots[scan.stops.root] == 1]  # none shares its place
    usual = _usual(problem, values, asked) if asked else 0.0
    wrong: set[str] = set()
    stood: dict[str, np.ndarray] = {}
    for scan in asked:
        tried = [(_width(values, scan, T), g, T) for g, T in _stands(problem, scan, values)]
        first, *others = sorted(tried, key=lambda each: each[0])
        if others and first[0] < SCANS_ALIKE * usual and SCANS_ALIKE * first[0] < others[0][0]:
            wrong |= {group.token for _, group, _ in others}
            stood[scan.stops.root] = first[2]
    return wrong, stood


def torn(problem: Problem) -> list[ScanStop]:
    """Scans of stops at which a body lost nearly all its weight."""
    keys = {
        key
        for block in problem.bodies
        if block.weight is not None
        for key, weight in zip(block.stop_names, block.weight, strict=True)
        if 0 < weight < 1.0 / CONTRADICTS
    }
    return [scan for scan in problem.scans if key_of(scan) in keys]


def _usual(problem: Problem, values: Values, asked: Sequence[ScanStop]) -> float:
    """How many sigmas wide the residuals of most other scans are."""
    keys = set(map(key_of, asked))
    others = [scan for scan in problem.scans if key_of(scan) not in keys]
    stands = [values[scan.stops.root] for scan in others]
    widths = list(over_stops(partial(_width, values), others, stands))
    return float(np.median(widths)) if others else np.inf


def _stands(problem: Problem, scan: ScanStop, values: Values) -> Iterator[tuple[Group, np.ndarray]]:
    """Where each body that gives a pose says that the rig stands at a scan's stop (4, 4)."""
    for block in problem.bodies:
        if key_of(scan) in block.stop_names and not block.is_point:
            k = block.stop_names.index(key_of(scan))
            T_stood_body = block.stops.from_stand(block.body, values, False).T
            T = T_stood_body[k if len(T_stood_body) > 1 else 0]
            yield block.groups[k], block.measured[k] @ se3.inverse(T)


def _width(values: Values, scan: ScanStop, T_world_root: np.ndarray) -> float:
    """How many sigmas wide the residuals of most beams are with the rig standing there: half of the
    beams of a LiDAR that is off along one axis, on floor and ceiling, tell nothing of it."""
    try:
        rows = scan.rows({**values, scan.stops.root: T_world_root})
    except InputError:  # no beam meets anything there
        return np.inf
    size = np.abs(rows.residual_m / rows.sigma_m)[rows.usable]
    return (
        float(np.quantile(size, MOST_OF_BEAMS)) / ndtri((1 + MOST_OF_BEAMS) / 2)
        if len(size)
        else np.inf
    )


def strayed(
    scans: Sequence[ScanStop],
    met: Sequence[Association],
    seen: Mapping[str, np.ndarray],
    values: Mapping[str, np.ndarray],
) -> bool:
    """Whether a scan is far from where it was when it took what its beams meet, and further than
    its beams leave open: along a corridor, what they meet there is as good as what they met.

    Args:
        scans: all scans.
        met: what the beams of each are known to meet.
        seen: the state at which they looked.
        values: the present state.
    """
    steps = (se3.log(se3.inverse(scan.pose(seen)) @ scan.pose(values)) for scan in scans)
    far = [(i, step) for i, step in enumerate(steps) if np.abs(step).max() >= STRAYED]
    some, known = [scans[i] for i, _ in far], [met[i] for i, _ in far]
    return any(over_stops(partial(_beyond_doubt, values), some, known, [step for _, step in far]))


def agreeing(scans: Sequence[ScanStop], values: Mapping[str, np.ndarray], scale: float) -> set[str]:
    """Tokens of those of some scans that contradict the others no more.

    Args:
        scans: that were set aside.
        values: the state.
        scale: how many sigmas wide the bulk of residuals is in most of the others.
    """
    found = over_stops(partial(_scale_of, values), scans)
    pairs = zip(scans, found, strict=True)
    return {scan.group.token for scan, own in pairs if own <= CONTRADICTS * scale}


def _scale_of(values: Mapping[str, np.ndarray], scan: ScanStop) -> float:
    """How many sigmas wide the bulk of a scan's residuals is; infinite where no beam tells."""
    try:
        rows = scan.rows(values, None)
    except NothingMetError:
        return np.inf
    told = (rows.residual_m / rows.sigma_m)[rows.usable]
    return robust_scale(told) if len(told) else np.inf


def _beyond_doubt(
    values: Mapping[str, np.ndarray], scan: ScanStop, met: Association, moved: np.ndarray
) -> bool:
    """Whether the beams of a scan, what they meet being known, tell where it is now from where it
    was before it moved so far (6,)."""
    rows = scan.rows(values, met)
    away = rows.by_twist @ moved / rows.sigma_m
    return float(np.sqrt(rows.weight @ np.square(away))) > STRAYED_SIGMAS
