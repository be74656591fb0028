"""What a page shows as numbers: tables, and the CSV of tables and figures."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from urllib.parse import quote

from chains import escape

CSV_DIGITS = 9  # significant digits of a number in CSV: more than any instrument of a rig has
UNQUOTED = ",:;"  # signs that stand for themselves in the address of a link, beside letters


@dataclass(frozen=True)
class Cell:
    """A cell of a table.

    Args:
        text: as people read it.
        value: the number behind it in the same unit, by which the table is sorted; None of text.
    """

    text: str
    value: float | None = None

    @property
    def exact(self) -> str:
        """As CSV has it."""
        return self.text if self.value is None else f"{self.value:z.{CSV_DIGITS}g}"


@dataclass(frozen=True)
class Table:
    """A table of the page.

    Args:
        id: its anchor, and the name of its CSV.
        title: what it holds.
        reading: how to read it.
        columns: headings, with units.
        rows: of cells, one for each column.
        folded: whether it is opened by a click.
    """

    id: str
    title: str
    reading: str
    columns: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    folded: bool = False

    @property
    def csv(self) -> str:
        """The address of its CSV; see `csv_link`."""
        return csv_link([self.columns, *([cell.exact for cell in row] for row in self.rows)])


def csv_link(rows: Iterable[Sequence[str]]) -> str:
    """The address of a CSV file that it holds itself, so that a page can give it without a script.

    Args:
        rows: of texts and numbers as texts; no text becomes a formula in a spreadsheet.
    """
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerows([escape.csv_cell(cell) for cell in row] for row in rows)
    return f"data:text/csv;charset=utf-8,{quote(file.getvalue(), safe=UNQUOTED)}"
