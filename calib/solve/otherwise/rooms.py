"""Rooms turned about the vertical: where nothing but a guess says which way round scans were taken.

A box with little in it looks nearly the same from either end. A fit that starts the wrong way
round ends there, and what the few things in it then do to beams is put down to something else.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.problem.model import Source
from calib.problem.problem import Problem
from calib.residuals.surfaces import MeshSurface
from calib.solve.otherwise.sampled import Sampled, Values, sampled_by_recording
from chains import se3
from sensors.lidar import Beams

TURNED_ABOUT_DEG = (0, 90, 180, 270)  # what a room of four walls may look alike by; 0 as it is
# Beams of a scan by which it is laid on the mesh, and by which then both ways are judged: choices;
# of the latter a hundredth still are so many that a box of half a metre shows.
LAID_BY, JUDGED_BY = 200, 1500
# How far (m) beams may be off and still count half, from step to step while scans are laid on the
# mesh (Geman and McClure's weights, narrowed): guesses are off by tenths of metres, CAD by 0.01 m.
NARROWED_M = (0.5, 0.5, 0.3, 0.3, 0.2, 0.1, 0.1, 0.05, 0.05)
LAID_WITHIN = np.repeat([0.3, 0.5], 3)  # rad, m: one sigma of what that moves; a choice
# Share of a scan's beams that fit in one way and not in the other, on average: less is alike. In
# bare rooms it is 0.001 and less; 0.005 to 0.04 where one box of 0.6 to 1.2 m stands in them; 0.1
# and more in 20 furnished ones.
FITS_ALIKE = 0.003
# How many scans have to fit notably better turned, and how much worse others then may: a choice.
# In 48 recordings of rooms with one box the right way round made none notably worse; one wrong way
# against another as many as it made better.
FEWEST_BETTER, NOTABLY, WORSE = 5, 0.002, 0.1
# Share of the beams that do not fit, at most, where any do: up to 0.18 in these rooms with a tenth
# of clutter, 0.9 along and across a corridor.
FITS_AT_ALL = 0.4


@dataclass(frozen=True)
class TurnedRoom:
    """How scans fit with the rig turned about the vertical in the middle of the room.

    Args:
        source: the recording.
        degrees: counter-clockwise, by which the scans fit better; or alike.
        is_better: which of the two.
    """

    source: Source
    degrees: tuple[int, ...]
    is_better: bool

    @property
    def frame(self) -> str:
        """That of the mesh."""
        return self.source.rig.reference_frame

    @property
    def sentence(self) -> str:
        """What to look at."""
        rig = self.source.rig
        what = ", ".join(map(str, self.degrees[:-1]))
        what = f"{what} or {self.degrees[-1]} deg" if what else f"{self.degrees[-1]} deg"
        if not self.is_better:
            return (
                f"the room looks the same turned by {what} about its middle, so that base_guess "
                "alone tells which way round it is; a target or something large that the mesh has "
                "would tell, too"
            )
        ties = (
            f", which alone ties '{rig.world}' to '{rig.reference_frame}'," if rig.tracker else ""
        )
        return (
            f"the scans fit the mesh better with the rig turned by {what} about the middle of the "
            f"room: is base_guess{ties} turned?"
        )


def rooms_turned(problem: Problem, values: Values) -> Iterator[TurnedRoom]:
    """Recordings whose scans a guess alone places in a room, where they fit as well or better
    turned in it.

    Args:
        problem: with scans; those of recordings whose targets tie the tracker to a mesh are passed
            over.
        values: the state from which scans are laid on the mesh.
    """
    for number, scans in sampled_by_recording(problem, values).items():
        source = problem.sources[number]
        if source.recording.base_guess is None or tied(source):
            continue
        cost = _costs(problem, scans)
        as_is = cost.pop(0)
        best = min(cost, key=lambda degrees: cost[degrees].mean())
        if _is_better(cost[best], as_is):
            yield TurnedRoom(source, (best,), is_better=True)
        elif alike := tuple(degrees for degrees, turned in cost.items() if _alike(turned, as_is)):
            yield TurnedRoom(source, alike, is_better=False)


def tied(source: Source) -> bool:
    """Whether targets say where the tracker is in the mesh."""
    return bool(source.rig.tracker and source.rig.target and source.recording.targets)


def _is_better(turned: np.ndarray, as_is: np.ndarray) -> bool:
    """Whether scans (K,) fit turned, some of them notably better than as they are, and what others
    lose is next to nothing of what these gain."""
    by = as_is - turned
    better, worse = by.clip(min=0.0).sum(), -by.clip(max=0.0).sum()
    enough = np.count_nonzero(by > NOTABLY) >= FEWEST_BETTER and by.mean() > FITS_ALIKE
    return bool(enough and worse < WORSE * better and turned.mean() < FITS_AT_ALL)


def _alike(turned: np.ndarray, as_is: np.ndarray) -> bool:
    """Whether scans (K,) fit, and each turned as well as it is."""
    return bool(as_is.mean() < FITS_AT_ALL and np.abs(as_is - turned).mean() < FITS_ALIKE)


def _costs(problem: Problem, scans: Sequence[Sampled]) -> dict[int, np.ndarray]:
    """Degrees -> which share (K,) of its beams each scan does not fit with, turned by that."""
    tracked = {body.stops.root for body in problem.bodies}
    roots = [each.scan.stops.root for each in scans]
    # Scans that a tracker ties to each other are laid on the mesh as one.
    names = ["" if root in tracked else root for root in roots]
    group = np.unique(names, return_inverse=True)[1]
    few, many = (LaidScans.of(scans, group, most) for most in (LAID_BY, JUDGED_BY))
    cost: dict[int, np.ndarray] = {}
    for degrees in TURNED_ABOUT_DEG:
        turn = few.about_middle(np.radians([0.0, 0.0, degrees, 0.0, 0.0, 0.0]))
        _, cost[degrees] = laid(few, many, turn)
    return cost


def laid(few: LaidScans, many: LaidScans, start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Scans laid on the mesh from where one motion (4, 4) of all puts them, by some of their beams,
    and then by more: their motions (K, 4, 4), and the share (K,) of the beams that do not fit."""
    T = few.alike(start)
    for width_m in NARROWED_M:
        T = few.nearer(T, width_m)
    T = many.nearer(T, NARROWED_M[-1])
    return T, many.cost(T, NARROWED_M[-1])


@dataclass(frozen=True)
class LaidScans:
    """Some beams of K scans, and how they are laid on the mesh.

    Args:
        meeting: the mesh.
        beams: (N,) in the mesh's frame, as a state has them.
        scan: (N,) which of the scans each is of.
        group: (K,) scans with the same are moved as one.
        middle_m: (3,) of the mesh's box.
    """

    meeting: MeshSurface
    beams: Beams
    scan: np.ndarray
    group: np.ndarray
    middle_m: np.ndarray

    @classmethod
    def of(cls, scans: Sequence[Sampled], group: np.ndarray, most: int) -> LaidScans:
        """About so many beams of each."""
        rays = [each.some(most) for each in scans]
        beams = Beams(
            *(
                np.concatenate([getattr(r, n) for r in rays])
                for n in ("origin_m", "direction", "range_m")
            )
        )
        scan = np.repeat(np.arange(len(scans)), [len(r.range_m) for r in rays])
        meeting = scans[0].scan.meeting
        vertices_m = meeting.reference.vertices_m
        middle_m = (vertices_m.min(axis=0) + vertices_m.max(axis=0)) / 2
        return cls(meeting=meeting, beams=beams, scan=scan, group=group, middle_m=middle_m)

    def about_middle(self, twist: np.ndarray) -> np.ndarray:
        """(..., 4, 4) motions by twists (..., 6), rad and m, about the middle of the room."""
        shift = se3.from_xyz_rpy(self.middle_m, np.zeros(3))
        return shift @ se3.exp(twist) @ se3.inverse(shift)

    def alike(self, T: np.ndarray) -> np.ndarray:
        """The same motion (4, 4) for each scan, (K, 4, 4)."""
        return np.tile(T, (len(self.group), 1, 1))

    def centred(self, T: np.ndarray, within: tuple[float, float]) -> np.ndarray:
        """A motion (4, 4) of all scans, moved on so that the middle of what they see, between these
        quantiles along each axis, is that of the room."""
        seen_m = self.beams.origin_m + self.beams.range_m[:, None] * self.beams.direction
        middle_m = np.quantile(se3.apply(T, seen_m), within, axis=0).mean(axis=0)
        return se3.from_xyz_rpy(self.middle_m - middle_m, np.zeros(3)) @ T

    def _off(self, T: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, Beams]:
        """Which beams (N,) meet anything with scans moved by T (K, 4, 4), how far (N,) m they end
        behind it, the slope (N, 3) of that by where they begin, and the beams there."""
        R, t = T[self.scan, :3, :3], T[self.scan, :3, 3]
        origin, direction = (
            np.matvec(R, self.beams.origin_m) + t,
            np.matvec(R, self.beams.direction),
        )
        beams = replace(self.beams, origin_m=origin, direction=direction)
        met = self.meeting.associate(np.eye(4), beams, {}, near_edges=False)
        surface = self.meeting.meet(np.eye(4), beams, {}, met)
        off_m = np.where(surface.usable, beams.range_m - surface.predicted_m, np.inf)
        return surface.usable, off_m, surface.slope, beams

    def cost(self, T: np.ndarray, width_m: float) -> np.ndarray:
        """(K,) share of the beams of each scan that do not fit: one that is off by the width is
        half of one, one that meets nothing all of one."""
        _, off_m, _, _ = self._off(T)
        fits = 1.0 / (1.0 + np.square(off_m / width_m))
        return 1.0 - np.bincount(self.scan, fits) / np.bincount(self.scan)

    def nearer(self, T: np.ndarray, width_m: float) -> np.ndarray:
        """T (K, 4, 4) one step of Gauss and Newton on, of each group together."""
        usable, off_m, slope, beams = self._off(T)
        off_m = np.where(usable, off_m, 0.0)
        weight = usable / np.square(1.0 + np.square(off_m / width_m))
        hit_m = beams.origin_m + (beams.range_m - off_m)[:, None] * beams.direction
        J = np.concatenate([np.cross(hit_m - self.middle_m, slope), slope], axis=1)
        out, of = T.copy(), self.group[self.scan]
        for g in range(self.group.max() + 1):
            mine = of == g
            A = J[mine].T @ (weight[mine, None] * J[mine]) + np.diag((width_m / LAID_WITHIN) ** 2)
            step = -np.linalg.solve(A, J[mine].T @ (weight[mine] * off_m[mine]))
            out[self.group == g] = self.about_middle(step) @ T[self.group == g]
        return out
