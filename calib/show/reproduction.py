"""What ``rigcal reproduce`` prints."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from rich.table import Table
from rich.text import Text

from calib.runs.reproduce import Difference, Reproduction
from calib.show.tables import columns_table, print_pairs, terminal


def print_reproduction(found: Reproduction) -> None:
    """Print whether a run is the same when it is made again, and else by how much it differs."""
    console = terminal()
    console.print(str(found.run), style="bold", markup=False, soft_wrap=True)
    for sentence in sentences(found):
        console.print(sentence, markup=False)
    if not found.identical:
        console.print(_table(found.differences))
    if found.versions:
        rows = [(name, f"{was} then, {now} here") for name, (was, now) in found.versions.items()]
        print_pairs(console, "made with other versions", rows)


def sentences(found: Reproduction) -> Iterator[str]:
    """The result in words."""
    if found.identical:
        yield f"identical: of the repeated run all {found.files} files hold the same."
        return
    differ = f"{len(found.differences)} of {found.files} files"
    yield f"differs: made again, {differ} hold something else."
    if found.furthest is not None:
        name, sigmas = found.furthest
        far = f"the furthest is {name}, by {sigmas:.2g} of its sigmas" if sigmas else "none moved"
        yield f"Of the estimates {far}."


def _table(differences: Sequence[Difference]) -> Table:
    table = columns_table("file", "entries", "furthest apart", "in the run", "made again")
    for each in differences:
        count = f"{each.entries} of {each.of}"
        table.add_row(*map(Text, (each.file, count, each.most, _cell(each.was), _cell(each.now))))
    return table


def _cell(value: Any) -> str:
    return "" if value is None else f"{value:.9g}" if isinstance(value, float) else str(value)
