"""An effect that a search has named."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from calib.diagnosis.score import ScoreTest
from calib.diagnosis.screen import Candidate
from calib.diagnosis.stand import Look
from calib.effects import Effect


@dataclass(frozen=True)
class NamedEffect:
    """An effect that the data confirm.

    Args:
        candidate: as it stood out before, in its best shape.
        before, after: the looks before it was fitted and after.
        judged: its test with clusters jackknifed.
        p_adjusted: as judged, or of the blunders in whose place it stands.
        rivals: candidates that explain as much, and what to tell them apart by.
    """

    candidate: Candidate
    before: Look
    after: Look
    judged: ScoreTest
    p_adjusted: float
    rivals: Sequence[Candidate]

    @property
    def effect(self) -> Effect:
        return self.candidate.effect

    def with_effect(self, effect: Effect | None) -> NamedEffect:
        """With another shape of its effect, if there is one."""
        if effect is None:
            return self
        return replace(self, candidate=replace(self.candidate, effect=effect))
