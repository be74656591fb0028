"""How a LiDAR's range lies."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calib.effects.base import Effect, OneHot, Param, Site, View
from calib.effects.basis import RANGE, beam, incidence_rad, place_of, range_m, settled, warmer_k
from calib.rig import Rig

STUDY = "Pushing the Limits of LiDAR: Accurate Performance Analysis of Indoor 3D LiDARs"
FAINTEST = 0.01  # of the median intensity: about 1 count of 8 bits, where a room's median is 100


class RangeEffect(Effect):
    """One number that lengthens every range: a subclass gives its unit, sigma and column."""

    site = Site.BEAM
    unit = "m"
    sigma: float
    param = "amount"

    def params(self, rig: Rig) -> tuple[Param, ...]:
        return (Param(self.param, self.unit, self.sigma),) if rig.lidar else ()

    def basis(self, view: View) -> np.ndarray:
        return beam(RANGE, self.column(view))

    def column(self, view: View) -> np.ndarray:
        """By how much range grows per unit of the parameter, (rows,) or (1,)."""
        raise NotImplementedError


class RangeOffset(RangeEffect):
    """The whole sensor has one range zero: ``measured = true + a``."""

    name = "range_offset"
    sigma = 0.01
    formula = "range = true + a"
    typical = "0.5 to 25 mm; new units of one maker beyond 60 mm"
    confounded_with = ("ring_range_offset", "incidence_angle_bias", "label_range_offset")
    source = f"{STUDY}, Table 5; issue 86 of SICKAG/sick_scan"

    def column(self, view: View) -> np.ndarray:
        return np.ones(1)


class RangeScale(RangeEffect):
    """The range clock runs slow or fast: ``measured = true * (1 + k)``."""

    name = "range_scale"
    unit, sigma = "1", 0.001
    formula = "range = true + k * true"
    typical = "up to 100 ppm from a clock; 1000 ppm where mesh or tracker have another scale"
    covariates = ("range_m",)
    confounded_with = ("faro_scale", "range_offset", "optitrack_scale", "intensity_range_walk")
    source = "size assumed"

    def column(self, view: View) -> np.ndarray:
        return range_m(view)


class RingRangeOffset(Effect):
    """Every ring has its own range zero: ``measured = true + a_ring``."""

    name = "ring_range_offset"
    site = Site.BEAM
    unit = "m"
    formula = "range = true + a_ring"
    typical = "1 to 25 mm, patterned over the rings"
    covariates = ("ring",)
    of_members = True
    confounded_with = ("range_offset", "ring_elevation_offset", "near_range_bias")
    source = f"{STUDY}, Fig. 9; Velodyne HDL-64E factory tables"

    def params(self, rig: Rig) -> tuple[Param, ...]:
        rings = rig.lidar.rings if rig.lidar else 0
        return tuple(Param(f"ring_{k:03d}", "m", 0.05) for k in range(rings))

    def basis(self, view: View) -> OneHot:
        ring = view["ring"]
        along = np.broadcast_to([1.0, 0.0, 0.0], (len(ring), 3))
        return OneHot(ring, along, view.rig.lidar.rings)


class RangeCyclic(Effect):
    """The range clock is uneven within its period: a sine of range."""

    name = "range_cyclic"
    site = Site.BEAM
    unit = "m"
    formula = "range = true + a * sin(2 pi * true / L) + b * cos(2 pi * true / L)"
    typical = "1 to 5 mm, size assumed"
    covariates = ("range_m",)
    confounded_with = ("range_step", "near_range_bias", "range_quantisation")
    source = "Lichti and Licht 2006, ISPRS Archives XXXVI-5: additional parameters of scanners"
    shape_name, shape = "wavelength_m", 1.0
    repeats = True

    def shapes(self, stops: View) -> tuple[float, ...]:
        """Even in 1 / L, from 0.3 to 4 m, so that over 5 m none lies between two unseen."""
        return tuple(float(f"{1 / wave:.3g}") for wave in np.linspace(1 / 4.0, 1 / 0.3, 21)[::-1])

    def params(self, rig: Rig) -> tuple[Param, ...]:
        return tuple(Param(n, "m", 0.003) for n in ("sin", "cos")) if rig.lidar else ()

    def basis(self, view: View) -> np.ndarray:
        phase = 2 * np.pi * range_m(view) / self.shape
        return beam(RANGE, np.sin(phase), np.cos(phase))


class NearRangeBias(RangeEffect):
    """Near returns saturate the receiver: an error that fades with range."""

    name = "near_range_bias"
    sigma = 0.01
    formula = "range = true + c * exp(-true / r0)"
    typical = "1 to 20 mm below 1 m, size assumed"
    covariates = ("range_m",)
    confounded_with = ("ring_range_offset", "intensity_range_walk", "range_offset")
    source = "near and far point correction: Velodyne HDL-64E S3 manual"
    shape_name, shape = "r0_m", 0.8

    def shapes(self, stops: View) -> tuple[float, ...]:
        return (0.3, 0.5, 0.8, 1.3, 2.0)

    def column(self, view: View) -> np.ndarray:
        return np.exp(-range_m(view) / self.shape)


class RangeStep(RangeEffect):
    """Beyond some range the sensor works in another mode. It fires, or amplifies, differently."""

    name = "range_step"
    sigma = 0.005
    formula = "range = true + s where true > r_s"
    typical = "1 to 10 mm, size assumed; one sensor changes its mode at 2.85 m"
    covariates = ("range_m",)
    confounded_with = ("range_cyclic", "near_range_bias", "range_scale")
    source = "near- and far-field firing: Hesai Pandar128E3X manual"
    shape_name, shape = "r_s_m", 2.75
    jumps = repeats = True

    def shapes(self, stops: View) -> tuple[float, ...]:
        return tuple(np.arange(1.0, 5.01, 0.25).tolist())

    def column(self, view: View) -> np.ndarray:
        return (range_m(view) > self.shape).astype(float)


class IncidenceAngleBias(RangeEffect):
    """A slanted surface stretches the pulse: ``measured = true + k * (1 / cos(g) - 1)``.

    The sign is open: a stretched pulse reads short, a weakened one long.
    """

    name = "incidence_angle_bias"
    sigma = 0.003
    formula = "range = true + k * (1 / cos(incidence) - 1)"
    typical = "1 to 10 mm at 60 degrees; up to 0.2 m where the beam grazes"
    covariates = ("incidence_rad",)
    confounded_with = ("range_offset", "ring_elevation_offset", "intensity_range_walk")
    source = "Laconte et al., Lidar Measurement Bias Estimation; Agishev et al., arXiv 2303.01123"

    def column(self, view: View) -> np.ndarray:
        return 1.0 / np.cos(incidence_rad(view)) - 1.0


class IntensityRangeWalk(RangeEffect):
    """A weak pulse crosses the threshold later: range walks with the intensity's logarithm."""

    name = "intensity_range_walk"
    sigma = 0.002
    formula = "range = true + w * ln(I / I0), I0 the recording's median intensity, I >= I0 / 100"
    typical = "1 to 15 mm per decade, w < 0, size assumed"
    covariates = ("intensity",)
    confounded_with = ("label_range_offset", "range_scale", "incidence_angle_bias")
    source = "range walk of leading-edge detection; size assumed"

    def column(self, view: View) -> np.ndarray:
        return log_intensity(view)


class LabelRangeOffset(Effect):
    """Light enters some materials before it returns: every label has its own range zero."""

    name = "label_range_offset"
    site = Site.BEAM
    unit = "m"
    formula = "range = true + m_label"
    typical = "0 to 10 mm; none found on stone"
    covariates = ("label",)
    of_members = True
    sigma = 0.005
    confounded_with = ("intensity_range_walk", "moved_surface", "range_offset")
    source = "Lenda 2015, PFG: plexiglas and polystyrene; Lichti and Harvey: none on stone"

    def params(self, rig: Rig) -> tuple[Param, ...]:
        names = rig.labels.items() if rig.lidar else ()
        return tuple(Param(f"{number}_{name}", "m", self.sigma) for number, name in names)

    def basis(self, view: View) -> OneHot:
        index = place_of(view["label"], np.array(list(view.rig.labels)))
        along = np.broadcast_to([1.0, 0.0, 0.0], (len(index), 3))
        return OneHot(index, along, len(view.rig.labels))


class LabelIncidenceBias(LabelRangeOffset):
    """Light that enters a material at a slant goes further in it: every label has its own
    `incidence_angle_bias`."""

    name = "label_incidence_bias"
    sigma = IncidenceAngleBias.sigma
    formula = "range = true + k_label * (1 / cos(incidence) - 1)"
    typical = "1 to 10 mm at 60 degrees of what is translucent or polished, else 0; size assumed"
    covariates = ("label", "incidence_rad")
    confounded_with = ("incidence_angle_bias", "label_range_offset", "moved_surface")
    source = "as `incidence_angle_bias` and `label_range_offset`; size assumed"

    def basis(self, view: View) -> OneHot:
        return replace(super().basis(view), values=IncidenceAngleBias().basis(view)[..., 0])


class WarmupDrift(RangeEffect):
    """The sensor warms up after the first stop; what it did before is a range offset."""

    name = "warmup_drift"
    sigma = 0.005
    formula = "range = true + D * (1 - exp(-t / tau)), t since the first stop"
    typical = "1 to 10 mm within 5 to 30 minutes, size assumed"
    covariates = ("elapsed_s",)
    confounded_with = ("temperature_drift", "mount_creep", "range_offset")
    source = "Glennie and Lichti 2011, Remote Sensing 3(3):539: stability of an HDL-64E"
    shape_name, shape = "tau_s", 600.0

    def shapes(self, stops: View) -> tuple[float, ...]:
        return (120.0, 240.0, 480.0, 900.0, 1800.0, 3600.0)

    def column(self, view: View) -> np.ndarray:
        return settled(view["elapsed_s"], self.shape)


class TemperatureDrift(RangeEffect):
    """Range drifts with the temperature: ``measured = true + k * (T - 20)``."""

    name = "temperature_drift"
    unit, sigma = "m/K", 0.001
    formula = "range = true + k * (temperature - 20 degrees C)"
    typical = "0.1 to 1 mm per kelvin, size assumed"
    covariates = ("temperature_c",)
    confounded_with = ("warmup_drift", "range_offset")
    source = "Glennie and Lichti 2011, Remote Sensing 3(3):539: stability of an HDL-64E"

    def column(self, view: View) -> np.ndarray:
        return warmer_k(view)


class AzimuthRangeHarmonic(Effect):
    """Window and housing reflect stray light: range depends on azimuth, once to 4 times a turn."""

    name = "azimuth_range_harmonic"
    site = Site.BEAM
    unit = "m"
    formula = "range = true + sum over m = 1..4 of s_m sin(m * azimuth) + c_m cos(m * azimuth)"
    typical = "1 to 10 mm, size assumed; more than 60 mm behind one product's rear window"
    covariates = ("azimuth_rad",)
    confounded_with = ("lidar", "mount", "encoder_eccentricity")
    source = "issue 86 of SICKAG/sick_scan: rear reflection, cured by an opaque cover"

    orders = (1, 2, 3, 4)

    def params(self, rig: Rig) -> tuple[Param, ...]:
        names = [f"{f}_{m}" for m in self.orders for f in ("sin", "cos")]
        return tuple(Param(name, "m", 0.002) for name in names) if rig.lidar else ()

    def basis(self, view: View) -> np.ndarray:
        azimuth = view["azimuth_rad"]
        return beam(RANGE, *(f(m * azimuth) for m in self.orders for f in (np.sin, np.cos)))


class RangeQuantisation(RangeEffect):
    """The readout rounds range to its step; 1 is rounding in full.

    Noise of half a step or more dithers the step away: of the error in the mean over a hold no more
    than exp(-2 (pi sigma / q)^2) is left, and what rounding adds to the scatter is in the data
    sheet's sigma. So the effect is there only for a LiDAR whose sigma is below a third of its step;
    and as range must then be predicted to a fraction of the step too, it is seldom to be trusted.
    """

    name = "range_quantisation"
    unit, sigma, param = "1", 1.0, "share"
    formula = "range = true + share * (q * round(true / q) - true), q the sensor's step"
    typical = "0 or 1; a step of 3 or 4 mm moves range by up to 2 mm"
    covariates = ("range_m",)
    confounded_with = ("range_cyclic",)
    source = "4 mm: Hesai PandarQT and PandarXT manuals; 1 to 8 mm: Ouster OS1 manual"

    def params(self, rig: Rig) -> tuple[Param, ...]:
        lidar = rig.lidar
        return super().params(rig) if lidar and lidar.quantum_m > 3 * lidar.sigma_range_m else ()

    def column(self, view: View) -> np.ndarray:
        step_m, true_m = view.rig.lidar.quantum_m, range_m(view)
        return step_m * np.rint(true_m / step_m) - true_m


def log_intensity(view: View) -> np.ndarray:
    """``ln(I / I0)`` of the intensity (rows,), which a view gives over the median I0 already: taken
    as I0 / 100 below that, and as I0 where none was recorded."""
    relative = view["intensity"]
    return np.log(np.maximum(np.where(np.isfinite(relative), relative, 1.0), FAINTEST))
