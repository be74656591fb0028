"""An arm as a run found it: where its tip truly is, and what to command so that it is elsewhere.

Both hold for reported joints, as `calib.forward` has them, and for many poses at once: what does
not change from pose to pose is multiplied out beforehand.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from calib.effects import Effect, Site, View
from calib.evaluation.poses import basis_at, loads_felt, moves, pose_columns
from calib.problem.model import Source
from calib.results.solution import Part
from calib.rig import Rig
from calib.runs.reopen import model_of, reopened
from calib.runs.run import Run
from chains import se3
from chains.errors import InputError
from chains.serial import CHUNK, SerialChain

Columns = Mapping[str, np.ndarray]
# Steps of the inverse, where the arm is not stretched and where it is.
USUAL_STEPS, STRETCHED_STEPS = 3, 30
REACHED = 1e-8  # of the arm's length, and rad: no more steps
# Least damping of a step, of squares of the arm's length; beyond it half the squared error, which
# keeps steps short where an arm is stretched (Sugihara 2011, IEEE Trans. Robotics 27(5)).
DAMPING = 1e-8
LEAST_DAMPED = 1e-4  # times the damping: with less, seven joints leave a step to rounding
GIVEN_UP = 1e4  # times the damping: no step brings the tip nearer


@dataclass(frozen=True)
class Command:
    """Joints to command, and how far the tip then is from where it should be.

    Args:
        joints: (K, J) rad or m, as the encoders report them.
        off_m, off_rad: (K,) what is left; next to nothing but for arms of less than six joints,
            where an arm is stretched, and where two axes lie in line: there one may have to turn
            by up to a quarter before the wrist can bend, and `joints_for` from elsewhere may do.
        went: (K,) how far the joint that goes furthest goes from those asked for, rad or m. Next to
            where two axes lie in line, a small error of the tip takes large turns of both.
        within: (K,) whether all joints are within the limits of the URDF.
    """

    joints: np.ndarray
    off_m: np.ndarray
    off_rad: np.ndarray
    went: np.ndarray
    within: np.ndarray


@dataclass(frozen=True)
class Arm:
    """An arm as a run found it.

    Args:
        source: the recording that was fitted, with the rig as on paper.
        effects: those of the model that bend it, each with its estimate (P,).
        frames: T_parent_child (4, 4) of the frames of ``rig.yaml`` as fitted.
        base, tip: from where to where: the arm's own, or any frame before and behind it.
    """

    source: Source
    effects: Sequence[tuple[Effect, np.ndarray]]
    frames: Mapping[str, np.ndarray]
    base: str
    tip: str

    @classmethod
    def of(cls, run: Run, tip: str | None = None, rig: str | None = None) -> Self:
        """The arm of a run.

        Args:
            run: the run.
            tip: a frame that the arm carries; its own tip, or the first of them, where None.
            rig: whose, where the run has several.

        Raises:
            InputError: the rig has no arm or no such frame, the run's recordings are not what they
                were, or an effect of a Python file may not run.
        """
        sources = reopened(run)
        found = [s for s in sources if rig in (None, s.rig.name)]
        if not found:
            raise InputError(f"{run.folder}: it has no rig '{rig}'")
        part = run.solution.part(found[0].rig.name if run.solution.recordings else None)
        known = {effect.name: effect for effect in model_of(run).effects}
        return cls.as_found(found[0], part, known, tip)

    @classmethod
    def as_found(
        cls, source: Source, part: Part, known: Mapping[str, Effect], tip: str | None = None
    ) -> Self:
        """The arm of a recording's rig, of which a part of a solution says what was found; see
        `of`."""
        rig = source.rig
        if not rig.joint_names:
            raise InputError(f"rig {rig.name} has no arm")
        base, tip = rig.arm_base, tip or rig.tips[0]
        above = rig.tree.path(base)
        if rig.tree.path(tip)[: len(above)] != above or not rig.joints_to(tip):
            raise InputError(f"frame '{tip}' is not carried by the arm; name one that it carries")
        bends = {n: e for n, e in known.items() if e.site in (Site.EDGE, Site.JOINTS)}
        bends = {n: e for n, e in bends.items() if n in part.effects and not e.by_chance}
        bends = {n: e for n, e in bends.items() if e.site is Site.JOINTS or moves(source, e, tip)}
        return cls(
            source=source,
            effects=[(effect, part.effects[name].estimate) for name, effect in bends.items()],
            frames={name: frame.T_parent_child for name, frame in part.frames.items()},
            base=base,
            tip=tip,
        )

    def corrected(self, joints: np.ndarray, columns: Columns | None = None) -> np.ndarray:
        """T_base_tip (K, 4, 4), true as far as the model tells.

        The base is where it stands at rest: what tilts or shifts it from pose to pose, as
        `base_flex` does, moves the tip.

        Args:
            joints: (K, J) reported, rad or m, in the order of `Rig.joint_names`.
            columns: (K, ...) that effects of the model ask for, ``temperature_c`` say, or
                ``moved.<joint>``, ``travel.<joint>`` and ``waited.s``, which follow from nothing
                here.

        Raises:
            InputError: a column that an effect asks for is not given.
        """
        joints, columns = self._checked(joints), columns or {}
        T = np.empty((len(joints), 4, 4))
        for first in range(0, len(joints), CHUNK):
            some = slice(first, first + CHUNK)
            here = {name: np.asarray(column)[some] for name, column in columns.items()}
            T[some] = self._placed(joints[some], here)
        return T

    def to_command(self, joints: np.ndarray, columns: Columns | None = None) -> Command:
        """Joints to command so that the true tip is where the drawn arm has it at these joints.

        Args:
            joints, columns: as of `corrected`.
        """
        joints = self._checked(joints)
        return self.joints_for(self.drawn.place(joints[:, self._ours]), joints, columns)

    def joints_for(
        self, Ts_base_tip: np.ndarray, near: np.ndarray, columns: Columns | None = None
    ) -> Command:
        """Joints to command so that the true tip is at these places.

        Args:
            Ts_base_tip: (K, 4, 4) wanted.
            near: (K, J) joints that bring the tip about there; those found lie next to them.
            columns: as of `corrected`.
        """
        near, given = self._checked(near), columns or {}
        given = {name: np.asarray(column) for name, column in given.items()}
        command, off = np.empty_like(near), np.empty((len(near), 6))

        def solve(some: np.ndarray, begin: np.ndarray, steps: int) -> None:
            here = {name: column[some] for name, column in given.items()}
            command[some], off[some] = self._solve(Ts_base_tip[some], begin[some], here, steps)

        for first in range(0, len(near), CHUNK):
            solve(np.arange(first, min(first + CHUNK, len(near))), near, USUAL_STEPS)
        far = np.abs(off).max(axis=1, initial=0.0) > REACHED * self._length_m
        solve(np.flatnonzero(far), command, STRETCHED_STEPS)
        turned, shifted = np.linalg.norm(off.reshape(-1, 2, 3), axis=2).T
        lower, upper = np.array([[j.lower, j.upper] for j in self.rig.joints]).reshape(-1, 2).T
        return Command(
            joints=command,
            off_m=shifted,
            off_rad=turned / self._length_m,
            went=np.abs(command - near).max(axis=1, initial=0.0),
            within=((command >= lower) & (command <= upper)).all(axis=1),
        )

    def _solve(
        self, wanted: np.ndarray, near: np.ndarray, columns: Columns, steps: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Commands (K, J) after some steps, and what is then left, (K, 6) of `_off`."""
        command, damped = near.copy(), np.ones(len(near))
        off, J = self._off(wanted, command, columns)
        moving = np.arange(len(near))
        for _ in range(steps):
            far = np.abs(off[moving]).max(axis=1, initial=0.0) > REACHED * self._length_m
            moving = moving[far & (damped[moving] < GIVEN_UP)]
            if not len(moving):
                break
            tried = command[moving]
            tried[:, self._ours] += self._step(J[moving], off[moving], damped[moving])
            here = {name: column[moving] for name, column in columns.items()}
            then, J_then = self._off(wanted[moving], tried, here)
            nearer = np.linalg.norm(then, axis=1) < np.linalg.norm(off[moving], axis=1)
            times = damped[moving] * np.where(nearer, 0.1, 10.0)
            damped[moving] = np.maximum(times, LEAST_DAMPED)
            better = moving[nearer]
            command[better], off[better], J[better] = tried[nearer], then[nearer], J_then[nearer]
        return command, off

    def _step(self, J: np.ndarray, off: np.ndarray, damped: np.ndarray) -> np.ndarray:
        """How far to turn joints between base and tip (K, n) for tips that are so far off (K, 6),
        and move so by them (K, 6, n), least where more turns do, and shorter the more they are
        damped (K,)."""
        damping = damped * (np.square(off).sum(axis=1) / 2 + DAMPING * self._length_m**2)
        square = J.mT @ J
        np.einsum("kii->ki", square)[:] += damping[:, None]
        return np.linalg.solve(square, np.vecmat(off, J)[..., None])[..., 0]

    def _off(
        self, wanted: np.ndarray, joints: np.ndarray, columns: Columns
    ) -> tuple[np.ndarray, np.ndarray]:
        """How far (K, 6) tips are from where they are wanted, in the base's axes: rotation times
        the arm's length, and m; and how they move by the joints between base and tip (K, 6, n),
        but for what effects change of that."""
        true, twists = self._bent(joints, columns)
        axes = self._fixed.axes(true[:, self._ours])
        T, J = axes.T if twists is None else self._through(true, twists), axes.jacobian()
        J[:, :3] *= self._length_m
        turn = se3.so3_log(wanted[:, :3, :3] @ T[:, :3, :3].mT)
        return np.hstack([self._length_m * turn, wanted[:, :3, 3] - T[:, :3, 3]]), J

    def _placed(self, joints: np.ndarray, columns: Columns) -> np.ndarray:
        true, twists = self._bent(joints, columns)
        if twists is None:
            return self._fixed.place(true[:, self._ours])
        return self._through(true, twists)

    def _bent(self, joints: np.ndarray, columns: Columns) -> tuple[np.ndarray, np.ndarray | None]:
        """True joints (K, J), and twists (K, E, 6) of edges; None where these never change."""
        asked = pose_columns(self.source, joints, columns, self._felt)
        view = View(self.rig, len(joints), asked, joints)
        for effect, theta in self.effects:
            if effect.site is Site.JOINTS:
                joints = joints + np.matvec(basis_at(effect, view), theta)
        if not self._varying:
            return joints, None
        return joints, self._twists + sum(basis_at(e, view) @ theta for e, theta in self._varying)

    def _through(self, joints: np.ndarray, twists: np.ndarray) -> np.ndarray:
        """T_base_tip (K, 4, 4) where edges differ from pose to pose; the base is at rest."""
        tree = self.rig.tree
        T_base = tree.transform(self.base, joints, self._twists[None])
        return se3.inverse(T_base) @ tree.transform(self.tip, joints, twists)

    @property
    def rig(self) -> Rig:
        """As on paper."""
        return self.source.rig

    @cached_property
    def _felt(self) -> dict[str, str]:
        return loads_felt(self.source, [effect for effect, _ in self.effects])

    @cached_property
    def drawn(self) -> SerialChain:
        """The arm as its maker draws it, with the frames of ``rig.yaml`` as fitted."""
        return self._chain(self._frame_twists)

    @cached_property
    def _fixed(self) -> SerialChain:
        """The arm with all that bends it alike wherever it stands."""
        return self._chain(self._twists)

    def _chain(self, twists: np.ndarray) -> SerialChain:
        edges, route = self.rig.tree.edges, self.rig.tree.path(self.tip)
        route = route[len(self.rig.tree.path(self.base)) :]
        bent = [edges[i].T_parent_child @ se3.exp(twists[i]) for i in route]
        pairs = zip(route, bent, strict=True)
        return SerialChain([replace(edges[i], T_parent_child=T) for i, T in pairs])

    @cached_property
    def _ours(self) -> np.ndarray:
        """Which of the rig's joints lie between base and tip."""
        return np.array([self.rig.joint_names.index(name) for name in self.drawn.joint_names])

    @cached_property
    def _length_m(self) -> float:
        """The links' lengths together."""
        return sum(float(np.linalg.norm(T[:3, 3])) for T in self.drawn.fixed) or 1.0

    @cached_property
    def _frame_twists(self) -> np.ndarray:
        """(E, 6) by which the frames of ``rig.yaml`` lie off CAD."""
        tree = self.rig.tree
        twists = np.zeros((len(tree.edges), 6))
        for e, edge in enumerate(tree.edges):
            if edge.name in self.frames:
                twists[e] = se3.log(se3.inverse(edge.T_parent_child) @ self.frames[edge.name])
        return twists

    @cached_property
    def _twists(self) -> np.ndarray:
        """(E, 6) of every edge that are the same wherever the arm stands."""
        return self._frame_twists + sum(
            basis[0] @ theta
            for (effect, theta), basis in zip(self.effects, self._known, strict=True)
            if effect.site is Site.EDGE and basis is not None
        )

    @cached_property
    def _varying(self) -> list[tuple[Effect, np.ndarray]]:
        """Effects of edges that change from pose to pose."""
        pairs = zip(self.effects, self._known, strict=True)
        return [each for each, basis in pairs if each[0].site is Site.EDGE and basis is None]

    @cached_property
    def _known(self) -> list[np.ndarray | None]:
        """The basis of each effect where one row stands for all poses."""
        found: list[np.ndarray | None] = []
        view = View(self.rig, 2, {}, np.zeros((2, len(self.rig.joint_names))))
        for effect, _ in self.effects:
            try:
                basis = effect.basis(view)
            except (InputError, KeyError):  # it asks for a column
                basis = np.zeros(2)
            found.append(basis if len(basis) == 1 else None)
        return found

    def _checked(self, joints: np.ndarray) -> np.ndarray:
        joints, wanted = np.asarray(joints, float), len(self.rig.joint_names)
        if joints.ndim != 2 or joints.shape[1] != wanted:
            raise InputError(
                f"joints are of shape {joints.shape}; (K, {wanted}) is wanted, a row a pose and a "
                f"column each of {', '.join(self.rig.joint_names)}"
            )
        return joints
