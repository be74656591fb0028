"""Structure that no physics is claimed for: an error of its own for every bin of a covariate, or of
a pair; one that a single ring has; directions of beams, joints and poses by smooth functions."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain, combinations, permutations

import numpy as np

from calib.effects import CATALOGUE, Effect, OneHot, Param, Site, View
from calib.effects.basis import AZIMUTH, ELEVATION, RANGE, beam
from calib.effects.rig import MountSlip
from calib.problem.model import Source
from calib.rig import Rig

# Bins of a covariate, of each of two, and of azimuth, whose harmonics turn several times about. A
# choice: what has half the period of three bins is seen, and looks are few; `formulas` sees finer.
COVARIATE_BINS, PAIR_BINS = 12, 6
AZIMUTH_BINS = 24
# Of columns of the stops: with more parameters than a fifth of these, tests have no power.
STOPS_A_BIN = 5
DIRECTION_WAVES = 6  # a turn, of the directions of beams: what 12 bins of azimuth show
POSE_WAVES = 4  # of a pose over a column: its quarters, as 12 bins have thirds of those
# What a range error may depend on alone, and the pairs that matter; others pair with range.
POINT = ("range_m", "incidence_rad", "azimuth_rad", "elevation_rad", "intensity")
PAIRS = (*combinations(POINT[:4], 2), ("intensity", "range_m"), ("label", "incidence_rad"))


# What a column of the stops may act on: an offset by stop alone may be chance, but one that differs
# from ring to ring, or with range, is none.
WITH_OWN = ("range_m", "elevation_rad")


class Binned(Effect):
    """Range has an error of its own in every bin of some covariates; empirical.

    Args:
        edges: covariate -> (B - 1,) ascending values between its bins.
        centres: covariate -> (B,) mean of its values in each bin.
        seen: covariate -> its least and largest value.
    """

    site = Site.BEAM
    formula = "range = true + a_bin"
    typical = "empirical"

    def __init__(
        self,
        edges: Mapping[str, np.ndarray],
        centres: Mapping[str, np.ndarray],
        seen: Mapping[str, tuple[float, float]],
    ) -> None:
        self.edges, self.centres, self.seen = edges, centres, seen
        self.covariates = tuple(edges)
        self.name = "structure:" + ",".join(edges)

    @property
    def bins(self) -> tuple[int, ...]:
        """How many of each covariate."""
        return tuple(len(e) + 1 for e in self.edges.values())

    def params(self, rig: Rig) -> tuple[Param, ...]:
        count = int(np.prod(self.bins))
        return tuple(Param(f"bin_{i}", "m", 0.01) for i in range(count if rig.lidar else 0))

    def basis(self, view: View) -> OneHot:
        index, known = np.zeros(view.rows, int), np.ones(view.rows, bool)
        for name, edges in self.edges.items():
            column = np.broadcast_to(view[name], view.rows)
            index = index * (len(edges) + 1) + np.searchsorted(edges, column)
            known &= np.isfinite(column)
        along = np.zeros(3)
        along[RANGE] = 1.0
        size = int(np.prod(self.bins))
        return OneHot(np.where(known, index, -1), np.broadcast_to(along, (view.rows, 3)), size)


class RingSlope(Effect):
    """Range errs in proportion to a column, in each ring by a factor of its own; empirical.

    Args:
        column: which.
        seen: the least and largest value of it.
        ring: which ring alone errs; None for all.
    """

    site = Site.BEAM
    typical = "empirical"
    formula = "range = true + a_ring * (column - its middle) / half its span"

    def __init__(self, column: str, seen: tuple[float, float], ring: int | None = None) -> None:
        self.column, self.seen, self.ring = column, {column: seen}, ring
        self.covariates = ("ring", column)
        self.name = f"structure:ring,{column}" + ("" if ring is None else f"@{ring}")

    @property
    def whole(self) -> RingSlope:
        """Of all rings."""
        return RingSlope(self.column, self.seen[self.column])

    def alone(self, ring: int) -> RingSlope:
        """Of one ring alone."""
        return RingSlope(self.column, self.seen[self.column], ring)

    def params(self, rig: Rig) -> tuple[Param, ...]:
        rings = range(rig.lidar.rings if rig.lidar else 0)
        some = [k for k in rings if self.ring in (None, k)]
        return tuple(Param(f"ring_{k:03d}", "m", 0.01) for k in some)

    def basis(self, view: View) -> OneHot:
        middle, half = self.scale
        u = np.broadcast_to((view[self.column] - middle) / half, view.rows)
        along = np.zeros((view.rows, 3))
        along[:, RANGE] = np.nan_to_num(u)
        if self.ring is not None:
            there = np.isfinite(u) & (view["ring"] == self.ring)
            return OneHot(np.where(there, 0, -1), along, 1)
        return OneHot(np.where(np.isfinite(u), view["ring"], -1), along, view.rig.lidar.rings)

    @property
    def scale(self) -> tuple[float, float]:
        """The middle of the column, and half its span."""
        low, high = self.seen[self.column]
        return (low + high) / 2, (high - low) / 2


def singly(
    effects: Sequence[Effect], of_rigs: Mapping[str, Sequence[np.ndarray]]
) -> tuple[list[Effect], dict[str, np.ndarray]]:
    """Structure as it is tested: that of rings one ring at a time, as shapes of one family; and the
    columns of each, of its parameters in every rig that has it."""
    out, at = [], {name: np.concatenate(each) for name, each in of_rigs.items()}
    for effect in effects:
        if not isinstance(effect, RingSlope):
            out.append(effect)
            continue
        rigs = of_rigs.get(effect.name, ())
        for ring in range(max(map(len, rigs), default=0)):
            out.append(one := effect.alone(ring))
            at[one.name] = np.array([columns[ring] for columns in rigs if ring < len(columns)])
    return out, at


def of_look(effect: Effect) -> Effect:
    """The effect whose unknowns a look has, for one that was tested."""
    return effect.whole if isinstance(effect, RingSlope) else effect


class DirectionShape(Effect):
    """Beams point higher, or to the side, by a smooth function of azimuth; empirical.

    Args:
        what: "elevation" or "azimuth", which errs.
        seen: the least and largest azimuth.
    """

    site = Site.BEAM
    typical = "empirical"
    covariates = ("azimuth_rad",)
    formula = "angle = true + sum over m of a_m sin(m azimuth) + b_m cos(m azimuth)"

    def __init__(self, what: str, seen: tuple[float, float]) -> None:
        self.what, self.seen = what, {"azimuth_rad": seen}
        self.name = f"structure:{what} of beams,azimuth_rad"

    def params(self, rig: Rig) -> tuple[Param, ...]:
        count = len(self.waves()) if rig.lidar else 0
        return tuple(Param(f"wave_{i}", "rad", 0.003) for i in range(count))

    def waves(self) -> list[str]:
        """The functions, as a formula has them."""
        orders = range(1, DIRECTION_WAVES + 1)
        return [f"{f}({m} * azimuth_rad)" for m in orders for f in ("sin", "cos")]

    def basis(self, view: View) -> np.ndarray:
        turns = [m * view["azimuth_rad"] for m in range(1, DIRECTION_WAVES + 1)]
        waves = [f(turn) for turn in turns for f in (np.sin, np.cos)]
        return beam(ELEVATION if self.what == "elevation" else AZIMUTH, *waves)


class JointShape(Effect):
    """A joint turns by a smooth function of itself, or of another joint beside; empirical.

    Args:
        joint: which turns.
        other: of which it is a function.
        seen: the least and largest value of that.
    """

    site = Site.JOINTS
    typical = "empirical"
    formula = "q_i = reported_i + sum over m = 1..3 of a_m sin(m q_k) + b_m cos(m q_k)"

    def __init__(self, joint: str, other: str, seen: tuple[float, float]) -> None:
        self.joint, self.other, self.seen = joint, other, {other: seen}
        self.covariates = ("joints",)
        self.name = f"structure:{joint}" + (f",{other}" if other != joint else "")

    def params(self, rig: Rig) -> tuple[Param, ...]:
        unit = dict(zip(rig.joint_names, rig.joint_kinds, strict=True)).get(self.joint)
        count = 6 if unit == "revolute" else 0
        return tuple(Param(f"wave_{i}", "rad", 0.003) for i in range(count))

    def basis(self, view: View) -> np.ndarray:
        i, k = (view.rig.joint_names.index(n) for n in (self.joint, self.other))
        q = view.joints[:, k]
        waves = [f(m * q) for m in (1, 2, 3) for f in (np.sin, np.cos)]
        out = np.zeros((len(q), view.joints.shape[1], len(waves)))
        out[:, i] = np.stack(waves, axis=1)
        return out


class PoseShape(Effect):
    """Something is moved by a smooth function of a column of the stops; empirical.

    Args:
        slips: the effect that moves it once: the mount, a tracked body, or the tracker.
        column: of the stops.
        seen: its least and largest value.
        waves: how many cosines there are of each motion.
    """

    typical = "empirical"
    formula = "moved by exp(sum over m = 1..M of a_m cos(pi m u)), u = 0 to 1 over the column"

    def __init__(
        self, slips: MountSlip, column: str, seen: tuple[float, float], waves: int
    ) -> None:
        self.slips, self.site = slips, slips.site
        self.column, self.seen, self.waves = column, {column: seen}, waves
        self.covariates = (column,)
        self.name = f"structure:{self.what},{column}"

    @property
    def of_lidar(self) -> bool:
        return self.slips.of_lidar

    @property
    def goes_by_place(self) -> bool:
        return self.slips.goes_by_place

    @property
    def what(self) -> str:
        """What is moved: mount, body, base or tracker."""
        return self.slips.family.removesuffix("_slip")

    def params(self, rig: Rig) -> tuple[Param, ...]:
        each = self.slips.params(rig)
        return tuple(
            replace(move, name=f"{move.name}.{m}") for m in range(self.waves) for move in each
        )

    def basis(self, view: View) -> np.ndarray:
        low, high = self.seen[self.column]
        u = (view[self.column] - low) / (high - low)
        known = np.isfinite(u)
        waves = (np.where(known, np.cos(np.pi * m * u), 0.0) for m in range(1, self.waves + 1))
        return np.concatenate([self.slips.moved(view, wave) for wave in waves], axis=-1)


def what_moves(effect: Effect) -> str | None:
    """What structure moves, where it is no error of a range or a joint."""
    return effect.what if isinstance(effect, PoseShape | DirectionShape) else None


def ring_of(effect: Effect) -> int | None:
    """The ring that structure is of, where it is of one alone."""
    return effect.ring if isinstance(effect, RingSlope) else None


def covariates() -> set[str]:
    """Columns that structure may depend on in any recording."""
    return {*POINT, "time_s", *chain(*PAIRS)}


def structure(sources: Sequence[Source], sample: Mapping[str, np.ndarray]) -> list[Effect]:
    """Effects without a formula, over every covariate that there is.

    Args:
        sources: the recordings.
        sample: covariate -> its values at some of the points; empty without a LiDAR.
    """
    out: list[Effect] = []
    own = [c for c in sample if c not in covariates() - {"time_s"}]
    wanted = [(c,) for c in (*POINT, *own) if c in sample]
    wanted += [p for p in PAIRS if all(c in sample for c in p)]
    wanted += [(c, point) for c in own for point in WITH_OWN if point in sample]
    stops = sum(len(s.recording.stops) for s in sources)
    for names in wanted:
        by_stop = stops if set(names) & set(own) else 0
        edges = {c: _edges(sample[c], _bins(c, len(names), by_stop)) for c in names}
        if all(len(e) for e in edges.values()):
            centres = {c: _centres(sample[c], e) for c, e in edges.items()}
            out.append(Binned(edges, centres, {c: _ends(sample[c]) for c in names}))
    ends = {c: _ends(sample[c]) for c in ("range_m", *own) if c in sample}
    out += [RingSlope(c, (low, high)) for c, (low, high) in ends.items() if high > low]
    if "azimuth_rad" in sample:
        around = _ends(sample["azimuth_rad"])
        out += [DirectionShape(what, around) for what in ("elevation", "azimuth")]
    joints: dict[str, list[np.ndarray]] = {}
    for name, values in (each for s in sources for each in _moving(s)):
        joints.setdefault(name, []).append(values)
    seen = {name: _ends(np.concatenate(values)) for name, values in joints.items()}
    out += [JointShape(j, j, seen[j]) for j in joints]
    out += [JointShape(i, k, seen[k]) for i, k in permutations(joints, 2)]
    return [*out, *_moved(sources)]


def _moved(sources: Sequence[Source]) -> Iterator[PoseShape]:
    """Mount, tracked bodies and tracker, moved by every column that changes from stop to stop."""
    stops = sum(len(s.recording.stops) for s in sources)
    slips = [e for e in CATALOGUE if isinstance(e, MountSlip) and e.jumps]
    slips = [e for e in slips if any(e.params(s.rig) for s in sources)]
    columns = set.intersection(
        *({"time_s", *s.recording.covariates} & {*s.columns} for s in sources)
    )
    for column in sorted(columns):
        values = np.concatenate([s.columns[column] for s in sources])
        low, high = _ends(values[np.isfinite(values)])
        for slip in slips if high > low else ():
            each = max(len(slip.params(s.rig)) for s in sources)
            if waves := min(POSE_WAVES, stops // (STOPS_A_BIN * each)):
                yield PoseShape(slip, column, (low, high), waves)


def _moving(source: Source) -> Iterator[tuple[str, np.ndarray]]:
    """Revolute joints that turned, and their values (K,)."""
    for name, kind, values in zip(
        source.rig.joint_names, source.rig.joint_kinds, source.recording.joints.T, strict=False
    ):
        if kind == "revolute" and len(values) and np.ptp(values) > 1e-3:
            yield name, values


def _ends(values: np.ndarray) -> tuple[float, float]:
    return float(np.nanmin(values)), float(np.nanmax(values))


def _bins(covariate: str, together: int, stops: int) -> int:
    """How many bins of a covariate, alone or of a pair; where one of them is the same for all beams
    of a stop, no more than that many stops can tell."""
    usual = PAIR_BINS if together > 1 else COVARIATE_BINS
    if stops:
        return max(2, min(usual, round((stops / STOPS_A_BIN) ** (1.0 / together))))
    return AZIMUTH_BINS if covariate == "azimuth_rad" and together == 1 else usual


def _centres(values: np.ndarray, edges: np.ndarray) -> np.ndarray:
    values = values[np.isfinite(values)]
    index = np.searchsorted(edges, values)
    count = np.bincount(index, minlength=len(edges) + 1)
    total = np.bincount(index, values, len(edges) + 1)
    return total / np.maximum(count, 1)


def _edges(values: np.ndarray, bins: int) -> np.ndarray:
    """Values between bins of about equal count; between all values where they are few."""
    values = values[np.isfinite(values)]
    distinct = np.unique(values)
    if len(distinct) <= bins:
        return (distinct[1:] + distinct[:-1]) / 2
    return np.unique(np.quantile(values, np.arange(1, bins) / bins))
