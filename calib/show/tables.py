"""What people read in a terminal: tables in mm and mrad, at most 80 columns wide."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from typing import IO, TYPE_CHECKING, Any

import numpy as np
from rich.console import Console
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from calib.blunders.chance import LEAST_P
from calib.diagnosis.suggest import span
from calib.effects import CATALOGUE
from calib.results.outstanding import shown, standing_out
from calib.rig.suspect import listed
from calib.runs.estimates import VariableEstimate, variable_estimates
from calib.show.headline import MOVED_WORDS, Words, by_what_became, closing, moved_sentence
from calib.show.misfit import beams_told, misfit_warnings
from chains import escape

if TYPE_CHECKING:
    from calib.effects import Effect
    from calib.results.check import Check
    from calib.runs.run import Run

TABLE_WIDTH = 80
MOST_DIGITS = 6  # after the point
LISTED_PARAMETERS = 12  # an effect of more parameters than these is summarised
ERROR_LABELS = {
    "nominal": "all as in CAD",
    "fit": "after the fit",
    "held_out": "of stops held out",
    "noise_floor": "expected if the model is right",
}


def print_check(check: Check, whole: bool = False) -> None:
    """Print what a recording holds, what is wrong, and what can be estimated from it.

    Args:
        check: of a recording.
        whole: also what each parameter that is not identifiable is tied to.
    """
    console = terminal()
    print_pairs(console, "what is there", check.contents)
    if check.problems:
        console.print("what is wrong", style="bold")
        for problem in check.problems:  # paths whole, ready to be copied
            console.print(f"  {problem}", soft_wrap=True)
        console.print()
    if check.odd:
        print_pairs(console, "what is worth a look", [("", sentence) for sentence in check.odd])
    if check.command:
        print_command(console, check.command)
    print_pairs(console, "what can be estimated", [("", line) for line in check.can or ["nothing"]])
    if whole:
        _print_reasons(console, "what cannot", check.cannot)
    else:
        _print_untold(console, "what cannot", check.cannot, "check")


def print_command(
    console: Console, command: str, what: str = "Correct the recording, or leave this out:"
) -> None:
    """Print a command in one line, ready to be pasted, and what it does."""
    console.print(what)
    console.print(command, style="bold", soft_wrap=True)
    console.print()


def print_run(run: Run, whole: bool = False) -> None:
    """Print a run: what moved since an earlier one, every link and effect with its sigma, what was
    not told, the errors, and last what matters.

    Args:
        run: a run that has just been fitted.
        whole: also what each parameter that was not told is tied to.
    """
    console, rows = terminal(), variable_estimates(run)
    summary = run.summary
    console.print(str(run.folder), style="bold", soft_wrap=True)
    for sentence in run.warning:
        console.print(sentence, style="bold red")
    console.print(f"{outcome(summary)}\n")
    if "links" in summary:
        print_links(console, summary["links"])
    console.print(links_table([row for row in rows if row.parent is not None]))
    effects = [row for row in rows if row.parent is None]
    if effects:
        console.print(effects_table(effects))
    formulas = (e for e in run.model["effects"] if isinstance(e, Mapping))
    if own := [(str(e["name"]), str(e["what"])) for e in formulas if "what" in e]:
        print_pairs(console, "effects of your own", own)
    if whole:
        _print_reasons(console, "not identifiable", run.solution.not_estimated)
    else:
        _print_untold(console, "not identifiable", run.solution.not_estimated, "fit")
    console.print(error_table(summary))
    if told := beams_told(summary):
        print_pairs(console, "of how many beams", [("", line) for line in told])
    if up := summary.get("up"):
        zeros = [("", zero["told"]) for zero in summary.get("level_zeros", ())]
        print_pairs(console, "which way is up", [("", up["told"]), *zeros])
    if predicted := summary.get("predicted_mm"):
        print_pairs(console, "how well the arm is known", [("", t) for t in predicted["told"]])
    if told := standing_out(summary):
        print_pairs(console, "what does not fit", [("", line) for line in told])
    for warning in misfit_warnings(summary):
        console.print(warning, style="bold")
        console.print()
    *lines, command = closing(run)
    for line in lines:
        console.print(line, style="bold")
    console.print(command, style="bold", soft_wrap=True)


def effect_page(effect: Effect) -> dict[str, Any]:
    """The catalogue's page of an effect."""
    what, _, notes = (effect.__doc__ or "").replace("``", "").partition("\n\n")
    return {
        "name": effect.name,
        "what": " ".join(what.split()),
        "notes": " ".join(notes.split()),
        "site": effect.site.value,
        "formula": effect.formula,
        "shape": f"{effect.shape_name}, {effect.shape:g}" if effect.shape_name else "",
        "unit": effect.unit,
        "typical": effect.typical,
        "covariates": list(effect.covariates),
        "seen": " and ".join(span(name, *ends) for name, ends in effect.seen.items()),
        "confounded_with": list(effect.confounded_with),
        "source": effect.source,
    }


def print_catalogue(effects: Sequence[Effect], whole: bool) -> None:
    """Print the catalogue as a list, or the whole page of each effect."""
    console, pages = terminal(), [effect_page(effect) for effect in effects]
    if whole:
        known = {effect.family for effect in CATALOGUE}
        for effect, page in zip(effects, pages, strict=True):
            for several in ("confounded_with", "covariates"):
                page[several] = ", ".join(page[several])
            name = page.pop("name")
            print_pairs(
                console, name, [(k.replace("_", " "), text) for k, text in page.items() if text]
            )
            if effect.family in known:  # one's own may be of a joint or body that no other rig has
                print_command(console, f"rigcal effects {name} -o {name}.svg", "A picture of it:")
        return
    table = columns_table("effect", "what")
    table.columns[0].min_width = max(len(page["name"]) for page in pages)
    table.columns[1].no_wrap, table.columns[1].overflow = True, "ellipsis"
    for page in pages:
        table.add_row(page["name"], re.split("[:;.]( |$)", page["what"])[0])
    console.print(table)
    console.print("\n'rigcal effects NAME' has formula, unit, size, rivals and source of one.")


# ---------------------------------------------------------------------------------------- numbers


def estimate_cell(estimate: float, sigma: float, unit: str) -> str:
    """An estimate and its sigma in the unit shown, as ``+1.234 ± 0.056``."""
    if sigma == 0.0:
        return "held"
    value, spread = estimate_texts(estimate, sigma, unit)
    return f"{value} ± {spread}".lstrip()


def estimate_texts(estimate: float, sigma: float, unit: str) -> tuple[str, str]:
    """An estimate and its sigma in the unit shown, both to as many digits as the sigma lets matter;
    an estimate of NaN is no text."""
    scale, _ = shown(unit)
    sigma = scale * sigma
    digits = 2 if sigma >= 0.095 else 3
    if scale == 1.0 or "/" in unit:  # of any size: two digits of the sigma
        digits = max(1 - int(np.floor(np.log10(sigma))), 0) if 0.0 < sigma < np.inf else 2
    if digits <= MOST_DIGITS:
        spread, value = f"{sigma:.{digits}f}", f"{scale * estimate:+z.{digits}f}"
    else:
        spread, value = f"{sigma:.1e}", f"{round(scale * estimate, digits):+.3g}"
    return "" if np.isnan(estimate) else value, spread


def mm(value: float | None, sign: str = "") -> str:
    """A length in mm, or an angle in mrad, that may be missing."""
    return "" if value is None else f"{value:{sign}z.2f}"


# ----------------------------------------------------------------------------------------- tables


class _Terminal(Console):
    """All text passes here on its way to a terminal, cells of tables too."""

    def render_str(self, text: str, **options: Any) -> Text:
        return super().render_str(escape.terminal(text), **options)


def terminal(file: IO[str] | None = None) -> Console:
    """Where people read: at most `TABLE_WIDTH` columns wide, and as wide where nobody looks; stdout
    where no file is given."""
    # In a notebook rich would colour a text for a file, and show it beside.
    console = _Terminal(
        file=file,
        markup=False,
        highlight=False,
        emoji=False,
        force_jupyter=False,
        force_terminal=file.isatty() if file else None,
    )
    console.width = min(console.width, TABLE_WIDTH) if console.is_terminal else TABLE_WIDTH
    return console


def columns_table(*columns: str) -> Table:
    """An empty table with these headings."""
    table = Table(box=None, padding=(0, 2, 0, 0), header_style="bold", pad_edge=False)
    for column in columns:
        table.add_column(column)
    return table


def print_pairs(console: Console, title: str, rows: Iterable[tuple[str, str]]) -> None:
    """Print names and what is to be said of each, below a title."""
    console.print(title, style="bold")
    table = columns_table("", "")
    table.show_header = False
    for name, text in rows:
        table.add_row(name, text)
    console.print(Padding(table, (0, 0, 1, 2)))


def links_table(rows: Sequence[VariableEstimate]) -> Table:
    """How far every frame lies from CAD, in its own axes, mm and mrad."""
    table = columns_table("from CAD, own axes", "x", "y", "z", "", "confounded")
    for row in rows:
        for part, unit in ((slice(3, 6), "m"), (slice(0, 3), "rad")):
            cells = map(estimate_cell, row.estimate[part], row.sigma[part], (unit,) * 3)
            untold = " ".join(np.array(["x", "y", "z"])[~row.told[part]])
            label = row.variable if unit == "m" else f"  on {row.parent}"
            table.add_row(label, *cells, shown(unit)[1], untold)
    table.add_row()
    return table


def effects_table(rows: Sequence[VariableEstimate]) -> Table:
    """Every parameter of every effect; of one with many, a summary."""
    table = columns_table("effect", "parameter", "estimate", "", "")
    for row in rows:
        name = row.variable
        for parameter, cell, unit, told in effect_cells(row):
            table.add_row(name, parameter, cell, unit, "" if told else "confounded")
            name = ""
    table.add_row()
    return table


def effect_cells(row: VariableEstimate) -> Iterable[tuple[str, str, str, bool]]:
    """Parameter, its cell, unit and whether it was told: one by one, or of each unit a summary; and
    the shape, whose name ends with its unit."""
    if row.shape is not None:
        name, _, unit = row.shape.name.rpartition("_")
        value, spread = estimate_texts(row.shape.value, row.shape.sigma, unit)
        yield name, f"{value.lstrip('+')} ± {spread}", shown(unit)[1], True
    if len(row.parameters) > LISTED_PARAMETERS:
        for unit in dict.fromkeys(row.units):
            free = (row.sigma > 0) & (np.array(row.units) == unit)
            cells = _summary_cell(row, free, unit)
            yield f"{free.sum()} values", *cells, bool(row.told[free].all())
        return
    for parameter, unit, *numbers, told in zip(
        row.parameters, row.units, row.estimate, row.sigma, row.told, strict=True
    ):
        if numbers[1]:
            yield parameter, estimate_cell(*numbers, unit), shown(unit)[1], told


def _summary_cell(row: VariableEstimate, free: np.ndarray, unit: str) -> tuple[str, str]:
    scale, unit = shown(unit)
    values = scale * row.estimate[free]
    if not len(values):
        return "held", unit
    digits = ".2f" if scale != 1.0 else ".3g"
    return (
        f"mean {values.mean():+{digits}}, {values.min():+{digits}} to {values.max():+{digits}}, "
        f"each ± {scale * np.median(row.sigma[free]):.2g}"
    ), unit


def error_table(summary: Mapping[str, Any]) -> Table:
    """The errors of a run's summary: before, after, of stops held out; and what is expected."""
    angles = {"orientation, mrad": summary["rms_mrad"]} if "rms_mrad" in summary else {}
    table = columns_table(f"{summary['residual']} residual, mm", "rms", "mean", "std", *angles)
    for column in table.columns[1:]:
        column.justify = "right"
    for kind, label in ERROR_LABELS.items():
        rms, mean, std = (summary[error].get(kind) for error in ("rms_mm", "mean_mm", "std_mm"))
        if rms is not None:
            turned = (mm(each.get(kind)) for each in angles.values())
            table.add_row(label, mm(rms), mm(mean, "+"), mm(std), *turned)
    table.add_row()
    return table


def print_links(
    console: Console, links: Sequence[Mapping[str, Any]], words: Words = MOVED_WORDS
) -> None:
    """Print what has moved since an earlier run, and what has not."""
    console.print(moved_sentence(links, words), style="bold")
    console.print()
    moved, still, _ = by_what_became(links)
    if moved:
        rows = [(link["name"], f"{_change(link)}; {chance(link['p_value'])}") for link in moved]
        print_pairs(console, words.title, rows)
    if still:
        rows = [(link["name"], f"{chance(link['p_value'])}{_seen_from(link)}") for link in still]
        print_pairs(console, words.title_of_none, rows)


def _seen_from(link: Mapping[str, Any]) -> str:
    """From what size on a move of a link at rest is seen, of its best and its worst parameter in
    each unit; of which it never is, and of which one that CAD has hardly is."""
    texts, known = [], list(zip(link.get("told_from", ()), link["units"], strict=False))
    for scale, unit in map(shown, dict.fromkeys(unit for _, unit in known)):
        each = [scale * least for least, u in known if shown(u)[1] == unit and least]
        if each:
            best, worst = (f"{float(f'{x:.2g}'):g}" for x in (min(each), max(each)))
            rest = "" if best == worst else f" (at worst {worst})"
            texts.append(f"{best} {unit}".rstrip() + rest)
    never = [n for n, (least, _) in zip(link["parameters"], known, strict=False) if not least]
    said = {"; seen from ": " and ".join(texts[::-1]), "; never in ": listed(never)}
    said["; hardly checked: "] = listed(link.get("unchecked", ()))
    return "".join(what + names for what, names in said.items() if names)


def _change(link: Mapping[str, Any]) -> str:
    """By how much a link moved: lengths and angles, parameter by parameter where they are few."""
    texts = []
    for unit in dict.fromkeys(link["units"]):
        mine = [i for i, u in enumerate(link["units"]) if u == unit]
        cells = [
            f"{link['parameters'][i]} {estimate_cell(link['change'][i], link['sigma'][i], unit)}"
            for i in mine
        ]
        if link.get("of_mean"):
            cells = [f"{len(mine)} values alike, by {estimate_cell(*link['of_mean'], unit)}"]
        elif len(mine) > LISTED_PARAMETERS:
            rms = np.sqrt(np.mean(np.square([link["change"][i] for i in mine])))
            cells = [f"{len(mine)} values by {shown(unit)[0] * rms:.2f} rms"]
        texts.append(f"{', '.join(cells)} {shown(unit)[1]}".rstrip())
    return "; ".join(texts[::-1])


def chance(p: float) -> str:
    """A p-value as people read it."""
    return f"p {small(p)}" if p <= LEAST_P else f"p = {small(p)}"


def small(p: float) -> str:
    """A p-value in a table."""
    return f"{p:.2g}" if p > LEAST_P else f"< {LEAST_P:.0e}"


def _print_reasons(console: Console, title: str, entries: Sequence[Mapping[str, str]]) -> None:
    """Names and why, entries with the same explanation after the colon together."""
    groups: dict[str, list[tuple[str, str]]] = defaultdict(list)
    for entry in entries:
        tied, colon, why = entry["why"].partition(": ")
        groups[why if colon else tied].append((entry["name"], tied if colon else ""))
    for why, rows in groups.items():
        print_pairs(console, f"{title}: {why}", rows)


def _print_untold(
    console: Console, title: str, entries: Sequence[Mapping[str, str]], command: str
) -> None:
    """Names of what was not told, those that are tied to others together, whatever to."""
    tied = [entry["name"] for entry in entries if ": " in entry["why"]]
    if tied:
        why = f"determined only in combination with others; 'rigcal -v {command}' names these"
        print_pairs(console, f"{title}: {why}", [("", ", ".join(tied))])
    _print_reasons(console, title, [each for each in entries if ": " not in each["why"]])


def outcome(summary: Mapping[str, Any]) -> str:
    """How a fit went, in a line."""
    settled = "converged" if summary["converged"] else "NOT CONVERGED"
    points = f"{summary['points']} points at " if summary["points"] else ""
    scans = summary.get("scans", 0)
    scanned = f", scans at {scans} of them" if 0 < scans < summary["stops"] else ""
    passes = f"{settled} in {summary['iterations']} passes, {summary['seconds']:.0f} s"
    return f"{points}{summary['stops']} stops{scanned}; {passes}"
