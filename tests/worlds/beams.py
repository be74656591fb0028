"""Spinning LiDARs: their beams, and how their ranges scatter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

NEAREST_M = 0.5
TAIL_DOF = 6  # of Student's t, which single ranges follow: tails are slightly heavy
SPREAD = 0.15  # of log sigma between beams
STRADDLE_RAD, JUMP_M, MIXED = 0.005, 0.05, 0.002  # at edges: a beam's width, how many are mixed
STRAY = 0.002  # of all beams: they graze what is too thin for a mesh


@dataclass(frozen=True)
class Lidar:
    """A model; angles rad, lengths m.

    Args:
        elevation_rad: (R,) by ring.
        columns: of a turn.
        sigma_m: of a single range, near and of a white surface.
        ring_mean_m, ring_sigma_m: of the rings' range zeros.
        step_m: of the readout.
    """

    elevation_rad: np.ndarray
    columns: int
    sigma_m: float
    ring_mean_m: float
    ring_sigma_m: float
    step_m: float

    def directions(self, beams: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Unit directions (N, 3), rings (N,) and columns (N,) of about so many beams."""
        rings = len(self.elevation_rad)
        step = max(1, round(self.columns * rings / beams))
        column, ring = np.meshgrid(np.arange(0, self.columns, step), np.arange(rings))
        azimuth = np.pi - 2 * np.pi * column.ravel() / self.columns
        up = self.elevation_rad[ring.ravel()]
        flat = np.cos(up)
        towards = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(up)], axis=1)
        return towards, ring.ravel(), column.ravel()

    def sigma(self, range_m: np.ndarray, white: np.ndarray, cosine: np.ndarray) -> np.ndarray:
        """Of a single range (N,) m: grows with distance, for the dark, and at a slant."""
        slant = np.minimum(np.sqrt(1 / cosine**2 - 1), 4)
        far = 1 + 0.02 * range_m**1.5
        dark = (0.8 / np.maximum(white, 0.05)) ** 0.15
        return np.hypot(self.sigma_m * far * dark, 0.0004 * range_m * slant)


def _qt64() -> np.ndarray:
    """The maker's angle table, rings from the lowest up, to 0.02 deg by an odd polynomial."""
    k = np.arange(64) - 31.5
    terms = (1.44813857, 1.40025638e-4, -2.18930899e-8, 9.09629540e-11)
    return np.radians(sum(c * k ** (2 * i + 1) for i, c in enumerate(terms)))


def model(name: str) -> Lidar:
    """The LiDAR of a name in `knobs.LIDARS`."""
    rows = {
        "hesai_pandarxt32": (np.radians(np.linspace(15, -16, 32)), 2000, 3.5, 0.5, 1.5, 4),
        "hesai_pandarqt64": (_qt64(), 600, 8.5, 3, 5, 4),
        "ouster_os0_128_rev7": (np.radians(np.linspace(45, -45, 128)), 1024, 5.0, 6.6, 3, 1),
    }
    elevation, columns, *mm = rows[name]
    sigma_m, mean_m, ring_m, step_m = np.array(mm) / 1e3
    return Lidar(
        elevation_rad=elevation,
        columns=columns,
        sigma_m=sigma_m,
        ring_mean_m=mean_m,
        ring_sigma_m=ring_m,
        step_m=step_m,
    )


def averaged(
    lidar: Lidar, rng: np.random.Generator, range_m: np.ndarray, sigma_m: np.ndarray, sweeps: int
) -> tuple[np.ndarray, np.ndarray]:
    """Mean (N,) m of the ranges that sweeps read, and their standard deviation (N,) m.

    The deviation is NaN for a single sweep.
    """
    sigma_m = sigma_m * np.exp(SPREAD * rng.standard_normal(len(sigma_m)) - SPREAD**2)
    unit = rng.standard_t(TAIL_DOF, (len(range_m), sweeps)) * np.sqrt(1 - 2 / TAIL_DOF)
    read = range_m[:, None] + sigma_m[:, None] * unit
    read = lidar.step_m * np.round(read / lidar.step_m)
    spread = read.std(axis=1, ddof=1) if sweeps > 1 else np.full(len(read), np.nan)
    return read.mean(axis=1), spread
