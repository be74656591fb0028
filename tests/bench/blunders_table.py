"""How the mishaps fared: shares, a line for each kind, and every case that is wrong."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any

from rich.console import Console
from rich.table import Table

from ..mishaps import MISHAPS, TIMES
from ..mishaps.judge import matches

Result = dict[str, Any]
NOTHING = "nothing"
WRONG = 4.0  # sigmas from the truth
MOVED = 3.0  # sigmas of the good recording's fit, from where that was
SLOW = 2.0  # times as long as the good recording's fit

# Class of a case -> the letter that stands for it, from best to worst.
CLASSES = {
    "right": "R",  # named right
    "group": "G",  # named with what it cannot be told from
    "refused": "2",  # in one sentence
    "not converged": "N",
    "alarm": "a",  # not adequate, and none of the names is right
    "calm": ".",  # adequate, and rightly so
    "moved": "m",  # adequate, and an estimate moved, yet not so far from the truth
    "silent": "S",  # adequate, and an estimate is wrong; of a mishap: one that it moved
    "endless": "E",
    "fault": "F",
}


def named(result: Result) -> list[list[str]]:
    """What was named: blunders and effects, each with what it may be taken for, and covariates."""
    rivals = result.get("rivals", {})
    return [*result["blunders"], *([name, *rivals.get(name, ())] for name in result["names"])]


def verdict(result: Result) -> str:
    """The class of a case.

    What is said of the good recording as well is no word on the mishap. What does no harm may be
    named beside a model that is adequate.
    """
    outcome, right = result["outcome"], result["right"]
    before = result["without_it"]
    if before and outcome == before["outcome"] and not result["blunders"]:
        outcome = "adequate" if set(result["names"]) <= set(before["names"]) else outcome
    if outcome in ("refused", "endless", "fault"):
        return outcome
    found = named(result)
    if outcome != "adequate" and found:
        if matches(found[0][0], right):
            return "right"
        if matches(found[0][0], result["group"]) or any(matches(n, right) for n in found[0]):
            return "group"
    if outcome == "adequate" and any(matches(note, right) for note in result.get("notes", ())):
        return "right"
    if outcome == "not converged":
        return outcome
    if outcome != "adequate":
        return "alarm"
    moved = result["moved"] > MOVED
    if result["told_off"] > WRONG and (moved or not before):
        return "silent"
    return "moved" if moved else "calm"


def false_names(result: Result) -> list[str]:
    """Blunders that were named, and are neither right nor in the group."""
    known = [*result["right"], *result["group"]]
    return [first for first, *rest in result["blunders"] if not matches(first, known)]


def usual_seconds(results: Iterable[Result]) -> dict[str, float]:
    """Rig -> seconds that a fit of a good recording takes at most."""
    out: dict[str, float] = {}
    for r in results:
        if r["kind"] == NOTHING and len(r["seconds"]) > 1:
            out[r["rig"]] = max(out.get(r["rig"], 0.0), r["seconds"][1])
    return out


def show(results: Sequence[Result], console: Console | None = None) -> None:
    """Print all tables."""
    console = console or Console(width=150)
    failed = [r for r in results if "error" in r]
    good = [r for r in results if "error" not in r]
    usual = usual_seconds(good)
    console.print(_shares(good, usual))
    console.print(_rigs(good, usual))
    console.print(_kinds(good))
    for title, which in (("SILENTLY WRONG", "silent"), ("FAULTS", "fault"), ("ENDLESS", "endless")):
        for r in (r for r in good if verdict(r) == which):
            console.print(f"{title}: {r['case']}: {_why(r)}", markup=False)
    for r in (r for r in good if verdict(r) == "moved"):
        said = f"the good recording's diagnosis says up to {r['could_move']:.1f}, unseen"
        console.print(f"MOVED: {r['case']}: by {r['moved']:.1f} sigma; {said}", markup=False)
    for r in (r for r in good if false_names(r)):
        console.print(f"FALSE NAMES: {r['case']}: {', '.join(false_names(r))}", markup=False)
    for r in failed:
        console.print(f"FAILED: {r['case']}: {r['error'].splitlines()[-1]}", markup=False)


def _why(r: Result) -> str:
    off = ", ".join(f"{n} {z:.1f} sigma" for n, z, told in r["off"] if told and z > WRONG)
    said = "; ".join([r["sentence"], *r["odd"]])
    return f"{off} {said}".strip()[:300]


HEAD = ("cases", *CLASSES, "false names", f"over {SLOW:g}x time")


def _line(results: Sequence[Result], usual: dict[str, float]) -> list[str]:
    count = Counter(map(verdict, results))
    slow = [
        r
        for r in results
        if len(r["seconds"]) > 1 and r["seconds"][1] > 1 + SLOW * usual.get(r["rig"], 1e9)
    ]
    false = sum(bool(false_names(r)) for r in results)
    numbers = [len(results), *(count[name] for name in CLASSES), false, len(slow)]
    return [str(n) if n else "." for n in numbers]


def _table(title: str, *first: str) -> Table:
    out = Table(title=title, box=None, header_style="bold", title_justify="left")
    for name in first:
        out.add_column(name, no_wrap=True)
    return out


def _shares(results: Sequence[Result], usual: dict[str, float]) -> Table:
    """By size: sized kinds, those that are there or not, and harmless ones."""
    out = _table("by size, in times the detectable", "mishaps", *HEAD, "share named")
    of = {r["case"]: MISHAPS.get(r["kind"]) for r in results}
    rows = {"nothing wrong": [r for r in results if r["kind"] == NOTHING]}
    for times in TIMES:
        rows[f"with a size, x{times}"] = [
            r
            for r in results
            if of[r["case"]] and of[r["case"]].sized and r["times"] == times and r["right"]
        ]
    rows["gross, with a name"] = [
        r for r in results if of[r["case"]] and not of[r["case"]].sized and r["right"]
    ]
    rows["without a name"] = [
        r for r in results if of[r["case"]] and not r["right"] and not of[r["case"]].harmless
    ]
    rows["harmless"] = [r for r in results if of[r["case"]] and of[r["case"]].harmless]
    for what, each in rows.items():
        named = sum(verdict(r) in ("right", "group", "refused") for r in each)
        out.add_row(what, *_line(each, usual), f"{named / max(len(each), 1):.2f}")
    return out


def _rigs(results: Sequence[Result], usual: dict[str, float]) -> Table:
    out = _table("by rig", "rig", *HEAD)
    for rig in dict.fromkeys(r["rig"] for r in results):
        for what, null in (("nothing", True), ("mishaps", False)):
            each = [r for r in results if r["rig"] == rig and (r["kind"] == NOTHING) is null]
            out.add_row(f"{rig}: {what}", *_line(each, usual))
    return out


def _kinds(results: Sequence[Result]) -> Table:
    """A letter for each case: one word a rig, its sizes in order."""
    rigs = list(dict.fromkeys(r["rig"] for r in results))
    legend = ", ".join(f"{letter} {name}" for name, letter in CLASSES.items())
    out = _table(f"by kind: {legend}", "kind", *rigs)
    for kind in dict.fromkeys(r["kind"] for r in results if r["kind"] != NOTHING):
        cells = []
        for rig in rigs:
            each = [r for r in results if r["kind"] == kind and r["rig"] == rig]
            each.sort(key=lambda r: r["times"])
            cells.append("".join(CLASSES[verdict(r)] for r in each))
        out.add_row(kind, *cells)
    return out
