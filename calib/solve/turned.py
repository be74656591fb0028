"""Other starts: a joint's zero or a frame, turned."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calib.forward import Placed
from calib.problem.problem import Problem
from calib.residuals.seen import BodiesTogether
from calib.residuals.tracker import TrackedBody
from chains import se3
from chains.align import mean_pose

# What mistakes about axes and mounts turn by: brackets and flanges have holes at right angles.
TURNS = (np.pi, np.pi / 2, -np.pi / 2)
STARTS_KEPT = 3  # starts that are given, of all that are looked at
TURNED_TOGETHER = 2  # zeros and frames that may be turned at once
TURNED_AGAIN = 5  # of those with one turned, how many have a second one turned

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
    first = dict(problem.initial)
    groups = [_Group.of(together, first) for together in BodiesTogether.of(bodies)]
    groups.sort(key=lambda group: group.joints)
    felt = frozenset[str]().union(*(group.felt for group in groups))
    angles = [angle for angle in _angles(problem, bodies) if angle[0] in felt]
    if not angles:
        return []
    found: list[tuple[float, Values, Sequence[np.ndarray]]] = []
    start = np.inf, first, [group.place(first) for group in groups]
    for _ in range(TURNED_TOGETHER):
        for _, values, placed in found[:TURNED_AGAIN] or [start]:
            for name, turned in _turned(values, angles):
                at = [
                    group.place(turned) if name in group.felt else Ts
                    for group, Ts in zip(groups, placed, strict=True)
                ]
                cost, stood = _stood(turned, groups, at)
                found.append((cost + _prior(problem, turned, angles), stood, at))
        found.sort(key=lambda each: each[0])
    return [(cost, values) for cost, values, _ in found[:STARTS_KEPT]]


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
        felt: unknowns that move the body against where the rig stands.
    """

    whole: TrackedBody
    roots: Sequence[str]
    joints: int
    felt: frozenset[str]

    @classmethod
    def of(cls, together: BodiesTogether, values: Values) -> _Group:
        roots = [b.stops.root for b in together.blocks for _ in b.measured]
        whole = together.whole
        joints = len(whole.stops.rig.joints_to(whole.body))
        moved = _from_stand(whole, values).d.items()
        return cls(whole, roots, joints, felt=frozenset(name for name, d in moved if d.any()))

    def place(self, values: Values) -> np.ndarray:
        """T_stood_body (K, 4, 4)."""
        return _from_stand(self.whole, values).T


def _from_stand(body: TrackedBody, values: Values) -> Placed:
    """T_stood_body, what encoders misreport at single stops left out."""
    stops = body.stops
    own = {stops.noise: np.zeros(stops.joints.shape)} if stops.noise else {}
    return stops.from_stand(body.body, {**values, **own})


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
) -> Iterator[tuple[str, Values]]:
    for name, i in angles:
        for turn in TURNS:
            theta = values[name].copy()
            theta[i] += turn
            yield name, {**values, name: theta}


def _stood(
    values: Values, groups: Sequence[_Group], placed: Sequence[np.ndarray]
) -> tuple[float, Values]:
    """The cost of all bodies, each `placed` (K, 4, 4) in its root, and the values with the rig
    standing where the bodies with the fewest joints before them say."""
    stood: dict[str, np.ndarray] = {}
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
