"""From sums of stops to normal equations of what is kept, in the order that takes less work.

The result does not depend on the order. Of many stops in a small room it takes less to eliminate
what each stop has for itself first (`stops_first`), of few stops in a room of many parts to
eliminate the cells of each surface first (`cells_first`).
"""

from __future__ import annotations

from collections.abc import Sequence

from calib.linear.assembly.cells_first import CellsFirst
from calib.linear.assembly.common import Assembly, KeptSums, alone
from calib.linear.assembly.stops_first import StopsFirst
from calib.linear.layout import Layout
from calib.linear.own import OwnRows
from calib.linear.rows import TWIST

__all__ = ["Assembly", "KeptSums", "alone", "assembly_of"]


def assembly_of(layout: Layout, own: Sequence[OwnRows], raw: bool) -> Assembly:
    """What sums of stops are added to; arguments as of `Assembly`."""
    kind = CellsFirst if begins_with_cells(layout) else StopsFirst
    return kind(layout, own, raw)


def begins_with_cells(layout: Layout) -> bool:
    """Whether that takes fewer products than to begin with the stops."""
    cells, own = sum(map(len, layout.cells)), sum(map(len, layout.own.values()))
    kept = len(layout.kept)
    by_cells = cells * (own + kept) ** 2 + own**2 * (own / 3 + 2 * kept) + own * kept**2
    by_stops = TWIST * layout.scanned * (cells + kept) ** 2
    by_stops += cells**2 * (cells / 3 + 2 * kept) + cells * kept**2
    return by_cells < by_stops
