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


class MeshShift(Effect):
    """The mesh is not in the frame of the spheres: a scan was registered wrongly, or the mesh was
    exported in another frame.

    A tracker whose frame was set anew between the targets and the stops looks the very same. Which
    of the two it is decides where the reference's frame is.
    """

    name = "mesh_shift"
    site = Site.REFERENCE
    unit = "m, rad"
    formula = "surface = mesh + t + r x point, about the origin of the reference's frame"
    typical = "1 to 10 mm and up to 1 mrad of a registration by targets or clouds, size assumed"
    covariates = ("point_m",)
    confounded_with = ("target_rod_tilt", "target_sphere_offset", "stop_pose_scatter")
    source = "size assumed"
    twin = "a tracker whose frame was set anew between the targets and the stops"

    @property
    def of_scanner(self) -> bool:
        """The spheres stay where they are."""
        return False

    def params(self, rig: Rig) -> tuple[Param, ...]:
        if not (rig.reference and rig.target):
            return ()
        return tuple(Param(n, "m", 0.005) for n in ("tx", "ty", "tz")) + tuple(
            Param(n, "rad", 0.001) for n in ("rx", "ry", "rz")
        )

    def basis(self, view: View) -> np.ndarray:
        point_m = finite(view["point_m"])
        shift = np.broadcast_to(np.eye(3), (len(point_m), 3, 3))
        turn = np.cross(np.eye(3)[:, None], point_m).transpose(1, 2, 0)
        return np.concatenate([shift, turn], axis=2)


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
