"""What a formula looks like: the residuals over its covariates, the formula, and what is left."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from calib.diagnosis.formulas.table import BeamTable, Projection

PICTURE_BINS = {1: 48, 2: 20}  # of one covariate, and of each of two: a few hundred beams in each
FEWEST_BEAMS = 3  # beams of a bin that is shown


def picture_of(
    table: BeamTable,
    covariates: Sequence[str],
    value: np.ndarray,
    fit: Projection,
    unit: str = "mm",
) -> dict[str, Any]:
    """Means in bins of the first two covariates.

    Args:
        table: the beams.
        covariates: of the formula; a third is averaged over.
        value: (N,) of the formula, m or rad.
        fit: the model with all formulas fitted to the table.
        unit: in which the picture is: mm, or mrad of a joint.

    Returns:
        ``unit``, ``covariates``, ``edges`` of the bins of each, and per bin ``measured`` (what the
        model leaves when the formula is taken out again), ``formula`` and ``left``; null where no
        beams are.
    """
    names = list(covariates[:2])
    edges = [_edges(table.covariates[n], PICTURE_BINS[len(names)]) for n in names]
    index = np.zeros(len(table), int)
    for name, ends in zip(names, edges, strict=True):
        at = np.searchsorted(ends[1:-1], table.covariates[name], side="right")
        index = index * (len(ends) - 1) + at
    shape = tuple(len(ends) - 1 for ends in edges)
    weight = fit.weight

    def mean(of: np.ndarray) -> list:
        size = int(np.prod(shape))
        total = np.bincount(index, weight * of, size)
        count = np.bincount(index, minlength=size)
        means = 1e3 * total / np.maximum(np.bincount(index, weight, size), 1e-300)
        return np.where(count >= FEWEST_BEAMS, means, np.nan).reshape(shape).tolist()

    return {
        "unit": unit,
        "covariates": names,
        "edges": [ends.tolist() for ends in edges],
        "measured": mean(fit.left_m + value),
        "formula": mean(value),
        "left": mean(fit.left_m),
    }


def _edges(values: np.ndarray, bins: int) -> np.ndarray:
    """Edges of even bins; between all values where they are few."""
    distinct = np.unique(values[np.isfinite(values)])
    if len(distinct) <= bins:
        between = (distinct[1:] + distinct[:-1]) / 2
        return np.concatenate([distinct[:1] - 0.5, between, distinct[-1:] + 0.5])
    return np.linspace(distinct[0], distinct[-1], bins + 1)
