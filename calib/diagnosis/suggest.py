"""What to do about a finding: a formula to add, a measurement to make."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Sequence
from itertools import count, pairwise
from typing import Any

import numpy as np

from calib.diagnosis.screen import Candidate
from calib.diagnosis.structure import ring_of
from calib.diagnosis.structure.empirical import (
    Binned,
    DirectionShape,
    JointShape,
    PoseSlope,
    RingSlope,
    middle_and_half,
)
from calib.effects import Effect, Site
from calib.effects.own.formula import FormulaEffect
from chains.errors import InputError

# Of the piecewise linear function that is suggested for one covariate, and of each of two; and of
# the harmonics of azimuth. A choice: with half as many knots as bins each has two bins to be fitted
# by, and a pair has 9 parameters.
SUGGESTED_KNOTS, PAIR_KNOTS = 7, 3
AZIMUTH_WAVES = 2

DESCRIBES = "Empirical, without a known cause; observed at"
# Endings of columns -> the unit that people read, and how many of it the column's unit is.
COLUMN_UNITS = {
    "_m": ("m", 1.0),
    "_rad": ("degrees", float(np.degrees(1.0))),
    "_s": ("s", 1.0),
    "_c": ("degrees C", 1.0),
    "_kg": ("kg", 1.0),
}
COLUMN_WORDS = {
    "range_m": "range",
    "incidence_rad": "incidence",
    "azimuth_rad": "azimuth",
    "elevation_rad": "elevation",
    "point_m": "where in the room the beam lands",
    "label": "material",
    "ring": "ring",
    "time_s": "time",
    "elapsed_s": "time",
    "waited.s": "how long the arm waits",
    "temperature_c": "temperature",
    "joints": "the arm's pose",
    "tracked": "the place of the tracked bodies",
    "intensity": "intensity",
}


def words(covariate: str) -> str:
    """A covariate in a roboticist's words."""
    return COLUMN_WORDS.get(covariate, covariate)


def formula(candidate: Candidate, taken: Collection[str] = ()) -> dict[str, Any] | None:
    """An effect as a formula that the user can add as it stands, empirical as it is.

    Piecewise linear over the covariate's bins, products of such for a pair, the strongest harmonics
    of azimuth; for a joint, harmonics of the joint that it depends on. None where there is no
    formula for it: of labels, or of a column that goes by no name of a formula.

    Args:
        candidate: structure that stands out.
        taken: names that the model has already.
    """
    effect = candidate.effect
    if isinstance(effect, JointShape):
        basis = [f"{f}({m} * {effect.other})" for m in (1, 2, 3) for f in ("sin", "cos")]
        rest = {"site": f"joint:{effect.joint}", "unit": "rad", "sigma": 0.003, "basis": basis}
    elif isinstance(effect, DirectionShape):
        rest = {"site": effect.what, "unit": "rad", "sigma": 0.003, "basis": effect.waves()}
    elif isinstance(effect, RingSlope):
        basis = [f"(ring == {effect.only}) * {_sloping(effect)}"]
        rest = {"site": "range", "unit": "m", "sigma": 0.01, "basis": basis}
    elif isinstance(effect, PoseSlope) and effect.formulas:
        site, move = effect.formulas[effect.only]
        rest = {"site": site, "unit": move.unit, "sigma": move.sigma, "basis": [_sloping(effect)]}
    elif isinstance(effect, Binned) and "label" not in effect.covariates:
        sides = [list(_shapes(c, effect, candidate)) for c in effect.covariates]
        basis = sides[0]
        for side in sides[1:]:
            basis = [f"({a}) * ({b})" for a in basis for b in side]
        rest = {"site": "range", "unit": "m", "sigma": 0.01, "basis": basis}
    else:
        return None
    bare = [c.removesuffix("_rad").removesuffix("_m") for c in hangs_on(effect)]
    if isinstance(effect, DirectionShape):
        bare = [effect.what, "by", *bare]
    elif isinstance(effect, RingSlope):
        bare = [f"ring_{effect.only:03d}", *bare[1:]]
    elif isinstance(effect, PoseSlope):
        bare = [rest["site"].removeprefix("tracker:"), "by", *bare]
    name = "_".join(["empirical", *(re.sub(r"\W", "_", c, flags=re.ASCII) for c in bare)])
    numbered = (f"{name}_{i}" for i in count(2))
    name = name if name not in taken else next(n for n in numbered if n not in taken)
    spans = {n: outward(*ends) for n, ends in effect.seen.items()}
    found = {"name": name, **rest, "seen": spans, "what": f"{DESCRIBES} {seen(effect)}."}
    try:
        FormulaEffect.read(found, "diagnosis.json", {})
    except InputError:
        return None
    return found


def _sloping(effect: RingSlope | PoseSlope) -> str:
    """The column from -1 to 1 over what was seen of it."""
    middle, half = middle_and_half(*effect.seen[effect.column])
    return f"({effect.column} - {middle:.9g}) / {half:.9g}"


def seen(effect: Binned | DirectionShape | JointShape | PoseSlope | RingSlope) -> str:
    """From where to where each covariate of structure went, in words."""
    suffix = "_rad" if isinstance(effect, JointShape) else ""
    return " and ".join(span(name, *ends, suffix) for name, ends in effect.seen.items())


def all_of(names: Sequence[str]) -> str:
    """Names in a sentence: ``a, b and c``."""
    return " and ".join(filter(None, [", ".join(names[:-1]), *names[-1:]]))


def span(name: str, low: float, high: float, suffix: str = "") -> str:
    """From where to where a column goes, in words; `suffix` where its name says no unit."""
    unit, scale = COLUMN_UNITS.get(suffix or f"_{name.rpartition('_')[2]}", ("", 1.0))
    ends = (f"{scale * x:.0f}" if abs(x) > 1e4 else f"{scale * x:.3g}" for x in (low, high))
    return f"{words(name)} from {' to '.join(ends)} {unit}".rstrip()


def outward(low: float, high: float) -> list[float]:
    """Both ends with three digits of what lies between them, not inside of where they were."""
    wide = high - low or max(abs(high), 1.0)
    digits = 2 - int(np.floor(np.log10(wide)))
    step = 10.0**-digits
    ends = np.floor(low / step) * step, np.ceil(high / step) * step
    return [round(float(end), digits) for end in ends]


def with_ring(covariates: Sequence[str], ring: int | None) -> list[str]:
    """The covariates of structure, with the number of the ring where one was tested by itself."""
    return [f"ring {ring}" if c == "ring" and ring is not None else c for c in covariates]


def in_words(effect: Effect) -> str:
    """The covariates of structure in a sentence."""
    return " and ".join(words(c) for c in with_ring(hangs_on(effect), ring_of(effect)))


def hangs_on(effect: Effect) -> tuple[str, ...]:
    """The covariates of structure, joints by their names."""
    if isinstance(effect, JointShape):
        return tuple(dict.fromkeys((effect.joint, effect.other)))
    return effect.covariates


def _shapes(covariate: str, effect: Binned, candidate: Candidate) -> Iterator[str]:
    if covariate == "azimuth_rad":
        waves = _strongest_waves(candidate) if len(effect.covariates) == 1 else (1, 2)
        yield from (f"{f}({m} * azimuth_rad)" for m in waves for f in ("sin", "cos"))
        return
    most = SUGGESTED_KNOTS if len(effect.covariates) == 1 else PAIR_KNOTS
    at = np.unique(np.quantile(effect.centres[covariate], np.linspace(0, 1, most)))
    gaps = [b - a for a, b in pairwise(at)]
    for i, knot in enumerate(at):
        left = gaps[max(i - 1, 0)]
        right = gaps[min(i, len(gaps) - 1)]
        rise = f"1 - ({knot:.9g} - {covariate}) / {left:.4g}"
        fall = f"1 - ({covariate} - {knot:.9g}) / {right:.4g}"
        yield f"maximum(0, minimum({rise}, {fall}))"


def _strongest_waves(candidate: Candidate) -> tuple[int, ...]:
    """Orders of the harmonics that fit what each bin of azimuth wants best."""
    centres = candidate.effect.centres["azimuth_rad"]
    wanted = candidate.test.estimate()
    orders = range(1, len(centres) // 3 + 1)
    power = [np.abs(np.sum(wanted * np.exp(1j * m * centres))) for m in orders]
    return tuple(sorted(int(m) + 1 for m in np.argsort(power)[::-1][:AZIMUTH_WAVES]))


def what_separates(a: Effect, b: Effect) -> str:
    """The measurement that would separate two effects, from what they depend on."""
    arm = (Site.EDGE, Site.JOINTS)
    return what_differs(a.covariates, b.covariates, a.site in arm or b.site in arm)


def what_differs(a: Collection[str], b: Collection[str], of_arm: bool = False) -> str:
    """The measurement that would separate what depends on some covariates from what does on others.

    Args:
        a, b: the covariates of both.
        of_arm: whether one of them is an effect of the arm.
    """
    mine, other = set(a), set(b)
    if mine - other and other - mine:
        return f"stops at which {_list(mine - other)} changes while {_list(other - mine)} does not"
    if mine ^ other:
        return f"stops that spread {_list(mine ^ other)} more widely"
    if of_arm:
        return "arm poses of other kinds: elbow up and down, wrist turned, another payload"
    return f"a wider spread of {_list(mine or {'poses'})}, the sensor rolled and tilted"


def _list(covariates: set[str]) -> str:
    return " and ".join(sorted({words(c) for c in covariates}))
