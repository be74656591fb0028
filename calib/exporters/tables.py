"""What was found, as tables for papers and notes: calibration.tex and calibration.md."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from calib.exporters.fitted import Fitted
from calib.exporters.written import Written, head, write_text
from calib.results.outstanding import shown
from calib.runs.estimates import VariableEstimate, variable_estimates
from calib.show.tables import LISTED_PARAMETERS, effect_cells, estimate_cell
from chains import escape

TABLE_CONVENTIONS = (
    "Links: how far T_parent_child lies from CAD, T_cad exp(twist), in the child's own axes; where",
    "no CAD says, sigma alone. Effects: geometry, true = nominal + effect; instruments,",
    "measured = true + effect. The number after the sign is one standard deviation.",
)


@dataclass(frozen=True)
class _TextTable:
    title: str
    header: tuple[str, ...]
    rows: list[tuple[str, ...]]


def write_latex(fitted: Fitted, folder: Path) -> Written:
    r"""Write calibration.tex: plain tabulars, to be read by ``\input``; no package is needed."""
    return _write(fitted, folder / "calibration.tex", "% {}\n", _latex)


def write_markdown(fitted: Fitted, folder: Path) -> Written:
    """Write calibration.md: the same tables."""
    return _write(fitted, folder / "calibration.md", "    {}\n", _markdown)


def _write(
    fitted: Fitted, path: Path, line: str, render: Callable[[_TextTable], Iterable[str]]
) -> Written:
    rows = variable_estimates(fitted.run)
    long = [
        row.variable
        for row in rows
        if row.parent is None and len(row.parameters) > LISTED_PARAMETERS
    ]
    not_held = [
        "poses: extrinsics.yaml has them",
        *(f"each value of {name}: extrinsics.yaml has them" for name in long),
    ]
    rigs = ", ".join(recording["rig"] for recording in fitted.run.model["recordings"])
    text = "".join(
        line.format(escape.line(each))
        for each in head(fitted.run, rigs, TABLE_CONVENTIONS, not_held)
    )
    for table in _tables(rows):
        text += "\n" + "\n".join(render(table)) + "\n"
    write_text(path, text)
    return Written([path], not_held)


def _tables(rows: list[VariableEstimate]) -> list[_TextTable]:
    links = [cells for row in rows if row.parent is not None for cells in _link(row)]
    effects = [
        (row.variable, parameter, cell, unit, "" if told else "yes")
        for row in rows
        if row.parent is None
        for parameter, cell, unit, told in effect_cells(row)
    ]
    tables = [
        _TextTable("Links", ("link", "x", "y", "z", "unit", "confounded"), links),
        _TextTable("Effects", ("effect", "parameter", "estimate", "unit", "confounded"), effects),
    ]
    return [table for table in tables if table.rows]


def _link(row: VariableEstimate) -> Iterable[tuple[str, ...]]:
    for part, unit in ((slice(3, 6), "m"), (slice(0, 3), "rad")):
        cells = map(estimate_cell, row.estimate[part], row.sigma[part], (unit,) * 3)
        untold = " ".join(
            axis for axis, told in zip("xyz", row.told[part], strict=True) if not told
        )
        yield (f"{row.parent} → {row.variable}", *cells, shown(unit)[1], untold)


def _latex(table: _TextTable) -> Iterable[str]:
    yield f"\\begin{{tabular}}{{{'l' * len(table.header)}}} % {table.title}"
    yield "\\hline"
    yield _latex_row(table.header)
    yield "\\hline"
    yield from map(_latex_row, table.rows)
    yield "\\hline"
    yield "\\end{tabular}"


def _latex_row(cells: Iterable[str]) -> str:
    minus = (re.sub(r"^-(?=\d)", "$-$", escape.latex(cell)) for cell in cells)
    return " & ".join(minus) + r" \\"


def _markdown(table: _TextTable) -> Iterable[str]:
    yield f"## {table.title}\n"
    yield _markdown_row(table.header)
    yield _markdown_row("---" for _ in table.header)
    yield from map(_markdown_row, table.rows)


def _markdown_row(cells: Iterable[str]) -> str:
    return "| " + " | ".join(map(escape.markdown, cells)) + " |"
