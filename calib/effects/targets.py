"""How hanging targets differ from their drawing. The tracker's z axis is taken to point up."""

from __future__ import annotations

import numpy as np

from calib.effects.base import Effect, Param, Site, View
from calib.rig import Rig


class TargetRodTilt(Effect):
    """Rods hang askew, all alike: friction, a bent hook, or a tracker's floor that is not level."""

    name = "target_rod_tilt"
    site = Site.TARGET
    unit = "rad"
    formula = "sphere = hung + L * (tilt_x, tilt_y, 0), tracker frame, L below the lower marker"
    typical = "5 to 10 mrad: 0.5 degrees over 0.2 m are 1.7 mm, size assumed"
    confounded_with = ("faro",)
    source = "size assumed"

    def params(self, rig: Rig) -> tuple[Param, ...]:
        return tuple(Param(n, "rad", 0.008) for n in "xy") if rig.target else ()

    def basis(self, view: View) -> np.ndarray:
        return view.rig.target.sphere_below_lower_marker_m * np.eye(3)[None, :, :2]


class TargetSphereOffset(Effect):
    """Spheres sit lower on their rods than drawn, all alike."""

    name = "target_sphere_offset"
    site = Site.TARGET
    unit = "m"
    formula = "sphere = hung - (0, 0, d), tracker frame"
    typical = "0.2 to 1 mm, as printed"
    confounded_with = ("faro",)
    source = "Pushing the Limits of LiDAR: Accurate Performance Analysis of Indoor 3D LiDARs"

    def params(self, rig: Rig) -> tuple[Param, ...]:
        return (Param("lower", "m", 0.001),) if rig.target else ()

    def basis(self, view: View) -> np.ndarray:
        return -np.eye(3)[None, :, 2:]
