"""Numbers as colours: signed ones about grey, others from dark to bright, names each their own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from calib.show.scale import round_up
from calib.view.scene import Points
from calib.view.shown import columns
from calib.view.shown.columns import LOCATION, STOP

# Blue to vermilion about a grey that shows on white walls: told apart by every kind of sight.
SIGNED = ("#08306b", "#2171b5", "#6baed6", "#b9bdc1", "#fd8d3c", "#d94801", "#7f2704")
# Dark to bright, evenly: matplotlib's viridis.
RISING = ("#440154", "#472d7b", "#3b528b", "#2c728e", "#21918c", "#28ae80", "#5ec962", "#addc30")
# For names: Okabe and Ito's, then darker and paler ones of the same hues.
NAMED = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00", "#f0e442", "#555555")
NAMED += ("#003a5c", "#7a5400", "#004d38", "#7d3560", "#b8def5", "#7a3600", "#8f8700", "#d9c4a0")
UNKNOWN_COLOUR = "#999999"
SHARE = 0.98  # of the points lie within the scale


@dataclass(frozen=True)
class Column:
    """How a column is shown: its name, its unit, what a value is multiplied by; and of one that is
    shown about 0, what less and more than 0 are called."""

    title: str
    unit: str = ""
    scale: float = 1.0
    signed: tuple[str, str] | None = None

    @property
    def heading(self) -> str:
        """Its name and its unit."""
        return f"{self.title}, {self.unit}" if self.unit else self.title


def _residual(title: str, than: str = "") -> Column:
    """A residual, or a difference of two."""
    return Column(title, "mm", 1e3, (f"short{than}", f"long{than}"))


COLUMNS = {
    "residual_m": _residual("residual"),
    columns.HELD_OUT: _residual("residual held out"),
    columns.LESS_FITTED: _residual("held out less fitted", "er"),
    columns.OTHER: _residual("residual in the other run"),
    columns.DIFFERENCE: _residual("difference to the other run", "er"),
    columns.OTHER_HELD_OUT: _residual("held out in the other run"),
    columns.HELD_OUT_DIFFERENCE: _residual("held out, difference to the other run", "er"),
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
    STOP: Column("number of the stop"),
    LOCATION: Column("location"),
}
NAMES = ("label", LOCATION)  # numbers that stand for names
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
        signed: what less and more than 0 are called, where 0 is in the middle.
    """

    title: str
    unit: str
    low: float | None
    high: float | None
    stops: tuple[str, ...]
    names: Mapping[str, str]
    signed: tuple[str, str] | None = None


def column(name: str) -> Column:
    """How a column is shown; one that the recording's maker added, under its own name."""
    return COLUMNS.get(name) or Column(name)


def choices(points: Points) -> list[str]:
    """Columns that the points can be coloured by, the residual first."""
    known = [name for name in COLUMNS if name in points.columns]
    own = [n for n in points.columns if n not in COLUMNS and n not in HIDDEN]
    return [n for n in (*known, *own) if np.isfinite(points.columns[n]).any()]


def scale_key(name: str) -> str:
    """The column whose scale another shares: all residuals have one."""
    return "residual_m" if column(name).signed else name


def limits(points: Points, name: str) -> tuple[float, float]:
    """Ends of a scale that nearly all points are within, in the unit that is shown."""
    shown = column(name)
    known = points.columns[name] * shown.scale
    known = known[np.isfinite(known)]
    if shown.signed:
        high = round_up(float(np.quantile(np.abs(known), SHARE)) if len(known) else 0.0)
        return -high, high
    edge = (1 - SHARE) / 2
    low, high = np.quantile(known, [edge, 1 - edge]) if len(known) else (0.0, 1.0)
    return float(low), float(high)


def coloured(
    points: Points,
    name: str,
    names: Mapping[int, str],
    ends: tuple[float, float] | None = None,
) -> tuple[np.ndarray, Scale]:
    """Colours (N, 3) uint8 of all points by one column, and what they mean.

    Args:
        points: of a stop.
        name: the column.
        names: what its numbers stand for, of one of `NAMES`.
        ends: of the scale; `limits` where there are none.
    """
    shown, values = column(name), points.columns[name]
    if name in NAMES:
        return _by_name(values.astype(int), names, shown.title)
    low, high = ends or limits(points, name)
    stops = SIGNED if shown.signed else RISING
    place = (values * shown.scale - low) / max(high - low, 1e-12)
    return _between(place, stops), Scale(
        title=shown.title,
        unit=shown.unit,
        low=low,
        high=high,
        stops=stops,
        names={},
        signed=shown.signed,
    )


def _by_name(labels: np.ndarray, names: Mapping[int, str], title: str) -> tuple[np.ndarray, Scale]:
    distinct, index = np.unique(labels, return_inverse=True)
    colours = [UNKNOWN_COLOUR if n < 0 else NAMED[i % len(NAMED)] for i, n in enumerate(distinct)]
    titles = [names.get(int(n), f"{title} {n}") for n in distinct]
    legend = dict(zip(titles, colours, strict=True))
    return _rgb(colours)[index], Scale(
        title=title, unit="", low=None, high=None, stops=(), names=legend
    )


def _between(place: np.ndarray, stops: tuple[str, ...]) -> np.ndarray:
    """Colours (N, 3) at places 0 to 1 between even stops; grey where there is no number."""
    at = np.linspace(0.0, 1.0, len(stops))
    channels = [np.interp(np.clip(place, 0.0, 1.0), at, c) for c in _rgb(stops).T]
    colours = np.stack(channels, axis=1)
    colours[~np.isfinite(place)] = _rgb((UNKNOWN_COLOUR,))[0]
    return np.rint(colours).astype(np.uint8)


def _rgb(colours: tuple[str, ...] | list[str]) -> np.ndarray:
    """(n, 3) uint8 of colours as #rrggbb."""
    return np.array([list(bytes.fromhex(c[1:])) for c in colours], np.uint8).reshape(-1, 3)
