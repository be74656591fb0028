"""A surface from a scanned cloud: thinned, meshed by Poisson's equation, trimmed where thin."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from chains.errors import InputError
from sensors.meshes import distance_to_mesh, poisson_mesh, surface_normals

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

Array = NDArray[np.float64]

FINEST_VOXEL_M = 0.002  # about a scanner's range noise: finer points say nothing new. A choice
MOST_MESHED_POINTS = 1_500_000  # a choice: bounds memory and time of meshing
_DEPTHS = (5, 11)  # of the octree, a choice: a room of 8 m has cells of 0.3 m to 4 mm
# Poisson's equation needs a few points in each of its cells.
_SPACINGS_PER_CELL = 3.0
# Surface further from every point than that one is from its eighth neighbour has been invented:
# but not nearer than a cell, and in any case beyond this many.
_CELLS_BEYOND = 3.0
# As has surface on points thinner than the median's by this many halvings of the distance.
_LEVELS_BELOW = 3.0
_NEIGHBOURS = 16  # points that pull at a vertex, a choice: two rings about it on an even surface
_ALIKE = np.cos(np.radians(30.0))  # a choice: between noise of normals and a room's right angles
_HALF_KEY = 1 << 20  # three numbers of 21 bits fill a key of 63


class Thinner:
    """Means of a cloud's columns over voxels, scan by scan, in memory that does not grow with it.

    Voxels begin at `voxel_m` and double whenever there are more than `most`; a voxel is the union
    of eight of half the size, so sums of sums are exact.
    """

    def __init__(self, voxel_m: float = FINEST_VOXEL_M, most: int = MOST_MESHED_POINTS) -> None:
        self.voxel_m = voxel_m
        self.most = most
        self.count = 0
        self._base: Array | None = None
        self._cells: dict[int, tuple[NDArray[np.int64], Array]] = {}

    def add(self, scan: int, points_m: Array, columns: Array) -> None:
        """Add points (N, 3), m, with further columns (N, C), of one scan; C never changes.

        Raises InputError for points more than 2 km apart.
        """
        finite = np.isfinite(points_m).all(axis=1)
        points_m, columns = points_m[finite], columns[finite]
        if not len(points_m):
            return
        self.count += len(points_m)
        self._base = points_m[0].copy() if self._base is None else self._base
        local = points_m - self._base
        cell = np.floor(local / self.voxel_m).astype(np.int64) + _HALF_KEY
        if cell.min() < 0 or cell.max() >= 2 * _HALF_KEY:
            raise InputError("its points are kilometres apart, which is no room; see --length-unit")
        key = (cell[:, 0] << 42) | (cell[:, 1] << 21) | cell[:, 2]
        rows = np.column_stack([np.ones(len(local)), local, columns])
        keys, sums = self._cells.get(scan, (key[:0], rows[:0]))
        self._cells[scan] = _sum_alike(np.append(keys, key), np.concatenate([sums, rows]))
        while sum(len(keys) for keys, _ in self._cells.values()) > self.most:
            self._double()

    def means(self) -> tuple[NDArray[np.int64], Array, Array]:
        """Scan (M,), mean point (M, 3) in m, and mean columns (M, C) of every voxel."""
        scan = np.repeat(list(self._cells), [len(keys) for keys, _ in self._cells.values()])
        sums = np.concatenate([sums for _, sums in self._cells.values()])
        means = sums[:, 1:] / sums[:, :1]
        return scan, means[:, :3] + self._base, means[:, 3:]

    def _double(self) -> None:
        self.voxel_m *= 2
        for scan, (key, sums) in self._cells.items():
            mask = 2 * _HALF_KEY - 1
            cell = np.stack([key >> 42, key >> 21 & mask, key & mask]) - _HALF_KEY
            cell = (cell >> 1) + _HALF_KEY
            self._cells[scan] = _sum_alike(cell[0] << 42 | cell[1] << 21 | cell[2], sums)


def _sum_alike(key: NDArray[np.int64], rows: Array) -> tuple[NDArray[np.int64], Array]:
    """Distinct keys, ascending, and the sums of their rows."""
    order = np.argsort(key, kind="stable")
    key, rows = key[order], rows[order]
    first = np.flatnonzero(np.append(True, key[1:] != key[:-1]))
    return key[first], np.add.reduceat(rows, first, axis=0)


@dataclass(frozen=True)
class Rebuilt:
    """A surface made from a cloud, and how good it is.

    Args:
        vertices_m: (V, 3); triangles: (F, 3).
        intensity: (F,), None where the cloud has none.
        spacing_m: median distance of a point to the nearest other.
        cell_m: size of the finest cells of Poisson's equation.
        trimmed: share of the area that was invented, and taken away.
        distance_m: (M,) of the cloud's points from the surface.
    """

    vertices_m: Array
    triangles: NDArray[np.int64]
    intensity: Array | None
    spacing_m: float
    cell_m: float
    trimmed: float
    distance_m: Array


def rebuild(
    points_m: Array,
    facing: Array,
    intensity: Array | None,
    progress: Callable[[str, int, int], None],
) -> Rebuilt:
    """Mesh a cloud by Poisson's equation (Kazhdan and Hoppe, TOG 2013), and trim what it invents.

    Args:
        points_m: (M, 3), thinned.
        facing: (M, 3) a vector that the outside of the surface looks along: to the scanner.
        intensity: (M,) or None.
        progress: told of each of the four steps.

    Raises:
        InputError: fewer than 100 points, or no surface through them.
    """
    from scipy.spatial import cKDTree

    if len(points_m) < 100:
        raise InputError(f"{len(points_m)} points do not make a surface; a scan has thousands")
    centre_m = points_m.mean(axis=0)
    local_m = points_m - centre_m
    tree = cKDTree(local_m)
    some = local_m[:: max(1, len(local_m) // 20000)]
    spacing_m = float(np.median(tree.query(some, 2)[0][:, 1]))
    size_m = 1.1 * float(np.ptp(local_m, axis=0).max())
    wanted = np.log2(size_m / max(_SPACINGS_PER_CELL * spacing_m, 1e-9))
    depth = int(np.clip(np.round(wanted), *_DEPTHS))
    cell_m = size_m / 2**depth
    progress("finding normals", 0, 4)
    normal = surface_normals(local_m)
    normal *= np.where(np.einsum("ni,ni->n", normal, facing) < 0, -1.0, 1.0)[:, None]
    progress(f"meshing {len(local_m)} points", 1, 4)
    vertices, triangles, density = poisson_mesh(local_m, normal, depth)
    progress("trimming", 2, 4)
    reach_m = np.clip(tree.query(local_m, 8)[0][:, -1], cell_m, _CELLS_BEYOND * cell_m)
    away_m, nearest = tree.query(vertices)
    thin = away_m > reach_m[nearest]
    thin |= density < np.median(density) - _LEVELS_BELOW
    kept = triangles[~thin[triangles].any(axis=1)]
    if not len(kept):
        raise InputError("no surface goes through its points; is it a scan of surfaces?")
    trimmed = 1 - _area(vertices, kept) / _area(vertices, triangles)
    used, kept = np.unique(kept, return_inverse=True)
    vertices, kept = vertices[used], kept.reshape(-1, 3)
    vertices = _settle(vertices, kept, tree, normal, cell_m)
    progress("measuring distances", 3, 4)
    distance_m = distance_to_mesh(vertices, kept, local_m)
    middle = vertices[kept].mean(axis=1)
    bright = None if intensity is None else intensity[tree.query(middle, 4)[1]].mean(axis=1)
    return Rebuilt(
        vertices_m=vertices + centre_m,
        triangles=kept,
        intensity=bright,
        spacing_m=spacing_m,
        cell_m=cell_m,
        trimmed=float(trimmed),
        distance_m=distance_m,
    )


def _settle(
    vertices: Array, triangles: NDArray[np.int64], tree: cKDTree, normal: Array, most_m: float
) -> Array:
    """Vertices (V, 3), moved along their normals onto the points near them, by `most_m` at most.

    Poisson's surface bulges near edges by more than a scanner's noise. A vertex goes to the mean
    of the planes of its nearest points, those left out that face elsewhere: implicit moving least
    squares (Kolluri, SODA 2005) made robust as by Öztireli et al. (Eurographics 2009).
    """
    corners = vertices[triangles]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    facing = np.zeros_like(vertices)
    for corner in range(3):
        np.add.at(facing, triangles[:, corner], cross)
    facing /= np.maximum(np.linalg.norm(facing, axis=1, keepdims=True), 1e-30)
    away, near = tree.query(vertices, _NEIGHBOURS)
    weight = np.exp(-((1.5 * away / away[:, [-1]]) ** 2))
    weight *= np.einsum("vki,vi->vk", normal[near], facing) > _ALIKE
    off = np.einsum("vki,vki->vk", normal[near], tree.data[near] - vertices[:, None])
    total = weight.sum(axis=1)
    step = np.where(total > 0, (weight * off).sum(axis=1) / np.maximum(total, 1e-30), 0.0)
    return vertices + np.clip(step, -most_m, most_m)[:, None] * facing


def _area(vertices: Array, triangles: NDArray[np.int64]) -> float:
    corners = vertices[triangles]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return float(np.linalg.norm(cross, axis=1).sum()) / 2
