"""What people read of a diagnosis, and of the ladder that explains a recording."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console
from rich.table import Table

from calib.diagnosis.suggest import with_ring
from calib.diagnosis.verdict.sentences import UNNAMED
from calib.runs.ladder import Rung, ladder
from calib.show.comparison import ladder_table
from calib.show.misfit import and_angle
from calib.show.tables import (
    columns_table,
    estimate_cell,
    mm,
    print_command,
    print_pairs,
    shown,
    small,
    terminal,
)

if TYPE_CHECKING:
    from calib.diagnosis import Diagnosis
    from calib.runs.explain import Explanation
    from calib.runs.run import Run

# Before the command that leaves out what is wrong. A blunder may be two columns or rows that are
# exchanged, which that looks for.
LEAVE_OUT = (
    "Correct the recording ('rigcal check' tells what seems mixed up in it), or leave this out:"
)
LEADING = 8  # candidates that are shown; diagnosis.json has all
WEAKEST = 4  # directions that are shown


def print_diagnosis(diagnosis: Diagnosis, residual: str = "range", whole: bool = False) -> None:
    """Print what is missing from a model: in sentences, then in tables.

    Args:
        diagnosis: what was found.
        residual: what its sizes are of, as a run's summary has it.
        whole: also what was tried and is not the answer, where a formula is.
    """
    console = terminal()
    _say_verdict(console, diagnosis)
    if diagnosis.verdict == UNNAMED and diagnosis.formulas and not whole:
        console.print("'rigcal -v diagnose' has the names that were tried, and all the rest.")
    else:
        _print_tables(console, diagnosis, residual)


def _print_tables(console: Console, diagnosis: Diagnosis, residual: str) -> None:
    adequate = diagnosis.verdict == "adequate" and not diagnosis.too_few
    if diagnosis.candidates and not adequate:
        console.print(candidates_table(diagnosis.candidates[:LEADING], residual))
    rivals = [(c["add"], c["indistinguishable_from"]) for c in diagnosis.candidates]
    tied = [(name, ", ".join(those)) for name, those in rivals if those]
    if tied:
        print_pairs(console, "not distinguishable on these data", tied)
    if diagnosis.plan:
        print_command(console, diagnosis.plan, "Stops that would tell more are planned by:")
    if diagnosis.unexplained:
        console.print(unexplained_table(diagnosis.unexplained[:LEADING], residual))
    if adequate:
        console.print(detectable_table(diagnosis.candidates))
    _print_untestable(console, diagnosis.untestable)
    _print_weak(console, diagnosis.weak_directions)
    _print_remedies(console, diagnosis)


def print_explanation(explanation: Explanation) -> None:
    """Print the rungs of a ladder, what was not worth adding and what is left; last, how far the
    ladder went and the verdict."""
    console, runs = terminal(), explanation.runs
    for run in runs:
        console.print(str(run.folder), style="bold", soft_wrap=True)
        for sentence in run.warning:
            console.print(sentence, style="bold red")
    console.print()
    console.print(ladder_table(ladder(runs) or [Rung(runs[0], None)]))
    if explanation.refused:
        names = ", ".join(dict.fromkeys(explanation.refused))
        console.print(f"Found, and not added, as the held-out error did not fall: {names}.")
    for path in explanation.kept:
        console.print(f"Kept for other recordings ('rigcal fit --effects'): {path}")
    console.print()
    _say_found(console, explanation.diagnosis, explanation.refused)
    for sentence in explanation.untold:
        console.print(sentence)
    last = runs[-1].summary
    kind = "held_out" if last["rms_mm"].get("held_out") is not None else "fit"
    what = {"held_out": "held-out error", "fit": "error of the fit, none held out"}[kind]
    errors = {"mm": "rms_mm", "mrad": "rms_mrad"}.items()
    ways = (f"{_way(runs, key, kind)} {unit}" for unit, key in errors if key in last)
    expected = and_angle(f"{last['rms_mm']['noise_floor']:.2f} mm", last, "noise_floor")
    way = f"{' and '.join(ways)}; {expected} expected if the model is right"
    console.print(f"{what}: {way}", style="bold")
    console.print(f"verdict: {explanation.diagnosis.heading}", style="bold")


def _way(runs: Sequence[Run], key: str, kind: str) -> str:
    """An error of the first run, and of the last if it is another."""
    return " -> ".join(f"{run.summary[key][kind]:.2f}" for run in (*runs[:1], *runs[1:][-1:]))


def _say_verdict(console: Console, diagnosis: Diagnosis) -> None:
    console.print(f"verdict: {diagnosis.heading}", style="bold")
    _say_found(console, diagnosis)


def _say_found(console: Console, diagnosis: Diagnosis, refused: Collection[str] = ()) -> None:
    """What a diagnosis found, and the command that it leads to, but to add what was refused."""
    for sentence in diagnosis.sentences:
        console.print(sentence)
    console.print()
    names = {*diagnosis.worth_adding, *diagnosis.formulas}
    if diagnosis.command and (diagnosis.blunders or names.isdisjoint(refused)):
        what = LEAVE_OUT if diagnosis.blunders else "Add it to the model:"
        print_command(console, diagnosis.command, what)


def candidates_table(candidates: Sequence[Mapping[str, Any]], residual: str) -> Table:
    """The leading candidates; those that were confirmed carry the number of their step."""
    table = columns_table("", "effect", "p", "explains", "held out", "would be")
    for column in table.columns[:5]:  # where it is narrow, the last one is broken into lines
        column.no_wrap = True
    for column in table.columns[2:5]:
        column.justify = "right"
    table.title = f"candidate effects; adjusted p, mm rms of {residual}"
    table.title_justify, table.title_style = "left", "bold"
    for each in candidates:
        table.add_row(
            str(each["step"] or ""),
            each["add"],
            small(each["p_adjusted"]),
            _size(each["unabsorbed_rms_mm"]),
            "\n".join(_fall(each)),
            _estimate(each["parameters"]),
        )
    table.add_row()
    return table


def _fall(candidate: Mapping[str, Any]) -> Iterator[str]:
    """How the held-out error falls, and that of orientations; a line each."""
    for unit in ("mm", "mrad"):
        ends = candidate.get(f"held_out_rms_{unit}") or {}  # earlier versions wrote no mrad
        if fall := " -> ".join(filter(None, (mm(ends.get(key)) for key in ("before", "after")))):
            yield fall if unit == "mm" else f"{fall} {unit}"


def unexplained_table(unexplained: Sequence[Mapping[str, Any]], residual: str) -> Table:
    """Structure that no effect accounts for, strongest first."""
    table = columns_table("residual structure over", "p", "mm", "to add it")
    for column in table.columns[1:3]:
        column.justify = "right"
    table.title = f"structure; adjusted p, mm rms of {residual}"
    table.title_justify, table.title_style = "left", "bold"
    for each in unexplained:
        formula = each["formula"]["name"] if each["formula"] else ""
        table.add_row(
            " x ".join(with_ring(each["covariates"], each.get("ring"))),
            small(each["p_adjusted"]),
            _size(each["rms_mm"]),
            formula,
        )
    table.add_row()
    return table


def detectable_table(candidates: Iterable[Mapping[str, Any]]) -> Table:
    """Of each effect the smallest size that would have been found, two effects abreast."""
    table = columns_table(*("effect", "found from") * 2)
    cells = []
    for each in sorted(candidates, key=lambda c: c["effect"]):
        size, units = each["smallest_detectable"], each["parameters"]["unit"].split(", ")
        scale, unit = shown(units[0])
        if len(set(units)) == 1 and size is not None and np.isfinite(size):
            cells.append((each["effect"], f"{scale * size:.2g} {unit}".rstrip()))
    half = (len(cells) + 1) // 2
    for left, right in zip(cells[:half], [*cells[half:], ("", "")], strict=False):
        table.add_row(*left, *right)
    table.add_row()
    return table


def _print_untestable(console: Console, untestable: Mapping[str, str]) -> None:
    """What could not be tested, by why."""
    names: dict[str, list[str]] = defaultdict(list)
    for name, why in untestable.items():
        names[why].append(name)
    if names:
        rows = [(why, ", ".join(those)) for why, those in names.items()]
        print_pairs(console, "what could not be tested", rows)


def _print_weak(console: Console, directions: Sequence[Mapping[str, Any]]) -> None:
    """What the data hardly determine, and what would."""
    rows = []
    for d in directions[:WEAKEST]:
        sigma = "" if d["sigma_mm"] is None else f" ± {d['sigma_mm']:.2f} mm"
        rows.append((f"{', '.join(d['parameters'])}{sigma}", d["needs"]))
    if rows:
        print_pairs(
            console, "weakly determined (angles as mm at 1 m), and what would determine it", rows
        )


def _print_remedies(console: Console, diagnosis: Diagnosis) -> None:
    """The commands that plan stops for what was just told; that of the first group stands there."""
    of = {"undistinguished": [], "weak_direction": [], "untestable": []}
    for remedy in diagnosis.remedies:
        of[remedy["of"]].append(remedy["plan"])
    tied, weak, untestable = of.values()
    every = (*tied, *weak[:WEAKEST], *untestable)
    if commands := [command for command in every if command and command != diagnosis.plan]:
        console.print("Commands that plan stops for each of these, if any can help:")
        for command in commands:
            console.print(command, style="bold", soft_wrap=True)
        console.print()


def _estimate(parameters: Mapping[str, Any]) -> str:
    """One parameter with its sigma, or the size of several, unit by unit."""
    units, names = parameters["unit"].split(", "), parameters["names"]
    estimate, sigma = (np.asarray(parameters[k], float) for k in ("estimate", "sigma"))
    if len(names) == 1:
        cell = estimate_cell(estimate[0], sigma[0], units[0])
        return f"{cell} {shown(units[0])[1]}".rstrip()
    units = units * len(names) if len(units) == 1 else units
    if len(units) != len(names):
        return ""
    parts = []
    for kind in dict.fromkeys(units):
        scale, unit = shown(kind)
        alike = scale * estimate[np.array(units) == kind]
        parts.append(f"{np.sqrt(np.mean(np.square(alike))):.2g} {unit}".rstrip())
    return f"{len(names)} of {', '.join(parts)} rms" if names else ""


def _size(size_mm: float | None) -> str:
    """A length in mm, however large; of what has none, nothing."""
    if size_mm is None:
        return ""
    return mm(size_mm) if size_mm < 1e4 else f"{size_mm:.0e}"
