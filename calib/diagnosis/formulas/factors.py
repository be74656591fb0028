"""Functions of one covariate that formulas are made of: without a unit, as text and as columns.

A factor has columns whose coefficients are linear, and constants that are not: where a step is, how
long a period. Its text is what `calib.effects.own.expression` reads, so what is fitted, written and
added is one thing.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import combinations

import numpy as np

from calib.effects import View
from calib.effects.own.expression import Expression

Columns = Mapping[str, np.ndarray]

STEP_PLACES = 16  # places at which a step is tried first
WINDOW = 12  # edges between which a window is tried first
CENTRES, WIDTHS = 8, (0.06, 0.15)  # of bumps; of the covariate's range
SCALES = (0.1, 0.25, 0.6)  # of exponentials, of the covariate's range
PERIODS = tuple(np.geomspace(0.1, 1.5, 24))  # of waves, of the covariate's range
WIDEST, NARROWEST = 3.0, 0.005  # scales and widths, of the covariate's range
RING_BLOCKS = (2.0, 4.0, 8.0, 16.0, 32.0)  # rings that a chip, or a bank of chips, has
A_PERIOD = 6  # values that a period must have, of those that can be told apart
HARMONICS = 12  # of harmonics of an angle
FEWEST_VALUES = 3  # of a covariate that is not a class
WIDE_ENOUGH = 1.5  # largest over smallest value, from which powers differ from a line
LEAST_SHARE = 0.005  # of the beams that a class must have
# Columns that name a part of the room, a beam or a stop, and so are no covariate; the rest of the
# room is in range, incidence and label.
NOT_COVARIATES = {"surface", "region", "patch", "plane", "column", "elapsed_s"}
NOT_COVARIATES |= {"reference_intensity", "stop", "location", "tracked", "normal", "point_m"}


@dataclass(frozen=True)
class FactorKind:
    """A sort of factor.

    Args:
        columns: its columns; ``{x}`` is the covariate, ``{0}``, ``{1}`` the constants.
        cost: how much there is to it: what takes the place of what, where data cannot tell.
        free: how many of the constants, from the first, are to be found.
        scales: which of these are a scale, not a place.
        edges: whether these are edges, of which values between two neighbours are one.
    """

    columns: tuple[str, ...]
    cost: float
    free: int = 0
    scales: tuple[int, ...] = ()
    edges: bool = False


# The 1 beside a line, a square and a logarithm lets the place of their zero be found.
FACTOR_KINDS = {
    "line": FactorKind(("({x} - {0}) / {1}", "1"), 1.0),
    "proportional": FactorKind(("{x} / {0}",), 0.9),
    "square": FactorKind(("(({x} - {0}) / {1})**2", "({x} - {0}) / {1}", "1"), 2.5),
    "logarithm": FactorKind(("log({x} / {0})", "1"), 1.5),
    "saturation": FactorKind(("log(1 + {x} / {0})",), 2.0, free=1, scales=(0,)),
    "share": FactorKind(("{x} / ({x} + {0})",), 2.0, free=1, scales=(0,)),
    "root": FactorKind(("sqrt({x} / {0})",), 1.5),
    "power": FactorKind(("({x} / {0})**{1}",), 1.5),
    "reciprocal": FactorKind(("{0} / {x}",), 1.5),
    "decay": FactorKind(("exp(-({x} - {1}) / {0})",), 2.0, free=1, scales=(0,)),
    "growth": FactorKind(("exp(({x} - {1}) / {0})",), 2.0, free=1, scales=(0,)),
    "wave": FactorKind(
        ("sin(2 * pi * {x} / {0})", "cos(2 * pi * {x} / {0})"), 2.5, free=1, scales=(0,)
    ),
    "harmonic": FactorKind(("sin({0} * {x})", "cos({0} * {x})"), 2.0),
    "step": FactorKind(("{x} > {0}",), 2.0, free=1, edges=True),
    "window": FactorKind(("({x} > {0}) * ({x} < {1})",), 2.5, free=2, edges=True),
    "outside": FactorKind(("({x} < {0}) + ({x} > {1})",), 2.5, free=2, edges=True),
    "ramp": FactorKind(("maximum(0, {x} - {0}) / {1}",), 2.0, free=1),
    "ramp down": FactorKind(("maximum(0, {0} - {x}) / {1}",), 2.0, free=1),
    "bump": FactorKind(("exp(-(({x} - {0}) / {1})**2)",), 2.5, free=2, scales=(1,)),
    "over cosine": FactorKind(("1 / cos({x}) - 1",), 1.0),
    "tangent": FactorKind(("tan({x})",), 1.0),
    "tangent squared": FactorKind(("tan({x})**2",), 1.5),
    "sine": FactorKind(("sin({x})",), 1.0),
    "cosine": FactorKind(("cos({x})", "1"), 1.2),
    "every other": FactorKind(("where(mod({x}, 2) > 0.5, 1, -1)",), 1.5),
    "block": FactorKind(("where(mod(floor({x} / {0}), 2) > 0.5, 1, -1)",), 1.8),
    "one of": FactorKind(("mod({x}, {0}) == {1}",), 2.0),
    "class": FactorKind(("{x} == {0}",), 1.0),
}


@dataclass(frozen=True)
class Factor:
    """One function of one covariate.

    Args:
        covariate: its name.
        kind: of `FACTOR_KINDS`.
        constants: those that the kind's columns have.
    """

    covariate: str
    kind: str
    constants: tuple[float, ...] = ()

    @property
    def texts(self) -> tuple[str, ...]:
        """Its columns as formulas."""
        return self.written(())

    def written(self, free: Sequence[str]) -> tuple[str, ...]:
        """The same with these in place of its first constants."""
        numbers = [*free, *(f"{c:.6g}" for c in self.constants[len(free) :])]
        found = (
            text.format(*numbers, x=self.covariate) for text in FACTOR_KINDS[self.kind].columns
        )
        return tuple(_plain(text, self.covariate) for text in found)

    @property
    def cost(self) -> float:
        return FACTOR_KINDS[self.kind].cost

    @property
    def free(self) -> int:
        """How many constants, from the first, are to be found."""
        return FACTOR_KINDS[self.kind].free

    def bounds(self, values: np.ndarray) -> np.ndarray:
        """(free, 2) least and largest value of the constants to be found: a place is among the
        covariate's values; a scale, or a width, is no larger than `WIDEST` times their range, where
        it could not be told from a line, nor so small that it is one value."""
        low, high = float(np.nanmin(values)), float(np.nanmax(values))
        scale = (high - low) * np.array([NARROWEST, WIDEST])
        kinds = FACTOR_KINDS[self.kind]
        found = [scale if i in kinds.scales else (low, high) for i in range(self.free)]
        return np.reshape(found, (self.free, 2))

    def gaps(self, values: np.ndarray) -> np.ndarray:
        """(free, 2) the values (N,) on both sides of each edge, between which it may be anywhere;
        of other constants these themselves."""
        found = np.repeat(np.reshape(self.constants[: self.free], (-1, 1)), 2, axis=1)
        known = np.unique(values[np.isfinite(values)])
        if not FACTOR_KINDS[self.kind].edges or len(known) < 2:
            return found
        after = np.clip(np.searchsorted(known, found[:, 0], side="right"), 1, len(known) - 1)
        return np.stack([known[after - 1], known[after]], axis=1)

    def columns(self, covariates: Columns) -> np.ndarray:
        """(N, k), with 0 where there is no value."""
        numbers = {f"c{i}": np.float64(f"{c:.6g}") for i, c in enumerate(self.constants)}
        at = {"x": covariates[self.covariate], **numbers}
        return _stacked([e.value(at.__getitem__) for e in _expressions(self.kind)], len(at["x"]))

    def at(self, constants: tuple[float, ...]) -> Factor:
        """The same with other free constants."""
        return replace(self, constants=(*constants, *self.constants[len(constants) :]))


def covariates_of(view: View) -> Iterator[tuple[str, np.ndarray]]:
    """Names and columns that residuals may depend on: (N,), or (1,) where one value holds for
    all."""
    for name in view.columns:
        if name in NOT_COVARIATES or name.startswith(("moved.", "travel.", "waited.")):
            continue
        values = np.asarray(view[name])
        if values.ndim == 1 and values.dtype.kind in "biuf":
            yield name, values


def columns_of(texts: tuple[str, ...], covariates: Columns) -> np.ndarray:
    """Columns (N, k) of formulas, with 0 where there is no value."""
    found = [Expression(t, "a finding").value(covariates.__getitem__) for t in texts]
    return _stacked(found, len(next(iter(covariates.values()))))


def product_of(columns: Sequence[np.ndarray]) -> np.ndarray:
    """(N, k) all products of columns (N, q) of several, those of the last side by side."""
    out = columns[0]
    for each in columns[1:]:
        out = (out[:, :, None] * each[:, None, :]).reshape(len(out), -1)
    return out


@cache
def _expressions(kind: str) -> tuple[Expression, ...]:
    """A kind's columns, of ``x`` and of constants ``c0``, ``c1``: parsed once."""
    texts = (text.format("c0", "c1", x="x") for text in FACTOR_KINDS[kind].columns)
    return tuple(Expression(text, "a finding") for text in texts)


def _stacked(found: Sequence[np.ndarray], rows: int) -> np.ndarray:
    """(N, k), with 0 where there is no value."""
    out = np.stack([np.broadcast_to(f, rows) for f in found], axis=1).astype(float)
    out[~np.isfinite(out)] = 0.0
    return out


def _plain(text: str, x: str) -> str:
    """A formula without what changes nothing: a zero taken off, a factor of one, two signs."""
    text = text.replace(f"({x} - -0)", x).replace(f"({x} - 0)", x)
    text = x if text == f"{x} / 1" else text
    return text.replace(f"(1 * {x})", f"({x})").replace("- -", "+ ")


def factors(name: str, values: np.ndarray, levels: int, angle: bool = False) -> list[Factor]:
    """All that are tried first of a covariate.

    Args:
        name: the covariate.
        values: (N,) of it.
        levels: how many values of it may be told apart: of a column of the stops, the stops.
        angle: whether it goes round, as azimuth does, and has harmonics.
    """
    known = values[np.isfinite(values)]
    distinct, count = np.unique(known, return_counts=True)
    if name == "label":
        often = distinct[count > LEAST_SHARE * len(known)]
        return [Factor(name, "class", (float(k),)) for k in often]
    if len(distinct) < FEWEST_VALUES:
        return [Factor(name, "step", (float(distinct.mean()),))] if len(distinct) > 1 else []
    out = [*_smooth(name, known, levels, angle), *_sharp(name, known, distinct, levels)]
    if name == "ring":
        out.append(Factor(name, "every other"))
        out += [Factor(name, "block", (size,)) for size in RING_BLOCKS]
        out += [Factor(name, "one of", (4.0, float(k))) for k in range(4)]
    return out


def _smooth(name: str, known: np.ndarray, levels: int, angle: bool) -> Iterator[Factor]:
    low, high = float(known.min()), float(known.max())
    wide, middle = high - low, _rounded((low + high) / 2, (high - low) / 2)
    half = _rounded(wide / 2, wide / 2)
    yield Factor(name, "line", (middle, half))
    yield Factor(name, "square", (middle, half))
    if low > 0.0 and high > WIDE_ENOUGH * low:
        scale = _rounded(float(np.sqrt(low * high)), wide)
        yield Factor(name, "logarithm", (scale,))
        yield Factor(name, "root", (scale,))
        yield Factor(name, "reciprocal", (scale,))
        yield from (Factor(name, "power", (scale, p)) for p in (2.0, 3.0))
    if low >= 0.0 and high > WIDE_ENOUGH * low:
        yield Factor(name, "proportional", (_rounded(high, wide),))
        sorts = ("saturation", "share")
        yield from (Factor(name, sort, (share * wide,)) for sort in sorts for share in SCALES)
    for share in SCALES:
        yield Factor(name, "decay", (share * wide, low))
        yield Factor(name, "growth", (share * wide, high))
    if name == "incidence_rad":
        sorts = ("over cosine", "tangent", "tangent squared", "sine", "cosine")
        yield from (Factor(name, sort) for sort in sorts)
    elif name == "elevation_rad":
        yield from (Factor(name, sort) for sort in ("tangent", "sine", "cosine"))
    if angle or name == "azimuth_rad":
        orders = min(HARMONICS, max(1, levels // A_PERIOD))
        yield from (Factor(name, "harmonic", (float(m),)) for m in range(1, orders + 1))
    else:
        slow = (share for share in PERIODS if share * levels > A_PERIOD)
        yield from (Factor(name, "wave", (share * wide,)) for share in slow)


def _sharp(name: str, known: np.ndarray, distinct: np.ndarray, levels: int) -> Iterator[Factor]:
    low, high = float(known.min()), float(known.max())
    wide = high - low
    places = np.unique(np.quantile(known, np.arange(1, STEP_PLACES + 1) / (STEP_PLACES + 1)))
    if len(distinct) < 4 * STEP_PLACES:  # between values: where a step is among them cannot be told
        at = np.unique(np.clip(np.searchsorted(distinct, places), 1, len(distinct) - 1))
        places = (distinct[at] + distinct[at - 1]) / 2
    yield from (Factor(name, "step", (float(t),)) for t in places)
    yield from (Factor(name, "ramp", (float(t), wide)) for t in places[1:-1:2])
    yield from (Factor(name, "ramp down", (float(t), wide)) for t in places[1:-1:2])
    if levels < 2 * WINDOW:
        return
    edges = np.linspace(low, high, WINDOW + 2)[1:-1]
    for a, b in combinations(edges.tolist(), 2):
        yield Factor(name, "window", (a, b))
        if name == "azimuth_rad":
            yield Factor(name, "outside", (a, b))
    for centre in np.linspace(low, high, CENTRES + 2)[1:-1].tolist():
        yield from (Factor(name, "bump", (centre, share * wide)) for share in WIDTHS)


def _rounded(value: float, of: float) -> float:
    """A number to as many digits as a tenth of a range has: a constant that nobody fits."""
    digits = 1 - int(np.floor(np.log10(max(abs(of), 1e-12))))
    return float(np.round(value, digits))
