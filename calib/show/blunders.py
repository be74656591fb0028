"""Groups of rows that a mishap spoiled, as tables have them; `told` says the same in sentences."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from calib.blunders.told import size_told
from calib.show.tables import columns_table

if TYPE_CHECKING:
    from rich.table import Table

BLUNDER_HEADINGS = ("what", "off by", "or else")


def blunder_cells(blunder: Mapping[str, Any]) -> tuple[str, str, str]:
    """What ``--without`` calls it, by how much it is off, and what else could be said of it.

    Args:
        blunder: as diagnosis.json has it.
    """
    axis, others = blunder["axis"] or "", blunder["indistinguishable_from"]
    along = f"in {axis}" if len(axis) == 1 else axis
    said = [f"or {', or '.join(others)}: nothing tells them apart"] if others else []
    if blunder["belongs_to"]:
        said.append(f"it was taken at {blunder['belongs_to']}")
    if blunder["wrong_sign"]:
        said.append(f"its {blunder['wrong_sign']} may have the wrong sign")
    known = blunder["size"] is not None
    size = size_told(blunder["size"], blunder["sigma"], blunder["unit"]) if known else ""
    what = blunder["without"] or f"{blunder['kind']} of {blunder['name']}"
    return what, f"{size} {along}".rstrip(), "; ".join(said)


def blunders_table(blunders: Sequence[Mapping[str, Any]]) -> Table:
    """All of them, in the order in which they were found."""
    table = columns_table(*BLUNDER_HEADINGS)
    table.title = "what is wrong in the recording"
    table.title_justify, table.title_style = "left", "bold"
    for each in blunders:
        table.add_row(*blunder_cells(each))
    return table
