"""Robust weights: Tukey's biweight, its cost, and how wide the bulk of rows is."""

from __future__ import annotations

import numpy as np
from scipy.special import chdtri

MAD = 1.4826  # of normal residuals, from the median of their size to their sigma
TUKEY = 4.685  # 95 % efficiency on normal rows (Holland and Welsch 1977)
# Chance that a group of good rows lies further out than where Huber's weights begin: of a recording
# with a hundred groups, one in a hundred has any weight below 1.
CHANCE_BEYOND = 1e-4
BULK = 4  # groups, below which their median is no measure of their bulk: half could be wild


def tukey_weight(z: np.ndarray, scale: float = 1.0) -> np.ndarray:
    """Weight of each whitened row under Tukey's biweight: ``(1 - (z / c)^2)^2`` inside c, else 0.

    Args:
        z: (N,) whitened residuals.
        scale: multiplies the tuning constant c = 4.685.
    """
    u = np.square(z / (TUKEY * scale))
    return np.square(np.maximum(1.0 - u, 0.0))


def tukey_cost(z: np.ndarray, scale: float = 1.0) -> float:
    """Half the robust chi-square, ``sum rho(z)`` with ``rho''(0) = 1``."""
    return float(np.sum(tukey_costs(z, scale)))


def tukey_costs(z: np.ndarray, scale: float = 1.0) -> np.ndarray:
    """What each row (N,) adds to that: ``rho(z)``."""
    c2 = (TUKEY * scale) ** 2
    inside = np.maximum(1.0 - np.square(z) / c2, 0.0)
    return c2 / 6.0 * (1.0 - inside**3)


def robust_scale(z: np.ndarray) -> float:
    """How many times wider than its sigma the bulk of the rows is; at least 1 (from the MAD)."""
    return max(1.0, MAD * float(np.median(np.abs(z)))) if len(z) else 1.0


def huber_weight(norm: np.ndarray, dof: np.ndarray) -> np.ndarray:
    """Weight of each group of whitened rows under Huber's loss of its norm: ``min(1, k / norm)``.

    A group's influence is bounded, and none is rejected: where two groups contradict each other
    and nothing else speaks, neither is taken to be right (Huber 1964). A group begins to lose
    weight at a norm k that chance exceeds with a probability of 1e-4, times how much wider than
    their sigmas the bulk of groups of its kind is.

    Args:
        norm: (G,) root of the sum of squares of each group's rows; groups of one kind.
        dof: (G,) how many rows each has.
    """
    if not len(norm):
        return np.ones(0)
    bulk = (
        max(1.0, float(np.median(norm / np.sqrt(chdtri(dof, 0.5))))) if len(norm) >= BULK else 1.0
    )
    return np.minimum(1.0, bulk * np.sqrt(chdtri(dof, CHANCE_BEYOND)) / np.maximum(norm, 1e-300))
