"""What Python shows of results: the tables of the terminal, as HTML in a notebook and as text.

Importing this gives runs, rungs and diagnoses their `_repr_html_`, and what is printed its
`__str__`: results know nothing of how they are shown. `calib.report.methods` imports it.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
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
from calib.show.tables import effects_table, error_table, links_table, outcome, terminal
from chains import escape

if TYPE_CHECKING:
    from rich.table import Table

_PAGE = """\
<div><p><b>{{ title }}</b></p>
{%- for sentence in sentences %}
<p>{{ sentence }}</p>
{%- endfor %}
{%- if command %}
<p>Mend it in the recording; or leave it out:</p>
<pre>{{ command }}</pre>
{%- endif %}
{%- for table in tables %}
<table>
{%- if table.title %}<caption>{{ table.title }}</caption>{% endif %}
<thead><tr>{% for column in table.columns %}<th>{{ column.header }}</th>{% endfor %}</tr></thead>
<tbody>
{%- for row in table.rows %}
<tr>{% for cell, column in row %}
<td style="text-align:{{ column.justify }};white-space:nowrap">{{ cell }}</td>{% endfor %}</tr>
{%- endfor %}
</tbody></table>
{%- endfor %}</div>
"""


def run_html(run: Run) -> str:
    """A run: every link and effect with its sigma in mm and mrad, the errors, what is not told."""
    rows = variable_estimates(run)
    effects = [row for row in rows if row.parent is None]
    tables = [links_table([row for row in rows if row.parent is not None])]
    tables += [effects_table(effects)] if effects else []
    untold = [f"not told: {each['name']}: {each['why']}" for each in run.solution.not_estimated]
    return _html(str(run.folder), [*run.warning, *untold], [*tables, error_table(run.summary)])


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


def _plain(file: io.StringIO) -> str:
    return "\n".join(line.rstrip() for line in file.getvalue().rstrip().splitlines())


def diagnosis_html(diagnosis: Diagnosis) -> str:
    """A diagnosis: the verdict, the sentences, what is wrong in the recording and the command that
    leaves it out, and what may be missing."""
    tables = [blunders_table(diagnosis.blunders)] if diagnosis.blunders else []
    if diagnosis.candidates:
        tables.append(candidates_table(diagnosis.candidates[:LEADING], "residual"))
    if diagnosis.unexplained:
        tables.append(unexplained_table(diagnosis.unexplained[:LEADING], "residual"))
    if diagnosis.verdict == "adequate" and not diagnosis.too_few:
        tables.append(detectable_table(diagnosis.candidates))
    title = f"verdict: {diagnosis.heading}"
    return _html(title, diagnosis.sentences, tables, diagnosis.command)


def rung_html(rung: Rung) -> str:
    """A rung: what it changed of the model, and what that did to the errors."""
    return _html(str(rung.run.folder), rung.run.warning, [ladder_table([rung])])


def _html(title: str, sentences: Sequence[str], tables: Sequence[Table], command: str = "") -> str:
    from jinja2 import Environment

    page, rows = Environment(autoescape=True).from_string(_PAGE), [_rows(t) for t in tables]
    shown = page.render(title=title, sentences=sentences, command=command, tables=rows)
    return escape.terminal(shown)


def _rows(table: Table) -> dict[str, Any]:
    """Title, columns and rows of a table of the terminal, without its empty rows."""
    rows = zip(*(list(column.cells) for column in table.columns), strict=True)
    filled = (row for row in rows if any(row))
    return {
        "title": table.title,
        "columns": table.columns,
        "rows": [list(zip(row, table.columns, strict=True)) for row in filled],
    }


for _kind, _html_of in ((Run, run_html), (Rung, rung_html), (Diagnosis, diagnosis_html)):
    _kind._repr_html_ = _html_of
Run.__str__, Moved.__str__ = run_text, moved_text
