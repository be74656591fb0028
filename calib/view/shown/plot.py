"""One column of the beams against another, as a chart of uPlot: dots in the colours of the room."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from calib.view.scene import Points
from calib.view.shown.colours import column

MOST_DOTS = 3000  # more would hide each other on a panel of 400 pixels
# Bins of the line of means, and beams in one: of fewer a mean says little.
LINE_BINS, FEWEST_IN_BIN = 16, 5
MEAN = "#d6278a"  # apart from all colours of dots, on light and on dark
FAINT = "rgba(128,128,128,0.3)"  # of dots that are not lit, on light and on dark
RING_COLOUR = "#13a10e"  # about the beam that was clicked, apart from those
Chart = tuple[tuple[np.ndarray, ...], tuple[Mapping[str, Any], ...]]
EMPTY: Chart = ((np.zeros(2), np.full(2, np.nan)), ({"label": ""}, {"label": ""}))


def chart(
    points: Points,
    rows: np.ndarray,
    up: str,
    over: str,
    colours: np.ndarray,
    shades: int = 12,
    lit: np.ndarray | None = None,
    marked: int | None = None,
) -> Chart:
    """Data and series: dots of some beams, and the mean of all inliers in even bins of `over`.

    Args:
        points: the beams.
        rows: (n,) indices of those that are looked at.
        up, over: columns.
        colours: (N, 3) uint8 of all beams.
        shades: how many colours the dots have at most; the nearest is taken.
        lit: (N,) bool, beams that have their colours; all of them where None.
        marked: index of one beam, with a ring about it.
    """
    x, y = (points.columns[n].astype(float) * column(n).scale for n in (over, up))
    rows = rows[np.isfinite(x[rows]) & np.isfinite(y[rows])]
    if not len(rows):
        return EMPTY
    means = binned(x[rows], y[rows], points.inlier[rows])
    thin = np.arange(0, len(rows), max(1, -(-len(rows) // MOST_DOTS)))
    thin = np.union1d(thin, np.flatnonzero(rows == marked))
    thin = thin[np.argsort(x[rows[thin]], kind="stable")]
    dots = rows[thin]
    palette, group = _palette(colours[dots], shades)
    if lit is not None:
        palette, group = [FAINT, *palette], np.where(lit[dots], group + 1, 0)
    series: list[Mapping[str, Any]] = [{"label": column(over).heading}]
    data = [x[dots]]
    for i, colour in enumerate(palette):
        data.append(np.where(group == i, y[dots], np.nan))
        series.append({"label": "beams", **_dots(colour)})
    if marked in rows:
        data.append(np.where(dots == marked, y[dots], np.nan))
        series.append({"label": "clicked", **_dots("rgba(0,0,0,0)", RING_COLOUR, 12)})
    data.append(means[thin])
    series.append({"label": "mean", "stroke": MEAN, "width": 2, "points": {"show": False}})
    return tuple(data), tuple(series)


def axes(x: np.ndarray, low: float, high: float) -> dict[str, Any]:
    """Scales: along all of x (n,), which rises; and from low to high."""
    room = 0.03 * (x[-1] - x[0]) or 0.5
    across = {"time": False, "range": (float(x[0] - room), float(x[-1] + room))}
    return {"x": across, "y": {"auto": False, "range": (low, high if high > low else low + 1)}}


def binned(x: np.ndarray, y: np.ndarray, inlier: np.ndarray) -> np.ndarray:
    """At each of N beams the mean y of the inliers in its bin of x; NaN where they are few."""
    low, high = x.min(), x.max()
    place = np.minimum((x - low) / max(high - low, 1e-12) * LINE_BINS, LINE_BINS - 1).astype(int)
    count = np.bincount(place[inlier], minlength=LINE_BINS)
    total = np.bincount(place[inlier], weights=y[inlier], minlength=LINE_BINS)
    return np.where(count < FEWEST_IN_BIN, np.nan, total / np.maximum(count, 1))[place]


def _palette(colours: np.ndarray, shades: int) -> tuple[list[str], np.ndarray]:
    """At most so many of the colours (n, 3) that are there, and the nearest of them for each."""
    distinct = np.unique(colours, axis=0).astype(float)
    chosen = distinct[np.linspace(0, len(distinct) - 1, min(shades, len(distinct))).astype(int)]
    apart = np.square(colours[:, None].astype(float) - chosen[None]).sum(axis=2)
    names = ["#" + bytes(int(c) for c in colour).hex() for colour in chosen]
    return names, np.argmin(apart, axis=1)


def _dots(colour: str, edge: str = "", size: int = 4) -> dict[str, Any]:
    points = {"show": True, "size": size, "fill": colour, "stroke": edge or colour}
    points["width"] = 2 if edge else 0
    return {"stroke": "rgba(0,0,0,0)", "width": 0, "points": points}
