"""Clouds of anyone's fields as scans with rings and columns.

What a field means is told by its name; rings that no field tells are the rows of an organised
cloud, or groups of equal elevation. All is decided once, on the first cloud of a source, so that
one direction has the same ring and column in every cloud.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chains.errors import InputError
from sensors.lidar import load_lidar
from sensors.readers.base import Array, Columns, Options
from sensors.readers.clouds.elevation import (
    RING_COUNTS,
    Groups,
    Order,
    azimuth_step,
    elevation_groups,
    matching_models,
    ring_order,
)
from sensors.readers.clouds.fields import Cloud, covariates, fields_of, finite_points, scale_of
from sensors.readers.clouds.origin import BeamOrigin, fit_beam_origin


@dataclass(frozen=True)
class CloudLayout:
    """How the clouds of one source are read."""

    fields: Mapping[str, str]
    """Our column -> the file's field: ring, column, intensity, time, and covariates by own name."""
    scale: float
    first_ring: int
    groups: Groups | Order | None
    """Rings by elevation or order, where no field and no row tells them."""
    rows: bool
    """Whether rings are the rows of the cloud's grid, and columns its columns."""
    columns: int
    """Azimuth steps of a turn."""
    height_m: float = 0.0
    """How far above the LiDAR's centre the cloud's origin lies below; taken off z."""

    def points(self, cloud: Cloud) -> Columns:
        """Return the points of one cloud as columns of a `Sweep`; no returns are left out."""
        xyz_m, seen = finite_points(cloud, self.scale)
        ring = self._ring(cloud, seen, xyz_m)
        xyz_m[:, 2] -= self.height_m
        points: Columns = {axis: xyz_m[:, k].astype(np.float32) for k, axis in enumerate("xyz")}
        points["ring"] = ring.astype(np.uint16)
        points["column"] = self._column(cloud, seen, xyz_m).astype(np.uint16)
        for name, field in self.fields.items():
            if name not in ("ring", "column", "time"):
                points[name] = cloud.fields[field][seen].astype(np.float32)
        return points

    def _ring(self, cloud: Cloud, seen: NDArray[np.bool_], xyz_m: Array) -> NDArray:
        if "ring" in self.fields:
            return cloud.fields[self.fields["ring"]][seen].astype(np.int64) - self.first_ring
        if self.groups is not None:
            return self.groups.ring(xyz_m)
        return np.flatnonzero(seen) // cloud.shape[1]

    def _column(self, cloud: Cloud, seen: NDArray[np.bool_], xyz_m: Array) -> NDArray:
        if "column" in self.fields:
            return cloud.fields[self.fields["column"]][seen].astype(np.int64)
        if self.rows:
            return np.flatnonzero(seen) % cloud.shape[1]
        azimuth = np.arctan2(xyz_m[:, 1], xyz_m[:, 0])
        return np.rint((np.pi - azimuth) * self.columns / (2 * np.pi)).astype(int) % self.columns


@dataclass(frozen=True)
class CloudFormat:
    """What the first cloud of a source tells: how to read all, and what to say."""

    layout: CloudLayout
    lidar: Mapping[str, Any]
    understood: tuple[str, ...]
    odd: tuple[str, ...]
    middle_s: float
    """From the cloud's stamp to the middle of its turn."""


def find_format(name: str, cloud: Cloud, options: Options) -> CloudFormat:
    """Decide how the clouds of a source are read.

    Raises InputError where lengths look like millimetres and no `--length-unit` says so, where a
    field that `--column` names is not there, and where rings cannot be told.
    """
    fields = fields_of(name, cloud, options)
    scale = scale_of(name, cloud, options)
    xyz_m, seen = finite_points(cloud, scale)
    odd: list[str] = []
    how, first_ring, groups, rows = _rings(name, cloud, fields, xyz_m, seen, options, odd)
    columns = _columns(cloud, fields, rows, xyz_m, options)
    layout = CloudLayout(
        fields=fields, scale=scale, first_ring=first_ring, groups=groups, rows=rows, columns=columns
    )
    ring = layout.points(cloud)["ring"].astype(np.int64)
    origin = fit_beam_origin(xyz_m, ring)
    lidar, said = _lidar(name, xyz_m, ring, layout, origin, options, odd)
    if origin is not None:
        layout = replace(layout, height_m=origin.above_m)
    understood = (
        f"{name}: {len(np.unique(ring))} rings with returns, {how}; {columns} columns;"
        f" {len(ring)} points in the first cloud"
        + (f"; also {', '.join(covariates(fields))}" if covariates(fields) else ""),
        *said,
    )
    middle_s = _time(name, cloud, fields, seen, xyz_m, ring, odd)
    return CloudFormat(
        layout=layout, lidar=lidar, understood=understood, odd=tuple(odd), middle_s=middle_s
    )


# ---------------------------------------------------------------------------------- rings, columns


def _rings(
    name: str,
    cloud: Cloud,
    fields: Mapping[str, str],
    xyz_m: Array,
    seen: NDArray[np.bool_],
    options: Options,
    odd: list[str],
) -> tuple[str, int, Groups | Order | None, bool]:
    """How rings are told, in words; the first one's number; by elevation or order; by row."""
    rows = cloud.shape is not None and min(cloud.shape) > 1 and _rows_are_rings(cloud, xyz_m, seen)
    if "ring" in fields:
        values = cloud.fields[fields["ring"]][seen]
        if not np.isfinite(values).all():
            raise InputError(f"{name}: field {fields['ring']} is not finite, and numbers rings")
        first = _first_ring(name, values, options, odd)
        return f"field {fields['ring']}, from {first}", first, None, rows
    if rows:
        return "the rows of the cloud", 0, None, True
    try:
        groups = elevation_groups(xyz_m, options.lidar) or ring_order(xyz_m)
    except InputError as error:
        raise InputError(f"{name}: {error}") from None
    if groups is None:
        raise InputError(
            f"{name} has no field for the ring (its fields are {', '.join(cloud.fields)}), and its"
            " elevations do not fall into clear groups; name the field by --column ring=FIELD, or"
            " the model by --lidar, or record clouds with rings"
        )
    odd.append(f"{name} has no field for the ring; {groups.why}")
    return "told by the points", 0, groups, False


def _rows_are_rings(cloud: Cloud, xyz_m: Array, seen: NDArray[np.bool_]) -> bool:
    """Whether points of one row have one elevation, compared with that of its neighbours."""
    if len(seen) != cloud.shape[0] * cloud.shape[1]:
        return False
    row = np.flatnonzero(seen) // cloud.shape[1]
    elevation = np.arctan2(xyz_m[:, 2], np.hypot(xyz_m[:, 0], xyz_m[:, 1]))
    rows = [elevation[row == k] for k in np.unique(row)]  # a loop over rows, not points
    middle = np.array([np.median(r) for r in rows])
    spread = np.array([np.median(np.abs(r - m)) for r, m in zip(rows, middle, strict=True)])
    step = np.abs(np.diff(middle))
    return len(rows) > 3 and bool(np.median(spread) < 0.5 * np.median(step))


def _first_ring(name: str, values: NDArray, options: Options, odd: list[str]) -> int:
    lowest, highest = int(values.min()), int(values.max())
    if options.first_ring is not None:
        if lowest < options.first_ring:
            raise InputError(
                f"{name} has ring {lowest}, but --first-ring says that they count from"
                f" {options.first_ring}"
            )
        return options.first_ring
    if lowest == 1 and highest in RING_COUNTS:
        odd.append(f"{name}: rings count from 1 to {highest}; they are counted from 0 here")
        return 1
    if lowest > 0:
        odd.append(f"{name}: no returns of rings below {lowest}; rings are taken to count from 0")
    return 0


def _columns(
    cloud: Cloud, fields: Mapping[str, str], rows: bool, xyz_m: Array, options: Options
) -> int:
    if rows and "column" not in fields:
        return cloud.shape[1]
    if "column" in fields:
        return int(cloud.fields[fields["column"]].max()) + 1
    step = azimuth_step(xyz_m)
    if options.lidar is not None:
        told = load_lidar(options.lidar).columns
        if abs(2 * np.pi / step / told - 1) < 0.05:
            return told
    return int(np.clip(np.rint(2 * np.pi / step), 1, 65535))


# -------------------------------------------------------------------------- the sensor, its clock


def _lidar(
    name: str,
    xyz_m: Array,
    ring: NDArray[np.int64],
    layout: CloudLayout,
    origin: BeamOrigin | None,
    options: Options,
    odd: list[str],
) -> tuple[dict[str, Any], list[str]]:
    """What rig.yaml should say of the LiDAR, and what to tell of it."""
    lidar: dict[str, Any] = {"columns": layout.columns}
    said: list[str] = []
    radial_m, height_m = (origin.radial_m, origin.height_m) if origin else (0.0, 0.0)
    flat = np.hypot(xyz_m[:, 0], xyz_m[:, 1]) - radial_m
    elevation = np.arctan2(xyz_m[:, 2] - height_m, flat)
    rings, place = np.unique(ring, return_inverse=True)
    middle = np.array([np.median(elevation[place == k]) for k in range(len(rings))])
    models = [options.lidar] if options.lidar else matching_models(rings, middle)
    if len(models) > 1 and origin is not None:
        models.sort(key=lambda m: abs(load_lidar(m).beam_origin_m[0] - radial_m))
        models = models[:1]
    if len(models) == 1:
        lidar["model"] = models[0]
        if not options.lidar:
            said.append(f"{name}: the elevations are those of {models[0]}; --lidar names another")
    else:
        like = f", perhaps {' or '.join(models)}" if models else ""
        odd.append(f"{name}: the LiDAR's model is not known{like}; name it by --lidar")
    _say_origin(name, origin, models, lidar, said, odd)
    if "model" in lidar and len(rings) == load_lidar(lidar["model"]).rings == rings[-1] + 1:
        lidar["elevation_deg"] = np.degrees(middle).round(4).tolist()
    return lidar, said


def _say_origin(
    name: str,
    origin: BeamOrigin | None,
    models: list[str],
    lidar: dict[str, Any],
    said: list[str],
    odd: list[str],
) -> None:
    if origin is None:
        return
    radial_mm, sigma_mm = 1000 * origin.radial_m, 1000 * origin.sigma_radial_m
    known_mm = 1000 * load_lidar(models[0]).beam_origin_m[0] if len(models) == 1 else 0.0
    lidar["beam_origin_m"] = [0.0, 0.0]
    if known_mm and abs(radial_mm - known_mm) < max(0.5, 3 * sigma_mm):
        lidar["beam_origin_m"] = [round(known_mm / 1000, 9), 0.0]
        said.append(
            f"{name}: the points' lines start {radial_mm:.1f} ± {sigma_mm:.1f} mm from the axis, as"
            f" those of {models[0]} do ({known_mm:g} mm)"
        )
    elif origin.aside_m:
        lidar["beam_origin_m"] = [round(origin.radial_m, 5), 0.0]
        said.append(
            f"{name}: the points' lines start {radial_mm:.1f} ± {sigma_mm:.1f} mm from the axis"
        )
    elif known_mm > max(2.0, 5 * sigma_mm):
        odd.append(
            f"{name}: beams of {models[0]} start {known_mm:.1f} mm from the axis, but the points'"
            f" lines pass it at {radial_mm:.1f} ± {sigma_mm:.1f} mm: the driver has left its"
            " correction off, which bends points by as much; switch it on and record anew"
        )
    if origin.above_m:
        odd.append(
            f"{name}: beams start {1000 * origin.above_m:.1f} mm above the origin of the points, as"
            " in a frame of the housing; z is taken from the LiDAR's own centre"
        )


def _time(
    name: str,
    cloud: Cloud,
    fields: Mapping[str, str],
    seen: NDArray[np.bool_],
    xyz_m: Array,
    ring: NDArray[np.int64],
    odd: list[str],
) -> float:
    """From the stamp to the middle of the turn, s; says where azimuth grows with time."""
    if "time" not in fields:
        return 0.0
    time = cloud.fields[fields["time"]][seen].astype(np.float64)
    span = float(np.ptp(time))
    if not np.isfinite(span) or span == 0:
        return 0.0
    unit = next(
        u for limit, u in ((10, 1.0), (1e4, 1e-3), (1e7, 1e-6), (np.inf, 1e-9)) if span < limit
    )
    one = ring == np.bincount(ring).argmax()
    order = np.argsort(time[one], kind="stable")
    step = np.diff(np.unwrap(np.arctan2(xyz_m[one, 1], xyz_m[one, 0])[order]))
    if len(step) > 20 and np.median(step) > 0:
        odd.append(
            f"{name}: azimuth grows with time; most LiDARs turn clockwise seen from above: see that"
            " the axes are right-handed, z up"
        )
    middle_s = float(time.min() + time.max()) / 2 * unit
    if np.median(np.abs(time)) > 100 * span:  # counted as the stamp is, not from it
        middle_s -= cloud.stamp_s
    return middle_s if abs(middle_s) < 1 else 0.0
