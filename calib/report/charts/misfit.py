"""Where the model does not fit: stop by stop, and by how far the geometry left its CAD values."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

from calib.report import plots
from calib.report.chart import Absent, Chart
from calib.report.charts.groups import MOST_NAMES, MOST_TICKS
from calib.report.evidence import Evidence
from calib.results.outstanding import (
    FAR_FROM_CAD,
    STANDS_OUT,
    groups,
    move_told,
    moves,
    of_stop,
    outstanding,
    things,
    times,
)
from calib.show.misfit import furthest

if TYPE_CHECKING:
    from calib.report.plots import Figure

MOST_BARS = 24  # moves that are drawn, the furthest
SHOWN_AT_LEAST = 0.2  # misfit: smaller ones are no news


def by_stop(evidence: Evidence) -> Iterator[Chart | Absent]:
    """Residuals over their sigmas: of every body at every stop, of its joints and its beams."""
    summary = evidence.run.summary
    stops = {s: of_stop(found) for s, found in summary["misfit_by"]["stop"].items()}
    found = {key: x for key, x in groups(summary).items() if not key.startswith("target ")}
    if not found:
        yield Absent("misfit", "no stop has residuals that anything checks")
        return
    loud = {key: x for key, x in outstanding(summary).items() if key in found}
    worst, most = next(iter((loud or found).items()))
    yield Chart(
        "misfit",
        furthest(worst, most, "its sigmas allow", len(loud))
        if loud
        else f"No stop stands out; the largest residuals, of {worst}, are {times(most)} times "
        f"their sigmas",
        f"How many times larger than their sigmas allow the residuals are, about 1 when all is "
        f"well: of each tracked body, of what the joints must misreport, and of the beams, stop "
        f"by stop. One dot above the dashed line ({STANDS_OUT:g}) is something that happened at "
        f"that stop; a whole row of dots there is a sigma too small, or an effect that is missing.",
        lambda: _by_stop(stops, loud),
        wide=True,
        quiet=most < STANDS_OUT,
    )


def _by_stop(stops: Mapping[str, Mapping[str, float]], loud: Mapping[str, float]) -> Figure:
    figure, grid = plots.axes(plots.WIDE_IN, 3.2)
    ax, names = grid[0, 0], list(stops)
    series = dict.fromkeys(name for found in stops.values() for name in found)
    for i, name in enumerate(series):
        at = [k for k, stop in enumerate(names) if name in stops[stop]]
        ratio = [stops[names[k]][name] for k in at]
        ax.plot(at, ratio, "osD^v"[i % 5], ms=5, color=plots.LINES[i % len(plots.LINES)],
                label=name, alpha=0.85)  # fmt: skip
    every = [(x, k, name) for k, s in enumerate(names) for name, x in stops[s].items()]
    for x, k, name in sorted(every, reverse=True):
        if f"{names[k]}, {name}" in list(loud)[:MOST_NAMES]:
            ax.annotate(f"{names[k]}, {name} {times(x)}", (k, x), (6, 3),
                        textcoords="offset points", fontsize=8)  # fmt: skip
    ax.axhline(STANDS_OUT, color=plots.INK, linestyle="--", linewidth=0.8)
    low, high = SHOWN_AT_LEAST, max(2 * STANDS_OUT, *(1.5 * x for x, _, _ in every))
    plots.log_axis(ax, low, high, "y")
    ax.set_ylim(low, high)
    ax.set_xlim(-0.7, len(names) - 0.3)
    step = -(-len(names) // MOST_TICKS)
    ax.set_xticks(range(0, len(names), step), names[::step], rotation=90, fontsize=8)
    ax.set_ylabel("residuals over their sigmas")
    figure.legend(loc="outside upper left", ncols=5)
    return figure


def by_thing(evidence: Evidence) -> Iterator[Chart | Absent]:
    """Residuals over their sigmas of every body and target, all of its rows together."""
    found, loud = things(evidence.run.summary), outstanding(evidence.run.summary)
    if not found:
        yield Absent("misfit-by", "nothing checks the rows of a body or a target")
        return
    worst, most = next(iter(found.items()))
    yield Chart(
        "misfit-by",
        f"Of bodies and targets {worst} has the largest residuals, {times(most)} times their "
        f"sigmas",
        "How many times larger than their sigmas allow the residuals are, of all stops together: "
        "about 1 (dashed) when all is well. Far beyond it, a body was not where rig.yaml says, or "
        "its sigma is too small.",
        lambda: _by_thing(dict(list(found.items())[:MOST_BARS])),
        quiet=most < STANDS_OUT and not loud,
    )


def _by_thing(found: Mapping[str, float]) -> Figure:
    figure, grid = plots.axes(plots.HALF_IN, 0.9 + 0.26 * len(found))
    ax = grid[0, 0]
    colours = [plots.BEFORE if x > STANDS_OUT else plots.AFTER for x in found.values()]
    bars = ax.barh(list(found), list(found.values()), height=0.6, color=colours)
    ax.bar_label(bars, [times(x) for x in found.values()], padding=3, fontsize=8)
    ax.axvline(1.0, color=plots.INK, linestyle="--", linewidth=0.8)
    ax.invert_yaxis()
    ax.margins(x=0.2)
    ax.grid(False, axis="y")
    ax.set_xlabel("residuals over their sigmas")
    return figure


def moves_from_cad(evidence: Evidence) -> Iterator[Chart | Absent]:
    """How far frames and parameters of the geometry moved, in sigmas of what was known of them."""
    found = moves(evidence.run.summary)
    if not found:
        yield Absent("moved", "no frame and no parameter of the geometry was estimated")
        return
    name, furthest = next(iter(found.items()))
    loud = sum(move["move_sigmas"] > FAR_FROM_CAD for move in found.values())
    told = move_told(name, furthest)
    yield Chart(
        "moved",
        f"{loud} of {len(found)} CAD values are further off than their sigmas allow, the furthest "
        f"{told}"
        if loud
        else f"CAD values agree with their sigmas; the furthest is {told}",
        "How far each frame (its parameter that moved most) and each parameter of the geometry "
        f"moved, in sigmas of its prior; the dashed line is {FAR_FROM_CAD:g}. Far "
        f"beyond it the value in rig.yaml or in the URDF is wrong, a sign or a unit say, or the "
        f"estimate is.",
        lambda: _moves(dict(list(found.items())[:MOST_BARS])),
        quiet=not loud,
    )


def _moves(found: Mapping[str, Mapping[str, Any]]) -> Figure:
    figure, grid = plots.axes(plots.HALF_IN, 0.9 + 0.26 * len(found))
    ax, sizes = grid[0, 0], [move["move_sigmas"] for move in found.values()]
    colours = [plots.BEFORE if x > FAR_FROM_CAD else plots.AFTER for x in sizes]
    bars = ax.barh(list(found), sizes, height=0.6, color=colours)
    texts = [move_told(name, move).partition(": ")[2].partition(" from")[0]
             for name, move in found.items()]  # fmt: skip
    ax.bar_label(bars, texts, padding=3, fontsize=8)
    ax.axvline(FAR_FROM_CAD, color=plots.INK, linestyle="--", linewidth=0.8)
    ax.invert_yaxis()
    ax.margins(x=0.2)
    ax.grid(False, axis="y")
    ax.set_xlabel("moved by, in sigmas of the prior")
    return figure
