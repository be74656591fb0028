"""The numbers of a figure as CSV, read off what is drawn: one way for every figure.

A panel is a block of rows below a heading, and an empty row stands between blocks. Lines, dots and
bars have a row per point, `from` and `to` being the ends of the interval or band about it; a map
has a row per row of cells. What has no place along the axes, a line at zero say, is no number.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from calib.report.data import csv_link
from chains import escape

if TYPE_CHECKING:
    from calib.report.plots import Axes, Figure

DRAWN_DIGITS = 5  # significant ones of a number that is drawn: more than a picture shows
COLOUR_BAR = "<colorbar>"  # what matplotlib calls the axes of one
# Of axes whose ticks are given as texts.
TEXT_FORMATTERS = {
    "FuncFormatter",
    "StrCategoryFormatter",
}
Series = tuple[str, np.ndarray, np.ndarray, np.ndarray]
Rows = list[list[str]]


def figure_csv(figure: Figure) -> str:
    """The address of a CSV file with the numbers of a figure that has been drawn, as of `csv_link`;
    empty where it has none."""
    rows: Rows = []
    panels = [ax for ax in figure.axes if ax.axison and ax.get_label() != COLOUR_BAR]
    series = _series(panels)
    for ax in panels:
        for block in (_points(ax, series), *_maps(ax), *_arrows(ax)):
            if len(block) > 1:
                rows += [[], *block] if rows else block
    return csv_link(rows) if rows else ""


def _series(panels: Sequence[Axes]) -> dict[str, str]:
    """Colour -> what a legend calls it, for panels whose lines are known by their colours."""
    barred = [each for ax in panels for each in ax.containers if hasattr(each, "has_xerr")]
    pairs = [(each.lines[0].get_color(), _name(each)) for each in barred]
    pairs += [(line.get_color(), _name(line)) for ax in panels for line in ax.lines]
    return {colour: name for colour, name in pairs if name}


def _points(ax: Axes, series: Mapping[str, str]) -> Rows:
    """A row per point of every series, below a heading."""
    out = [[_title(ax, "series"), *_labels(ax), "from", "to"]]
    for name, x, y, ends in (*_bars(ax), *_errorbars(ax, series), *_lines(ax, series)):
        places = zip(_texts(ax.xaxis, x), _texts(ax.yaxis, y), strict=True)
        for place, pair in zip(places, ends, strict=True):
            if all(place):
                out.append([name, *place, *map(_text, pair)])
    return out


def _bars(ax: Axes) -> Iterator[Series]:
    for each in ax.containers:
        if hasattr(each, "patches"):
            corner = np.array([bar.get_xy() for bar in each.patches])
            size = np.array([(bar.get_width(), bar.get_height()) for bar in each.patches])
            along = 0 if each.orientation == "horizontal" else 1
            at = corner + size / 2
            at[:, along] = size[:, along]
            yield _name(each), *at.T, np.full((len(at), 2), np.nan)


def _errorbars(ax: Axes, series: Mapping[str, str]) -> Iterator[Series]:
    for each in ax.containers:
        if hasattr(each, "has_xerr"):
            line, _, (bars, *_) = each.lines
            along = 0 if each.has_xerr else 1
            ends = np.array([path.vertices[:, along] for path in bars.get_paths()])
            name = _name(each) or series.get(line.get_color(), "")
            yield name, *map(np.asarray, line.get_data()), ends


def _lines(ax: Axes, series: Mapping[str, str]) -> Iterator[Series]:
    """Lines and dots; each band belongs to the first line that goes through all of it."""
    barred = [each.lines[0] for each in ax.containers if hasattr(each, "has_xerr")]
    bands = [_band(each) for each in ax.collections if hasattr(each, "get_paths")]
    bands = [band for band in bands if len(band[0])]
    for line in ax.lines:
        if line in barred or line.get_transform() != ax.transData:
            continue
        x, y = (np.asarray(each, float) for each in line.get_data())
        ends = np.full((len(x), 2), np.nan)
        mine = next((k for k, (at, _) in enumerate(bands) if np.isin(at, x).all()), None)
        if mine is not None:
            at, pairs = bands.pop(mine)
            found = np.isin(x, at)
            ends[found] = pairs[np.searchsorted(at, x[found])]
        yield _name(line) or series.get(line.get_color(), ""), x, y, ends


def _band(collection: Any) -> tuple[np.ndarray, np.ndarray]:
    """Where a shaded band is (n,) and its ends there (n, 2); empty of what is no band."""
    if "PolyCollection" not in type(collection).__name__:
        return np.zeros(0), np.zeros((0, 2))
    corners = np.concatenate([np.zeros((0, 2)), *(p.vertices for p in collection.get_paths())])
    at, place = np.unique(corners[:, 0], return_inverse=True)
    ends = np.tile([np.inf, -np.inf], (len(at), 1))
    np.minimum.at(ends[:, 0], place, corners[:, 1])
    np.maximum.at(ends[:, 1], place, corners[:, 1])
    return at, ends


def _maps(ax: Axes) -> Iterator[Rows]:
    """Of every map a row per row of cells, below where its columns are."""
    for image in ax.images:
        left, right, bottom, top = image.get_extent()
        cells = image.get_array()
        x, y = _middles(left, right, cells.shape[1]), _middles(bottom, top, cells.shape[0])
        yield _map(ax, image, x, y if image.origin == "lower" else y[::-1])
    for mesh in ax.collections:
        if hasattr(mesh, "get_coordinates"):
            edges = mesh.get_coordinates()
            x, y = edges[0, :, 0], edges[:, 0, 1]
            yield _map(ax, mesh, (x[1:] + x[:-1]) / 2, (y[1:] + y[:-1]) / 2)


def _map(ax: Axes, image: Any, x: np.ndarray, y: np.ndarray) -> Rows:
    across, up = _labels(ax)
    what = _title(ax, "")
    bars = [image.colorbar, *(each.colorbar for other in ax.figure.axes for each in other.images)]
    if bar := next((bar.ax for bar in bars if bar), None):  # maps may share one
        what = f"{what}: {bar.get_xlabel() or bar.get_ylabel()}".removeprefix(": ")
    cells = np.ma.filled(np.ma.asarray(image.get_array(), float), np.nan)
    cells = cells.reshape(len(y), len(x))
    head = [f"{what}; {up} down, {across} to the right".removeprefix("; "), *_texts(ax.xaxis, x)]
    lines = zip(_texts(ax.yaxis, y), cells, strict=True)
    return [head, *([place, *map(_text, row)] for place, row in lines)]


def _arrows(ax: Axes) -> Iterator[Rows]:
    """Of arrows where each begins, and what it is along both axes."""
    for each in ax.collections:
        if hasattr(each, "U"):
            table = np.column_stack([each.X, each.Y, each.U, each.V])
            heading = [f"{_title(ax, 'arrows')}: {_labels(ax)[0]}", _labels(ax)[1]]
            yield [[*heading, "along x", "along y"], *(list(map(_text, row)) for row in table)]


def _middles(first: float, last: float, count: int) -> np.ndarray:
    return first + (last - first) * (np.arange(count) + 0.5) / count


def _title(ax: Axes, otherwise: str) -> str:
    return ax.get_title(loc="left") or otherwise


def _labels(ax: Axes) -> tuple[str, str]:
    """What lies along its axes, which those that share one with it may say."""
    x, y = (shared.get_siblings(ax) for shared in (ax.get_shared_x_axes(), ax.get_shared_y_axes()))
    everyone = [ax, *ax.figure.axes]
    across = [each.get_xlabel() for each in everyone if each in x]
    up = [each.get_ylabel() for each in everyone if each in y]
    x, y = (max(labels, key=bool).replace("\n", ", ") for labels in (across, up))
    return x or "x", y or "y"


def _name(artist: Any) -> str:
    """What the legend calls it; empty of what it does not name."""
    label = str(artist.get_label())
    return "" if label.startswith("_") else label


def _texts(axis: Any, at: np.ndarray) -> list[str]:
    """Places along an axis: numbers, or where its ticks are names the name of the tick nearby."""
    form = axis.get_major_formatter()
    if type(form).__name__ in TEXT_FORMATTERS:
        ticks = np.asarray(axis.get_majorticklocs(), float)
        names = [form(tick, k).replace("\n", ", ") for k, tick in enumerate(ticks)]
        if len(ticks) and not all(map(escape.is_number, names)):
            off = np.abs(np.subtract.outer(np.asarray(at, float), ticks))
            nearest = zip(at, off.argmin(axis=1), off.min(axis=1), strict=True)
            return [names[k] if far < 0.5 else _text(value) for value, k, far in nearest]
    return list(map(_text, at))


def _text(value: float) -> str:
    return f"{value:z.{DRAWN_DIGITS}g}" if np.isfinite(value) else ""
