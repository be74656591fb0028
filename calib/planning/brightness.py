"""How bright the beams of a planned stop will be: as those of its recording are, by what they meet.

``log(intensity) = a_label + b log(range) + c log(cos(incidence))``, fitted to beams that were
recorded: Lambert's law has b = -2 and c = 1, and makers' own corrections have others.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Self

import numpy as np

from calib.residuals.beams import Rows

LEAST_INTENSITY = 1e-6  # of the median: less has no logarithm
LEAST_RANGE_M, LEAST_COSINE = 0.1, 0.05  # range and cosine: logarithms of less would decide the fit


@dataclass(frozen=True)
class Brightness:
    """A fit of intensities, over the recordings' median.

    Args:
        labels: (L,) ascending.
        level: (L,) of each, a logarithm.
        usual: of all others.
        fall, slant: exponents of the range and of the cosine of incidence.
    """

    labels: np.ndarray
    level: np.ndarray
    usual: float
    fall: float
    slant: float

    @classmethod
    def of(cls, scans: Iterable[Rows]) -> Self | None:
        """As the usable beams of some scans are; None where they have no intensity."""
        parts: list[np.ndarray] = []
        for rows in scans:
            names = ("intensity", "label", "range_m", "incidence_rad")
            values = [np.broadcast_to(rows.view[name], rows.view.rows) for name in names]
            parts.append(np.stack(values)[:, rows.usable])
        intensity, label, range_m, incidence = np.concatenate(parts, axis=1)
        fine = np.isfinite(intensity) & (intensity > LEAST_INTENSITY)
        if not fine.any():
            return None
        labels, index = np.unique(label[fine].astype(int), return_inverse=True)
        A = np.zeros((fine.sum(), len(labels) + 2))
        A[np.arange(len(A)), index] = 1.0
        A[:, -2:] = _logs(range_m[fine], np.cos(incidence[fine]))
        found = np.linalg.lstsq(A, np.log(intensity[fine]), rcond=None)[0]
        level = found[:-2]
        return cls(
            labels=labels,
            level=level,
            usual=float(np.median(level)),
            fall=float(found[-2]),
            slant=float(found[-1]),
        )

    def at(self, label: np.ndarray, range_m: np.ndarray, cosine: np.ndarray) -> np.ndarray:
        """Intensity (N,) over the median of beams that meet such labels, at ranges and cosines of
        incidence (N,)."""
        place = np.minimum(np.searchsorted(self.labels, label), len(self.labels) - 1)
        level = np.where(self.labels[place] == label, self.level[place], self.usual)
        far, slant = _logs(np.where(np.isfinite(range_m), range_m, 1.0), cosine).T
        return np.exp(level + self.fall * far + self.slant * slant)


def _logs(range_m: np.ndarray, cosine: np.ndarray) -> np.ndarray:
    held = np.maximum(range_m, LEAST_RANGE_M), np.maximum(cosine, LEAST_COSINE)
    return np.log(np.stack(held, axis=1))
