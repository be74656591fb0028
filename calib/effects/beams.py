"""How a LiDAR's beams point elsewhere than it says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calib.effects.base import Effect, OneHot, Param, Site, View
from calib.effects.basis import AZIMUTH, ELEVATION, Slips, beam, range_m
from calib.rig import Rig

NEAREST_M = 0.1  # nothing is nearer: keeps angles of offsets finite


class RingElevationOffset(Effect):
    """Every ring points higher or lower than its table says: ``measured = true + d_ring``."""

    name = "ring_elevation_offset"
    site = Site.BEAM
    unit = "rad"
    formula = "elevation = true + d_ring"
    typical = "0.2 to 2 mrad"
    covariates = ("ring",)
    of_members = True
    confounded_with = ("ring_range_offset", "incidence_angle_bias", "beam_origin_offset")
    source = "Glennie and Lichti 2010, Remote Sensing 2(6):1610; Ouster OS1 data sheet: 0.01 deg"
    axis = ELEVATION

    def params(self, rig: Rig) -> tuple[Param, ...]:
        rings = rig.lidar.rings if rig.lidar else 0
        return tuple(Param(f"ring_{k:03d}", "rad", 0.001) for k in range(rings))

    def basis(self, view: View) -> OneHot:
        ring = view["ring"]
        turn = np.broadcast_to(np.eye(3)[self.axis], (len(ring), 3))
        return OneHot(ring, turn, view.rig.lidar.rings)


class RingAzimuthOffset(RingElevationOffset):
    """Every ring points to the side of where its table says: ``measured = true + d_ring``."""

    name = "ring_azimuth_offset"
    formula = "azimuth = true + d_ring"
    typical = "0.2 to 2 mrad; degrees with another unit's table"
    confounded_with = ("lidar", "ring_elevation_offset", "encoder_eccentricity")
    source = "angle correction files of single units: Hesai PandarQT and PandarXT manuals"
    axis = AZIMUTH


class RingSlips(Slips):
    """What rings do from a time on, as their offset does all the time."""

    covariates = ("ring", "elapsed_s")
    repeats = False  # of the one time that is asked for nothing would be left

    def shapes(self, stops: View) -> tuple[float, ...]:
        """The middle one alone, as each has a parameter for every ring: what changes earlier or
        later goes with it in part, and a fit that has it goes on to others."""
        every = super().shapes(stops)
        return every[len(every) // 2 :][:1]

    def basis(self, view: View) -> OneHot:
        whole = super().basis(view)
        return replace(whole, values=whole.values * self.when(view["elapsed_s"])[:, None])


class RingElevationSlip(RingSlips, RingElevationOffset):
    """From a time on, rings point higher or lower: another table of them, as by an update."""

    name = "ring_elevation_slip"
    formula = "elevation = true + d_ring where t > t_s, t since the first stop"
    confounded_with = ("ring_elevation_offset", "lidar_slip", "tracker_slip")
    source = "size assumed"


class RingAzimuthSlip(RingSlips, RingAzimuthOffset):
    """From a time on, rings point to the side: another table of them, as by an update."""

    name = "ring_azimuth_slip"
    formula = "azimuth = true + d_ring where t > t_s, t since the first stop"
    confounded_with = ("ring_azimuth_offset", "lidar_slip", "ring_elevation_slip")
    source = "size assumed"


class ElevationScale(Effect):
    """Elevations are stretched: ``measured = true * (1 + k)``."""

    name = "elevation_scale"
    site = Site.BEAM
    unit = "1"
    formula = "elevation = true + k * true"
    typical = "0.1 to 0.5 percent, size assumed"
    covariates = ("elevation_rad",)
    confounded_with = ("beam_origin_offset", "ring_elevation_offset", "incidence_angle_bias")
    source = "size assumed"

    def params(self, rig: Rig) -> tuple[Param, ...]:
        return (Param("scale", "1", 0.002),) if rig.lidar else ()

    def basis(self, view: View) -> np.ndarray:
        return beam(ELEVATION, view["elevation_rad"])


class EncoderEccentricity(Effect):
    """The encoder's disc sits off its axis: azimuth errs once a turn."""

    name = "encoder_eccentricity"
    site = Site.BEAM
    unit = "rad"
    formula = "azimuth = true + a * sin(azimuth) + b * cos(azimuth)"
    typical = "0.1 to 1 mrad: 10 um on a radius of 12.5 mm make 0.8 mrad"
    covariates = ("azimuth_rad",)
    confounded_with = ("lidar", "mount", "azimuth_range_harmonic")
    source = "eccentricity table of torquety.com; Glennie and Lichti 2011, Remote Sensing 3(3):539"
    axis, times = AZIMUTH, 1

    def params(self, rig: Rig) -> tuple[Param, ...]:
        return tuple(Param(n, "rad", 0.001) for n in ("sin", "cos")) if rig.lidar else ()

    def basis(self, view: View) -> np.ndarray:
        turn = self.times * view["azimuth_rad"]
        return beam(self.axis, np.sin(turn), np.cos(turn))


class EncoderSecondHarmonic(EncoderEccentricity):
    """Two read heads leave the second harmonic. They cancel the first."""

    name = "encoder_second_harmonic"
    formula = "azimuth = true + a * sin(2 azimuth) + b * cos(2 azimuth)"
    typical = "0.05 to 0.5 mrad, size assumed"
    confounded_with = ("spin_axis_wobble",)
    source = "elliptic discs and pairs of read heads: Cramer, encoder tools"
    times = 2


class SpinAxisWobble(EncoderEccentricity):
    """The spin axis wobbles: elevation errs twice a turn; once a turn is how the LiDAR sits."""

    name = "spin_axis_wobble"
    formula = "elevation = true + a * sin(2 azimuth) + b * cos(2 azimuth)"
    typical = "0.05 to 0.5 mrad, size assumed"
    confounded_with = ("encoder_second_harmonic", "ring_elevation_offset")
    source = "size assumed"
    axis, times = ELEVATION, 2


class BeamOriginOffset(Effect):
    """Beams start elsewhere than ``lidar.beam_origin_m`` says: further out by H, to the left by B.

    Range is referred to the sensor's centre, as makers do: ``r - H cos(elevation)`` is measured
    from where the beam starts. To first order H bends beams up and B turns them, less the further
    the surface.
    """

    name = "beam_origin_offset"
    site = Site.BEAM
    unit = "m"
    formula = (
        "elevation = true + H * sin(elevation) / range, "
        "azimuth = true - B / (range * cos(elevation) + H0); (H0, B0) = lidar.beam_origin_m"
    )
    typical = "H 28 to 32 mm and B up to 13 mm, where a driver leaves its correction off"
    covariates = ("range_m", "elevation_rad")
    confounded_with = ("elevation_scale", "ring_elevation_offset", "lidar", "near_range_azimuth")
    source = "optical centre in Hesai's drivers; lidar_origin_to_beam_origin in Ouster's SDK"

    def params(self, rig: Rig) -> tuple[Param, ...]:
        return tuple(Param(n, "m", 0.01) for n in ("radial", "tangential")) if rig.lidar else ()

    def basis(self, view: View) -> np.ndarray:
        ahead, left = view.rig.lidar.beam_origin_m
        reach_m = np.maximum(range_m(view), NEAREST_M)
        c, s = np.cos(view["elevation_rad"]), np.sin(view["elevation_rad"])
        turn = 1.0 / np.maximum(reach_m * c + ahead, NEAREST_M)
        basis = np.zeros((len(reach_m), 3, 2))
        basis[:, 2, 0] = s / reach_m
        # Turning a beam whose origin lies to the left also pushes it along its azimuth.
        basis[:, 0, 1] = -left * turn * c
        basis[:, 1, 1] = -turn
        basis[:, 2, 1] = left * turn * s / reach_m
        return basis


class NearRangeAzimuth(Effect):
    """Near returns come from the side of the spot: azimuth errs more the nearer."""

    name = "near_range_azimuth"
    site = Site.BEAM
    unit = "rad"
    formula = "azimuth = true + c * exp(-range / r0)"
    typical = "0.5 to 4 mrad below 4 m"
    covariates = ("range_m",)
    confounded_with = ("beam_origin_offset", "lidar")
    source = "spot correction of the PandarXT-32, off by default: parser of Hesai's SDK 2"
    shape_name, shape = "r0_m", 1.0

    def shapes(self, stops: View) -> tuple[float, ...]:
        return (0.5, 1.0, 2.0, 4.0)

    def params(self, rig: Rig) -> tuple[Param, ...]:
        return (Param("amount", "rad", 0.003),) if rig.lidar else ()

    def basis(self, view: View) -> np.ndarray:
        return beam(AZIMUTH, np.exp(-range_m(view) / self.shape))
