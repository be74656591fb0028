"""The scatter within a hold: what it says of how the noise grows, as rows of the fit.

A direction measured n times has a variance ``s^2`` about its mean; if its noise is ``sigma``, then
``s^2 / sigma^2 - 1`` scatters about 0 with variance ``2 / (n - 1)``. An effect on the noise,
``log sigma = nominal + growth @ theta``, moves it by ``-2 growth``. Each stop's own level is taken
off, as rows are weighted with the level that the stop shows.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from calib.residuals.robust import robust_scale, tukey_weight
from sensors.holds import spread_known
from sensors.recording import Scan


@dataclass(frozen=True)
class SpreadRows:
    """Whitened, weighted rows of one stop's scatter.

    Args:
        residual: (N,); 0 where a direction was measured once only.
        columns: variable -> (N, P) derivative.
    """

    residual: np.ndarray
    columns: Mapping[str, np.ndarray]

    def heavier(self, times: np.ndarray) -> SpreadRows:
        """The same rows, each as heavy as so many (N,) of its like."""
        root = np.sqrt(times)
        columns = {name: each * root[:, None] for name, each in self.columns.items()}
        return SpreadRows(self.residual * root, columns)


def spread_rows(
    scan: Scan, variance_m2: np.ndarray, usable: np.ndarray, growth: Mapping[str, np.ndarray]
) -> SpreadRows | None:
    """The rows of a stop's scatter; None where it has none, or nothing depends on it.

    Args:
        scan: as read.
        variance_m2: (N,) of one measurement, as the model has it.
        usable: (N,) whether a beam met anything.
        growth: variable -> (N, P) of log sigma, per unit.
    """
    known = spread_known(scan.range_std_m, scan.count, usable)
    if not growth or known.sum() < 2:
        return None
    dof = np.where(known, scan.count - 1.0, 0.0)
    ratio = np.square(np.where(known, scan.range_std_m, 0.0)) / variance_m2
    ratio /= np.median(ratio[known])
    root = np.sqrt(dof / 2.0)
    z = root * (ratio - 1.0)
    weight = np.where(known, tukey_weight(z, robust_scale(z[known])), 0.0)
    share = weight * dof / np.sum(weight * dof)
    root *= np.sqrt(weight)
    columns = {name: -2.0 * root[:, None] * (g - share @ g) for name, g in growth.items()}
    return SpreadRows(root * (ratio - share @ ratio), columns)
