"""The study's figures 2 to 9, of uncorrected returns at the study's own poses."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from calib.report import plots

from .case import STEEP_RAD, Columns

if TYPE_CHECKING:
    from calib.report.plots import Figure

BRIGHT = 0.4
"""Of the FARO's intensity: what Fig. 9 takes for high reflectivity."""
NEAR_M, FAR_M = 1.5, 6.0  # Fig. 9's ranges
FEW = 30  # directions in a bin
LEAST_STEEP_RAD = np.radians(60.0)

Points = Mapping[str, Columns]  # sensor -> its points


def curve(
    x: np.ndarray, y: np.ndarray, edges: np.ndarray, middle: str = "mean"
) -> tuple[np.ndarray, np.ndarray]:
    """Middle of each bin of x that holds enough, and mean or median (B,) of y there."""
    at = np.digitize(x, edges) - 1
    known = np.isfinite(y)
    value = {"mean": np.mean, "median": np.median}[middle]
    bins = [b for b in range(len(edges) - 1) if np.count_nonzero((at == b) & known) >= FEW]
    return (
        (edges[:-1] + np.diff(edges) / 2)[bins],
        np.array([value(y[(at == b) & known]) for b in bins]),
    )


def by_incidence(points: Columns, column: str, middle: str = "mean") -> tuple:
    """A column's mean or median against incidence in degrees."""
    angle = np.degrees(points["incidence_rad"])
    return curve(angle, points[column].astype(float), np.arange(0.0, 90.0, 2.5), middle)


def by_distance(points: Columns) -> tuple[np.ndarray, np.ndarray]:
    """Precision, m, against distance, m, of beams that meet their surface under 60 degrees."""
    some = points["incidence_rad"] < LEAST_STEEP_RAD
    x, y = points["distance_m"][some], points["precision_m"][some].astype(float)
    return curve(x, y, np.arange(0.5, 8.0, 0.5))


def by_ring(points: Columns, rings: int) -> np.ndarray:
    """Median signed error (rings,) m under Fig. 9's filter, NaN of rings with few directions."""
    some = (points["incidence_rad"] < STEEP_RAD) & (points["reference_intensity"] > BRIGHT)
    some &= (points["distance_m"] > NEAR_M) & (points["distance_m"] < FAR_M)
    out = np.full(rings, np.nan)
    edges = np.arange(rings + 1) - 0.5
    ring, error_m = points["ring"][some], points["raw_signed_error_m"][some].astype(float)
    middles, values = curve(ring, error_m, edges, "median")
    out[middles.astype(int)] = values
    return out


def draw(
    points: Points,
    labels: Mapping[int, str],
    rings: Mapping[str, Mapping[str, np.ndarray]],
    folder: Path,
) -> dict[str, str]:
    """Draw all figures as PNG.

    Args:
        points: by sensor.
        labels: name of each material.
        rings: sensor -> what a ring's range offset is (rings,) m, by who says so.
        folder: where to write.

    Returns:
        File name -> caption.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with plots.styled():
        figures = _all(points, labels, rings)
    for name, (figure, _) in figures.items():
        plots.save(figure, folder / name)
    return {name: caption for name, (_, caption) in figures.items()}


def _all(
    points: Points, labels: Mapping[int, str], rings: Mapping[str, Mapping[str, np.ndarray]]
) -> dict[str, tuple[Figure, str]]:
    """File name -> figure and caption."""
    return {
        "2-3_histograms.png": (
            _histograms(points),
            "Figures 2 and 3: precision, and signed range error, by direction.",
        ),
        "4-6_incidence.png": (
            _incidence(points),
            "Figures 4 to 6: signed range error (median), precision and intensity (means) against "
            "the incidence angle.",
        ),
        "7_distance.png": (
            _distance(points),
            "Figure 7: precision against distance, of beams under 60°.",
        ),
        "8_labels.png": (
            _labels(points, labels),
            "Figure 8: precision and intensity by material, in order of the FARO's intensity.",
        ),
        "9_rings.png": (
            _rings(points, rings),
            "Figure 9: signed range error by ring; FARO intensity above 0.4, under 70°, 1.5 to "
            "6 m. Dots: median residuals, as the study has them; lines: the truth, and the graph.",
        ),
    }


def _colours(points: Points) -> list[tuple[str, Columns, str]]:
    return [(s, p, c) for (s, p), c in zip(points.items(), plots.LINES, strict=False)]


def _histograms(points: Points) -> Figure:
    figure, ((left, right),) = plots.axes(plots.WIDE_IN, 3.0, 1, 2)
    for sensor, table, colour in _colours(points):
        for ax, column, edges in (
            (left, "precision_m", np.arange(0, 25.25, 0.25)),
            (right, "raw_signed_error_m", np.arange(-40, 61, 1.0)),
        ):
            values = 1e3 * table[column].astype(float)
            share, _ = np.histogram(values[np.isfinite(values)], edges)
            share = 100 * share / len(values) / (edges[1] - edges[0])
            ax.stairs(share, edges, color=colour, label=sensor, linewidth=1.3)
    left.set(xlabel="precision, mm", ylabel="% of directions per mm")
    right.set(xlabel="measured - true range, mm")
    left.legend()
    return figure


def _incidence(points: Points) -> Figure:
    figure, (axes,) = plots.axes(plots.WIDE_IN, 2.9, 1, 3)
    for sensor, table, colour in _colours(points):
        x, y = by_incidence(table, "raw_signed_error_m", "median")
        axes[0].plot(x, 1e3 * y, color=colour, label=sensor)
        x, y = by_incidence(table, "precision_m")
        axes[1].plot(x, 1e3 * y, color=colour)
        axes[2].plot(*by_incidence(table, "intensity"), color=colour)
    for ax, what in zip(axes, ("signed error, mm", "precision, mm", "intensity"), strict=True):
        ax.set(xlabel="incidence, degrees", title=what, xticks=range(0, 91, 30))
    axes[0].legend()
    return figure


def _distance(points: Points) -> Figure:
    figure, ((ax,),) = plots.axes(plots.HALF_IN, 3.0)
    for sensor, table, colour in _colours(points):
        x, y = by_distance(table)
        ax.plot(x, 1e3 * y, color=colour, label=sensor)
    ax.set(xlabel="distance, m", ylabel="precision, mm", ylim=(0, None))
    ax.legend()
    return figure


def _labels(points: Points, labels: Mapping[int, str]) -> Figure:
    figure, ((upper,), (lower,)) = plots.axes(plots.WIDE_IN, 5.0, 2, 1, sharex=True)
    first = next(iter(points.values()))
    faro = {n: np.mean(first["reference_intensity"][first["label"] == n]) for n in labels}
    order = sorted((n for n in labels if np.isfinite(faro[n])), key=faro.get)
    for sensor, table, colour in _colours(points):
        for ax, column, scale in ((upper, "precision_m", 1e3), (lower, "intensity", 1.0)):
            by = [_mean(table[column][table["label"] == n], scale) for n in order]
            ax.plot(range(len(order)), by, "o-", color=colour, label=sensor, markersize=4)
    upper.set(ylabel="precision, mm")
    lower.set(ylabel="intensity")
    names = [f"{labels[n].replace('_', ' ')}\n{faro[n]:.2f}" for n in order]
    lower.set_xticks(range(len(order)), names, rotation=60, ha="right", fontsize=8)
    upper.legend(ncols=4)
    return figure


def _mean(values: np.ndarray, scale: float) -> float:
    known = values[np.isfinite(values)]
    return scale * float(known.mean()) if len(known) >= FEW else np.nan


def _rings(points: Points, rings: Mapping[str, Mapping[str, np.ndarray]]) -> Figure:
    figure, (axes,) = plots.axes(plots.WIDE_IN, 3.0, 1, len(points))
    styles = ((plots.PALE, 2.5), (plots.AFTER, 1.0))
    for (sensor, table, _), ax in zip(_colours(points), axes, strict=True):
        for (who, offset_m), (colour, width) in zip(rings[sensor].items(), styles, strict=False):
            ax.plot(1e3 * offset_m, color=colour, linewidth=width, label=who)
        median_m = by_ring(table, len(next(iter(rings[sensor].values()))))
        ax.plot(1e3 * median_m, ".", color=plots.BEFORE, markersize=3, label="residuals")
        ax.set(xlabel="ring", title=sensor)
    axes[0].set(ylabel="range offset, mm")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper right", ncols=3)
    return figure
