"""One stop's scan as rows: read, associated, weighted honestly.

A stop is computed from the recording and a state alone, so stops can be computed anywhere.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from calib.effects import LazyColumn, OneHot, Site, View
from calib.forward import Stops, Term, Values
from calib.residuals.beams import (
    Association,
    CellNumbers,
    Columns,
    Ranges,
    Rows,
    Surface,
    beam_derivative,
    effect_columns,
    growth_columns,
    range_columns,
    site_error,
    turns_beams,
    zero_at,
)
from calib.residuals.compiled import twist_derivative
from calib.residuals.groups import Group
from calib.residuals.robust import robust_scale, tukey_weight
from calib.residuals.spread import spread_rows
from calib.residuals.store import BeamStore, SomeBeams, common_median, drawn_of_each
from calib.residuals.surfaces import Meeting
from chains import se3
from chains.errors import InputError, NothingMetError
from sensors.holds import spread_known
from sensors.lidar import Beams, LidarModel
from sensors.recording import RecordedStops, Scan

SIZE = {Site.BEAM: 3, Site.REFERENCE: 3, Site.NOISE: 1}
# A measured spread of fewer sweeps than this leans on the datasheet: a choice; of so many, a sigma
# is known to a sixth.
PRIOR_COUNT = 20.0
MET = {"label": -1, "incidence_rad": np.nan}  # and what they are where nothing is met
MET_PARTS = ("surface", "region", "patch", "plane")  # of what is met: no column of a user's
# Of the variance of a patch of the reference, between its neighbouring points: a choice, as errors
# of scans and planes are smooth.
LOCAL_SHARE = 0.05


@dataclass(frozen=True)
class _Seen:
    """A scan, its beams as they truly pointed, what they meet, and the error at each site."""

    scan: Scan
    ray: Beams
    surface: Surface
    view: View
    bases: Mapping[str, tuple[Site, np.ndarray | OneHot]]
    error: Mapping[Site, np.ndarray]
    shift_m: np.ndarray | float  # (N,) of the surfaces along their normals, by unknowns of theirs
    cells: Sequence[Columns]  # by those unknowns, of that shift

    def error_at(self, site: Site, rows: np.ndarray) -> np.ndarray:
        """The error (R, D) at some rows."""
        error = self.error[site]
        shape = len(rows), error.shape[1]
        return error[rows] if len(error) > 1 else np.broadcast_to(error, shape)


@dataclass(frozen=True)
class ScanStop:
    """One stop's beams against what they meet.

    Args:
        name: for messages.
        recording, index: where the scan is read.
        stops: geometry of this stop (K = 1).
        terms: the model's effects at BEAM, REFERENCE and NOISE.
        columns: (1,) covariates of the stop.
        meeting: mesh or planes.
        reference_sigma_m: how far the reference may be off its surface.
        store, alike: its recording's scans as beams, and those of all recordings by this LiDAR.
        room: the mesh, or the recording whose planes these are.
        group: the name of its rows.
        cells: unknown of the surfaces -> which component moves what beams are known to meet.
        reference_scatter_m: kind of part, "surface", "region" or "patch", or "tilt" of whole
            surfaces -> how widely they scatter beyond what is stated of them; in
            `reference_sigma_m`.
    """

    name: str
    recording: RecordedStops
    index: int
    stops: Stops
    terms: Sequence[Term]
    columns: Mapping[str, np.ndarray]
    meeting: Meeting
    reference_sigma_m: float
    store: BeamStore | SomeBeams
    room: int | str
    group: Group
    reference_scatter_m: Mapping[str, float] = field(default_factory=dict, kw_only=True)
    alike: tuple[BeamStore, ...] = ()
    cells: Mapping[str, CellNumbers] = field(default_factory=dict, kw_only=True)

    @property
    def stated_sigma_m(self) -> float:
        """How far the reference may be off as rig.yaml has it, or the least that planes are."""
        beyond2 = sum(sd**2 for sd in self.reference_scatter_m.values())
        return float(np.sqrt(max(self.reference_sigma_m**2 - beyond2, 0.0)))

    @property
    def local_sigma_m(self) -> float:
        """How far neighbouring points of one patch may be off each other: a whole surface that is
        elsewhere is no rougher for that."""
        patch_m = self.reference_scatter_m.get("patch", 0.0)
        return float(np.sqrt(LOCAL_SHARE * (self.stated_sigma_m**2 + patch_m**2)))

    def scattering(self, part: str, sd_m: float) -> ScanStop:
        """The scan on a reference whose parts of one kind scatter otherwise beyond that."""
        scatter = {**self.reference_scatter_m, part: sd_m}
        sigma_m = float(np.sqrt(self.stated_sigma_m**2 + sum(sd**2 for sd in scatter.values())))
        return replace(self, reference_sigma_m=sigma_m, reference_scatter_m=scatter)

    @property
    def lidar(self) -> LidarModel:
        return self.stops.rig.lidar

    def pose(self, values: Values) -> np.ndarray:
        """T_reference_lidar (4, 4) at a state."""
        return self.stops.in_reference(self.stops.rig.lidar_frame, values, False).T[0]

    def associate(self, values: Values, near_edges: bool) -> Association:
        """Which part of the surface each beam meets, at a state."""
        _, ray = self._read()
        return self._associate(self.pose(values), ray, values, near_edges)

    def settled(self, part: np.ndarray | None, values: Values) -> Association:
        """What is to be kept of what the beams meet at a state: of the parts (N,) that they are
        known to have met, or anew, and then without those beside a depth edge.

        Raises:
            InputError: there are not so many beams.
        """
        if part is None:
            return self.associate(values, near_edges=True)
        _, ray = self._read()
        if part.shape != ray.range_m.shape:
            raise InputError(
                f"{self.recording.folder}: stop '{self.name}' has {len(ray.range_m)} beams, and "
                f"state.npz of the run says what {len(part)} of them met; fit the run again"
            )
        return self.meeting.divided(self.pose(values), ray, part)

    def rows(
        self,
        values: Values,
        association: Association | None = None,
        T: np.ndarray | None = None,
    ) -> Rows:
        """The stop's rows at a state.

        Args:
            values: the state.
            association: what its beams meet; found anew where None.
            T: (4, 4) T_reference_lidar there, where it is known already.
        """
        scan, ray = self._read()
        T = self.pose(values) if T is None else T
        if association is None:
            association = self._associate(T, ray, values, near_edges=False)
        return self._rows(self._seen(T, values, association, scan, ray), T)

    def parts(self, association: Association, kind: str) -> np.ndarray:
        """The parts (N,) of a kind that beams meet, -1 for none."""
        if kind in association.patches:
            return np.where(association.part >= 0, association.patches[kind], -1)
        return self.meeting.surfaces(association)

    def some(
        self, association: Association, most: int
    ) -> tuple[ScanStop, Association, np.ndarray | None]:
        """About so many of the beams that meet anything, drawn by chance from those on each
        surface; what they meet, and for how many each stands. All, and None, of no more."""
        met = self.meeting.surfaces(association)
        if np.count_nonzero(met >= 0) <= most:
            return self, association, None
        at, times = drawn_of_each(met, most, self.index)
        store, alike = SomeBeams(self.store, at), self.alike or (self.store,)
        return replace(self, store=store, alike=alike), association.only(at), times

    def ranges(self, values: Values) -> Ranges:
        """Every beam that meets the surface, before and after what the effects correct."""
        T = self.pose(values)
        scan, ray = self._read()
        found = self._associate(T, ray, values, near_edges=False)
        seen = self._seen(T, values, found, scan, ray)
        nominal_m = np.asarray(seen.view["range_m"])
        hit = np.flatnonzero(seen.surface.usable & np.isfinite(nominal_m))
        normal = seen.surface.columns["normal"]()[hit]
        direction = seen.ray.direction[hit] @ T[:3, :3].T
        moved = np.einsum("ni,ni->n", normal, seen.error_at(Site.REFERENCE, hit))
        moved /= np.einsum("ni,ni->n", normal, direction)
        predicted_m = seen.surface.predicted_m[hit] + moved
        origin_m = se3.apply(T, seen.ray.origin_m[hit])
        measured_m = ray.range_m[hit]
        return Ranges(
            T_reference_lidar=T,
            scan=scan,
            view=seen.view,
            hit=hit,
            surface_m=origin_m + predicted_m[:, None] * direction,
            direction=direction,
            normal=normal,
            raw_m=measured_m - nominal_m[hit],
            corrected_m=measured_m - seen.error_at(Site.BEAM, hit)[:, 0] - predicted_m,
        )

    def what_meets(self, ray: Beams, values: Values) -> dict[str, np.ndarray]:
        """What is known (N,) of any beams of this stop: range, incidence and label of what they
        meet, and (1,) the stop's own columns; of beams that meet nothing, or whose raw ranges
        would be rejected beside the others, a range and an incidence of NaN and label -1."""
        T = self.pose(values)
        surface = self.meeting.meet(T, ray, values, self._associate(T, ray, values, False))
        hit, met = np.flatnonzero(surface.usable), np.zeros(len(surface.usable), bool)
        range_m, cosine = surface.predicted_m[hit], surface.cosine[hit]
        sigma_m = np.sqrt(self.lidar.range_variance(range_m, cosine))
        z = (ray.range_m[hit] - range_m) / np.hypot(sigma_m, self.reference_sigma_m / cosine)
        met[hit] = tukey_weight(z, robust_scale(z)) > 0
        known = {n: c() if callable(c) else c for n, c in surface.columns.items() if n in MET}
        columns = {n: np.where(met, c, MET[n]) for n, c in known.items()}
        columns["range_m"] = np.where(met, surface.predicted_m, np.nan)
        return {n: c for n, c in self.columns.items() if c.ndim == 1} | columns

    def _seen(
        self,
        T: np.ndarray,
        values: Values,
        association: Association,
        scan: Scan,
        ray: Beams,
    ) -> _Seen:
        """What the beams meet, turned as they truly were, and the error at each site."""
        surface = self.meeting.meet(T, ray, values, association)
        view = self._view(scan, ray, surface)
        bases = {
            t.variable: (t.effect.site, _finite(t.basis(view), surface.usable)) for t in self.terms
        }
        error = {s: np.zeros((1, d)) for s, d in SIZE.items()}
        for name, (site, basis) in bases.items():
            error[site] = error[site] + site_error(basis, values[name])
        if error[Site.BEAM][:, 1:].any():
            ray = ray.turned(-error[Site.BEAM][:, 1], -error[Site.BEAM][:, 2])
            surface = self.meeting.meet(T, ray, values, association)
        cells = [
            cell.columns(name, self.parts(association, cell.column), association)
            for name, cell in (self.cells if association.patches else {}).items()
        ]
        shifts = (np.append(values[c.variable], 0.0)[c.index] * c.value for c in cells)
        return _Seen(
            scan=scan,
            ray=ray,
            surface=surface,
            view=view,
            bases=bases,
            error=error,
            shift_m=sum(shifts, 0.0),
            cells=cells,
        )

    def _read(self) -> tuple[Scan, Beams]:
        return self.store.read(self.index)

    def _associate(
        self, T: np.ndarray, ray: Beams, values: Values, near_edges: bool
    ) -> Association:
        found = self.meeting.associate(T, ray, values, near_edges)
        if not (found.part >= 0).any():
            raise NothingMetError(
                f"{self.recording.folder}: stop '{self.name}': none of its {len(found.part)} beams "
                f"{self.meeting.not_met}; or leave out {self.group.token}"
            )
        return found

    def _view(self, scan: Scan, ray: Beams, surface: Surface) -> View:
        given = {n: c for n, c in {**self.columns, **scan.extra}.items() if n not in MET_PARTS}
        columns: dict[str, LazyColumn] = {
            **given,
            **surface.columns,
            "ring": scan.ring,
            "column": scan.column,
            "intensity": lambda: scan.intensity / common_median(self.alike or (self.store,)),
            "azimuth_rad": lambda: ray.azimuth_rad,
            "elevation_rad": lambda: ray.elevation_rad,
            "range_m": surface.predicted_m,
        }
        return View(self.stops.rig, len(scan.ring), columns, self.stops.joints)

    def _rows(self, seen: _Seen, T: np.ndarray) -> Rows:
        scan, ray, surface, error = seen.scan, seen.ray, seen.surface, seen.error
        usable = surface.usable
        cosine = np.where(usable, surface.cosine, 1.0)
        slope = np.where(usable[:, None], surface.slope, 0.0)
        t = np.where(usable, surface.predicted_m, 1.0) - seen.shift_m / cosine
        if error[Site.REFERENCE].any():
            t += np.einsum("ni,ni->n", slope @ T[:3, :3].T, error[Site.REFERENCE])
        residual = np.where(usable, ray.range_m - t - error[Site.BEAM][:, 0], 0.0)
        reference, local = self.reference_sigma_m / cosine, self.local_sigma_m / cosine
        single = self.lidar.range_variance(t, cosine) * np.exp(2.0 * error[Site.NOISE][:, 0])
        variance = self._beam_variance(scan, single, t, cosine, usable)
        sigma = np.sqrt(variance + local**2)
        z = residual / sigma
        scale = robust_scale(z[usable])
        growth = {
            name: growth_columns(basis, len(t))
            for name, (site, basis) in seen.bases.items()
            if site is Site.NOISE
        }
        return Rows(
            residual_m=residual,
            sigma_m=sigma,
            weight=np.where(usable, tukey_weight(z, scale), 0.0),
            reference_sigma_m=np.sqrt(reference**2 - local**2),
            scale=scale,
            view=seen.view,
            usable=usable,
            derive=lambda: self._derivatives(seen, T, t, slope, cosine),
            spread=spread_rows(scan, single, usable, growth),
        )

    def _derivatives(
        self, seen: _Seen, T: np.ndarray, t: np.ndarray, slope: np.ndarray, cosine: np.ndarray
    ) -> tuple[np.ndarray, dict[str, np.ndarray], list[Columns]]:
        """By the LiDAR's twist; by unknowns of effects and of found planes, dense ones, and those
        with one non-zero per row, parts of surfaces the last."""
        by_site: dict[Site, np.ndarray] = {}
        found = {}
        usable = seen.surface.usable
        lost = np.flatnonzero(~usable)
        for name, (site, basis) in seen.bases.items():
            if site is Site.BEAM and not turns_beams(basis):
                found[name] = range_columns(name, basis, len(t))
            elif site is not Site.NOISE:
                if site not in by_site:
                    beam = site is Site.BEAM
                    turn = -T[:3, :3].T
                    by_site[site] = beam_derivative(seen.ray, t, slope) if beam else slope @ turn
                    by_site[site][lost] = 0.0  # 0 * inf would be NaN
                found[name] = effect_columns(name, basis, by_site[site])
        dense = {name: c for name, c in found.items() if not isinstance(c, Columns)}
        sparse = [c for c in found.values() if isinstance(c, Columns)]
        sparse += seen.surface.unknown(t)
        sparse = [replace(c, value=zero_at(lost, c.value)) for c in sparse]
        sparse += [
            replace(c, index=np.where(usable, c.index, -1), value=c.value / cosine)
            for c in seen.cells
        ]
        return twist_derivative(seen.ray.origin_m, seen.ray.direction, t, slope), dense, sparse

    def _beam_variance(
        self,
        scan: Scan,
        single: np.ndarray,
        t: np.ndarray,
        cosine: np.ndarray,
        usable: np.ndarray,
    ) -> np.ndarray:
        """Variance of the averaged range: noise over count, and the beam's angle.

        The spread measured over a hold leans on the datasheet's, scaled to this stop, as if that
        were `PRIOR_COUNT` sweeps more: a spread of few sweeps is itself too uncertain a weight.
        """
        measured = np.square(scan.range_std_m)
        known = spread_known(scan.range_std_m, scan.count, usable)
        if known.any():
            single = single * np.median((measured / single)[known])
            dof = np.where(known, scan.count - 1.0, 0.0)
            measured = np.where(known, measured, 0.0)
            single = (PRIOR_COUNT * single + dof * measured) / (PRIOR_COUNT + dof)
        tangent2 = 1.0 / np.square(cosine) - 1.0
        return single / scan.count + (self.lidar.sigma_angle_rad * t) ** 2 * tangent2


def _finite(basis: np.ndarray | OneHot, usable: np.ndarray) -> np.ndarray | OneHot:
    """A basis with 0 where a beam met nothing and its formula has no value there."""
    lost = np.flatnonzero(~usable)
    if isinstance(basis, OneHot) or len(basis) < len(usable) or np.isfinite(basis[lost]).all():
        return basis
    kept = basis.copy()
    kept[lost] = 0.0
    return kept
