"""An earlier estimate as what is known before: one joint prior over many variables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple, Self

import numpy as np
from scipy.linalg import cholesky, solve_triangular

from calib.forward import Derivatives, Values
from calib.problem.unknowns import Unknown
from chains import se3

COMMON_OF, COMMON_BY = "common_of", "common_by"  # names of arrays in a file


class CommonErrors(NamedTuple):
    """How an estimate goes with errors that another run may share, as it rests on the same mesh, or
    on the same scan of the spheres: each is the same in both, so what they make does not average
    out.

    Args:
        of: (M,) what errs: a part of a mesh, or an axis of a sphere, by what was measured.
        by: (M, P) by how much each parameter is off for a unit of each, in their units.
    """

    of: np.ndarray
    by: np.ndarray

    @classmethod
    def none(cls, parameters: int) -> Self:
        """Of an estimate of so many parameters that goes with none."""
        return cls(np.zeros(0, "U1"), np.zeros((0, parameters)))

    @classmethod
    def read(cls, arrays: Mapping[str, np.ndarray]) -> Self | None:
        """From the arrays of a file; None where an earlier version wrote it."""
        if not {COMMON_OF, COMMON_BY} <= arrays.keys():
            return None
        return cls(np.char.decode(arrays[COMMON_OF]), arrays[COMMON_BY].astype(float))

    @property
    def arrays(self) -> dict[str, np.ndarray]:
        """As a file has them."""
        return {COMMON_OF: np.char.encode(self.of), COMMON_BY: self.by.astype(np.float32)}

    def at(self, parameters: np.ndarray) -> CommonErrors:
        """The same of some of the parameters (n,)."""
        return self._replace(by=self.by[:, parameters])


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
        common: how the means go with errors that the newer data may share.
    """

    held: Sequence[Unknown]
    means: Mapping[str, np.ndarray]
    covariance: np.ndarray
    freed: frozenset[str] = frozenset()
    rests_on: frozenset[str] = frozenset()
    spreads: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    common: CommonErrors | None = None

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

    def off_by(self, rows: np.ndarray) -> CommonErrors | None:
        """How an estimate from this prior goes with the errors that its means go with.

        Args:
            rows: (P, Q) the rows of the prior, times the covariance of the Q parameters of that
                estimate.
        """
        by = self.common and self.common.by @ self._root.T @ rows
        return self.common and self.common._replace(by=by)

    @cached_property
    def _root(self) -> np.ndarray:
        """R with R.T @ R = inverse(covariance), scaled first: sigmas differ by orders."""
        sigma = np.sqrt(np.diag(self.covariance))
        lower = cholesky(self.covariance / np.outer(sigma, sigma), lower=True)
        return solve_triangular(lower, np.diag(1.0 / sigma), lower=True)
