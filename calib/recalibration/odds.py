"""How much likelier newer data are where some links moved."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from calib.linear.symmetric import eigh
from calib.problem.prior import JointPrior
from calib.recalibration.newer import Force, NewerData, blocks_of

# A link that moved may have gone by as many of CAD's sigmas: to 0.1 m, of a mount known to 0.1 mm.
# Between two of them evidence hardly differs.
FREEDOMS = 2.0 ** np.arange(11)
# Along directions that data tell less well, against how far links may have moved, nothing is told.
TELLS_NOTHING = 1e-6


@dataclass(frozen=True, eq=False)
class MoveOdds:
    """How much likelier data and prior are where some links moved.

    With moves ``N(0, D)`` the pull p of those links is ``N(0, S + A D A)``, where A is how it
    answers to moves and S its spread where nothing moved: see `Force`. The gain is the logarithm of
    the ratio of its densities with moves and without. By how many of CAD's sigmas a link may move
    is half-Cauchy beforehand (Gelman 2006, Bayesian Analysis 1), here per step of a grid of
    logarithms.

    Args:
        force: of the prior, where nothing is let go.
        sigma: (P,) of CAD, in units of the prior's.
        blocks: where each link stands among them.
    """

    force: Force
    sigma: np.ndarray
    blocks: Mapping[str, slice]

    @classmethod
    def of(cls, prior: JointPrior, data: NewerData) -> MoveOdds:
        """Of a prior, and data that it knew nothing of."""
        scale = np.sqrt(np.diag(prior.covariance))
        sigma = np.concatenate([v.sigma for v in prior.held]) / scale
        return cls(Force.of(prior, data), sigma, blocks_of(prior.held))

    def gain(self, freed: Mapping[str, float]) -> float:
        """Of moves of these links, each by about so many of CAD's sigmas."""
        if not freed:
            return 0.0
        rows = np.concatenate([np.r_[self.blocks[name]] for name in freed])
        root = np.concatenate([f * self.sigma[self.blocks[name]] for name, f in freed.items()])
        some, both = np.ix_(rows, rows), np.outer(root, root)
        told, axes = eigh(self.force.answer[some] * both)
        axes, told = axes[:, told > TELLS_NOTHING], told[told > TELLS_NOTHING]
        pull = axes.T @ (root * self.force.pull[rows])
        spread = axes.T @ (self.force.spread[some] * both) @ axes
        moved = spread + np.diag(np.square(told))
        explained = pull @ np.linalg.solve(spread, pull) - pull @ np.linalg.solve(moved, pull)
        size = np.linalg.slogdet(moved)[1] - np.linalg.slogdet(spread)[1]
        expected = sum(np.log(2.0 * f / (1.0 + f * f)) for f in freed.values())
        return float((explained - size) / 2 + expected)

    def freest(self, freed: Mapping[str, float], name: str) -> dict[str, float]:
        """Some links that are let go, and one more, as far as evidence has it."""
        ways = [{**freed, name: float(f)} for f in FREEDOMS]
        return max(ways, key=self.gain)
