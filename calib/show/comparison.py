"""Runs side by side in a terminal, and the ladder by which they grew: ``rigcal compare``; what
changed between two: ``rigcal moved``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from calib.results.outstanding import moves, shown, things
from calib.runs.asked.moved import SHARED, Moved
from calib.runs.estimates import comparison
from calib.runs.ladder import DESCRIBED, FORMULA, Rung, ladder
from calib.show.headline import DIFFERS, MOVED_WORDS, Words, moved_sentence
from calib.show.misfit import worst_of
from calib.show.tables import (
    ERROR_LABELS,
    LISTED_PARAMETERS,
    columns_table,
    estimate_cell,
    mm,
    outcome,
    print_links,
    terminal,
)

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from calib.runs.run import Run

ABREAST = 3  # runs in one table
STACKED = 4  # names in a cell


def print_comparison(runs: Sequence[Run]) -> None:
    """Print the ladder of a study, and errors and parameters of runs side by side."""
    console = terminal()
    for run in runs:
        console.print(str(run.folder), style="bold", soft_wrap=True)
        for sentence in run.warning:
            console.print(sentence, style="bold red")
        console.print(f"{_model(run)}; {outcome(run.summary)}")
    if rungs := ladder(runs):
        console.print()
        console.print(ladder_table(rungs))
    for start in range(0, len(runs), ABREAST):
        console.print()
        console.print(_comparison_table(runs[start : start + ABREAST]))


def moved_document(found: Moved) -> dict[str, Any]:
    """What changed between two runs, as ``rigcal moved --json`` gives it."""
    return found.document() | {"sentence": moved_sentence(found.links, _words(found))}


def print_moved(found: Moved, console: Console | None = None) -> None:
    """Print what changed between two runs: the sentence, the links, and how the two go together; on
    the terminal where no console is given."""
    console = console or terminal()
    for run in found.runs:
        for sentence in run.doubts:
            console.print(f"{run.folder}: {sentence}", style="bold red", soft_wrap=True)
    print_links(console, found.links, _words(found))
    for remark in found.remarks:
        console.print(f"{remark}.")


def _words(found: Moved) -> Words:
    return DIFFERS if found.relation == SHARED else MOVED_WORDS


def ladder_table(rungs: Sequence[Rung]) -> Table:
    """What each rung changed of the model, and what that did to the error of stops held out."""
    turned = any(rung.run.summary.get("rms_mrad") for rung in rungs)
    more = ["held out, mrad"] if turned else []
    table = columns_table("ladder", "model", "held out, mm", "fit, mm", "expected, mm", *more)
    for column in table.columns[2:]:
        column.justify = "right"
    table.columns[1].overflow = "fold"  # names are there to be copied
    for rung in rungs:
        rms = rung.run.summary["rms_mm"]
        name = rung.run.folder.name or str(rung.run.folder)
        own = mm(rms["fit"]), mm(rms["noise_floor"])
        angles = [_held_out(rung, "rms_mrad")] if turned else []
        table.add_row(name, rung.step, _held_out(rung, "rms_mm"), *own, *angles)
    if any(rung.empirical for rung in rungs):
        table.caption = f"{DESCRIBED} {FORMULA}"
        table.caption_justify, table.caption_style = "left", ""
    return table


def _held_out(rung: Rung, key: str) -> str:
    """The held-out error of the rung below, and its own."""
    runs = [rung.below, rung.run] if rung.below else [rung.run]
    every = (mm((run.summary.get(key) or {}).get("held_out")) for run in runs)
    return " -> ".join(filter(None, every))


def _comparison_table(runs: Sequence[Run]) -> Table:
    compared = comparison(runs)
    table = columns_table("", "", *(run.folder.name or str(run.folder) for run in runs))
    for error in ("rms_mm", "mean_mm", "std_mm", "rms_mrad"):
        for kind, label in ERROR_LABELS.items():
            values = compared[error].get(kind, ())
            if any(value is not None for value in values):
                cells = (mm(value, "+" if error == "mean_mm" else "") for value in values)
                name, unit = error.split("_")
                table.add_row(f"{name} {label}", unit, *cells)
    if not all(compared["converged"]):
        how = {True: "converged", False: "NOT CONVERGED"}
        table.add_row("the fit has", "", *(how[each] for each in compared["converged"]))
    for key in ("left_out", "set_aside"):
        if any(compared[key]):
            table.add_row(key.replace("_", " "), "", *map(_stacked, compared[key]))
    _add_misfit(table, runs, compared)
    for variable, parameters in compared["parameters"].items():
        if len(parameters) > LISTED_PARAMETERS:
            _add_spread(table, variable, list(parameters.values()))
            continue
        for name, entry in parameters.items():
            numbers = zip(entry["estimate"], entry["sigma"], strict=True)
            cells = ("" if s is None else estimate_cell(e, s, entry["unit"]) for e, s in numbers)
            table.add_row(f"{variable}.{name}", shown(entry["unit"])[1], *cells)
    return table


def _stacked(tokens: Sequence[str]) -> str:
    """Names below each other, and how many more there are."""
    more = [f"and {len(tokens) - STACKED} more"] if len(tokens) > STACKED else []
    return "\n".join([*tokens[:STACKED], *more])


def _add_misfit(table: Table, runs: Sequence[Run], compared: Mapping[str, Any]) -> None:
    """What was thrown out, and how large residuals are against their sigmas."""
    every, share = compared["rms_all_mm"], compared["rejected_share"]
    if any(x for x in share):
        table.add_row("rms after the fit, of all beams", "mm", *map(mm, every))
        cells = ("" if x is None else f"{100 * x:.1f}" for x in share)
        table.add_row("beams thrown out", "%", *cells)
    for kind, ratios in compared["misfit"].items():
        cells = ("" if x is None else f"{x:.2f}" for x in ratios)
        table.add_row(f"residuals over sigma, {kind}", "", *cells)
    labels = ("the largest of these, where", "furthest from CAD, in its sigmas")
    for label, cells in zip(labels, zip(*map(worst_of, runs), strict=True), strict=True):
        if any(cells):
            table.add_row(label, "", *cells)
    _add_worst(table, "residuals over sigma, {}", [things(run.summary) for run in runs])
    frames = [
        {name: move["move_sigmas"] for name, move in moves(run.summary).items() if "." not in name}
        for run in runs
    ]
    _add_worst(table, "from CAD in its sigmas, {}", frames)


def _add_worst(table: Table, label: str, found: Sequence[Mapping[str, float]]) -> None:
    """A row for each name, those first that are worst in any run; of many the worst."""
    most: dict[str, float] = {}
    for each in found:
        most |= {name: max(x, most.get(name, 0.0)) for name, x in each.items()}
    ranked = sorted(most, key=lambda name: -most[name])
    for name in ranked[:LISTED_PARAMETERS]:
        cells = (f"{each[name]:.2f}" if name in each else "" for each in found)
        table.add_row(label.format(name), "", *cells)
    if (more := len(ranked) - LISTED_PARAMETERS) > 0:
        table.add_row(f"and {more} more that are less", "", *("" for _ in found))


def _add_spread(table: Table, variable: str, entries: Sequence[Mapping[str, Any]]) -> None:
    """Mean and standard deviation, per run, over an effect's many parameters of each unit."""
    for kind in dict.fromkeys(entry["unit"] for entry in entries):
        scale, unit = shown(kind)
        alike = [entry["estimate"] for entry in entries if entry["unit"] == kind]
        estimates = np.array(alike, float).T
        for what, function in (("mean", np.mean), ("sd", np.std)):
            present = (each[~np.isnan(each)] for each in estimates)
            cells = (f"{scale * function(each):+.3g}" if len(each) else "" for each in present)
            table.add_row(f"{variable}, {what}", unit, *cells)


def _model(run: Run) -> str:
    model = run.model
    text = ", ".join(run.effects) or "no effects"
    text += f"; fixed {', '.join(model['fixed'])}" if model["fixed"] else ""
    return text + (f"; from {run.prior}" if run.prior else "")
