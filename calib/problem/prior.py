"""An earlier estimate as what is known before: one joint prior over many variables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.linalg import cholesky, solve_triangular

from calib.forward import Derivatives, Values
from calib.problem.unknowns import Unknown
from chains import se3


@dataclass(frozen=True)
class JointPrior:
    """Rows that hold several variables to an earlier estimate with its covariance.

    Args:
        held: the variables, in the order of the covariance.
        means: their earlier values.
        covariance: (P, P) of their tangents.
        freed: the variables that may have moved since.
        rests_on: digests of measurements that the earlier estimate rests on; a fit from it does not
            count them again, see `Problem.resting_on`.
        spreads: key of a spread, as of `calib.problem.spread` -> what it was then, and the sigma of
            that: a few stops tell little of how widely stops scatter.
    """

    held: Sequence[Unknown]
    means: Mapping[str, np.ndarray]
    covariance: np.ndarray
    freed: frozenset[str] = frozenset()
    rests_on: frozenset[str] = frozenset()
    spreads: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    name = "prior"
    kind = "prior"

    @property
    def variables(self) -> tuple[str, ...]:
        return tuple(v.name for v in self.held)

    @property
    def rows(self) -> int:
        return len(self.covariance)

    def evaluate(self, values: Values, derivatives: bool) -> tuple[np.ndarray, Derivatives | None]:
        """Whitened differences from the means."""
        moved = [v.difference(self.means[v.name], values[v.name]) for v in self.held]
        root = self._root
        residual = root @ np.concatenate(moved)
        if not derivatives:
            return residual, None
        d, start = {}, 0
        for v, step in zip(self.held, moved, strict=True):
            columns = root[:, start : start + v.dim]
            pose = v.kind == "pose"
            d[v.name] = columns @ se3.right_jacobian_inverse(step) if pose else columns
            start += v.dim
        return residual, d

    @property
    def sigmas(self) -> dict[str, np.ndarray]:
        """Variable -> (n,) how well each of its parameters was known by itself."""
        ends = np.cumsum([v.dim for v in self.held])[:-1]
        each = np.split(np.sqrt(np.diag(self.covariance)), ends)
        return dict(zip(self.variables, each, strict=True))

    def loosened(self, freed: Mapping[str, float]) -> JointPrior:
        """The same, where some variables have since moved by as many times their own sigma."""
        if not freed:
            return self
        moved = [freed.get(v.name, 0.0) * v.sigma for v in self.held]
        covariance = self.covariance + np.diag(np.square(np.concatenate(moved)))
        return replace(self, covariance=covariance, freed=self.freed | freed.keys())

    @cached_property
    def _root(self) -> np.ndarray:
        """R with R.T @ R = inverse(covariance), scaled first: sigmas differ by orders."""
        sigma = np.sqrt(np.diag(self.covariance))
        lower = cholesky(self.covariance / np.outer(sigma, sigma), lower=True)
        return solve_triangular(lower, np.diag(1.0 / sigma), lower=True)
