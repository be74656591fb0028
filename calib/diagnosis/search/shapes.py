"""Better shapes of effects that a model has: those just found on a grid, and those of which others
have since changed what is best."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace

import numpy as np

from calib.diagnosis.candidates import shape_limits
from calib.diagnosis.score import ScoreTest, project, score_test
from calib.diagnosis.stand import Stand, tried
from calib.effects import Effect, ShapeStep
from calib.forward import named
from calib.linear.symmetric import pinv
from calib.problem.build import shapes_of, stops_view, theta_of
from calib.solve.estimate import DOFS, SEEN
from calib.solve.fit import Progress

# Squared sigmas by which another shape must fit better: three sigmas of one parameter, 0.3 % by
# chance.
BETTER_SHAPE = 9.0
# Change of a shape's logarithm at once: a choice, half as much again; the derivative holds no
# further.
LARGEST_SHAPE_STEP = 0.4
MOST_SHAPE_STEPS = 5  # a choice: from the finer grid one or two sufficed in all that was tried


def retuned(
    stand: Stand, names: Collection[str], progress: Progress
) -> tuple[Stand, dict[str, Effect]]:
    """A fit with better shapes of some effects.

    Args:
        stand: the fit.
        names: of effects of its model.
        progress: as of `fit.solve`.

    Returns:
        The fit with them, and the effects that took the place of others, by the others' names.
    """
    found: dict[str, Effect] = {}
    for _ in range(MOST_SHAPE_STEPS):
        original = {found[name].name if name in found else name: name for name in names}
        swapped = _better_shapes(stand, original, progress)
        if not swapped or (further := tried(_with_shapes, stand, swapped, progress)) is None:
            break
        # Of two places between which rows err another way, each may seem better from the other.
        jumped = any(effect.jumps for effect in swapped.values())
        if jumped and _cost(further) >= _cost(stand):
            break
        stand = further
        found |= {original[name]: effect for name, effect in swapped.items()}
    return stand, found


def _cost(stand: Stand) -> float:
    """What a fit lowers; anything is less where it was resumed, and nothing tells."""
    return stand.estimate.robust_cost if stand.estimate.linear else np.inf


def _with_shapes(stand: Stand, swapped: Mapping[str, Effect], progress: Progress) -> Stand:
    effects = tuple(swapped.get(e.name, e) for e in stand.model.effects)
    start = replace(stand.estimate.start, state=_state_with(stand, swapped))
    return stand.refitted(replace(stand.model, effects=effects), start, progress)


def _better_shapes(stand: Stand, names: Collection[str], progress: Progress) -> dict[str, Effect]:
    """By their names, some effects of the model with the shapes that one step leads to."""
    steps: dict[str, list[ShapeStep]] = {}
    for effect in (e for e in stand.model.effects if e.name in names):
        theta = theta_of(stand.problem, effect, stand.estimate.values)
        if effect.has_derivative_by_shape:
            steps[effect.name] = [ShapeStep(effect, theta)]
        elif effect.jumps and (others := _beside(effect, stand)):
            steps[effect.name] = [ShapeStep(effect, theta, to=shape) for shape in others]
    if not steps:
        return {}
    linear, at, _ = stand.linearise([step for some in steps.values() for step in some], progress)
    scores, swapped = project(linear, linear.candidates), {}
    for name, some in steps.items():
        effect = some[0].effect
        tests = ((step, score_test(scores, at[step.name])) for step in some)
        further = [_further(stand, step, test) for step, test in tests if test.dof]
        gain, shape = max(further, default=(0.0, effect.shape))
        better = effect.at(shape)
        taken = {*stand.model.names, *(e.name for e in swapped.values())}
        if gain > BETTER_SHAPE and better.name not in taken:
            swapped[name] = better
    return swapped


def _beside(effect: Effect, stand: Stand) -> list[float]:
    """Shapes to which an effect that jumps may go next; where the model has it again, it stays."""
    every = {shape for source in stand.sources for shape in effect.beside(stops_view(source))}
    return sorted(shape for shape in every if effect.at(shape).name not in stand.model.names)


def _further(stand: Stand, step: ShapeStep, test: ScoreTest) -> tuple[float, float]:
    """By how much, in squared sigmas, another shape fits better, and which one.

    With the score u and information M of a step that all rigs take together: where the shape has a
    derivative ``u^2 / M``, what its best step gains; of another shape ``2 u - M``, what going there
    does, no more and no less.
    """
    u, M = test.score.sum(), pinv(test.whiten @ test.whiten.T).sum()
    effect = step.effect
    if step.to is not None:
        return float(2.0 * u - M), step.to
    by = np.exp(np.clip(u / M, -LARGEST_SHAPE_STEP, LARGEST_SHAPE_STEP))
    ends = shape_limits(shapes_of(effect, stand.sources))
    return float(u**2 / M), float(f"{np.clip(effect.shape * by, *ends):.6g}")


def _state_with(stand: Stand, swapped: Mapping[str, Effect]) -> dict[str, np.ndarray]:
    """The state, for a model in which some effects have other shapes."""
    renamed = {
        t.variable: named(swapped[t.effect.name].name, t.rig)
        for terms in stand.problem.terms
        for t in terms
        if t.effect.name in swapped
    }
    endings = ("", DOFS, SEEN)
    every = {f"{old}{end}": f"{new}{end}" for old, new in renamed.items() for end in endings}
    return {every.get(name, name): value for name, value in stand.estimate.state.items()}
