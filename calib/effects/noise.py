"""How the range's scatter differs from the LiDAR's data sheet."""

from __future__ import annotations

import numpy as np

from calib.effects.base import Effect, Param, Site, View
from calib.effects.basis import incidence_rad, range_m
from calib.effects.range import STUDY, log_intensity
from calib.rig import Rig


class NoiseRange(Effect):
    """Range scatters more the further the surface: its sigma grows as a power of range."""

    name = "noise_range"
    site = Site.NOISE
    unit = "1"
    formula = "sigma = nominal * (range / 3 m)^b"
    typical = "b of 0 to 0.7"
    covariates = ("range_m",)
    confounded_with = ("noise_intensity",)
    source = f"{STUDY}, Fig. 7"
    sigma = 0.4

    def params(self, rig: Rig) -> tuple[Param, ...]:
        return (Param("power", "1", self.sigma),) if rig.lidar else ()

    def basis(self, view: View) -> np.ndarray:
        return self.log_growth(view)[:, None, None]

    def log_growth(self, view: View) -> np.ndarray:
        """Logarithm (rows,) of what the power is of."""
        return np.log(np.maximum(range_m(view), 0.1) / 3.0)


class NoiseIncidence(NoiseRange):
    """Range scatters more on slanted surfaces: its sigma grows as a power of 1 / cos."""

    name = "noise_incidence"
    formula = "sigma = nominal * (1 / cos(incidence))^b"
    typical = "b of 0 to 1"
    covariates = ("incidence_rad",)
    source = "Soudarissanane et al. 2009: incidence dominates beyond 60 degrees"

    def log_growth(self, view: View) -> np.ndarray:
        """Logarithm (rows,) of what the power is of."""
        return -np.log(np.cos(incidence_rad(view)))


class NoiseIntensity(NoiseRange):
    """Weak returns scatter more: sigma grows as a power of 1 / intensity."""

    name = "noise_intensity"
    formula = "sigma = nominal * (I0 / I)^b, I0 the recording's median intensity, I >= I0 / 100"
    typical = "b of 0.5 to 0.8"
    covariates = ("intensity",)
    confounded_with = ("noise_range", "noise_incidence")
    source = "Wujanz et al. 2018, Sensors 18(7):2187; Ouster OS1 data sheet"

    def log_growth(self, view: View) -> np.ndarray:
        """Logarithm (rows,) of what the power is of."""
        return -log_intensity(view)
