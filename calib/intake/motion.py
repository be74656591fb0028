"""How fast things move, whatever logged it: what clocks are matched by, and holds are found in."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from chains import se3
from chains.frames import Edge
from chains.se3 import Array
from sensors.readers.base import Track

GAP_S = 0.5  # a longer pause of a log, and nobody knows what moved
MOVING_KINDS = ("joints", "pose", "gyro", "point")


@dataclass(frozen=True)
class Motion:
    """Velocities of one thing, smoothed over a window.

    Args:
        name, clock: as of the track.
        kind: "turn" where rates are rad/s of a body in space, "joints" of joints in theirs,
            "shift" m/s.
        time_s: (N,) s, rising.
        rate: (N, D) components; NaN = not known.
    """

    name: str
    clock: str
    kind: str
    time_s: Array
    rate: Array

    @property
    def speed(self) -> Array:
        """(N,) size of the rate."""
        return np.linalg.norm(self.rate, axis=1)


def place(edges: Sequence[Edge], joints: Array) -> Array:
    """T_base_tip (K, 4, 4) of a chain at joints (K, J), taken at its word."""
    T = np.broadcast_to(np.eye(4), (len(joints), 4, 4))
    moving = iter(joints.T)
    for edge in edges:
        T = T @ edge.T_parent_child
        if edge.joint is not None:
            T = T @ se3.exp(next(moving)[:, None] * edge.joint.screw)
    return T


def motions(track: Track, edges: Sequence[Edge], window_s: float) -> list[Motion]:
    """The motions that a track tells, best first; none of a covariate.

    Joints of the arm `edges` tell how its tip turns, too, which a tracker on it sees as well.
    """
    if track.kind not in MOVING_KINDS or len(track.time_s) < 3:
        return []
    known = np.isfinite(track.values).all(axis=1)
    known[1:] &= np.diff(track.time_s) > 0
    time_s, values = track.time_s[known], track.values[known]
    if len(time_s) < 3:
        return []

    def motion(kind: str, moves: Array) -> Motion:
        middle_s = (time_s[1:] + time_s[:-1]) / 2
        return Motion(
            name=track.name,
            clock=track.clock,
            kind=kind,
            time_s=middle_s,
            rate=smooth(time_s, moves, window_s),
        )

    step_s = np.diff(time_s)[:, None]
    if track.kind == "gyro":
        return [motion("turn", (values[1:] + values[:-1]) / 2 * step_s)]
    parts = []
    if track.kind == "pose":
        parts.append(motion("turn", _turned(Rotation.from_quat(values[:, 3:], scalar_first=True))))
    if track.kind == "joints":
        names = [edge.joint.name for edge in edges if edge.joint is not None]
        if names and set(names) <= set(track.names):
            T = place(edges, values[:, [track.names.index(name) for name in names]])
            parts.append(motion("turn", _turned(Rotation.from_matrix(T[:, :3, :3]))))
        parts.append(motion("joints", np.diff(values, axis=0)))
    else:
        parts.append(motion("shift", np.diff(values[:, :3], axis=0)))
    return parts


def _turned(turn: Rotation) -> Array:
    """Turns (N - 1, 3) rad between neighbours."""
    return (turn[:-1].inv() * turn[1:]).as_rotvec()


def smooth(time_s: Array, moves: Array, window_s: float) -> Array:
    """Rates (N - 1, D) at the middles between times (N,), of moves (N - 1, D) to the next.

    A rate is the mean over a centred window, what was moved within it; NaN where a log pauses.
    """
    step_s = np.diff(time_s)
    usual_s = max(float(np.median(step_s)), 1e-6)
    middle_s = (time_s[1:] + time_s[:-1]) / 2
    moved = np.vstack([np.zeros(moves.shape[1]), np.cumsum(moves, axis=0)])
    half = max(window_s, usual_s) / 2
    early, late = (np.clip(middle_s + h, time_s[0], time_s[-1]) for h in (-half, half))
    ends = [np.stack([np.interp(at, time_s, m) for m in moved.T], axis=1) for at in (late, early)]
    rate = (ends[0] - ends[1]) / (late - early)[:, None]
    rate[step_s > max(GAP_S, 5 * usual_s)] = np.nan
    return rate
