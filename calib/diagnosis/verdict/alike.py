"""Columns of the stops that change together: what depends on one may depend on the other."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from scipy import special

from calib.diagnosis.search import NamedEffect
from calib.problem.model import Source

NOTED = 0.05  # level at which an effect would still be seen: by convention
SINCE = "elapsed_s"  # the time, as one of the columns


def columns_alike(step: NamedEffect) -> Iterator[tuple[str, str]]:
    """Columns that a named effect depends on, each with another that goes with it so closely, in a
    straight line, that where the two differ the effect would not be seen."""
    effect, test, sources = step.effect, step.judged, step.before.stand.sources
    if effect.shape_name:  # it jumps, or bends, and is no straight line
        return
    statistic = test.statistic / max(test.inflation, 1.0)
    least, columns = special.chdtri(test.dof, NOTED), _columns(sources)
    for name in (c for c in effect.covariates if c in columns):
        for other in sorted(columns.keys() - {name}):
            alike = np.corrcoef(columns[name], columns[other])[0, 1]
            if statistic * (1.0 - alike**2) < least:
                yield name, other


def _columns(sources: Sequence[Source]) -> dict[str, np.ndarray]:
    """Numbers that every recording has of each of its stops, (K,) over all of these, and that
    differ. Not ``time_s``: effects look at it for the order of the stops alone."""
    first, *others = sources
    names = [n for n in (*first.recording.covariates, SINCE) if np.ndim(first.columns.get(n)) == 1]
    names = [n for n in names if all(np.ndim(s.columns.get(n)) == 1 for s in others)]
    every = {n: np.concatenate([s.columns[n] for s in sources]) for n in names}
    return {n: column for n, column in every.items() if np.ptp(column) > 0.0}
