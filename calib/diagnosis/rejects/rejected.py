"""Beams that a fit rejected, and what they have in common."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from calib.residuals.groups import ALONG_BEAMS, ALONG_NORMAL

# Share of rejected beams that agree on a size, beyond those that agree with its negative, from
# which they are coherent: a choice, most of them.
AGREES = 0.5
# Share of rejected beams that end before the mesh, from which something stands in their way: a
# choice. Of rooms of which the mesh lacks the furniture it is all, of people before walls 0.95.
MOSTLY_SHORT = 0.9
# Share of rejected beams that have another beside them, 0 if no more do than by chance and 1 if all
# do, from which what they hit is wider than a beam: a choice. Of rooms of which the mesh lacks the
# furniture, and of people, it was 0.64 to 0.94.
MOSTLY_BESIDE = 0.5


@dataclass(frozen=True)
class Rejected:
    """R beams whose robust weight is 0.

    Args:
        stop, place, surface: (R,) numbers of the stop, the place and the surface they belong to.
        cells: (R, A) cell on each axis.
        residual_m: (R,); reach_m: (R,) by how much a beam may be off and not be rejected.
        slant: (R,) cosine of the incidence: what is as far along the beam is so much nearer along
            the normal.
        beside: (R,) whether the beam before or after it of its ring is rejected as well.
    """

    stop: np.ndarray
    place: np.ndarray
    surface: np.ndarray
    cells: np.ndarray
    residual_m: np.ndarray
    reach_m: np.ndarray
    slant: np.ndarray
    beside: np.ndarray

    @classmethod
    def of(cls, parts: Sequence[Rejected]) -> Rejected:
        """Several together."""
        names = [field.name for field in fields(cls)]
        return cls(**{n: np.concatenate([getattr(part, n) for part in parts]) for n in names})

    def __getitem__(self, rows: np.ndarray) -> Rejected:
        return Rejected(**{name: column[rows] for name, column in vars(self).items()})

    def __len__(self) -> int:
        return len(self.stop)

    def along(self, way: str) -> Rejected:
        """The same, with distances along the beams, as they are, or along the normal of what these
        were to meet."""
        slant = self.slant if way == ALONG_NORMAL else 1.0
        return replace(self, residual_m=self.residual_m * slant, reach_m=self.reach_m * slant)

    @property
    def steadier(self) -> str:
        """Whether the beams or the normal is the way along which most differ less, by a part of
        their median, from that."""
        return min((ALONG_NORMAL, ALONG_BEAMS), key=lambda way: self.along(way)._unevenness)

    @property
    def _unevenness(self) -> float:
        median = self._medians[0]
        return float(np.median(np.abs(self.residual_m - median)) / max(abs(median), 1e-300))

    @property
    def coherent(self) -> bool:
        """Whether most would not be rejected were their median taken off, and not as well with the
        other sign: an error of one size, where mixed pixels and clutter scatter over all values."""
        agrees, mirrored = (np.abs(self.residual_m - m) < self.reach_m for m in self._medians)
        return len(self) > 0 and bool(agrees.mean() - mirrored.mean() > AGREES)

    @property
    def short(self) -> float:
        """Which share of them ends before the mesh; 0 of none."""
        return float(np.mean(self.residual_m < 0)) if len(self) else 0.0

    def beside_each_other(self, share: float) -> bool:
        """Whether what most of them hit is wider than a beam, which errors of single beams are not.

        Args:
            share: of all beams that are rejected.
        """
        chance = 1.0 - (1.0 - share) ** 2  # that one beside is rejected too, before it or after
        wide = self.beside.mean() - chance if len(self) else 0.0
        return bool(wide > MOSTLY_BESIDE * (1.0 - chance))

    def in_the_way(self, share: float) -> bool:
        """Whether they hit things nearer than the mesh, at all distances; argument as of
        `beside_each_other`."""
        return self.beside_each_other(share) and self.short > MOSTLY_SHORT and not self.coherent

    @property
    def agreeing(self) -> Rejected:
        """Those that would not be rejected were the median taken off."""
        return self[np.abs(self.residual_m - self._medians[0]) < self.reach_m]

    @property
    def sigma_m(self) -> float:
        """Sigma of the mean of those that agree, m, stops and surfaces counted; NaN where there is
        one of them only."""
        some, variance = self.agreeing, 0.0
        away = some.residual_m - some.residual_m.mean()
        for way in (some.stop, some.surface):
            _, cluster = np.unique(way, return_inverse=True)
            sums = np.bincount(cluster, away)
            if (several := len(sums)) > 1:
                variance += several / (several - 1) * np.sum(np.square(sums / len(away)))
        return float(np.sqrt(variance)) or np.nan

    @property
    def _medians(self) -> tuple[float, float]:
        median = float(np.median(self.residual_m)) if len(self) else np.nan
        return median, -median
