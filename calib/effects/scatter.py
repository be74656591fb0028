"""What chance does anew at every stop or place: random effects, whose spread is what is estimated.

Each member of a group (a stop, a location) has a value of its own about zero, ``a ~ N(0, sd^2)``.
The values are unknowns of the graph with that prior; the sd is estimated from them (see
`calib.solve.components`). Values of one stop say nothing of the next: they correct no other
recording, but without them errors that rows share count as so many independent ones.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable
from typing import ClassVar, Self

import numpy as np

from calib.effects.base import Effect, OneHot, Param, Site, View
from calib.effects.basis import RANGE
from calib.rig import Rig


class Scatter(Effect):
    """A value by chance for every member of a group.

    Attributes:
        per: column of the stops that says which member each belongs to.
        sigma: sd to start from.
        members: names of all members; unknown until `among` says so, and then taken for one.
        label: before the names of the members of this recording, where there are several.
    """

    by_chance = True
    per: ClassVar[str]
    sigma: ClassVar[float]
    members: tuple[str, ...] = ()
    label: str = ""

    def among(self, members: Iterable[str], label: str = "") -> Self:
        """The effect with a parameter for each of these members."""
        chosen = copy.copy(self)
        chosen.members, chosen.label = tuple(dict.fromkeys(members)), label
        return chosen

    def params(self, rig: Rig) -> tuple[Param, ...]:
        members = self.members or ("each",)
        return tuple(Param(m, self.unit, self.sigma) for m in members if rig.lidar)

    def member(self, view: View) -> np.ndarray:
        """Number (rows,) or (1,) of the member that a row belongs to, -1 for none."""
        names = np.atleast_1d(view[self.per])
        if not self.members:
            return np.zeros(len(names), int)
        at = {name: i for i, name in enumerate(self.members)}
        return np.array([at.get(f"{self.label}{name}", -1) for name in names.tolist()])


class StopRangeScatter(Scatter):
    """The range zero is another one at every stop, by chance: power cycles, settling, the hour."""

    name = "stop_range_scatter"
    site = Site.BEAM
    unit, sigma = "m", 0.0003
    per = "stop"
    covariates = ("stop",)
    formula = "range = true + a_stop, a_stop by chance with a spread of sd"
    typical = "sd of 0.1 to 1 mm, size assumed"
    confounded_with = ("location_range_scatter", "temperature_drift", "warmup_drift")
    source = "variance components: Searle, Casella and McCulloch 1992; size assumed"

    def basis(self, view: View) -> OneHot:
        index = np.broadcast_to(self.member(view), view.rows)
        along = np.zeros(3)
        along[RANGE] = 1.0
        values = np.broadcast_to(along, (view.rows, 3))
        return OneHot(index, values, max(1, len(self.members)))


class LocationRangeScatter(StopRangeScatter):
    """The range zero is another one at every location, by chance: each has its own air and day."""

    name = "location_range_scatter"
    per = "location"
    covariates = ("location",)
    formula = "range = true + a_location, a_location by chance with a spread of sd"
    confounded_with = ("stop_range_scatter", "temperature_drift", "warmup_drift")
