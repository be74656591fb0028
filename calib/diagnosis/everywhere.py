"""Changes of an arm's geometry that move nothing that is seen, at any pose: no stops tell them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from calib.diagnosis.linear import beside
from calib.diagnosis.stand import Stand
from calib.effects import Effect
from calib.forward import Placed
from calib.problem.unknowns import Key
from calib.results.reach import at_joints, body_beyond, joint_range, placed

POSES = 100  # that are drawn: enough for a change that moves something at some to show
# Of what one parameter moves in the median, that a change moves: less is rounding. In the tests'
# worlds those that cancel are below 1e-12, and all others above 0.3.
CANCELS = 1e-6
# Of what an effect moves, that another can move as well: a choice; its sigma is then 5.8 times as
# large beside the other.
STANDS_IN = 0.97


@dataclass(frozen=True)
class Everywhere:
    """How parameters move all that is seen, at poses all over what the arm can turn.

    Args:
        keys: (P,) of the parameters.
        effects: (P,) whose they are; empty of a frame's.
        J: (R, P) of rotations, rad, and places, m, per unit of each.
    """

    keys: Sequence[Key]
    effects: Sequence[str]
    J: np.ndarray

    @classmethod
    def of(cls, stand: Stand, added: Sequence[Effect] = ()) -> Self | None:
        """Of the LiDAR, bodies and levels of the first rig of a fit, told from a tracked body
        before the joints, or else from the tracker where the base stands still; None where the rig
        has no arm, or nothing tells where its base is.

        Args:
            stand: the fit.
            added: effects besides its model.
        """
        problem, values = stand.estimate.problem, stand.estimate.values
        if added:
            problem, values = beside(stand.problem_of(stand.model.plus(added)), stand.estimate)
        source = stand.sources[0]
        rig = source.rig
        beyond, recording = body_beyond(problem), source.recording
        bodies = rig.tracker.bodies if rig.tracker else ()
        base = next((body for body in bodies if not rig.joints_to(body)), None)
        root = beyond.root if beyond else ""
        if not rig.joint_names or (base is None and (beyond is None or rig.moves != "never")):
            return None
        rng, count = np.random.default_rng(0), len(recording.stops)
        known = recording.joints if count else np.zeros((1, len(rig.joint_names)))
        joints = rng.uniform(*joint_range(rig, known), (POSES, len(rig.joint_names)))
        stops = at_joints(problem, np.arange(POSES) % count if count else None, joints, root)
        seen = (*bodies, rig.lidar_frame, *(rig.levels.frames if rig.levels else ()))
        each = [placed(stops, f, base, values) for f in dict.fromkeys(seen) if f and f != base]
        names = [n for n in problem.calibration if any(n in there.d for there in each)]
        widths = {n: problem.variables[n].dim for n in names}
        J = [
            np.concatenate([_at_all(there, n, widths[n]) for n in names], axis=1) for there in each
        ]
        keys = [key for n in names for key in problem.variables[n].keys]
        J = np.concatenate(J)
        if base is None and root not in names:  # wherever the base stands
            free = np.concatenate([_at_all(there, root, 6) for there in each])
            left = J - free @ np.linalg.lstsq(free, J)[0]
            size = CANCELS * np.linalg.norm(J, axis=0)
            J = np.where(np.linalg.norm(left, axis=0) < size, 0.0, left)
        effects = [problem.variables[n].owner.effect for n in names for _ in range(widths[n])]
        return cls(keys, effects, J) if keys else None

    def split(self, keys: Sequence[Key], known: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Directions of unit length, at right angles, that together span all changes: those (P, r)
        that move nothing that is seen, and all others (P, P - r).

        Args:
            keys: (P,) of what is changed; what is no geometry plays no part in the first.
            known: (P,) the units in which directions are told.
        """
        moved = self._moved(keys, known)
        own = np.linalg.norm(moved, axis=0)
        scale = np.median(own[own > 0]) if own.any() else 1.0
        others = np.array([key not in self.keys for key in keys], float)
        seen = np.concatenate([moved / scale, np.diag(others)])
        _, size, turn = np.linalg.svd(seen, full_matrices=False)
        return turn[size < CANCELS].T, turn[size >= CANCELS].T

    def alike(self, effect: str, other: str) -> bool:
        """Whether another effect, and all else that there is, moves what an effect moves: but for
        next to nothing of what is left of that without the other."""
        effects = np.array(self.effects)
        mine, theirs = effects == effect, effects == other
        left, alone = (self._left(mine, rest) for rest in (~mine, ~(mine | theirs)))
        return bool(mine.any() and theirs.any() and left < (1.0 - STANDS_IN) * alone)

    def _left(self, mine: np.ndarray, others: np.ndarray) -> float:
        """Sum of squares of what some columns move that others cannot."""
        size = np.maximum(np.linalg.norm(self.J, axis=0), 1e-300)
        mine, others = self.J[:, mine], (self.J / size)[:, others]
        rest = mine - others @ np.linalg.lstsq(others, mine, rcond=CANCELS)[0]
        return float(np.sum(np.square(rest)))

    def movers(self, keys: Sequence[Key], change: np.ndarray, share: float) -> list[str]:
        """Names of the parameters whose parts of a change (P,) move most of what is seen, each by
        itself: by no less than a share of what the first of them does. Where none moves anything
        that another place of the base would not, those whose parts are largest."""
        own = np.linalg.norm(self._moved(keys, change), axis=0)
        own = own if own.any() else np.abs(change)
        order = np.argsort(-own, kind="stable")
        return [keys[i].name for i in order if own[i] > share * own.max()]

    def _moved(self, keys: Sequence[Key], change: np.ndarray) -> np.ndarray:
        """(R, P) how the parts of a change (P,) move what is seen; 0 of what is no geometry."""
        at = {key: i for i, key in enumerate(self.keys)}
        mine = np.array([at.get(key, -1) for key in keys], int)
        return np.where(mine < 0, 0.0, self.J[:, mine] * change)


def _at_all(there: Placed, name: str, width: int) -> np.ndarray:
    """(6 K, n) how an unknown moves a frame at all poses; nothing where it does not."""
    d = there.d.get(name, np.zeros((1, 6, width)))
    return np.broadcast_to(d, (len(there.T), *d.shape[1:])).reshape(-1, width)
