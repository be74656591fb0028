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
from calib.residuals.groups import SCAN, Group
from calib.solve.components.told import DIRECTION_SEEN, Told, told
from calib.solve.estimate import Estimate

ALPHA_AGREE = 1e-6  # the least p-value that is ever told
FEWEST_AGREEING = 5  # stops; and of those off: a single one is a blunder for which others are asked
FEWEST_OFF_TOGETHER = 2
NO_SD = 1e-9  # m and rad: of what does not scatter; far below what anything tells
APART = 3.0  # times further off than those that agree is the nearest of the others: a choice
MOST_CENTRES = 500  # about which balls are looked at, evenly chosen


@dataclass(frozen=True)
class Agreement:
    """Stops that agree, and others.

    Args:
        agree: how many do.
        within: unit -> how far apart they are, root mean square.
        off: rows of the others, and unit -> how far off these are.
        what: in what they agree.
    """

    agree: int
    within: dict[str, float]
    off: Sequence[tuple[Group, dict[str, float]]]
    what: str

    def blunders(self) -> Iterator[dict[str, Any]]:
        """The others, as diagnosis.json has blunders."""
        for group, size in self.off:
            said = (
                f"{group.where}: {_sizes(size)} off {self.what}; {self.agree} of "
                f"{self.agree + len(self.off)} stops agree there within {_sizes(self.within)}, so "
                "that is no scatter by chance. Look at its scan and at its tracked bodies."
            )
            unit = max(size, key=lambda each: size[each] / max(self.within[each], NO_SD))
            yield {
                **otherwise(group.kind, group.what, group.where, said),
                "stop": group.stop,
                "recording": group.recording or None,
                "size": size[unit],
                "unit": unit,
                "sigma": self.within[unit],
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
            who = [Group("scan", n.removeprefix(term.effect.label), SCAN, label) for n in names]
            units = np.array(unknown.units[:size])
            known = [k for k in np.flatnonzero(seen) if _there(who[k], others)]
            yield _split(values[known], wide[known], [who[k] for k in known], units, effect.what)


def _there(group: Group, others: Others) -> bool:
    return any(scan.group == group for scan in others.problem.scans)


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
    """Those of some values (K, r), of these covariances (K, r, r) if by chance, that agree, and the
    others; None where that may be chance, or where no gap is between."""
    count, size = values.shape
    least = max(FEWEST_AGREEING, -(-count // 2))
    if count < least + FEWEST_OFF_TOGETHER:
        return None
    root = np.linalg.cholesky(covariance)
    z = np.linalg.solve(root, values[..., None])[..., 0]
    centre = z[:: -(-count // MOST_CENTRES)]
    far = np.linalg.norm(z[None] - centre[:, None], axis=2)
    order = np.argsort(far, axis=1)
    reach = np.take_along_axis(far, order, axis=1)
    most = count - FEWEST_OFF_TOGETHER
    number = np.arange(least, most + 1)  # of those in a ball
    inside = special.chdtr(size, np.square(reach[:, number - 1]))
    p = count * len(number) * special.bdtrc(number - 2.0, count - 1, inside)
    p[reach[:, number] < APART * reach[:, number - 1]] = 1.0
    i, k = np.unravel_index(np.argmin(p), p.shape)
    if p[i, k] >= ALPHA_AGREE:
        return None
    agree, rest = order[i, : number[k]], np.sort(order[i, number[k] :])
    middle = np.median(values[agree], axis=0)
    away = values - middle

    def by_unit(squares: np.ndarray) -> dict[str, float]:
        every = dict.fromkeys(units.tolist())
        return {unit: float(np.sqrt(squares[units == unit].sum())) for unit in every}

    return Agreement(
        agree=len(agree),
        within=by_unit(np.square(away[agree]).mean(axis=0)),
        off=[(who[j], by_unit(np.square(away[j]))) for j in rest.tolist()],
        what=what,
    )
