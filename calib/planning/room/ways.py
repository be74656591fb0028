"""The way over planned stops: their order, and by what poses an arm gets from one to the next."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from calib.planning.room.clear import Clear
from calib.planning.stops import Poses

# Between poses that are looked at on the way, of all joints together, rad or m: what is a metre
# away moves by 5 cm, half of what tubes are kept clear by.
LOOKED_AT = 0.05
MOST_VIA = 200  # poses to go by that are tried for one way, those of the shortest detour first
TIMES_REORDERED = 5  # orders that are tried around ways that are not clear


@dataclass(frozen=True)
class Leg:
    """From one planned stop to the next, at one location.

    Args:
        to: number of the stop that it leads to, from 0.
        via: (J,) rad or m of a pose to go by; None where the straight way is clear, or none is.
        clear: whether a clear way was found.
    """

    to: int
    via: np.ndarray | None
    clear: bool


def way_over(
    poses: Poses, among: Poses, clear: Clear, T_reference_world: np.ndarray, places: Sequence[str]
) -> tuple[list[int], list[Leg]]:
    """An order of stops, and how to get from each to the next where its location is the same.

    All joints move at once, each evenly. Where what lies between two stops is not clear, another
    order is sought, and then a pose to go by.

    Args:
        poses: the n stops.
        among: clear poses that may be gone by, at any location.
        clear: what keeps the arm from a pose.
        T_reference_world: (4, 4).
        places: locations in the order in which they are visited.
    """
    barred: set[frozenset[int]] = set()
    looked: dict[frozenset[int], bool] = {}

    def free(a: np.ndarray, b: np.ndarray, T_world_root: np.ndarray) -> bool:
        way = between(a, b)
        T = np.broadcast_to(T_reference_world @ T_world_root, (len(way), 4, 4))
        return bool(clear.of_poses(way, T).all())

    for _ in range(TIMES_REORDERED):
        order = in_order_of_path(poses.joints, poses.location, places, barred)
        steps = [p for p in pairwise(order) if len({*poses.location[[*p]]}) < 2]
        for a, b in (p for p in steps if frozenset(p) not in looked):
            looked[frozenset((a, b))] = free(*poses.joints[[a, b]], poses.Ts_world_root[a])
        found = {frozenset(p) for p in steps if not looked[frozenset(p)]}
        if found <= barred:
            break
        barred |= found
    legs = []
    for a, b in steps:
        ok, via = looked[frozenset((a, b))], None
        if not ok:
            via = _via(*poses.joints[[a, b]], poses.Ts_world_root[a], among, free)
            ok = via is not None
        legs.append(Leg(order.index(b), via, ok))
    return order, legs


def way_document(poses: Poses, names: Sequence[str], legs: Sequence[Leg]) -> list[dict[str, Any]]:
    """The way as JSON has it: every pose on it, the stops and those to
    go by; ``stop`` is the number of a stop, from 1, or None; ``clear`` whether the way to it is
    known to be, None where it begins or the base moves.

    Args:
        poses: the stops in order.
        names: (J,) of the joints.
        legs: how to get from each to the next.
    """
    by, out = {leg.to: leg for leg in legs}, []
    for number, (at, joints) in enumerate(zip(poses.location.tolist(), poses.joints, strict=True)):
        leg = by.get(number)
        rows = [(joints, number + 1)]
        if leg and leg.via is not None:
            rows.insert(0, (leg.via, None))
        for angles, stop in rows:
            where = {"location": str(at), **dict(zip(names, angles.tolist(), strict=True))}
            out.append({**where, "stop": stop, "clear": leg.clear if leg else None})
    return out


def way_columns(way: Sequence[Mapping[str, Any]], names: Sequence[str]) -> dict[str, list[Any]]:
    """The same as columns of a table."""
    return {key: [row[key] for row in way] for key in ("location", *names, "stop", "clear")}


def between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Poses (n, J) on the straight way from one (J,) to another, ends included."""
    count = int(np.ceil(np.linalg.norm(b - a) / LOOKED_AT)) + 1
    return a + np.linspace(0, 1, max(count, 2))[:, None] * (b - a)


def _via(
    a: np.ndarray,
    b: np.ndarray,
    T_world_root: np.ndarray,
    among: Poses,
    free: Callable[[np.ndarray, np.ndarray, np.ndarray], bool],
) -> np.ndarray | None:
    """A pose (J,) by which there is a clear way from one to another, of the shortest such way."""
    here = np.isclose(among.Ts_world_root, T_world_root, rtol=0, atol=1e-9).all(axis=(1, 2))
    joints = among.joints[here]
    detour = np.linalg.norm(joints - a, axis=1) + np.linalg.norm(joints - b, axis=1)
    for k in np.argsort(detour)[:MOST_VIA].tolist():
        if free(a, joints[k], T_world_root) and free(joints[k], b, T_world_root):
            return joints[k]
    return None


def in_order_of_path(
    joints: np.ndarray,
    location: np.ndarray,
    locations: Sequence[str],
    barred: Collection[frozenset[int]] = (),
) -> list[int]:
    """An order (n,) of stops: the base moves as seldom as can be, the arm by short ways.

    At each location the nearest stop comes next, then the way is untangled (2-opt: Croes 1958). A
    way's length is the sum of the joints' Euclidean steps.

    Args:
        joints: (n, J) rad or m.
        location: (n,) of each stop.
        locations: in the order in which they are visited.
        barred: pairs of stops with no straight way between them.
    """
    order: list[int] = []
    step = np.linalg.norm(joints[:, None] - joints[None], axis=2)
    longest = step.sum()  # no way over all of them is longer
    for a, b in barred:
        step[a, b] = step[b, a] = longest
    for place in locations:
        here = np.flatnonzero(location == place)
        if len(here):
            first = int(np.argmin(step[order[-1], here])) if order else 0
            order += here[_way(step[np.ix_(here, here)], first)].tolist()
    return order


def _way(step: np.ndarray, first: int) -> np.ndarray:
    """A short open way over all of some stops, whose distances are (n, n), from the first."""
    way, left = [first], set(range(len(step))) - {first}
    while left:
        way.append(min(sorted(left), key=lambda k: step[way[-1], k]))
        left.remove(way[-1])
    better = True
    while better:
        better = False
        for i in range(1, len(way) - 1):
            for k in range(i + 1, len(way)):
                turned = way[:i] + way[i : k + 1][::-1] + way[k + 1 :]
                if _length(step, turned) < _length(step, way) - 1e-12:
                    way, better = turned, True
    return np.array(way)


def _length(step: np.ndarray, way: Sequence[int]) -> float:
    return float(step[way[:-1], way[1:]].sum())
