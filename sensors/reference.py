"""The reference surface: the scanned mesh, what a beam meets on it, and which of it is one surface.

The ray caster (Embree, in float32) only says *which* triangle a ray meets first, on the mesh moved
to its own centre. Range, point, normal and incidence are then computed in float64 from that
triangle's plane, so a residual and its derivatives agree as doubles wherever the mesh lies.
"""

import hashlib
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from chains.errors import InputError
from sensors.meshes import ray_caster, read_mesh
from sensors.surfaces import SurfaceGrid, Ways, connected_surfaces, transverse, triangle_planes

# A probe that lands further than this from the plane of the hit has crossed a depth edge.
DEPTH_STEP_M = 0.02
# A mesh wider than this is in millimetres.
WIDEST_MESH_M = 1000.0


@dataclass(frozen=True)
class Hits:
    """Where N beams meet the reference, in its frame.

    A miss has triangle -1, label -1, range and point infinite, a zero normal, incidence pi / 2.
    The intensity is NaN on a miss and where the reference states none.
    """

    triangle: np.ndarray  # (N,) int64
    range_m: np.ndarray  # (N,)
    point_m: np.ndarray  # (N, 3)
    normal: np.ndarray  # (N, 3) unit, facing the sensor
    incidence_rad: np.ndarray  # (N,) 0 where the beam meets the surface head-on
    label: np.ndarray  # (N,) int64
    intensity: np.ndarray  # (N,)


class Reference:
    """A triangle mesh with a label and an intensity per triangle, in the reference frame, metres.

    Args:
        vertices_m: (V, 3).
        triangles: (F, 3) vertex indices.
        label: (F,) integers; none means one label, 0.
        intensity: (F,); none means NaN.
        label_names: name of each label; a label without one is called `label_<n>`.

    Raises:
        InputError: the arrays do not fit each other, a vertex is not finite, no triangle has area.
    """

    def __init__(
        self,
        vertices_m: ArrayLike,
        triangles: ArrayLike,
        label: ArrayLike | None = None,
        intensity: ArrayLike | None = None,
        label_names: dict[int, str] | None = None,
    ) -> None:
        self.vertices_m = np.ascontiguousarray(vertices_m, dtype=np.float64)
        self.triangles = np.ascontiguousarray(triangles, dtype=np.int64)
        _check_mesh(self.vertices_m, self.triangles)
        count = len(self.triangles)
        label = _per_triangle(label, 0, count, "label")
        if np.any((label < 0) | (label != np.floor(label))):
            raise InputError("a label is no whole number, 0 or more.")
        # One row more than there are triangles: index -1, the miss, finds it.
        self._label = np.append(label, -1).astype(np.int64)
        self._intensity = np.append(_per_triangle(intensity, np.nan, count, "intensity"), np.nan)
        self._plane, self.area_m2 = triangle_planes(self.vertices_m[self.triangles])
        if not self.area_m2.any():
            raise InputError("the mesh has no triangle with an area; a surface is needed.")
        self.label_names = {
            int(n): (label_names or {}).get(int(n), f"label_{n}") for n in np.unique(self.label)
        }

    @classmethod
    def read(
        cls, mesh: Path | str, faces: Path | str | None = None, labels: Path | str | None = None
    ) -> "Reference":
        """Read a mesh (PLY, OBJ, STL) with its columns per triangle and its label names.

        Args:
            mesh: the file; double precision is kept.
            faces: table with one row per triangle, in order: `label`, `intensity`, either or both.
            labels: YAML of `number: name`.

        Raises:
            InputError: a file is missing, unreadable, or does not fit the others.
        """
        arrays = read_mesh(Path(mesh))
        columns = {} if faces is None else _read_faces(Path(faces))
        names = None if labels is None else _read_labels(Path(labels))
        try:
            return cls(*arrays, columns.get("label"), columns.get("intensity"), names)
        except InputError as error:
            files = mesh if faces is None else f"{mesh} with {faces}"
            raise InputError(f"{files}: {error}") from None

    @property
    def planes(self) -> np.ndarray:
        """Plane [n, n.p] (F + 1, 4) of each triangle; the last, and any without area, is met by no
        beam."""
        return self._plane

    @property
    def label(self) -> np.ndarray:
        """Label (F,) of each triangle."""
        return self._label[:-1]

    @property
    def intensity(self) -> np.ndarray:
        """Intensity (F,) of each triangle, NaN where none is stated."""
        return self._intensity[:-1]

    def cast(self, origins_m: np.ndarray, directions: np.ndarray, nthreads: int = 0) -> Hits:
        """First hit of each beam; beams in scan order are about twice as fast as shuffled ones.

        Args:
            origins_m: (N, 3) or (3,), in the reference frame.
            directions: (N, 3) unit vectors.
            nthreads: 0 means all.
        """
        return self.hits(
            self.first_triangle(origins_m, directions, nthreads), origins_m, directions
        )

    def hits(self, triangle: np.ndarray, origins_m: np.ndarray, directions: np.ndarray) -> Hits:
        """Where beams meet the planes of given triangles, each plane extended without end.

        `range = (n.p - n.o) / n.d` for a plane through p with normal n. A plane behind the sensor,
        or along the beam, is a miss.

        Args:
            triangle: (N,) triangle indices, -1 for none.
            origins_m: (N, 3) or (3,), in the reference frame.
            directions: (N, 3) unit vectors.
        """
        origins_m = np.broadcast_to(origins_m, directions.shape)
        plane = self._plane.take(triangle, axis=0)
        along = _dot(plane, directions)
        with np.errstate(divide="ignore", invalid="ignore"):
            range_m = (plane[:, 3] - _dot(plane, origins_m)) / along
            point_m = np.einsum("n,ni->ni", range_m, directions) + origins_m
        normal = np.einsum("n,ni->ni", np.where(along > 0, -1.0, 1.0), plane[:, :3])
        incidence_rad = np.arccos(np.minimum(np.abs(along), 1.0))
        missed = np.flatnonzero(~((range_m > 0) & (range_m < np.inf)))
        if len(missed):
            triangle = np.array(triangle, dtype=np.int64)
            triangle[missed] = -1
            range_m[missed] = np.inf
            point_m[missed] = np.inf
            normal[missed] = 0.0
            incidence_rad[missed] = np.pi / 2
        return Hits(
            triangle=triangle,
            range_m=range_m,
            point_m=point_m,
            normal=normal,
            incidence_rad=incidence_rad,
            label=self._label[triangle],
            intensity=self._intensity[triangle],
        )

    def near_edge(
        self, origins_m: np.ndarray, directions: np.ndarray, hits: Hits, angle_rad: ArrayLike
    ) -> np.ndarray:
        """Whether a beam turned to any of four sides leaves the plane that the beam itself hit.

        Such a beam may see two surfaces at once: a mixed pixel. A turned beam leaves the plane
        when it misses, or lands more than 0.02 m off it.

        Args:
            origins_m: (N, 3) or (3,), in the reference frame.
            directions: (N, 3) unit vectors.
            hits: where those beams hit.
            angle_rad: how far to turn, scalar or (N,).

        Returns:
            (N,) bool, False where the beam itself missed.
        """
        origins_m = np.broadcast_to(origins_m, directions.shape)
        plane = self._plane.take(hits.triangle, axis=0)
        near = np.zeros(len(directions), dtype=bool)
        side = np.tan(np.asarray(angle_rad)).reshape(-1, 1) * transverse(directions)
        up = np.cross(directions, side)
        for turn in (side, -side, up, -up):
            turned = directions + turn
            turned /= np.linalg.norm(turned, axis=1, keepdims=True)
            landed = self._plane.take(self.first_triangle(origins_m, turned), axis=0)
            with np.errstate(divide="ignore", invalid="ignore"):
                range_m = (landed[:, 3] - _dot(landed, origins_m)) / _dot(landed, turned)
                off_m = _dot(plane, origins_m) + range_m * _dot(plane, turned) - plane[:, 3]
                near |= ~(np.abs(off_m) <= DEPTH_STEP_M)
        return near & (hits.triangle >= 0)

    @cached_property
    def digest(self) -> str:
        """Of its triangles and their labels, by which its parts are numbered."""
        sha = hashlib.sha256()
        for each in (self.vertices_m, self.triangles, self.label):
            sha.update(np.ascontiguousarray(each).tobytes())
        return sha.hexdigest()

    @cached_property
    def surface(self) -> np.ndarray:
        """Surface (F,) int64 of each triangle, counted from 0.

        Triangles of one label that share an edge, across which the normal turns less than 30
        degrees, belong to one surface. Triangles without area each stand alone.
        """
        return connected_surfaces(self.vertices_m, self.triangles, self._normal, self.label)

    def patch(
        self,
        triangle: np.ndarray,
        point_m: np.ndarray,
        size_m: float = 0.7,
        by_way: bool = False,
    ) -> np.ndarray:
        """Patch (N,) int64 of each hit: a cell of about `size_m` of its surface's tangent plane.

        Patches are counted over all surfaces; -1 where the beam missed.

        Args:
            triangle: (N,) that was hit; -1 for none.
            point_m: (N, 3) where.
            size_m: about how wide a patch is.
            by_way: whether patches of curved surfaces are divided by the way they face.
        """
        patch = np.full(len(triangle), -1, dtype=np.int64)
        hit = np.flatnonzero(triangle >= 0)
        mine = triangle[hit]
        patch[hit] = self._grid.patch(self.surface[mine], point_m[hit], size_m)
        if by_way:
            cells = self._grid.patches(size_m)
            patch[hit] = self._ways.patch(patch[hit], mine, self.surface[mine], cells)
        return patch

    def from_middle_m(self, triangle: np.ndarray, point_m: np.ndarray, size_m: float) -> np.ndarray:
        """How far (N, 2) each hit is from the middle of its patch, along the axes of its surface's
        tangent plane; 0 where the beam missed. Arguments as of `patch`."""
        away_m = np.zeros((len(triangle), 2))
        hit = np.flatnonzero(triangle >= 0)
        surface = self.surface[triangle[hit]]
        away_m[hit] = self._grid.from_middle_m(surface, point_m[hit], size_m)
        return away_m

    def widths_m(self, size_m: float) -> np.ndarray:
        """How wide (S, 2) the patches of that size are on each surface, along the same axes."""
        return self._grid.widths_m(size_m)

    def facts(self, triangle: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Label, intensity and surface (N,) of triangles (N,); -1, NaN and -1 of triangle -1."""
        surface = np.where(triangle >= 0, self.surface[triangle], -1)
        return self._label[triangle], self._intensity[triangle], surface

    def patch_surface(self, size_m: float = 0.7, by_way: bool = False) -> np.ndarray:
        """Surface (P,) int64 of every patch that `patch` can return for that size."""
        if by_way:
            return self._ways.surfaces(self._grid.patches(size_m))
        return self._grid.patch_surface(size_m)

    def surface_centre_m(self, surface: int) -> np.ndarray:
        """The centre (3,) of a surface, by area."""
        mine = self.surface == surface
        centres_m = self.vertices_m[self.triangles[mine]].mean(axis=1)
        return np.average(centres_m, axis=0, weights=self.area_m2[mine])

    def patch_centre_m(self, patch: int, size_m: float) -> np.ndarray:
        """The middle (3,) of a patch of that size: the centre of the triangles in it, or of its
        cell where these are larger."""
        cells = self._grid.patches(size_m)
        whole = patch if patch < cells.sum() else self._ways.whole(patch, cells)
        surface, middle_m = self._grid.centre(whole, size_m)
        mine = np.flatnonzero(self.surface == surface)
        middles_m = self.vertices_m[self.triangles[mine]].mean(axis=1)
        there = self.patch(mine, middles_m, size_m, by_way=patch != whole)
        here = (there == patch) & (self.area_m2[mine] > 0)
        if here.any():
            return np.average(middles_m[here], axis=0, weights=self.area_m2[mine[here]])
        axes, centre_m = self._grid.axes[surface], self.surface_centre_m(surface)
        return centre_m + (middle_m - axes @ centre_m) @ axes

    @cached_property
    def _ways(self) -> Ways:
        middle_m = self.vertices_m[self.triangles].mean(axis=1)
        return Ways.over(self._grid.axes, middle_m, self._normal, self.area_m2, self.surface)

    @property
    def _normal(self) -> np.ndarray:
        return self._plane[:-1, :3]

    @cached_property
    def _grid(self) -> SurfaceGrid:
        corners_m = self.vertices_m[self.triangles]
        return SurfaceGrid.over(corners_m, self._normal, self.area_m2, self.surface)

    @cached_property
    def _solid(self) -> np.ndarray:
        """Triangles that a ray can hit, then -1: where the ray caster's "no triangle" is sent."""
        return np.append(np.flatnonzero(self.area_m2), -1)

    @cached_property
    def _centre_m(self) -> np.ndarray:
        return self.vertices_m[self.triangles].mean(axis=(0, 1))

    @cached_property
    def _scene(self) -> Any:
        return ray_caster(self.vertices_m - self._centre_m, self.triangles[self._solid[:-1]])

    def first_triangle(
        self, origins_m: np.ndarray, directions: np.ndarray, nthreads: int = 0
    ) -> np.ndarray:
        """Triangle (N,) that each beam hits first, -1 for none; arguments as of `cast`."""
        rays = np.empty((len(directions), 6), dtype=np.float32)
        rays[:, :3] = origins_m - self._centre_m
        rays[:, 3:] = directions
        primitive = self._scene.cast_rays(rays, nthreads=nthreads)["primitive_ids"].numpy()
        return self._solid[np.minimum(primitive, len(self._solid) - 1)]

    def distance_m(self, points_m: np.ndarray) -> np.ndarray:
        """Distance (N,) of points (N, 3) in the reference frame from the nearest triangle."""
        points = (points_m - self._centre_m).astype(np.float32)
        closest = self._scene.compute_closest_points(points)
        triangle = self._solid[closest["primitive_ids"].numpy()]
        # Float32 says which triangle and where on it; the offset across its plane is a double.
        across = _dot(self._plane.take(triangle, axis=0), points_m) - self._plane[triangle, 3]
        beside = points - closest["points"].numpy()
        beside -= _dot(self._plane.take(triangle, axis=0), beside)[:, None] * self._normal[triangle]
        return np.hypot(across, np.linalg.norm(beside, axis=1))

    def __getstate__(self) -> dict[str, Any]:
        """Without the ray caster's own scene, which cannot travel between processes."""
        return {name: value for name, value in self.__dict__.items() if name != "_scene"}


def _read_faces(path: Path) -> dict[str, np.ndarray]:
    from sensors.recording import read_table

    columns = read_table(path)
    if not {"label", "intensity"} & columns.keys():
        raise InputError(f"{path}: has neither of the columns label and intensity.")
    return columns


def _read_labels(path: Path) -> dict[int, str]:
    from sensors.documents import read_yaml

    data, _ = read_yaml(path)
    if not isinstance(data, dict) or not all(type(number) is int for number in data):
        raise InputError(f"{path}: each line should read `number: name`, as in `0: floor`.")
    return {number: str(name) for number, name in data.items()}


def _check_mesh(vertices_m: np.ndarray, triangles: np.ndarray) -> None:
    for what, array in (("vertices", vertices_m), ("triangles", triangles)):
        if array.ndim != 2 or array.shape[1] != 3 or not len(array):
            raise InputError(f"the mesh's {what} have shape {array.shape}; (n, 3) is needed.")
    if not np.isfinite(vertices_m).all():
        row = int(np.flatnonzero(~np.isfinite(vertices_m).all(axis=1))[0])
        raise InputError(f"vertex {row} of the mesh is not finite.")
    size_m = np.ptp(vertices_m, axis=0).max()
    if size_m > WIDEST_MESH_M:
        raise InputError(
            f"the mesh is {size_m:.0f} m wide, which looks like millimetres; give metres."
        )
    stray = triangles[(triangles < 0) | (triangles >= len(vertices_m))]
    if len(stray):
        raise InputError(
            f"a triangle names vertex {stray[0]}, but the vertices are 0 to {len(vertices_m) - 1}."
        )


def _per_triangle(values: ArrayLike | None, default: float, count: int, what: str) -> np.ndarray:
    values = np.full(count, default) if values is None else np.asarray(values, dtype=np.float64)
    if values.shape != (count,):
        raise InputError(
            f"{what} has shape {values.shape}, but the mesh has {count} triangles: give one each."
        )
    return values


def _dot(plane: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """n.v (N,) of planes [n, n.p] (N, 4) and vectors (N, 3)."""
    return np.einsum("ni,ni->n", plane[:, :3], vectors)
