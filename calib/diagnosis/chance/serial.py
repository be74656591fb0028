"""Correlation of what seems to scatter from stop to stop: whether stops that follow each other err
alike, as where something drifts, or was changed in between and changed back; and whether those do
in which the arm has the same pose, as where the error goes with it.

With r_k the errors of stops, ``S = sum r_i . r_k`` over pairs of these. Where errors are random,
each might as well have the other sign, and then S has the mean 0 and the variance ``sum (r_i .
r_k)^2``, however widely any of them scatters (the serial correlation of von Neumann 1941, by signs
as in `jackknife`). Errors are taken against a fit of all other rows, which leaves next to
nothing in common between those of neighbours. What is fixed to a body keeps its direction in the
body's axes, and what is fixed to the tracker keeps it in the tracker's: both are asked.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import pairwise

import numpy as np
from scipy import special
from scipy.spatial import cKDTree

from calib.blunders.chance import at_least
from calib.blunders.judged import Blunder
from calib.blunders.others import Others
from calib.diagnosis.suggest import all_of
from calib.effects import Scatter, Site
from calib.problem import Problem
from calib.problem.model import Source, labels
from chains import se3
from sensors.stops import in_time

ALPHA_SERIAL = 0.01  # share of random errors that are said not to be: a choice, it names nothing
FEWEST_PAIRS = 9  # of stops: S over its sd is at most the root of their number, 3 for p = 0.001
SAME_POSE = 0.01  # rad or m, of each joint: an arm returns to a pose far nearer than that
OF_ROWS = {Site.TRACKER: "body", Site.JOINTS: "joints"}  # where widened -> kind of its groups

StopKey = tuple[str, str]  # recording and stop
Pairs = Callable[[Sequence[StopKey]], np.ndarray]  # (P, 2) of some stops


def p_serial(effect: Scatter, others: Others, blunders: list[Blunder]) -> float:
    """How often chance makes errors that follow each other so much alike; 1 where nothing tells.

    Args:
        effect: what seems to scatter; it is in the model.
        others: all rows of the fit of that model.
        blunders: all groups of them, as `judge` has them.
    """
    return _least(_series(effect, others, blunders), [_in_time(others.problem)])


def p_of_pose(effect: Scatter, others: Others, blunders: list[Blunder]) -> float:
    """The same of stops in which the arm has the same pose, or what it carries is nearly as much
    turned against gravity, or seen by the tracker nearly so turned, or nearly there."""
    problem = others.problem
    each = [[*_views(source)] for source in problem.sources]
    near = (_nearest(problem, views) for views in zip(*each, strict=True)) if all(each) else ()
    return _least(_series(effect, others, blunders), [_in_pose(problem), *near])


def _series(
    effect: Scatter, others: Others, blunders: list[Blunder]
) -> Iterator[tuple[list[StopKey], np.ndarray]]:
    """Stops, and their errors (K, r), of which some may be alike."""
    if effect.widens:
        return _of_rows(OF_ROWS.get(effect.site, ""), blunders)
    return _of_values(effect, others) if effect.per == "stop" else iter(())


def _in_time(problem: Problem) -> Pairs:
    """Pairs of stops that follow each other."""
    turn = {
        (of, stop): at
        for source, of in zip(problem.sources, labels(problem.sources), strict=True)
        for at, stop in enumerate(in_time(source.recording.stops, source.recording.time_s))
    }

    def pairs(stops: Sequence[StopKey]) -> np.ndarray:
        there = [k for k, stop in enumerate(stops) if stop in turn]
        order = sorted(there, key=lambda k: turn[stops[k]])
        return np.array([order[:-1], order[1:]], int).T

    return pairs


def _in_pose(problem: Problem) -> Pairs:
    """Pairs of stops of a recording in which all its joints are read, and alike: each with the next
    of its pose, so that signs of no two products depend on each other."""
    poses: dict[StopKey, tuple[str, bytes]] = {}
    for source, of in zip(problem.sources, labels(problem.sources), strict=True):
        joints = source.recording.joints
        read = np.flatnonzero(np.isfinite(joints).all(axis=1)) if joints.size else ()
        for k in read:
            near = np.round(joints[k] / SAME_POSE).astype(int)
            poses[of, source.recording.stops[k]] = of, near.tobytes()

    def pairs(stops: Sequence[StopKey]) -> np.ndarray:
        alike: dict[tuple[str, bytes], list[int]] = {}
        for k, stop in enumerate(stops):
            if stop in poses:
                alike.setdefault(poses[stop], []).append(k)
        found = [pair for some in alike.values() for pair in pairwise(some)]
        return np.array(found, int).reshape(-1, 2)

    return pairs


def _views(source: Source) -> Iterator[np.ndarray]:
    """What an error may go with (K, d) each, NaN where it is not known: which way up is for what
    the arm carries; how the tracker sees it turned; and where."""
    rig, recording = source.rig, source.recording
    frame = next((f for f in (rig.lidar_frame, *rig.carried) if f and rig.joints_to(f)), None)
    if frame:
        yield rig.tree.place(frame, recording.joints).Ts_root_frame[:, 2, :3]
    for pose in (recording.bodies[body] for body in rig.carried[:1]):
        yield se3.from_xyz_quat(pose[:, :3], pose[:, 3:])[:, :3, :3].reshape(-1, 9)
        yield pose[:, :3]


def _nearest(problem: Problem, views: Sequence[np.ndarray]) -> Pairs:
    """Pairs of stops of a recording, each with that whose view (K, d) is nearest to its own; these
    make no rings, so that signs of no two products depend on each other.

    Args:
        problem: with its sources.
        views: of each of these, as of `_views`.
    """
    at = {
        (of, stop): (of, view)
        for source, of, some in zip(problem.sources, labels(problem.sources), views, strict=True)
        for stop, view in zip(source.recording.stops, some, strict=True)
        if np.isfinite(view).all()
    }

    def pairs(stops: Sequence[StopKey]) -> np.ndarray:
        mine: dict[str, list[int]] = {}
        for k, stop in enumerate(stops):
            if stop in at:
                mine.setdefault(at[stop][0], []).append(k)
        found: set[tuple[int, int]] = set()
        for some in (some for some in mine.values() if len(some) > 1):
            view = np.stack([at[stops[k]][1] for k in some])
            if np.ptp(view, axis=0).max() < SAME_POSE:
                continue  # all alike, so nothing goes with it
            _, two = cKDTree(view).query(view, k=2)
            other = np.where(two[:, 0] == np.arange(len(some)), two[:, 1], two[:, 0])
            each = np.sort(np.stack([some, np.take(some, other)], axis=1), axis=1)
            found |= set(map(tuple, each.tolist()))
        return np.array(sorted(found), int).reshape(-1, 2)

    return pairs


def _least(series: Iterable[tuple[list[StopKey], np.ndarray]], pairings: Sequence[Pairs]) -> float:
    """The least p-value of some series by some pairings, how many there are being paid for."""
    each = ((errors, pairs(stops)) for stops, errors in series for pairs in pairings)
    p = [_alike(errors, some) for errors, some in each if len(some) >= FEWEST_PAIRS]
    return min(1.0, len(p) * min(p)) if p else 1.0


def drifting(problem: Problem, blunders: list[Blunder], names: Sequence[str]) -> Iterator[str]:
    """What is said where tracked poses of stops that follow each other err alike beside all that a
    search found; a sentence, or none.

    Args:
        problem: of the last fit.
        blunders: of its rows, as `judge` has them.
        names: of effects that go with time and were found; a step, say.
    """
    p = _least(_of_rows("body", blunders), [_in_time(problem)])
    if p < ALPHA_SERIAL:
        looks = all_of(names)
        beside, mistaken = "", ""
        if names:
            beside = f"even with {looks} in the model "
            mistaken = f" Noise that is correlated in time can look like {looks}."
        yield (
            f"Tracked poses of stops that follow each other err alike {beside}(p = "
            f"{at_least(p):.1g}): something drifts, the tracker's noise is correlated in time, or "
            f"the error goes with the pose and poses follow a path.{mistaken} Sigmas may be too "
            "small; the same stops in a random order would tell."
        )


def random_or_not(p_adjusted: float, p_serial: float, p_of_pose: float) -> str:
    """Whether scatter that was found is random, in words."""
    if min(p_serial, p_of_pose) >= ALPHA_SERIAL:
        return f"random as far as these data show (p = {p_adjusted:.1g})"
    if p_of_pose < p_serial:
        return (
            "not at random, as stops in which the arm has the same pose, or nearly, err alike (p = "
            f"{at_least(p_of_pose):.1g}): the error goes with the pose"
        )
    return (
        f"not at random, as stops that follow each other err alike (p = {at_least(p_serial):.1g}): "
        "something drifts, was changed in between, or goes with the pose where poses follow a path"
    )


def _of_rows(kind: str, blunders: list[Blunder]) -> Iterator[tuple[list[StopKey], np.ndarray]]:
    """Errors (K, r) of each body, or each joint, in its sigmas, and the stops of these; of bodies
    in the axes in which people are told, and in those of the rows."""
    found: dict[tuple[str, str, int, bool], list[tuple[StopKey, np.ndarray]]] = {}
    for shift in (b.shift for b in blunders if b.group.kind == kind and not b.found):
        if shift.dof == len(shift.offset):
            for R in (None,) if shift.turn is None else (None, shift.turn):
                offset, C = shift.offset, shift.covariance
                if R is not None:
                    offset, C = R.T @ offset, R.T @ C @ R
                key = shift.group.recording, shift.group.what, shift.dof, R is None
                stop = shift.group.recording, shift.group.where
                found.setdefault(key, []).append((stop, offset / np.sqrt(np.diag(C))))
    for some in found.values():
        yield [stop for stop, _ in some], np.stack([error for _, error in some])


def _of_values(effect: Scatter, others: Others) -> Iterator[tuple[list[StopKey], np.ndarray]]:
    """Values (K, r) of the stops of each recording, in their spreads, and these stops."""
    problem = others.problem
    named = zip(problem.terms, problem.sources, labels(problem.sources), strict=True)
    for term, source, of in ((t, s, label) for some, s, label in named for t in some):
        if term.effect.name == effect.name:
            known = {f"{term.effect.label}{stop}": (of, stop) for stop in source.recording.stops}
            sd, members = problem.variables[term.variable].sigma, term.effect.members
            values = (others.whole.values[term.variable] / sd).reshape(len(members), -1)
            mine = [k for k, member in enumerate(members) if member in known]
            yield [known[members[k]] for k in mine], values[mine]


def _alike(errors: np.ndarray, pairs: np.ndarray) -> float:
    """One-sided p-value of S for errors (K, r) of pairs (P, 2)."""
    products = np.einsum("ki,ki->k", errors[pairs[:, 0]], errors[pairs[:, 1]])
    sd = float(np.sqrt(np.square(products).sum()))
    return float(special.ndtr(-products.sum() / max(sd, 1e-300)))
