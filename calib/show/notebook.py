"""What Python shows of results: the tables of the terminal, as HTML in a notebook and as text.

Importing this gives runs, rungs and diagnoses their `_repr_html_`, and what is printed its
`__str__`: results know nothing of how they are shown. `calib.report.methods` imports it.
"""

from __future__ import annotations

import io
import sys
import time
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from calib.diagnosis import Diagnosis
from calib.runs.asked.moved import Moved
from calib.runs.estimates import variable_estimates
from calib.runs.ladder import Rung
from calib.runs.run import Run
from calib.show.blunders import blunders_table
from calib.show.comparison import ladder_table, print_moved
from calib.show.diagnosis import (
    LEADING,
    candidates_table,
    detectable_table,
    unexplained_table,
)
from calib.show.headline import closing, moved_sentence
from calib.show.tables import (
    TABLE_WIDTH,
    effects_table,
    error_table,
    links_table,
    outcome,
    terminal,
)
from chains import escape

if TYPE_CHECKING:
    from rich.table import Table

TOLD_EVERY_S = 0.1  # lines follow each other no faster than they can be read

_PAGE = """\
<div><p><b>{{ title }}</b></p>
{%- for sentence in sentences %}
<p>{{ sentence }}</p>
{%- endfor %}
{%- if command %}
<p>{{ command[0] }}</p>
<pre>{{ command[1] }}</pre>
{%- endif %}
{%- for table in tables %}
<details{% if loop.first and first_open %} open="open"{% endif %}>
<summary>{{ table.title }}</summary>
<table>
<thead><tr>{% for column in table.columns %}<th>{{ column.header }}</th>{% endfor %}</tr></thead>
<tbody>
{%- for row in table.rows %}
<tr>{% for cell, column in row %}
<td style="text-align:{{ column.justify }};white-space:nowrap">{{ cell }}</td>{% endfor %}</tr>
{%- endfor %}
</tbody></table></details>
{%- endfor %}
{%- for what, lines in folded %}
<details><summary>{{ what }}</summary>
{%- for line in lines %}
<p>{{ line }}</p>
{%- endfor %}
</details>
{%- endfor %}</div>
"""


class ProgressLine:
    """How far a step is, on one line that is written over: below its cell in a notebook, else on
    stderr. It is given to what takes long: ``calib.fit(["rec"], "run", progress=ProgressLine())``.
    """

    def __init__(self) -> None:
        self._next_s, self._cell = 0.0, None

    def __call__(self, what: str, done: int, total: int) -> None:
        """Tell that so many of a step are done, counted from 0."""
        now_s = time.monotonic()
        if now_s < self._next_s and done + 1 < total:
            return
        self._next_s = now_s + TOLD_EVERY_S
        line = escape.terminal(f"{what} {done + 1}/{total}")
        if "ipykernel" not in sys.modules:
            print(f"\r{line:<{TABLE_WIDTH - 1}}", end="", file=sys.stderr, flush=True)
        elif self._cell is None:
            from IPython.display import display

            self._cell = display({"text/plain": line}, raw=True, display_id=True)
        else:
            self._cell.update({"text/plain": line}, raw=True)


def run_html(run: Run) -> str:
    """A run: its error and what it is worth; folded, every link and effect with its sigma in mm and
    mrad, the errors, and what is not told."""
    rows = variable_estimates(run)
    effects = [row for row in rows if row.parent is None]
    tables = {"links": links_table([row for row in rows if row.parent is not None])}
    tables |= {"effects": effects_table(effects)} if effects else {}
    untold = [
        f"not identifiable: {each['name']}: {each['why']}" for each in run.solution.not_estimated
    ]
    first, *others = closing(run)
    moved = [moved_sentence(run.summary["links"])] if "links" in run.summary else []
    return _html(
        f"{run.folder}: {first}",
        [*moved, *run.warning, *others],
        {**tables, "errors": error_table(run.summary)},
        folded={f"not identifiable: {len(untold)}": untold} if untold else {},
    )


def run_text(run: Run) -> str:
    """A run in short: what moved, every link and effect with its sigma, and what matters."""
    file, rows = io.StringIO(), variable_estimates(run)
    console = terminal(file)
    for line in (str(run.folder), *run.warning, outcome(run.summary)):
        console.print(line)
    if "links" in run.summary:
        console.print(moved_sentence(run.summary["links"]))
    console.print()
    console.print(links_table([row for row in rows if row.parent is not None]))
    if effects := [row for row in rows if row.parent is None]:
        console.print(effects_table(effects))
    for line in closing(run):
        console.print(line)
    return _plain(file)


def moved_text(found: Moved) -> str:
    """What changed between two runs, as ``rigcal moved`` prints it."""
    file = io.StringIO()
    print_moved(found, terminal(file))
    return _plain(file)


def moved_html(found: Moved) -> str:
    """The same for a notebook."""
    from markupsafe import escape as in_html

    return f"<pre>{in_html(moved_text(found))}</pre>"


def _plain(file: io.StringIO) -> str:
    return "\n".join(line.rstrip() for line in file.getvalue().rstrip().splitlines())


def diagnosis_html(diagnosis: Diagnosis) -> str:
    """A diagnosis: the verdict, the finding, what is wrong in the recording and the command that
    leaves it out; folded, all other sentences and what may be missing."""
    tables = {}
    if diagnosis.blunders:
        tables["wrong in the recording"] = blunders_table(diagnosis.blunders)
    if diagnosis.candidates:
        found = candidates_table(diagnosis.candidates[:LEADING], "residual")
        tables["effects that the model lacks"] = found
    if diagnosis.unexplained:
        found = unexplained_table(diagnosis.unexplained[:LEADING], "residual")
        tables["structure that no effect explains"] = found
    if diagnosis.verdict == "adequate" and not diagnosis.too_few:
        tables["what would have been found"] = detectable_table(diagnosis.candidates)
    wrong = bool(diagnosis.blunders)
    lead = "Correct the recording, or leave this out:" if wrong else "Add it to the model:"
    return _html(
        f"verdict: {diagnosis.heading}",
        diagnosis.sentences[:1],
        tables,
        (lead, diagnosis.command) if diagnosis.command else None,
        {"all that was found": rest} if (rest := diagnosis.sentences[1:]) else {},
    )


def rung_html(rung: Rung) -> str:
    """A rung: what it changed of the model, and what that did to the errors."""
    return _html(str(rung.run.folder), rung.run.warning, {"errors": ladder_table([rung])})


def _html(
    title: str,
    sentences: Sequence[str],
    tables: Mapping[str, Table],
    command: tuple[str, str] | None = None,
    folded: Mapping[str, Sequence[str]] | None = None,
) -> str:
    """A card: its title and sentences, and below them tables, which open.

    Args:
        title: of the card.
        sentences: below it.
        tables: name -> each; of one alone, or below a command, the first is open.
        command: what it does, and the command.
        folded: what opens last: a heading, and its lines.
    """
    from jinja2 import Environment

    shown = (
        Environment(autoescape=True)
        .from_string(_PAGE)
        .render(
            title=title,
            sentences=sentences,
            command=command,
            tables=[_rows(name, table) for name, table in tables.items()],
            first_open=len(tables) == 1 or bool(command),
            folded=(folded or {}).items(),
        )
    )
    return escape.terminal(shown)


def _rows(name: str, table: Table) -> dict[str, Any]:
    """Title, columns and rows of a table of the terminal, without its empty rows."""
    rows = zip(*(list(column.cells) for column in table.columns), strict=True)
    filled = (row for row in rows if any(row))
    return {
        "title": table.title or name,
        "columns": table.columns,
        "rows": [list(zip(row, table.columns, strict=True)) for row in filled],
    }


Run._repr_html_, Rung._repr_html_ = run_html, rung_html
Diagnosis._repr_html_, Moved._repr_html_ = diagnosis_html, moved_html
Run.__str__, Moved.__str__ = run_text, moved_text
