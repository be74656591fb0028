"""Terms of a formula: products of functions of one covariate each, and the constants in them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from calib.diagnosis.formulas.factors import Columns, Factor, product_of
from calib.diagnosis.formulas.table import Projection

CLOSER = (0.04, 0.04, 0.01, 0.0025)  # of a covariate's range, between places that are tried
PLACES_BESIDE = (0, -4, -3, -2, -1, 1, 2, 3, 4)  # which of them; where none is better, it stays
NUDGE = 0.01  # of a covariate's range, for the derivative by a constant
GAUSS_NEWTON_STEPS = 6  # of Gauss-Newton; two or three are enough from where the places are
STEP_PARTS = (1.0, 0.5, 0.25)  # of a step that are tried
ROUNDING = 1e-9  # of what is explained: places no pose lies between are equally good
ENOUGH = 1e-4  # of what is explained: steps that gain less are the last


@dataclass(frozen=True)
class FormulaTerm:
    """A product of functions of different covariates; its columns are all products of theirs.

    Args:
        factors: these.
    """

    factors: tuple[Factor, ...]

    @property
    def covariates(self) -> tuple[str, ...]:
        return tuple(f.covariate for f in self.factors)

    @property
    def texts(self) -> tuple[str, ...]:
        """Its columns as formulas."""
        return tuple(times(texts) for texts in product(*(f.texts for f in self.factors)))

    @property
    def cost(self) -> float:
        """How much there is to it."""
        return sum(f.cost for f in self.factors)

    @property
    def constants(self) -> tuple[float, ...]:
        """Those that are to be found."""
        return tuple(c for f in self.factors for c in f.constants[: f.free])

    def at(self, constants: Sequence[float]) -> FormulaTerm:
        """The same with other constants."""
        left, out = list(constants), []
        for f in self.factors:
            out.append(f.at(tuple(left[: f.free])))
            del left[: f.free]
        return FormulaTerm(tuple(out))

    def columns(self, covariates: Columns) -> np.ndarray:
        """(N, k)."""
        return product_of([f.columns(covariates) for f in self.factors])

    def gaps(self, covariates: Columns) -> np.ndarray:
        """(c, 2) as of `Factor.gaps`, among the beams where the other factors are not zero."""
        there = [np.any(f.columns(covariates) != 0.0, axis=1) for f in self.factors]
        every = np.ones_like(there[0])
        seen = [np.all([every, *(t for t in there if t is not mine)], axis=0) for mine in there]
        pairs = zip(self.factors, seen, strict=True)
        return np.vstack([f.gaps(covariates[f.covariate][at]) for f, at in pairs])


def refine(projection: Projection, term: FormulaTerm, kept: Sequence[int] = ()) -> FormulaTerm:
    """A term with those constants that explain most, from where they are: places beside each are
    tried, ever closer, as where an edge is has no slope; then all go together (Gauss-Newton).

    Args:
        projection: the table, and the model fitted to it.
        term: with the constants to start from.
        kept: which of its columns count; all where there are none.
    """
    kept = list(kept) or list(range(len(term.texts)))
    if not term.constants:
        return term
    covariates = projection.table.covariates
    ends, wide = _ends(term, covariates), _wide(term, covariates)
    for size in CLOSER:
        for i in range(len(wide)):
            places = np.clip(term.constants[i] + size * wide[i] * np.array(PLACES_BESIDE), *ends[i])
            tried = [term.at(_with(term.constants, i, place)) for place in places.tolist()]
            columns = _changed(term, tried, covariates)
            explained, _ = projection.explained([each[:, kept] for each in columns])
            term = tried[_best(explained)]
    return _descended(projection, term, kept, ends)


def slopes(
    covariates: Columns, term: FormulaTerm, kept: Sequence[int], amount: np.ndarray
) -> np.ndarray:
    """Derivative (N, c) by its constants of a term whose columns `kept` have amounts (k,)."""
    ends, out = _ends(term, covariates), []
    for i, by in enumerate(NUDGE * _wide(term, covariates)):
        # Within bounds: a scale that changes its sign overflows.
        high, low = np.clip([term.constants[i] + by, term.constants[i] - by], *ends[i]).tolist()
        sides = [term.at(_with(term.constants, i, value)) for value in (high, low)]
        up, down = (c[:, kept] @ amount for c in _changed(term, sides, covariates))
        out.append((up - down) / max(high - low, 1e-300))
    rows = len(next(iter(covariates.values())))
    return np.stack(out, axis=1) if out else np.zeros((rows, 0))


def times(texts: Sequence[str]) -> str:
    """A product of formulas; ones are left out."""
    some = [text for text in texts if text != "1"]
    if len(some) < 2:
        return some[0] if some else "1"
    return " * ".join(f"({text})" for text in some)


def _descended(
    projection: Projection, term: FormulaTerm, kept: Sequence[int], ends: np.ndarray
) -> FormulaTerm:
    """A term after steps of all its constants together, each of which explains more."""
    covariates = projection.table.covariates

    def explained(some: Sequence[FormulaTerm]) -> np.ndarray:
        columns = _changed(term, some, covariates)
        return projection.explained([each[:, kept] for each in columns])[0]

    (best,) = explained([term])
    for _ in range(GAUSS_NEWTON_STEPS):
        columns = term.columns(covariates)[:, kept]
        _, amount = projection.fitted(columns)
        along = slopes(covariates, term, kept, amount)
        _, both = projection.fitted(np.hstack([columns, along]))
        now, step = np.array(term.constants), both[len(kept) :]
        tried = [term.at(np.clip(now + part * step, *ends.T).tolist()) for part in STEP_PARTS]
        found = explained(tried)
        gain = found.max() - best
        if gain > ROUNDING * best:
            term, best = tried[_best(found)], found.max()
        if gain < ENOUGH * best:
            break
    return term


def _best(explained: np.ndarray) -> int:
    """The first of those that explain most: which of several alike is no matter of rounding."""
    return int(np.argmax(explained >= (1.0 - ROUNDING) * explained.max()))


def _changed(
    term: FormulaTerm, some: Sequence[FormulaTerm], covariates: Columns
) -> list[np.ndarray]:
    """Columns (N, k) of terms that have most of their factors in common with another."""
    made = {f: f.columns(covariates) for f in term.factors}
    return [product_of([_made(f, made, covariates) for f in each.factors]) for each in some]


def _made(factor: Factor, made: dict[Factor, np.ndarray], covariates: Columns) -> np.ndarray:
    return made[factor] if factor in made else factor.columns(covariates)


def _ends(term: FormulaTerm, covariates: Columns) -> np.ndarray:
    """(c, 2) of each constant the least and largest value."""
    return np.concatenate([f.bounds(covariates[f.covariate]) for f in term.factors])


def _wide(term: FormulaTerm, covariates: Columns) -> np.ndarray:
    """(c,) the range of the covariate of each constant, of the values that there are."""
    seen = [covariates[f.covariate] for f in term.factors]
    wide = [np.nanmax(values) - np.nanmin(values) for values in seen]
    return np.repeat(wide, [f.free for f in term.factors])


def _with(constants: Sequence[float], i: int, value: float) -> list[float]:
    return [value if k == i else c for k, c in enumerate(constants)]
