"""Where the beams of a LiDAR start, from its points alone.

The points of one ring lie on a cone: with horizontal distance h from the axis, height z, and t the
tangent of the ring's elevation, z = z0 + t (h - n), where n is how far from the axis beams start
and z0 how high. Of each ring a line is fitted, z = t h + c; over the rings, c = z0 - n t. Range
errors move points along their line and bias nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sensors.readers.base import Array

_LEAST_POINTS = 50
"""Of a ring: a choice; a line through so many is known to a seventh of their scatter."""
_LEAST_RINGS = 6
"""A choice: three times the two numbers that are fitted over them."""
_MOST_RINGS = 256
"""What has more rows is a scanner that nods, whose rows are no cones about the axis it turns on."""


@dataclass(frozen=True)
class BeamOrigin:
    """Where beams start, m: out from the axis, and above the frame's origin; with their sigmas."""

    radial_m: float
    height_m: float
    sigma_radial_m: float
    sigma_height_m: float

    @property
    def aside_m(self) -> float:
        """How far from the axis beams start, 0 where that is not proven."""
        proven = abs(self.radial_m) > max(0.002, 5 * self.sigma_radial_m)
        return self.radial_m if proven else 0.0

    @property
    def above_m(self) -> float:
        """How far above the frame's origin beams start, 0 where that is not proven."""
        proven = abs(self.height_m) > max(0.005, 5 * self.sigma_height_m)
        return self.height_m if proven else 0.0


def fit_beam_origin(xyz_m: Array, ring: NDArray[np.int64]) -> BeamOrigin | None:
    """Fit where the beams of points (N, 3) m start; None where the points do not tell.

    They do not where a ring sees one distance only, where rings do not lie on cones (each laser at
    a height of its own), or where too few or too many rings have points enough.
    """
    flat_m, z_m = np.hypot(xyz_m[:, 0], xyz_m[:, 1]), xyz_m[:, 2]
    if ring.max() >= _MOST_RINGS:
        return None
    kept, rings = np.ones(len(z_m), bool), int(ring.max()) + 1
    for _ in range(3):  # a stray point is one that lies far from its ring's line
        slope, level, sigma_level, sigma = _lines(flat_m[kept], z_m[kept], ring[kept], rings)
        miss = np.abs(z_m - slope[ring] * flat_m - level[ring])
        kept = miss < 4 * np.maximum(sigma[ring], 1e-5)
    told = np.isfinite(sigma_level)
    if told.sum() < _LEAST_RINGS:
        return None
    return _over_rings(slope[told], level[told], sigma_level[told])


def _over_rings(slope: Array, level: Array, sigma: Array) -> BeamOrigin | None:
    """Fit level = height - radial * slope, weighing rings by their sigmas."""
    design = np.stack([-slope, np.ones_like(slope)], axis=1) / sigma[:, None]
    target = level / sigma
    solution, *_ = np.linalg.lstsq(design, target)
    left = target - design @ solution
    excess = max(1.0, float(left @ left) / (len(left) - 2))
    spread = np.sqrt(np.diag(np.linalg.inv(design.T @ design)) * excess)
    misses_m = np.abs(level - design @ solution * sigma)
    if np.median(misses_m) > 0.003 or spread[0] > 0.003:
        return None
    return BeamOrigin(*solution.tolist(), *spread.tolist())


def _lines(
    flat_m: Array, z_m: Array, ring: NDArray, size: int
) -> tuple[Array, Array, Array, Array]:
    """Per ring (size,) slope, level at the axis, its sigma and the scatter, m; NaN = none."""
    count = np.bincount(ring, minlength=size).astype(float)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean_h = np.bincount(ring, flat_m, size) / count
        mean_z = np.bincount(ring, z_m, size) / count
        h, z = flat_m - mean_h[ring], z_m - mean_z[ring]
        hh = np.bincount(ring, h * h, size)
        slope = np.bincount(ring, h * z, size) / hh
        level = mean_z - slope * mean_h
        scatter = np.sqrt(np.bincount(ring, (z - slope[ring] * h) ** 2, size) / (count - 2))
        sigma = np.maximum(scatter, 1e-6) * np.sqrt(1 / count + mean_h**2 / hh)
    told = (count >= _LEAST_POINTS) & (hh > 1e-3 * count)
    for values in (slope, level, sigma, scatter):
        values[~told] = np.nan
    return slope, level, sigma, scatter
