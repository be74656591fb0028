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

COMMON_NAMES, COMMON_BY = "common_names", "common_by"  # names of arrays in a file


class CommonErrors(NamedTuple):
    """How an estimate goes with errors of what was measured once, and may be measured once for
    another run, too: a mesh, or the scan of a sphere. Each is the same in both.

    Args:
        names: (M,) what errs, told apart by what was measured: a part of a mesh, or a coordinate of
            a sphere or a marker.
        by: (M, P) by how much each parameter is off for one sigma of each, in its unit.
    """

    names: np.ndarray
    by: np.ndarray

    @classmethod
    def none(cls, parameters: int) -> Self:
        """Of an estimate of so many parameters that goes with none."""
        return cls(np.zeros(0, "U1"), np.zeros((0, parameters)))

    @classmethod
    def read(cls, arrays: Mapping[str, np.ndarray], parameters: int) -> Self | None:
        """From the arrays of a file that has so many parameters; None where an earlier version
        wrote it.

        Raises:
            ValueError: they do not fit each other.
        """
        if not {COMMON_NAMES, COMMON_BY} <= arrays.keys():
            return None
        names, by = arrays[COMMON_NAMES], arrays[COMMON_BY]
        if names.dtype.kind != "S" or by.dtype.kind != "f" or by.shape != (len(names), parameters):
            raise ValueError(f"{COMMON_NAMES} and {COMMON_BY} do not fit each other")
        return cls(np.char.decode(names), by.astype(float))

    @property
    def arrays(self) -> dict[str, np.ndarray]:
        """As a file has them; float32, as a millionth of an error tells enough."""
        return {COMMON_NAMES: np.char.encode(self.names), COMMON_BY: self.by.astype(np.float32)}

    def at(self, parameters: np.ndarray) -> CommonErrors:
        """The same of some of the parameters (n,)."""
        return self._replace(by=self.by[:, parameters])

    @staticmethod
    def together(some: Sequence[CommonErrors], parameters: int) -> tuple[np.ndarray, CommonErrors]:
        """Of errors that reach an estimate in several ways, by the rows of each: what that adds to
        its covariance (P, P), and how it goes with each of them by all ways.

        With a_i by how much it is off for one sigma of an error by way i, ``(sum_i a_i) (sum_i
        a_i)^T - sum_i a_i a_i^T``: what a covariance lacks that takes them for different errors.
        """
        some = [each for each in some if len(each.names)]
        if not some:
            return np.zeros(2 * (parameters,)), CommonErrors.none(parameters)
        names, at = np.unique(np.concatenate([each.names for each in some]), return_inverse=True)
        ends = np.cumsum([len(each.names) for each in some])[:-1]
        by, alone = np.zeros((len(names), parameters)), np.zeros(2 * (parameters,))
        several = np.bincount(at) > 1
        for k, each in zip(np.split(at, ends), some, strict=True):
            by[k] += each.by
            alone += each.by[several[k]].T @ each.by[several[k]]
        return by[several].T @ by[several] - alone, CommonErrors(names, by)


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
        common: how the means go with errors that the newer data may share; None where the earlier
            run did not write that down.
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

    def off_by(self, rows: np.ndarray) -> CommonErrors:
        """How an estimate from this prior goes with the errors that its means go with.

        Args:
            rows: (P, Q) the rows of the prior, times the covariance of the Q parameters of that
                estimate.
        """
        if self.common is None:
            return CommonErrors.none(rows.shape[1])
        return self.common._replace(by=self.common.by @ self._root.T @ rows)

    @cached_property
    def _root(self) -> np.ndarray:
        """R with R.T @ R = inverse(covariance), scaled first: sigmas differ by orders."""
        sigma = np.sqrt(np.diag(self.covariance))
        lower = cholesky(self.covariance / np.outer(sigma, sigma), lower=True)
        return solve_triangular(lower, np.diag(1.0 / sigma), lower=True)
