"""Other starts: a joint's zero, a frame, or the LiDAR in its frame, turned; or scans mirrored."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from calib.forward import Placed
from calib.problem.problem import Problem
from calib.residuals.scan import ScanStop
from calib.residuals.seen import BodiesTogether
from calib.residuals.surfaces import MeshSurface
from calib.residuals.tracker import TrackedBody
from chains import se3
from chains.align import mean_pose
from sensors.lidar import Beams

# What mistakes about axes and mounts turn by: brackets and flanges have holes at right angles.
TURNS = (np.pi, np.pi / 2, -np.pi / 2)
STARTS_KEPT = 3  # starts that are given, of all that are looked at
TURNED_TOGETHER = 2  # zeros and frames that may be turned at once
TURNED_AGAIN = 5  # of those with one turned, how many have a second one turned
# Orientations of a LiDAR are looked at on a grid, of turns by up to 0.6 rad about three axes beside
# each of the 24 that map a cube onto itself, and on finer ones beside the best of these. From
# 0.3 rad away passes over the scans find the optimum.
STEP_RAD, FINER_RAD, BEST = 0.3, (0.15, 0.07), 8
# So many beams of so many scans tell orientations apart; beams are off by no more than this, as
# what they pass by may be anywhere behind.
SCANS_ASKED, BEAMS_A_SCAN, FARTHEST_OFF_M = 8, 150, 1.0
NEAR_M = 0.1  # mean error of these beams that asks for no other orientation: good ones have 0.02
# Of the mean error, what another orientation may have at most: a choice, between good ones' 0.02 m
# and the 0.1 m from which one is asked for.
NEARER = 0.5
# Mean error, at most, with other axes: 0.02 m of good beams, 0.1 m as a tenth of them are 1 m off,
# and some to spare. A room with floor and ceiling 0.3 m too low has 0.26 m as a mirror shows it.
FITS_M = 0.2
MIRROR = np.diag([1.0, -1.0, 1.0])  # any other follows by turns

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


def lidars_turned(problem: Problem, values: Mapping[str, np.ndarray]) -> Values:
    """The frame of each LiDAR turned as its scans fit the mesh best, of orientations all around.

    Args:
        problem: with scans.
        values: the state; a LiDAR's origin stays where it has it.

    Returns:
        The unknowns of the frames to turn, by name: of those LiDARs whose beams are then less than
        half as far off.
    """
    return {
        name: _with_turn(values[name], start, turn)
        for (name, start), scans in _sampled(problem, values).items()
        if (turn := _best_turn(scans)) is not None
    }


class OtherAxes(NamedTuple):
    """Coordinates that fit when they are read with other axes.

    Args:
        whose: "scans", "mesh" or "tracker".
        frame: of the LiDAR whose scans say so.
        read: (3, 3) what takes the coordinates that are there to those that fit; None for scans, of
            which it is only known that they are mirrored.
    """

    whose: str
    frame: str
    read: np.ndarray | None


def axes_of(
    problem: Problem, values: Mapping[str, np.ndarray], turned: Collection[str] | None = None
) -> Iterator[OtherAxes]:
    """Axes that were exchanged or mirrored, if the beams of a LiDAR are less than half as far off
    when they are set right: of the mesh or of the tracker by quarter turns and mirrors; of scans
    mirrored, in any orientation. Nothing where the LiDAR turned, as it is, does as well.

    Args:
        problem, values: as of `lidars_turned`.
        turned: the frames that this turns, where they are known.
    """
    turned = lidars_turned(problem, values) if turned is None else turned
    quarters = Rotation.create_group("O").as_matrix().round()
    every = np.concatenate([quarters, quarters @ MIRROR])
    for (name, _), scans in _sampled(problem, values).items():
        chosen, frame = _asked(scans), scans[0].scan.stops.rig.lidar_frame
        start_m = _off_m(chosen, np.eye(3)[None])[0]
        if start_m < NEAR_M or name in turned:
            continue
        for whose in ("mesh", "tracker"):
            at = (each.read(whose, every, values) for each in chosen)
            off_m = np.mean([s.off_m(T) for s, T in zip(chosen, at, strict=True)], axis=0)
            if off_m.min() < min(NEARER * start_m, FITS_M):
                read = every[np.argmin(off_m)]
                yield OtherAxes(whose, frame, read.T if whose == "mesh" else read)
                break
        else:
            if _best_turn(scans, MIRROR) is not None:
                yield OtherAxes("scans", frame, None)


@dataclass(frozen=True)
class _Sampled:
    """A scan, and T_reference_lidar (4, 4) as a state has it."""

    scan: ScanStop
    T: np.ndarray

    def turned(self, turns: np.ndarray) -> np.ndarray:
        """T_reference_lidar (G, 4, 4) with the LiDAR turned, or mirrored, (G, 3, 3) about its
        origin."""
        return self.T @ _maps(turns)

    def read(self, whose: str, axes: np.ndarray, values: Values) -> np.ndarray:
        """The same (G, 4, 4) with other axes (G, 3, 3): of the mesh, into which they lead, or of
        the world that bodies are tracked in."""
        outer = self.scan.stops.reference
        if whose == "mesh" or outer is None:
            return _maps(axes) @ self.T
        T_world_reference = values[outer]
        return se3.inverse(T_world_reference) @ _maps(axes) @ T_world_reference @ self.T

    def off_m(self, at: np.ndarray) -> np.ndarray:
        """Mean error (G,) of some beams, of maps (G, 4, 4) from the LiDAR's frame to the mesh's."""
        _, ray = self.scan.store.read(self.scan.index)
        some = np.linspace(0, len(ray.range_m) - 1, BEAMS_A_SCAN).round().astype(int)
        linear = at[:, :3, :3].mT
        origin = ray.origin_m[some] @ linear + at[:, None, :3, 3]
        direction = ray.direction[some] @ linear
        range_m = np.tile(ray.range_m[some], len(at))
        beams, here = Beams(origin.reshape(-1, 3), direction.reshape(-1, 3), range_m), np.eye(4)
        met = self.scan.meeting.associate(here, beams, {}, near_edges=False)
        surface = self.scan.meeting.meet(here, beams, {}, met)
        off_m = np.where(
            surface.usable, np.abs(beams.range_m - surface.predicted_m), FARTHEST_OFF_M
        )
        return np.minimum(off_m, FARTHEST_OFF_M).reshape(len(at), -1).mean(axis=1)


def _maps(linear: np.ndarray) -> np.ndarray:
    """Linear maps (G, 3, 3) as (G, 4, 4)."""
    out = np.tile(np.eye(4), (len(linear), 1, 1))
    out[:, :3, :3] = linear
    return out


def _sampled(
    problem: Problem, values: Mapping[str, np.ndarray]
) -> dict[tuple[str, int], list[_Sampled]]:
    """The scans of each LiDAR that a mesh shows, by the unknown that turns its frame."""
    seen: dict[tuple[str, int], list[_Sampled]] = {}
    for scan in problem.scans:
        edge = _free_edge(problem, scan)
        if edge and isinstance(scan.meeting, MeshSurface):
            seen.setdefault(edge, []).append(_Sampled(scan, scan.pose(values)))
    return seen


def _asked(scans: Sequence[_Sampled]) -> list[_Sampled]:
    """Some of the scans, spread evenly."""
    chosen = np.unique(np.linspace(0, len(scans) - 1, SCANS_ASKED).round().astype(int))
    return [scans[i] for i in chosen]


def _off_m(scans: Sequence[_Sampled], turns: np.ndarray) -> np.ndarray:
    """Mean error (G,) of the beams of all, with the LiDAR turned (G, 3, 3)."""
    return np.mean([each.off_m(each.turned(turns)) for each in scans], axis=0)


def _best_turn(scans: Sequence[_Sampled], of: np.ndarray | None = None) -> np.ndarray | None:
    """The turn (3, 3) of a LiDAR that makes its beams fit best, after they were mirrored, say, by
    `of` (3, 3); None where none is much better than all as it is."""
    chosen, of = _asked(scans), np.eye(3) if of is None else of
    start_m = float(_off_m(chosen, np.eye(3)[None])[0])
    if start_m < NEAR_M:
        return None
    turns = _beside(Rotation.create_group("O").as_matrix(), STEP_RAD * np.arange(-2, 3))
    for step in FINER_RAD:
        best = np.argsort(_off_m(chosen, turns @ of))[:BEST]
        turns = _beside(turns[best], step * np.arange(-1, 2))
    found_m = _off_m(chosen, turns @ of)
    return turns[np.argmin(found_m)] if found_m.min() < NEARER * start_m else None


def _beside(turns: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Turns (G, 3, 3), each turned further by all combinations of angles about three axes."""
    further = se3.so3_exp(np.stack(np.meshgrid(*[angles] * 3), axis=-1).reshape(-1, 3))
    return (turns[:, None] @ further).reshape(-1, 3, 3)


def _free_edge(problem: Problem, scan: ScanStop) -> tuple[str, int] | None:
    """Unknown that may turn the frame of a LiDAR any way, the same at all stops, and where its
    rotation vector begins; None where there is none."""
    path = scan.stops.rig.tree.path(scan.stops.rig.lidar_frame)
    if not path:  # it is the rig's root
        return None
    for name, own in scan.stops.edge_bases.items():
        basis = scan.stops.at_edges(name, own[:1])
        turns = np.flatnonzero(np.any(basis[0, path[-1], :3] != 0, axis=0))
        same = len(own) == 1 and name in problem.calibration
        if same and np.array_equal(basis[0, path[-1], :3][:, turns], np.eye(3)):
            return name, int(turns[0])
    return None


def _with_turn(value: np.ndarray, start: int, turn: np.ndarray) -> np.ndarray:
    """A frame's offsets with its rotation vector, which begins there, turned."""
    out, angles = value.copy(), slice(start, start + 3)
    out[angles] = se3.so3_log(se3.so3_exp(value[angles]) @ turn)
    return out


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
        moved = _in_root(whole, values).d.items()
        return cls(whole, roots, joints, felt=frozenset(name for name, d in moved if d.any()))

    def place(self, values: Values) -> np.ndarray:
        """T_root_body (K, 4, 4)."""
        return _in_root(self.whole, values).T


def _in_root(body: TrackedBody, values: Values) -> Placed:
    """T_root_body, what encoders misreport at single stops left out."""
    stops = body.stops
    own = {stops.noise: np.zeros(stops.joints.shape)} if stops.noise else {}
    return stops.in_root(body.body, {**values, **own})


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
