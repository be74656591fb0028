"""Numbers as colours: signed ones about grey, others from dark to bright, names each their own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from calib.show.scale import round_up
from calib.view.scene import Points

# Blue to vermilion about a grey that shows on white walls: told apart by every kind of sight.
SIGNED = ("#08306b", "#2171b5", "#6baed6", "#b9bdc1", "#fd8d3c", "#d94801", "#7f2704")
# Dark to bright, evenly: matplotlib's viridis.
RISING = ("#440154", "#472d7b", "#3b528b", "#2c728e", "#21918c", "#28ae80", "#5ec962", "#addc30")
# For names: Okabe and Ito's, then darker and paler ones of the same hues.
NAMED = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00", "#f0e442", "#555555")
NAMED += ("#003a5c", "#7a5400", "#004d38", "#7d3560", "#b8def5", "#7a3600", "#8f8700", "#d9c4a0")
UNKNOWN = "#999999"
SHARE = 0.98  # of the points lie within the scale


@dataclass(frozen=True)
class Column:
    """How a column is shown: its name, its unit, and what a value is multiplied by."""

    title: str
    unit: str = ""
    scale: float = 1.0

    @property
    def heading(self) -> str:
        """Its name and its unit."""
        return f"{self.title}, {self.unit}" if self.unit else self.title


COLUMNS = {
    "residual_m": Column("residual", "mm", 1e3),
    "range_m": Column("range", "m"),
    "incidence_rad": Column("incidence", "deg", 180 / np.pi),
    "ring": Column("ring"),
    "column": Column("column"),
    "azimuth_rad": Column("azimuth", "deg", 180 / np.pi),
    "elevation_rad": Column("elevation", "deg", 180 / np.pi),
    "intensity": Column("intensity", "of the median"),
    "label": Column("label"),
    "sigma_m": Column("sigma", "mm", 1e3),
    "weight": Column("weight in the fit"),
    "time_s": Column("time", "s"),
    "temperature_c": Column("temperature", "°C"),
}
HIDDEN = {"surface", "region", "patch", "plane"}  # numbers that mean nothing to people


@dataclass(frozen=True)
class Scale:
    """What colours mean.

    Args:
        title: of what.
        unit: of the ends.
        low, high: values at the ends of `stops`; None where colours stand for names.
        stops: colours at even steps from low to high.
        names: name -> colour.
    """

    title: str
    unit: str
    low: float | None
    high: float | None
    stops: tuple[str, ...]
    names: Mapping[str, str]


def column(name: str) -> Column:
    """How a column is shown; one that the recording's maker added, under its own name."""
    return COLUMNS.get(name) or Column(name)


def choices(points: Points) -> list[str]:
    """Columns that the points can be coloured by, the residual first."""
    known = [name for name in COLUMNS if name in points.columns]
    own = [n for n in points.columns if n not in COLUMNS and n not in HIDDEN]
    told = (n for n in known if np.isfinite(points.columns[n]).any())
    return [*told, *own]


def coloured(points: Points, name: str, label_names: Mapping[int, str]) -> tuple[np.ndarray, Scale]:
    """Colours (N, 3) uint8 of all points by one column, and what they mean.

    Args:
        points: of a stop.
        name: the column.
        label_names: of the reference's labels.
    """
    shown, values = column(name), points.columns[name]
    if name == "label":
        return _by_name(values.astype(int), label_names)
    values = values * shown.scale
    known = values[np.isfinite(values)]
    if name == "residual_m":
        high = round_up(float(np.quantile(np.abs(known), SHARE)) if len(known) else 0.0)
        low, stops = -high, SIGNED
    else:
        edge = (1 - SHARE) / 2
        low, high = np.quantile(known, [edge, 1 - edge]) if len(known) else (0.0, 1.0)
        stops = RISING
    place = (values - low) / max(high - low, 1e-12)
    return _between(place, stops), Scale(
        title=shown.title, unit=shown.unit, low=float(low), high=float(high), stops=stops, names={}
    )


def _by_name(labels: np.ndarray, names: Mapping[int, str]) -> tuple[np.ndarray, Scale]:
    distinct, index = np.unique(labels, return_inverse=True)
    colours = [UNKNOWN if n < 0 else NAMED[i % len(NAMED)] for i, n in enumerate(distinct)]
    titles = [names.get(int(n), f"label {n}") for n in distinct]
    legend = dict(zip(titles, colours, strict=True))
    return _rgb(colours)[index], Scale(
        title="label", unit="", low=None, high=None, stops=(), names=legend
    )


def _between(place: np.ndarray, stops: tuple[str, ...]) -> np.ndarray:
    """Colours (N, 3) at places 0 to 1 between even stops; grey where there is no number."""
    at = np.linspace(0.0, 1.0, len(stops))
    channels = [np.interp(np.clip(place, 0.0, 1.0), at, c) for c in _rgb(stops).T]
    colours = np.stack(channels, axis=1)
    colours[~np.isfinite(place)] = _rgb((UNKNOWN,))[0]
    return np.rint(colours).astype(np.uint8)


def _rgb(colours: tuple[str, ...] | list[str]) -> np.ndarray:
    """(n, 3) uint8 of colours as #rrggbb."""
    return np.array([list(bytes.fromhex(c[1:])) for c in colours], np.uint8).reshape(-1, 3)
