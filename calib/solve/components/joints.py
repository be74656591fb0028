"""What joint readings say of how widely each joint's scatter.

A joint's error moves a pose as others' may, so its residual shows theirs. The variances of all
joints are estimated together: readings are values that chance draws anew, and each joint is a group
of them. Stops tell hardly anything of each other's readings, so these come in parts.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from calib.linear.clusters import Entries, over_all
from calib.linear.system import Linearisation, Values
from calib.problem.spread import Whose
from calib.problem.unknowns import Unknown, is_read
from calib.solve.components.checks import Checks
from calib.solve.components.told import Told, ToldApart, slices

READINGS_TOGETHER = 120  # whose covariance is computed at once: of 17 stops of seven joints
# Stops, from which each tells its own alone. What they tell of each other goes as one over their
# number: with 300 poses of an iiwa, spreads change by less than 0.01 of theirs, and with 60 by up
# to 0.1.
MANY_STOPS = 200


@dataclass(frozen=True)
class Readings:
    """What all rows say of joint readings.

    Args:
        whose: (J,) the joints, each of which is read somewhere.
        told: of their readings, in sigmas that these have in the fit; each joint is a group.
        first: (J,) what their sigmas were at first, in the same: they scatter by no less.
    """

    whose: Sequence[Whose]
    told: ToldApart
    first: np.ndarray

    @classmethod
    def of(
        cls,
        sigmas: Mapping[Whose, tuple[float, float]],
        some: Sequence[Unknown],
        values: Values,
        linear: Linearisation,
        kept: np.ndarray,
    ) -> Readings | None:
        """Of those at stops; None where no joint is read at any of them.

        Args:
            sigmas: the joints, and of each its sigma, and how much of that it had not at first.
            some: what encoders misreport at each stop.
            values, linear, kept: as of `squares_beside_bodies`.
        """
        whose = [w for w in sigmas if any(u.reads(w.what, w.unit).any() for u in some)]
        if not whose:
            return None
        group = {each: j for j, each in enumerate(whose)}
        numbered = [(u, _numbers(u, group)) for u in some]
        pairs = [(u, number) for u, number in numbered if (number >= 0).any()]
        count = max(1, READINGS_TOGETHER // len(whose))
        parts = [pairs[i : i + count] for i in range(0, len(pairs), count)]
        sigma, beyond = np.array([sigmas[each] for each in whose]).T
        found = [_part(part, values, linear, kept, len(pairs) > MANY_STOPS) for part in parts]
        told = ToldApart.at_stops([each for part in found for each in part])
        return cls(whose, told, np.sqrt(sigma**2 - beyond**2) / sigma)

    @cached_property
    def likeliest(self) -> np.ndarray:
        """(J,) how widely each joint's readings scatter, in sigmas that they have in the fit."""
        return self.told.spread(self.first, least=self.first)

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
                    alone = redundancy[..., mine[:, None], mine]
                    found.append(Checks.of(residual[..., mine], alone))
        return Checks.together(every), [Checks.together(found) for found in each]


def _numbers(unknown: Unknown, group: Mapping[Whose, int]) -> np.ndarray:
    """Which joint each reading (dim,) is of; -1 of those that are not asked for, or not read."""
    each = zip(unknown.dofs, unknown.units, strict=True)
    number = np.array([group.get(Whose("joints", *of), -1) for of in each], int)
    return np.where(is_read(unknown.sigma), number, -1)


def _part(
    numbered: Sequence[tuple[Unknown, np.ndarray]],
    values: Values,
    linear: Linearisation,
    kept: np.ndarray,
    apart: bool,
) -> list[Told]:
    """Of readings at some stops: what is misreported there, and which joint (dim,) each is of; of
    each stop `apart`, or of all together. Those that the fit gave less weight count as all others:
    what all else says of them is the same."""
    pairs = [(u, np.flatnonzero(number >= 0)) for u, number in numbered]
    sigma = np.concatenate([u.sigma[at] for u, at in pairs])
    scaled = np.concatenate([values[u.name][at] for u, at in pairs]) / sigma
    columns = np.concatenate([linear.layout.columns([u.name])[at] for u, at in pairs])
    rows = over_all([Entries.one_each(1.0 / sigma, columns)], linear.layout.size)
    of_each = np.concatenate([number[number >= 0] for _, number in numbered])
    variance = np.concatenate([np.full(len(at), 1.0 / u.weight) for u, at in pairs])
    covariance = linear.covariance(rows, kept)
    some = slices(len(at) for _, at in pairs) if apart else [slice(0, len(sigma))]
    return [Told.fitted(scaled[s], covariance[s, s], variance[s], of_each[s]) for s in some]


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
        sd = self.among.likeliest.copy()
        sd[self.number] = np.sqrt(1.0 + d)
        return float(2.0 * sd[self.number] * self.among.told.sigma(sd)[self.number])
