"""What may be hidden in a world, each by a formula of its own; sizes in its unit."""

from __future__ import annotations

import numpy as np

from .arm import gravity_torque

WARM_UP_S, MEAN_C = 900.0, 24.0
# Name -> unit of its size, and what it does.
EFFECTS = {
    "incidence": "m: range = true + k (1 / cos(incidence) - 1)",
    "warm_up": "m: range = true + k exp(-t / 900 s)",
    "gravity_sag": "rad/(N m): joint = reported + k times gravity's torque about it",
    "joint_slip": "rad: joint_3 = reported + k in the second half of the stops",
    "ring_by_temperature": "m: range = true + k (T - 24 C) / 4 K (2 ring / last ring - 1)",
}


def of_joints(hidden: tuple[tuple[str, float], ...], reported: np.ndarray) -> np.ndarray:
    """What hidden effects add to reported angles (K, 6) rad."""
    size = dict(hidden)
    late = np.arange(len(reported)) >= len(reported) / 2
    slipped = np.outer(late, [0.0, 0.0, size.get("joint_slip", 0.0), 0.0, 0.0, 0.0])
    return size.get("gravity_sag", 0.0) * gravity_torque(reported) + slipped


def of_range(
    hidden: tuple[tuple[str, float], ...],
    cosine: np.ndarray,
    height: np.ndarray,
    time_s: float,
    temperature_c: float,
) -> np.ndarray:
    """What hidden effects add to ranges (N,) m.

    Args:
        hidden: effects and sizes.
        cosine: (N,) of incidence.
        height: (N,) of the ring, -1 of the first to 1 of the last.
        time_s, temperature_c: of the stop.
    """
    size = dict(hidden)
    out = size.get("incidence", 0.0) * np.minimum(1 / cosine - 1, 10)
    out = out + size.get("warm_up", 0.0) * np.exp(-time_s / WARM_UP_S)
    warm = (temperature_c - MEAN_C) / 4
    return out + size.get("ring_by_temperature", 0.0) * warm * height
