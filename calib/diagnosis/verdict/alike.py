"""Columns of the stops that change together: what depends on one may depend on the other."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from calib.diagnosis.search import NamedEffect
from calib.diagnosis.verdict.matters import NOTABLE
from calib.problem.model import Source

CLOCKS = ("time_s", "elapsed_s")


def columns_alike(step: NamedEffect) -> Iterator[tuple[str, str]]:
    """Columns that a named effect depends on, each with another that goes with it so closely, in a
    straight line, that where the two differ the effect would not be seen: it would be less than
    `NOTABLE` of its sigmas."""
    effect, test, sources = step.effect, step.judged, step.before.stand.sources
    if effect.shape_name:  # it jumps, or bends, and is no straight line
        return
    sigmas = np.sqrt(test.statistic / max(test.inflation, 1.0))
    known = _columns(sources)
    for name in (c for c in effect.covariates if c in known):
        for other in sorted(known):
            same = other == name or (other in CLOCKS and name in CLOCKS)
            if not same and sigmas * _apart(known[name], known[other]) < NOTABLE:
                yield name, other


def _columns(sources: Sequence[Source]) -> dict[str, np.ndarray]:
    """Numbers that every recording has of its stops, (K,) over all of these, and that differ."""
    first, *others = sources
    names = [n for n in (*first.recording.covariates, *CLOCKS) if n in first.columns]
    names = [n for n in names if all(n in source.columns for source in others)]
    every = {n: np.concatenate([s.columns[n] for s in sources]) for n in names}
    return {n: column for n, column in every.items() if np.nanstd(column) > 0.0}


def _apart(a: np.ndarray, b: np.ndarray) -> float:
    """Share of one column's size (K,) that is left beside another's straight line."""
    both = np.isfinite(a) & np.isfinite(b)
    if both.sum() < len(a) or len(a) < 3:
        return 1.0
    return float(np.sqrt(max(1.0 - np.corrcoef(a, b)[0, 1] ** 2, 0.0)))
