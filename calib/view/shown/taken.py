"""Files that are taken away from a page: what its plot shows, and what a run has found."""

from __future__ import annotations

import csv
import io
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from calib.exporters import export
from calib.report import plots
from calib.runs.run import Run
from calib.view.scene import Points
from calib.view.shown import sizes
from calib.view.shown.colours import Scale, column
from calib.view.shown.columns import STOP
from calib.view.shown.plot import DOT, Chart
from calib.view.side import Chosen, Side
from chains import escape
from chains.errors import InputError

if TYPE_CHECKING:
    from calib.report.plots import Axes, Figure

BEAM = (STOP, "ring", "column")  # what says which beam a row is
MOST_BYTES = 1_000_000_000  # of a run's folder: a browser holds all of it in memory
LONG_AGO = (1980, 1, 1, 0, 0, 0)  # of files in an archive: the same run gives the same bytes


def beams_csv(points: Points, rows: np.ndarray, names: Sequence[str], lit: np.ndarray) -> bytes:
    """Some columns of some beams (n,), as the plot shows them: with their units, and for each beam
    1 or 0 for an inlier, and for one that is lit (N,)."""
    wanted = [n for n in dict.fromkeys((*BEAM, *names)) if n in points.columns]
    table = [points.columns[n][rows].astype(float) * column(n).scale for n in wanted]
    table += [points.inlier[rows].astype(float), lit[rows].astype(float)]
    heading, body = io.StringIO(), io.StringIO()
    texts = [*(column(n).heading for n in wanted), "inlier", "lit"]
    csv.writer(heading, lineterminator="\n").writerow(map(escape.csv_cell, texts))
    np.savetxt(body, np.stack(table, axis=1), "%.7g", delimiter=",")
    return (heading.getvalue() + body.getvalue().replace("nan", "")).encode()


def plot_file(
    sides: Sequence[Side],
    chosen: Chosen,
    charts: Sequence[Chart],
    axes: Mapping[str, Any],
    kind: Literal["CSV", "SVG", "PNG"],
) -> bytes:
    """The plots of the page, beside each other on the same axes; as CSV the beams of the first.

    Args:
        sides: the runs.
        chosen: what is shown of them.
        charts: the plot of each.
        axes: as `plot.axes` has them.
        kind: of the file.
    """
    if kind == "CSV":
        names = [n for n in (chosen.over, chosen.up, chosen.colour, chosen.size) if n]
        first, lit = sides[0], sides[0].lit(chosen)
        lit = np.ones(len(first.points.xyz_m), bool) if lit is None else lit
        return beams_csv(first.points, np.flatnonzero(first.kept), names, lit)
    with plots.styled(), TemporaryDirectory() as scratch:
        wide = plots.HALF_IN if len(sides) == 1 else plots.WIDE_IN
        figure, grid = plots.axes(wide, 3.6, 1, len(sides), sharey=True)
        for ax, side, (data, series) in zip(grid[0], sides, charts, strict=True):
            _draw(ax, data, series)
            ax.set(title=side.name, xlabel=column(chosen.over).heading)
            ax.set(xlim=axes["x"]["range"], ylim=axes["y"]["range"])
        grid[0, 0].set_ylabel(column(chosen.up).heading)
        _explain(figure, grid, sides[0].scale, chosen)
        path = Path(scratch) / f"plot.{kind.lower()}"
        plots.save(plots.with_plain_text(figure), path)
        return path.read_bytes()


def _explain(figure: Figure, grid: np.ndarray, scale: Scale, chosen: Chosen) -> None:
    """Say what colours and sizes of dots mean."""
    if scale.low is None:
        dots = {name: (colour, 5.0) for name, colour in scale.names.items()}
        plots.dot_key(figure, dots, scale.title)
    else:
        label = column(chosen.colour).heading
        plots.colour_bar(figure, grid, scale.stops, (scale.low, scale.high), label)
    if chosen.size:
        of, steps = sizes.key(chosen.size, chosen.size_ends)
        each = zip(steps, sizes.FACTORS, strict=True)
        dots = {text: (plots.PALE, 0.75 * DOT * factor) for text, factor in each}
        plots.dot_key(figure, dots, of, "upper right")


def _draw(ax: Axes, data: Sequence[np.ndarray], series: Sequence[Mapping[str, Any]]) -> None:
    """Draw what a plot of the page has: dots, and the line of means."""
    for y, how in zip(data[1:], series[1:], strict=True):
        known, dots = np.isfinite(y), how.get("points", {})
        if dots.get("show"):
            fill, edge = (_colour(dots[key]) for key in ("fill", "stroke"))
            width = 0.75 * dots["width"]
            look = {"c": [fill], "edgecolors": [edge], "linewidths": width, "zorder": 2 + width}
            ax.scatter(data[0][known], y[known], s=(0.75 * dots["size"]) ** 2, **look)
        elif known.any():
            ax.plot(data[0], y, color=how["stroke"], linewidth=how["width"], zorder=3)


def _colour(css: str) -> str | tuple[float, ...]:
    """A colour of a page, for a figure."""
    if not css.startswith("rgba"):
        return css
    *rgb, alpha = map(float, css.removeprefix("rgba(").removesuffix(")").split(","))
    return (*(x / 255 for x in rgb), alpha)


def run_zip(run: Run) -> bytes:
    """A run's folder as one archive, without what lies in it and is no file.

    Raises:
        InputError: it is too large to go through a browser.
    """
    files = [f for f in sorted(run.folder.rglob("*")) if f.is_file() and not f.is_symlink()]
    size = sum(file.stat().st_size for file in files)
    if size > MOST_BYTES:
        raise InputError(
            f"{run.folder} holds {size / 1e9:.1f} GB, which is too much for a browser; copy it"
        )
    return _packed({f"{run.folder.name}/{f.relative_to(run.folder).as_posix()}": f for f in files})


def extrinsics_zip(run: Run) -> bytes:
    """What ``rigcal export`` writes of a run, in all formats, as one archive.

    Raises:
        InputError: the run has not converged.
    """
    with TemporaryDirectory() as scratch:
        files = sorted(export(run, Path(scratch) / "extrinsics").files)
        return _packed({f"extrinsics/{file.name}": file for file in files})


def _packed(files: Mapping[str, Path]) -> bytes:
    """An archive of files by the names that they have in it."""
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        for name, file in files.items():
            entry = zipfile.ZipInfo(name, LONG_AGO)
            archive.writestr(entry, file.read_bytes(), zipfile.ZIP_DEFLATED)
    return packed.getvalue()
