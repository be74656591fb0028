"""From a rough start to where it is known what beams meet: each pass looks anew."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping
from functools import partial
from typing import NamedTuple

import numpy as np

from calib.forward import Values
from calib.linear.layout import StopKey, key_of
from calib.linear.parallel import over_stops
from calib.linear.rows import State, Weighing
from calib.linear.symmetric import eigh
from calib.residuals.beams import Rows
from calib.residuals.robust import TUKEY, tukey_cost
from calib.residuals.scan import ScanStop
from calib.residuals.surfaces import MeshSurface
from calib.solve.loop import HOPELESS, Loop
from calib.solve.torn import CONTRADICTS, STRAYED, borne_out, torn
from chains.errors import NothingMetError

SETTLED_STEP = 1e-4  # m and rad: then triangles that beams meet are kept; a choice, 1 mm at 10 m
# So often is looked what beams meet before it is asked whether that leads anywhere, and so often at
# most; good recordings, and one with the LiDAR 0.13 m from where CAD has it, take 2 to 6 passes.
# After so many, looks that leave MUCH of the cost are given up.
USUALLY_LOOKED, MOST_PASSES_LOOKED, MUCH = 8, 15, 0.9
TIMES_ASKED = 2  # times: the first pass brings the LiDAR to where it is, near enough
SCANS_OF_PLACE = 3  # scans of a place, for most of them to tell where the rig stood
# How many of the beams of a scan that a guess places count when it looks again; how far it is slid
# for that, at steps of 0.05 m; and how often it looks again at most: all choices. Measured in 32
# worlds of two simulators, each with 12 to 20 LiDARs of 32 rings, guessed 0.05 to 0.4 m and 1 to 6
# deg off (one sigma): every LiDAR whose place its beams tell ended within 1 mm. In 14 worlds with
# level LiDARs the fit that neither slows scales nor looks again left one to twelve of them 10 to
# 670 mm off.
NEARLY_ALL = 0.99
SLIDES_M = np.linspace(-0.6, 0.6, 25)
MOST_ROUNDS = 3


def look_around(loop: Loop) -> bool:
    """Passes until what beams meet settles; False where the fit is hopeless, as where planes that
    were found in the scans never do.

    Where no tracked body shares the root of scans of a mesh, a scan may end in a wrong place: a
    floor that few beams meet, and that alone says how high the LiDAR stands, is rejected once walls
    are met well. There robust scales go but half the way from pass to pass; and scans look again,
    slid to where they fit best along the direction that is told least, with scales wide enough for
    nearly all of their beams (graduated non-convexity: Yang et al. 2020, IEEE Robotics and
    Automation Letters 5(2)). Each root is left where its scans cost less.
    """
    told = {body.stops.root for body in loop.problem.bodies}
    meshed = (s for s in loop.problem.scans if isinstance(s.meeting, MeshSurface))
    guessed = sorted({scan.stops.root for scan in meshed} - told)
    try:
        settled = _look(loop, guessed, asked=TIMES_ASKED)
    except NothingMetError as error:
        raise NothingMetError(_with_others(loop, str(error))) from None
    for _ in range(MOST_ROUNDS if settled and guessed else 0):
        kept, before = loop.values, _fits(loop)
        try:
            loop.values = _slid(loop, guessed)
            wide = {key: fit.wide for key, fit in _fits(loop).items()}
            moved, after = (loop.values, _fits(loop)) if _look(loop, guessed, wide) else (kept, {})
        except NothingMetError:  # a LiDAR left the room
            moved, after = kept, {}
        better = [
            root
            for root in guessed
            if np.abs(moved[root] - kept[root]).max() > STRAYED
            and _cost(loop, root, after) < _cost(loop, root, before)
        ]
        loop.values = {**kept, **{root: moved[root] for root in better}}
        if not better:
            break
    return settled


def _with_others(loop: Loop, said: str) -> str:
    """What is said of a scan that meets nothing, with the others that meet nothing either."""
    scans = loop.problem.scans
    met = over_stops(partial(_meets, loop.values), scans)
    tokens = [scan.group.token for scan, any_met in zip(scans, met, strict=True) if not any_met]
    others = [token for token in tokens if token not in said]
    return f"{said}, and likewise {', '.join(others)}" if others else said


def _meets(values: Values, scan: ScanStop) -> bool:
    try:
        scan.rows(values, None)
    except NothingMetError:
        return False
    return True


class _Fit(NamedTuple):
    """How the beams of a scan fit where it is.

    Args:
        cost: half their robust chi-square; see `_cost_of`.
        wide: robust scale with which nearly all of them would count.
    """

    cost: float
    wide: float


def _fits(loop: Loop) -> dict[StopKey, _Fit]:
    """How scans fit where they are."""
    scans = loop.problem.scans
    found = over_stops(partial(_fit_of, loop.values), scans)
    return {key_of(scan): fit for scan, fit in zip(scans, found, strict=True)}


def _fit_of(values: Values, scan: ScanStop) -> _Fit:
    rows = scan.rows(values, None)
    z = np.abs(rows.residual_m / rows.sigma_m)[rows.usable]
    far = float(np.quantile(z, NEARLY_ALL)) if len(z) else 0.0
    return _Fit(_cost_of(z, rows), far / TUKEY)


def _cost_of(z: np.ndarray, rows: Rows) -> float:
    """Half the robust chi-square of the beams of a scan, usable ones being z (N,) sigmas off; one
    that meets nothing costs as much as one that is rejected."""
    return tukey_cost(z) + (len(rows.usable) - len(z)) * TUKEY**2 / 6.0


def _cost(loop: Loop, root: str, fits: Mapping[StopKey, _Fit]) -> float:
    """Of all scans of a root."""
    return sum(fits[key_of(s)].cost for s in loop.problem.scans if s.stops.root == root)


def _slid(loop: Loop, guessed: Collection[str]) -> dict[str, np.ndarray]:
    """The state with each of some roots where its scans fit best, roughly weighed, of places along
    the direction of which their beams tell least."""
    scans, told = loop.problem.scans, {root: np.zeros((3, 3)) for root in guessed}
    for scan, own in zip(scans, over_stops(partial(_told_of, loop.values), scans), strict=True):
        if scan.stops.root in told:
            told[scan.stops.root] += own
    along = {root: eigh(information)[1][:, 0] for root, information in told.items()}
    cost = {root: np.zeros(len(SLIDES_M)) for root in guessed}
    for k, by_m in enumerate(SLIDES_M.tolist()):
        loop.progress("looking where scans were taken", k, len(SLIDES_M))
        there = loop.values | {r: _shifted(loop.values[r], by_m * along[r]) for r in guessed}
        for scan, own in zip(scans, over_stops(partial(_rough_cost, there), scans), strict=True):
            if scan.stops.root in cost:
                cost[scan.stops.root][k] += own
    best_m = {root: float(SLIDES_M[np.argmin(each)]) for root, each in cost.items()}
    return loop.values | {r: _shifted(loop.values[r], best_m[r] * along[r]) for r in guessed}


def _told_of(values: Values, scan: ScanStop) -> np.ndarray:
    """What the beams of a scan tell (3, 3) of where the LiDAR is, in the world's axes."""
    rows = scan.rows(values, None)
    T_world_lidar = scan.stops.in_world(scan.stops.rig.lidar_frame, values, False).T[0]
    by_shift = rows.by_twist[:, 3:] @ T_world_lidar[:3, :3].T
    return by_shift.T @ (rows.weight_m2[:, None] * by_shift)


def _rough_cost(values: Values, scan: ScanStop) -> float:
    """The cost of beams that count up to as far off as the places of `_slid` are apart."""
    try:
        rows = scan.rows(values, None)
    except NothingMetError:  # outside the room
        return np.inf
    off = rows.residual_m[rows.usable] / (SLIDES_M[1] - SLIDES_M[0])
    return _cost_of(TUKEY * off, rows)


def _shifted(T: np.ndarray, by_m: np.ndarray) -> np.ndarray:
    shifted = T.copy()
    shifted[:3, 3] += by_m
    return shifted


def _look(
    loop: Loop,
    guessed: Collection[str],
    wide: Mapping[StopKey, float] | None = None,
    asked: int = 0,
) -> bool:
    """Passes, each of which looks anew, until they settle; whether they lead anywhere.

    Args:
        loop: the fit.
        guessed: roots of scans that no tracked body shares. With such, robust scales are slowed.
        wide: scales to begin with; those of the residuals alone where None.
        asked: in how many passes scans are asked which bodies are right, where bodies of their
            stop contradict each other.
    """
    meshes, cost = any(isinstance(s.meeting, MeshSurface) for s in loop.problem.scans), np.inf
    slowed: list[Weighing] = []
    if wide is not None:  # twice, as the first pass goes half the way
        state = State(loop.values)
        pairs = [(s.pose(loop.values), 2.0 * wide[key_of(s)]) for s in loop.problem.scans]
        slowed = [Weighing(state, T, scale, None) for T, scale in pairs]
    for count in range(1, MOST_PASSES_LOOKED + 1):
        if count <= asked:
            _ask_scans(loop)
        slowed = slowed if len(slowed) == len(loop.problem.scans) else []
        loop.linearise(associate=True, slowed=slowed)
        loop.passes += 1
        scale = used = loop.here.scale
        if slowed:
            scale = 2.0 * used - [each.scale for each in slowed]  # not slowed
        if count <= asked and _set_aside(loop, scale, count == asked):
            continue
        if count > USUALLY_LOOKED and np.median(scale) > HOPELESS:
            return False
        slowed = list(loop.here.weighed) if guessed else []
        tangent, _ = loop.step()
        loop.values = loop.moved(loop.values, tangent)
        steps = [loop.size(tangent), *(np.abs(tangent[root]).max() for root in guessed)]
        if max(steps) < SETTLED_STEP and np.all(used < 2.0 * scale):
            return True
        if meshes and count >= USUALLY_LOOKED and loop.cost() > MUCH * cost:
            return bool(np.median(scale) <= HOPELESS)
        cost = loop.cost()
    return meshes


def _ask_scans(loop: Loop) -> None:
    """Set aside the bodies that the scan at their stop shows to be wrong."""
    wrong, stood = borne_out(loop.given, loop.values)
    if wrong:
        loop.values |= stood
        loop.give(loop.given.setting_aside(loop.given.set_aside | wrong))
        loop.take_weights()


def _set_aside(loop: Loop, scale: np.ndarray, torn_too: bool) -> bool:
    """Leave scans out of the fit that contradict all others; whether there are any.

    Args:
        torn_too: also those of stops whose bodies contradict each other, once they were asked.
        scale: (K,) how many sigmas wide the bulk of each scan's residuals is, where bodies, or
            most scans of a place where the rig stood, say that the LiDAR is.
    """
    stood = Counter(scan.stops.root for scan in loop.problem.scans)
    told = {b.stops.root for b in loop.problem.bodies}
    told |= {root for root, count in stood.items() if count >= SCANS_OF_PLACE}
    far = scale > CONTRADICTS * np.median(scale)
    pairs = zip(loop.problem.scans, far, strict=True)
    gone = {s.group.token for s, is_far in pairs if is_far and s.stops.root in told}
    gone -= set() if torn_too else {scan.group.token for scan in torn(loop.problem)}
    loop.give(loop.given.setting_aside(loop.given.set_aside | gone))
    return bool(gone)
