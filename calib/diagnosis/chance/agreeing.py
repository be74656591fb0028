"""Whether most stops agree, and a few are off, where stops seem to scatter by chance.

Were values (r,) drawn from one normal distribution, as scatter has it, a ball of radius q, wherever
it is, would hold any of them no more often than one about their mean (Anderson 1955). With a mean
square of r in all, that is most often where they lie along one direction: the probability of
chi-square, 1, below q^2 / r, where that is below 1 (Szekely and Bakirov 2003, Probability Theory
and Related Fields 126, have it for two directions; above 1 nothing is said). So the binomial tail
of as many of n values in the ball about one of them that reaches to the m-th says how close they
lie, least over balls of half of the values or more with an empty gap around them; and how often it
is as little by chance is drawn, of values along one direction. What chance does not do so is
nothing that scatters: most agree, and something was wrong at the others.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from scipy import special

from calib.blunders.judged import Blunder
from calib.blunders.others import Others
from calib.blunders.told import SHOWN, otherwise
from calib.effects import Scatter, Site
from calib.linear.symmetric import eigh, pinv
from calib.problem.model import labels
from calib.residuals.groups import Group
from calib.solve.components.told import DIRECTION_SEEN, Told, told
from calib.solve.estimate import Estimate

# How often chance may make stops agree: a choice, as for other names that are easily checked.
ALPHA_AGREE = 0.01
# Up to so many stops it is drawn how often, from 2000 draws; of more the bound itself is enough.
MOST_DRAWN_FOR, AGREE_BATCHES, DRAWN_AT_ONCE = 60, 8, 250
FEWEST_AGREEING = 5  # stops; and of those off: a single one is a blunder for which others are asked
FEWEST_OFF_TOGETHER = 2
LEAST_VARIANCE = 1e-6  # of a direction, of that of each number: below it is rounding
NO_SD = 1e-9  # m and rad: of what does not scatter; far below what anything tells
# Of the most that is told of any member in some direction, less than which tells nothing of one:
# rows that are thirty sigmas off weigh a thousandth, and still tell of theirs.
SEEN_BY_ITSELF = 1e-6
GAP_AROUND = 3.0  # times further off than those that agree is the nearest of the others: a choice
MOST_CENTRES = 500  # about which balls are looked at, evenly chosen


@dataclass(frozen=True)
class Agreement:
    """Stops that agree, and others.

    Args:
        agree: how many do.
        within: unit -> how far apart they are, root mean square.
        off: rows of the others, and unit -> how far off these are.
        what: in what they agree.
        lead: the unit in which the others stand out most.
        alike: whether they are all off by the same.
        look: at what to look.
    """

    agree: int
    within: dict[str, float]
    off: Sequence[tuple[Group, dict[str, float]]]
    what: str
    lead: str
    alike: bool
    look: str

    def blunders(self) -> Iterator[dict[str, Any]]:
        """The others, as diagnosis.json has blunders."""
        alike = ""
        if self.alike:
            alike = "; all that are off are off by the same"
            alike += ", and either half may be right" * (self.agree == len(self.off))
        for group, size in self.off:
            said = (
                f"{group.where} is {_sizes(size)} off {self.what}, where {self.agree} of "
                f"{self.agree + len(self.off)} stops agree to {_sizes(self.within)}: that is no "
                f"scatter by chance{alike}. Look at {self.look}."
            )
            yield {
                **otherwise(group.kind, group.what, group.where, said),
                "stop": group.stop,
                "recording": group.recording or None,
                "size": size[self.lead],
                "unit": self.lead,
                "sigma": self.within[self.lead],
                "without": group.token,
            }


def _sizes(of: Mapping[str, float]) -> str:
    """Sizes by unit as people read them."""
    shown = (SHOWN[unit] for unit in of)
    pairs = zip(of.values(), shown, strict=True)
    return " and ".join(f"{scale * size:.3g} {unit}" for size, (unit, scale) in pairs)


def agreements(
    effect: Scatter, estimate: Estimate, others: Others, blunders: Sequence[Blunder]
) -> list[Agreement | None]:
    """What agrees of that which seems to scatter by chance, of each recording or body, None where
    most does not; the effect is in the model of a fit, of which these are all rows and all groups
    of them."""
    if effect.widens and effect.site is Site.TRACKER:
        return [*_of_bodies(blunders)]
    if not effect.widens and effect.per == "stop":
        return [*_of_values(effect, estimate, others)]
    return []


def _of_values(effect: Scatter, estimate: Estimate, others: Others) -> Iterator[Agreement | None]:
    """By recording, of the values of its stops beside what they have in common."""
    problem = others.problem
    for terms, label in zip(problem.terms, labels(problem.sources), strict=True):
        for term in (t for t in terms if t.effect.name == effect.name):
            unknown, names = problem.variables[term.variable], term.effect.members
            size = unknown.dim // len(names)
            rows = told([unknown], estimate.values, estimate.covariance_of([unknown.name]))
            rows = rows.about_means(slice(c, unknown.dim, size) for c in range(size))
            values, covariance = _by_themselves(rows, len(names))
            sd = np.maximum(unknown.sigma, NO_SD).reshape(len(names), size)
            wide = covariance + np.square(sd)[:, :, None] * np.eye(size)
            seen = _seen(rows, len(names))
            scans = (s.group for s in problem.scans if s.group.recording == label)
            who = {f"{term.effect.label}{group.where}": group for group in scans}
            known = [k for k in np.flatnonzero(seen).tolist() if names[k] in who]
            groups, units = [who[names[k]] for k in known], np.array(unknown.units[:size])
            look = "its scan" + " and its tracked bodies" * (size > 1)
            yield _split(values[known], wide[known], groups, units, (effect.what, look))


def _seen(rows: Told, count: int) -> np.ndarray:
    """(K,) of which of so many members rows tell in every direction."""
    size, each = len(rows.score) // count, np.arange(count)
    blocks = rows.information.reshape(count, size, count, size)[each, :, each]
    root = np.sqrt(np.maximum(np.einsum("kii->ki", blocks).max(axis=0), NO_SD))
    return np.linalg.eigvalsh(blocks / np.outer(root, root))[:, 0] > SEEN_BY_ITSELF


def _by_themselves(rows: Told, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Values (K, r) of so many members as their rows alone have them, and their covariances."""
    inverse = pinv(rows.information, DIRECTION_SEEN)
    size = len(inverse) // count
    each = np.arange(count)
    blocks = inverse.reshape(count, size, count, size)[each, :, each]
    return (inverse @ rows.score).reshape(count, size), blocks


def _of_bodies(blunders: Sequence[Blunder]) -> Iterator[Agreement | None]:
    """By body, of its poses against a fit of all other rows."""
    found: dict[tuple[str, str], list[Blunder]] = {}
    for each in blunders:
        shift = each.shift
        if each.group.kind == "body" and not each.found and shift.dof == len(shift.offset) == 6:
            found.setdefault((each.group.recording, each.group.what), []).append(each)
    for (_, body), some in found.items():
        offset, covariance = (
            np.stack([getattr(b.shift, of) for b in some]) for of in ("offset", "covariance")
        )
        units = np.array(some[0].shift.units)
        told_of = (f"in where the tracker sees {body}", "its row")
        yield _split(offset, covariance, [b.group for b in some], units, told_of)


def _split(
    values: np.ndarray,
    covariance: np.ndarray,
    who: Sequence[Group],
    units: np.ndarray,
    said: tuple[str, str],
) -> Agreement | None:
    """Those of some values (K, r), of these covariances (K, r, r) if by chance, that agree, in all
    or in those of one unit, and the others; None where that may be chance. It is `said` in what,
    and at what to look."""
    every, (what, look) = dict.fromkeys(units.tolist()), said
    looks = [np.full(len(units), True), *(units == unit for unit in every if len(every) > 1)]
    balls = [_ball(values[:, at], covariance[:, at][:, :, at]) for at in looks]
    p, agree = min(filter(None, balls), key=lambda ball: ball[0], default=(1.0, None))
    if agree is None or p * len(looks) >= ALPHA_AGREE:
        return None
    rest = np.setdiff1d(np.arange(len(values)), agree)
    middle = np.median(values[agree], axis=0)
    away = values - middle

    def by_unit(squares: np.ndarray) -> dict[str, float]:
        return {unit: float(np.sqrt(squares[units == unit].sum())) for unit in every}

    within, off = (
        by_unit(np.square(away[agree]).mean(axis=0)),
        by_unit(np.square(away[rest]).mean(0)),
    )
    apart = by_unit(np.var(away[rest], axis=0))
    lead = max(every, key=lambda unit: off[unit] / max(within[unit], NO_SD))
    return Agreement(
        agree=len(agree),
        within=within,
        off=[(who[j], by_unit(np.square(away[j]))) for j in rest.tolist()],
        what=what,
        lead=lead,
        alike=apart[lead] * GAP_AROUND < off[lead],
        look=look,
    )


def _ball(values: np.ndarray, covariance: np.ndarray) -> tuple[float, np.ndarray] | None:
    """How often chance makes as many of some values (K, r), of these covariances, lie together as
    do where that is least likely; and which these are. None where no gap is around them."""
    count = len(values)
    numbers = count - FEWEST_OFF_TOGETHER + 1 - _half(count)
    if numbers < 1:
        return None
    # In units of their sizes; m and rad in one matrix, or what rounding leaves, may have no root.
    size = np.sqrt(np.maximum(np.einsum("kii->ki", covariance), NO_SD**2))
    variance, axes = eigh(covariance / (size[:, :, None] * size[:, None]))
    along = np.vecmat(values / size, axes) / np.sqrt(np.maximum(variance, LEAST_VARIANCE))
    z = np.matvec(axes, along)  # the axes of one are not those of another
    tail, (order,), (number,) = _tails(z[None])
    if tail[0] >= 1.0:
        return None
    p = count * numbers * float(tail[0])
    if count <= MOST_DRAWN_FOR:
        p = min(p, float(np.mean(np.append(_drawn_tails(count) <= tail[0], True))))
    return p, order[:number]


def _half(count: int) -> int:
    return max(FEWEST_AGREEING, -(-count // 2))


def _tails(z: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of some sets of values (D, K, r): the least tail (D,) of balls with a gap around them, 1
    where there is none, the values (D, K) in the order of their distance from its centre, and how
    many (D,) are in it."""
    draws, count, size = z.shape
    z = z - z.mean(axis=1, keepdims=True)
    z /= np.maximum(np.sqrt(np.square(z).mean(axis=(1, 2), keepdims=True)), NO_SD)
    centre = z[:, :: -(-count // MOST_CENTRES)]
    far = np.linalg.norm(z[:, None] - centre[:, :, None], axis=3)
    order = np.argsort(far, axis=2)
    reach = np.take_along_axis(far, order, axis=2)
    number = np.arange(_half(count), count - FEWEST_OFF_TOGETHER + 1)  # of those in a ball
    share = np.square(reach[..., number - 1]) / size
    inside = np.where(share < 1.0, special.chdtr(1, share), 1.0)
    tail = special.bdtrc(number - 2.0, count - 1, inside)
    tail[reach[..., number] < GAP_AROUND * reach[..., number - 1]] = 1.0
    flat = tail.reshape(draws, -1)
    i, m = np.unravel_index(flat.argmin(axis=1), tail.shape[1:])
    each = np.arange(draws)
    return flat.min(axis=1), order[each, i], number[m]


@cache
def _drawn_tails(count: int) -> np.ndarray:
    """Such tails of so many values along one direction, by chance."""
    rng = np.random.default_rng(0)
    return np.concatenate(
        [_tails(rng.standard_normal((DRAWN_AT_ONCE, count, 1)))[0] for _ in range(AGREE_BATCHES)]
    )
