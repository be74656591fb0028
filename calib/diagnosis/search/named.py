"""An effect that a search has named."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.diagnosis.candidates import one_more_wave
from calib.diagnosis.score import ScoreTest
from calib.diagnosis.screen import ODDS, Candidate, rivals
from calib.diagnosis.search.parts import likeliest_part
from calib.diagnosis.stand import Look, Stand
from calib.effects import Effect
from calib.solve.fit import Progress

# Log odds from which a rival takes the name: evidence of 150 to 1 is called very strong (Kass and
# Raftery 1995, JASA 90).
FAR_MORE = np.log(150.0)


@dataclass(frozen=True)
class Rival:
    """A candidate that explains about as much as an effect that was named, or more.

    Args:
        candidate: which.
        log_odds: log of how much likelier other rows are expected to be with the one named.
        more: evidence that it has beyond that of the one named.
    """

    candidate: Candidate
    log_odds: float
    more: float

    @property
    def effect(self) -> Effect:
        return self.candidate.effect


def log_odds(one: Stand, other: Stand, more: int, common: float) -> float:
    """Log of how much likelier rows that they are not fitted to are expected to be with one fit
    than with another, as of `Explained.log_score`.

    Args:
        one: a fit.
        other: that of another model, `compared` with it.
        more: how many more parameters that has.
        common: the rows' inflation.
    """
    return (other.estimate.robust_cost - one.estimate.robust_cost) / max(common, 1e-300) + more


def rivals_of(
    look: Look, candidate: Candidate, before: Look, finest: Candidate, scale: float
) -> list[Rival]:
    """The candidates that explain as much as one that is to be named; of each the likeliest part.

    Others are known in shapes of the grid alone. So one that has a shape is compared with the
    effect in its own shape on the grid.

    Args:
        look: at which all of them were missing.
        candidate: the effect, in the best shape of the grid.
        before: the look with the effect in its best shape.
        finest: the effect, in that.
        scale: how much wider than their sigmas allow rows scatter once it is in the model.
    """
    on_grid, at_best = (likeliest_part(*of, scale) for of in ((look, candidate), (before, finest)))
    found = {}
    for other in look.named.candidates:
        own = on_grid if other.effect.shape_name else at_best
        part = likeliest_part(look, other, scale)
        found[other.effect.name] = Rival(
            candidate=other,
            log_odds=own.log_score(scale) - part.log_score(scale),
            more=part.evidence(scale) - own.evidence(scale),
        )
    near = rivals(look.named, finest, lambda other: found[other.effect.name].log_odds)
    return [found[other.effect.name] for other in near]


@dataclass(frozen=True)
class NamedEffect:
    """An effect that the data confirm.

    Args:
        candidate: as it stood out before, in its best shape.
        before, after: the looks before it was fitted and after.
        judged: its test with clusters jackknifed.
        p_adjusted: as judged, or of the blunders in whose place it stands.
        rivals: candidates that explain as much.
    """

    candidate: Candidate
    before: Look
    after: Look
    judged: ScoreTest
    p_adjusted: float
    rivals: Sequence[Rival]

    @property
    def effect(self) -> Effect:
        return self.candidate.effect

    @property
    def likelier(self) -> Candidate | None:
        """A rival that explains far more than the named effect does, where rows scatter as they do
        with that in the model, and is not one more wave."""
        model = self.before.stand.model
        every = (rival for rival in self.rivals if not one_more_wave(rival.effect, model))
        best = max(every, key=lambda rival: rival.more, default=None)
        return best.candidate if best and best.more > FAR_MORE else None

    @property
    def doubted_by(self) -> list[Candidate]:
        """Rivals that are expected to predict other rows far better than the named effect, none of
        them one more wave; best first."""
        model = self.before.stand.model
        every = (rival for rival in self.rivals if not one_more_wave(rival.effect, model))
        better = [rival for rival in every if rival.log_odds < -ODDS]
        return [rival.candidate for rival in sorted(better, key=lambda rival: rival.log_odds)]

    def log_odds(self, other: NamedEffect, progress: Progress) -> float:
        """Log of how much likelier other rows are expected to be with this effect than with another
        in its place."""
        here, there = self.after.stand, other.after.stand
        there = here.compared(there.model, there.estimate.start, progress)
        more = other.candidate.test.dof - self.candidate.test.dof
        return log_odds(here, there, more, max(self.after.named.common, self.judged.inflation))

    def with_effect(self, effect: Effect | None) -> NamedEffect:
        """With another shape of its effect, if there is one."""
        if effect is None:
            return self
        return replace(self, candidate=replace(self.candidate, effect=effect))
