"""Which columns of the terms of a formula the data need."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np

from calib.diagnosis.formulas.factors import Factor
from calib.diagnosis.formulas.table import Projection
from calib.diagnosis.formulas.terms import FormulaTerm, refine, slopes
from calib.diagnosis.score import GAUGE

# Sigmas from zero, below which a column of a term is left out again: of ten columns that are not
# there, one in forty formulas keeps one.
CLEAR = 3.0


def needed(
    model: Projection, terms: Sequence[FormulaTerm], columns: Sequence[np.ndarray]
) -> list[list[int]]:
    """Of each term the columns that the data need: not those that the model absorbs, nor those
    that chance, or other constants, explain."""
    kept = [list(range(c.shape[1])) for c in columns]
    while True:
        some = [c[:, k] for c, k in zip(columns, kept, strict=True)]
        owner = [(i, c) for i, k in enumerate(kept) for c in k]
        if not owner:
            return kept
        alone, beside = _clear(model, terms, kept, some)
        for worst in np.argsort(beside, kind="stable").tolist():
            i, c = owner[worst]
            if beside[worst] > CLEAR:
                return kept
            # Beside constants that would go far, their slopes say little: they are tried.
            others = [each for k, each in enumerate(some) if k != i]
            rest = model.beside(np.hstack(others)) if alone[worst] > CLEAR and others else model
            if alone[worst] <= CLEAR or (
                alone[worst] * _alone(rest, terms[i], kept[i], c) <= CLEAR
            ):
                kept[i].remove(c)
                break
        else:
            return kept


def reduced(term: FormulaTerm, kept: Sequence[int]) -> tuple[FormulaTerm, list[int]]:
    """A term without factors that none of its kept columns has, squares of which but the line is
    kept as lines; and which columns of it are kept."""
    rows = [list(product(*(f.texts for f in term.factors)))[i] for i in kept]
    factors, at = [], []
    for i, each in enumerate(term.factors):
        texts = {row[i] for row in rows}
        if texts == {"1"}:
            continue
        if each.kind == "square" and each.texts[0] not in texts:
            each = Factor(each.covariate, "line", each.constants)
        factors.append(each)
        at.append(i)
    if not factors:
        return term, list(kept)
    every = list(product(*(f.texts for f in factors)))
    return FormulaTerm(tuple(factors)), [every.index(tuple(row[i] for i in at)) for row in rows]


def _clear(
    model: Projection,
    terms: Sequence[FormulaTerm],
    kept: Sequence[Sequence[int]],
    columns: Sequence[np.ndarray],
) -> tuple[np.ndarray, np.ndarray]:
    """How many sigmas each column (k,) is from zero: with constants as they are, and unknown."""
    every = np.hstack(columns)
    beside, theta = model.fitted(every)
    amounts = np.split(theta, np.cumsum([len(k) for k in kept])[:-1])
    each = zip(terms, kept, amounts, strict=True)
    along = [slopes(model.table.covariates, *one) for one in each]
    taken_on, out = _taken_on(model, every), []
    for some in (every, np.hstack([every, *along])):
        sigma = beside.test(some).sigma(1.0)[: len(theta)]
        t = np.where(sigma > 0.0, np.abs(theta) / np.maximum(sigma, 1e-300), 0.0)  # 0: not seen
        t[taken_on] = 0.0
        out.append(t)
    return out[0], out[1]


def _alone(model: Projection, term: FormulaTerm, kept: Sequence[int], column: int) -> float:
    """What share of what a column of a term explains no other constants do (root)."""
    covariates = model.table.covariates
    left = [c for c in kept if c != column]
    if not left:
        return 1.0
    own = term.columns(covariates)
    other = refine(model, term, left).columns(covariates)
    (every, same, best), _ = model.explained([own[:, kept], own[:, left], other[:, left]])
    return float(np.sqrt(np.clip((every - best) / max(every - same, 1e-300), 0.0, 1.0)))


def _taken_on(model: Projection, columns: np.ndarray) -> np.ndarray:
    """Which columns (N, k) the model, or those before, absorb."""
    kept, _ = model.off(columns)
    root = np.sqrt(model.weight)[:, None]
    size = np.sqrt(np.square(root * columns).sum(axis=0))
    own = np.abs(np.diag(np.linalg.qr(root * kept / np.maximum(size, 1e-300), mode="r")))
    return own < np.sqrt(GAUGE)
