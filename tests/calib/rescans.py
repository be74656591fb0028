"""Recordings whose LiDAR measured something else than it did."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from sensors.recording import read_table, write_table

# (which stop, range m, azimuth rad, elevation rad of its beams) -> their range, m.
Change = Callable[[int, np.ndarray, np.ndarray, np.ndarray], np.ndarray]


def change_ranges(recording: Path, change: Change) -> None:
    """Give every beam of a recording another range."""
    for stop, path in enumerate(sorted((recording / "scans").glob("*.parquet"))):
        table = read_table(path)
        points = np.stack([table[c] for c in "xyz"], axis=1).astype(float)
        range_m = np.linalg.norm(points, axis=1)
        azimuth = np.arctan2(points[:, 1], points[:, 0])
        elevation = np.arcsin(points[:, 2] / range_m)
        points *= (change(stop, range_m, azimuth, elevation) / range_m)[:, None]
        write_table(path, table | dict(zip("xyz", points.astype(np.float32).T, strict=True)))


def sector(first_rad: float, last_rad: float, by_m: float) -> Change:
    """Ranges are off in a sector of azimuth, which may run through pi."""
    width = (last_rad - first_rad) % (2 * np.pi)

    def change(stop, range_m, azimuth, elevation):
        return range_m + by_m * ((azimuth - first_rad) % (2 * np.pi) < width)

    return change
