"""Rings of clouds that do not number them: by their elevation, or by the order of the points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from chains.errors import InputError
from sensors.lidar import beams, catalog, load_lidar
from sensors.readers.base import Array

RING_COUNTS = (16, 32, 40, 64, 80, 90, 128)
"""How many rings spinning LiDARs have."""
_CLEAR = 3.0
"""Times that the smallest step between groups exceeds the largest within one."""
_LEAST_POINTS = 3
"""Fewer points with one elevation are stray and no ring."""
_MOST_POINTS = 300_000
"""Points from which groups are found: of 128 rings some 2,000 each. A choice: bounds the time."""
_SAME_STEPS = 0.03
"""How far a turn's number of azimuth steps may be off a model's, of itself."""
_SPEEDS = (0.5, 1.0, 2.0)
"""A turn has so many of a model's azimuth steps, as it turns at 20, 10 or 5 Hz."""
_JITTER = 20
"""Points within which azimuth may cross the beginning of its turn to and fro."""


@dataclass(frozen=True)
class Groups:
    """Elevations (G,) rad, rising, seen from where beams start; the ring of each."""

    elevation_rad: Array
    rings: NDArray[np.int64]
    beam_origin_m: Array
    why: str
    """How it was told, in words."""

    def ring(self, xyz_m: Array) -> NDArray[np.int64]:
        """Return the ring (N,) of points (N, 3) m: that of the nearest elevation."""
        edges = (self.elevation_rad[1:] + self.elevation_rad[:-1]) / 2
        elevation = beams(xyz_m, self.beam_origin_m).elevation_rad
        return self.rings[np.searchsorted(edges, elevation)]


@dataclass(frozen=True)
class Order:
    """Rings that stand one after another in the file, each a turn of rising or falling azimuth."""

    rings: int
    downwards: bool
    """Whether the highest stands first; rings count from the lowest up."""
    why: str
    """How it was told, in words."""

    def ring(self, xyz_m: Array) -> NDArray[np.int64]:
        """Return the ring (N,) of points (N, 3) m; InputError where there are more or fewer."""
        place = _turns(xyz_m)
        if place[-1] + 1 != self.rings:
            raise InputError(
                f"a cloud has {place[-1] + 1} turns of azimuth, one after another, and the first"
                f" had {self.rings}: rings cannot be inferred from the order of its points"
            )
        return self.rings - 1 - place if self.downwards else place


def ring_order(xyz_m: Array) -> Order | None:
    """Tell rings by the order of points (N, 3) m, as in KITTI's files; None where it is not clear.

    It is where azimuth jumps by most of a turn as often as LiDARs have rings, less one, and each
    run's elevation lies beyond that of the one before.
    """
    place = _turns(xyz_m)
    rings = int(place[-1]) + 1
    if rings not in RING_COUNTS:
        return None
    elevation = np.arctan2(xyz_m[:, 2], np.hypot(xyz_m[:, 0], xyz_m[:, 1]))
    middle = np.array([np.median(part) for part in np.split(elevation, _starts(place))])
    step = np.diff(middle)
    if not (np.all(step > 0) or np.all(step < 0)):
        return None
    why = f"rings are inferred from the order of the points, in {rings} turns, from the lowest up"
    return Order(rings, bool(step[0] < 0), why)


def _turns(xyz_m: Array) -> NDArray[np.int64]:
    """How often azimuth has jumped by more than 3/4 of a turn before each point (N,).

    Counted from x or from -x, whichever jumps less often: turns begin there, and a turn that began
    elsewhere would jump once more.
    """
    azimuth = np.arctan2(xyz_m[:, 1], xyz_m[:, 0])
    counts = []
    for start in (0, np.pi):
        angle = (azimuth + start) % (2 * np.pi)
        jumps = np.flatnonzero(np.abs(np.diff(angle)) > 1.5 * np.pi) + 1
        jumps = jumps[np.diff(jumps, prepend=0) > _JITTER]  # to and fro is once
        count = np.zeros(len(angle), np.int64)
        count[jumps] = 1
        counts.append(np.cumsum(count))
    return min(counts, key=lambda count: count[-1])


def _starts(place: NDArray[np.int64]) -> NDArray[np.int64]:
    return np.flatnonzero(np.diff(place)) + 1


def elevation_groups(xyz_m: Array, model: str | None = None) -> Groups | None:
    """Group points (N, 3) m by elevation; None where groups are not clear.

    They are where every step between groups is three times the widest step within one, and either
    their elevations are those of a model of the catalogue (of `model`, if that is given) or they
    are as many as LiDARs have rings. Beams are tried from the origin and from where each model of
    the catalogue has them start. Of several models with the same elevations, the number of azimuth
    steps in a turn tells which it is.

    Raises:
        InputError: the steps fit none or several of them, and rings are numbered otherwise in each.
    """
    models = [model] if model else catalog()
    origins = {(0.0, 0.0), *(tuple(load_lidar(m).beam_origin_m.tolist()) for m in models)}
    some = xyz_m[:: len(xyz_m) // _MOST_POINTS + 1]
    best: tuple[float, tuple[float, float], Array] | None = None
    for origin in sorted(origins):
        clear, middle = _split(np.sort(beams(some, origin).elevation_rad))
        if clear > _CLEAR and (best is None or clear > best[0]):
            best = clear, origin, middle
    if best is None:
        return None
    _, origin, middle = best
    return _number(middle, np.array(origin), models, xyz_m)


def azimuth_step(xyz_m: Array) -> float:
    """The usual step between neighbouring points (N, 3) of one cone, rad."""
    elevation = np.arctan2(xyz_m[:, 2], np.hypot(xyz_m[:, 0], xyz_m[:, 1]))
    azimuth = np.arctan2(xyz_m[:, 1], xyz_m[:, 0])
    cone = np.rint(elevation / 1e-3)
    order = np.lexsort((azimuth, cone))
    step = np.diff(azimuth[order])[np.diff(cone[order]) == 0]
    step = step[step > 2e-4]
    return float(np.median(step[step < 2 * np.quantile(step, 0.2)])) if len(step) else 2 * np.pi


def matching_models(rings: NDArray[np.int64], elevation_rad: Array) -> list[str]:
    """Models of the catalogue whose rings look where these do: on average within half a degree."""
    alike = []
    for name in catalog():
        model = load_lidar(name)
        if rings[-1] < model.rings <= 2 * len(rings):
            miss = np.abs(model.elevation_rad[rings] - elevation_rad)
            if np.degrees(miss.mean()) < 0.5:
                alike.append(name)
    return alike


def _split(elevation: Array) -> tuple[float, Array]:
    """How clearly sorted elevations fall into groups, and the groups' medians, at the best cut."""
    steps = np.diff(elevation)
    falling = np.sort(steps)[::-1]
    most = min(max(RING_COUNTS) + 1, len(falling))
    if most < 8:
        return 0.0, np.zeros(0)
    ratio = falling[6 : most - 1] / np.maximum(falling[7:most], 1e-7)
    cuts = 7 + int(ratio.argmax())
    parts = np.split(elevation, np.sort(np.argsort(steps)[-cuts:]) + 1)
    groups = [np.median(part) for part in parts if len(part) >= _LEAST_POINTS]
    return float(ratio.max()), np.array(groups)


def _number(middle: Array, origin: Array, models: list[str], xyz_m: Array) -> Groups | None:
    """Rings of the groups: those of the one model they fit, or counted from the lowest up."""
    alike = {name: rings for name in models if (rings := _rings_of(name, middle)) is not None}
    if alike:
        name, why = _one_of(alike, xyz_m)
        why = f"rings are inferred from elevation, whose {len(middle)} groups are those of {why}"
        elevation = load_lidar(name).elevation_rad.copy()  # of rings with next to no points
        elevation[alike[name]] = middle
        order = np.argsort(elevation)
        return Groups(elevation[order], order, origin, why)
    if len(middle) not in RING_COUNTS:
        return None
    why = f"rings are inferred from elevation: {len(middle)} clear groups, counted from the lowest"
    return Groups(middle, np.arange(len(middle)), origin, why)


def _one_of(alike: dict[str, NDArray[np.int64]], xyz_m: Array) -> tuple[str, str]:
    """The model that numbers rings, and what to say of it; by azimuth steps if they differ."""
    first, *others = alike
    if all(np.array_equal(alike[first], alike[other]) for other in others):
        return first, first
    steps = 2 * np.pi / azimuth_step(xyz_m)
    ratio = {name: steps / load_lidar(name).columns for name in alike}
    same = [n for n in alike if any(abs(ratio[n] / k - 1) < _SAME_STEPS for k in _SPEEDS)]
    if len(same) != 1:
        raise InputError(
            f"the elevations of the points are those of {' and of '.join(alike)}, which number"
            f" their rings each in its own way, and {round(steps)} azimuth steps a turn do not tell"
            " them apart; name the one by --lidar"
        )
    why = f"{' and of '.join(alike)}; of these, {same[0]} makes {round(steps)} steps a turn"
    return same[0], why


def _rings_of(name: str, middle: Array) -> NDArray[np.int64] | None:
    """The ring of a model at each elevation (G,) rad; None where it is not this model."""
    model = load_lidar(name)
    nearest = np.abs(model.elevation_rad[:, None] - middle).argmin(axis=0)
    miss = np.degrees(np.abs(model.elevation_rad[nearest] - middle))
    fits = len(np.unique(nearest)) == len(middle) > model.rings // 2 and miss.max() < 0.1
    return nearest if fits else None
