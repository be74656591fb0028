"""Every group of rows that one mishap would spoil together, against what chance allows."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from calib.report import plots
from calib.report.chart import Absent, Chart
from calib.report.evidence import Evidence
from calib.residuals.groups import AT_STOPS, JOINTS, MESH, SCAN, kind_and_number
from calib.results.outstanding import times
from calib.show.misfit import furthest

if TYPE_CHECKING:
    from calib.report.plots import Figure

LEAST_DRAWN = 0.1  # of what chance allows: what is less is drawn there
MOST_NAMES = 5  # groups or stops that are named in a picture: more would hide each other
MOST_TICKS = 40  # stops whose names are written below
ONE_JOINT = "a single joint"
OTHERS = "others"
COLOURS = (plots.AFTER, plots.FLOOR, *plots.LINES[3:])


def groups(evidence: Evidence) -> Iterator[Chart | Absent]:
    """How far each group of rows is off, over the most that chance allows."""
    if evidence.diagnosis is None:
        yield Absent("groups", f"not diagnosed; 'rigcal diagnose {evidence.run.folder}' does it")
        return
    found = {g["token"]: (g["kind"], ratio(g)) for g in evidence.diagnosis["groups"]}
    if not found:
        yield Absent("groups", "there is no group of rows that others could contradict")
        return
    loud = sorted((t for t in found if found[t][1] > 1.0), key=lambda t: -found[t][1])
    worst = max(found, key=lambda t: found[t][1])
    stops = {stop: k for s in evidence.sources for k, stop in enumerate(s.recording.stops)}
    yield Chart(
        "groups",
        furthest(worst, found[worst][1], "chance allows", len(loud))
        if loud
        else f"Of {len(found)} groups of rows none is further off than chance allows; the furthest "
        f"is {worst}, at {times(found[worst][1])} of it",
        "How far each group of rows that one blunder would spoil is off from what all other rows "
        "predict, over the limit of the test, which is adjusted for all groups that are tested. "
        "Above the dashed line is a blunder; what the diagnosis left out is drawn as it was "
        "before. Small dots: single joints and, after the stops, targets, nominal values (cad) "
        "and parts of the mesh by their kind. Groups without redundancy cannot be tested and are "
        "not drawn.",
        lambda: _groups(found, loud, stops),
        wide=True,
        quiet=not loud,
        answer=True,
    )


def ratio(group: Mapping[str, Any]) -> float:
    """How far a group is off, over the most that chance allows: lengths, so roots of squares."""
    return float(np.sqrt(group["statistic"] / group["limit"]))


def _groups(
    found: Mapping[str, tuple[str, float]], loud: Sequence[str], stops: Mapping[str, int]
) -> Figure:
    column, series = _columns(found, stops), _series(found)
    figure, grid = plots.axes(plots.WIDE_IN, 3.4)
    ax = grid[0, 0]
    for i, (name, tokens) in enumerate(series.items()):
        minor = name in (ONE_JOINT, OTHERS)
        x = [column[_place(t)] for t in tokens]
        ax.plot(x, [max(found[t][1], LEAST_DRAWN) for t in tokens],
                "." if minor else "osD^v"[i % 5], ms=4 if minor else 5.5, alpha=0.85, label=name,
                color=plots.PALE if minor else COLOURS[i % len(COLOURS)],
                zorder=1 if minor else 2)  # fmt: skip
    for token in loud[:MOST_NAMES]:
        at, right = column[_place(token)], column[_place(token)] > 0.6 * len(column)
        ax.plot(at, found[token][1], "o", ms=12, mfc="none", mew=1.5, color=plots.BEFORE)
        ax.annotate(token, (at, found[token][1]), (-10 if right else 10, -3), fontsize=9,
                    textcoords="offset points", ha="right" if right else "left",
                    color=plots.BEFORE, fontweight="bold")  # fmt: skip
    high = max(2.0, 1.6 * max(x for _, x in found.values()))
    plots.log_axis(ax, LEAST_DRAWN, high, "y")
    ax.set_ylim(0.8 * LEAST_DRAWN, high)
    ax.axhline(1.0, color=plots.INK, linestyle="--", linewidth=0.8)
    names, step = list(column), -(-len(column) // MOST_TICKS)
    ax.set_xticks(range(0, len(names), step), names[::step], rotation=90, fontsize=8)
    ax.set_xlim(-0.7, len(names) - 0.3)
    ax.set_ylabel("off, over what chance allows")
    figure.legend(loc="outside upper left", ncols=6)
    return figure


def _place(token: str) -> str:
    """Where a group is: its stop or target, or `CAD`; of the mesh what kind of part it is."""
    where, _, what = token.rpartition(":")
    return kind_and_number(what)[0] if where == MESH else where


def _columns(found: Mapping[str, tuple[str, float]], stops: Mapping[str, int]) -> dict[str, int]:
    """Place -> its column: stops in their order, recording by recording, then all others, which
    have columns of their own."""
    at_stop = {_place(t): kind in AT_STOPS for t, (kind, _) in found.items()}

    def order(place: str) -> tuple[bool, str, int, str]:
        # Of several recordings, the name of each stands before a slash.
        recording, _, stop = place.rpartition("/")
        return not at_stop[place], recording, stops.get(stop, -1) if at_stop[place] else 0, place

    return {place: k for k, place in enumerate(sorted(at_stop, key=order))}


def _series(found: Mapping[str, tuple[str, float]]) -> dict[str, list[str]]:
    """What is drawn alike: each body, scans, joints; then what is drawn small."""
    out: dict[str, list[str]] = {}
    for token, (kind, _) in found.items():
        what = token.rpartition(":")[2]
        name = what if kind in AT_STOPS else OTHERS
        name = ONE_JOINT if kind == "joints" and what != JOINTS else name
        out.setdefault(name, []).append(token)
    last = (SCAN, JOINTS, ONE_JOINT, OTHERS)
    return dict(sorted(out.items(), key=lambda pair: pair[0] in last and last.index(pair[0]) + 1))
