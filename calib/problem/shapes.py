"""Shapes of effects: those worth trying on recordings, and how far the one that was chosen may be
off.

An effect that is not linear in its shape (a time constant, a wavelength) is linear once that is
chosen. What the shape does to the rows is linear near there as well, and stands beside the model as
one unknown more: its derivative by the logarithm of the shape.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from calib.effects import Effect, ShapeStep, View
from calib.problem.model import Model, Source
from calib.problem.problem import Problem


def shapes_of(effect: Effect, sources: Sequence[Source]) -> list[float]:
    """The shapes worth trying, ascending. Of several recordings, as of times at which something
    slipped, no more than of the one that has most: evenly among those of all."""
    each = [effect.shapes(stops_view(source)) for source in sources]
    every = sorted(set().union(*each))
    chosen = np.linspace(0, len(every) - 1, max(map(len, each))).round().astype(int)
    return [every[i] for i in np.unique(chosen)]


def stops_view(source: Source) -> View:
    """The stops of a recording as effects see them."""
    count = len(source.recording.stops)
    return View(source.rig, count, source.columns, source.recording.joints)


def shape_steps(
    problem: Problem, model: Model, values: Mapping[str, np.ndarray]
) -> list[ShapeStep]:
    """What moves the shapes of a model's effects, at a state.

    Before any data a shape is anywhere among those worth trying, evenly in its logarithm.
    """
    return [
        ShapeStep(effect, theta_of(problem, effect, values), _width(effect, problem.sources))
        for effect in model.effects
        if effect.has_derivative_by_shape
    ]


def theta_of(
    problem: Problem, effect: Effect, values: Mapping[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """Parameters (P,) of an effect at a state, those that are held included, by the rig's name."""
    found = {}
    for terms, source in zip(problem.terms, problem.sources, strict=True):
        for term in (t for t in terms if t.effect.name == effect.name):
            theta = np.zeros(len(effect.params(source.rig)))
            theta[term.free] = values[term.variable]
            found[source.rig.name] = theta
    return found


def _width(effect: Effect, sources: Sequence[Source]) -> float:
    """Standard deviation of the logarithm of a shape that is anywhere among those worth trying."""
    tried = [shape for shape in (*shapes_of(effect, sources), effect.shape) if shape > 0]
    return float(np.log(max(tried) / min(tried)) / np.sqrt(12.0))
