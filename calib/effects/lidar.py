"""How a spinning LiDAR lies."""

from __future__ import annotations

import numpy as np

from calib.effects.base import Effect, OneHot, Param, Site, View
from calib.rig import Rig


class RingRangeOffset(Effect):
    """Every ring has its own range zero: ``measured = true + a_ring``."""

    name = "ring_range_offset"
    site = Site.BEAM
    formula = "range = true + a_ring"
    typical = "1 to 25 mm, patterned over the rings"
    covariates = ("ring",)
    confounded_with = ("range_offset", "ring_elevation_offset", "near_range_bias")
    source = "the accuracy by ring of indoor LiDARs; Velodyne HDL-64E factory tables"

    def params(self, rig: Rig) -> tuple[Param, ...]:
        rings = rig.lidar.rings if rig.lidar else 0
        return tuple(Param(f"ring_{k:03d}", "m", 0.05) for k in range(rings))

    def basis(self, view: View) -> OneHot:
        ring = view["ring"]
        along = np.broadcast_to([1.0, 0.0, 0.0], (len(ring), 3))
        return OneHot(ring, along, view.rig.lidar.rings)
