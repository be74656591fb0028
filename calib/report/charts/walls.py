"""The residuals on the room itself: its floor, ceiling and walls, laid flat."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from calib.report import plots
from calib.report.chart import Absent, Chart
from calib.report.charts.residuals import NO_BEAMS
from calib.report.evidence import Evidence
from calib.report.walls import DEPTH_M, Face, repeats_m
from calib.show.scale import round_up

if TYPE_CHECKING:
    from calib.report.plots import Figure

CELLS_IN_SCALE = 0.98  # of the cells: those that lie inside the scale


def walls(evidence: Evidence) -> Iterator[Chart | Absent]:
    """Mean residual over the sides of each room that was scanned."""
    if not evidence.has_beams:
        yield Absent("room", NO_BEAMS)
        return
    rooms = evidence.walls
    if not rooms:
        yield Absent("room", "there is no mesh of the room")
    for i, (sigma_m, sides) in enumerate(rooms, 1):
        repeats = repeats_m(sides)
        yield Chart(
            "room" if len(rooms) == 1 else f"room-{i}",
            f"{1e3 * repeats:.2f} mm rms of the residuals repeat from stop to stop at the same "
            f"place in the room; the mesh is known to {1e3 * sigma_m:.2f} mm",
            f"Mean residual in cells of {sides[0].cell_m:g} m of floor, ceiling and walls, and "
            f"of what stands up to {DEPTH_M:g} m before them; coordinates from a corner of the "
            "room. Orange reads long, purple short, grey was not seen. What repeats is what both "
            "halves of the stops see in a cell: a wall that leans, a mesh that is out of date.",
            lambda sides=sides: _walls(sides),
            wide=True,
            quiet=repeats < sigma_m,
        )


def _walls(sides: Sequence[Face]) -> Figure:
    widths = [max(side.mean_m.shape[1] for side in sides[k::3]) for k in range(3)]
    figure, grid = plots.axes(plots.WIDE_IN, 4.4, 2, 3, width_ratios=widths)
    seen = np.abs(np.concatenate([side.mean_m.ravel() for side in sides]))
    seen = seen[np.isfinite(seen)]
    limit = round_up(1e3 * float(np.quantile(seen, CELLS_IN_SCALE))) if len(seen) else 1.0
    for ax, side in zip(grid.flat, sides, strict=True):
        rows, columns = side.mean_m.shape
        extent = (0.0, side.cell_m * columns, 0.0, side.cell_m * rows)
        picture = plots.signed_map(ax, 1e3 * side.mean_m, extent, limit)
        ax.set_aspect("equal")
        ax.set(title=side.name, xlabel=f"{side.axes[0]}, m", ylabel=f"{side.axes[1]}, m")
    bar = figure.colorbar(picture, ax=grid, orientation="horizontal", aspect=60, extend="both")
    bar.set_label("mean residual, mm")
    return figure
