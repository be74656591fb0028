"""How well a calibration is to be known: ``--until "lidar 0.3 mm, rings 1 mm"``."""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np

from calib.diagnosis.stand import Stand
from calib.effects import split
from calib.planning.purpose import Purpose, calibration, components
from calib.problem.unknowns import Key
from chains.errors import InputError

# What people write -> the unit of parameters, and how many of it that is.
TOLERANCE_UNITS: Mapping[str, tuple[str, float]] = {
    "mm": ("m", 1e-3),
    "m": ("m", 1.0),
    "mrad": ("rad", 1e-3),
    "rad": ("rad", 1.0),
    "deg": ("rad", float(np.radians(1.0))),
}
RINGS = {"rings": "ring_range_offset", "links": "arm_link_length", "joints": "arm_joint_offset"}
ENDS = ("xyz", "rpy")  # of a frame's name, as people say of which part they speak; the unit says so
_ITEM = re.compile(r"(\S+)\s+(\S+?)\s*([a-z]+(?:/\S+)?)")


def purpose_until(stand: Stand, text: str) -> Purpose:
    """What a plan is for that goes on until sigmas are small enough.

    Args:
        stand: the fit of a run.
        text: items with commas, each a frame, an effect of the model or one parameter, or `RINGS`,
            a number, and a unit of `TOLERANCE_UNITS`: sigmas of all its parameters in such a unit
            are to be that small.

    Raises:
        InputError: an item is none, or what it names is not in the model, or has another unit.
    """
    wanted: dict[Key, float] = {}
    for item in split(text):
        found = _ITEM.fullmatch(item)
        if found is None:
            raise InputError(f"--until '{item}': give NAME NUMBER UNIT, 'lidar 0.3 mm' say")
        name, number, unit = found.groups()
        size = _size(item, number, unit)
        keys = _keys(stand, item, name, size[0])
        wanted |= dict.fromkeys(keys, size[1])
    if not wanted:
        raise InputError("--until: give NAME NUMBER UNIT, 'lidar 0.3 mm, rings 1 mm' say")
    return Purpose(text, components=tuple(wanted), tolerance=tuple(wanted.values()))


def _size(item: str, number: str, unit: str) -> tuple[str, float]:
    """The unit of parameters, and how many of it are wanted."""
    base, per, rest = unit.partition("/")
    try:
        size = float(number)
    except ValueError:
        size = float("nan")
    if not 0 < size < float("inf"):
        raise InputError(f"--until '{item}': '{number}' is no number above 0")
    if base not in TOLERANCE_UNITS:
        raise InputError(
            f"--until '{item}': unit '{unit}' is unknown; give {', '.join(TOLERANCE_UNITS)}"
        )
    of, scale = TOLERANCE_UNITS[base]
    return f"{of}{per}{rest}", size * scale


def _keys(stand: Stand, item: str, name: str, unit: str) -> list[Key]:
    """The components of that name that have the unit."""
    head, _, end = name.rpartition(".")
    found = components(stand, RINGS.get(name, head if end in ENDS else name))
    if not found:
        known = ", ".join(stand.estimate.problem.calibration)
        raise InputError(f"--until '{item}': '{name}' is not in the model; it has {known}")
    units: dict[Key, str] = {}
    for unknown in calibration(stand):
        units |= dict(zip(unknown.keys, unknown.units, strict=True))
    alike = [key for key in found if units[key] == unit]
    if not alike:
        has = " and ".join(dict.fromkeys(units[key] for key in found))
        raise InputError(f"--until '{item}': parameters of '{name}' are in {has}, not {unit}")
    return alike
