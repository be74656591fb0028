"""Other starts: a joint's zero, or a frame, turned by a quarter or half of a turn."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calib.problem.problem import Problem
from calib.residuals.tracker import BodiesTogether, TrackedBody
from chains import se3
from chains.align import mean_pose

TURNS = (np.pi, np.pi / 2, -np.pi / 2)
KEPT = 3  # starts that are given, of all that are looked at
TOGETHER = 2  # zeros and frames that may be turned at once
WIDTH = 5  # of those with one turned, how many have a second one turned

Values = dict[str, np.ndarray]


def least_turned(problem: Problem) -> list[tuple[float, Values]]:
    """Starts with zeros and frames turned, and the cost of each, least first.

    Every angle that is the same at all stops (a joint's zero, a frame's rotation) is turned, one at
    a time; the rig then stands where the bodies with the fewest joints before them say. From the
    best few of these a second one is turned.

    Args:
        problem: its initial values are what is turned; the cost is that of its tracked bodies, and
            of the priors of what may be turned.
    """
    bodies = [b for b in problem.bodies if not b.is_point]
    angles = _angles(problem, bodies)
    if not angles:
        return []
    groups = sorted(map(_Group.of, BodiesTogether.of(bodies)), key=lambda group: group.joints)
    found: list[tuple[float, Values]] = []
    for _ in range(TOGETHER):
        before = found[:WIDTH] or [(np.inf, dict(problem.initial))]
        tried = [_stood(each, groups) for _, v in before for each in _turned(v, angles)]
        found += [(cost + _prior(problem, v, angles), v) for cost, v in tried]
        found.sort(key=lambda each: each[0])
    return found[:KEPT]


def turned_far(problem: Problem, values: Mapping[str, np.ndarray]) -> bool:
    """Whether any of those angles is more than an eighth of a turn from where it was thought."""
    pairs = (
        (problem.variables[name].mean[i], values[name][i])
        for name, i in _angles(problem, problem.bodies)
    )
    return any(abs(now - mean) > np.pi / 4 for mean, now in pairs)


@dataclass(frozen=True)
class _Group:
    """One body at K stops.

    Args:
        whole: the body's rows at all of them.
        roots: (K,) unknown of where the rig stands.
        joints: how many there are before the body.
    """

    whole: TrackedBody
    roots: Sequence[str]
    joints: int

    @classmethod
    def of(cls, together: BodiesTogether) -> _Group:
        roots = [b.stops.root for b in together.blocks for _ in b.measured]
        whole = together.whole
        return cls(whole=whole, roots=roots, joints=len(whole.stops.rig.joints_to(whole.body)))

    def place(self, values: Values) -> np.ndarray:
        """T_root_body (K, 4, 4), what encoders misreport at single stops left out."""
        stops = self.whole.stops
        own = {stops.noise: np.zeros(stops.joints.shape)} if stops.noise else {}
        return stops.in_root(self.whole.body, {**values, **own}).T


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


def _stood(values: Values, groups: Sequence[_Group]) -> tuple[float, Values]:
    """The cost of all bodies, and the values with the rig standing where the bodies with the fewest
    joints before them say."""
    placed, stood = [group.place(values) for group in groups], {}
    for group, T_root_body in zip(groups, placed, strict=True):
        said: dict[str, list[np.ndarray]] = {}
        for root, T in zip(
            group.roots, group.whole.measured @ se3.inverse(T_root_body), strict=True
        ):
            if root not in stood:
                said.setdefault(root, []).append(T)
        each = said.items()
        stood |= {root: mean_pose(np.stack(Ts)) if Ts[1:] else Ts[0] for root, Ts in each}
    cost = 0.0
    for group, T_root_body in zip(groups, placed, strict=True):
        T = np.stack([stood[root] for root in group.roots]) @ T_root_body
        block = group.whole
        turn = se3.so3_log(T[:, :3, :3].mT @ block.measured[:, :3, :3]) / block.sigma_rad
        away = (T[:, :3, 3] - block.measured[:, :3, 3]) / block.sigma_m
        cost += float(np.square(turn).sum() + np.square(away).sum()) / 2
    return cost, {**values, **stood}


def _prior(problem: Problem, values: Values, angles: Sequence[tuple[str, int]]) -> float:
    unknowns = (problem.variables[name] for name in dict.fromkeys(name for name, _ in angles))
    return sum(float(np.square((values[v.name] - v.mean) / v.sigma).sum()) / 2 for v in unknowns)
