"""Stops over ring and azimuth: those held out, beside what the fit left of them; and all."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from calib.report import plots
from calib.report.chart import Absent, Chart
from calib.report.charts.residuals import NO_BEAMS
from calib.report.evidence import Evidence
from calib.report.statistics import StopMap, StopMaps
from calib.show.scale import round_up

if TYPE_CHECKING:
    from calib.report.plots import Figure

MOST_STOPS = 3  # that are drawn, the worst: as many as a screen holds in a row each
MAPS_IN_ROW = 4  # small maps in a row
FIRST_MAPS, PAGE_MAPS = 8, 24  # small maps that are shown, and in each figure that is folded
MOST_MAPS = 104  # small maps in all: more would make the page too heavy
NAME = 16  # letters of a stop's name that stand above a map
UNSEEN_IN_SCALE = 0.95  # of the cells of stops held out: those that lie inside the scale


def unseen(evidence: Evidence) -> Iterator[Chart | Absent]:
    """Mean residual over ring and azimuth, stop by stop: before, seen, and held out."""
    if not evidence.has_beams:
        yield Absent("unseen", NO_BEAMS)
        return
    if evidence.run.summary["rms_mm"].get("held_out") is None:
        yield Absent("unseen", "no stops were held out")
        return
    stops = evidence.unseen
    if not stops:
        yield Absent("unseen", "an earlier version did not keep what was held out; fit again")
        return
    worst = stops[0]
    _, seen_mm, unseen_mm = (1e3 * rms for rms in worst.rms_m)
    of = f"Of {len(stops)} stops held out {worst.name} is furthest off" if stops[1:] else worst.name
    yield Chart(
        "unseen",
        f"{of}: {unseen_mm:.2f} mm rms where the fit did not see it, {seen_mm:.2f} mm where it did",
        "A row per stop, the worst first, and all maps on one scale. Left to right: "
        f"{evidence.before}; in the fit of all stops; in a fit without it. Orange reads long, "
        "purple short, grey was not seen. An error that shows on the right alone is absorbed by "
        "the fit where it uses the stop.",
        lambda: _unseen(stops[:MOST_STOPS]),
        wide=True,
    )


def _unseen(stops: Sequence[StopMaps]) -> Figure:
    height = 1.2 + 1.25 * len(stops)
    figure, grid = plots.axes(plots.WIDE_IN, height, len(stops), 3, sharex=True, sharey="row")
    off_mm = np.concatenate([1e3 * np.abs(stop.map_m[-1]).ravel() for stop in stops])
    limit = round_up(float(np.nanquantile(off_mm, UNSEEN_IN_SCALE)))
    for row, stop in zip(grid, stops, strict=True):
        told = zip(row, stop.map_m, stop.rms_m, ("before", "seen", "held out"), strict=True)
        for ax, map_m, rms_m, what in told:
            title = f"{_short(stop.name)} {what}: {1e3 * rms_m:.2f} mm"
            picture = plots.ring_map(ax, 1e3 * map_m, limit, title)
    plots.name_ring_maps(figure, grid, picture)
    return figure


def every_stop(evidence: Evidence) -> Iterator[Chart | Absent]:
    """Mean residual over ring and azimuth of every stop, small: as fitted, and as held out."""
    if not evidence.has_beams:
        yield Absent("stops", NO_BEAMS)
        return
    maps = evidence.stops
    shown = maps[:MOST_MAPS]
    off_mm = np.concatenate([1e3 * np.abs(each.map_m).ravel() for each in shown])
    limit = round_up(float(np.nanquantile(off_mm, UNSEEN_IN_SCALE)))
    worst, best = maps[0], maps[-1]
    stops = len({each.name for each in maps})
    what = "held out" if worst.held_out else "in the fit"
    told = f"Stop by stop, the worst first: {worst.name}, {1e3 * worst.rms_m:.2f} mm rms {what}"
    cuts = [0, *range(FIRST_MAPS, len(shown), PAGE_MAPS), len(shown)]
    for k, (begin, end) in enumerate(pairwise(dict.fromkeys(cuts))):
        some = shown[begin:end]
        yield Chart(
            f"stops-{k + 1}" if k else "stops",
            f"{told}; of {stops} stops the best has {1e3 * best.rms_m:.2f} mm"
            if not k
            else f"More stops: {some[0].name} to {some[-1].name}, from {1e3 * some[0].rms_m:.2f} "
            "mm rms",
            "A map per stop as the fit of all stops left it, after one as a fit without it "
            "predicts it where it was held out; all maps on one scale. Orange reads long, purple "
            "short, grey was not seen. A map unlike the others is something that happened at "
            "that stop; what all share is missing from the model."
            + (f" The {MOST_MAPS} worst maps of {len(maps)}." if len(maps) > MOST_MAPS else ""),
            partial(_small, some, evidence.rings, limit),
            wide=True,
            quiet=k > 0,
        )


def _small(maps: Sequence[StopMap], rings: int, limit: float) -> Figure:
    """Small maps, a few abreast, on a scale that ends at `limit` mm."""
    rows = -(-len(maps) // MAPS_IN_ROW)
    size = (plots.WIDE_IN, 1.2 + 1.15 * rows, rows, MAPS_IN_ROW)
    figure, grid = plots.axes(*size, sharex=True, sharey=True)
    for ax, each in zip(grid.flat, maps, strict=False):
        what = " held out" if each.held_out else ""
        title = f"{_short(each.name)}{what}: {1e3 * each.rms_m:.2f} mm"
        picture = plots.ring_map(ax, 1e3 * each.map_m, limit, title, rings)
        ax.title.set_fontsize(8)
    for ax in grid.flat[len(maps) :]:
        ax.set_axis_off()
    plots.name_ring_maps(figure, grid, picture)
    return figure


def _short(name: str) -> str:
    """A stop's name as long as fits above a map."""
    return name if len(name) <= NAME else f"{name[: NAME - 1]}…"
