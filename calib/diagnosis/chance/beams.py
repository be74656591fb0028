"""Whether beams scatter each by itself: what those beside each other have in common.

Where a LiDAR is noisier than its noise model says, each beam errs by itself. Where something is
missing from the model, beams beside each other err alike, in a ring or from ring to ring, and what
belongs to a direction of the LiDAR comes again at every stop.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from calib.forward import Values
from calib.linear.parallel import over_stops
from calib.residuals.beams import Association
from calib.residuals.scan import ScanStop
from calib.residuals.store import drawn_evenly
from calib.results.sigmas import TOLERATED
from calib.solve.estimate import Estimate

STOPS_ASKED = 40  # a choice: with 1,000 beams each a share of a hundredth is known to half of it
COLUMN_RAD = np.radians(0.2)  # wide as a column of most spinning LiDARs: 1,800 or 2,048 a turn


@dataclass(frozen=True)
class BeamScatter:
    """How widely beams scatter.

    Args:
        times: rms of their residuals, in their sigmas.
        common: the share of its square that beams beside each other, or the same beam at other
            stops, have in common, whichever is more.
    """

    times: float
    common: float

    @property
    def alone(self) -> float:
        """How many times wider than its sigma each beam scatters by itself."""
        return self.times * float(np.sqrt(1.0 - self.common))

    @property
    def sentence(self) -> str:
        """What it says, and what to do about it."""
        beside = (
            f"{100 * self.common:.0f} % of the variance is common to beams beside each other, or "
            "to the same beam at other stops"
        )
        if self.alone <= TOLERATED:
            return (
                f"The ranges scatter {self.times:.1f} times as widely as the LiDAR's noise model "
                f"says, and {beside}: that is no noise of single beams."
            )
        return (
            f"The ranges scatter {self.alone:.1f} times as widely as the LiDAR's noise model says, "
            f"each beam by itself ({beside}). Sigmas are widened by that; a larger sigma_range_m "
            "of the lidar in rig.yaml would say so."
        )

    @classmethod
    def of(cls, estimate: Estimate) -> BeamScatter:
        """Of the beams that have weight, at an estimate with scans; where there are many stops,
        some of them, drawn evenly, stand for all."""
        some = drawn_evenly(len(estimate.scans), STOPS_ASKED, seed=0)
        scans, met = ([of[i] for i in some] for of in (estimate.scans, estimate.associations))
        stops = list(over_stops(partial(_residuals, estimate.values), scans, met))
        z, ring, column = (np.concatenate(each) for each in zip(*stops, strict=True))
        each = [len(of_stop[0]) for of_stop in stops]
        stop = np.repeat(np.arange(len(stops)), each)
        rigs = [scan.stops.rig.name for scan in scans]
        lidar = np.repeat(np.unique(rigs, return_inverse=True)[1], each)
        square = float(np.mean(np.square(z)))
        alike = (
            _beside(z, (stop, ring), column),
            _beside(z, (stop, column), ring),
            _again(z, (lidar, ring, column)),
        )
        return cls(float(np.sqrt(square)), float(np.clip(max(alike) / square, 0.0, 1.0)))


def _beside(z: np.ndarray, within: Sequence[np.ndarray], along: np.ndarray) -> float:
    """Mean product of values (N,) that follow each other along something, within the same."""
    order = np.lexsort((along, *within))
    here, there = order[:-1], order[1:]
    pairs = np.all([each[here] == each[there] for each in within], axis=0)
    return float(np.mean((z[here] * z[there])[pairs])) if pairs.any() else 0.0


def _again(z: np.ndarray, same: Sequence[np.ndarray]) -> float:
    """Mean product of values (N,) of which all that is the same is one."""
    number = np.zeros(len(z), np.int64)
    for each in same:
        number = number * (int(np.ptp(each)) + 1) + each - each.min()
    _, which, count = np.unique(number, return_inverse=True, return_counts=True)
    total, squares = (np.bincount(which, weights=x) for x in (z, np.square(z)))
    pairs = float(np.sum(count * (count - 1.0)))
    return float(np.sum(np.square(total) - squares)) / pairs if pairs else 0.0


def _residuals(
    values: Values, scan: ScanStop, association: Association
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A stop's residuals in sigmas, with the ring and the column of each."""
    rows = scan.rows(values, association)
    ring, azimuth_rad = (np.asarray(rows.view[name]) for name in ("ring", "azimuth_rad"))
    kept = rows.weight > 0
    z = (rows.residual_m / rows.sigma_m)[kept]
    return z, ring[kept], np.round(azimuth_rad[kept] / COLUMN_RAD).astype(int)
