"""What joint readings say of how widely each joint's scatter.

A joint's error moves a pose as others' may, so its residual shows theirs. The variances of all
joints are estimated together: readings are values that chance draws anew, and each joint is a group
of them. Stops tell hardly anything of each other's readings, so these come in parts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from calib.linear.clusters import Entries, over_all
from calib.linear.system import Linearisation, Values
from calib.problem.spread import Whose
from calib.problem.unknowns import Unknown
from calib.solve.components.checks import Checks
from calib.solve.components.told import Told, ToldApart

READINGS_TOGETHER = 120  # whose covariance is computed at once: of 17 stops of seven joints


@dataclass(frozen=True)
class Readings:
    """What all rows say of joint readings.

    Args:
        whose: (J,) the joints.
        told: of their readings, in sigmas that these have in the fit; each joint is a group.
    """

    whose: Sequence[Whose]
    told: ToldApart

    @classmethod
    def of(
        cls,
        whose: Sequence[Whose],
        some: Sequence[Unknown],
        values: Values,
        linear: Linearisation,
        kept: np.ndarray,
    ) -> Readings:
        """Of those at stops.

        Args:
            whose: the joints.
            some: what encoders misreport at each stop.
            values, linear, kept: as of `squares_beside_bodies`.
        """
        group = {each.what: j for j, each in enumerate(whose)}
        known = [np.flatnonzero(u.is_read & [dof in group for dof in u.dofs]) for u in some]
        pairs = [(u, at) for u, at in zip(some, known, strict=True) if len(at)]
        count = max(1, READINGS_TOGETHER // len(whose))
        parts = [pairs[i : i + count] for i in range(0, len(pairs), count)]
        return cls(whose, ToldApart([_part(p, group, values, linear, kept) for p in parts]))

    @cached_property
    def likeliest(self) -> np.ndarray:
        """(J,) how widely each joint's readings scatter, in sigmas that they have in the fit."""
        return self.told.spread(np.ones(len(self.whose)))

    @cached_property
    def sigma(self) -> np.ndarray:
        """(J,) of that."""
        return self.told.sigma(self.likeliest)

    @property
    def of_each(self) -> dict[Whose, ReadingChecks]:
        """Whose -> what residuals say, at the sigmas of the fit."""
        _, each = self.checks(np.ones(len(self.whose)))
        return {
            whose: ReadingChecks(**vars(found), among=self, number=j)
            for j, (whose, found) in enumerate(zip(self.whose, each, strict=True))
        }

    def checks(self, sd: np.ndarray) -> tuple[Checks, list[Checks]]:
        """What residuals say where readings have these sigmas (J,): of all, and of each joint."""
        every: list[Checks] = []
        each: list[list[Checks]] = [[] for _ in self.whose]
        for part in self.told.parts:
            sigma = sd[part.group]
            values, covariance, _ = part.given(np.square(sd))
            residual = values / sigma
            redundancy = np.eye(len(sigma)) - covariance / np.outer(sigma, sigma)
            every.append(Checks.of(residual, redundancy))
            for j, found in enumerate(each):
                if len(mine := np.flatnonzero(part.group == j)):
                    found.append(Checks.of(residual[mine], redundancy[np.ix_(mine, mine)]))
        return Checks.together(every), [Checks.together(found) for found in each]


def _part(
    pairs: Sequence[tuple[Unknown, np.ndarray]],
    group: dict[str, int],
    values: Values,
    linear: Linearisation,
    kept: np.ndarray,
) -> Told:
    """Of readings at some stops: what is misreported there, and which of it (n,) is asked for.
    Those that the fit gave less weight count as all others: what all else says of them is the
    same."""
    sigma = np.concatenate([u.sigma[at] for u, at in pairs])
    scaled = np.concatenate([values[u.name][at] for u, at in pairs]) / sigma
    columns = np.concatenate([linear.layout.columns([u.name])[at] for u, at in pairs])
    rows = over_all([Entries.one_each(1.0 / sigma, columns)], linear.layout.size)
    of_each = np.array([group[u.dofs[i]] for u, at in pairs for i in at])
    variance = np.concatenate([np.full(len(at), 1.0 / u.weight) for u, at in pairs])
    return Told.fitted(scaled, linear.covariance(rows, kept), variance, of_each)


@dataclass(frozen=True)
class ReadingChecks(Checks):
    """What residuals of one joint's readings say, others' errors being estimated beside them.

    Args:
        among: all readings.
        number: which joint it is.
    """

    among: Readings | None = None
    number: int = 0

    def growth(self) -> float:
        return float(self.among.likeliest[self.number] ** 2 - 1.0)

    def sigma(self, d: float) -> float:
        return float(2.0 * np.sqrt(1.0 + d) * self.among.sigma[self.number])
