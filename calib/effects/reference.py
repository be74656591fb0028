"""How the reference mesh differs from the room."""

from __future__ import annotations

import numpy as np

from calib.effects.base import Effect, OneHot, Param, Site, View
from calib.effects.basis import finite, place_of
from calib.rig import Rig
from chains import se3

RIGID = (
    *(Param(n, "m", 0.005) for n in ("tx", "ty", "tz")),
    *(Param(n, "rad", 0.001) for n in ("rx", "ry", "rz")),
)
SEAMS = 3  # of a mesh, along each axis: a choice; seams between them are found from the next
# How often finer ones are tried between two of these, and seams beside one that was found, to
# either side and how far apart: in shares of the mesh's length. In a room of 8 m one explains half
# as much 50 mm off, and three times leave it at most 16 mm off.
SEAM_REFINEMENTS = 3
SEAMS_BESIDE, SEAM_STEP = 6, 0.005


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


class FaroRangeOffset(Effect):
    """The scanner's ranges are too short or too long by a constant. Its mesh and its spheres lie
    nearer to where it stood, or further from there, than the room does. Of several stations, each
    point is seen from the nearest."""

    name = "faro_range_offset"
    site = Site.REFERENCE
    unit = "m"
    formula = "surface or sphere = scanned + b * unit vector from the scanner (`scanner_m`)"
    typical = "up to 2 mm on the data sheets of phase scanners"
    covariates = ("point_m",)
    confounded_with = ("faro_scale", "mesh_scale", "range_offset")
    source = "rangefinder offset of a scanner: Lichti and Licht 2006, IAPRS XXXVI-5"

    def params(self, rig: Rig) -> tuple[Param, ...]:
        stood = rig.reference and rig.reference.scanner_m
        return (Param("range_offset", "m", 0.001),) if stood else ()

    def basis(self, view: View) -> np.ndarray:
        point_m = view["point_m"]
        from_each = finite(point_m)[:, None] - np.array(view.rig.reference.scanner_m)
        distance = np.linalg.norm(from_each, axis=2)
        nearest = np.arange(len(point_m)), distance.argmin(axis=1)
        away = from_each[nearest] / np.maximum(distance[nearest], np.finfo(float).tiny)[:, None]
        return (away * np.isfinite(point_m))[:, :, None]


class MeshShift(Effect):
    """The mesh is not in the frame of the spheres: the scanner was set up again between them, or
    the mesh was exported in another frame.

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
        return RIGID if rig.reference and rig.target else ()

    def basis(self, view: View) -> np.ndarray:
        point_m = finite(view["point_m"])
        basis = np.empty((len(point_m), 3, 6))
        basis[..., :3], basis[..., 3:] = np.eye(3), -se3.skew(point_m)
        return basis


class MeshScale(MeshShift):
    """The mesh has another metre than the spheres. It was scaled on its way, or made of other scans
    than they."""

    name = "mesh_scale"
    unit = "1"
    formula = "surface = mesh * (1 + s), about the origin of the reference's frame"
    typical = "100 to 2000 ppm of a mesh that was merged or exported badly, size assumed"
    confounded_with = ("faro_scale", "range_scale", "mesh_strain")
    twin = ""

    def params(self, rig: Rig) -> tuple[Param, ...]:
        apart = super().params(rig) and rig.reference.mesh
        return FaroScale().params(rig) if apart else ()

    basis = FaroScale.basis


class MeshStrain(MeshScale):
    """The mesh is stretched along an axis, or sheared. Scans of parts of the room were joined with
    small errors that add up, and are not in the frame of the spheres."""

    name = "mesh_strain"
    unit = "m, 1"
    formula = "surface = mesh + t + F point, about the origin of the reference's frame"
    confounded_with = ("mesh_scale", "mesh_shift", "mesh_seam_x", "mesh_seam_y")

    def params(self, rig: Rig) -> tuple[Param, ...]:
        rates = (Param(f"{a}{b}", "1", 0.0005) for a in "xyz" for b in "xyz")
        return (*RIGID[:3], *rates) if super().params(rig) else ()

    def basis(self, view: View) -> np.ndarray:
        point_m = finite(view["point_m"])
        basis = np.zeros((len(point_m), 3, 12))
        for a in range(3):
            basis[:, a, a], basis[:, a, 3 + 3 * a : 6 + 3 * a] = 1.0, point_m
        return basis


class MeshSeamX(MeshShift):
    """Scans of the room were registered wrongly: beyond a seam across x the mesh is shifted and
    turned against the rest of it."""

    name = "mesh_seam_x"
    formula = "surface = mesh + t + r x point, where x of the point > x_m; as `mesh_shift`"
    typical = "1 to 10 mm and up to 1 mrad between scans, size assumed"
    confounded_with = ("mesh_shift", "moved_surface", "faro_scale")
    twin = ""
    shape_name, shape, jumps = "x_m", 0.0, True
    repeats = True
    refinements = SEAM_REFINEMENTS
    axis = 0  # across which seams run

    def params(self, rig: Rig) -> tuple[Param, ...]:
        return RIGID if rig.reference else ()  # the mesh tells of it by itself, without targets

    def shapes(self, stops: View) -> tuple[float, ...]:
        return self._seams(stops, np.arange(1, SEAMS + 1) / (SEAMS + 1))

    def beside(self, stops: View) -> tuple[float, ...]:
        around = np.arange(-SEAMS_BESIDE, SEAMS_BESIDE + 1) * SEAM_STEP
        return self._seams(stops, around[around != 0.0], self.shape)

    def basis(self, view: View) -> np.ndarray:
        beyond = finite(view["point_m"])[:, self.axis] > self.shape
        return super().basis(view) * beyond[:, None, None]

    def _seams(self, stops: View, shares: np.ndarray, of: float | None = None) -> tuple[float, ...]:
        """Seams inside the mesh, at some shares of its length from a seam or from its lower end."""
        if "mesh_box_m" not in stops.columns or not self.params(stops.rig):
            return ()
        low, high = stops["mesh_box_m"][0, :, self.axis]
        at = (low if of is None else of) + shares * (high - low)
        return tuple(float(f"{x:.6g}") for x in at if low < x < high)


class MeshSeamY(MeshSeamX):
    """The same beyond a seam across y."""

    name = "mesh_seam_y"
    formula = "surface = mesh + t + r x point, where y of the point > y_m; as `mesh_shift`"
    shape_name = "y_m"
    axis = 1


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
