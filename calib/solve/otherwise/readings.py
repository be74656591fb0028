"""Poses of a tracked body that are written otherwise: other orders, axes, or the inverse.

Where several bodies are seen, each says it of the others; where there is one, only the scans of a
mesh can."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from calib.problem import start
from calib.problem.model import Source
from calib.problem.problem import Problem
from calib.rig.suspect import Suspect
from calib.rig.tracked import OTHER_QUATERNIONS
from calib.solve.otherwise.sampled import (
    NEAR_M,
    NEARER,
    Sampled,
    Values,
    asked,
    sampled_by_recording,
    turned_off_m,
)
from chains import se3
from chains.align import align_points, mean_pose
from chains.errors import InputError

# Mean error of beams (m), at most, that a reading may have, and how many times that of the best
# reading a simpler one. Of 29 recordings of hand-held and cart-mounted LiDARs by two simulators, in
# six ways of writing poses, the right reading had 0.006 to 0.035 m, 0.15 m where a guess off by
# 0.08 m and 2 deg tied the tracker to the mesh; every wrong one 0.40 m and more.
READS_M, READ_AS_WELL = 0.3, 1.5
POSE_COLUMNS = ("x", "y", "z"), ("qw", "qx", "qy", "qz")


@dataclass(frozen=True)
class PoseReading:
    """A way in which the columns of a body's pose may have to be read.

    Args:
        order: (4, 4) what makes qw, qx, qy, qz of the columns called so.
        axes: (3, 3) what makes x, y, z of the columns called so.
        inverse: whether the pose that this gives is that of the tracker in the body.
        held: what the columns called qw, qx, qy, qz hold, where they are just in another order or
            of another sign.
    """

    order: np.ndarray
    axes: np.ndarray
    inverse: bool = False
    held: str = ""

    @property
    def is_of_axes(self) -> bool:
        """Whether x, y, z are others, too."""
        return not np.array_equal(self.axes, np.eye(3))

    @property
    def changes(self) -> int:
        """How many mistakes it takes to write poses so."""
        return self.is_of_axes + self.inverse + bool(self.held)

    def read(self, pose: np.ndarray) -> np.ndarray:
        """T_world_body (K, 4, 4) of the columns x, y, z, qw, qx, qy, qz (K, 7), m."""
        T = se3.from_xyz_quat(pose[:, :3] @ self.axes.T, pose[:, 3:] @ self.order.T)
        return se3.inverse(T) if self.inverse else T

    def suspect(self, body: str, world: str, targets_too: bool) -> Suspect:
        """That a body's poses in a world should be read so, and perhaps the targets' places."""
        if not self.is_of_axes:
            said = "the scans fit the mesh if "
            if self.held:
                said += f"the columns qw, qx, qy, qz of {body} hold {self.held}"
            if self.inverse:
                said += " and " * bool(self.held) + (
                    f"the poses of {body} are inverted: do they say where {world} is as {body} "
                    f"sees it? write where {body} is in {world}"
                )
            said += "; write them as they are named" * (not self.inverse)
            return Suspect("body", body, said)
        xyz, quat = (
            ", ".join(_signed(m, names))
            for m, names in zip((self.axes, self.order), POSE_COLUMNS, strict=True)
        )
        asked_ = (
            "is another axis up there than elsewhere"
            if np.linalg.det(self.axes) > 0
            else "are two columns exchanged, or are the tracker's axes left-handed"
        )
        more = f", and {xyz} of upper and lower in targets.csv" * targets_too
        said = (
            f"the scans fit the mesh with {xyz} and {quat} of {body} in place of x, y, z and qw, "
            f"qx, qy, qz: {asked_}? write them so{more}"
        )
        return Suspect("body", body, said)


def _signed(matrix: np.ndarray, names: Sequence[str]) -> list[str]:
    """What of some columns each row of a matrix of -1, 0 and 1 takes."""
    signs, at = matrix.sum(axis=1), np.abs(matrix).argmax(axis=1)
    return [f"{'-' if s < 0 else ''}{names[i]}" for s, i in zip(signs, at, strict=True)]


def _of_quaternion(vector: np.ndarray) -> np.ndarray:
    """(4, 4) with qw as it is, and a map (3, 3) of qx, qy, qz."""
    out = np.eye(4)
    out[1:, 1:] = vector
    return out


def pose_readings() -> list[PoseReading]:
    """Every other way that is looked at; first the one that is right.

    Orders and signs of quaternions, and the inverse, alone and together; two axes exchanged in all
    columns; and all other axes, of the tracker and of its bodies alike, also left-handed ones.
    """
    same = np.eye(3)
    ways = {"": np.eye(4), **OTHER_QUATERNIONS}
    out = [
        PoseReading(order=order, axes=same, inverse=inverse, held=held)
        for inverse in (False, True)
        for held, order in ways.items()
    ]
    for i, j in ((1, 2), (0, 1), (0, 2)):
        exchanged = same.copy()
        exchanged[[i, j]] = same[[j, i]]
        out.append(PoseReading(order=_of_quaternion(exchanged), axes=exchanged))
    quarters = Rotation.create_group("O").as_matrix().round()
    for axes in (*-quarters, *quarters):
        if not np.array_equal(axes, same):
            # A mirror turns turns round: their axes are mirrored, and the angle's sign besides.
            order = _of_quaternion(np.linalg.det(axes).round() * axes)
            out.append(PoseReading(order=order, axes=axes))
    return out


def readings_of(problem: Problem, values: Values, turned: Values) -> Iterator[Suspect]:
    """Bodies that are alone in giving poses, where the scans show that these are written otherwise:
    beams are then less than half as far off as they are, or would be with LiDARs turned.

    Args:
        problem: with scans.
        values: a state; of it count where LiDARs and bodies sit in the rig, and T_world_reference
            where targets say so. Where a guess does, it is what each reading makes of it.
        turned: the frames of LiDARs that would have to turn, as of `lidars_turned`.
    """
    for number, scans in sampled_by_recording(problem, {**values, **turned}).items():
        source = problem.sources[number]
        body = _only_body(source)
        if body is None:
            continue
        seen = np.isfinite(source.recording.bodies[body]).all(axis=1)
        told = [each for each in scans if seen[each.scan.index]]
        if not told:
            continue
        chosen = asked(told)
        as_is_m = turned_off_m(chosen, np.eye(3)[None])[0]
        if as_is_m < NEAR_M:
            continue
        found = _fitting(source, body, chosen, values, as_is_m)
        if found is not None:
            yield found


def _only_body(source: Source) -> str | None:
    """The tracked body that gives poses, where it is one."""
    tracker = source.rig.tracker
    posed = [b for b in tracker.bodies if not start.is_point(source, b)] if tracker else []
    return posed[0] if len(posed) == 1 else None


def _fitting(
    source: Source,
    body: str,
    chosen: Sequence[Sampled],
    values: Values,
    as_is_m: float,
) -> Suspect | None:
    """The simplest reading with which beams of the scans fit best, if that is far better than as
    they are, on average so far off (m)."""
    ways = [
        (reading, of_targets, T)
        for reading in pose_readings()
        for of_targets, T in _references(source, body, chosen[0], values, reading)
    ]
    off_m = np.zeros(len(ways))
    for each in chosen:
        stops, k = each.scan.stops, each.scan.index
        T_body_lidar = (
            se3.inverse(stops.in_root(body, values).T[0])
            @ (stops.in_root(stops.rig.lidar_frame, values).T[0])
        )
        pose = source.recording.bodies[body][k : k + 1]
        at = [se3.inverse(T) @ reading.read(pose)[0] @ T_body_lidar for reading, _, T in ways]
        off_m += each.off_m(np.stack(at)) / len(chosen)
    of_right = (m for m, (reading, *_) in zip(off_m, ways, strict=True) if not reading.changes)
    right = min(as_is_m, *of_right)
    least = float(off_m.min())
    if least >= min(NEARER * right, READS_M):
        return None
    good = [i for i in np.argsort(off_m).tolist() if off_m[i] <= READ_AS_WELL * least]
    reading, of_targets, _ = ways[min(good, key=lambda i: ways[i][0].changes)]
    return reading.suspect(body, source.rig.world, of_targets)


def _references(
    source: Source,
    body: str,
    one: Sampled,
    values: Values,
    reading: PoseReading,
) -> Iterator[tuple[bool, np.ndarray]]:
    """T_world_reference (4, 4) as it may be with a reading, and whether the targets are read so,
    too."""
    outer, targets, spec = one.scan.stops.reference, source.recording.targets, source.rig.target
    if outer is None:
        yield False, np.eye(4)
        return
    if targets is None or spec is None:
        yield False, _from_guesses(source, body, reading, values[outer])
        return
    yield False, values[outer]
    if reading.is_of_axes:
        lower_m = start.lower_markers(targets)
        sphere_m = lower_m + spec.sphere_below_lower_marker_m * start.gravity(source)
        known = np.isfinite(targets.faro_m).all(axis=1)
        try:
            yield True, align_points(sphere_m[known] @ reading.axes.T, targets.faro_m[known])[0]
        except InputError:
            return


def _from_guesses(
    source: Source, body: str, reading: PoseReading, otherwise: np.ndarray
) -> np.ndarray:
    """T_world_reference (4, 4) from all stops that are guessed and tracked, as a reading has them;
    as it is where there is none."""
    guess, pose = source.recording.base_guess, source.recording.bodies[body]
    if guess is None:
        return otherwise
    both = np.flatnonzero(np.isfinite(guess).all(axis=1) & np.isfinite(pose).all(axis=1))
    if not len(both):
        return otherwise
    T_root_body = source.rig.tree.place(body, source.recording.joints[both]).Ts_root_frame
    T_world_root = reading.read(pose[both]) @ se3.inverse(T_root_body)
    T_reference_root = se3.from_xyz_quat(guess[both, :3], guess[both, 3:])
    return mean_pose(T_world_root @ se3.inverse(T_reference_root))
