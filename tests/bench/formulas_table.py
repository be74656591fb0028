"""Shares of what is right, by size, by number of covariates and by rig; and every miss."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

Result = dict[str, Any]
GOALS = {"covariates": 0.90, "at the floor": 0.90, "form": 0.70, "no formula": 0.95}


def form_right(result: Result) -> bool:
    """Whether what was added is the truth over the data's range."""
    return result.get("form", {}).get("right", False)


COLUMNS: dict[str, Callable[[Result], bool]] = {
    "covariates": lambda r: r["covariates_right"],
    "at the floor": lambda r: r["at_floor"],
    "form": form_right,
    "all three": lambda r: r["covariates_right"] and r["at_floor"] and form_right(r),
}


def groups(hidden: Sequence[Result]) -> Iterator[tuple[str, list[Result]]]:
    """All; then by size, number of covariates, rig, and whether stops scatter."""
    kinds: dict[str, Callable[[Result], str]] = {
        "size": lambda r: f"{r['times']:g} of a shot",
        "covariates": lambda r: (
            "two at once" if len(r["hidden"]) > 1 else f"{len(r['wanted'])} covariates"
        ),
        "rig": lambda r: r["rig"],
        "scatter": lambda r: f"stops scatter {r['scatter_mm']:g} mm",
    }
    yield "all", list(hidden)
    for key in kinds.values():
        for value in sorted({key(r) for r in hidden}):
            yield value, [r for r in hidden if key(r) == value]


def near(step: Result) -> bool:
    """Whether a held-out error is within a tenth of the floor."""
    return step["held_out_mm"] is not None and step["held_out_mm"] < 1.1 * step["floor_mm"]


def false(null: Result) -> bool:
    """Whether a formula was proposed where nothing is hidden."""
    return any(null["formulas"])


def show(results: Sequence[Result], console: Console | None = None) -> None:
    """Print the tables and every miss."""
    console = console or Console(width=150)
    good = [r for r in results if "error" not in r]
    known = [r for r in good if r["rig"] == "known"]
    hidden = [r for r in good if r["hidden"] and r["rig"] != "known"]
    nulls = [r for r in good if not r["hidden"]]
    if hidden:
        attainable = [r for r in hidden if r["oracle"] and near(r["oracle"])]
        console.print(f"{len(attainable)} of {len(hidden)} come to the floor with the truth itself")
        console.print(_shares(hidden))
    if nulls:
        count = sum(map(false, nulls))
        console.print(f"nulls: {len(nulls)}, a formula on {count} (goal: at most 5 %)")
    for r in known:
        console.print(_line(r), markup=False)
    missed = [r for r in hidden if not COLUMNS["all three"](r)]
    for r in (*missed, *filter(false, nulls)):
        console.print(_line(r), markup=False)
    for r in (r for r in results if "error" in r):
        console.print(f"FAILED: {r['case']}: {r['error'].splitlines()[-1]}", markup=False)


def _shares(hidden: Sequence[Result]) -> Table:
    goals = [f"{n} >= {GOALS[n]:.0%}" if n in GOALS else n for n in COLUMNS]
    table = Table("", "cases", *goals, "search/fit s, median, most", box=None)
    for name, some in groups(hidden):
        shares = [f"{np.mean([good(r) for r in some]):.2f}" for good in COLUMNS.values()]
        ratio = [r["search_s"][0] / r["fit_s"] for r in some if r["search_s"]]
        times = f"{np.median(ratio):.1f}, {max(ratio):.1f}" if ratio else ""
        table.add_row(name, str(len(some)), *shares, times)
    return table


def _blunders(r: Result) -> str:
    """What was taken for a blunder."""
    names = [name for some in r.get("blunders", []) for name, *_ in some]
    return f"blunders {', '.join(dict.fromkeys(names))} " if names else ""


def _line(r: Result) -> str:
    """What a case hid, and what was found of it."""
    said = [s or " | ".join(b)[:120] for s, b in zip(r["says"], r["basis"], strict=True)]
    marks = "".join(
        mark if good(r) else "-"
        for mark, good in zip("CHF", list(COLUMNS.values())[:3], strict=True)
    )
    errors = " ".join("?" if mm is None else f"{mm:.2f}" for mm in r["held_out_mm"])
    form = r.get("form", {})
    off = f"off {form['off_mm']:.2f} of {form['effect_mm']:.2f} mm" if form else ""
    floor = ", ".join(f"{mm:.2f}" for mm in r["floor_mm"][-1:])
    thrown = ", ".join(f"{x:.1%}" for x in r["rejected"][-1:])
    best = r.get("oracle", {})
    best = f" (with the truth {best['held_out_mm']:.2f}, {best['rejected']:.1%})" if best else ""
    return (
        f"{marks} {r['case']} {r['rig']} {r['lidar']}: {' + '.join(r['hidden']) or 'nothing'}\n"
        f"      found {r['found']} {'; '.join(said)} named {r['named']} {r['verdicts']} "
        f"{_blunders(r)}held out {errors} of {floor} mm, {thrown} left out{best} {off} "
        f"[{r['stopped']}]"
    )
