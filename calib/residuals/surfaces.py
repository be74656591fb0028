"""What the beams of a stop meet: the reference mesh, or planes found in the scans."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, partial
from typing import Protocol

import numpy as np

from calib.forward import Values
from calib.residuals.beams import Association, Columns, Surface
from calib.solve.graph import Variable
from chains import se3
from sensors.lidar import Beams
from sensors.planes import Cells, Planes
from sensors.reference import Reference
from sensors.surfaces import transverse

GRAZING_RAD = np.deg2rad(80.0)  # a fit keeps no beam that meets its surface flatter than this
PARALLEL_RAD = np.deg2rad(89.0)
# Widths of the cells that surfaces are divided into, in a room whose box has 200 m2 of walls; in
# larger ones the cells grow alike, so that there are never many more of them.
PATCHES_M = {"region": 1.2, "patch": 0.5}
ROOM_M2 = 200.0


class Meeting(Protocol):
    """Something that beams meet. First associate, then meet: an association can be kept."""

    def associate(
        self, T: np.ndarray, beams: Beams, values: Values, near_edges: bool
    ) -> Association: ...

    def meet(
        self, T: np.ndarray, beams: Beams, values: Values, association: Association
    ) -> Surface: ...


@dataclass(frozen=True)
class MeshSurface:
    """The reference mesh.

    Args:
        reference: the mesh.
        footprint_rad: how far beside a beam a depth edge spoils it.
    """

    reference: Reference
    footprint_rad: float

    @cached_property
    def patches_m(self) -> dict[str, float]:
        """Kind of patch -> its width, in this room."""
        length, width, height = np.ptp(self.reference.vertices_m, axis=0)
        walls_m2 = 2.0 * (length * width + width * height + height * length)
        scale = max(1.0, float(np.sqrt(walls_m2 / ROOM_M2)))
        return {kind: scale * size_m for kind, size_m in PATCHES_M.items()}

    @cached_property
    def roughness_m(self) -> np.ndarray:
        """Standard deviation (S,) m of each surface's corners across the plane that fits best."""
        mesh = self.reference
        corners_m = mesh.vertices_m[mesh.triangles].reshape(-1, 3)
        return Cells.of(corners_m, np.repeat(mesh.surface, 3)).spread_m[:, 0]

    def surface_of(self, kind: str, parts: np.ndarray) -> np.ndarray:
        """The surface that each of those parts is of; a surface is its own."""
        if kind == "surface":
            return parts
        return self.reference.patch_surface(self.patches_m[kind])[parts]

    def associate(
        self, T: np.ndarray, beams: Beams, values: Values, near_edges: bool
    ) -> Association:
        """Triangle of each beam; near edges its patches too, and -1 for what is better left out.

        Args:
            T: (4, 4) T_reference_lidar.
            beams: of the stop.
            values: the state; a mesh does not depend on it.
            near_edges: True drops beams near a depth edge, and grazing ones.
        """
        origins, directions = _in_reference(T, beams)
        triangle = self.reference.first_triangle(origins, directions)
        if not near_edges:
            return Association(triangle)
        hits = self.reference.hits(triangle, origins, directions)
        spoilt = hits.incidence_rad > GRAZING_RAD
        spoilt |= self.reference.near_edge(origins, directions, hits, self.footprint_rad)
        triangle = np.where(spoilt, -1, hits.triangle).astype(np.int32)
        patches = {
            kind: self.reference.patch(hits, size_m).astype(np.int32)
            for kind, size_m in self.patches_m.items()
        }
        return Association(triangle, patches)

    def meet(
        self, T: np.ndarray, beams: Beams, values: Values, association: Association
    ) -> Surface:
        """The triangle's plane that each beam meets under this association."""
        hits = self.reference.hits(association.part, *_in_reference(T, beams))
        surface = self.reference.surface
        columns = {
            "label": hits.label,
            "reference_intensity": hits.intensity,
            "surface": lambda: np.where(hits.triangle >= 0, surface[hits.triangle], -1),
            "normal": hits.normal,
            "point_m": hits.point_m,
            "incidence_rad": hits.incidence_rad,
        }
        for kind, size_m in self.patches_m.items():
            columns[kind] = partial(self.reference.patch, hits, size_m)
        columns |= association.patches
        return Surface(hits.range_m, hits.normal, hits.incidence_rad < PARALLEL_RAD, columns)


@dataclass(frozen=True)
class PlaneSurface:
    """Planes found in the scans; each is itself unknown, as three numbers of one vector variable.

    Plane k is ``n.p = d`` with ``n ~ n0 + a side + b up`` and ``d = d0 + c``, where (a, b, c) are
    components 3k to 3k + 2.

    Args:
        planes: as found, in the reference frame at the start.
        variable: the vector variable's name.
    """

    planes: Planes
    variable: str

    @property
    def unknown(self) -> Variable:
        """The planes' numbers as a variable of the graph, free within half a radian and a metre."""
        count = len(self.planes.normal)
        kinds = ("tilt_1", "tilt_2", "distance")
        return Variable(
            self.variable,
            "vector",
            np.zeros(3 * count),
            np.tile([0.5, 0.5, 1.0], count),
            tuple(f"plane_{m}.{kind}" for m in range(count) for kind in kinds),
            ("rad", "rad", "m") * count,
        )

    @cached_property
    def axes(self) -> np.ndarray:
        """(M, 2, 3) two unit vectors in each plane as found."""
        side = transverse(self.planes.normal)
        return np.stack([side, np.cross(self.planes.normal, side)], axis=1)

    def associate(
        self, T: np.ndarray, beams: Beams, values: Values, near_edges: bool
    ) -> Association:
        """Plane of each beam, by where its point lies; -1 for none."""
        point = beams.origin_m + beams.range_m[:, None] * beams.direction
        return Association(self.planes.assign(se3.apply(T, point)).astype(np.int32))

    def meet(
        self, T: np.ndarray, beams: Beams, values: Values, association: Association
    ) -> Surface:
        """The plane that each beam meets under this association."""
        origins, directions = _in_reference(T, beams)
        part = association.part
        theta = values[self.variable].reshape(-1, 3)
        axes = self.axes
        tilted = self.planes.normal + np.einsum("mk,mki->mi", theta[:, :2], axes)
        length = np.linalg.norm(tilted, axis=1)
        unit = tilted / length[:, None]
        n, d = unit[part], (self.planes.distance_m + theta[:, 2])[part]
        along = np.einsum("ni,ni->n", n, directions)
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (d - np.einsum("ni,ni->n", n, origins)) / along
            hit = origins + t[:, None] * directions
        incidence = np.arccos(np.minimum(np.abs(along), 1.0))
        usable = (part >= 0) & (t > 0) & np.isfinite(t) & (incidence < PARALLEL_RAD)
        facing = np.where(along > 0, -1.0, 1.0)[:, None] * n
        columns = {"plane": part, "normal": facing, "point_m": hit, "incidence_rad": incidence}
        unknown = [self._by_tilt(k, part, hit, n, along, length, axes) for k in (0, 1)]
        unknown.append(self._columns(2, part, -1.0 / along))
        return Surface(t, facing, usable, columns, unknown)

    def _by_tilt(
        self,
        k: int,
        part: np.ndarray,
        hit: np.ndarray,
        n: np.ndarray,
        along: np.ndarray,
        length: np.ndarray,
        axes: np.ndarray,
    ) -> Columns:
        # d r / d n = hit / n.u, and n moves along the axis, less what renormalising takes back.
        axis = axes[:, k][part]
        across = axis - np.einsum("ni,ni->n", axis, n)[:, None] * n
        value = np.einsum("ni,ni->n", hit, across) / (along * length[part])
        return self._columns(k, part, value)

    def _columns(self, k: int, part: np.ndarray, value: np.ndarray) -> Columns:
        components = 3 * np.arange(len(self.planes.normal)) + k
        return Columns(self.variable, part, value, components)


def _in_reference(T: np.ndarray, beams: Beams) -> tuple[np.ndarray, np.ndarray]:
    return se3.apply(T, beams.origin_m), beams.direction @ T[:3, :3].T
