"""Levels: what an accelerometer at rest says of gravity, against where the chain puts it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from calib.forward import Values
from calib.residuals.seen import Compared, SeenBody
from chains import se3

ACROSS = ("across_1", "across_2")  # of a direction, in its tangent plane
SMALL_RAD = 1e-4  # below this angle theta / sin(theta) is 1 to 2e-9


@dataclass(frozen=True, kw_only=True)
class Level(SeenBody):
    """An accelerometer in one frame at K stops that share every variable.

    At rest it feels what holds it up: the direction p = -R^T g of the frame's pose R and of down g.
    Measured less predicted is minus the logarithm of p on the unit sphere about the measured
    direction m: ``r = -(theta / sin theta) B^T p``, theta from m to p, B (3, 2) across m (Absil,
    Mahony and Sepulchre 2008, Optimization Algorithms on Matrix Manifolds, 5.4.1).

    Args:
        measured: (K, 3) unit vectors, along what was felt, in the frame's axes.
        gravity: variable of g (3,), down in the world frame; its length means nothing.
        sigma_rad: of one measurement, about either axis across it.
    """

    gravity: str
    sigma_rad: float

    kind = "level"
    axes = ("", "")  # across what was felt; no names of these would tell people anything
    dofs = ACROSS
    units = ("rad", "rad")

    @property
    def sigma(self) -> np.ndarray:
        return np.repeat(self.sigma_rad, 2)

    @property
    def variables(self) -> tuple[str, ...]:
        return (*super().variables, self.gravity)

    def predicted(self, values: Values) -> np.ndarray:
        """(K, 3) the direction that it should feel."""
        g, _ = down(values[self.gravity])
        return -np.matvec(self.seen(values).T[:, :3, :3].mT, g)

    def compare(self, T_world_body: np.ndarray, values: Values) -> Compared:
        g, by_gravity = down(values[self.gravity])
        R_t = T_world_body[:, :3, :3].mT
        m, B_t, p = self.measured, self._across.mT, -np.matvec(R_t, g)
        c, s = np.vecdot(m, p), np.linalg.norm(np.cross(m, p), axis=1)
        near = s < SMALL_RAD
        f = np.where(near & (c > 0), 1.0, np.arctan2(s, c) / np.maximum(s, 1e-12))
        by_c = np.where(near, -1.0 / 3.0, (f * c - 1.0) / np.square(np.where(near, 1.0, s)))
        side = np.matvec(B_t, p)
        by_p = -(f[:, None, None] * B_t + (by_c[:, None] * side)[:, :, None] * m[:, None, :])
        by_twist = np.concatenate([by_p @ se3.skew(p), np.zeros((len(m), 2, 3))], axis=2)
        return Compared(-f[:, None] * side, by_twist, {self.gravity: -by_p @ R_t @ by_gravity})

    @cached_property
    def _across(self) -> np.ndarray:
        """(K, 3, 2) two unit vectors across each measured direction and each other."""
        return np.linalg.svd(self.measured[:, None, :])[2][:, 1:].mT


def down(gravity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The unit vector (3,) along gravity (3,) of any length, and its derivative (3, 3) by it."""
    length = np.linalg.norm(gravity)
    g = gravity / length
    return g, (np.eye(3) - np.outer(g, g)) / length
