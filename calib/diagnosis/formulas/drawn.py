"""Beams of one stop, drawn for a table to try formulas on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array

from calib.diagnosis.formulas.factors import covariates_of
from calib.linear.clusters import Entries, over_all
from calib.linear.rows import TWIST, StopRows


@dataclass(frozen=True, kw_only=True)
class DrawnBeams:
    """Beams of one stop, and nothing of its others.

    Args:
        stop: its number.
        columns: covariates (n,) of these; (1,) of the stop.
        residual_m, sigma_m, twists, chain: as of `BeamTable`.
        met: (n,) which of what any beam of the stop meets each does.
    """

    stop: int
    columns: Mapping[str, np.ndarray]
    residual_m: np.ndarray
    sigma_m: np.ndarray
    twists: csr_array
    chain: csr_array
    met: np.ndarray

    @classmethod
    def of(
        cls, share: float, begin: int, size: int, rows: StopRows, met: np.ndarray, count: int
    ) -> DrawnBeams:
        """A share of a stop's beams; so many columns of unknowns begin after the twists'. The last
        arguments are those of `each_stop`."""
        usable = np.flatnonzero(rows.rows.usable & np.isfinite(rows.rows.residual_m))
        drawn = np.random.default_rng(rows.stop).choice(usable, round(share * len(usable)), False)
        picked, columns = np.sort(drawn), {}
        for name, values in covariates_of(rows.rows.view):
            columns[name] = (values[picked] if len(values) > 1 else values).astype(float)
        return cls(
            stop=rows.stop,
            columns=columns,
            residual_m=rows.rows.residual_m[picked],
            sigma_m=rows.rows.sigma_m[picked],
            twists=_twists(rows, picked, TWIST * rows.stop, begin, begin + size),
            chain=over_all([Entries.of(rows.chain, rows.chain_columns)], size),
            met=met[picked],
        )

    def column(self, name: str) -> np.ndarray:
        """A covariate (n,)."""
        return np.broadcast_to(self.columns[name], len(self.residual_m))


def _twists(rows: StopRows, picked: np.ndarray, first: int, begin: int, size: int) -> csr_array:
    """Derivative (n, size) of the residuals of some beams of a scan, whose twist has the columns
    from `first`; those of unknowns begin at `begin`."""
    wide = rows.dense.shape[1] - TWIST - 1
    dense = np.hstack([rows.dense[picked, :TWIST], rows.dense[picked, TWIST + 1 :]])
    own = np.concatenate([np.arange(first, first + TWIST), begin + rows.columns[:wide]])
    found = rows.index[picked]
    met = found >= 0
    sparse = begin + rows.columns[wide:][np.where(met, found, 0)] if rows.sparse else found
    at = np.hstack([np.broadcast_to(own, dense.shape), sparse])
    values = np.hstack([dense, np.where(met, rows.value[picked], 0.0)])
    ends = np.arange(len(picked) + 1) * at.shape[1]
    out = csr_array((values.ravel(), at.ravel(), ends), (len(picked), size))
    out.eliminate_zeros()
    return out
