"""Flat patches found in the scans themselves, for rigs without a mesh.

Space is divided into cells. A stop's points in one cell are flat when they spread along two
directions and no further than noise along the third. Flat cells of all stops that agree are one:
first the same place seen from several stops, then neighbours, until whole planes are left.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from sensors.numbers import connected
from sensors.surfaces import SurfaceGrid

if TYPE_CHECKING:
    from scipy.spatial import KDTree

# Fewer points than this do not tell a flat cell from a bent one.
MIN_CELL_POINTS = 12
# Flat cells whose normals differ more than this are parts of different planes.
SAME_NORMAL_RAD = np.radians(6.0)
# What a sensor sees flatter than this is no plane: the points of a few rings, which fan out about
# it, lie in one through the sensor itself.
FLATTEST_PLANE_RAD = np.radians(80.0)
# How many of the nearest cells are looked at: enough for a corner, where several planes meet.
NEAREST_CELLS = 8


def _tree(points_m: np.ndarray) -> KDTree:
    from scipy.spatial import KDTree  # late, as a fit to a mesh needs none

    return KDTree(points_m)


@dataclass(frozen=True)
class Cells:
    """First and second moments of the points in C cells."""

    count: np.ndarray  # (C,)
    mean_m: np.ndarray  # (C, 3)
    covariance_m2: np.ndarray  # (C, 3, 3)

    @classmethod
    def of(cls, points_m: np.ndarray, cell: np.ndarray) -> Cells:
        """Moments of the points (N, 3) in each cell (N,), every one of which has some."""
        count = np.bincount(cell)

        def mean(values: np.ndarray) -> np.ndarray:
            return np.bincount(cell, values) / count

        mean_m = np.stack([mean(axis) for axis in points_m.T], axis=-1)
        away_m = (points_m - mean_m[cell]).T
        covariance_m2 = np.stack([[mean(a * b) for b in away_m] for a in away_m])
        return cls(count, mean_m, np.moveaxis(covariance_m2, -1, 0))

    @cached_property
    def _principal(self) -> tuple[np.ndarray, np.ndarray]:
        return np.linalg.eigh(self.covariance_m2)

    @property
    def spread_m(self) -> np.ndarray:
        """Standard deviations (C, 3) along the principal directions, the smallest first."""
        return np.sqrt(np.maximum(self._principal[0], 0.0))

    @property
    def normal(self) -> np.ndarray:
        """Direction (C, 3) of least spread, unit, of either sign."""
        return self._principal[1][:, :, 0]

    def take(self, index: np.ndarray) -> Cells:
        """The cells of an index or mask."""
        return Cells(self.count[index], self.mean_m[index], self.covariance_m2[index])

    def join(self, other: Cells) -> Cells:
        """These cells, then those."""
        return Cells(
            np.concatenate([self.count, other.count]),
            np.concatenate([self.mean_m, other.mean_m]),
            np.concatenate([self.covariance_m2, other.covariance_m2]),
        )

    def pool(self, group: np.ndarray) -> Cells:
        """Moments of all points of each group (G,), given the group (C,) of each cell.

        `cov = sum n (cov_i + d_i d_i') / sum n` with `d_i` from the group's mean to the cell's.
        """
        size = int(group.max(initial=-1)) + 1
        count, mean_m = np.bincount(group, self.count, size), np.zeros((size, 3))
        np.add.at(mean_m, group, (self.count / count[group])[:, None] * self.mean_m)
        away_m = self.mean_m - mean_m[group]
        second_m2 = self.covariance_m2 + away_m[:, :, None] * away_m[:, None, :]
        covariance_m2 = np.zeros((size, 3, 3))
        np.add.at(covariance_m2, group, (self.count / count[group])[:, None, None] * second_m2)
        return Cells(count, mean_m, covariance_m2)


@dataclass(frozen=True)
class Planes:
    """M planes `normal . p = distance_m`, each with the cells that it was seen in."""

    normal: np.ndarray  # (M, 3) unit
    distance_m: np.ndarray  # (M,) >= 0
    count: np.ndarray  # (M,) points
    cell_mean_m: np.ndarray  # (C, 3)
    cell_plane: np.ndarray  # (C,) plane of each cell
    cell_m: float
    tolerance_m: float

    def grid(self, axes: np.ndarray) -> SurfaceGrid:
        """A grid over the cells that each plane was seen in, along its axes (M, 2, 3)."""
        place_m = np.einsum("cki,ci->ck", axes[self.cell_plane], self.cell_mean_m)
        low, high = np.full((2, len(axes), 2), [[[np.inf]], [[-np.inf]]])
        np.minimum.at(low, self.cell_plane, place_m)
        np.maximum.at(high, self.cell_plane, place_m)
        return SurfaceGrid(axes, low - self.cell_m / 2, high - low + self.cell_m)

    def assign(self, points_world_m: np.ndarray) -> np.ndarray:
        """Plane (N,) int64 of each point (N, 3), or -1.

        The nearest plane that is no further than `tolerance_m` and was seen within 0.75 cells.
        """
        if not len(self.cell_mean_m):
            return np.full(len(points_world_m), -1)
        _, near = _tree(self.cell_mean_m).query(
            points_world_m, NEAREST_CELLS, distance_upper_bound=0.75 * self.cell_m, workers=-1
        )
        plane = np.append(self.cell_plane, -1)[near]
        off_m = np.einsum("nki,ni->nk", self.normal[plane], points_world_m)
        off_m = np.where(plane < 0, np.inf, np.abs(off_m - self.distance_m[plane]))
        best = off_m.argmin(axis=1)[:, None]
        within = np.take_along_axis(off_m, best, axis=1) <= self.tolerance_m
        return np.where(within, np.take_along_axis(plane, best, axis=1), -1)[:, 0]


class PlaneFinder:
    """Collects flat cells stop by stop, then joins them to planes; it keeps cells, never points.

    Args:
        cell_m: width of a cell; a plane must be wider than one.
        noise_m: range noise of one point (1 sigma).
        tolerance_m: how far, along the normal, two stops may disagree about one plane: poses may be
            off by about half of it. Parallel surfaces further apart than this plus the poses' own
            error stay two; closer ones may become one, and are dropped if that is no plane.
    """

    def __init__(
        self, cell_m: float = 0.3, noise_m: float = 0.01, tolerance_m: float = 0.045
    ) -> None:
        self.cell_m, self.noise_m, self.tolerance_m = cell_m, noise_m, tolerance_m
        self._cells = Cells(np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3, 3)))
        self._seen = [np.zeros((0, 2), dtype=np.int64)]

    def add(self, stop_index: int, points_world_m: np.ndarray, sensor_world_m: np.ndarray) -> None:
        """Take in one stop's points (N, 3), placed in the world as well as is known so far.

        Args:
            stop_index: whose they are.
            points_world_m: (N, 3).
            sensor_world_m: (3,) where they were seen from.
        """
        cells = cell_moments(points_world_m, self.cell_m)
        thick_m, narrow_m, _ = cells.spread_m.T
        away_m = cells.mean_m - sensor_world_m
        facing = np.abs(np.einsum("ci,ci->c", cells.normal, away_m))
        cells = cells.take(
            (cells.count >= MIN_CELL_POINTS)
            & (thick_m < 1.5 * self.noise_m)
            & (narrow_m > np.maximum(3 * thick_m, self.cell_m / 10))
            & (facing > np.cos(FLATTEST_PLANE_RAD) * np.linalg.norm(away_m, axis=1))
        )
        same = self._same_place(cells)
        known = len(self._cells.count)
        same[same < 0] = known + np.arange(np.count_nonzero(same < 0))
        self._cells = self._cells.join(cells).pool(np.append(np.arange(known), same))
        self._seen.append(np.column_stack([np.full(len(same), stop_index), same]))

    def planes(self, min_points: int = 200, min_stops: int = 1) -> Planes:
        """Planes of at least so many points, seen from at least so many stops; largest first."""
        cells = self._cells
        pairs = _tree(cells.mean_m).query_pairs(1.5 * self.cell_m, output_type="ndarray")
        a, b = pairs[self._apart_m(cells.take(pairs[:, 0]), cells.take(pairs[:, 1])) < np.inf].T
        plane = connected(len(cells.count), a, b)
        pooled = cells.pool(plane)
        kept = np.flatnonzero(
            (pooled.count >= min_points)
            & (self._stops(plane) >= min_stops)
            & (pooled.spread_m[:, 0] < self.tolerance_m / 2)
            # A row of single cells may be a step, and a single one a ball.
            & (pooled.spread_m[:, 1] > self.cell_m / 3)
        )
        kept = kept[np.argsort(-pooled.count[kept], kind="stable")]
        number = np.full(len(pooled.count), -1)
        number[kept] = np.arange(len(kept))
        part = number[plane] >= 0
        normal, mean_m = pooled.normal[kept], pooled.mean_m[kept]
        distance_m = np.einsum("mi,mi->m", normal, mean_m)
        side = np.where(distance_m < 0, -1.0, 1.0)
        return Planes(
            normal=normal * side[:, None],
            distance_m=distance_m * side,
            count=pooled.count[kept].astype(np.int64),
            cell_mean_m=cells.mean_m[part],
            cell_plane=number[plane][part],
            cell_m=self.cell_m,
            tolerance_m=self.tolerance_m,
        )

    def _same_place(self, cells: Cells) -> np.ndarray:
        """Which known cell (C,) each new one is another view of; -1 for none."""
        known = len(self._cells.count)
        if not known or not len(cells.count):
            return np.full(len(cells.count), -1)
        _, near = _tree(self._cells.mean_m).query(
            cells.mean_m, NEAREST_CELLS, distance_upper_bound=self.cell_m / 2
        )
        new, column = np.nonzero(near < known)
        apart_m = np.full(near.shape, np.inf)
        apart_m[new, column] = self._apart_m(cells.take(new), self._cells.take(near[new, column]))
        best = apart_m.argmin(axis=1)[:, None]
        agree = np.take_along_axis(apart_m, best, axis=1) < np.inf
        return np.where(agree, np.take_along_axis(near, best, axis=1), -1)[:, 0]

    def _apart_m(self, a: Cells, b: Cells) -> np.ndarray:
        """Offset (C,) of each pair of cells along their normals; inf where they disagree."""
        between_m = b.mean_m - a.mean_m
        apart_m = np.maximum(
            np.abs(np.einsum("ni,ni->n", a.normal, between_m)),
            np.abs(np.einsum("ni,ni->n", b.normal, between_m)),
        )
        parallel = np.abs(np.einsum("ni,ni->n", a.normal, b.normal)) > np.cos(SAME_NORMAL_RAD)
        return np.where(parallel & (apart_m < self.tolerance_m), apart_m, np.inf)

    def _stops(self, plane: np.ndarray) -> np.ndarray:
        """Number of stops that saw each plane, given the plane (C,) of each cell."""
        stop, cell = np.concatenate(self._seen).T
        views = np.unique(np.column_stack([plane[cell], stop]), axis=0)
        return np.bincount(views[:, 0], minlength=plane.max(initial=-1) + 1)


def cell_moments(points_world_m: np.ndarray, cell_m: float = 0.3) -> Cells:
    """Moments of the points (N, 3) in every cell of a cubic grid that has any."""
    index = np.floor(points_world_m / cell_m).astype(np.int64)
    index -= index.min(axis=0, initial=0)
    size = index.max(axis=0, initial=0) + 1
    _, cell = np.unique(np.ravel_multi_index(index.T, size), return_inverse=True)
    return Cells.of(points_world_m, cell)
