"""Units in which numbers are shown; round ones for the ends of axes and scales of colour."""

from __future__ import annotations

import numpy as np

DISPLAY_UNITS = {"m": (1e3, "mm"), "rad": (1e3, "mrad"), "1": (1.0, "(no unit)")}


def round_up(value: float) -> float:
    """The next of 1, 2, 5 times a power of ten; 1 of what is not positive."""
    if not value > 0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(value))
    return float(next(n for n in (1, 2, 5, 10) if n * power >= value * (1 - 1e-9)) * power)


def shown(unit: str) -> tuple[float, str]:
    """Factor and unit in which a unit is shown, m/K as m is."""
    length, per, rest = unit.partition("/")
    if per and length in DISPLAY_UNITS and length != "1":
        scale, name = DISPLAY_UNITS[length]
        return scale, f"{name}/{rest}"
    return DISPLAY_UNITS.get(unit, (1.0, unit))
