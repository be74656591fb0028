"""How the reference mesh differs from the room."""

from __future__ import annotations

import numpy as np

from calib.effects.base import Effect, OneHot, Param, Site, View
from calib.effects.basis import finite, place_of
from calib.rig import Rig


class FaroScale(Effect):
    """The scanner's metre is too long or too short. Its mesh and its spheres share that:
    ``true = scanned * (1 + s)``."""

    name = "faro_scale"
    site = Site.REFERENCE
    unit = "1"
    formula = "surface or sphere = scanned * (1 + s), about the origin of the reference's frame"
    typical = "1 to 100 ppm of a laser's clock; 1000 ppm of a mesh merged badly, size assumed"
    covariates = ("point_m",)
    confounded_with = ("range_scale", "optitrack_scale", "incidence_angle_bias")
    source = "size assumed"

    def params(self, rig: Rig) -> tuple[Param, ...]:
        return (Param("scale", "1", 0.0005),) if rig.reference else ()

    def basis(self, view: View) -> np.ndarray:
        return finite(view["point_m"])[:, :, None]


class MovedSurface(Effect):
    """Things were moved after the mesh was made: each label by its own way along the normal."""

    name = "moved_surface"
    site = Site.REFERENCE
    unit = "m"
    formula = "true surface = mesh + d_label * normal, towards the sensor"
    typical = "5 to 50 mm of what was moved, else 0; size assumed"
    covariates = ("label",)
    confounded_with = ("label_range_offset",)
    source = "size assumed"

    def params(self, rig: Rig) -> tuple[Param, ...]:
        return tuple(Param(f"{number}_{name}", "m", 0.005) for number, name in rig.labels.items())

    def basis(self, view: View) -> OneHot:
        labels = np.array(list(view.rig.labels))
        return OneHot(place_of(view["label"], labels), view["normal"], len(labels))
