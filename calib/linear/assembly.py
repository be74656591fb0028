"""From sums of stops to normal equations of what is kept: what both orders of elimination share.

Both give the same result; see `calib.linear` for which is taken when.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calib.linear.clusters import ClusteredRows
from calib.linear.elimination import Eliminated, square
from calib.linear.layout import Layout, positions
from calib.linear.rows import TWIST, OwnSums, StopSums
from calib.linear.system import Linearisation, Values
from calib.problem.unknowns import Role
from calib.residuals.compiled import add_at, add_gram


@dataclass(frozen=True)
class OwnRows:
    """Whitened rows that are no beams: of a tracked body, of a prior, or of a hold's scatter.

    Args:
        A: (m, n) derivatives, columns: (n,) by which.
        b: (m,) minus the residuals.
        measured: False for a prior.
    """

    A: np.ndarray
    b: np.ndarray
    columns: np.ndarray
    measured: bool

    def of_stop(self, stop: int, place: np.ndarray | None = None) -> ClusteredRows:
        """The same as rows of a stop, each of a place (m,); -1 for none, as without it."""
        at, none = np.full(len(self.b), stop), np.full(len(self.b), -1)
        place = none if place is None else place
        return ClusteredRows(A=self.A, b=self.b, columns=self.columns, stop=at, place=place)

    def add_to(self, target: np.ndarray, at: np.ndarray, sigma: np.ndarray, b: int = -1) -> None:
        """Add their Gram matrix to another.

        Args:
            target: (N, N), added to.
            at: (U,) where columns stand in it, -1 for those that do not.
            sigma: (U,) units of the columns.
            b: where the right side stands; -1 if it does not.
        """
        rows = np.column_stack([self.A * sigma[self.columns], self.b])
        add_gram(target, np.append(at[self.columns], b), rows)


@dataclass(frozen=True)
class KeptSums:
    """The Gram matrix of whitened rows about kept unknowns.

    Args:
        gram: (n + 1, n + 1) over the columns and, last, the right side.
        columns: (n,) by which.
    """

    gram: np.ndarray
    columns: np.ndarray

    @classmethod
    def of(cls, rows: OwnRows) -> KeptSums:
        """Of rows, however many."""
        return cls(square(np.column_stack([rows.A, rows.b])), rows.columns)

    def add_to(self, target: np.ndarray, at: np.ndarray, sigma: np.ndarray, b: int = -1) -> None:
        """Add it to another; arguments as of `OwnRows.add_to`."""
        place, unit = np.append(at[self.columns], b), np.append(sigma[self.columns], 1.0)
        add_at(target, place, place, self.gram * unit * unit[:, None])


class Assembly:
    """What both orders share: give it each stop's sums by `add`, those of other rows about kept
    unknowns by `add_kept`, then call ``done``.

    Args:
        layout: which column is what.
        own: stop -> rows about its own unknowns.
        beams: how many stops have beams.
        raw: whether the Gram matrix before eliminations is wanted.
    """

    def __init__(
        self, layout: Layout, own: Mapping[int, Sequence[OwnRows]], beams: int, raw: bool
    ) -> None:
        self.layout, self.own = layout, own
        self.raw = np.zeros((len(layout.kept), len(layout.kept))) if raw else None
        self.chi2 = sum(float(rows.b @ rows.b) for each in own.values() for rows in each)
        self.touched = np.zeros(layout.size, bool)
        for rows in (r for each in own.values() for r in each if r.measured):
            self.touched[rows.columns] |= np.any(rows.A != 0, axis=0)
        self.weight_m2 = self.beams_chi2 = 0.0
        self.eliminated: list[Eliminated] = []
        self.twists: list[tuple[int, np.ndarray, np.ndarray]] = []
        self.scans: dict[int, OwnSums] = {}

    def add(self, sums: StopSums) -> None:
        """Add the beams of a stop."""
        self.weight_m2 += sums.weight_m2
        self.beams_chi2 += float(sums.dense[TWIST, TWIST])
        self.chi2 += float(sums.dense[TWIST, TWIST])
        seen = np.append(np.diag(sums.dense)[TWIST + 1 :], sums.own) > 0
        self.touched[sums.columns] |= seen
        self.touched[sums.chain_columns] |= np.any(sums.chain != 0, axis=0)
        if self.raw is not None:
            self.scans[sums.stop] = sums.alone()

    def _add_raw(self, found: Iterable[OwnRows | KeptSums]) -> None:
        """Add what rows say of kept columns."""
        at = positions(self.layout.size, self.layout.kept)
        for rows in found:
            rows.add_to(self.raw, at, self.layout.sigma)

    def add_kept(self, sums: KeptSums) -> None:
        """Add the sums of whitened rows about kept unknowns."""
        self.chi2 += float(sums.gram[-1, -1])
        self.touched[sums.columns] |= np.diag(sums.gram)[:-1] > 0

    def _cell_priors(self, values: Values, columns: np.ndarray) -> np.ndarray:
        """Right side (n,) of the priors of cells, in units of their sigmas: the derivative is 1."""
        whole = np.zeros(self.layout.size)
        for name, at in self.layout.at.items():
            if self.layout.unknowns[name].role is Role.SURFACE:
                whole[at] = -values[name] / self.layout.unknowns[name].sigma
        self.chi2 += float(whole[columns] @ whole[columns])
        return whole[columns]

    def _done(self, values: Values, kept: np.ndarray) -> Linearisation:
        return Linearisation(
            beams_chi2=self.beams_chi2,
            layout=self.layout,
            values=values,
            kept=kept,
            raw=self.raw,
            chi2=self.chi2,
            touched=self.touched,
            eliminated=self.eliminated,
            twists=self.twists,
            scans=self.scans,
            weight_m2=self.weight_m2,
        )
