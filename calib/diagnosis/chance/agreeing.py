"""Whether most stops agree, and a few are off, where stops seem to scatter by chance.

Were values drawn from one normal distribution, as scatter has it, then standardised ones (r,) would
be independent, normal, and of variance 1. A ball of radius q, wherever it is, then holds any of
them with a probability of that of chi-square, r, below q^2, or less (Anderson 1955). So of n values
m or more lie in the ball about one of them that reaches to the m-th with the tail of a binomial, or
less, times n. Half of the stops or more in a ball that is empty far around it are no chance: these
agree, and something was wrong at the others.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import special

from calib.blunders.judged import Blunder
from calib.blunders.others import Others
from calib.blunders.told import SHOWN, otherwise
from calib.effects import Scatter, Site
from calib.problem.model import labels
from calib.residuals.groups import Group
from calib.solve.components.told import DIRECTION_SEEN, Told, told
from calib.solve.estimate import Estimate

ALPHA_AGREE = 1e-6  # the least p-value that is ever told
FEWEST_AGREEING = 5  # stops; and of those off: a single one is a blunder for which others are asked
FEWEST_OFF_TOGETHER = 2
NO_SD = 1e-9  # m and rad: of what does not scatter; far below what anything tells
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
    """

    agree: int
    within: dict[str, float]
    off: Sequence[tuple[Group, dict[str, float]]]
    what: str
    lead: str
    alike: bool

    def blunders(self) -> Iterator[dict[str, Any]]:
        """The others, as diagnosis.json has blunders."""
        alike = ""
        if self.alike:
            alike = "; all that are off are off by the same"
            alike += ", and either half may be right" * (self.agree == len(self.off))
        for group, size in self.off:
            said = (
                f"{group.where}: {_sizes(size)} off {self.what}; {self.agree} of "
                f"{self.agree + len(self.off)} stops agree there within {_sizes(self.within)}, so "
                f"that is no scatter by chance{alike}. Look at its scan and at its tracked bodies."
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


def agreement(
    effect: Scatter, estimate: Estimate, others: Others, blunders: Sequence[Blunder]
) -> Agreement | None:
    """What agrees of that which seems to scatter by chance, if most does; the effect is in the
    model of a fit, of which these are all rows and all groups of them."""
    found: Iterator[Agreement | None] = iter(())
    if effect.widens and effect.site is Site.TRACKER:
        found = _of_bodies(blunders)
    elif not effect.widens and effect.per == "stop":
        found = _of_values(effect, estimate, others)
    return next((each for each in found if each), None)


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
            seen = np.isfinite(wide).all(axis=(1, 2))
            scans = (s.group for s in problem.scans if s.group.recording == label)
            who = {f"{term.effect.label}{group.where}": group for group in scans}
            known = [k for k in np.flatnonzero(seen).tolist() if names[k] in who]
            groups, units = [who[names[k]] for k in known], np.array(unknown.units[:size])
            yield _split(values[known], wide[known], groups, units, effect.what)


def _by_themselves(rows: Told, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Values (K, r) of so many members as their rows alone have them, and their covariances."""
    inverse = np.linalg.pinv(rows.information, rcond=DIRECTION_SEEN, hermitian=True)
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
        yield _split(offset, covariance, [b.group for b in some], units, f"where {body} is")


def _split(
    values: np.ndarray,
    covariance: np.ndarray,
    who: Sequence[Group],
    units: np.ndarray,
    what: str,
) -> Agreement | None:
    """Those of some values (K, r), of these covariances (K, r, r) if by chance, that agree, in all
    or in those of one unit, and the others; None where that may be chance."""
    every = dict.fromkeys(units.tolist())
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
    )


def _ball(values: np.ndarray, covariance: np.ndarray) -> tuple[float, np.ndarray] | None:
    """How often chance makes as many of some values (K, r), of these covariances, lie together as
    do where that is least likely; and which these are. None where no gap is around them."""
    count, size = values.shape
    least, most = max(FEWEST_AGREEING, -(-count // 2)), count - FEWEST_OFF_TOGETHER
    if most < least:
        return None
    z = np.linalg.solve(np.linalg.cholesky(covariance), values[..., None])[..., 0]
    z -= z.mean(axis=0)
    z /= max(float(np.sqrt(np.square(z).mean())), NO_SD)  # by chance they are as wide as they are
    centre = z[:: -(-count // MOST_CENTRES)]
    far = np.linalg.norm(z[None] - centre[:, None], axis=2)
    order = np.argsort(far, axis=1)
    reach = np.take_along_axis(far, order, axis=1)
    number = np.arange(least, most + 1)  # of those in a ball
    inside = special.chdtr(size, np.square(reach[:, number - 1]))
    p = count * len(number) * special.bdtrc(number - 2.0, count - 1, inside)
    p[reach[:, number] < GAP_AROUND * reach[:, number - 1]] = np.inf
    i, k = np.unravel_index(np.argmin(p), p.shape)
    return (float(p[i, k]), order[i, : number[k]]) if p[i, k] < np.inf else None
