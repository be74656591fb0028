"""What bases are made of: columns kept finite, and put where they belong."""

from __future__ import annotations

import numpy as np

from calib.effects.base import View
from sensors.lidar import GRAZING_RAD

RANGE, AZIMUTH, ELEVATION = range(3)


def beam(axis: int, *columns: np.ndarray) -> np.ndarray:
    """The basis (rows, 3, P) of columns that each add to one axis of BEAM."""
    stacked = np.stack(np.broadcast_arrays(*map(np.atleast_1d, columns)), axis=-1)
    basis = np.zeros((len(stacked), 3, len(columns)))
    basis[:, axis] = stacked
    return basis


def range_m(view: View) -> np.ndarray:
    """Predicted range (rows,); 0 where a beam meets nothing ahead."""
    return np.maximum(finite(view["range_m"]), 0.0)


def incidence_rad(view: View) -> np.ndarray:
    """Incidence (rows,), held below 1.5 rad: beams flatter than that tell nothing."""
    return np.clip(finite(view["incidence_rad"]), 0.0, GRAZING_RAD)


# A choice: two such steps reach the next of `step_times` where there are 300 stops.
TIMES_BESIDE = 8


def finite(column: np.ndarray) -> np.ndarray:
    """A column with 0 where nothing was recorded."""
    return np.where(np.isfinite(column), column, 0.0)


def place_of(values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Index of each value among the known ones, which ascend; -1 for one that is not known."""
    at = np.minimum(np.searchsorted(known, values), len(known) - 1)
    return np.where(known[at] == values, at, -1)


def step_times(stops: View) -> tuple[float, ...]:
    """Times midway between stops, three or more of them on either side; 20 at most."""
    between = _between(stops)
    if not len(between):
        return ()
    chosen = np.linspace(0, len(between) - 1, min(len(between), 20)).round().astype(int)
    return tuple(float(f"{t:.6g}") for t in np.unique(between[chosen]))


def nearest_times(stops: View, t_s: float) -> tuple[float, ...]:
    """Of times midway between stops, as of `step_times`, those nearest to one: on either side as
    many as `TIMES_BESIDE`, with at least one stop between each and that one."""
    between, time_s = _between(stops), np.sort(stops["elapsed_s"])
    gone = np.searchsorted(time_s, between, "right") - np.searchsorted(time_s, t_s, "right")
    return tuple(float(f"{t:.6g}") for t in between[(gone != 0) & (np.abs(gone) <= TIMES_BESIDE)])


def _between(stops: View) -> np.ndarray:
    """Times midway between stops, three or more of them on either side."""
    time_s = np.sort(stops["elapsed_s"])
    return (0.5 * (time_s[1:] + time_s[:-1]))[2:-2]
