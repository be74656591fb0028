"""One column of the beams against another, as a chart of uPlot: dots in the colours of the room."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from calib.view.scene import Points
from calib.view.shown import sizes
from calib.view.shown.colours import column

DOT = 4  # px
MOST_DOTS = 3000  # more would hide each other on a panel of 400 pixels
BINS, FEWEST = 16, 5  # of the line of means, and beams in one: of fewer a mean says little
MEAN = "#d6278a"  # apart from all colours of dots, on light and on dark
FAINT = "rgba(128,128,128,0.3)"  # of dots that are not lit, on light and on dark
RING = "#13a10e"  # about the beam that was clicked, apart from those
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
    steps: np.ndarray | None = None,
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
        steps: (N,) of the size of each dot, as `sizes` has them; all are alike where None.
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
    for size, among in _by_size(None if steps is None else steps[dots]):
        for i, colour in enumerate(palette):
            some = (group == i) & among
            if steps is None or some.any():
                data.append(np.where(some, y[dots], np.nan))
                series.append({"label": "beams", **_dots(colour, size=size)})
    if marked in rows:
        data.append(np.where(dots == marked, y[dots], np.nan))
        series.append({"label": "clicked", **_dots("rgba(0,0,0,0)", RING, 12)})
    data.append(means[thin])
    series.append({"label": "mean", "stroke": MEAN, "width": 2, "points": {"show": False}})
    return tuple(data), tuple(series)


def axes(xs: Sequence[np.ndarray], low: float, high: float) -> dict[str, Any]:
    """Scales of all plots: along all of each x (n,), and from low to high."""
    x = np.concatenate([np.zeros(0), *xs])
    left, right = (x.min(), x.max()) if len(x) else (0.0, 0.0)
    room = 0.03 * (right - left) or 0.5
    across = {"time": False, "range": (float(left - room), float(right + room))}
    return {"x": across, "y": {"auto": False, "range": (low, high if high > low else low + 1)}}


def binned(x: np.ndarray, y: np.ndarray, inlier: np.ndarray) -> np.ndarray:
    """At each of N beams the mean y of the inliers in its bin of x; NaN where they are few."""
    low, high = x.min(), x.max()
    place = np.minimum((x - low) / max(high - low, 1e-12) * BINS, BINS - 1).astype(int)
    count = np.bincount(place[inlier], minlength=BINS)
    total = np.bincount(place[inlier], weights=y[inlier], minlength=BINS)
    return np.where(count < FEWEST, np.nan, total / np.maximum(count, 1))[place]


def _palette(colours: np.ndarray, shades: int) -> tuple[list[str], np.ndarray]:
    """At most so many of the colours (n, 3) that are there, far apart from each other, and the
    nearest of them for each."""
    distinct = np.unique(colours, axis=0).astype(float)
    chosen, apart = [0], np.full(len(distinct), np.inf)
    while len(chosen) < min(shades, len(distinct)):
        apart = np.minimum(apart, np.square(distinct - distinct[chosen[-1]]).sum(axis=1))
        chosen.append(int(np.argmax(apart)))
    kept = distinct[np.sort(chosen)]
    nearest = np.square(colours[:, None].astype(float) - kept[None]).sum(axis=2)
    names = ["#" + bytes(int(c) for c in colour).hex() for colour in kept]
    return names, np.argmin(nearest, axis=1)


def _by_size(steps: np.ndarray | None) -> Iterator[tuple[float, np.ndarray | bool]]:
    """Size of dots, and which of them (n,) have it; the large ones first, as they would hide
    the others."""
    if steps is None:
        yield DOT, True
        return
    for step in reversed(range(len(sizes.FACTORS))):
        yield DOT * sizes.FACTORS[step], steps == step


def _dots(colour: str, edge: str = "", size: float = DOT) -> dict[str, Any]:
    points = {"show": True, "size": size, "fill": colour, "stroke": edge or colour}
    points["width"] = 2 if edge else 0
    return {"stroke": "rgba(0,0,0,0)", "width": 0, "points": points}
