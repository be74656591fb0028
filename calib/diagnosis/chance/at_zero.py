"""The test that values do not scatter; see `calib.diagnosis.chance`."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from scipy import special

from calib.blunders.chance import POWER
from calib.linear.symmetric import eigh
from calib.solve.components.told import DIRECTION_SEEN, Told

SCATTER_DRAWS = 2000  # of chance: their mean, from which p-values follow, is known to some 5 %
GRID = np.append(0.0, np.geomspace(1e-3, 1e3, 61))  # of d, in units of the mean 1 / l


class AtZero:
    """The test that a group's values do not scatter.

    Args:
        told: of that group.
    """

    def __init__(self, told: Told) -> None:
        values, axes = eigh(told.information)
        seen = values > DIRECTION_SEEN * max(values[-1], 0.0)
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

    def spread(self) -> float:
        """The likeliest sd."""
        gain = [float(self._gain(d)) for d in self.d]
        return float(np.sqrt(self.d[int(np.argmax(gain))]))

    def _gain(self, d: float) -> float:
        grown = 1.0 + d * self.l
        return self.w @ (1.0 - 1.0 / grown) - np.log(grown).sum()

    def drawn(self, d: float = 0.0) -> np.ndarray:
        """The statistic (SCATTER_DRAWS,) of draws at a variance."""
        normal = np.random.default_rng(0).standard_normal((SCATTER_DRAWS, len(self.l)))
        return self.statistic(np.square(normal) * (1.0 + d * self.l))

    @cached_property
    def tail(self) -> tuple[float, float]:
        """Share of what is not zero by chance, and the scale of the chi-square that it is."""
        drawn = self.drawn()
        share = float(np.mean(drawn > 1e-9))
        return share, float(drawn.mean() / share) if share else 1.0

    def p_value(self) -> tuple[float, float]:
        """The statistic, and how often chance alone makes one as large."""
        share, scale = self.tail
        statistic = float(self.statistic(self.w[None])[0])
        p = share * float(special.chdtrc(1, statistic / scale)) if statistic > 1e-9 else 1.0
        return statistic, p

    def detectable(self, alpha: float) -> float:
        """The sd that is found with 80 % power at a level."""
        share, scale = self.tail
        if share <= alpha:
            return np.inf
        limit = scale * float(special.chdtri(1, alpha / share))
        first, last = 0, len(self.d)  # of the grid: too small for sure, and large enough
        while last - first > 1:
            middle = (first + last) // 2
            enough = np.mean(self.drawn(self.d[middle]) > limit) > POWER
            first, last = (first, middle) if enough else (middle, last)
        return float(np.sqrt(self.d[last])) if last < len(self.d) else np.inf
