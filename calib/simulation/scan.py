"""What the LiDAR returned at one stop: true rays, and everything that is wrong with them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from calib.effects import LazyColumn, Site, View
from calib.simulation.room import Room
from calib.simulation.spec import Spec
from calib.simulation.truth import Truth
from chains import se3
from sensors.lidar import LidarModel
from sensors.reference import Hits

NO_RETURN_RAD = np.radians(86.0)  # a choice: flatter beams glance off
RETURNED = 0.99  # share of the sweeps in which a direction returns anything
STRAY_SD_M = 0.1  # sd of a range that is wrong for no visible reason
EDGE_STEP_M = 0.05  # two surfaces this far apart along a beam mix
# Beams that are looked at for an edge, for each that is to be mixed: each costs a ray. In the
# preset `default` 1.9 % find one, so that a fifth of the mixed pixels lie at edges.
PROBES_PER_MIXED = 12


@dataclass(frozen=True)
class EmittedBeams:
    """N beams: ring, column, and where each truly points, in the LiDAR's frame."""

    ring: np.ndarray
    column: np.ndarray
    azimuth_rad: np.ndarray
    elevation_rad: np.ndarray

    def __getitem__(self, rows: np.ndarray) -> EmittedBeams:
        return EmittedBeams(*(v[rows] for v in vars(self).values()))


@dataclass(frozen=True)
class Scanner:
    """A simulated LiDAR in its room.

    Args:
        truth, room, spec: of the world.
        median_intensity: of all that it will return; NaN where no effect asks for it.
    """

    truth: Truth
    room: Room
    spec: Spec
    median_intensity: float = float("nan")

    @property
    def lidar(self) -> LidarModel:
        """The model on paper."""
        return self.truth.rig.lidar

    def scan(
        self,
        T_faro_lidar: np.ndarray,
        stop: Mapping[str, np.ndarray],
        joints: np.ndarray,
        rng: np.random.Generator,
    ) -> dict[str, np.ndarray]:
        """The columns of one stop's scan file.

        ``measured = true + effects + noise`` for range, azimuth and elevation. Averages over a hold
        are drawn from their distribution, never summed: the mean of n sweeps has sigma / sqrt(n),
        their spread is sigma * chi(n-1) / sqrt(n-1).

        Args:
            T_faro_lidar: (4, 4) true pose.
            stop: (1,) columns of the stop.
            joints: (1, J) as reported.
            rng: this stop's noise.
        """
        beams, hits = self._meet(T_faro_lidar)
        intensity = self._intensity(hits, rng)
        view = self._view(beams, hits, intensity, stop, joints)
        error = np.broadcast_to(self.truth.error(Site.BEAM, view, (3,)), (len(hits.range_m), 3))
        range_m = hits.range_m + error[:, 0] + self._displaced(hits, view)
        range_m = self._mix(range_m, T_faro_lidar, beams, rng)
        scatter = self.spec.noise * np.exp(self.truth.error(Site.NOISE, view, (1,))[:, 0])
        sigma_m = scatter * self.lidar.sigma_range(hits.range_m, hits.incidence_rad)
        sigma_rad = self.spec.noise * self.lidar.sigma_angle_rad
        azimuth, elevation = (
            true + added + sigma_rad * rng.standard_normal(len(true))
            for true, added in (
                (beams.azimuth_rad, error[:, 1]),
                (beams.elevation_rad, error[:, 2]),
            )
        )
        shots = self._sweeps if self.spec.raw else self._average
        rows, range_m, extra = shots(range_m, sigma_m, rng)
        origin, direction = beam(azimuth[rows], elevation[rows], self.lidar.beam_origin_m)
        xyz = (origin + range_m[:, None] * direction).astype(np.float32)
        return dict(zip("xyz", xyz.T, strict=True)) | {
            "ring": beams.ring[rows].astype(np.uint16),
            "column": beams.column[rows].astype(np.uint16),
            "intensity": intensity[rows].astype(np.float32),
            **extra,
        }

    def intensities(self, T_faro_lidar: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Those (N,) of one stop's beams, as `scan` draws them first of all."""
        return self._intensity(self._meet(T_faro_lidar)[1], rng)

    def _meet(self, T_faro_lidar: np.ndarray) -> tuple[EmittedBeams, Hits]:
        """The beams that return, and what they hit."""
        lidar = self.lidar
        columns = np.arange(0, lidar.columns, self.spec.column_step)
        ring, column = (a.ravel() for a in np.meshgrid(np.arange(lidar.rings), columns))
        u = lidar.directions(ring, column)
        azimuth, elevation = np.arctan2(u[:, 1], u[:, 0]), np.arcsin(u[:, 2])
        beams = EmittedBeams(ring, column, azimuth, elevation)
        hits = self._cast(T_faro_lidar, azimuth, elevation)
        near, far = lidar.min_range_m, lidar.max_range_m
        back = (hits.range_m > near) & (hits.range_m < far) & (hits.incidence_rad < NO_RETURN_RAD)
        kept = np.flatnonzero(back)
        return beams[kept], Hits(**{name: v[kept] for name, v in vars(hits).items()})

    def _cast(self, T_faro_lidar: np.ndarray, azimuth: np.ndarray, elevation: np.ndarray) -> Hits:
        origin, direction = beam(azimuth, elevation, self.lidar.beam_origin_m)
        R = T_faro_lidar[:3, :3]
        return self.room.true.cast(se3.apply(T_faro_lidar, origin), direction @ R.T)

    def _intensity(self, hits: Hits, rng: np.random.Generator) -> np.ndarray:
        """``800 rho cos(g) / (r^2 + (2 m)^2)``: Lambert's law, and less of it up close."""
        strength = self.room.reflectivity[hits.triangle] * np.cos(hits.incidence_rad)
        speckle = np.exp(0.03 * self.spec.noise * rng.standard_normal(len(strength)))
        return 800.0 * strength / (hits.range_m**2 + 4.0) * speckle

    def _view(
        self,
        beams: EmittedBeams,
        hits: Hits,
        intensity: np.ndarray,
        stop: Mapping[str, np.ndarray],
        joints: np.ndarray,
    ) -> View:
        mesh = self.room.measured
        columns: dict[str, LazyColumn] = {
            **stop,
            "ring": beams.ring,
            "column": beams.column,
            "azimuth_rad": beams.azimuth_rad,
            "elevation_rad": beams.elevation_rad,
            "intensity": intensity / self.median_intensity,
            "range_m": hits.range_m,
            "incidence_rad": hits.incidence_rad,
            "label": hits.label,
            "reference_intensity": hits.intensity,
            "normal": hits.normal,
            "point_m": hits.point_m,
            "surface": lambda: mesh.surface[hits.triangle],
        }
        return View(self.truth.rig, len(hits.range_m), columns, joints)

    def _displaced(self, hits: Hits, view: View) -> np.ndarray:
        """By how much longer (N,) m the range is as the surface truly lies off the mesh.

        ``n.d / n.u``, where the normal n faces the sensor, so ``n.u = -cos(incidence)``.
        """
        outwards_m = (self.truth.error(Site.REFERENCE, view, (3,)) * hits.normal).sum(axis=1)
        return -outwards_m / np.cos(hits.incidence_rad)

    def _mix(
        self,
        range_m: np.ndarray,
        T_faro_lidar: np.ndarray,
        beams: EmittedBeams,
        rng: np.random.Generator,
    ) -> np.ndarray:
        """Spoil a share of the ranges: half at depth edges, if there are so many, between the two
        surfaces that the beam's footprint touches, the others off by 0.1 m or so."""
        wanted = rng.binomial(len(range_m), self.spec.mixed_pixel_share)
        order = rng.permutation(len(range_m))
        probed = order[: PROBES_PER_MIXED * wanted]
        turn = rng.uniform(0, 2 * np.pi, len(probed))
        reach = self.lidar.beam_divergence_rad / 2
        beside = self._cast(
            T_faro_lidar,
            beams.azimuth_rad[probed] + reach * np.cos(turn) / np.cos(beams.elevation_rad[probed]),
            beams.elevation_rad[probed] + reach * np.sin(turn),
        )
        step_m = np.where(np.isfinite(beside.range_m), beside.range_m, np.nan) - range_m[probed]
        edges = np.flatnonzero(np.abs(step_m) > EDGE_STEP_M)[: wanted // 2]
        spoilt = range_m.copy()
        spoilt[probed[edges]] += rng.uniform(0.1, 0.9, len(edges)) * step_m[edges]
        others = order[len(order) - (wanted - len(edges)) :]
        spoilt[others] += STRAY_SD_M * rng.standard_normal(len(others))
        return np.maximum(spoilt, self.lidar.min_range_m)

    def _average(
        self, range_m: np.ndarray, sigma_m: np.ndarray, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
        """Which beams returned, their mean ranges, and the columns of an average."""
        count = rng.binomial(self.spec.sweeps, RETURNED, len(range_m))
        rows = np.flatnonzero(count)
        n, sigma_m = count[rows], sigma_m[rows]
        mean_m = range_m[rows] + sigma_m / np.sqrt(n) * rng.standard_normal(len(rows))
        dof = np.maximum(n - 1, 1)
        spread_m = np.where(n > 1, sigma_m * np.sqrt(rng.chisquare(dof) / dof), np.nan)
        extra = {"count": n.astype(np.uint16), "range_std_m": spread_m.astype(np.float32)}
        return rows, mean_m, extra

    def _sweeps(
        self, range_m: np.ndarray, sigma_m: np.ndarray, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
        """Which beam each return of every sweep belongs to, its range as read out, its sweep."""
        back = rng.random((self.spec.sweeps, len(range_m))) < RETURNED
        sweep, rows = np.nonzero(back)
        step_m = self.lidar.quantum_m
        # The model's sigma holds the readout's step, which rounding adds here.
        analogue_m = np.sqrt(np.maximum(sigma_m**2 - step_m**2 / 12, 0.0))[rows]
        shot_m = range_m[rows] + analogue_m * rng.standard_normal(len(rows))
        if step_m:
            shot_m = step_m * np.rint(shot_m / step_m)
        return rows, shot_m, {"scan": sweep.astype(np.uint16)}


def beam(
    azimuth_rad: np.ndarray, elevation_rad: np.ndarray, origin_m: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Origin (N, 3) m and direction (N, 3) of beams in the LiDAR's frame.

    The origin of a beam lies `origin_m` = (ahead, left) of the spin axis, and turns with it.
    """
    c, s = np.cos(azimuth_rad), np.sin(azimuth_rad)
    ahead, left = origin_m
    flat = np.cos(elevation_rad)
    origin = np.stack([ahead * c - left * s, ahead * s + left * c, 0 * c], axis=1)
    return origin, np.stack([flat * c, flat * s, np.sin(elevation_rad)], axis=1)
