"""What a formula looks like: the residuals over its covariates, the formula, and what is left."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from calib.diagnosis.formulas.table import Projection, Table

BINS = {1: 48, 2: 20}  # of one covariate, and of each of two: a few hundred beams in each
FEWEST = 3  # beams of a bin that is shown


def picture_of(
    table: Table, covariates: Sequence[str], value_m: np.ndarray, fit: Projection
) -> dict[str, Any]:
    """Means in bins of the first two covariates.

    Args:
        table: the beams.
        covariates: of the formula; a third is averaged over.
        value_m: (N,) of the formula.
        fit: the model with all formulas fitted to the table.

    Returns:
        ``covariates``, ``edges`` of the bins of each, and per bin ``measured_mm`` (what the model
        leaves when the formula is taken out again), ``formula_mm`` and ``left_mm``; null where no
        beams are.
    """
    names = list(covariates[:2])
    edges = [_edges(table.covariates[n], BINS[len(names)]) for n in names]
    index = np.zeros(len(table), int)
    for name, ends in zip(names, edges, strict=True):
        at = np.searchsorted(ends[1:-1], table.covariates[name], side="right")
        index = index * (len(ends) - 1) + at
    shape = tuple(len(ends) - 1 for ends in edges)
    weight = fit.weight

    def mean_mm(of_m: np.ndarray) -> list:
        size = int(np.prod(shape))
        total = np.bincount(index, weight * of_m, size)
        count = np.bincount(index, minlength=size)
        mean = 1e3 * total / np.maximum(np.bincount(index, weight, size), 1e-300)
        return np.where(count >= FEWEST, mean, np.nan).reshape(shape).tolist()

    return {
        "covariates": names,
        "edges": [ends.tolist() for ends in edges],
        "measured_mm": mean_mm(fit.left_m + value_m),
        "formula_mm": mean_mm(value_m),
        "left_mm": mean_mm(fit.left_m),
    }


def _edges(values: np.ndarray, bins: int) -> np.ndarray:
    """Edges of even bins; between all values where they are few."""
    distinct = np.unique(values[np.isfinite(values)])
    if len(distinct) <= bins:
        between = (distinct[1:] + distinct[:-1]) / 2
        return np.concatenate([distinct[:1] - 0.5, between, distinct[-1:] + 0.5])
    return np.linspace(distinct[0], distinct[-1], bins + 1)
