"""Spheres on hanging rods: seen by the scanner as centres, by the tracker as two markers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from calib.forward import Derivatives, Values
from calib.residuals.groups import Group
from calib.residuals.levels import down

TARGET_PARTS = ("lower", "upper", "sphere")  # of a target, three rows each, in their order
PARTS_OF_SIGMAS = {"sphere": ("sphere",), "marker": ("lower", "upper")}  # of which parts


@dataclass(frozen=True)
class HangingTarget:
    """One rod. Its lower marker's true place p is unknown; gravity g is common to all rods.

    ``lower - p``, ``upper - p`` across the rod, and ``faro + s - T_faro_world (p + L g)``, s the
    scanner's error there, each over its sigma; markers less what the tracker's volume adds to them.
    The spacing of the markers is not used, so it need not be known.

    Args:
        name: for messages.
        marker: variable of p (3,), world frame.
        gravity: variable of g (3,), down in the world frame; its length means nothing.
        reference: variable of T_world_faro.
        faro_m, upper_m, lower_m: (3,) measured.
        below_m: L, sphere centre below the lower marker.
        sigma_sphere_m, sigma_marker_m: per axis.
        shift: (3, P) per variable: where the sphere truly sits beyond that, world frame.
        scanned: (3, P) per variable: where it truly sits beyond where it was scanned, faro frame.
        tracked: (2, 3, P) per variable: where the lower and the upper marker are seen beyond where
            they truly are, world frame.
        groups: (3,) the names of the rows of each of `TARGET_PARTS`.
        weight: (3,) of the rows of each, robust, and 0 for a part that was left out; 1 where None.
        scatter: "sphere" or "marker" -> how widely it scatters beyond what its sigma was at first.
    """

    name: str
    marker: str
    gravity: str
    reference: str
    faro_m: np.ndarray
    upper_m: np.ndarray
    lower_m: np.ndarray
    below_m: float
    sigma_sphere_m: float
    sigma_marker_m: float
    shift: Mapping[str, np.ndarray]
    scanned: Mapping[str, np.ndarray] = field(default_factory=dict)
    tracked: Mapping[str, np.ndarray] = field(default_factory=dict)
    groups: tuple[Group, ...] = ()
    weight: np.ndarray | None = None
    scatter: Mapping[str, float] = field(
        default_factory=lambda: dict.fromkeys(PARTS_OF_SIGMAS, 0.0)
    )

    kind = "target"
    rows = 9

    @property
    def of_effects(self) -> tuple[str, ...]:
        """Variables of effects on it."""
        return (*self.shift, *self.scanned, *self.tracked)

    @property
    def variables(self) -> tuple[str, ...]:
        return (self.marker, self.gravity, self.reference, *self.of_effects)

    @property
    def measured_m(self) -> np.ndarray:
        """(3, 3) of each of `TARGET_PARTS`: markers in the world, the sphere in faro."""
        return np.stack([self.lower_m, self.upper_m, self.faro_m])

    @property
    def sigmas_m(self) -> np.ndarray:
        """(9,) of its rows."""
        return np.repeat([self.sigma_marker_m, self.sigma_marker_m, self.sigma_sphere_m], 3)

    @property
    def part_weights(self) -> np.ndarray:
        """(3,) of each of `TARGET_PARTS`."""
        return np.ones(len(TARGET_PARTS)) if self.weight is None else self.weight

    @property
    def weights(self) -> np.ndarray:
        """(9,) of its rows."""
        return np.repeat(self.part_weights, 3)

    def without_sphere(self) -> HangingTarget:
        """The target where its sphere says nothing."""
        counts = [part != "sphere" for part in TARGET_PARTS]
        return replace(self, weight=np.where(counts, self.part_weights, 0.0))

    def scattering(self, of: str, sd: float) -> HangingTarget:
        """The target with another spread beyond the sigma of its sphere, or of its markers."""
        sigma_m = getattr(self, f"sigma_{of}_m")
        wider = np.sqrt(sigma_m**2 - self.scatter[of] ** 2 + sd**2)
        changed = {f"sigma_{of}_m": float(wider), "scatter": {**self.scatter, of: sd}}
        return replace(self, **changed)

    def evaluate(self, values: Values, derivatives: bool) -> tuple[np.ndarray, Derivatives | None]:
        """Nine whitened rows [lower marker, upper marker across the rod, sphere]."""
        p, T = values[self.marker], values[self.reference]
        g, by_gravity = down(values[self.gravity])
        added = sum((b @ values[n] for n, b in self.tracked.items()), np.zeros((2, 3)))
        lower, rod = self.lower_m - added[0], self.upper_m - added[1] - p
        across = rod - g * (g @ rod)
        sphere = p + self.below_m * g + sum(b @ values[n] for n, b in self.shift.items())
        R_t = T[:3, :3].T
        in_faro = R_t @ (sphere - T[:3, 3])
        scanned = self.faro_m + sum(b @ values[n] for n, b in self.scanned.items())
        residual = np.concatenate([lower - p, across, scanned - in_faro]) / self.sigmas_m
        root = np.sqrt(self.weights)
        if not derivatives:
            return root * residual, None
        found = self._derivatives(g, rod, R_t, in_faro)
        found[self.gravity] = found[self.gravity] @ by_gravity
        return root * residual, {n: d * np.c_[root] for n, d in found.items()}

    def _derivatives(
        self, g: np.ndarray, rod: np.ndarray, R_t: np.ndarray, in_faro: np.ndarray
    ) -> Derivatives:
        """By each unknown; of gravity, by its unit vector."""
        marker, sphere, eye = 1.0 / self.sigma_marker_m, 1.0 / self.sigma_sphere_m, np.eye(3)
        along = np.outer(g, g)
        by_p = np.vstack([-eye * marker, (along - eye) * marker, -R_t * sphere])
        by_g = np.zeros((9, 3))
        by_g[3:6] = -((g @ rod) * eye + np.outer(g, rod)) * marker
        by_g[6:9] = -self.below_m * R_t * sphere
        by_T = np.zeros((9, 6))
        x, y, z = in_faro
        by_T[6:9, :3] = -np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) * sphere
        by_T[6:9, 3:] = eye * sphere
        d = {self.marker: by_p, self.gravity: by_g, self.reference: by_T}
        for name, basis in self.shift.items():
            d[name] = np.vstack([np.zeros((6, basis.shape[1])), -R_t @ basis * sphere])
        for name, basis in self.scanned.items():
            d[name] = np.vstack([np.zeros((6, basis.shape[1])), basis * sphere])
        for name, (lower, upper) in self.tracked.items():
            of_markers = np.vstack([-lower, (along - eye) @ upper]) * marker
            d[name] = np.vstack([of_markers, np.zeros((3, lower.shape[1]))])
        return d
