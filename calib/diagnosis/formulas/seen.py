"""Where an empirical effect was observed, and whether it is used beyond that."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from calib.diagnosis.suggest import span
from calib.effects import Effect

# Of what lies between the least and largest value: a formula is judged in bins of that width; see
# `calib.diagnosis.formulas.picture.PICTURE_BINS`.
BEYOND_SEEN = 0.05


class ColumnRanges:
    """From where to where the columns go that effects depend on, batch by batch.

    Args:
        effects: those with `Effect.seen` are asked about.

    `ends` are the least and the largest value of each column so far.
    """

    def __init__(self, effects: Iterable[Effect]) -> None:
        self._effects = [effect for effect in effects if effect.seen]
        self.ends: dict[str, tuple[float, float]] = {}

    def look(self, columns: Mapping[str, Any], rows: np.ndarray | slice = slice(None)) -> None:
        """Take in one batch.

        Args:
            columns: name -> (N,), or (1,) where one value holds for all, or a function that gives
                it; those of no effect are left alone.
            rows: which rows count.
        """
        names = dict.fromkeys(name for effect in self._effects for name in effect.seen)
        for name in filter(columns.__contains__, names):
            values = np.asarray(columns[name]() if callable(columns[name]) else columns[name])
            values = values[rows] if len(values) > 1 else values
            values = values[np.isfinite(values)]
            if len(values):
                self._include(name, float(values.min()), float(values.max()))

    def fresh(self) -> ColumnRanges:
        """The same that has seen nothing."""
        return ColumnRanges(self._effects)

    def include(self, ends: Mapping[str, tuple[float, float]]) -> None:
        """Take in the ends of what another was shown."""
        for name, each in ends.items():
            self._include(name, *each)

    def _include(self, name: str, low: float, high: float) -> None:
        ends = self.ends.get(name, (np.inf, -np.inf))
        self.ends[name] = min(ends[0], low), max(ends[1], high)

    def sentences(self) -> list[str]:
        """A warning for each effect that is used beyond where it was seen."""
        return list(filter(None, map(self._sentence, self._effects)))

    def _sentence(self, effect: Effect) -> str:
        beyond = []
        for name, (low, high) in effect.seen.items():
            here = self.ends.get(name, (low, high))
            slack = BEYOND_SEEN * (high - low)
            if here[0] < low - slack or here[1] > high + slack:
                beyond.append(f"{span(name, low, high)}, and here goes {_ends_of(name, *here)}")
        if not beyond:
            return ""
        return (
            f"{effect.name} is empirical: it was observed at "
            f"{' and at '.join(beyond)}; beyond that it extrapolates."
        )


def _ends_of(name: str, low: float, high: float) -> str:
    """The ends, without the name."""
    return "from" + span(name, low, high).partition(" from")[2]
