"""What the beams of a stop meet: the reference mesh, or planes found in the scans."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property, partial
from typing import ClassVar, Protocol

import numpy as np

from calib.effects import LazyColumn
from calib.forward import Values
from calib.residuals.beams import Association, Columns, Surface
from calib.residuals.compiled import meet_planes
from calib.residuals.groups import PATCH, REGION_PART, SURFACE, kind_and_number
from chains import se3
from sensors.lidar import Beams
from sensors.planes import Cells, Planes
from sensors.reference import Reference
from sensors.surfaces import SurfaceGrid, transverse

# A fit keeps no beam that meets its surface flatter than this: a choice; a millimetre of the
# surface is 6 mm of range there.
FLATTEST_FITTED_RAD = np.deg2rad(80.0)
PARALLEL_RAD = np.deg2rad(89.0)  # a choice: where it is 57 mm of range, nothing is measured
# Widths of the cells that surfaces are divided into, in a room whose box has 200 m2 of walls; in
# larger ones the cells grow alike, so that there are never many more of them. Patches of planes are
# as wide as the cells that planes are found in: within patches of 0.5 m the walls of the simulated
# labs are uneven enough for ring zeros of an XT32 to be 1.2 to 1.5 times their sigmas off.
PATCHES_M = {REGION_PART: 1.2, PATCH: 0.5}
PLANE_PATCHES_M = {REGION_PART: 1.2, PATCH: 0.3}
ROOM_M2 = 200.0


class Meeting(Protocol):
    """Something that beams meet. First associate, then meet: an association can be kept.

    Args:
        not_met: what is wrong where no beam of a scan meets it; the end of a sentence.
    """

    not_met: ClassVar[str]

    def surfaces(self, association: Association) -> np.ndarray: ...

    def tilting(self, kind: str, parts: np.ndarray) -> np.ndarray: ...

    def divided(self, T: np.ndarray, beams: Beams, part: np.ndarray) -> Association: ...

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
        without: kind of part -> numbers of those that are left out: a beam that meets one is not
            used.
    """

    reference: Reference
    footprint_rad: float
    without: Mapping[str, Collection[int]] = field(default_factory=dict)
    not_met: ClassVar[str] = (
        "meets a surface of the mesh; check the scan's units, the mesh's frame, and where the stop "
        "starts (base_guess, targets)"
    )

    @cached_property
    def patches_m(self) -> dict[str, float]:
        """Kind of patch -> its width, in this room."""
        return patch_widths_m(self.reference)

    @cached_property
    def roughness_m(self) -> np.ndarray:
        """Standard deviation (S,) m of each surface's corners across the plane that fits best."""
        mesh = self.reference
        corners_m = mesh.vertices_m[mesh.triangles].reshape(-1, 3)
        return Cells.of(corners_m, np.repeat(mesh.surface, 3)).spread_m[:, 0]

    def surface_of(self, kind: str, parts: np.ndarray) -> np.ndarray:
        """The surface that each of those parts is of; a surface is its own."""
        if kind == SURFACE:
            return parts
        return self.reference.patch_surface(self.patches_m[kind], kind == PATCH)[parts]

    def tilting(self, kind: str, parts: np.ndarray) -> np.ndarray:
        """How wide (P, 2) parts are along each axis of their surface; 0 where they do not tilt:
        regions as narrow as a patch, and surfaces as narrow as a region."""
        surface = self.surface_of(kind, parts)
        if kind == SURFACE:
            whole_m = self.reference.widths_m(np.inf)
            several = whole_m > self.reference.widths_m(self.patches_m[REGION_PART])
            return np.where(several, whole_m, 0.0)[surface]
        wide_m = _wide(self, self.reference, surface)
        return wide_m if kind == REGION_PART else np.zeros_like(wide_m)

    def surfaces(self, association: Association) -> np.ndarray:
        """The surface (N,) that each beam meets, -1 for none."""
        return self.reference.facts(association.part)[2]

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
            return Association(self._kept(T, beams, triangle))
        hits = self.reference.hits(triangle, origins, directions)
        spoilt = hits.incidence_rad > FLATTEST_FITTED_RAD
        spoilt |= self.reference.near_edge(origins, directions, hits, self.footprint_rad)
        return self.divided(T, beams, np.where(spoilt, -1, hits.triangle).astype(np.int32))

    def divided(self, T: np.ndarray, beams: Beams, part: np.ndarray) -> Association:
        """The triangles (N,) that beams meet from there, and the patches of them; -1 for one of a
        part that is left out."""
        part = self._kept(T, beams, part)
        met = _Met(T, beams, self.reference.planes, part)
        patches = {kind: self._patch(met, kind).astype(np.int32) for kind in self.patches_m}
        away_m = {
            kind: self.reference.from_middle_m(met.part, met.point_m, size_m).astype(np.float32)
            for kind, size_m in ((SURFACE, np.inf), (REGION_PART, self.patches_m[REGION_PART]))
        }
        return Association(part, patches, away_m)

    def meet(
        self, T: np.ndarray, beams: Beams, values: Values, association: Association
    ) -> Surface:
        """The triangle's plane that each beam meets under this association."""
        met = _Met(T, beams, self.reference.planes, association.part)
        facts = cache(lambda: self.reference.facts(met.part))
        columns = met.columns | {
            "label": lambda: facts()[0],
            "reference_intensity": lambda: facts()[1],
            "surface": lambda: facts()[2],
        }
        for kind in self.patches_m:
            columns[kind] = partial(self._patch, met, kind)
        return met.surface(columns | association.patches)

    def _kept(self, T: np.ndarray, beams: Beams, triangle: np.ndarray) -> np.ndarray:
        for kind, numbers in self.without.items():
            if numbers:
                gone = np.isin(self._number(kind, T, beams, triangle), [*numbers])
                triangle = np.where(gone, -1, triangle).astype(np.int32)
        return triangle

    def _number(self, kind: str, T: np.ndarray, beams: Beams, triangle: np.ndarray) -> np.ndarray:
        """Number (N,) of the part of a kind that each beam meets, -1 for none."""
        if kind == SURFACE:
            return self.reference.facts(triangle)[2]
        met = _Met(T, beams, self.reference.planes, triangle)
        return self._patch(met, kind)

    def _patch(self, met: _Met, kind: str) -> np.ndarray:
        """Patches (N,) of a kind. The finest are divided by the way they face: where a curved
        surface stands elsewhere as a whole, its offset along the normal differs over it, and would
        be taken for a shift of the whole mesh."""
        return self.reference.patch(met.part, met.point_m, self.patches_m[kind], kind == PATCH)


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
    not_met: ClassVar[str] = (
        "meets a plane, and planes are what was found in the scans, as there is no mesh; check "
        "where the stop starts (base_guess)"
    )

    @cached_property
    def axes(self) -> np.ndarray:
        """(M, 2, 3) two unit vectors in each plane as found."""
        side = transverse(self.planes.normal)
        return np.stack([side, np.cross(self.planes.normal, side)], axis=1)

    @cached_property
    def patches_m(self) -> dict[str, float]:
        """Kind of patch -> its width, in this room."""
        return _widths_m(PLANE_PATCHES_M, self.planes.cell_mean_m)

    @cached_property
    def _grid(self) -> SurfaceGrid:
        """Over the cells in which each plane was seen."""
        return self.planes.grid(self.axes)

    def surfaces(self, association: Association) -> np.ndarray:
        """The plane (N,) that each beam meets, -1 for none."""
        return association.part

    def surface_of(self, kind: str, parts: np.ndarray) -> np.ndarray:
        """The plane that each of those parts is of."""
        return self._grid.patch_surface(self.patches_m[kind])[parts]

    def tilting(self, kind: str, parts: np.ndarray) -> np.ndarray:
        """How wide (P, 2) regions are along each axis of their plane; 0 where they do not tilt, see
        `MeshSurface.tilting`. One that is all of its plane tilts with it."""
        if kind != REGION_PART:
            return np.zeros((len(parts), 2))
        surface = self.surface_of(kind, parts)
        several = self._grid.patches(self.patches_m[REGION_PART]) > 1
        return np.where(several[surface, None], _wide(self, self._grid, surface), 0.0)

    def divided(self, T: np.ndarray, beams: Beams, part: np.ndarray) -> Association:
        """The planes (N,) that beams meet from there, and the patches of them."""
        met = _Met(T, beams, _and_none(self.planes.normal, self.planes.distance_m), part)
        patches = {
            kind: self._patch(met, size_m).astype(np.int32)
            for kind, size_m in self.patches_m.items()
        }
        hit = np.flatnonzero(met.part >= 0)
        where = met.part[hit], met.point_m[hit], self.patches_m[REGION_PART]
        away_m = np.zeros((len(part), 2), np.float32)
        away_m[hit] = self._grid.from_middle_m(*where)
        return Association(part, patches, {REGION_PART: away_m})

    def associate(
        self, T: np.ndarray, beams: Beams, values: Values, near_edges: bool
    ) -> Association:
        """Plane of each beam, by where its point lies, -1 for none; near edges its patches too."""
        point = beams.origin_m + beams.range_m[:, None] * beams.direction
        part = self.planes.assign(se3.apply(T, point)).astype(np.int32)
        return self.divided(T, beams, part) if near_edges else Association(part)

    def meet(
        self, T: np.ndarray, beams: Beams, values: Values, association: Association
    ) -> Surface:
        """The plane that each beam meets under this association."""
        theta = values[self.variable].reshape(-1, 3)
        tilted = self.planes.normal + np.einsum("mk,mki->mi", theta[:, :2], self.axes)
        length = np.linalg.norm(tilted, axis=1)
        distance = self.planes.distance_m + theta[:, 2]
        plane = _and_none(tilted / length[:, None], distance)
        met = _Met(T, beams, plane, association.part)
        columns = met.columns | {"plane": association.part}
        for kind, size_m in self.patches_m.items():
            columns[kind] = partial(self._patch, met, size_m)
        return met.surface(columns | association.patches, partial(self._by_numbers, met, length))

    def _patch(self, met: _Met, size_m: float) -> np.ndarray:
        patch = np.full(len(met.part), -1)
        hit = np.flatnonzero(met.part >= 0)
        patch[hit] = self._grid.patch(met.part[hit], met.point_m[hit], size_m)
        return patch

    def _by_numbers(self, met: _Met, length: np.ndarray, range_m: np.ndarray) -> list[Columns]:
        """Derivatives by the three numbers of each plane: ``d r / d n = hit / n.u``, and n moves
        along an axis, less what renormalising takes back; the beams reach so far (N,) m."""
        part = met.association_part
        n = met.plane[part, :3]
        origins, directions = _in_reference(met.T, met.beams)
        hit = origins + range_m[:, None] * directions
        along = np.einsum("ni,ni->n", n, directions)
        along[along == 0.0] = np.inf  # nothing is met
        out = []
        for k in (0, 1):
            axis = self.axes[:, k][part]
            across = axis - np.einsum("ni,ni->n", axis, n)[:, None] * n
            value = np.einsum("ni,ni->n", hit, across) / (along * length[part])
            out.append(self._columns(k, part, value))
        return [*out, self._columns(2, part, -1.0 / along)]

    def _columns(self, k: int, part: np.ndarray, value: np.ndarray) -> Columns:
        components = 3 * np.arange(len(self.planes.normal)) + k
        return Columns(self.variable, part, value, components)


class _Met:
    """Beams against the planes that they meet; what is seldom asked is computed when asked.

    Args:
        T: (4, 4) T_reference_lidar.
        beams: N beams.
        plane: (M + 1, 4), the last met by no beam.
        part: (N,) which plane each beam meets; -1 for none.
    """

    def __init__(self, T: np.ndarray, beams: Beams, plane: np.ndarray, part: np.ndarray) -> None:
        self.T, self.beams, self.plane, self.association_part = T, beams, plane, part
        self.range_m, self.cosine, self.slope = meet_planes(
            T, beams.origin_m, beams.direction, plane, part
        )

    @cached_property
    def part(self) -> np.ndarray:
        """(N,) the plane, -1 where it is not ahead."""
        return np.where(np.isfinite(self.range_m), self.association_part, -1)

    @cached_property
    def point_m(self) -> np.ndarray:
        """(N, 3) where beams meet it, reference frame; infinite where they do not."""
        origins, directions = _in_reference(self.T, self.beams)
        with np.errstate(invalid="ignore"):
            point = origins + self.range_m[:, None] * directions
        return np.where(np.isfinite(self.range_m)[:, None], point, np.inf)

    @cached_property
    def normal(self) -> np.ndarray:
        """(N, 3) unit, facing the sensor, reference frame; zero where there is none."""
        return (self.slope * -self.cosine[:, None]) @ self.T[:3, :3].T

    @property
    def columns(self) -> dict[str, LazyColumn]:
        """What effects may ask of it."""
        return {
            "normal": lambda: self.normal,
            "point_m": lambda: self.point_m,
            "incidence_rad": cache(lambda: np.arccos(self.cosine)),
        }

    def surface(
        self,
        columns: Mapping[str, LazyColumn],
        unknown: Callable[[np.ndarray], Sequence[Columns]] = lambda range_m: (),
    ) -> Surface:
        """As rows want it."""
        usable = self.cosine > np.cos(PARALLEL_RAD)
        return Surface(
            predicted_m=self.range_m,
            cosine=self.cosine,
            slope=self.slope,
            usable=usable,
            columns=columns,
            unknown=unknown,
        )


def patch_widths_m(reference: Reference) -> dict[str, float]:
    """Kind of patch -> its width, on a mesh."""
    return _widths_m(PATCHES_M, reference.vertices_m)


def part_centre_m(reference: Reference, part: str) -> np.ndarray:
    """About where (3,) a part of the mesh is, called as `part_of_mesh` calls it."""
    kind, number = kind_and_number(part)
    if kind == SURFACE:
        return reference.surface_centre_m(number)
    return reference.patch_centre_m(number, patch_widths_m(reference)[kind])


def part_counts(reference: Reference) -> dict[str, int]:
    """How many parts of each kind a mesh has, counted from 0."""
    surfaces = {SURFACE: int(reference.surface.max()) + 1}
    widths_m = patch_widths_m(reference).items()
    return surfaces | {
        kind: len(reference.patch_surface(size_m, kind == PATCH)) for kind, size_m in widths_m
    }


def _wide(
    met: MeshSurface | PlaneSurface, grid: Reference | SurfaceGrid, surface: np.ndarray
) -> np.ndarray:
    """How wide (R, 2) regions of these surfaces are along each axis; 0 if as narrow as a patch."""
    widths_m = grid.widths_m(met.patches_m[REGION_PART])
    return np.where(widths_m > met.patches_m[PATCH], widths_m, 0.0)[surface]


def _widths_m(patches_m: Mapping[str, float], points_m: np.ndarray) -> dict[str, float]:
    """Kind of patch -> its width, in a room whose box holds the points (N, 3)."""
    length, width, height = np.ptp(points_m, axis=0)
    walls_m2 = 2.0 * (length * width + width * height + height * length)
    scale = max(1.0, float(np.sqrt(walls_m2 / ROOM_M2)))
    return {kind: scale * size_m for kind, size_m in patches_m.items()}


def _and_none(normal: np.ndarray, distance_m: np.ndarray) -> np.ndarray:
    """Planes (M + 1, 4), the last met by no beam."""
    return np.vstack([np.column_stack([normal, distance_m]), [[0.0, 0.0, 0.0, np.inf]]])


def _in_reference(T: np.ndarray, beams: Beams) -> tuple[np.ndarray, np.ndarray]:
    return se3.apply(T, beams.origin_m), beams.direction @ T[:3, :3].T
