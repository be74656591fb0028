"""The mean of rows in the bins of a covariate, with a band that counts clusters, not rows.

Rows of one stop err together, and so do rows of one place. With ``s_c`` what the rows of cluster c
add to a bin's weighted sum of residuals beyond what is expected, and W the bin's weight, the
variance of its mean is the two-way one of Cameron, Gelbach and Miller (2011),
``(sum over stops s^2 + over places s^2 - over stop x place s^2) / W^2``, never less than by stops
or by places alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import special

CONFIDENCE = 0.95  # of a band: by convention


class TwoWay(NamedTuple):
    """Squares (B,) of what clusters add to each bin, summed over these: stops, places, and both."""

    stop: np.ndarray
    place: np.ndarray
    both: np.ndarray

    @classmethod
    def of(cls, stop: np.ndarray, place: np.ndarray, both: np.ndarray) -> TwoWay:
        """Of what each cluster adds (C, B)."""
        return cls(*(np.square(added).sum(axis=0) for added in (stop, place, both)))

    @property
    def variance(self) -> np.ndarray:
        """(B,) of the bins' sums."""
        one_way = np.maximum(self.stop, self.place)
        return np.maximum(one_way, self.stop + self.place - self.both)


@dataclass(frozen=True)
class BinnedMean:
    """The mean of each bin.

    Args:
        mean: (B,) NaN where nothing is.
        sigma: (B,) of it.
    """

    mean: np.ndarray
    sigma: np.ndarray

    @classmethod
    def of(
        cls, total: np.ndarray, weight: np.ndarray, squares: TwoWay, least: np.ndarray
    ) -> BinnedMean:
        """From sums over rows.

        Args:
            total: (B,) of weighted residuals.
            weight: (B,) of the weights.
            squares: of what clusters add to `total`.
            least: (B,) variance of `total` below which none is believed.
        """
        variance = np.maximum(squares.variance, least)
        return cls(total / weight, np.sqrt(variance) / weight)

    def each(self, clusters: np.ndarray) -> np.ndarray:
        """Half the width (B,) of bands that hold each bin for itself with 95 % probability; NaN in
        a bin of one cluster.

        Args:
            clusters: (B,) how many there are in each bin.
        """
        freedom = np.maximum(clusters - 1, 1)
        half = special.stdtrit(freedom, 0.5 + CONFIDENCE / 2) * self.sigma
        return np.where(clusters > 1, half, np.nan)

    def together(self, draws: np.ndarray, squares: TwoWay) -> np.ndarray:
        """Half the width (B,) of a band that holds all bins at once with 95 % probability.

        Args:
            draws: (R, B) sums as chance might have dealt them, stops and places each for itself.
            squares: of what these add to them.
        """
        by_chance = np.abs(draws) / np.sqrt(np.maximum(squares.stop + squares.place, 1e-300))
        seen = np.isfinite(self.sigma)
        return np.quantile(by_chance[:, seen].max(axis=1), CONFIDENCE) * self.sigma


class BinnedSums:
    """Sums over rows in B bins, and over clusters of these, stop by stop."""

    def __init__(self, bins: int) -> None:
        self.weight, self.total = np.zeros((2, bins))
        self._stops = np.zeros((4, bins))  # clusters, W^2, W R, R^2
        self._both = np.zeros((4, bins))
        self._places = np.zeros((2, bins, 0))  # W, R of each place

    def add(self, at: np.ndarray, row: np.ndarray, weight: np.ndarray, place: np.ndarray) -> None:
        """Take in all rows (N,) of one stop.

        Args:
            at: the bin of each.
            row: residuals.
            weight: of each.
            place: the number of each one's place, among those of all stops.
        """
        theirs, local = np.unique(place, return_inverse=True)
        shape = len(self.weight), len(theirs)
        cell = at * len(theirs) + local
        each = (np.bincount(cell, x, shape[0] * shape[1]) for x in (weight, weight * row))
        sums = np.stack([x.reshape(shape) for x in each])
        missing = int(theirs.max(initial=-1)) + 1 - self._places.shape[2]
        if missing > 0:
            self._places = np.pad(self._places, ((0, 0), (0, 0), (0, missing)))
        self._places[:, :, theirs] += sums
        self._both += _squared(sums)
        self._stops += _squared(sums.sum(axis=2, keepdims=True))
        self.weight += sums[0].sum(axis=1)
        self.total += sums[1].sum(axis=1)

    def mean(self) -> tuple[BinnedMean, np.ndarray]:
        """The means, residuals counted about them, and how many clusters (B,) each rests on: stops
        or places, whichever are fewer; cells of both, where there is one stop or place."""
        ways = (self._stops, _squared(self._places), self._both)
        few = np.minimum(*(np.where(way[0] > 1, way[0], np.inf) for way in ways[:2]))
        clusters = np.where(np.isfinite(few), few, self._both[0])
        with np.errstate(invalid="ignore", divide="ignore"):  # of empty bins
            mean = self.total / self.weight
            squares = TwoWay(*(_about(mean, way) for way in ways))
            return BinnedMean.of(self.total, self.weight, squares, squares.both), clusters


def _squared(sums: np.ndarray) -> np.ndarray:
    """(4, B) how many clusters have rows, and W^2, W R, R^2 added up, of (2, B, C) W and R."""
    weight, total = sums
    parts = ((weight > 0).astype(float), weight * weight, weight * total, total * total)
    return np.stack([part.sum(axis=1) for part in parts])


def _about(mean: np.ndarray, way: np.ndarray) -> np.ndarray:
    """Squares (B,) of what G clusters add beyond the mean, with their ``G / (G - 1)``."""
    count, ww, wr, rr = way
    left = np.maximum(ww * mean**2 - 2 * wr * mean + rr, 0.0)
    return left * np.where(count > 1, count / (count - 1), 0.0)
