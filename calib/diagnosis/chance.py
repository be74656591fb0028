"""Whether values scatter from stop to stop, or from place to place, by chance: tested at zero.

As `calib.solve.components` has it, a group's values have a score ``g ~ N(0, M + d M M)``, d their
variance. With the eigenvalues l of M, the squares ``w = z^2 / l`` of its independent parts are
chi-square times ``1 + d l``. The restricted likelihood ratio of d against 0 lies on the edge of
what d may be, so it is no chi-square; its distribution follows from the l alone (Crainiceanu and
Ruppert 2004). It is drawn, and its tail is that of a chi-square, scaled, with a share of zeros
(Greven, Crainiceanu, Kuechenhoff and Peters 2008).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import special

from calib.blunders.chance import after_looks
from calib.diagnosis.score import Scores
from calib.effects import Scatter
from calib.solve.components import SEEN, Told, spreads, told
from calib.solve.estimate import Estimate

ALPHA = 0.01  # chance that a scatter is found where there is none
POWER = 0.8  # with which one of the smallest detectable spread is found
FEWEST = 4  # members that anything tells of, below which nothing is said of their spread
DRAWS = 2000
GRID = np.append(0.0, np.geomspace(1e-3, 1e3, 61))  # of d, in units of the mean 1 / l


@dataclass(frozen=True)
class Chance:
    """An effect by chance that a model lacks.

    Args:
        effect: which.
        sd: how widely its values scatter.
        sigma: of the sd.
        statistic: the likelihood ratio against none.
        p_value: how often as much is seen where there is none.
        p_adjusted: the same, the others of its kind being looked at too.
        detectable: sd that is found with 80 % power.
    """

    effect: Scatter
    sd: float
    sigma: float
    statistic: float
    p_value: float
    p_adjusted: float
    detectable: float

    @property
    def found(self) -> bool:
        """Whether it is to be named."""
        return self.p_adjusted < ALPHA

    def beside(self, estimate: Estimate) -> Chance:
        """The same as a fit has it that it is part of, tested beside all else in that."""
        spread, best = spreads(estimate), self
        for name in (n for n in spread if n.rpartition("/")[2] == self.effect.name):
            unknown = estimate.problem.variables[name]
            test = AtZero(told([unknown], estimate.values, estimate.covariance_of([name])))
            statistic, p = test.p_value()
            sd, sigma = spread[name]
            again = replace(self, sd=sd, sigma=sigma, statistic=statistic, p_value=p, p_adjusted=p)
            best = again if best is self or statistic > best.statistic else best
        return best

    @property
    def spread(self) -> dict[str, Any]:
        """How widely it scatters, as the contract has it."""
        effect = self.effect
        return {"effect": effect.name, "sd": self.sd, "sigma": self.sigma, "unit": effect.unit}

    def document(self, step: int | None) -> dict[str, Any]:
        """As one of the candidates of diagnosis.json.

        Args:
            step: in which it was added, counting from 1; None where it was not.
        """
        return {
            "effect": self.effect.family,
            "add": self.effect.name,
            "site": "range",
            "p_value": self.p_value,
            "p_adjusted": self.p_adjusted,
            "statistic": self.statistic,
            "dof": 1,
            "step": step,
            "dressed_up": False,
            "held_out_rms_mm": {"before": None, "after": None},
            "error_explained": None,
            "rms_mm": 1e3 * self.sd,
            "unabsorbed_rms_mm": 1e3 * self.sd,
            "parameters": {
                "unit": self.effect.unit,
                "names": ["sd"],
                "estimate": [self.sd],
                "sigma": [self.sigma],
            },
            "smallest_detectable": self.detectable,
            "indistinguishable_from": [],
            "rivals": [],
        }

    @property
    def sentence(self) -> str:
        """What it says, and what to do about it."""
        each, name = self.effect.per, self.effect.name
        return (
            f"{each.capitalize()}s scatter by {1e3 * self.sd:.2f} +- {1e3 * self.sigma:.2f} mm in "
            f"range, by chance as far as this data tell (p = {self.p_adjusted:.1g}): {name} takes "
            f"that into every sigma. It tells nothing of the next {each}, so no held-out error "
            f"falls."
        )


class AtZero:
    """The test that a group's values do not scatter.

    Args:
        told: of that group.
    """

    def __init__(self, told: Told) -> None:
        values, axes = np.linalg.eigh(told.information)
        seen = values > SEEN * values[-1]
        self.l = values[seen]
        self.w = np.square(axes[:, seen].T @ told.score) / self.l
        self.d = GRID / np.mean(self.l) if len(self.l) else GRID

    @property
    def members(self) -> int:
        """How many anything tells of: their mean belongs to a range zero that all share."""
        return len(self.l) + 1

    def statistic(self, w: np.ndarray) -> np.ndarray:
        """Twice the log of the likelihood ratio (R,) of squares (R, n)."""
        grown = 1.0 + self.d[:, None] * self.l
        gain = w @ (1.0 - 1.0 / grown).T - np.log(grown).sum(axis=1)
        return gain.max(axis=1)

    def drawn(self, d: float = 0.0) -> np.ndarray:
        """The statistic (DRAWS,) of draws at a variance."""
        normal = np.random.default_rng(0).standard_normal((DRAWS, len(self.l)))
        return self.statistic(np.square(normal) * (1.0 + d * self.l))

    def tail(self) -> tuple[float, float]:
        """Share of what is not zero by chance, and the scale of the chi-square that it is."""
        drawn = self.drawn()
        share = float(np.mean(drawn > 1e-9))
        return share, float(drawn.mean() / share) if share else 1.0

    def p_value(self) -> tuple[float, float]:
        """The statistic, and how often chance alone makes one as large."""
        share, scale = self.tail()
        statistic = float(self.statistic(self.w[None])[0])
        p = share * float(special.chdtrc(1, statistic / scale)) if statistic > 1e-9 else 1.0
        return statistic, p

    def detectable(self, alpha: float) -> float:
        """The sd that is found with 80 % power at a level."""
        share, scale = self.tail()
        if share <= alpha:
            return np.inf
        limit = scale * float(special.chdtri(1, alpha / share))
        first, last = 0, len(self.d)  # of the grid: too small for sure, and large enough
        while last - first > 1:
            middle = (first + last) // 2
            enough = np.mean(self.drawn(self.d[middle]) > limit) > POWER
            first, last = (first, middle) if enough else (middle, last)
        return float(np.sqrt(self.d[last])) if last < len(self.d) else np.inf


def chances(
    scores: Scores, some: Sequence[Scatter], columns: Mapping[str, np.ndarray]
) -> list[Chance]:
    """The tests of effects by chance, those that chance explains least first.

    Args:
        scores: of candidates, these among them.
        some: those to test.
        columns: effect's name -> its columns among the scores.
    """
    out, looks = [], len(some)
    for effect in some:
        at = columns[effect.name]
        rows = Told(scores.score[at], scores.information[np.ix_(at, at)], np.zeros(len(at), int))
        test = AtZero(rows)
        if test.members < FEWEST:
            continue
        sd = rows.spread(np.array([effect.sigma]))
        statistic, p = test.p_value()
        out.append(
            Chance(
                effect=effect,
                sd=float(sd[0]),
                sigma=float(rows.sigma(sd)[0]),
                statistic=statistic,
                p_value=p,
                p_adjusted=float(after_looks(p, looks)),
                detectable=test.detectable(ALPHA / looks),
            )
        )
    return sorted(out, key=lambda chance: (chance.p_value, -chance.statistic))
