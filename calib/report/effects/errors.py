"""What an effect does at its site, in the unit that people read."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.effects import Effect, Site
from calib.effects.base import Basis, OneHot, View

ERRORS = {
    Site.BEAM: (("range", 1e3, "mm"), ("azimuth", 1e3, "mrad"), ("elevation", 1e3, "mrad")),
    Site.NOISE: (("log of sigma", 1.0, ""),),
}


@dataclass(frozen=True)
class ShownError:
    """One thing that is in error.

    Args:
        what: that is.
        unit: of the errors.
        values: (rows, S) of S settings of the effect's parameters.
        is_size: whether they are lengths of vectors, which have no sign.
    """

    what: str
    unit: str
    values: np.ndarray
    is_size: bool = False


def errors(effect: Effect, view: View, basis: Basis, settings: np.ndarray) -> list[ShownError]:
    """What an effect does where its parameters (P, S) are set so."""
    error = _product(basis, settings)
    if len(error) == 1:  # one row stands for all
        error = np.repeat(error, view.rows, axis=0)
    site, rig = effect.site, view.rig
    if site in ERRORS:
        parts = zip(ERRORS[site], np.moveaxis(error, 1, 0), strict=True)
        return [ShownError(what, unit, scale * values) for (what, scale, unit), values in parts]
    if site is Site.JOINTS:
        units = ("mrad" if kind == "revolute" else "mm" for kind in rig.joint_kinds)
        each = zip(rig.joint_names, units, np.moveaxis(error, 1, 0), strict=True)
        return [ShownError(name, unit, 1e3 * values) for name, unit, values in each]
    if site in (Site.TARGET, Site.REFERENCE):
        what = "sphere" if site is Site.TARGET else "surface"
        return [ShownError(f"{what} off", "mm", 1e3 * np.linalg.norm(error, axis=1), True)]
    if site is Site.EDGE:
        frame = rig.lidar_frame or rig.tracker.bodies[-1]
        by_twist = rig.tree.place(frame, view.joints).d_twist.reshape(len(view.joints), 6, -1)
        twist = by_twist @ error.reshape(len(error), by_twist.shape[2], -1)
        return _moved(f"{frame} moves", twist[:, None])
    if site is Site.ROOT:
        return _moved("the rig moves", error[:, None])
    return _moved("body moves", error)


def _moved(what: str, twist: np.ndarray) -> list[ShownError]:
    """Of twists (rows, B, 6, S) how far the body that moves furthest moves and turns."""
    turn, shift = (1e3 * np.linalg.norm(twist[:, :, part], axis=2).max(axis=1)
                   for part in (slice(0, 3), slice(3, 6)))  # fmt: skip
    return [ShownError(what, "mm", shift, True), ShownError("turns", "mrad", turn, True)]


def _product(basis: Basis, settings: np.ndarray) -> np.ndarray:
    """(rows, *site, S)."""
    if isinstance(basis, OneHot):
        known = np.vstack([settings, np.zeros((1, settings.shape[1]))])
        return basis.values[:, :, None] * known[basis.index][:, None, :]
    return basis @ settings
