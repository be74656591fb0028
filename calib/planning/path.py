"""In what order to drive to planned stops: a short way in joint space, location by location."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def in_order_of_path(
    joints: np.ndarray, location: np.ndarray, locations: Sequence[str]
) -> list[int]:
    """An order (n,) of stops: the base moves as seldom as can be, the arm by short ways.

    At each location the nearest stop comes next, then the way is untangled (2-opt: Croes 1958). A
    way's length is the sum of the joints' Euclidean steps; nothing checks what lies on it.

    Args:
        joints: (n, J) rad or m.
        location: (n,) of each stop.
        locations: in the order in which they are visited.
    """
    order: list[int] = []
    for place in locations:
        here = np.flatnonzero(location == place)
        if len(here):
            from_ = joints[order[-1]] if order else None
            order += here[_way(joints[here], from_)].tolist()
    return order


def _way(joints: np.ndarray, start: np.ndarray | None) -> np.ndarray:
    """A short open way over all of some stops (n, J), from somewhere."""
    step = np.linalg.norm(joints[:, None] - joints[None], axis=2)
    first = 0 if start is None else int(np.argmin(np.linalg.norm(joints - start, axis=1)))
    way, left = [first], set(range(len(joints))) - {first}
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
