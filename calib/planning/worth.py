"""What is known of a calibration with some stops, in the words of a run."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from calib.diagnosis.everywhere import STANDS_IN
from calib.diagnosis.weak import hardly_known
from calib.planning.criteria import (
    Apart,
    Criterion,
    Variance,
    Volume,
    every_pair,
    found_from,
    indices,
)
from calib.planning.information import Information
from calib.planning.purpose import RELIABILITY, Purpose
from calib.planning.reliability import Reliable
from calib.planning.scene import PlanningScene

Pair = tuple[str, str]  # names of an effect and of a rival that it is to be told from


@dataclass(frozen=True)
class Known:
    """What is known of a calibration, with some stops.

    Args:
        stops: how many.
        sigma: (P,) of each parameter, m or rad.
        smallest: effect -> rival -> root mean square size of the effect's parameters, from which it
            is found beside the model and that rival; itself as rival: beside the model alone.
        weak: the directions that are hardly determined, as diagnosis.json has them.
        indices: the observability indices.
        predicted_m: root mean square error, m, of the place of what the arm carries, over all that
            it can reach; None where that is not what stops are planned for.
    """

    stops: int
    sigma: np.ndarray
    smallest: Mapping[str, Mapping[str, float]]
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
            smallest=_smallest(scene, aim, known),
            weak=hardly_known(
                [model.keys[i] for i in own],
                model.covariance(own),
                model.unit[own],
                scene.everywhere,
            ),
            indices=indices(model, every, stops),
        )


def criterion(
    scene: PlanningScene, aim: Purpose, known: Information, apart: Collection[Pair] | None = None
) -> Criterion:
    """By what stops are chosen: D of all, A of some components, T of rivals, or A of all once a
    stop is lost.

    Args:
        scene, aim: what is planned, and what for.
        known: of all rows that were measured.
        apart: of rivals which are to be told from which; all where None.
    """
    if aim.text == RELIABILITY:
        measured = np.zeros((0, len(known.keys), len(known.keys)))
        if len(scene.measured.joints):
            measured = scene.each(scene.measured, known.keys)
        return Reliable(known, known.at(scene.calibration), measured)
    if aim.rivals:
        rivals = [_rival(scene, known, name) for name in aim.rivals]
        every = every_pair(len(rivals))
        pairs = [p for p in every if apart is None or (aim.rivals[p[0]], aim.rivals[p[1]]) in apart]
        return Apart(known, rivals, known.at(scene.unbounded), pairs)
    if not aim.components:
        return Volume(known, known.at(scene.calibration))
    at = np.array([known.keys.index(key) for key in aim.components])
    wanted = np.array(aim.tolerance) / known.unit[at] if aim.tolerance else np.ones(len(at))
    return Variance(known, at, wanted)


def alike(scene: PlanningScene, aim: Purpose, most: Information) -> dict[Pair, float]:
    """An effect and a rival that does next to the same at all stops that can be measured -> the
    size from which the effect is told from it by all of them.

    Args:
        scene, aim: what is planned, and what for.
        most: what all those stops say.
    """
    least = np.sqrt(1.0 - STANDS_IN)
    every = _smallest(scene, aim, most).items()
    pairs = ((name, rival, sizes) for name, sizes in every for rival in sizes)
    return {(n, r): sizes[r] for n, r, sizes in pairs if sizes[n] < least * sizes[r]}


def _rival(scene: PlanningScene, known: Information, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Where the components (q,) of an effect stand, and of what size they are taken to be."""
    variables = [term.variable for term in scene.terms_of(name)]
    size = np.concatenate([scene.problem.variables[v].sigma for v in variables])
    at = known.at(variables)
    return at, size / known.unit[at]


def _smallest(
    scene: PlanningScene, aim: Purpose, known: Information
) -> dict[str, dict[str, float]]:
    """Of each effect the size from which it is found beside each; see `Known`."""
    at = {name: _rival(scene, known, name)[0] for name in aim.rivals}
    added = known.at(scene.unbounded)
    return {
        name: {
            rival: found_from(known, of, np.setdiff1d(added, np.concatenate([of, other])))
            for rival, other in at.items()
        }
        for name, of in at.items()
    }
