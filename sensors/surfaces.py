"""A mesh's triangles as planes, as connected surfaces, and as patches of those surfaces."""

from dataclasses import dataclass

import numpy as np

from sensors.numbers import connected

# A triangle thinner than this has no normal: it is treated as a hole.
THINNEST_TRIANGLE_M = 1e-9
# Vertices closer than this are one vertex: meshes often repeat them, triangle by triangle.
SAME_VERTEX_M = 1e-6
# Across an edge that turns more than this, another surface begins.
SMOOTH_TURN_RAD = np.radians(30.0)
# Over how much normals are averaged before it is asked which way they face: a choice. Noise of 3 mm
# turns triangles of 20 mm by 16 degrees, and averages of so much by 4.
SMOOTHED_M = 0.05
# A surface is curved whose normals stand off their main direction by more than this, rms: a choice.
# A curtain's do by 18 degrees.
CURVED_RAD = np.radians(10.0)
# How far unit normals that face the same way are apart at most, along two axes: a choice, which
# makes nine ways of the waves of a curtain; and how many ways a surface faces at most, as where
# coarse triangles are so noisy that each faces its own.
ONE_WAY, MOST_WAYS = 0.1, 32


def triangle_planes(corners_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Planes [n, n.p] (F + 1, 4) and areas (F,) of triangles (F, 3, 3); no area, no plane.

    A hole, and the last row, is the plane that no beam meets: n = 0, n.p = inf.
    """
    edges = np.roll(corners_m, -1, axis=1) - corners_m
    cross = np.cross(edges[:, 0], edges[:, 1])
    twice_area = np.linalg.norm(cross, axis=1)
    solid = twice_area > THINNEST_TRIANGLE_M * np.linalg.norm(edges, axis=2).max(axis=1)
    plane = np.tile([0.0, 0.0, 0.0, np.inf], (len(corners_m) + 1, 1))
    normal = cross[solid] / twice_area[solid, None]
    plane[:-1][solid] = np.column_stack(
        [normal, np.einsum("ni,ni->n", normal, corners_m[solid].mean(axis=1))]
    )
    return plane, np.where(solid, twice_area / 2, 0.0)


def connected_surfaces(
    vertices_m: np.ndarray, triangles: np.ndarray, normal: np.ndarray, label: np.ndarray
) -> np.ndarray:
    """Surface (F,) int64 of each triangle: smooth across shared edges, and of one label.

    Args:
        vertices_m: (V, 3); vertices at the same place count as one.
        triangles: (F, 3) vertex indices, wound either way.
        normal: (F, 3) unit, by the right-hand rule; zero for a triangle without area, which
            stands alone.
        label: (F,).
    """
    first, second, alike = _shared_edges(_merge_vertices(vertices_m)[triangles])
    cos_turn = np.where(alike, 1.0, -1.0) * np.einsum("ni,ni->n", normal[first], normal[second])
    joined = (cos_turn > np.cos(SMOOTH_TURN_RAD)) & (label[first] == label[second])
    return connected(len(triangles), first[joined], second[joined])


@dataclass(frozen=True)
class SurfaceGrid:
    """A grid of patches in the tangent plane of each of S surfaces."""

    axes: np.ndarray  # (S, 2, 3) unit, in the tangent plane
    corner_m: np.ndarray  # (S, 2) lower corner along the axes
    size_m: np.ndarray  # (S, 2) extent along the axes

    @classmethod
    def over(
        cls, corners_m: np.ndarray, normal: np.ndarray, area_m2: np.ndarray, surface: np.ndarray
    ) -> "SurfaceGrid":
        """Grid over triangles: corners (F, 3, 3), unit normals (F, 3), areas (F,), surfaces (F,).

        The tangent plane stands across the main direction of the surface's normals, by area.
        """
        count = int(surface.max()) + 1
        moment = np.zeros((count, 3, 3))
        np.add.at(moment, surface, np.einsum("f,fi,fj->fij", area_m2, normal, normal))
        main = np.linalg.eigh(moment)[1][:, :, -1]
        side = transverse(main)
        axes = np.stack([side, np.cross(main, side)], axis=1)
        place_m = np.einsum("fki,fci->fck", axes[surface], corners_m)
        low, high = np.full((count, 2), np.inf), np.full((count, 2), -np.inf)
        np.minimum.at(low, surface, place_m.min(axis=1))
        np.maximum.at(high, surface, place_m.max(axis=1))
        return cls(axes, low, np.maximum(high - low, SAME_VERTEX_M))

    def patch(self, surface: np.ndarray, point_m: np.ndarray, cell_m: float) -> np.ndarray:
        """Patch (N,) int64, counted over all surfaces, of points (N, 3) on given surfaces (N,)."""
        cells = self._cells(cell_m)
        first = np.cumsum(cells.prod(axis=1)) - cells.prod(axis=1)
        _, at = self._steps(surface, point_m, cells)
        row, column = at.T
        return first.take(surface) + row * cells[:, 1].take(surface) + column

    def from_middle_m(self, surface: np.ndarray, point_m: np.ndarray, cell_m: float) -> np.ndarray:
        """How far (N, 2) points (N, 3) on given surfaces (N,) are from the middle of their patch,
        along the axes of its surface."""
        cells = self._cells(cell_m)
        steps, at = self._steps(surface, point_m, cells)
        return (steps - at - 0.5) * self.widths_m(cell_m).take(surface, axis=0)

    def widths_m(self, cell_m: float) -> np.ndarray:
        """How wide (S, 2) the patches of each surface are along its axes."""
        return self.size_m / self._cells(cell_m)

    def patches(self, cell_m: float) -> np.ndarray:
        """How many patches (S,) each surface has."""
        return self._cells(cell_m).prod(axis=1)

    def patch_surface(self, cell_m: float) -> np.ndarray:
        """Surface (P,) int64 of every patch."""
        return np.repeat(np.arange(len(self.size_m)), self.patches(cell_m))

    def centre(self, patch: int, cell_m: float) -> tuple[int, np.ndarray]:
        """The surface that a patch is of, and its middle (2,) along that one's axes."""
        cells, surface = self._cells(cell_m), int(self.patch_surface(cell_m)[patch])
        first = int(cells[:surface].prod(axis=1).sum())
        step = np.array(divmod(patch - first, int(cells[surface, 1]))) + 0.5
        return surface, self.corner_m[surface] + step * self.size_m[surface] / cells[surface]

    def _steps(
        self, surface: np.ndarray, point_m: np.ndarray, cells: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """How many cells (N, 2) points (N, 3) on given surfaces (N,) are from the corner along each
        axis, and the last cells (N, 2) int64 that begin before them."""
        per_m = cells / self.size_m
        along = (self.axes * per_m[:, :, None]).take(surface, axis=0)
        steps = np.einsum("nki,ni->nk", along, point_m)
        steps -= (self.corner_m * per_m).take(surface, axis=0)
        return steps, np.clip(steps, 0, cells.take(surface, axis=0) - 1).astype(np.int64)

    def _cells(self, cell_m: float) -> np.ndarray:
        """Cells (S, 2) along the axes, each about `cell_m` wide: no slivers at the far rim."""
        return np.maximum(1, np.rint(self.size_m / cell_m)).astype(np.int64)


@dataclass(frozen=True)
class Ways:
    """Which way each of F triangles faces, on those of S surfaces that are curved. One that is
    wound otherwise than its neighbours faces another way."""

    way: np.ndarray  # (F,) its number among the ways of its surface; 0 on a flat one
    count: np.ndarray  # (S,) how many ways a surface faces; 1 of a flat one

    @classmethod
    def over(
        cls,
        axes: np.ndarray,
        middle_m: np.ndarray,
        normal: np.ndarray,
        area_m2: np.ndarray,
        surface: np.ndarray,
    ) -> "Ways":
        """Of surfaces with these axes (S, 2, 3), and triangles: middles and unit normals (F, 3),
        areas (F,), surfaces (F,)."""
        axes = np.concatenate([axes, np.cross(axes[:, 0], axes[:, 1])[:, None]], axis=1)[surface]
        along = np.einsum("fij,fj->fi", axes, normal)  # the last along the main direction
        cell = np.floor(np.einsum("fij,fj->fi", axes[:, :2], middle_m) / SMOOTHED_M)
        there = np.column_stack([surface, along[:, 2] > 0, cell]).astype(np.int64)
        along = _averages(along, area_m2, there)
        spread = np.bincount(surface, area_m2 * np.square(along[:, :2]).sum(axis=1))
        curved = spread > np.sin(CURVED_RAD) ** 2 * np.bincount(surface, area_m2)
        way, count = np.zeros(len(surface), np.int64), np.ones(len(curved), np.int64)
        mine = np.flatnonzero(curved[surface])
        mine = mine[np.argsort(surface[mine], kind="stable")]
        for some in np.split(mine, np.flatnonzero(np.diff(surface[mine])) + 1) if len(mine) else ():
            way[some] = _ways(along[some])
            count[surface[some[0]]] = way[some].max() + 1
        return cls(way, count)

    def patch(
        self, whole: np.ndarray, triangle: np.ndarray, surface: np.ndarray, cells: np.ndarray
    ) -> np.ndarray:
        """Patches (N,), those of curved surfaces divided by the way they face. The parts are
        counted after all patches that are whole.

        Args:
            whole: (N,) patches as the grid has them.
            triangle, surface: (N,) on which each is.
            cells: (S,) how many patches the grid has on each surface.
        """
        first, start = np.cumsum(cells) - cells, self._start(cells)
        parts = start[surface] + (whole - first[surface]) * self.count[surface]
        return np.where(self.count[surface] > 1, parts + self.way[triangle], whole)

    def surfaces(self, cells: np.ndarray) -> np.ndarray:
        """The surface (P,) of every patch, and then of every part of a divided one."""
        every = np.arange(len(cells))
        return np.concatenate([np.repeat(every, cells), np.repeat(every, self._apart(cells))])

    def whole(self, patch: int, cells: np.ndarray) -> int:
        """The patch of which that one is a part."""
        surface, start = int(self.surfaces(cells)[patch]), self._start(cells)
        first = int(cells[:surface].sum())
        return first + (patch - int(start[surface])) // int(self.count[surface])

    def _apart(self, cells: np.ndarray) -> np.ndarray:
        return np.where(self.count > 1, cells * self.count, 0)

    def _start(self, cells: np.ndarray) -> np.ndarray:
        apart = self._apart(cells)
        return cells.sum() + np.cumsum(apart) - apart


def _averages(normal: np.ndarray, area_m2: np.ndarray, cell: np.ndarray) -> np.ndarray:
    """Unit normals (F, 3), each that of all in its cell (F, k), by area."""
    cell = cell - cell.min(axis=0)
    _, at = np.unique(np.ravel_multi_index(cell.T, cell.max(axis=0) + 1), return_inverse=True)
    sums = np.stack([np.bincount(at, area_m2 * each) for each in normal.T], axis=1)
    return (sums / np.maximum(np.linalg.norm(sums, axis=1), 1e-300)[:, None])[at]


def _ways(normal: np.ndarray) -> np.ndarray:
    """Numbers (F,) of the ways that triangles of one surface face, by normals (F, 3) along its
    axes; coarser ones where there would be too many."""
    width, number = ONE_WAY, np.full(1, MOST_WAYS)
    while number.max() >= MOST_WAYS:
        steps = np.column_stack([np.rint(normal[:, :2] / width), normal[:, 2] > 0])
        number = np.unique(steps, axis=0, return_inverse=True)[1].ravel()
        width *= 2.0
    return number


def transverse(directions: np.ndarray) -> np.ndarray:
    """A unit vector (N, 3) at right angles to each direction (N, 3)."""
    furthest_axis = np.eye(3)[np.argmin(np.abs(directions), axis=1)]
    across = np.cross(directions, furthest_axis)
    return across / np.linalg.norm(across, axis=1, keepdims=True)


def _merge_vertices(vertices_m: np.ndarray) -> np.ndarray:
    """Number (V,) of each vertex, the same for vertices at the same place."""
    place = np.rint((vertices_m - vertices_m.mean(axis=0)) / SAME_VERTEX_M).astype(np.int64)
    order = np.lexsort(place.T)
    moved = np.any(np.diff(place[order], axis=0) != 0, axis=1)
    number = np.empty(len(vertices_m), dtype=np.int64)
    number[order] = np.append(0, np.cumsum(moved))
    return number


def _shared_edges(triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """All pairs of triangles (n,), (n,) that share an edge, and whether they are wound alike."""
    start, end = triangles.ravel(), np.roll(triangles, -1, axis=1).ravel()
    low, high = np.minimum(start, end), np.maximum(start, end)
    order = np.lexsort((high, low))
    low, high, forward, owner = low[order], high[order], (start < end)[order], order // 3
    pairs = [(owner[:0], owner[:0], forward[:0])]
    step = 1
    # An edge may have more than two triangles: compare the sorted edges one step on, then two, ...
    while (same := (low[step:] == low[:-step]) & (high[step:] == high[:-step])).any():
        i = np.flatnonzero(same)
        # Neighbours wound alike run along their shared edge in opposite senses.
        pairs.append((owner[i], owner[i + step], forward[i] != forward[i + step]))
        step += 1
    first, second, alike = (np.concatenate(part) for part in zip(*pairs, strict=True))
    return first, second, alike
