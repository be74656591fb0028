"""What is known of a calibration with some stops, in the words of a run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from calib.diagnosis.weak import hardly_known
from calib.planning.criteria import (
    Apart,
    Criterion,
    Variance,
    Volume,
    found_from,
    indices,
)
from calib.planning.information import Information
from calib.planning.purpose import RELIABILITY, Purpose
from calib.planning.reliability import Reliable
from calib.planning.scene import PlanningScene


@dataclass(frozen=True)
class Known:
    """What is known of a calibration, with some stops.

    Args:
        stops: how many.
        sigma: (P,) of each parameter, m or rad.
        smallest: effect -> root mean square size of its parameters, from which it is found beside
            the model, and beside the model and its rivals.
        weak: the directions that are hardly determined, as diagnosis.json has them.
        indices: the observability indices.
        predicted_m: root mean square error, m, of the place of what the arm carries, over all that
            it can reach; None where that is not what stops are planned for.
    """

    stops: int
    sigma: np.ndarray
    smallest: Mapping[str, tuple[float, float]]
    weak: Sequence[Mapping[str, Any]]
    indices: Mapping[str, float]
    predicted_m: float | None = None

    @classmethod
    def of(
        cls, scene: PlanningScene, aim: Purpose, known: Information, stops: int, wider: np.ndarray
    ) -> Known:
        """As the information of all stops has it.

        Args:
            scene, aim: what is planned, and what for.
            known: of all stops.
            stops: how many they are.
            wider: (P,) how many times wider than the graph's the sigmas of the run are.
        """
        model = known.without(scene.unbounded)
        every = model.at(scene.calibration)
        own = model.at([n for n in scene.calibration if n != scene.source.rig.reference_frame])
        return cls(
            stops=stops,
            sigma=wider * np.sqrt(np.diag(model.covariance(every))),
            smallest=dict(zip(aim.rivals, _smallest(scene, aim, known), strict=True)),
            weak=hardly_known([model.keys[i] for i in own], model.covariance(own), model.unit[own]),
            indices=indices(model, every, stops),
        )


def criterion(scene: PlanningScene, aim: Purpose, known: Information) -> Criterion:
    """By what stops are chosen: D of all, A of some components, T of rivals, or A of all once a
    stop is lost."""
    if aim.text == RELIABILITY:
        measured = np.zeros((0, len(known.keys), len(known.keys)))
        if len(scene.measured.joints):
            measured = scene.each(scene.measured, known.keys)
        return Reliable(known, known.at(scene.calibration), measured)
    if aim.rivals:
        return Apart(known, [_rival(scene, known, name) for name in aim.rivals])
    if not aim.components:
        return Volume(known, known.at(scene.calibration))
    at = np.array([known.keys.index(key) for key in aim.components])
    wanted = np.array(aim.tolerance) / known.unit[at] if aim.tolerance else np.ones(len(at))
    return Variance(known, at, wanted)


def _rival(scene: PlanningScene, known: Information, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Where the components (q,) of an effect stand, and of what size they are taken to be."""
    variables = [term.variable for term in scene.terms_of(name)]
    size = np.concatenate([scene.problem.variables[v].sigma for v in variables])
    at = known.at(variables)
    return at, size / known.unit[at]


def _smallest(scene: PlanningScene, aim: Purpose, known: Information) -> list[tuple[float, float]]:
    """Of each effect the size from which it is found; see `Known`."""
    others = known.at(scene.unbounded)
    each = (_rival(scene, known, name)[0] for name in aim.rivals)
    return [(found_from(known, of, np.setdiff1d(others, of)), found_from(known, of)) for of in each]
