"""Figures for pages and papers: their style, and how they become SVG, PNG or PDF.

This is the matplotlib door. Colours are Okabe and Ito's, which those who confuse red and green can
tell apart; signed values run from purple to orange about white.
"""

from __future__ import annotations

import io
import re
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from chains import escape
from chains.errors import InputError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

AFTER, BEFORE, FLOOR, INK, PALE = "#0072b2", "#d55e00", "#009e73", "#333333", "#999999"
RED = "#b00020"
HELD_OUT_COLOUR = "#b8568f"  # of stops held out, beside AFTER and BEFORE
LINES = (AFTER, BEFORE, FLOOR, "#cc79a7", "#e69f00", "#56b4e9")
SIGNED_MAP, UNSIGNED_MAP = "PuOr_r", "cividis"
HALF_IN, WIDE_IN = 5.6, 8.0  # inches: of a column of the page, and of both
NARROW = 4.2  # of the workbench's panel
LETTERS_PER_INCH = 13  # of the lines of a warning
IMAGE_FORMATS = ("png", "svg", "pdf")
PAPER_DPI, MAP_DPI = 300, 110
LONGEST_TICK = {"x": 24, "y": 44}  # letters along an axis: longer ones leave no room for the rest
LABEL_IN = 0.22  # of axes' labels from the left and from below, where margins are given
POSITION_DIGITS = 9  # of a position of axes, as a share of the figure: far below what is seen
_STYLE = {
    "font.size": 9.5,
    "text.parse_math": False,  # a dollar in a run's name is a dollar
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#888888",
    "axes.labelcolor": INK,
    "axes.linewidth": 0.8,
    "axes.titlesize": 9.5,
    "axes.titlelocation": "left",
    "axes.axisbelow": True,
    "xtick.color": "#555555",
    "ytick.color": "#555555",
    "grid.color": "#e4e4e4",
    "legend.frameon": False,
    "text.color": INK,
    "legend.fontsize": 9,
    "lines.linewidth": 1.5,
    "svg.fonttype": "none",
    "svg.hashsalt": "rigcal",
    "pdf.fonttype": 42,
}


def axes(
    width: float = HALF_IN,
    height: float = 3.0,
    rows: int = 1,
    columns: int = 1,
    margins: Sequence[float] | None = None,
    **options: Any,
) -> tuple[Figure, np.ndarray]:
    """A figure of so many inches, and its axes (rows, columns) with faint grids.

    Args:
        width, height: inches.
        rows, columns: of axes.
        margins: inches on the left, on the right, below, above, where it is known how wide labels
            are; else all of it is measured, which takes as long as drawing it.
        options: more for ``Figure.subplots``.
    """
    from matplotlib.figure import Figure
    from matplotlib.transforms import blended_transform_factory

    figure = Figure(figsize=(width, height), layout=None if margins else "constrained")
    if margins:
        left, right, bottom, top = margins
        figure.subplots_adjust(
            left / width, bottom / height, 1 - right / width, 1 - top / height, hspace=0.12
        )
    grid = figure.subplots(rows, columns, squeeze=False, **options)
    for each in grid.flat:
        each.grid(True)
        if margins:
            beside = blended_transform_factory(figure.transFigure, each.transAxes)
            each.yaxis.set_label_coords(LABEL_IN / width, 0.5, beside)
            below = blended_transform_factory(each.transAxes, figure.transFigure)
            each.xaxis.set_label_coords(0.5, LABEL_IN / height, below)
    return figure, grid


@contextmanager
def styled() -> Iterator[None]:
    """The house style, for what is drawn inside."""
    from matplotlib import rc_context

    with rc_context(_STYLE):
        yield


def band(ax: Axes, x: np.ndarray, mean: np.ndarray, half: np.ndarray, colour: str) -> None:
    """A shaded band about a line; that of stops held out, which is wide, hides no other."""
    alpha = 0.1 if colour == HELD_OUT_COLOUR else 0.25
    ax.fill_between(x, mean - half, mean + half, color=colour, alpha=alpha, linewidth=0)


def log_axis(ax: Axes, least: float, most: float, name: str = "x") -> None:
    """Make an axis, x or y, logarithmic, with a number at every 1, 2 and 5."""
    ax.set(**{f"{name}scale": "log"})
    powers = np.arange(np.floor(np.log10(least)), np.ceil(np.log10(most)) + 1)
    ticks = np.outer(10.0**powers, [1, 2, 5]).ravel()
    ticks = ticks[(ticks > 0.7 * least) & (ticks < 1.4 * most)]
    axis = ax.xaxis if name == "x" else ax.yaxis
    axis.set_ticks(ticks, [f"{tick:g}" for tick in ticks])
    axis.set_ticks([], minor=True)


def signed_map(
    ax: Axes, values: np.ndarray, extent: Sequence[float], limit: float, scale: str = SIGNED_MAP
) -> Any:
    """A map (rows, columns) about zero, drawn as one picture; grey where it is NaN.

    Args:
        ax: where.
        values: rows from below.
        extent: left, right, bottom, top.
        limit: the value at the scale's ends.
        scale: matplotlib's name of the colours.
    """
    ax.set_facecolor("#d8d8d8")
    ax.grid(False)
    options = {"aspect": "auto", "origin": "lower", "interpolation": "nearest"}
    return ax.imshow(values, scale, vmin=-limit, vmax=limit, extent=extent, **options)


def ring_map(
    ax: Axes, values: np.ndarray, limit: float, title: str, rings: int | None = None
) -> Any:
    """A `signed_map` over azimuth, all around, and ring; of so many `rings` where rows hold several
    of them."""
    ax.set_title(title)
    ax.set_xticks(range(-180, 181, 90))
    return signed_map(ax, values, (-180, 180, -0.5, (rings or len(values)) - 0.5), limit)


def name_ring_maps(figure: Figure, grid: np.ndarray, picture: Any) -> None:
    """Say what lies along some of these maps, and what their colours, of one scale, are."""
    for ax in grid[-1]:
        ax.set_xlabel("azimuth, deg")
    for ax in grid[:, 0]:
        ax.set_ylabel("ring")
    bar = figure.colorbar(picture, ax=grid, orientation="horizontal", aspect=60, extend="both")
    bar.set_label("mean residual, mm")


def signed_cells(ax: Axes, x: np.ndarray, y: np.ndarray, values: np.ndarray, limit: float) -> Any:
    """As `signed_map`, of cells (rows, columns) with these edges, which need not be even."""
    ax.set_facecolor("#d8d8d8")
    ax.grid(False)
    known = np.ma.masked_invalid(values)
    return ax.pcolormesh(x, y, known, cmap=SIGNED_MAP, vmin=-limit, vmax=limit, rasterized=True)


def share_map(ax: Axes, values: np.ndarray, extent: Sequence[float], most: float) -> Any:
    """A map (rows, columns) from 0 to `most`, drawn as one picture; grey where it is NaN."""
    ax.set_facecolor("#d8d8d8")
    ax.grid(False)
    options = {"aspect": "auto", "origin": "lower", "interpolation": "nearest"}
    return ax.imshow(values, UNSIGNED_MAP, vmin=0.0, vmax=most, extent=extent, **options)


def colour_bar(
    figure: Figure, grid: np.ndarray, colours: Sequence[str], ends: tuple[float, float], label: str
) -> None:
    """Say beside axes what colours at even steps between two values mean."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import LinearSegmentedColormap, Normalize

    scale = ScalarMappable(Normalize(*ends), LinearSegmentedColormap.from_list("", list(colours)))
    bar = figure.colorbar(scale, ax=list(grid.flat), aspect=30)
    bar.outline.set_visible(False)
    bar.set_label(label)


def dot_key(
    figure: Figure, dots: Mapping[str, tuple[str, float]], title: str, place: str = "lower left"
) -> None:
    """Say outside axes what dots mean: text -> their colour and their size, points."""
    from matplotlib.lines import Line2D

    look = {"linestyle": "none", "marker": "o", "markeredgewidth": 0}
    handles = [
        Line2D([], [], label=text, color=colour, markersize=size, **look)
        for text, (colour, size) in dots.items()
    ]
    where = {"loc": f"outside {place}", "ncols": 4, "fontsize": 8, "alignment": "left"}
    figure.legend(handles=handles, title=title, title_fontsize=8, columnspacing=1, **where)


def number_above(ax: Axes, text: str, x: float, y: float) -> None:
    """Write a number above a point, readable where a line runs through it."""
    from matplotlib.patheffects import withStroke

    halo = [withStroke(linewidth=3, foreground="white")]
    where = {"textcoords": "offset points", "ha": "center", "path_effects": halo}
    ax.annotate(text, (x, y), (0, 8), **where)


def with_plain_text(figure: Figure) -> Figure:
    """The figure, its texts without control characters, which neither XML nor a font has; names
    along its axes that would leave no room for what is drawn are shortened."""
    from matplotlib.text import Text

    for text in figure.findobj(Text):
        text.set_text(escape.terminal(text.get_text()))
    for ax in figure.axes:
        for axis in (ax.xaxis, ax.yaxis):
            names, most = axis.get_major_formatter(), LONGEST_TICK[axis.axis_name]
            names.format_ticks = partial(_plain_ticks, names.format_ticks, most)
    return figure


def _plain_ticks(format_ticks: Callable[[Any], list[str]], most: int, values: Any) -> list[str]:
    return [_shortened(escape.terminal(name), most) for name in format_ticks(values)]


def _shortened(name: str, most: int) -> str:
    lines = name.split("\n")
    return "\n".join(line if len(line) <= most else f"{line[: most - 1]}…" for line in lines)


def svg(figure: Figure, name: str) -> str:
    """The figure as an ``<svg>`` to stand in a page among others.

    Every id begins with `name`, of letters, digits, hyphens and underscores only.
    """
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    file = io.StringIO()
    with styled():
        _lay_out(figure)
        figure.set_dpi(MAP_DPI)
        # Not by savefig, which would draw all of it once more before, in case of a layout to make.
        FigureCanvasSVG(figure).print_svg(file, metadata={"Date": None})
    text = file.getvalue()
    text = text[text.index("<svg") :]
    # The page has the one rule of matplotlib's style, and runs no style but its own.
    for part in ("metadata", "style"):
        text = re.sub(rf"<{part}\b.*?</{part}>", "", text, flags=re.DOTALL)
    # As large as its column, and in the page's own letters.
    text = re.sub(r'(<svg[^>]*?) height="[^"]*"', r"\1", text, count=1)
    text = re.sub(r'(<svg[^>]*?) width="[^"]*"', r"\1", text, count=1)
    text = re.sub(r"font: ([0-9.]+px) [^;\"]*", r"font-size: \1; font-family: inherit", text)
    text = re.sub(r'\bid="', f'id="{name}-', text)
    return re.sub(r'(url\(#|href="#)', rf"\1{name}-", text)


def _lay_out(figure: Figure) -> None:
    """Put the axes where they stay, unless they are there.

    The solver of constraints adds up in the order of addresses in memory, so the last digits, of
    which ids of the SVG are made, are chance; they are rounded away.
    """
    if figure.get_layout_engine() is None:
        return
    figure.get_layout_engine().execute(figure)
    figure.set_layout_engine("none")
    for each in figure.axes:
        each.set_position(np.round(each.get_position(original=True).bounds, POSITION_DIGITS))


def check_format(path: Path | str) -> str:
    """The format that a path's end asks for.

    Raises:
        InputError: it is none of .png, .svg and .pdf.
    """
    kind = Path(path).suffix.lower().removeprefix(".")
    if kind not in IMAGE_FORMATS:
        ends = ", ".join(f".{f}" for f in IMAGE_FORMATS)
        raise InputError(f"{path}: a figure is written as one of {ends}; name the file so")
    return kind


def png(figure: Figure) -> bytes:
    """The figure as a picture for a screen."""
    file = io.BytesIO()
    with styled():
        figure.set_dpi(MAP_DPI)  # first: letters are as wide as whole dots make them
        _lay_out(figure)
        figure.savefig(file, format="png", dpi=MAP_DPI, facecolor="white")
    return file.getvalue()


def warned(figure: Figure, warning: Sequence[str]) -> Figure:
    """The figure, and above it what is to stand above everything that is shown of a run."""
    wide = int(LETTERS_PER_INCH * figure.get_figwidth())
    lines = [line for each in warning for line in textwrap.wrap(escape.terminal(each), wide)]
    if lines:
        figure.text(0.0, 1.0, "\n".join(lines), color=RED, va="bottom", weight="bold", fontsize=9)
    return figure


def save(figure: Figure, path: Path | str, warning: Sequence[str] = ()) -> None:
    """Write a figure as the end of the path says; `check_format` says what it may be. A warning
    stands above it, and in what the file says of itself."""
    from matplotlib import rc_context

    kind = check_format(path)
    undated = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}.get(kind, {})
    more = {}
    if warning:
        undated["Subject" if kind == "pdf" else "Description"] = escape.line(" ".join(warning))
        more["bbox_inches"] = "tight"  # as large as it is with the lines above
    # A paper is read where our letters may not be there: they are drawn.
    with styled(), rc_context({"svg.fonttype": "path"}):
        _lay_out(figure)
        warned(figure, warning)
        options = {"dpi": PAPER_DPI, "facecolor": "white", "metadata": undated, **more}
        figure.savefig(path, format=kind, **options)
