"""Residuals of stops as large as errors are, where few rows tell of a model's many unknowns.

A model follows part of what rows err by, so residuals scatter less than errors: of 80 poses of two
hands a geometry of 78 unknowns takes 8 %, of 40 poses of a UR10 a fifth. Clusters of residuals
would tell too little of chance then. So the residuals e of each stop become ``(1 - H)^-1/2 e``, H
(m, m) the stop's part of the hat matrix ``A C A^T`` (CR2: Bell and McCaffrey 2002). Where rows err
alone these are as large as errors. Over ten empty worlds of two hands the variance of scores, as
clusters say, is 0.88 to 0.94 of what it is by effect with residuals as they are, and 0.98 to 1.01
with these; over twelve of a UR10 0.73 to 0.87, and 0.89 to 1.04.

Rows of beams are left as they are: a stop has thousands, and a model follows none to speak of.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from calib.linear.cluster_sums import ALONE
from calib.linear.clusters import ClusteredRows
from calib.linear.layout import Layout, positions
from calib.linear.own import OwnRows, priors
from calib.linear.symmetric import eigh
from calib.problem.unknowns import Role

Values = Mapping[str, np.ndarray]
UNTOUCHED_SHARE = 1e-12  # of the largest: a direction that what a stop has alone does not touch


@dataclass(frozen=True)
class Leverage:
    """How well what stops share is known, and so how much of their rows' errors it takes in.

    Args:
        names: of unknowns that stops share; none where stops have beams.
        covariance: (S, S) of these, as fitted.
    """

    names: Sequence[str]
    covariance: np.ndarray

    @classmethod
    def of(cls, information: np.ndarray, layout: Layout, values: Values, widened: float) -> Self:
        """At the solution of a fit.

        Args:
            information: (S, S) of what is kept of the layout, in units of priors' sigmas, with the
                priors of the hardware; these are so many times `widened`.
            layout: of the fit's unknowns and of candidates beside them, which take in nothing.
            values: the state.
        """
        if layout.scanned:
            return cls((), np.zeros((0, 0)))
        names = [name for name in layout.outer() if name not in layout.unbounded]
        at = positions(layout.size, layout.kept)[layout.columns(names)]
        block = information[np.ix_(at, at)]
        ends = dict(zip(names, np.cumsum([layout.unknowns[n].dim for n in names]), strict=True))
        hardware = [name for name in names if layout.unknowns[name].role is Role.CALIBRATION]
        for some, known, _ in priors(layout, hardware, values):
            scaled = known * layout.sigma[layout.columns_of_each(some)][:, None]
            for name, A in zip(some, scaled, strict=True):
                end = ends[name]
                block[end - len(A) : end, end - len(A) : end] += (1.0 - widened**-2.0) * A.T @ A
        unit = layout.sigma[layout.columns(names)]
        C = cho_solve(cho_factor(block), np.eye(len(block))) * np.outer(unit, unit)
        return cls(names, C)

    def grown(
        self, rows: Sequence[ClusteredRows | OwnRows], layout: Layout
    ) -> list[ClusteredRows | OwnRows]:
        """The same rows, whitened and all but those of beams, with the residuals of each stop as
        large as errors are."""
        if not self.names:
            return list(rows)
        stop, e = (np.concatenate([getattr(some, k) for some in rows]) for k in ("stop", "b"))
        ends = np.cumsum([0, *(len(some.b) for some in rows)])
        kept, own = self._derivatives(rows, ends, layout)
        count = np.bincount(stop[stop >= 0], minlength=1)
        order = np.argsort(stop, kind="stable")[(stop < 0).sum() :]
        first = np.cumsum([0, *count])[:-1]
        e = e.copy()
        for size in np.unique(count[count > 0]).tolist():
            at = order[first[count == size][:, None] + np.arange(size)]
            e[at] = _grown(e[at], kept[at], own[at], self.covariance)
        pairs = zip(rows, ends, ends[1:], strict=False)
        return [some.with_residuals(e[start:end]) for some, start, end in pairs]

    def _derivatives(
        self, rows: Sequence[ClusteredRows | OwnRows], ends: np.ndarray, layout: Layout
    ) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives (R, S) of all rows by what stops share, and (R, O) by what each has alone."""
        shared = positions(layout.size, layout.columns(self.names))
        alone = np.full(layout.size, -1)
        for columns in layout.own.values():
            alone[columns] = np.arange(len(columns))
        kept, own = (np.zeros((ends[-1], int(at.max(initial=-1)) + 1)) for at in (shared, alone))
        for some, start, end in zip(rows, ends, ends[1:], strict=False):
            if isinstance(some, OwnRows):
                A, columns = some.shared.reshape(end - start, -1), some.shared_columns
                at = np.arange(start, end).reshape(len(some.stops), -1)[:, :, None]
                own[at, alone[some.own_columns][:, None]] = some.own
            else:
                A, columns = some.A, some.columns
            to = shared[columns]
            if (to >= 0).any():
                kept[start:end, to[to >= 0]] = A[:, to >= 0]
        return kept, own


def _grown(e: np.ndarray, kept: np.ndarray, own: np.ndarray, C: np.ndarray) -> np.ndarray:
    """Residuals (K, m) of stops as large as errors are.

    Args:
        e: as they are.
        kept, own: (K, m, .) derivatives by what stops share, and by what each has alone, which
            takes in all that it can.
        C: covariance of what stops share.
    """
    if own.shape[2]:
        axes, size, _ = np.linalg.svd(own, full_matrices=False)
        axes = axes * (size > UNTOUCHED_SHARE * size[:, :1])[:, None]
        kept = kept - axes @ (axes.mT @ kept)
    values, axes = eigh(kept @ C @ kept.mT)
    root = 1.0 / np.sqrt(1.0 - np.clip(values, 0.0, ALONE))
    return np.matvec(axes, root * np.matvec(axes.mT, e))
