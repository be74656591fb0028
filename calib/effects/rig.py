"""How a rig differs from its drawing."""

from __future__ import annotations

import numpy as np

from calib.effects.base import Effect, Param, Site, View
from calib.rig import Rig

DOF = ("rx", "ry", "rz", "tx", "ty", "tz")


class FrameOffset(Effect):
    """A frame sits elsewhere than in CAD: ``T_parent_child = T_cad exp(theta)``.

    One per frame of ``rig.yaml``; a degree of freedom with a sigma of 0 is held.
    """

    site = Site.EDGE
    formula = "T_parent_child = T_cad exp(theta), theta in the child's axes"
    typical = "0.2 to 2 mm, 1 to 5 mrad"

    def __init__(self, frame: str) -> None:
        self.name = frame

    def params(self, rig: Rig) -> tuple[Param, ...]:
        sigma = rig.frame_sigma[self.name]
        units = ("rad",) * 3 + ("m",) * 3
        return tuple(
            Param(dof, unit, float(s)) for dof, unit, s in zip(DOF, units, sigma, strict=True)
        )

    def basis(self, view: View) -> np.ndarray:
        tree = view.rig.tree
        basis = np.zeros((1, len(tree.edges), 6, 6))
        basis[0, tree.edge_names.index(self.name)] = np.eye(6)
        return basis
