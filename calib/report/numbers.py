"""The numbers of a figure, read off what is drawn: one way for every figure. They are its CSV, and
what the page says of the place under the pointer.

A panel is a block of rows below a heading, and an empty row stands between blocks. Lines, dots and
bars have a row per point, `from` and `to` being the ends of the interval or band about it; a map
has a row per row of cells. What has no place along the axes, a line at zero say, is no number. A
diagram, which has no axes to read, gives its rows itself: `give`.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from calib.report.data import csv_link
from calib.results.outstanding import shown
from chains import escape

if TYPE_CHECKING:
    from calib.report.plots import Axes, Figure

DRAWN_DIGITS = 5  # significant ones of a number that is drawn: more than a picture shows
CELL_DIGITS = 3  # of a cell of a map, which is a colour; a page has many
COLOUR_BAR = "<colorbar>"  # what matplotlib calls the axes of one
GIVEN = "numbers of the diagram"  # attribute of axes
# Of axes whose ticks are given as texts.
TEXT_FORMATTERS = {"FuncFormatter", "StrCategoryFormatter"}
POINTS_PER_INCH = 72  # of an SVG by matplotlib
Series = tuple[str, np.ndarray, np.ndarray, np.ndarray, str]
Rows = list[list[str]]
Places = list[dict[str, Any]]


@dataclass(frozen=True)
class DrawnNumbers:
    """A heading and the rows below it, and where in the picture they are.

    Args:
        ax: their panel.
        rows: the heading first.
        places: of runs of rows: `x` and `y` of each in the panel's own coordinates, and `by`, along
            which axes the pointer has to be near: "xy", or "x" or "y" of a bar; of a map the edges
            of its columns `x` and rows `y`, and `what` its cells are.
    """

    ax: Axes
    rows: Rows
    places: Places


def give(ax: Axes, heading: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Have a diagram give its numbers itself, which no axis says.

    Args:
        ax: of the diagram, in which row i is drawn at y = i.
        heading: with units.
        rows: of texts.
    """
    setattr(ax, GIVEN, [list(heading), *map(list, rows)])


def blocks_of(figure: Figure) -> list[DrawnNumbers]:
    """The numbers of a figure that has been drawn."""
    panels = [ax for ax in figure.axes if ax.axison and ax.get_label() != COLOUR_BAR]
    series = _series(panels)
    out = []
    for ax in figure.axes:
        if rows := getattr(ax, GIVEN, None):
            at = np.arange(len(rows) - 1.0)
            out.append(DrawnNumbers(ax, rows, [{"by": "y", "x": np.zeros(len(at)), "y": at}]))
        elif ax in panels:
            out += [_points(ax, series), *_maps(ax), *_arrows(ax)]
    return [block for block in out if len(block.rows) > 1]


def figure_csv(blocks: Sequence[DrawnNumbers]) -> str:
    """The address of a CSV file with the numbers of a figure, as of `csv_link`; empty where it has
    none."""
    rows: Rows = []
    for block in blocks:
        rows += [[], *block.rows] if rows else block.rows
    return csv_link(rows) if rows else ""


def figure_places(blocks: Sequence[DrawnNumbers]) -> str:
    """Where in the SVG the rows of `figure_csv` are, as JSON for the page's script.

    Of each block `row`, the number of its heading in the CSV, `box`, its panel's left, top, right
    and bottom, and its `places` as of `DrawnNumbers`, all in the units of the SVG's view box.
    """
    out, row = [], 0
    for block in blocks:
        inches = block.ax.figure.get_size_inches()
        scale, high = POINTS_PER_INCH / block.ax.figure.dpi, POINTS_PER_INCH * inches[1]
        box = block.ax.get_window_extent().get_points() * scale
        places = [
            each | {axis: _placed(block.ax, each[axis], axis, scale, high) for axis in "xy"}
            for each in block.places
        ]
        left, right, top, bottom = box[0, 0], box[1, 0], high - box[1, 1], high - box[0, 1]
        corners = [round(float(side), 1) for side in (left, top, right, bottom)]
        out.append({"row": row, "box": corners, "places": places})
        row += len(block.rows) + 1
    return json.dumps(out, separators=(",", ":")) if out else ""


def _placed(ax: Axes, values: np.ndarray, axis: str, scale: float, high: float) -> list[float]:
    """Where along one axis of the SVG values of a panel are, to a tenth."""
    k = "xy".index(axis)
    at = np.tile([ax.get_xlim()[0], ax.get_ylim()[0]], (len(values), 1)).astype(float)
    at[:, k] = values
    with np.errstate(invalid="ignore", divide="ignore"):
        out = scale * ax.transData.transform(at)[:, k]
    out = high - out if axis == "y" else out
    return np.round(np.nan_to_num(out, nan=-1e4, posinf=1e4, neginf=-1e4), 1).tolist()


def _series(panels: Sequence[Axes]) -> dict[str, str]:
    """Colour -> what a legend calls it, for panels whose lines are known by their colours."""
    barred = [each for ax in panels for each in ax.containers if hasattr(each, "has_xerr")]
    pairs = [(each.lines[0].get_color(), _name(each)) for each in barred]
    pairs += [(line.get_color(), _name(line)) for ax in panels for line in ax.lines]
    return {colour: name for colour, name in pairs if name}


def _points(ax: Axes, series: Mapping[str, str]) -> DrawnNumbers:
    """A row per point of every series, below a heading."""
    rows, places = [[_title(ax, "series"), *_labels(ax), "from", "to"]], []
    for name, x, y, ends, by in (*_bars(ax), *_errorbars(ax, series), *_lines(ax, series)):
        told = list(zip(_texts(ax.xaxis, x), _texts(ax.yaxis, y), strict=True))
        known = np.array([all(place) for place in told], bool)
        for place, pair, is_known in zip(told, ends, known, strict=True):
            if is_known:
                rows.append([name, *place, *map(_text, pair)])
        places.append({"by": by, "x": x[known], "y": y[known]})
    return DrawnNumbers(ax, rows, places)


def _bars(ax: Axes) -> Iterator[Series]:
    for each in ax.containers:
        if hasattr(each, "patches"):
            corner = np.array([bar.get_xy() for bar in each.patches])
            size = np.array([(bar.get_width(), bar.get_height()) for bar in each.patches])
            along = 0 if each.orientation == "horizontal" else 1
            at = corner + size / 2
            at[:, along] = size[:, along]
            yield _name(each), *at.T, np.full((len(at), 2), np.nan), "yx"[along]


def _errorbars(ax: Axes, series: Mapping[str, str]) -> Iterator[Series]:
    for each in ax.containers:
        if hasattr(each, "has_xerr"):
            line, _, (bars, *_) = each.lines
            along = 0 if each.has_xerr else 1
            ends = np.array([path.vertices[:, along] for path in bars.get_paths()])
            name = _name(each) or series.get(line.get_color(), "")
            yield name, *map(np.asarray, line.get_data()), ends, "xy"


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
        yield _name(line) or series.get(line.get_color(), ""), x, y, ends, "xy"


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


def _maps(ax: Axes) -> Iterator[DrawnNumbers]:
    """Of every map a row per row of cells, below where its columns are."""
    for image in ax.images:
        left, right, bottom, top = image.get_extent()
        rows, columns = image.get_array().shape
        x, y = np.linspace(left, right, columns + 1), np.linspace(bottom, top, rows + 1)
        yield _map(ax, image, x, y if image.origin == "lower" else y[::-1])
    for mesh in ax.collections:
        if hasattr(mesh, "get_coordinates"):
            edges = mesh.get_coordinates()
            yield _map(ax, mesh, edges[0, :, 0], edges[:, 0, 1])


def _map(ax: Axes, image: Any, x: np.ndarray, y: np.ndarray) -> DrawnNumbers:
    """Of a map with these edges of its columns and rows."""
    across, up = _labels(ax)
    what, bar_label = _title(ax, ""), ""
    bars = [image.colorbar, *(each.colorbar for other in ax.figure.axes for each in other.images)]
    if bar := next((bar.ax for bar in bars if bar), None):  # maps may share one
        bar_label = bar.get_xlabel() or bar.get_ylabel()
        what = f"{what}: {bar_label}".removeprefix(": ")
    cells = np.ma.filled(np.ma.asarray(image.get_array(), float), np.nan)
    cells = cells.reshape(len(y) - 1, len(x) - 1)
    at, up_at = (x[1:] + x[:-1]) / 2, (y[1:] + y[:-1]) / 2
    head = [f"{what}; {up} down, {across} to the right".removeprefix("; "), *_texts(ax.xaxis, at)]
    lines = zip(_texts(ax.yaxis, up_at), cells, strict=True)
    rows = [head, *([place, *(_text(cell, CELL_DIGITS) for cell in row)] for place, row in lines)]
    told = [_title(ax, ""), across, up, bar_label or _title(ax, "")]
    return DrawnNumbers(ax, rows, [{"what": told, "x": x, "y": y}])


def _arrows(ax: Axes) -> Iterator[DrawnNumbers]:
    """Of arrows where each begins, and what it is along both axes."""
    for each in ax.collections:
        if hasattr(each, "U"):
            labels = _labels(ax)
            scale, unit = shown(labels[0].rpartition(", ")[2])
            sizes = scale * np.asarray(each.U), scale * np.asarray(each.V)
            table = np.column_stack([each.X, each.Y, *sizes])
            heading = [f"{_title(ax, 'arrows')}: {labels[0]}", labels[1]]
            heading += [f"along {label.partition(' ')[0].rstrip(',')}, {unit}" for label in labels]
            rows = [heading, *(list(map(_text, row)) for row in table)]
            yield DrawnNumbers(ax, rows, [{"by": "xy", "x": table[:, 0], "y": table[:, 1]}])


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


def _text(value: float, digits: int = DRAWN_DIGITS) -> str:
    return f"{value:z.{digits}g}" if np.isfinite(value) else ""
