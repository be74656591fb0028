"""Whether rings are numbered as their model says: each ring's elevation against the catalogue."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from sensors.lidar import Array, LidarModel, catalog, load_lidar

REVERSED = "reversed"
_LEAST_RINGS = 8
"""A choice: of fewer, a unit's own angles explain a misfit as well as another numbering."""
_FARTHEST_SHIFT = 4
"""A choice: files count from 0 or 1, and leave out a few rings at an end."""
_CLEARLY_OFF = 0.5
"""Of the usual step between rings: by less than that, no ring is taken for its neighbour."""
_EXPLAINED = 0.6
"""Of the misfit, what another numbering may leave at most.

Measured on 24 units' own tables (Hesai's correction files, Ouster's metadata, HDL-64E's factory
files): as they are, every other numbering leaves 1.46 times the misfit or more; numbered from the
other end, the right one leaves 0.04 of it at most; one too low 0.42, and so one too high but for
two Ousters, whose own angles lie half a step off: there one too high is not told."""
_NEIGHBOURS = 9
"""Rings whose median a ring is compared with, as a unit's own angles differ smoothly from its
model's: 14 units of Hesai and Ouster among these lie 0.94 steps at most from that median, and none
has rings out of order."""
_LISTED = 3
"""Exchanged rings that a sentence names: a choice."""
_UNIT_RAD, _UNIT_STEPS = np.radians(1.2), 2.4
"""Of those 24 units, what the angles of any lie beside the table of its model at most."""
_FOREIGN_RAD, _FOREIGN_STEPS = np.radians(2.0), 4.0
"""Beyond both, elevations are of no model known."""


@dataclass(frozen=True)
class RingFinding:
    """Rings that are not numbered as their model says.

    Args:
        what: "reversed"; "shifted", by `shift`; "upside_down", z reversed; "model", those of
            another, `model`; "exchanged", some rings bear others' numbers; "unknown", nothing that
            fits.
        off_rad: rms of the rings' elevations against the model's table; of those alone that bear
            other rings' numbers, `rings`, if some do, and beside their neighbours'.
        left_rad: the same against the numbering that fits best.
        sentence: for people.
    """

    what: Literal["reversed", "shifted", "upside_down", "model", "exchanged", "unknown"]
    off_rad: float
    left_rad: float
    sentence: str
    shift: int = 0
    model: str | None = None
    rings: tuple[int, ...] = ()


def ring_elevations(sums_rad: ArrayLike, counts: ArrayLike) -> Array:
    """Mean elevation (R,) rad by ring, from sums and counts of beams; NaN of rings not seen."""
    counts = np.asarray(counts, float)
    return np.where(counts > 0, np.asarray(sums_rad) / np.maximum(counts, 1), np.nan)


def least_off_rad(lidar: LidarModel) -> float:
    """Rms of elevations from the model's, rad, below which no ring is taken for another; infinite
    where rings are too few to tell."""
    few = len(lidar.elevation_rad) < _LEAST_RINGS
    return np.inf if few else _CLEARLY_OFF * _step_rad(lidar)


def _step_rad(lidar: LidarModel) -> float:
    return float(np.median(np.diff(np.sort(lidar.elevation_rad))))


def odd_rings(lidar: LidarModel, elevation_rad: ArrayLike) -> RingFinding | None:
    """Return what is wrong with the numbers of rings, None where they are as the model has them.

    A unit's own angles differ from its model's by up to a few steps between rings, so a misfit is
    none until some other numbering explains most of it.

    Args:
        lidar: the model, with its table of elevations.
        elevation_rad: (R,) of each ring's beams, from where they start; NaN of rings not seen.
    """
    seen = np.asarray(elevation_rad, float)
    rings = np.flatnonzero(np.isfinite(seen))
    if len(rings) < _LEAST_RINGS:
        return None
    step_rad = _step_rad(lidar)
    off_rad = _rms(seen[rings] - lidar.elevation_rad[rings])
    if off_rad < least_off_rad(lidar):
        return _exchanged(lidar, seen, rings)
    others = [
        (_rms(seen[at] - table[at]), words)
        for table, words in _numberings(lidar)
        if len(at := rings[rings < len(table)]) == len(rings) and len(at)
        if (at := at[np.isfinite(table[at])]).size >= _LEAST_RINGS
    ]
    left_rad, found = min(others, key=lambda other: round(other[0], 6))  # the first of equals
    if left_rad > min(_EXPLAINED * off_rad, found.get("left", np.inf)):
        exchanged = _exchanged(lidar, seen, rings)
        if exchanged is not None:
            return exchanged
        if off_rad < max(_FOREIGN_RAD, _FOREIGN_STEPS * step_rad):
            return None
        found = {"what": "unknown", "said": "are those of no model of the catalogue"}
    return RingFinding(
        what=found["what"],
        off_rad=off_rad,
        left_rad=left_rad,
        shift=found.get("shift", 0),
        model=found.get("model"),
        sentence=(
            f"rings of {lidar.name} {found['said']}: their elevations are "
            f"{np.degrees(off_rad):.2g} deg rms off its table, and {np.degrees(left_rad):.2f} deg "
            "off the nearest other one"
        ),
    )


def _exchanged(lidar: LidarModel, seen: Array, rings: Array) -> RingFinding | None:
    """Rings that lie where others should, if any: they are not in their table's order."""
    from scipy.ndimage import median_filter  # late: few rings are out of order

    rings = rings[np.argsort(lidar.elevation_rad[rings])]
    table, seen = lidar.elevation_rad[rings], seen[rings]
    if np.all(np.diff(seen) > 0):
        return None
    of_unit = table + median_filter(seen - table, _NEIGHBOURS, mode="nearest")
    off = np.abs(seen[:, None] - of_unit)
    nearest, own = off.argmin(axis=1), off.diagonal()
    step_rad = _CLEARLY_OFF * _step_rad(lidar)
    wrong = np.flatnonzero((own > step_rad) & (off.min(axis=1) < _EXPLAINED * own))
    if not 0 < len(wrong) <= len(rings) // 2:  # most are needed to tell the unit's own angles
        return None
    wrong = wrong[np.argsort(rings[wrong])]
    said = [f"ring {rings[k]} lies where ring {rings[nearest[k]]} should" for k in wrong[:_LISTED]]
    more = f", and {len(wrong) - _LISTED} more rings elsewhere" if len(wrong) > _LISTED else ""
    off_rad, left_rad = _rms(own[wrong]), _rms(off[wrong, nearest[wrong]])
    return RingFinding(
        what="exchanged",
        off_rad=off_rad,
        left_rad=left_rad,
        rings=tuple(rings[wrong].tolist()),
        sentence=(
            f"rings of {lidar.name} bear other rings' numbers: {', '.join(said)}{more}; their "
            f"elevations are {np.degrees(off_rad):.2g} deg rms off what their numbers say"
        ),
    )


def _numberings(lidar: LidarModel) -> Iterator[tuple[Array, dict]]:
    """Other elevations (R,) by ring, NaN where there is none, and what they would mean."""
    table = lidar.elevation_rad
    yield table[::-1], {"what": REVERSED, "said": "are numbered from the other end"}
    yield -table, {"what": "upside_down", "said": "point down where they should point up"}
    for shift in sorted(set(range(-_FARTHEST_SHIFT, _FARTHEST_SHIFT + 1)) - {0}, key=abs):
        ring = np.arange(len(table)) - shift
        inside = (ring >= 0) & (ring < len(table))
        shifted = np.where(inside, table[np.clip(ring, 0, len(table) - 1)], np.nan)
        how = f"are numbered {abs(shift)} too {'high' if shift > 0 else 'low'}"
        yield shifted, {"what": "shifted", "shift": shift, "said": how}
    for name in catalog():
        other = load_lidar(name).elevation_rad
        if name == lidar.name or (len(other) == len(table) and np.allclose(other, table)):
            continue
        said, step = f"are those of {name}", np.median(np.diff(np.sort(other)))
        how = {"what": "model", "model": name, "left": max(_UNIT_RAD, _UNIT_STEPS * step)}
        yield other, how | {"said": said}
        yield other[::-1], how | {"said": f"{said} from the other end"}


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
