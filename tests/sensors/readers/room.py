"""What LiDARs of known geometry measure in a box: the truth that readers' tests compare with."""

import numpy as np

HALF_M = np.array([3.0, 4.0, 1.5])
"""Half the size of the box around the LiDAR."""


def box_range(origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Range (N,) m from origins (N, 3) inside the box along unit directions to its walls."""
    with np.errstate(divide="ignore", invalid="ignore"):
        walls = (np.sign(direction) * HALF_M - origin) / direction
    return np.where(direction == 0, np.inf, walls).min(axis=1)


def box_scan(
    elevation: np.ndarray, columns: int, radial_m: float = 0.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points (N, 3), ring and column of a turn whose beams start `radial_m` from the axis.

    Column c looks at pi - 2 pi c / columns; rows of a ring stand together.
    """
    ring, column = (a.ravel() for a in np.indices((len(elevation), columns)))
    azimuth = np.pi - 2 * np.pi * column / columns
    flat = np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros(len(azimuth))], axis=1)
    up = elevation[ring][:, None]
    direction = flat * np.cos(up) + np.array([0, 0, 1]) * np.sin(up)
    origin = radial_m * flat
    points = origin + direction * box_range(origin, direction)[:, None]
    return points, ring, column
