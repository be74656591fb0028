"""From sums of stops to normal equations of what is kept, cells first.

A beam meets one surface. So before anything is eliminated nothing ties the cells of one surface to
those of another, and they are taken out surface by surface. What stops have for themselves stays in
the matrix until then, and goes at once.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calib.linear.assembly.common import Assembly, Scanned
from calib.linear.elimination import Eliminated, eliminate
from calib.linear.layout import Layout
from calib.linear.own import OwnRows
from calib.linear.system import Values
from calib.residuals.compiled import add_at


class CellsFirst(Assembly):
    """Beside cells its matrix has what stops have for themselves, and then what is kept; arguments
    as of `Assembly`."""

    def __init__(self, layout: Layout, own: Sequence[OwnRows], raw: bool) -> None:
        self.own = np.concatenate([np.zeros(0, int), *layout.own.values()])
        super().__init__(layout, own, raw, np.concatenate([self.own, layout.kept]))

    def add_twists(self, beams: Sequence[Scanned]) -> None:
        """All that twists depend on is in the matrix still."""
        self.add_through(beams)

    def eliminate(self, values: Values) -> np.ndarray:
        for rows in self.rows:
            self._add_own(rows)
        self.tell_raw()
        rest = self.without_cells(values, [len(some) for some in self.layout.cells])
        count = len(self.own)
        if not count:
            return rest
        kept = np.ascontiguousarray(rest[count:, count:])
        factor, gain = eliminate(rest[:count, :count], rest[:count, count:], kept)
        over = np.append(self.layout.kept, self.layout.size)
        self.eliminated.append(Eliminated(self.own, over, factor, gain))
        return kept

    def _add_own(self, rows: OwnRows) -> None:
        """Add the products of rows about stops' own unknowns."""
        sigma = self.layout.sigma
        b = rows.b.reshape(len(rows.stops), rows.of_each, 1)
        own = rows.own * sigma[rows.own_columns][:, None]
        shared = np.concatenate([rows.shared * sigma[rows.shared_columns], b], axis=2)
        alike = np.append(self.at[rows.shared_columns], len(self.columns) - 1)
        flat = shared.reshape(-1, len(alike))
        add_at(self.half, alike, alike, flat.T @ flat / 2)
        blocks, beside = own.mT @ own / 2, own.mT @ shared
        for at, block, cross in zip(self.at[rows.own_columns], blocks, beside, strict=True):
            add_at(self.half, at, at, block)
            add_at(self.half, at, alike, cross)
