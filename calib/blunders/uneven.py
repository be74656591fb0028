"""Groups of one kind that scatter more at some stops than at others: far from the tracker, say, or
while something heavy passed. Stops that stand out for that reason are no mishaps.

What a variance depends on is found by regression of the logs of squares (Harvey 1976, Econometrica
44, 461). How far out a group lies is then measured against those that are nearest to it in that.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import special

from calib.blunders.chance import LEVELS, after_looks
from calib.blunders.shifts import Shift
from calib.linear.symmetric import pinv
from calib.problem.model import labels
from calib.problem.problem import Problem

ALPHA_UNEVEN = LEVELS["effect on the scatter"]
# Groups that tell, so that each of the classes of time has eight: a choice.
FEWEST_UNEVEN = 40
CLASSES = 5  # of time, of equally many groups: a while of a tenth of it shows in one of them
NEAREST = 10  # share of the groups, one in so many, that are nearest; but no fewer than this:
FEWEST_NEAREST = 15  # the median of so many squares of six dofs is known to 20 %
# No instrument scatters by more than so many times what most of its rows do: a choice. Rows of
# zeros, which all lie in one place, are mishaps.
MOST_TIMES = 10.0
LEAST_RATIO = 1e-6  # of a square to what chance makes it: what is less counts as so much
TOLD_BETWEEN = (0.05, 0.95)  # quantiles between which it is told how unevenly they scatter

NamedStop = tuple[str, str]  # the recording, by its label, and the stop


@dataclass(frozen=True)
class Uneven:
    """That groups of a kind scatter unevenly.

    Args:
        along: what it depends on, "place" or "time".
        p_value: how often chance alone makes it seem so.
        scale: stop -> how far out its neighbours lie, in squares of what chance makes it.
        nearest: how many neighbours tell it.
    """

    along: str
    p_value: float
    scale: Mapping[NamedStop, float]
    nearest: int

    @property
    def times(self) -> float:
        """How many times as much they scatter where they do most as where they do least."""
        least, most = np.quantile(list(self.scale.values()), TOLD_BETWEEN)
        return float(np.sqrt(most / least))


@dataclass(frozen=True)
class Whereabouts:
    """When stops were, and where the tracker saw each body.

    Args:
        time_s: stop -> when.
        place: body -> stop -> where, (3,) in the tracker's frame.
    """

    time_s: Mapping[NamedStop, float]
    place: Mapping[str, Mapping[NamedStop, np.ndarray]]

    @classmethod
    def of(cls, problem: Problem) -> Whereabouts:
        """Of all stops of a problem."""
        time_s: dict[NamedStop, float] = {}
        place: dict[str, dict[NamedStop, np.ndarray]] = {}
        for source, label in zip(problem.sources, labels(problem.sources), strict=True):
            recording = source.recording
            keys = [(label, stop) for stop in recording.stops]
            time_s |= dict(zip(keys, recording.time_s.tolist(), strict=True))
            for body, seen in recording.bodies.items():
                at = seen[:, :3]  # a point, or a pose: the quaternion after it
                known = np.isfinite(at).all(axis=1)
                some = {key: p for key, p, k in zip(keys, at, known, strict=True) if k}
                place.setdefault(body, {}).update(some)
        return cls(time_s, place)

    def columns(self, keys: Sequence[NamedStop], body: str) -> dict[str, np.ndarray]:
        """What the scatter of groups (n,) may depend on: columns (n, q) of classes of time, and of
        where a body was and how far; of the body that moves most where the groups are of none."""
        out = {}
        time = np.array([self.time_s.get(key, np.nan) for key in keys])
        if np.isfinite(time).all() and np.ptp(time) > 0:
            rank = np.argsort(np.argsort(time, kind="stable"), kind="stable")
            out["time"] = np.eye(CLASSES)[rank * CLASSES // len(rank)][:, 1:]
        bodies = [self.place[body]] if body in self.place else self.place.values()
        places = [np.stack([b[k] for k in keys]) for b in bodies if all(k in b for k in keys)]
        if places:
            at = max(places, key=lambda at: at.var(axis=0).sum())  # of that which moves most
            out["place"] = np.column_stack([at, np.linalg.norm(at, axis=1)])
        return out


def unevenly(some: Sequence[Shift], where: Whereabouts) -> Uneven | None:
    """How groups of one kind scatter unevenly; None where they do not, or are too few to tell."""
    if len(some) < FEWEST_UNEVEN or any(shift.group.stop is None for shift in some):
        return None
    keys = [(shift.group.recording, shift.group.where) for shift in some]
    by_chance = special.chdtri([shift.dof for shift in some], 0.5)
    ratio = np.maximum([shift.statistic for shift in some] / by_chance, LEAST_RATIO)
    along = where.columns(keys, some[0].group.what)
    tested = {name: _regressed(np.log(ratio), each) for name, each in along.items()}
    name = min(tested, key=lambda name: tested[name][0], default="")
    if not name or (p := float(after_looks(tested[name][0], len(tested)))) >= ALPHA_UNEVEN:
        return None
    by = tested[name][1] if name == "place" else [where.time_s[key] for key in keys]
    order = np.argsort(by, kind="stable")
    nearest = max(FEWEST_NEAREST, len(some) // NEAREST)
    local = _medians(ratio[order], nearest)
    if _one_way([some[i] for i in order], local, nearest):
        return None
    local = np.minimum(local, MOST_TIMES**2 * np.median(ratio))
    scale = dict(zip([keys[i] for i in order], local.tolist(), strict=True))
    return Uneven(name, p, scale, nearest)


def _medians(values: np.ndarray, count: int) -> np.ndarray:
    """Of each of some values (n,), in order, the largest median of so many before, around and after
    it: where scatter changes at an edge, one of these lies on its side of that."""
    each = np.median(np.lib.stride_tricks.sliding_window_view(values, count), axis=1)
    first = np.arange(len(values))[:, None] - np.array([count - 1, count // 2, 0])
    return each[np.clip(first, 0, len(each) - 1)].max(axis=1)


def _one_way(some: Sequence[Shift], local: np.ndarray, count: int) -> bool:
    """Whether groups, in order, are off the same way where they lie furthest out, so many of them:
    then something is wrong there, and nothing scatters (Hotelling's T squared)."""
    last = int(np.argmax(local))
    around = range(max(0, last - count + 1), min(last, len(some) - count) + 1)
    sizes = {len(shift.offset) for shift in some}
    if len(sizes) > 1 or not 0 < (own := sizes.pop()) < count:
        return False
    offsets = np.stack([shift.offset for shift in some])
    p = min(_p_of_mean(offsets[first : first + count], own) for first in around)
    return bool(after_looks(p, len(around)) < ALPHA_UNEVEN)


def _p_of_mean(offsets: np.ndarray, own: int) -> float:
    """How often chance alone puts the mean of some offsets (n, q) as far from none."""
    count = len(offsets)
    spread = np.cov(offsets.T).reshape(own, own)
    size = np.sqrt(np.maximum(np.diag(spread), 1e-300))
    mean = offsets.mean(axis=0) / size
    squared = count * mean @ pinv(spread / np.outer(size, size)) @ mean
    others = count - own
    return float(special.fdtrc(own, others, squared * others / (own * (count - 1))))


def _regressed(y: np.ndarray, columns: np.ndarray) -> tuple[float, np.ndarray]:
    """The p-value of a regression of y (n,) on columns (n, q) and a constant, by F; and what it
    makes of y (n,)."""
    X = np.column_stack([np.ones(len(y)), columns])
    X = X / np.linalg.norm(X, axis=0).clip(1e-300)
    found, _, rank, _ = np.linalg.lstsq(X, y, rcond=1e-9)
    fitted = X @ found
    left, taken = np.square(y - fitted).sum(), np.square(fitted - y.mean()).sum()
    own, others = rank - 1, len(y) - rank
    if own < 1 or others < 1 or left <= 0:
        return 1.0, fitted
    return float(special.fdtrc(own, others, taken / own / (left / others))), fitted
