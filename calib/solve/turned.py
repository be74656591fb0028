"""Other starts: a joint's zero, or a frame, turned by a quarter or half of a turn."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from calib.problem.problem import Problem
from calib.residuals.tracker import TrackedBody
from calib.solve.graph import Graph
from chains import se3
from chains.align import mean_pose

TURNS = (np.pi, np.pi / 2, -np.pi / 2)
KEPT = 3  # starts that are tried, of all that are looked at
TOGETHER = 3  # zeros and frames that may be turned at once

Values = dict[str, np.ndarray]


def least_turned(problem: Problem) -> list[tuple[float, Values]]:
    """Starts with zeros and frames turned, and the cost of each, least first.

    Every angle that is the same at all stops (a joint's zero, a frame's rotation) is turned, one at
    a time; the rig then stands where the bodies with the fewest joints before them say. From the
    best of these a second one is turned, and so on, as long as that lowers the cost.

    Args:
        problem: its tracked bodies and targets; its initial values are what is turned.
    """
    bodies = [b for b in problem.blocks if isinstance(b, TrackedBody) and not b.is_point]
    graph = Graph(list(problem.variables.values()), problem.blocks)
    angles = _angles(problem, bodies)
    best, found = (graph.error(problem.initial), dict(problem.initial)), []
    for _ in range(TOGETHER if bodies and angles else 0):
        tried = [_stood(v, bodies) for v in _turned(best[1], angles)]
        ranked = sorted(((graph.error(v), k, v) for k, v in enumerate(tried)), key=lambda x: x[:2])
        found += [(cost, values) for cost, _, values in ranked[:KEPT]]
        if ranked[0][0] >= best[0]:
            break
        best = ranked[0][0], ranked[0][2]
    return sorted(found, key=lambda x: x[0])[:KEPT]


def _angles(problem: Problem, bodies: Sequence[TrackedBody]) -> list[tuple[str, int]]:
    """Unknown and component of every angle of joints and edges that is the same at all stops."""
    fixed = {
        name
        for block in bodies
        for bases in (block.stops.joint_bases, block.stops.edge_bases)
        for name, basis in bases.items()
        if len(basis) == 1
    }
    calibration = (problem.variables[n] for n in problem.calibration if n in fixed)
    return [(v.name, i) for v in calibration for i, unit in enumerate(v.units) if unit == "rad"]


def _turned(
    values: Mapping[str, np.ndarray], angles: Sequence[tuple[str, int]]
) -> Iterator[Values]:
    for name, i in angles:
        for turn in TURNS:
            theta = values[name].copy()
            theta[i] += turn
            yield {**values, name: theta}


def _stood(values: Values, bodies: Sequence[TrackedBody]) -> Values:
    """The same, the rig standing where its bodies say: those with the fewest joints before them."""
    nearest: dict[str, TrackedBody] = {}
    for block in sorted(bodies, key=lambda b: len(b.stops.rig.joints_to(b.body))):
        nearest.setdefault(block.stops.root, block)
    out = dict(values)
    for root, block in nearest.items():
        T_root_body = block.stops.in_root(block.body, values).T
        out[root] = mean_pose(block.measured @ se3.inverse(T_root_body))
    return out
