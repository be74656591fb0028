"""How the reference mesh differs from the room."""

from __future__ import annotations

import numpy as np

from calib.effects.base import Effect, OneHot, Param, Site, View
from calib.rig import Rig


class SurfaceShift(Effect):
    """Parts of the mesh stand off the true surface, each by one displacement along its normal.

    Mesh error is smooth over whole surfaces, so a fit carries one displacement per surface and one
    per patch as nuisances: without them neighbouring points would count as independent facts.

    Args:
        name: of the effect.
        column: the point's column that says which part it lies on.
        parts: (P,) which parts there are, ascending; others do not move.
        sigma_m: how far a part may stand off.
    """

    site = Site.REFERENCE
    formula = "true surface = mesh + d_part * normal"

    def __init__(self, name: str, column: str, parts: np.ndarray, sigma_m: float) -> None:
        self.name, self.column, self.parts, self.sigma_m = name, column, parts, sigma_m

    def params(self, rig: Rig) -> tuple[Param, ...]:
        return tuple(Param(f"{self.column}_{part}", "m", self.sigma_m) for part in self.parts)

    def basis(self, view: View) -> OneHot:
        part = view[self.column]
        at = np.minimum(np.searchsorted(self.parts, part), len(self.parts) - 1)
        index = np.where(self.parts[at] == part, at, -1)
        return OneHot(index, view["normal"], len(self.parts))
