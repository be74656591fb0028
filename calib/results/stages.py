"""Which stage of what takes long is under way, of how many, and how much time is left."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

from calib.solve.fit import Progress


@dataclass(frozen=True)
class Stage:
    """One of the stages that something goes through in their order.

    Args:
        title: what is done.
        begins: how the texts of progress within it begin.
        share: of the time of all; of the preset `default`, on two cores.
    """

    title: str
    begins: tuple[str, ...]
    share: float


FIT = (
    Stage("estimate", ("looking for", "pass "), 0.62),
    Stage("sigmas", ("errors in common of rows",), 0.11),
    Stage("held-out error", ("without ",), 0.19),
    Stage("residuals", ("residuals of beams", "writing residuals"), 0.08),
)
DIAGNOSE = (
    Stage("tests", ("testing", "looking for", "fitting", "pass "), 0.67),
    Stage("rejected beams", ("looking at what was rejected",), 0.02),
    Stage("held-out error", ("without ",), 0.05),
    Stage("formulas", ("reading residuals", "searching covariates"), 0.26),
)
PLAN = (
    Stage("what is known", ("looking for", "pass "), 0.08),
    Stage("candidates", ("looking at candidates",), 0.75),
    Stage("choice", ("choosing", "how many are enough"), 0.06),
    Stage("what would be found", ("what would be found",), 0.11),
)
REPORT = (
    Stage("residuals", ("residuals", "derivatives", "stop by stop", "held-out residuals"), 0.22),
    Stage("figures", ("drawing",), 0.78),
)


def staged(progress: Progress, stages: Sequence[Stage]) -> Progress:
    """Tells `progress` with each step its stage and how much time is left, counted from now."""
    told, start_s = Staged(stages), time.monotonic()
    return lambda what, done, total: progress(told(what, time.monotonic() - start_s), done, total)


class Staged:
    """Says of each step in which stage it is, and how much time is left.

    Args:
        stages: in their order; one that does not occur is passed over.
    """

    def __init__(self, stages: Sequence[Stage]) -> None:
        self._stages, self._at, self._end_s = stages, 0, 0.0

    def __call__(self, what: str, elapsed_s: float) -> str:
        """The text of a step, ``elapsed_s`` after the start. The time left is what the later stages
        took of a measured run, in proportion; in the first stage it is not known, as the number of
        its passes is not."""
        later = range(self._at, len(self._stages))
        at = next((i for i in later if what.startswith(self._stages[i].begins)), self._at)
        if at > self._at:
            self._at = at
            self._end_s = elapsed_s / sum(stage.share for stage in self._stages[:at])
        left_s = self._end_s - elapsed_s
        left = f", about {left_s:.0f} s left" if left_s >= 1.0 else ""
        return f"{at + 1} of {len(self._stages)}, {self._stages[at].title}{left}: {what}"
