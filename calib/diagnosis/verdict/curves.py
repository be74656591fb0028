"""Where the model fails: the mean residual against covariates, in bands that hold for clusters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from calib.diagnosis.screen import Screen
from calib.diagnosis.structure.empirical import Binned
from calib.linear.binned import BinnedMean, TwoWay


@dataclass(frozen=True)
class Curve:
    """Mean range residual in the bins of one covariate, or of two.

    Args:
        centres: covariate -> (B,) mean of its values in each bin.
        mean_m: (B,) or (B1, B2), weighted mean of what is left after the fit; NaN where nothing is.
        band_m: half the width of a band that holds all bins together with 95 % probability where
            the model is right, stops and surfaces counted, not rows; no narrower than the
            candidates' common inflation has it.
        rig: whose, where there are several; else empty.
    """

    centres: Mapping[str, np.ndarray]
    mean_m: np.ndarray
    band_m: np.ndarray
    rig: str = ""

    @property
    def covariates(self) -> tuple[str, ...]:
        return tuple(self.centres)

    def document(self) -> dict[str, Any]:
        """As in diagnosis.json."""
        return {
            "covariates": list(self.centres),
            "centres": [c for c in self.centres.values()],
            "mean_mm": 1e3 * self.mean_m,
            "band_mm": 1e3 * self.band_m,
            **({"rig": self.rig} if self.rig else {}),
        }


def curves(screen: Screen) -> list[Curve]:
    """The curve of every covariate, and the map of every pair, that was tested for structure; of
    each rig, where there are several."""
    return [
        _curve(screen, c.effect, at, screen.scores.owner[name].rig)
        for c in screen.candidates
        if isinstance(c.effect, Binned)
        for name, at in screen.scores.at.items()
        if screen.scores.owner[name].effect == c.effect.name
    ]


def _curve(screen: Screen, effect: Binned, columns: slice, rig: str) -> Curve:
    scores = screen.scores
    weight = scores.felt[columns]
    weight = np.where(weight > 1e-9 * weight.max(), weight, np.nan)
    ways = (scores.by_stop[:, columns], scores.by_place[:, columns], scores.by_both(columns))
    squares = TwoWay.of(*ways)
    model = screen.common * np.diag(scores.information)[columns]
    # A range error of 1 m changes every residual of its bin by as much: mean = score / weight.
    found = BinnedMean.of(scores.score[columns], weight, squares, model)
    return Curve(
        centres=effect.centres,
        mean_m=found.mean.reshape(effect.bins),
        band_m=found.together(scores.draws[:, columns], squares).reshape(effect.bins),
        rig=rig,
    )
