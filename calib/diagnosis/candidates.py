"""What could be missing: every effect of the catalogue that a model does not have, in its shapes;
`structure` has what is no effect of it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calib.effects import CATALOGUE, Effect, Site
from calib.problem.build import shapes_of
from calib.problem.model import Model, Source

FINER = 9  # shapes between the two of a grid beside the best one: a choice
NO_MASSES = "the masses of the arm's links (inertial/mass in its URDF)"


def known_effects(
    model: Model,
    sources: Sequence[Source],
    columns: frozenset[str],
    catalogue: Sequence[Effect] = CATALOGUE,
) -> list[Effect]:
    """The effects that the model lacks and the recordings can show, shape by shape; of those that
    repeat, also more of what it has.

    Args:
        model: as fitted.
        sources: the recordings.
        columns: what points and stops carry.
        catalogue: the effects that are known.
    """
    there = {effect.family for effect in model.effects}
    found: list[Effect] = []
    for effect in catalogue:
        if effect.family in there and not effect.repeats:
            continue
        if effect.family in model.fixed or lacking(effect, sources, columns):
            continue
        if effect.shape_name:
            found += [effect.at(s) for s in _others(effect, shapes_of(effect, sources), model)]
        else:
            found.append(effect)
    return found


def one_more_wave(effect: Effect, model: Model) -> bool:
    """Whether a model has a wave of an effect's family already, and this is another. Any shape can
    be taken for many waves, so they come after all else."""
    return not effect.jumps and any(e.family == effect.family for e in model.effects)


def _others(effect: Effect, grid: Sequence[float], model: Model) -> list[float]:
    """The shapes of a grid that a model has not. Next to a smooth one that it has, another only
    says that this one is a little off; so of these, one of the grid lies between."""
    if not len(grid):
        return []
    shapes, number = np.array(grid), np.arange(len(grid))
    there = np.zeros(len(grid), bool)
    for mine in (e.shape for e in model.effects if e.family == effect.family):
        there |= shapes == mine
        if effect.has_derivative_by_shape:
            there |= np.abs(number - np.interp(mine, shapes, number)) <= 1
    return shapes[~there].tolist()


def concerned(effect: Effect, sources: Sequence[Source]) -> bool:
    """Whether a rig has the instrument, or the kind of joint, that an effect is about: an arm under
    a tracker alone lacks nothing of a LiDAR, a scanner or targets, and one without sliding joints
    nothing of rails. One that moves between all stops stands on nothing."""
    rigs = [s.rig for s in sources]
    if effect.needs_standing or effect.joint_kind == "mimic":
        return any(effect.params(rig) for rig in rigs)
    if effect.site in (Site.BEAM, Site.NOISE) or effect.needs_lidar:
        return any(rig.lidar for rig in rigs)
    if effect.joint_kind:
        return any(effect.joint_kind in rig.joint_kinds for rig in rigs)
    if effect.site is Site.REFERENCE:
        return any(rig.reference or rig.lidar for rig in rigs)
    return effect.site is not Site.TARGET or any(rig.target for rig in rigs)


def lacking(effect: Effect, sources: Sequence[Source], columns: frozenset[str]) -> list[str]:
    """What the recordings lack to test an effect: columns, or anything to act on."""
    needed = (*effect.covariates, "range_std_m") if effect.site is Site.NOISE else effect.covariates
    missing = [c for c in needed if c != "joints" and c not in columns]
    if "joints" in effect.covariates and not any(s.rig.joint_names for s in sources):
        missing.append("joints")
    if not missing and not any(effect.params(s.rig) for s in sources):
        arms = [s.rig for s in sources if s.rig.joint_names]
        weightless = arms and not any(rig.masses for rig in arms)
        missing.append(
            NO_MASSES if effect.needs_masses and weightless else "hardware that it acts on"
        )
    return missing


def finer(effect: Effect, grid: Sequence[float]) -> list[Effect]:
    """An effect in finer shapes between those of a grid beside its own, which is one of them."""
    i = grid.index(effect.shape)
    ends = grid[max(0, i - 1)], grid[min(len(grid) - 1, i + 1)]
    evenly = effect.jumps or ends[0] <= 0  # else in its logarithm
    spaced = (np.linspace if evenly else np.geomspace)(*ends, FINER)
    spaced = np.rint(spaced) if effect.whole else spaced
    shapes = {float(f"{shape:.6g}") for shape in (*spaced, effect.shape)}
    return [effect.at(shape) for shape in sorted(shapes)]


def shape_limits(grid: Sequence[float]) -> tuple[float, float]:
    """Between which shapes an effect is what its name says: as far beyond each end of its grid as
    the next shape is before it. A wave much longer than all ranges would stand for any curve."""
    if len(grid) < 2 or grid[0] <= 0:
        return -np.inf, np.inf
    return grid[0] ** 2 / grid[1], grid[-1] ** 2 / grid[-2]
