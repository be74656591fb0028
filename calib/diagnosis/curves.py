"""Where the model fails: the mean residual against covariates, in bands that hold for clusters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from calib.diagnosis.candidates import Binned
from calib.diagnosis.screen import Screen

CURVE_CONFIDENCE = 0.95  # that the band holds the whole curve: by convention


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
        _curve(screen, c.effect, at, name.removesuffix(c.effect.name).removesuffix("/"))
        for c in screen.candidates
        if isinstance(c.effect, Binned)
        for name, at in screen.scores.at.items()
        if f"/{name}".endswith(f"/{c.effect.name}")
    ]


def _curve(screen: Screen, effect: Binned, columns: slice, rig: str) -> Curve:
    scores = screen.scores
    weight = np.diag(scores.whole)[columns]
    weight = np.where(weight > 1e-9 * weight.max(), weight, np.nan)
    stop, place = np.square(scores.by_stop[:, columns]), np.square(scores.by_place[:, columns])
    one_way = np.maximum(stop.sum(axis=0), place.sum(axis=0))
    two_way = stop.sum(axis=0) + place.sum(axis=0) - np.square(scores.both[:, columns]).sum(axis=0)
    model = screen.common * np.diag(scores.information)[columns]
    sigma = np.sqrt(np.maximum(np.maximum(one_way, two_way), model)) / weight
    scale = np.sqrt(np.maximum(stop.sum(axis=0) + place.sum(axis=0), 1e-300))
    by_chance = np.abs(scores.draws[:, columns]) / scale
    width = np.quantile(by_chance[:, np.isfinite(weight)].max(axis=1), CURVE_CONFIDENCE)
    # A range error of 1 m changes every residual of its bin by as much: mean = score / weight.
    mean = scores.score[columns] / weight
    return Curve(
        centres=effect.centres,
        mean_m=mean.reshape(effect.bins),
        band_m=(width * sigma).reshape(effect.bins),
        rig=rig,
    )
