"""Tracked bodies: what the tracker says of a body against where the chain puts it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from calib.effects.rig import DOF
from calib.forward import Values
from calib.residuals.seen import Compared, SeenBody
from chains import se3

TWIST_NAMES = ("about x", "about y", "about z", "x", "y", "z")


@dataclass(frozen=True, kw_only=True)
class TrackedBody(SeenBody):
    """One body at K stops that share every variable.

    ``r_rot = log(R_predicted^T R_measured)`` and ``r_pos = R_predicted^T (t_measured -
    t_predicted)``, each over its sigma; of a body seen as a point the position rows only.

    Args:
        measured: (K, 4, 4) T_world_body; the rotation is not used for a point.
        sigma_m, sigma_rad: of one measurement, per axis.
        is_point: True when the tracker gives no orientation.
        scatter: unit, "m" or "rad" -> how widely it scatters beyond what its sigmas were at first.
    """

    sigma_m: float
    sigma_rad: float
    is_point: bool
    scatter: Mapping[str, float] = field(default_factory=lambda: {"m": 0.0, "rad": 0.0})

    kind = "tracker"

    @property
    def _kept(self) -> slice:
        """Of a twist, what the tracker gives."""
        return slice(3, 6) if self.is_point else slice(0, 6)

    @property
    def axes(self) -> tuple[str, ...]:
        return TWIST_NAMES[self._kept]

    @property
    def dofs(self) -> tuple[str, ...]:
        return DOF[self._kept]

    @property
    def units(self) -> tuple[str, ...]:
        return (("rad",) * 3 + ("m",) * 3)[self._kept]

    @property
    def sigma(self) -> np.ndarray:
        return np.repeat([self.sigma_rad, self.sigma_m], 3)[self._kept]

    def turn(self, k: int) -> np.ndarray:
        """Positions are told in the tracker's axes."""
        turn = np.eye(6)
        turn[3:, 3:] = self.measured[k, :3, :3]
        return turn[self._kept, self._kept]

    def scattering(self, unit: str, sd: float) -> TrackedBody:
        """The block with another spread beyond the sigma in this unit."""
        sigma = getattr(self, f"sigma_{unit}")
        wider = np.sqrt(sigma**2 - self.scatter[unit] ** 2 + sd**2)
        changed = {f"sigma_{unit}": float(wider), "scatter": {**self.scatter, unit: sd}}
        return replace(self, **changed)

    @property
    def turns_at_m(self) -> float:
        """How far [m] from the body a sigma of its orientation moves a point by a sigma of its
        position, both as stated, without what scatters beyond; 0 of a point."""
        if self.is_point:
            return 0.0
        sigma = {"m": self.sigma_m, "rad": self.sigma_rad}
        stated = {unit: np.sqrt(sigma[unit] ** 2 - self.scatter[unit] ** 2) for unit in sigma}
        return float(stated["m"] / stated["rad"])

    def predicted(self, values: Values) -> np.ndarray:
        """T_world_body (K, 4, 4)."""
        return self.seen(values).T

    def compare(self, T_world_body: np.ndarray, values: Values) -> Compared:
        rows, by_twist = _pose_error(T_world_body, self.measured)
        return Compared(rows[:, self._kept], by_twist[:, self._kept], {})


def _pose_error(predicted: np.ndarray, measured: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """[rotation, position] error in the predicted body's axes (K, 6), and its derivative by the
    predicted pose's right increment (K, 6, 6)."""
    R_t = predicted[:, :3, :3].mT
    rotation = se3.so3_log(R_t @ measured[:, :3, :3])
    position = np.matvec(R_t, measured[:, :3, 3] - predicted[:, :3, 3])
    d = np.zeros((len(measured), 6, 6))
    d[:, :3, :3] = -se3.so3_left_jacobian_inverse(rotation)
    d[:, 3:, :3] = se3.skew(position)
    d[:, 3:, 3:] = -np.eye(3)
    return np.concatenate([rotation, position], axis=1), d
