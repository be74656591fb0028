"""Whether a base that is said to stand still stands elsewhere at every stop.

Such a base seems to scatter in all that is seen of the rig: in its tracked bodies, its joints, and
where its LiDAR is. With a place of its own at every stop there is no scatter left; where a tracker
or joints scatter, there still is, as bodies and scans of one stop contradict each other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib import problem as problems
from calib.diagnosis.chance import Chance
from calib.diagnosis.stand import Stand, tried
from calib.diagnosis.suggest import all_of
from calib.effects import Site
from calib.problem.model import Source
from calib.problem.places import standing
from calib.solve.fit import Progress, solve
from chains import se3

# Of what scatter explains, that is left where the base is free; a choice, below which the rest is
# another matter.
LEFT = 0.1
CARRIED = (Site.TRACKER, Site.JOINTS, Site.EDGE)  # where what a base carries seems to scatter
STILL = {"location": "at a location", "never": "at all stops"}  # as rig.yaml says


@dataclass(frozen=True)
class Sways:
    """A base that stands elsewhere at every stop.

    Args:
        shift_m, turn_rad: rms, from where it stands on average.
        said: for how long rig.yaml says that it stands still.
        names: of the scatter that it was taken for.
    """

    shift_m: float
    turn_rad: float
    said: str
    names: Sequence[str]

    @property
    def sentence(self) -> str:
        """What it says, and what to do about it."""
        return (
            f"rig.yaml says that the base stands still {self.said}, but from stop to stop it moves "
            f"by {1e3 * self.shift_m:.2f} mm and {1e3 * self.turn_rad:.2f} mrad rms, so that what "
            f"it carries seems to scatter ({all_of(self.names)}). Put 'moves: stop' under 'base' "
            "in rig.yaml; with a place of the base for each stop, next to nothing of that scatter "
            "is left."
        )


def sways(stand: Stand, scatter: Sequence[Chance], progress: Progress) -> Sways | None:
    """A base whose moves explain scatter that was found; None where they do not.

    Args:
        stand: the model with all that is named, scatter or not.
        scatter: what was found.
        progress: as of `fit.solve`.
    """
    scatter = [chance for chance in scatter if chance.effect.site in CARRIED]
    if not scatter or not all(map(_shows_its_base, stand.sources)):
        return None
    names = [chance.effect.name for chance in scatter]
    free = tried(_freed, stand, names, progress)
    if free is None or not free.estimate.converged:
        return None
    left = [c.statistic for c in free.look(progress).chance if c.found and c.effect.name in names]
    if max(left, default=0.0) > LEFT * max(chance.statistic for chance in scatter):
        return None
    turn_rad, shift_m = _moves(stand, free)
    return Sways(shift_m, turn_rad, STILL[stand.sources[0].rig.moves], names)


def _shows_its_base(source: Source) -> bool:
    """Whether its base is said to stand still, and something that stands on it is tracked."""
    bodies = source.rig.tracker.bodies if source.rig.tracker else ()
    return source.rig.moves in STILL and any(not source.rig.joints_to(b) for b in bodies)


def _freed(stand: Stand, scatter: Sequence[str], progress: Progress) -> Stand:
    """The model without that scatter, its bases free to stand elsewhere at every stop."""
    model = stand.model.minus(scatter)
    sources = [replace(s, rig=replace(s.rig, moves="stop")) for s in stand.sources]
    problem = problems.build(sources, model, meetings=stand.problem.meetings)
    estimate = solve(problem, progress=progress, start=stand.estimate.start)
    return Stand(sources, model, problem, estimate, own=stand.own)


def _moves(stand: Stand, free: Stand) -> np.ndarray:
    """(2,) rms by which the base is turned and shifted at a stop, from the mean of the stops
    between which it is said to stand still; without what it only seems to move by, as it is not
    better known."""
    values, found, known, stops = free.estimate.values, [], [], 0
    for i, (source, loose) in enumerate(zip(stand.sources, free.sources, strict=True)):
        still, prefix = standing(source), f"{i}/" if len(stand.sources) > 1 else ""
        roots = np.array([f"{prefix}root@{stop}" for stop in standing(loose)])
        for place in np.unique(still):
            names = [name for name in roots[still == place].tolist() if name in values]
            T, count = np.array([values[name] for name in names]), len(names)
            if count > 1:
                away = se3.log(se3.inverse(T[0]) @ T)
                C = free.estimate.covariance_of(names).reshape(count, 6, count, 6)
                own, shared = np.einsum("iaia->a", C), np.einsum("iaja->a", C) / count
                found.append(np.square(away - away.mean(axis=0)).sum(axis=0))
                known.append(own - shared)
                stops += count - 1
    left = np.sum(found, axis=0) - np.sum(known, axis=0)
    return np.sqrt(np.maximum(left.reshape(2, 3).sum(axis=1) / max(stops, 1), 0.0))
