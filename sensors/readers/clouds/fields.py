"""What the fields of anyone's cloud mean, told by their names; and its unit of length."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from chains.errors import InputError
from sensors.readers.base import Array, Columns, Options

_RING = (
    *("ring", "ring_id", "ringid", "channel", "laser_id", "laserid", "laser_number", "laser"),
    *("line", "scan_line", "beam", "beam_id", "row", "rowindex", "row_index"),
)
_COLUMN = ("column", "col", "columnindex", "column_index", "azimuth_index", "measurement_id")
_INTENSITY = ("intensity", "intensities", "i", "reflectivity", "reflectance", "signal")
_TIME = (
    *("t", "time", "timestamp", "time_stamp", "timestamps", "offset_time", "time_offset"),
    *("point_time_offset", "gps_time", "rel_time"),
)
_USELESS = {
    *("x", "y", "z", "range", "distance", "azimuth", "elevation", "rgb", "rgba", "nx", "ny", "nz"),
    *("normal_x", "normal_y", "normal_z", "red", "green", "blue", "scan"),
    *("cartesianinvalidstate", "padding", "_"),
}
_AVERAGED = {"count", "range_std_m"}  # of holds, where a file has both
_UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001}
# Median range: a choice. Half of a room's or a street's points are nearer, and in millimetres those
# of a room are beyond 1000.
_FARTHEST_M = 200.0


@dataclass(frozen=True)
class Cloud:
    """Points as a file has them: columns (N,), and (rows, columns) where it is organised."""

    fields: Columns
    shape: tuple[int, int] | None = None
    stamp_s: float = np.nan


def finite_points(cloud: Cloud, scale: float) -> tuple[Array, NDArray[np.bool_]]:
    """Points (M, 3) m that are finite and not in the origin, and which of the cloud's they are."""
    with np.errstate(invalid="ignore"):  # what is no cloud may hold any bits
        xyz = np.stack([cloud.fields[axis] for axis in "xyz"], axis=1).astype(np.float64) * scale
    seen = np.isfinite(xyz).all(axis=1) & (xyz != 0).any(axis=1)
    return xyz[seen], seen


def _plain(name: str) -> str:
    return name.lower().removeprefix("scalar_")


def fields_of(name: str, cloud: Cloud, options: Options) -> dict[str, str]:
    """Our names -> the cloud's fields: ring, column, intensity, time, and covariates by their own.

    Raises InputError where a field that `--column` names is not there, and where that of the ring
    holds no whole numbers.
    """
    numeric = {f: v for f, v in cloud.fields.items() if v.dtype.kind in "iufb"}
    plain = {_plain(field): field for field in numeric}
    fields: dict[str, str] = {}
    for ours in ("ring", "column", "intensity", "time"):
        theirs = options.columns.get(ours)
        if theirs is not None and theirs not in numeric:
            raise InputError(
                f"{name} has no field {theirs}, which --column {ours}={theirs} names; its fields"
                f" are {', '.join(cloud.fields)}"
            )
        known = {"ring": _RING, "column": _COLUMN, "intensity": _INTENSITY, "time": _TIME}[ours]
        chosen = theirs or next((plain[n] for n in known if n in plain), None)
        if chosen is not None and not (ours == "ring" and options.rings_from_elevation):
            fields[ours] = chosen
    if "ring" in fields and not _whole(numeric[fields["ring"]]):
        raise InputError(
            f"{name}: field {fields['ring']} holds no whole numbers, so it cannot be the ring;"
            " name the right one by --column ring=FIELD"
        )
    taken = {*fields.values()}
    useless = {*_TIME, *fields} | _USELESS
    useless |= set() if plain.keys() >= _AVERAGED else _AVERAGED
    for key, field in plain.items():
        if field not in taken and key not in useless:
            fields[key] = field
    return fields


def covariates(fields: Mapping[str, str]) -> list[str]:
    """Our names of those fields that are only carried along."""
    return [name for name in fields if name not in ("ring", "column", "time", "intensity")]


def _whole(values: NDArray) -> bool:
    finite = values[np.isfinite(values)] if values.dtype.kind == "f" else values
    return bool(np.all(finite == np.floor(finite)) and np.all(finite >= 0))


def scale_of(name: str, cloud: Cloud, options: Options) -> float:
    """Metres per unit of the cloud.

    Raises InputError where it has no returns, and where it looks like millimetres untold.
    """
    xyz, _ = finite_points(cloud, 1.0)
    if not len(xyz):
        raise InputError(f"{name} has no returns: all its points are NaN or zero")
    if options.length_unit is not None:
        return _UNITS[options.length_unit]
    median = float(np.median(np.linalg.norm(xyz, axis=1)))
    if median > _FARTHEST_M:
        raise InputError(
            f"{name}: half of the points are beyond {median:.0f}, which looks like millimetres; say"
            " --length-unit mm, or --length-unit m if they are metres"
        )
    return 1.0
