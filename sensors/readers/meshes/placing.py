"""Units and axes of what a scanner measured: metres, z up, and what is said of it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from chains.errors import InputError
from sensors.readers.base import Array, Options
from sensors.readers.conventions import Z_FROM_Y
from sensors.readers.tables.sheets import LENGTHS

# A choice: rooms are narrower, and in millimetres a room of 0.2 m and more is wider.
WIDEST_ROOM_M = 200.0
FAR_M = 1000.0  # from the origin, as surveys are: told, and no harm
COARSEST_M = 1e-4  # a sixth of a scanner's usual sigma of 0.6 mm: coarser coordinates would show


@dataclass(frozen=True)
class Placing:
    """How coordinates of a file become metres with z up.

    Args:
        metres: what one unit of the file is.
        R: (3, 3) turn from the file's axes.
        understood: units and axes in words.
        odd: what looked odd, a sentence each.
    """

    metres: float
    R: Array
    understood: str
    odd: tuple[str, ...] = ()

    def points(self, values: np.ndarray) -> Array:
        """Points (N, 3) in m, z up, of the file's."""
        return np.asarray(values, np.float64) * self.metres @ self.R.T

    def directions(self, values: np.ndarray) -> Array:
        """Unit vectors (N, 3), z up, of the file's."""
        return np.asarray(values, np.float64) @ self.R.T


def find_placing(
    path: Path, values: np.ndarray, options: Options, up: str = "z", because: str = ""
) -> Placing:
    """How coordinates (N, 3) of a file become metres with z up.

    Flags decide; without them, the file is in metres with `up` upwards, `because` of what. Raises
    InputError where it is wider than 200 m, which is millimetres unless a flag says otherwise.
    """
    unit, axis = options.length_unit or "m", options.up or up
    if unit not in LENGTHS or axis not in ("y", "z"):
        raise InputError(f"--length-unit is m, cm or mm and --up is y or z, not {unit} and {axis}")
    low, high = np.nanmin(values, axis=0), np.nanmax(values, axis=0)
    metres, size = LENGTHS[unit], float((high - low).max())
    if options.length_unit is None and size > WIDEST_ROOM_M:
        raise InputError(
            f"{path} is {size:.0f} units wide: if they are millimetres, give --length-unit mm,"
            " if they are metres, --length-unit m"
        )
    turned = "z up" if axis == "z" else "y up, turned to z up (x, -z, y)"
    said = [unit, turned + (f" {because}" if because and options.up is None else "")]
    away = float(np.linalg.norm((low + high) / 2)) * metres
    if away > FAR_M:
        said.append(f"{away / 1000:.0f} km from its origin, which does not harm")
    R = np.eye(3) if axis == "z" else Z_FROM_Y
    return Placing(metres, R, ", ".join(said), _odd(path, values, size * metres, metres))


def _odd(path: Path, values: np.ndarray, size_m: float, metres: float) -> tuple[str, ...]:
    odd = []
    step_m = float(np.spacing(np.float32(np.nanmax(np.abs(values))))) * metres
    if step_m > COARSEST_M and np.array_equal(values, values.astype(np.float32), equal_nan=True):
        odd.append(
            f"{path.name} holds single precision so far from its origin that coordinates are"
            f" rounded to {1000 * step_m:.1f} mm; export it in double precision, or nearer"
        )
    if size_m < 0.1:
        odd.append(f"{path.name} is only {1000 * size_m:.1f} mm wide; see --length-unit")
    return tuple(odd)
