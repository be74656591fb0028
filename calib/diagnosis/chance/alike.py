"""Whether the readings of all joints scatter alike."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import special

from calib.blunders.chance import LEVELS
from calib.linear.clusters import Entries, over_all
from calib.problem.spread import Whose, read, sigmas
from calib.problem.unknowns import Unknown
from calib.residuals.groups import JOINTS
from calib.residuals.store import drawn_evenly
from calib.solve.components import Told, sigma_beyond
from calib.solve.estimate import Estimate

ALPHA_UNLIKE = LEVELS["effect on the scatter"]
UNITS = {"rad": "mrad", "m": "mm"}  # in which thousandths are told
MOST_READINGS = 600  # that are asked: their spreads are known to 10 % of them, of six joints
STANDS_APART = 2.0  # sigmas by which a joint scatters more than all do together, to be told by name


@dataclass(frozen=True)
class Unlike:
    """Joints of which one scatters more than another.

    Args:
        joints: (J,) names.
        unit: "rad" or "m".
        sd, sigma: (J,) how widely the readings of each scatter beyond their first sigma, and the
            sigma of that.
        apart: (J,) bool, which scatter more than all do together.
    """

    joints: Sequence[str]
    unit: str
    sd: np.ndarray
    sigma: np.ndarray
    apart: np.ndarray

    @property
    def sentence(self) -> str:
        """Which scatter most, and the others."""
        unit, most = UNITS[self.unit], self.apart | (self.sd == self.sd.max())
        which = zip(self.joints, self.sd, self.sigma, most, strict=True)
        names = [
            f"{j} by {1e3 * sd:.2f} ± {1e3 * of:.2f} {unit}" for j, sd, of, far in which if far
        ]
        others = f", no other by more than {1e3 * self.sd[~most].max():.2f} {unit}"
        return f"Not all joints scatter alike: {', '.join(names)}{others if any(~most) else ''}."

    def document(self) -> list[dict[str, Any]]:
        """As diagnosis.json has it."""
        each = zip(self.joints, self.sd.tolist(), self.sigma.tolist(), strict=True)
        return [{"of": j, "sd": sd, "sigma": of, "unit": self.unit} for j, sd, of in each]


def unlike(estimate: Estimate, unit: str) -> Unlike | None:
    """How differently joints scatter; None where they may all scatter alike.

    A spread of each joint's readings, and one of all, both of greatest restricted likelihood, are
    compared by its ratio, chi-square with a degree of freedom less than there are joints.

    Args:
        estimate: a fit in whose model joint readings scatter.
        unit: of the joints that are asked, "rad" or "m".
    """
    some = [u for u in read(estimate.problem, unit) if u.weight == 1.0]
    joints = list(dict.fromkeys(u.dofs[i] for u in some for i in u.read(unit)))
    if len(joints) < 2:
        return None
    told, sigma = _told(_drawn(some, len(joints)), joints, unit, estimate)
    together = Told(told.score, told.information, np.zeros_like(told.group))
    each, all_ = told.spread(np.ones(len(joints))), together.spread(np.ones(1))
    ratio = told.statistic(each) - together.statistic(all_)
    if special.chdtrc(len(joints) - 1, ratio) >= ALPHA_UNLIKE:
        return None
    whole, beyond = sigmas(estimate.problem)[Whose("joints", JOINTS, unit)]
    first = np.sqrt(whole**2 - beyond**2)
    of_each = told.sigma(each)
    sd = np.sqrt(np.maximum(np.square(sigma * each) - first**2, 0.0))
    of_variance = 2.0 * each * of_each * sigma**2
    return Unlike(
        joints=joints,
        unit=unit,
        sd=sd,
        sigma=np.array([sigma_beyond(*pair) for pair in zip(sd, of_variance, strict=True)]),
        apart=each - all_[0] > STANDS_APART * of_each,
    )


def _drawn(some: Sequence[Unknown], joints: int) -> list[Unknown]:
    """Stops that stand for all, drawn evenly."""
    which = drawn_evenly(len(some), max(1, MOST_READINGS // joints), seed=0)
    return [some[i] for i in which]


def _told(
    some: Sequence[Unknown], joints: Sequence[str], unit: str, estimate: Estimate
) -> tuple[Told, float]:
    """What all rows say of readings, in sigmas that these have in the fit, each joint's a group;
    and that sigma."""
    linear, at = estimate.linear, [u.read(unit) for u in some]
    pairs = list(zip(some, at, strict=True))
    sigma = np.concatenate([u.sigma[i] for u, i in pairs])
    values = np.concatenate([estimate.values[u.name][i] for u, i in pairs]) / sigma
    columns = np.concatenate([linear.layout.columns([u.name])[i] for u, i in pairs])
    rows = over_all([Entries.one_each(1.0 / sigma, columns)], linear.layout.size)
    covariance = linear.covariance(rows, estimate.kept)
    group = np.array([joints.index(u.dofs[i]) for u, mine in pairs for i in mine])
    return Told.fitted(values, covariance, np.ones(len(values)), group), float(sigma[0])
