"""What is estimated: which recordings, with which effects, holding what fixed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib import effects
from calib.effects import Effect, FrameOffset
from calib.forward import Term
from calib.rig import Rig, load_rig
from chains.errors import InputError
from sensors.recording import Recording
from sensors.reference import Reference


@dataclass(frozen=True)
class Model:
    """A choice of effects; frames with a sigma are always in it unless fixed.

    Args:
        effects: those to estimate; the name of one in the catalogue stands for it.
        fixed: names kept at their nominal value: a frame or effect, or one parameter of it as
            ``name.parameter``, ``lidar.tz`` say.
    """

    effects: tuple[Effect, ...] = effects.DEFAULT
    fixed: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        chosen = (effects.find(e) if isinstance(e, str) else e for e in self.effects)
        object.__setattr__(self, "effects", tuple(chosen))

    @classmethod
    def of(cls, chosen: str | None, fixed: Sequence[str]) -> Model:
        """The model that a command line names: effects with commas, or the default ones.

        Raises:
            InputError: an effect that the catalogue has not.
        """
        if chosen is None:
            return cls(fixed=tuple(fixed))
        names = tuple(dict.fromkeys(name.strip() for name in chosen.split(",") if name.strip()))
        return cls(names, tuple(fixed))

    @property
    def names(self) -> tuple[str, ...]:
        """Of its effects."""
        return tuple(effect.name for effect in self.effects)

    def terms(self, rig: Rig, several: bool) -> list[Term]:
        """The model's effects on one rig: those with anything to act on.

        Args:
            rig: the rig.
            several: True when other rigs share the graph; what belongs to this rig alone then
                carries its name.

        Raises:
            InputError: an effect or a fixed name that this rig does not know.
        """
        chosen: list[Effect] = [FrameOffset(name) for name in rig.frame_sigma]
        chosen += self.effects
        self._check_fixed(chosen, rig)
        terms = []
        for effect in chosen:
            free = self._free(effect, rig)
            if len(free):
                own = several and owned(effect, rig)
                terms.append(
                    Term(effect, f"{rig.name}/{effect.name}" if own else effect.name, free)
                )
        return terms

    def _free(self, effect: Effect, rig: Rig) -> np.ndarray:
        if effect.name in self.fixed:
            return np.zeros(0, int)
        params = enumerate(effect.params(rig))
        return np.array(
            [i for i, p in params if p.sigma and f"{effect.name}.{p.name}" not in self.fixed], int
        )

    def _check_fixed(self, chosen: Sequence[Effect], rig: Rig) -> None:
        known = {e.name for e in chosen}
        known |= {f"{e.name}.{p.name}" for e in chosen for p in e.params(rig)}
        known |= {frame for frame in (rig.reference_frame,) if frame}
        for name in self.fixed:
            if name not in known:
                raise InputError(
                    f"--fix {name}: no such frame, effect or parameter in the model; it has "
                    f"{', '.join(sorted(e.name for e in chosen))} and name.parameter of each"
                )


def owned(effect: Effect, rig: Rig) -> bool:
    """Whether an effect belongs to this rig alone when several rigs stand in one graph.

    The arm, the base's frames and the scanner's alignment are the same hardware in every
    recording; what hangs from the arm's tip, and the LiDAR, are not, unless ``rig.yaml`` says so.
    """
    if effect.name in rig.shared:
        return False
    if effect.name in rig.own or effect.of_lidar:
        return True
    return effect.name in rig.beyond_arm


@dataclass(frozen=True)
class Source:
    """A recording opened for a fit: its rig, its stops, its reference."""

    rig: Rig
    recording: Recording
    reference: Reference | None

    @classmethod
    def open(cls, folder: Path | str) -> Source:
        """Read a recording's rig, stops and mesh, checking all but the scans.

        Raises:
            InputError: what is wrong, and where.
        """
        rig = load_rig(folder)
        rings = rig.lidar.rings if rig.lidar else None
        bodies = rig.tracker.bodies if rig.tracker else ()
        recording = Recording.open(folder, rig.joint_names, bodies, rings)
        spec = rig.reference
        mesh = Reference.read(spec.mesh, spec.faces, spec.labels) if spec and spec.mesh else None
        return cls(rig, recording, mesh)

    @property
    def columns(self) -> dict[str, np.ndarray]:
        """Per-stop covariates (K,) that effects may look at."""
        moved = moved_columns(self.rig.joint_names, self.recording.joints, self.recording.time_s)
        return {"time_s": self.recording.time_s, **moved, **self.recording.covariates}


def moved_columns(
    names: Sequence[str], joints: np.ndarray, time_s: np.ndarray
) -> dict[str, np.ndarray]:
    """Which way each joint turned to come to each stop, ``moved.<joint>`` (K,): -1, 0 or 1.

    Args:
        names: of the joints.
        joints: (K, J) reported.
        time_s: (K,) of the stops; nothing is known of the first.
    """
    order = np.argsort(time_s, kind="stable")
    way = np.zeros(np.shape(joints))
    way[order[1:]] = np.sign(np.diff(joints[order], axis=0))
    return {f"moved.{name}": way[:, j] for j, name in enumerate(names)}
