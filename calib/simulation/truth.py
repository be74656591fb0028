"""What is true of the simulated hardware, drawn about what its rig.yaml says."""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from calib.effects import (
    DEFAULT,
    Effect,
    FrameOffset,
    OneHot,
    Site,
    Trust,
    View,
    find,
    load_effects,
)
from calib.problem.model import owned
from calib.rig import Rig
from calib.simulation.spec import Spec
from chains import se3
from chains.errors import InputError

# Hardware is built better than a prior allows: 3 mm and 3 mrad for an arm.
BUILT = 0.6


def stream(seed: int, what: str) -> np.random.Generator:
    """Random numbers for one purpose, the same for the same seed whatever else is drawn."""
    return np.random.default_rng([seed, zlib.crc32(what.encode())])


@dataclass(frozen=True)
class Truth:
    """Every effect that acts on the hardware, and how the worlds lie.

    Args:
        rig: the rig on paper.
        effects: each effect with the values (P,) of its parameters.
        T_opti_faro: (4, 4).
        hidden: size of every effect that was asked for, by its name.
    """

    rig: Rig
    effects: tuple[tuple[Effect, np.ndarray], ...]
    T_opti_faro: np.ndarray
    hidden: Mapping[str, float]

    def error(self, site: Site, view: View, shape: tuple[int, ...]) -> np.ndarray:
        """Sum of all effects at a site, (rows or 1, *shape): ``sum of basis(view) @ theta``."""
        total = np.zeros((1, *shape))
        for effect, theta in self.effects:
            if effect.site is site:
                total = total + _product(effect.basis(view), theta)
        return total

    @property
    def frames(self) -> dict[str, np.ndarray]:
        """True T_parent_child (4, 4) of every frame of rig.yaml."""
        tree = self.rig.tree
        on_paper = View(self.rig, 1, {}, np.zeros((1, len(self.rig.joint_names))))
        frames = {}
        for effect, theta in self.effects:
            if isinstance(effect, FrameOffset):
                edge = tree.edge_names.index(effect.name)
                twist = (effect.basis(on_paper) @ theta)[0, edge]
                frames[effect.name] = tree.edges[edge].T_parent_child @ se3.exp(twist)
        return frames


def draw(
    rig: Rig, spec: Spec, hide: Mapping[str, float], seed: int, trust: Trust | None = None
) -> Truth:
    """Hardware as it might have been built, with effects hidden in it.

    Frames are off by their sigma. The default effects are off by 0.6 of their parameters' sigma;
    those of the LiDAR by the mean offset and the pattern that its model is known for. A hidden
    effect of size s has ``theta = s * sigma * z``, z normal numbers scaled to a root mean square of
    1; so an effect of one parameter has ``theta = +-s * sigma``. A default effect that is hidden is
    drawn in this way instead. Effects that the spec says act have their parameters at its value.

    Args:
        rig: the rig on paper.
        spec: how far from paper hardware is built.
        hide: what `calib.effects.load_effects` takes -> size.
        seed: of the recording.
        trust: the Python files that the spec may name; None where the caller made it himself.

    Raises:
        InputError: there is no such effect, or it may not run, or it finds nothing to act on.
    """
    shared_seed = seed if spec.world_seed is None else spec.world_seed
    asked = [(_met(e, spec), size) for text, size in hide.items() for e in load_effects([text])]
    hidden = {effect.name: size for effect, size in asked}
    acting = ((e, a) for text, a in spec.acting.items() for e in load_effects([text], trust))
    given = [(_met(effect, spec), value) for effect, value in acting]
    hidden_or_given = {*hidden, *(effect.name for effect, _ in given)}
    usual = [FrameOffset(name) for name in rig.frame_sigma]
    usual += [find(name) for name in DEFAULT if name not in hidden_or_given]
    effects = [_acting(e, rig, value, stream(seed, e.name)) for e, value in given]
    for effect in [*usual, *(effect for effect, _ in asked)]:
        rng = stream(seed if owned(effect, rig) else shared_seed, effect.name)
        sigma = np.array([p.sigma for p in effect.params(rig)])
        if effect.name in hidden:
            if not sigma.any():
                raise InputError(f"effect '{effect.name}' has nothing to act on in rig {rig.name}")
            z = rng.standard_normal(len(sigma)) * (sigma > 0)
            theta = hidden[effect.name] * sigma * z / np.sqrt(np.mean(z[sigma > 0] ** 2))
        elif effect.of_lidar:
            theta = spec.build_error * _pattern(rig, len(sigma), rng)
        else:
            built = 1.0 if isinstance(effect, FrameOffset) else BUILT
            theta = spec.build_error * built * sigma * rng.standard_normal(len(sigma))
        if len(theta):
            effects.append((effect, theta))
    return Truth(rig, tuple(effects), _opti_faro(stream(shared_seed, "opti")), hidden)


def _met(effect: Effect, spec: Spec) -> Effect:
    """An effect; one by chance with a parameter for every stop or location that there will be."""
    return effect.among(spec.names[effect.per]) if effect.by_chance else effect


def _acting(
    effect: Effect, rig: Rig, value: float, rng: np.random.Generator
) -> tuple[Effect, np.ndarray]:
    """An effect, every parameter of it that may differ from 0 at one value; of one by chance that
    is their spread."""
    sigma = np.array([p.sigma for p in effect.params(rig)])
    if not sigma.any():
        raise InputError(f"effect '{effect.name}' has nothing to act on in rig {rig.name}")
    chance = rng.standard_normal(len(sigma)) if effect.by_chance else 1.0
    return effect, np.where(sigma > 0, value * chance, 0.0)


def _pattern(rig: Rig, count: int, rng: np.random.Generator) -> np.ndarray:
    """Range offsets (count,) m by ring: a common one, slow waves and white noise."""
    if rig.lidar is None:
        return np.zeros(0)
    phase = 2 * np.pi * np.arange(count) / count
    waves = np.stack([f(m * phase) for m in (1, 2, 3) for f in (np.sin, np.cos)])
    pattern = 0.8 * rng.standard_normal(6) @ waves / np.sqrt(3) + 0.6 * rng.standard_normal(count)
    pattern -= pattern.mean()
    pattern *= rig.lidar.typical_ring_offset_m / pattern.std()
    return rig.lidar.typical_range_offset_m + pattern


def _opti_faro(rng: np.random.Generator) -> np.ndarray:
    """T_opti_faro (4, 4): any heading, level to about 0.1 degrees, a metre apart."""
    tilt = np.append(np.radians(0.1) * rng.standard_normal(2), rng.uniform(-np.pi, np.pi))
    place = np.append(rng.uniform(-1, 1, 2), rng.normal(1.2, 0.05))
    return se3.from_xyz_rpy(place, tilt)


def _product(basis: np.ndarray | OneHot, theta: np.ndarray) -> np.ndarray:
    if isinstance(basis, OneHot):
        return basis.values * np.append(theta, 0.0)[basis.index][:, None]
    return basis @ theta
