"""How widely values scatter that chance draws anew: variance components, by REML.

Values ``u ~ N(0, D)`` of the members of some groups, D diagonal with one variance for each group,
are unknowns of the graph. All rows but their priors say of them, everything else being estimated,
``g = M u + e`` with ``e ~ N(0, M)``: score and information. So ``g ~ N(0, M + M D M)``, and the
variances of greatest likelihood are those of restricted maximum likelihood (Patterson and Thompson
1971). With C the covariance of u as fitted, ``M = C^-1 - D^-1`` and ``g = C^-1 u``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from calib.problem.problem import Problem
from calib.problem.spread import by_chance, sigmas, widening
from calib.problem.unknowns import Unknown
from calib.residuals.tracker import BodiesTogether
from calib.solve.estimate import Estimate

ROUNDS = 500  # of the fixed point; from ten times too large or small 40 were measured
STEADY = 1e-6  # relative change of a variance that ends them
LEAST = 1e-3  # of the sd that a group starts from: what is smaller counts as none
MOST = 1e6  # times that: far from an optimum scores are of any size, and squares overflow
SEEN = 1e-9  # of the largest information, below which a direction of values is not seen


@dataclass(frozen=True)
class Told:
    """What all rows but their priors say of values by chance (Q,).

    Args:
        score: (Q,) at zero, all else being estimated there.
        information: (Q, Q), all else being estimated.
        group: (Q,) which group each belongs to, from 0.
    """

    score: np.ndarray
    information: np.ndarray
    group: np.ndarray

    @classmethod
    def of(
        cls, values: np.ndarray, covariance: np.ndarray, variance: np.ndarray, group: np.ndarray
    ) -> Told:
        """From the values (Q,) as fitted, their covariance (Q, Q) and the variances (Q,) that they
        were held by; the group (Q,) of each is a number from 0."""
        root = np.sqrt(variance)
        scaled = np.linalg.inv(covariance / np.outer(root, root))
        information = (scaled - np.eye(len(values))) / np.outer(root, root)
        score = (scaled @ (values / root)) / root
        return cls(score, (information + information.T) / 2, group)

    def spread(self, start: np.ndarray) -> np.ndarray:
        """The sd (G,) of each group.

        Args:
            start: (G,) sd to start from.
        """
        count = np.bincount(self.group, minlength=len(start))
        least, most = np.square(LEAST * start), np.square(MOST * start)
        variance = np.square(start)
        for _ in range(ROUNDS):
            values, covariance = self._given(variance)
            # A value known no better than by its prior tells nothing of that (MacKay 1992).
            told = count - np.bincount(self.group, np.diag(covariance)) / variance
            new = np.bincount(self.group, np.square(values)) / np.maximum(told, 1e-12)
            new = np.where(told > 1e-9, np.clip(new, least, most), variance)
            steady = np.all(np.abs(new - variance) < STEADY * variance)
            variance = new
            if steady:
                break
        return np.sqrt(variance)

    def _given(self, variance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The values (Q,) and their covariance, given the variances of the groups."""
        root = np.sqrt(variance)[self.group]
        inner = np.eye(len(root)) + root[:, None] * self.information * root
        covariance = root[:, None] * cho_solve(cho_factor(inner), np.eye(len(root))) * root
        return covariance @ self.score, covariance

    def sigma(self, sd: np.ndarray) -> np.ndarray:
        """Of the sds (G,), from the expected information of the variances: ``tr(P E_i P E_j) / 2``
        with ``P = M - M C M``."""
        _, covariance = self._given(np.square(sd))
        P = self.information - self.information @ covariance @ self.information
        sums = np.zeros((len(sd), len(sd)))
        np.add.at(sums, (self.group[:, None], self.group), np.square(P) / 2)
        scale = np.sqrt(np.maximum(np.diag(sums), 1e-300))
        inverse = np.linalg.pinv(sums / np.outer(scale, scale)) / np.outer(scale, scale)
        return np.sqrt(np.maximum(np.diag(inverse), 0.0)) / (2 * sd)


def told(some: Sequence[Unknown], values: Mapping[str, np.ndarray], covariance: np.ndarray) -> Told:
    """What all rows say of some unknowns by chance; `covariance` is their joint one, as fitted."""
    return Told.of(
        np.concatenate([values[u.name] for u in some]),
        covariance,
        np.square(np.concatenate([u.sigma for u in some])),
        np.repeat(np.arange(len(some)), [u.dim for u in some]),
    )


Sums = Mapping[tuple[str, str], tuple[float, float]]


def squares(estimate: Estimate) -> Sums:
    """Whose rows and unit -> the sum of squares of these rows, whitened, and of their redundancies:
    both are about equal where sigmas are right (Foerstner 1979)."""
    found: dict[tuple[str, str], list[tuple[float, float]]] = {}
    together = BodiesTogether.of(estimate.problem.bodies)
    blocks = [block for each in together for block in each.blocks]
    rows = [some for each in together for some in each.evaluate(estimate.values)]
    variances = estimate.variances([d for _, d in rows])
    for block, (residual, _), seen in zip(blocks, rows, variances, strict=True):
        count = len(block.measured)
        weight = np.ones(count) if block.weight is None else block.weight
        left = np.repeat(weight, len(residual) // count) - seen
        for k, unit in enumerate(("m",) if block.is_point else ("rad", "m")):
            mine = [each.reshape(count, -1, 3)[:, k] for each in (residual, left)]
            sums = float(np.square(mine[0]).sum()), float(mine[1].sum())
            found.setdefault((block.body, unit), []).append(sums)
    cells = squares_of_cells(estimate.problem, estimate.values, estimate.variances)
    return cells | {k: tuple(np.sum(sums, axis=0).tolist()) for k, sums in found.items()}


def squares_of_cells(
    problem: Problem,
    values: Mapping[str, np.ndarray],
    variances: Callable[[Sequence[Mapping[str, np.ndarray]]], list[np.ndarray]],
) -> dict[tuple[str, str], tuple[float, float]]:
    """The same of what parts of surfaces stand off, by their kind.

    Args:
        problem: with its cells.
        values: as fitted.
        variances: as `Estimate.variances` has them.
    """
    out: dict[tuple[str, str], tuple[float, float]] = {}
    each = variances([{name: np.eye(problem.variables[name].dim)} for name in problem.cells])
    for (name, cells), seen in zip(problem.cells.items(), each, strict=True):
        sigma = problem.variables[name].sigma
        total, left = out.get((cells.kind, "m"), (0.0, 0.0))
        total += float(np.square(values[name] / sigma).sum())
        out[cells.kind, "m"] = total, left + float(np.sum(1.0 - seen / np.square(sigma)))
    return out


def wider(problem: Problem, sums: Sums) -> dict[str, float]:
    """Key of a spread -> how widely rows scatter beyond their first sigma, as they have it."""
    out, known = {}, sigmas(problem)
    for key, whose in widening(problem).items():
        (total, redundancy), (sigma, beyond) = sums.get(whose, (0.0, 0.0)), known[whose]
        factor = total / redundancy if redundancy > 0 else 0.0
        out[key] = float(np.sqrt(max(factor * sigma**2 - (sigma**2 - beyond**2), 0.0)))
    return out


def spreads(estimate: Estimate) -> dict[str, tuple[float, float]]:
    """Key of a spread, an unknown by chance or what widens rows -> that spread, and its sigma."""
    some, out = by_chance(estimate.problem), {}
    if some:
        names = [u.name for u in some]
        found = told(some, estimate.values, estimate.covariance_of(names))
        sd = np.array([u.sigma[0] for u in some])
        pairs = zip(sd.tolist(), found.sigma(sd).tolist(), strict=True)
        out |= dict(zip(names, pairs, strict=True))
    if keys := widening(estimate.problem):
        sums, known = squares(estimate), sigmas(estimate.problem)
        for key, whose in keys.items():
            sigma, beyond = known[whose]
            out[key] = beyond, sigma_beyond(beyond, sigma**2, sums[whose][1])
    return out


def sigma_beyond(sd: float, variance: float, redundancy: float) -> float:
    """Sigma of a spread beyond a known sigma, from a variance that rows of some redundancy tell."""
    of_variance = variance * np.sqrt(2.0 / max(redundancy, 1.0))
    return float(np.sqrt(sd**2 + of_variance) - sd)
