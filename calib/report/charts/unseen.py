"""Stops that the fit never saw, beam by beam, beside what the fit made of them when it did."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from textwrap import wrap
from typing import TYPE_CHECKING

import numpy as np

from calib.report import plots
from calib.report.chart import Absent, Chart
from calib.report.charts.residuals import NO_BEAMS
from calib.report.evidence import Evidence
from calib.report.statistics import StopMaps
from calib.show.scale import round_up

if TYPE_CHECKING:
    from calib.report.plots import Figure

MOST_STOPS = 3  # that are drawn, the worst: as many as a screen holds in a row each
NAME = 20  # letters of a stop's name that stand along a map
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
            extent = (-180, 180, -0.5, len(map_m) - 0.5)
            picture = plots.signed_map(ax, 1e3 * map_m, extent, limit)
            ax.set_title(f"{what}: {1e3 * rms_m:.2f} mm")
            ax.set_xticks(range(-180, 181, 90))
        row[0].set_ylabel("\n".join([*wrap(stop.name, NAME), "ring"]), fontsize=8)
    for ax in grid[-1]:
        ax.set_xlabel("azimuth, deg")
    bar = figure.colorbar(picture, ax=grid, orientation="horizontal", aspect=60, extend="both")
    bar.set_label("mean residual, mm")
    return figure
