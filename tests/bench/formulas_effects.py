"""Range errors that no catalogue lists, for the search of formulas to find.

Each is arithmetic on columns of a recording, in the words of a user's own effects, and evaluated
here by numpy alone: angles rad, ranges m, times s; ``label`` a whole number. A formula is scaled to
its size afterwards, so only its shape counts.

What the model itself absorbs is avoided: a function of the ring alone is taken by the rings' zeros,
one of the place in the room by the surfaces' errors. So is what the catalogue lists: a power or an
exponential of the range, up to four waves of azimuth, a constant of a label, a line in temperature,
a logarithm of intensity, an exponential in time. `formulas_size` tells what is left of the others.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import CodeType

import numpy as np

# A spinning LiDAR's ring has one elevation, and its column one azimuth: two names of one thing.
SAME = {"elevation_rad": "ring", "column": "azimuth_rad", "elapsed_s": "time_s"}
NAMES = {
    name: getattr(np, name)
    for name in ("sin", "cos", "tan", "exp", "log", "sqrt", "abs", "minimum", "maximum", "where")
} | {"pi": np.pi}

ONE = (
    "log(humidity / 0.45)",
    "(humidity - 0.45) ** 2",
    "battery_v < 23.6",
    "exp((23 - battery_v) / 0.5)",
    "(fan_rpm / 3000) ** 2",
    "fan_rpm > 3300",
    "(temperature_c - 26) ** 2",
    "sin(2 * pi * temperature_c / 3)",
    "sin(2 * pi * time_s / 900)",
    "(azimuth_rad > 0.4) * (azimuth_rad < 1.1)",
    "cos(7 * azimuth_rad)",
    "exp(-(((azimuth_rad - 1) / 0.3) ** 2))",
    "sqrt(ambient)",
    "exp(-ambient / 150)",
    "exp(-(((range_m - 3.2) / 0.4) ** 2))",
)
TWO = (
    "cos(pi * ring) * (temperature_c - 26)",
    "(sin(pi * (2 * ring + 1) / 8) > 0) * (humidity - 0.45)",
    "elevation_rad * log(humidity / 0.45)",
    "sin(azimuth_rad) * (temperature_c - 26)",
    "cos(2 * azimuth_rad) * (fan_rpm / 3000 - 1)",
    "(azimuth_rad > -2) * (azimuth_rad < -0.8) * (battery_v - 24)",
    "sin(3 * azimuth_rad) * elevation_rad",
    "cos(azimuth_rad + 6 * elevation_rad)",
    "(1 / cos(incidence_rad) - 1) * (temperature_c - 26)",
    "tan(incidence_rad) * (battery_v - 24)",
    "range_m * (humidity - 0.45)",
    "log(range_m) * (temperature_c - 26)",
    "(label == 2) * (range_m - 3)",
    "(label == 1) * (temperature_c - 26)",
    "intensity * (fan_rpm / 3000 - 1)",
    "sin(joint_2) * elevation_rad",
    "cos(joint_5) * sin(azimuth_rad)",
    "sin(2 * joint_3) * cos(azimuth_rad)",
    "ambient * (temperature_c - 26)",
    "log(1 + ambient / 50) * (range_m - 3)",
    "sin(2 * pi * time_s / 1200) * sin(azimuth_rad)",
    "exp(-time_s / 900) * elevation_rad",
    "(fan_rpm > 3300) * sin(4 * azimuth_rad)",
    "(azimuth_rad > 0) * elevation_rad",
    "cos(pi * ring) * (range_m > 3)",
    "exp(-range_m / 1.5) * (battery_v - 24)",
)
THREE = (
    "sin(azimuth_rad) * elevation_rad * (temperature_c - 26)",
    "(azimuth_rad > 1) * (azimuth_rad < 2.2) * elevation_rad * (temperature_c - 26)",
    "range_m * (humidity - 0.45) * (temperature_c - 26)",
    "sin(joint_1) * elevation_rad * (battery_v - 24)",
    "(label == 2) * (1 / cos(incidence_rad) - 1) * (temperature_c - 26)",
    "cos(2 * azimuth_rad) * log(range_m) * (humidity - 0.45)",
    "ambient * elevation_rad * (fan_rpm / 3000 - 1)",
    "cos(pi * ring) * sin(azimuth_rad) * (battery_v - 24)",
)
SINGLES = (*ONE, *TWO, *THREE)
# Two at once, each of half the variance: places in `SINGLES`.
PAIRS = (
    (0, 9), (2, 18), (5, 21), (7, 12), (10, 25), (13, 16), (15, 19), (22, 27), (24, 3), (30, 6),
)  # fmt: skip


def compiled(formula: str) -> CodeType:
    """A formula, ready to be evaluated."""
    return compile(formula, "<formula>", "eval")


def covariates(formula: str) -> frozenset[str]:
    """The columns that a formula looks at."""
    return same(name for name in compiled(formula).co_names if name not in NAMES)


def same(names: object) -> frozenset[str]:
    """Columns, those that are one thing by one name."""
    return frozenset(SAME.get(name, name) for name in names)


def value(formula: str, columns: Mapping[str, np.ndarray]) -> np.ndarray:
    """A formula's value, of the shape of the columns."""
    found = eval(compiled(formula), {"__builtins__": {}, **NAMES}, dict(columns))
    return np.asarray(found, float)
