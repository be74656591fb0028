"""The catalogue of effects. A new one is a short class and a line in `CATALOGUE`."""

from __future__ import annotations

import difflib

from calib.effects.arm import ArmAxisTilt, ArmJointOffset, ArmLinkLength
from calib.effects.base import Basis, Effect, LazyColumn, OneHot, Param, Site, View
from calib.effects.lidar import RingRangeOffset
from calib.effects.reference import SurfaceShift
from calib.effects.rig import FrameOffset
from chains.errors import InputError

CATALOGUE: tuple[Effect, ...] = (
    ArmLinkLength(),
    ArmJointOffset(),
    ArmAxisTilt(),
    RingRangeOffset(),
)
DEFAULT = ("arm_link_length", "arm_joint_offset", "ring_range_offset")

__all__ = [
    "CATALOGUE",
    "DEFAULT",
    "Basis",
    "Effect",
    "FrameOffset",
    "LazyColumn",
    "OneHot",
    "Param",
    "Site",
    "SurfaceShift",
    "View",
    "find",
]


def find(name: str) -> Effect:
    """The effect of this name, ``family`` or ``family@shape``.

    Raises:
        InputError: when the catalogue has none, naming the nearest.
    """
    family, _, shape = name.partition("@")
    known = {effect.name: effect for effect in CATALOGUE}
    if family not in known:
        near = difflib.get_close_matches(family, known, 1)
        hint = f"; did you mean '{near[0]}'?" if near else f": it has {', '.join(known)}."
        raise InputError(f"effect '{name}' is not in the catalogue{hint}")
    effect = known[family]
    if not shape:
        return effect
    try:
        chosen = float(shape)
    except ValueError:
        chosen = float("nan")
    if not effect.shape_name or not chosen < float("inf"):
        wanted = f"write {family}@NUMBER" if effect.shape_name else "it has no shape to choose"
        raise InputError(f"effect '{name}': {wanted}")
    return effect.at(chosen)
