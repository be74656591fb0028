"""Which groups of rows chance does not put so far out: blunders, named, sized, told apart.

How far out a group lies is measured against others of its kind: a tracker five times worse than its
sigma makes all bodies stick out, and none a blunder. How far out their kind is, they themselves
tell, and so does the sigma that is stated of them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from scipy import special

from calib.blunders.chance import KNOWN, LEVELS, after_looks, at_least, enough, log_tail
from calib.blunders.others import Others
from calib.blunders.shifts import Shift, shifts
from calib.blunders.uneven import Uneven, Whereabouts, unevenly
from calib.problem.model import labels
from calib.residuals.groups import JOINTS, Group, kind_and_number

ALPHA_BLUNDER = LEVELS["blunder"]
# How much the median of squares tells of their scale, against their mean, for Gaussian rows.
MEDIAN = 0.37
FEWEST_OF_KIND = 4  # groups of a kind, below which these are taken at their sigmas
# Degrees of freedom of a sigma that somebody states: a half over the square of its relative
# uncertainty, a quarter (GUM G.4.2). Where groups are few, it tells more of their scale than they.
STATED = 8.0
# Of groups that nothing tells apart, that which goes wrong most often is named first: bodies are
# touched, knocked and occluded, scans mixed up; all joints of an arm are seldom wrong at once.
LIKELY = ("body", "scan", "target", "level", "frame", "surface", "joints", "rings")
# Beyond this what a joint does is far from its derivative: no joint is said to be so far off. What
# is half a turn off seems to be by a little more at times.
LINEAR_RAD = 0.5
TELLING = 2.0  # sigmas: by convention, from which a size says something
ALONG = 0.95  # of an offset's length, along one axis, to be said to lie along it


@dataclass(frozen=True)
class Blunder:
    """A group of rows, and whether chance puts it so far out.

    Args:
        shift: by how much.
        p_value: how often chance alone does, given how far out others of its kind are.
        p_adjusted: the same, all groups looked at being paid for.
        evidence: minus the log of the p-value of independent rows, at the scale of its kind.
        limit: of the statistic, beyond which it is named.
        enough: noncentrality of the statistic at which it is found with 80 % power.
        detectable: unit -> size of such a blunder.
        looks: how many groups p_adjusted pays for.
        uneven: how those of its kind scatter unevenly, where they do.
    """

    shift: Shift
    p_value: float
    p_adjusted: float
    evidence: float
    limit: float
    enough: float
    detectable: Mapping[str, float]
    looks: int
    uneven: Uneven | None = None

    @property
    def group(self) -> Group:
        return self.shift.group

    @property
    def likely(self) -> int:
        """How seldom its kind goes wrong, from 0."""
        return LIKELY.index(self.group.kind)

    @property
    def possible(self) -> bool:
        """Whether it may be off by so much at all."""
        half_a_turn = 0.0 if self.group.kind == "joints" else np.pi
        return self._turned_rad < half_a_turn + LINEAR_RAD

    @property
    def found(self) -> bool:
        """Whether it is to be named: joints, and others only where they may be off by so much, as
        where nothing fits they would be turned by far more than half a turn."""
        return self.p_adjusted < ALPHA_BLUNDER and (self.group.kind == "joints" or self.possible)

    @property
    def _turned_rad(self) -> float:
        """Its largest angle."""
        turns = self.shift.parts.get("rad", np.zeros(0, int))
        return float(np.abs(self.shift.offset[turns]).max(initial=0.0))

    def leading(self) -> tuple[float, float, str, str]:
        """Size, its sigma, the unit, and along which axis; empty where it is along no single one.
        Of shifts in several units, that which is more sigmas."""
        shift, best = self.shift, (0.0, 0.0, np.inf, "m", "")
        for unit, at in shift.parts.items():
            offset, covariance = shift.offset[at], shift.covariance[np.ix_(at, at)]
            size = float(np.linalg.norm(offset))
            if not size:
                continue
            sigma = float(np.sqrt(offset @ covariance @ offset)) / size
            k = int(np.argmax(np.abs(offset)))
            axis = shift.axes[at[k]] if abs(offset[k]) > ALONG * size else ""
            if size < TELLING * sigma:  # as a whole nothing tells it: then what is known best
                known = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
                k = int(np.argmax(np.abs(offset) / known))
                size, sigma, axis = abs(float(offset[k])), float(known[k]), shift.axes[at[k]]
            best = max(best, (size / max(sigma, 1e-300), size, sigma, unit, axis))
        return best[1:]


@dataclass(frozen=True)
class LeftOut:
    """A blunder, and what else could be wrong in its place.

    Args:
        blunder: as it stood out when it was left out.
        rivals: groups that explain as much, nothing once it is left out, and leave nothing of it if
            they are left out instead.
        belongs: of a scan, the stop in whose place it fits.
        aside: whether the fit itself had set it aside.
    """

    blunder: Blunder
    rivals: Sequence[Group]
    belongs: Group | None = None
    aside: bool = False


def judge(others: Others, planned: Collection[str] = ()) -> list[Blunder]:
    """All groups of rows, those that chance explains least first.

    Args:
        others: as of `shifts`.
        planned: names of stops that nobody has measured yet, which tell nothing of how far out
            others of their kind are.
    """
    problem = others.problem
    kinds: dict[tuple[str, str, bool], list[Shift]] = {}
    pairs = list(zip(problem.sources, labels(problem.sources), strict=True))
    gone = {group for source, _ in pairs for group in source.without}
    gone |= {Group("joints", *where, label) for source, label in pairs for where in source.unread}
    for shift in shifts(others):
        if shift.dof and shift.group not in gone:
            kinds.setdefault((*_alike(shift.group), shift.of_ranges), []).append(shift)
    # Of the level one half is for parts of the mesh, which are many, and one for all others.
    halves = Counter(s.group.kind == "surface" for some in kinds.values() for s in some)
    whereabouts = Whereabouts.of(problem)
    found: list[Blunder] = []
    for (kind, *_), some in kinds.items():
        looks = len(halves) * halves[kind == "surface"]
        found += _judged(some, looks, planned, whereabouts)
    return sorted(_as_one_joint_scatters(found), key=lambda b: -b.evidence)


def _as_one_joint_scatters(judged: Sequence[Blunder]) -> Iterator[Blunder]:
    """Where one joint's reading explains how far out a stop is, and chance puts that joint so far
    out, as it scatters more than others do, chance puts the stop there: nothing else of the stop
    is further out than that, and further out it would have to be to be named."""
    single: dict[tuple[str, str], list[Blunder]] = {}
    for each in judged:
        if not _whole(each.group):
            single.setdefault(each.group.place, []).append(each)
    for each in judged:
        if each.found and _whole(each.group):
            least = each.shift.statistic - each.limit * (1.0 - 1.0 / each.shift.dof)
            for one in single.get(each.group.place, ()):
                if one.shift.statistic > least and one.p_adjusted > each.p_adjusted:
                    wider = max(1.0, each.shift.statistic / each.limit)
                    each = replace(
                        each,
                        p_value=one.p_value,
                        p_adjusted=one.p_adjusted,
                        limit=wider * each.limit,
                        enough=wider * each.enough,
                        detectable={u: np.sqrt(wider) * x for u, x in each.detectable.items()},
                    )
        yield each


def _alike(group: Group) -> tuple[str, str]:
    """Groups that are as likely as each other to be somewhat off."""
    if group.kind == "surface":
        return group.kind, kind_and_number(group.what)[0]
    return group.kind, group.what if group.kind in ("body", "level") else ""


def _whole(group: Group) -> bool:
    """Whether it tells how far out its kind is. Each joint of a stop can stand in for much of what
    contradicts that stop, so the median of single joints says little."""
    return group.kind != "joints" or group.what == JOINTS


def limit_of(own: float, others: float, groups: int, looks: int) -> tuple[float, float]:
    """Degrees of freedom of how far out the bulk of a kind is; and how far beyond that chance puts
    a group at most, in mean squares (F).

    Args:
        own, others: degrees of freedom of the group, and of all others of its kind.
        groups: of its kind.
        looks: groups that are looked at.
    """
    known = STATED + MEDIAN * max(others, 1.0) if groups >= FEWEST_OF_KIND else KNOWN
    return known, special.fdtri(own, known, (1.0 - ALPHA_BLUNDER) ** (1.0 / looks))


def _bulk(some: Sequence[Shift]) -> float:
    """How far out the median of some groups is, in squares of what chance makes it; at least 1."""
    if len(some) < FEWEST_OF_KIND:
        return 1.0
    by_chance = special.chdtri([shift.dof for shift in some], 0.5)
    return max(1.0, float(np.median([shift.statistic for shift in some] / by_chance)))


def _judged(
    some: Sequence[Shift], looks: int, planned: Collection[str], whereabouts: Whereabouts
) -> Iterator[Blunder]:
    """Groups of one kind: in units of how far out their bulk is, or their neighbours are where they
    scatter unevenly; a single joint's too, as readings that scatter show most in the joints that
    move the body furthest."""
    measured = [shift for shift in some if shift.group.stop not in planned]
    wholes = [shift for shift in measured if _whole(shift.group)]
    dof = np.array([shift.dof for shift in wholes])
    of_kind = _bulk(wholes)
    single: dict[tuple[str, str], list[Shift]] = {}
    for shift in (s for s in measured if not _whole(s.group)):
        single.setdefault((shift.group.recording, shift.group.what), []).append(shift)
    of_joint = {joint: max(of_kind, _bulk(mine)) for joint, mine in single.items()}
    uneven = unevenly(wholes, whereabouts)
    count = uneven.nearest if uneven else len(wholes)

    @cache
    def bounds(own: int) -> tuple[float, float, float]:
        """Of groups of so many dofs: those of the bulk, the limit of F, and its noncentrality."""
        others = dof.sum() * count / max(len(wholes), 1)
        known, limit = limit_of(own, others - own, count, looks)
        return known, limit, enough(own, known, limit)

    def bulk_of(group: Group) -> float:
        """How far out those of its kind are, there."""
        bulk = of_kind
        if uneven:
            bulk = max(1.0, uneven.scale.get((group.recording, group.where), of_kind))
        return max(bulk, of_joint.get((group.recording, group.what), 0.0))

    own = np.array([shift.dof for shift in some])
    bulk = np.array([bulk_of(shift.group) for shift in some])
    known, limit, least = np.array([bounds(each) for each in own.tolist()]).T
    scaled = np.array([shift.statistic for shift in some]) / bulk
    p = special.fdtrc(own, known, scaled / own)
    each = zip(
        some, p, after_looks(p, looks), scaled, limit * own * bulk, least * bulk, strict=True
    )
    for shift, p_value, p_adjusted, statistic, beyond, found in each:
        told = {u: shift.information[at, at].mean() for u, at in shift.parts.items()}
        yield Blunder(
            shift=shift,
            p_value=at_least(p_value),
            p_adjusted=float(p_adjusted),
            evidence=-log_tail(statistic, shift.dof),
            limit=float(beyond),
            enough=float(found),
            detectable={u: float(np.sqrt(found / t)) for u, t in told.items() if t > 0},
            looks=looks,
            uneven=uneven,
        )
