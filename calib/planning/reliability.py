"""Stops that check each other: a calibration that no single stop carries alone.

With C the covariance of the estimates and C_k that without stop k, an error of any shape in the
rows of that stop, too small to be found, moves estimate j by at most

    sqrt(d (C_k - C)_jj)

where d is the noncentrality of its test (external reliability: Baarda 1968; that ``A^T (I - A C
A^T)^-1 A`` between two C is C_k - C is Woodbury's identity). So what a blunder can do unseen is how
much worse off one is without the stop, and stops are chosen that leave most once the stop is lost
whose loss hurts most.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calib.linear.symmetric import eigh
from calib.planning.criteria import Criterion, Variance
from calib.planning.information import Information, inverse


class Reliable(Criterion):
    """A-optimality, in units of what is known now, once the stop is lost whose loss hurts most.

    Args:
        known: of all rows that were measured.
        of: (n,) the components of interest.
        measured: (K, S, S) what each measured stop tells by itself.
    """

    def __init__(self, known: Information, of: np.ndarray, measured: np.ndarray) -> None:
        # Taken by itself a stop may seem to tell more than it does among all; none tells less
        # than nothing.
        rest, turn = eigh(known.data - measured.sum(axis=0))
        self.start = known.paper + (turn * np.maximum(rest, 0.0)) @ turn.T + measured.sum(axis=0)
        now = np.sqrt(np.diag(inverse(known.data + known.paper, of)))
        self.inner, self.measured = Variance(known, of, now), list(measured)

    def of(self, M: np.ndarray) -> np.ndarray:
        """Of designs (n,) of which the planned stops are never lost."""
        return np.min([self.inner.of(M - E) for E in self.measured or [0.0]], axis=0)

    def each(
        self, base: np.ndarray, more: np.ndarray, others: Sequence[np.ndarray] = ()
    ) -> np.ndarray:
        """As `Criterion.each`; of designs that are not the best, no less than what they are.

        The loss of the stop that is being added is no worse than not to add it, so it plays no
        part. The losses that hurt most are looked at first, and only designs that can still be the
        best at the others.
        """
        lost = [*self.measured, *others] or [np.zeros_like(base)]
        hurt = np.argsort([self.inner.of((base - E)[None])[0] for E in lost], kind="stable")
        value = self.inner.each(base - lost[hurt[0]], more)
        best = int(np.argmax(value))
        least = min(self.inner.of((base + more[best] - E)[None])[0] for E in lost)
        for k in hurt[1:]:
            still = np.flatnonzero(value >= min(least, value.max()))  # of equal ones by rounding
            there = self.inner.each(base - lost[k], more[still])
            value[still] = np.minimum(value[still], there)
        return value
