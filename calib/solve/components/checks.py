"""What residuals say of the sigma of their rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.linear.symmetric import eigh

# Of a variance; no less and no more is found at once. Joints read to 0.1 mrad may scatter by 1 rad.
GROWN = np.geomspace(1e-3, 1e8, 78) - 1.0
UNSEEN_REDUNDANCY = 1e-6  # of a redundancy: rounding of a covariance is some 1e-9 of it
UNTOLD_ROWS = 1e-6  # rows: what fewer tell of a variance is nothing


@dataclass(frozen=True)
class Checks:
    """What residuals (n,) of rows with one sigma, whitened and independent, say of that sigma.

    A residual has the variance ``r + d r^2``, r its redundancy and d by how much more the rows'
    variance is than their sigma has it. Rows that check each other alone have r = 1; joint readings
    also show what bodies and beams err by, and little of what they err by themselves.

    Args:
        square: (n,) of each residual; sum of so many.
        redundancy: (n,) r.
        count: (n,) how many there are of each.
    """

    square: np.ndarray
    redundancy: np.ndarray
    count: np.ndarray

    @classmethod
    def alone(cls, total: float, left: float) -> Checks:
        """Of rows that check each other: the sum of their squares, and of their redundancies."""
        return cls(np.array([total]), np.ones(1), np.array([left]))

    @classmethod
    def of(cls, residual: np.ndarray, redundancy: np.ndarray) -> Checks:
        """Of residuals (..., m) whose covariance is the redundancy (..., m, m), where sigmas are
        right."""
        values, axes = eigh(redundancy)
        seen = values > UNSEEN_REDUNDANCY  # in the others nothing checks the rows: residuals are 0
        square = np.square(np.vecmat(residual, axes))[seen]
        return cls(square, np.minimum(values[seen], 1.0), np.ones(int(seen.sum())))

    @classmethod
    def together(cls, some: Sequence[Checks]) -> Checks:
        """Of all of these rows."""
        return cls(
            square=np.concatenate([each.square for each in some]),
            redundancy=np.concatenate([each.redundancy for each in some]),
            count=np.concatenate([each.count for each in some]),
        )

    @property
    def total(self) -> float:
        """Sum of squares, about `left` where the sigma is right (Foerstner 1979)."""
        return float(self.square.sum())

    @property
    def left(self) -> float:
        """The redundancy of all rows."""
        return float(self.count @ self.redundancy)

    @property
    def told(self) -> float:
        """How many rows without error beside them would tell as much of the variance."""
        return float(self.count @ np.square(self.redundancy))

    @property
    def dof(self) -> float:
        """Of the chi-square that `total` is in `scaled` units, of the same mean and variance
        (Satterthwaite 1946)."""
        return self.left**2 / self.told

    @property
    def scaled(self) -> float:
        return self.total * self.left / self.told

    def growth(self) -> float:
        """The d of greatest restricted likelihood, down to -1 where nothing tells."""
        if self.told <= 0:
            return -1.0
        from scipy.optimize import minimize_scalar  # late: it loads much, and most fits need none

        best = int(np.argmax([self.statistic(d) for d in GROWN]))
        around = GROWN[max(best - 1, 0)], GROWN[min(best + 1, len(GROWN) - 1)]
        found = minimize_scalar(
            lambda x: -self.statistic(np.expm1(x)), bounds=np.log1p(around), method="bounded"
        )
        return float(np.expm1(found.x))

    def sigma(self, d: float) -> float:
        """Sigma of `growth` where that is d."""
        weight = self.count @ np.square(self.redundancy / (1.0 + d * self.redundancy))
        return float(np.sqrt(2.0 / max(weight, UNTOLD_ROWS)))

    def statistic(self, d: float) -> float:
        """Twice the log of the likelihood ratio of d against none."""
        grown = 1.0 + d * self.redundancy
        return float(self.square @ (d / grown) - self.count @ np.log(grown))

    def had_variance(self, share: float) -> Checks:
        """What they would be had the rows' sigma this share of its variance."""
        r = self.redundancy
        grown = 1.0 - r + share * r
        return Checks(share * self.square / grown**2, share * r / grown, self.count)
