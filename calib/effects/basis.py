"""What bases are made of: columns kept finite and put where they belong, and courses in time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calib.effects.base import Effect, Param, View
from calib.rig import Rig
from sensors.lidar import GRAZING_RAD

RANGE, AZIMUTH, ELEVATION = range(3)
AMBIENT_C = 20.0  # where the error is zero by definition: the usual reference (ISO 1)


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


def warmer_k(view: View) -> np.ndarray:
    """By how much it is warmer than where errors by temperature are zero (rows,), K."""
    return finite(view["temperature_c"] - AMBIENT_C)


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
    """Times midway between stops, three or more of them on either side, and any of them later."""
    time_s = np.sort(stops["elapsed_s"])
    between = (0.5 * (time_s[1:] + time_s[:-1]))[2:-2]
    return between[between < time_s[-1:]] if len(between) else between


def settled(elapsed_s: np.ndarray, tau_s: float) -> np.ndarray:
    """How much (K,) has happened of what is fast at first, and then ever slower."""
    return 1.0 - np.exp(-elapsed_s / tau_s)


class Slips(Effect):
    """What happens once, at a time t_s since the first stop, and then stays."""

    shape_name, shape = "t_s", 900.0
    jumps = repeats = True

    def shapes(self, stops: View) -> tuple[float, ...]:
        return step_times(stops) if self.params(stops.rig) else ()

    def beside(self, stops: View) -> tuple[float, ...]:
        return nearest_times(stops, self.shape) if self.params(stops.rig) else ()

    def when(self, elapsed_s: np.ndarray) -> np.ndarray:
        """How much of it has happened (K,) at times since the first stop."""
        return (elapsed_s > self.shape).astype(float)


class Creeps(Effect):
    """What happens little by little, evenly in time; per hour."""

    shape_name, shape = "", 0.0
    jumps = repeats = False

    def shapes(self, stops: View) -> tuple[float, ...]:
        return ()

    def params(self, rig: Rig) -> tuple[Param, ...]:
        return tuple(replace(p, unit=f"{p.unit}/h") for p in super().params(rig))

    def when(self, elapsed_s: np.ndarray) -> np.ndarray:
        """How much of it has happened (K,) at times since the first stop."""
        return elapsed_s / 3600.0


class Settles(Effect):
    """What happens fast at first, then ever more slowly, with a time constant tau_s."""

    shape_name, shape = "tau_s", 300.0
    jumps = repeats = False

    def shapes(self, stops: View) -> tuple[float, ...]:
        """Shares of the time measured in: after a longer one it would look like `Creeps`."""
        lasted_s = float(stops["elapsed_s"].max(initial=0.0))
        known = bool(self.params(stops.rig)) and 0.0 < lasted_s < np.inf
        return tuple(float(f"{share * lasted_s:.3g}") for share in (0.05, 0.1, 0.2) if known)

    def when(self, elapsed_s: np.ndarray) -> np.ndarray:
        """How much of it has happened (K,) at times since the first stop."""
        return settled(elapsed_s, self.shape)
