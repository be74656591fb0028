"""A formula that was found: its constants with their sigmas, as people and as files read it."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import count, product
from typing import Any

import numpy as np

from calib.diagnosis.formulas.factors import columns_of
from calib.diagnosis.formulas.picture import picture_of
from calib.diagnosis.formulas.pursuit import Form, Step, Term, refine
from calib.diagnosis.formulas.table import Table
from calib.diagnosis.score import GAUGE, test
from calib.effects.own.formula import FormulaEffect

CLEAR = 2.0  # sigmas from zero, below which a column of a term is left out again
NUDGE = 0.01  # of a covariate's range, for the derivative by a constant
WIDER = 3.0  # times the largest amplitude: the sigma that the prior of an amplitude has
PASSES = 2  # of refining every term beside the others
PHASE = ("sin(", "cos(")


@dataclass(frozen=True)
class Part:
    """One term of a formula, with what its columns are multiplied by.

    Args:
        term: with its constants.
        at: which of its columns are kept.
        amount_m: (k,) by which each is multiplied; sigma_m: (k,) of that.
        constants_sigma: (c,) of the term's constants.
    """

    term: Term
    at: tuple[int, ...]
    amount_m: np.ndarray
    sigma_m: np.ndarray
    constants_sigma: np.ndarray

    @property
    def texts(self) -> tuple[str, ...]:
        """Its columns as formulas."""
        return tuple(self.term.texts[i] for i in self.at)


@dataclass(frozen=True)
class Formula:
    """What the ranges do, over some covariates, beyond the model.

    Args:
        parts: its terms.
        steps: how each of them was found.
        rms_m: of what it changes the ranges by, beyond what the model takes on.
        seen: covariate -> its least and largest value.
        picture: of residuals over two of the covariates, as measured, as the formula has them and
            what is left; see `picture_of`.
    """

    parts: Sequence[Part]
    steps: Sequence[Step]
    rms_m: float
    seen: dict[str, tuple[float, float]]
    picture: dict[str, Any]

    @property
    def alike(self) -> list[Form]:
        """Other forms that stops cannot tell from the first term."""
        return [form for form in self.steps[0].alike if form.other_than(self.parts[0].term)]

    @property
    def covariates(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(c for p in self.parts for c in p.term.covariates))

    @property
    def texts(self) -> tuple[str, ...]:
        """All its columns."""
        return tuple(text for part in self.parts for text in part.texts)

    @cached_property
    def amount_m(self) -> np.ndarray:
        """(k,) by which each is multiplied."""
        return np.concatenate([part.amount_m for part in self.parts])

    @property
    def says(self) -> str:
        """The formula as people write it, each number with the sigma of its last digits."""
        return "range = true " + " ".join(_said(part) for part in self.parts)

    def name(self, taken: Collection[str] = ()) -> str:
        """Of its effect; another where that is taken."""
        bare = (c.removesuffix("_rad").removesuffix("_m") for c in self.covariates)
        name = "_".join(["empirical", *(re.sub(r"\W", "_", c, flags=re.ASCII) for c in bare)])
        every = (name if i == 1 else f"{name}_{i}" for i in count(1))
        return next(each for each in every if each not in taken)

    def effect(self, taken: Collection[str], what: str) -> dict[str, Any]:
        """The effect, as a file of formulas has it.

        Args:
            taken: names that the model has already.
            what: for its page.
        """
        largest = float(np.abs(self.amount_m).max())
        document = {
            "name": self.name(taken),
            "site": "range",
            "unit": "m",
            "sigma": float(f"{max(WIDER * largest, 0.01):.1g}"),
            "basis": list(self.texts),
            "start": [float(f"{amount:.4g}") for amount in self.amount_m],
            "what": what,
        }
        FormulaEffect.read(document, "diagnosis.json", {})
        return document

    def value_m(self, covariates: dict[str, np.ndarray]) -> np.ndarray:
        """What it adds to ranges (N,)."""
        return columns_of(self.texts, covariates) @ self.amount_m


def settled(table: Table, steps: Sequence[Step]) -> list[Formula]:
    """All terms fitted together, their constants refined; those over the same covariates are one
    formula."""
    terms = [step.form.term for step in steps]
    columns = [t.columns(table.covariates) for t in terms]
    for _ in range(PASSES):
        weight = table.beside(np.hstack(columns)).projection().weight
        for i, term in enumerate(terms):
            others = [c for k, c in enumerate(columns) if k != i]
            alone = table.beside(np.hstack(others)) if others else table
            terms[i] = refine(alone.projection().at(weight), term)
            columns[i] = terms[i].columns(table.covariates)
    kept = _kept(table, terms, columns, weight)
    parts = _parts(table, terms, columns, kept, weight)
    groups: dict[frozenset[str], list[int]] = {}
    for i, term in enumerate(terms):
        groups.setdefault(frozenset(term.covariates), []).append(i)
    weigh, out = table.projection().at(weight), []
    fit = table.beside(np.hstack([c[:, p.at] for c, p in zip(columns, parts, strict=True)]))
    fit = fit.projection()
    for some in groups.values():
        mine = [parts[i] for i in some]
        value = sum(columns[i][:, p.at] @ p.amount_m for i, p in zip(some, mine, strict=True))
        left = weigh.off(value[:, None])[0][:, 0]
        names = dict.fromkeys(c for p in mine for c in p.term.covariates)
        out.append(
            Formula(
                parts=mine,
                steps=[steps[i] for i in some],
                rms_m=float(np.sqrt(weight @ np.square(left) / weight.sum())),
                seen={n: _ends(table.covariates[n]) for n in names},
                picture=picture_of(table, list(names), value, fit),
            )
        )
    return out


def _kept(
    table: Table, terms: Sequence[Term], columns: Sequence[np.ndarray], weight: np.ndarray
) -> list[list[int]]:
    """Of each term the columns that the data need: not those that the model takes on, nor those
    that chance explains."""
    kept = [list(range(c.shape[1])) for c in columns]
    alone = table.projection().at(weight)
    while True:
        some = np.hstack([c[:, k] for c, k in zip(columns, kept, strict=True)])
        scores = alone.scores({}, some)
        size = np.maximum(np.diag(scores.whole), 1e-300)
        found = test(scores, np.arange(some.shape[1]))
        left = np.linalg.pinv(found.whiten @ found.whiten.T).diagonal() / size
        t = np.abs(found.estimate()) / np.maximum(_sigma(table, some, some, weight), 1e-300)
        t = np.where((np.diag(scores.information) / size > GAUGE) & (left > GAUGE), t, 0.0)
        owner = [(i, c) for i, k in enumerate(kept) for c in k]
        can = [j for j, (i, _) in enumerate(owner) if len(kept[i]) > 1]
        worst = min(can, key=lambda j: t[j], default=None)
        if worst is None or t[worst] > CLEAR:
            return kept
        i, c = owner[worst]
        kept[i].remove(c)


def _parts(
    table: Table,
    terms: Sequence[Term],
    columns: Sequence[np.ndarray],
    kept: Sequence[Sequence[int]],
    weight: np.ndarray,
) -> list[Part]:
    some = [c[:, k] for c, k in zip(columns, kept, strict=True)]
    fit = table.beside(np.hstack(some)).projection()
    amount = fit.step[-sum(c.shape[1] for c in some) :]
    slopes, start = [], 0
    for term, mine, k in zip(terms, some, kept, strict=True):
        own = amount[start : (start := start + mine.shape[1])]
        slopes.append(_slopes(table, term, k, own))
    sigma = _sigma(table, np.hstack(some), np.hstack([*some, *slopes]), fit.weight)
    out, start, more = [], 0, len(amount)
    for term, mine, k, slope in zip(terms, some, kept, slopes, strict=True):
        at = slice(start, start := start + mine.shape[1])
        of = slice(more, more := more + slope.shape[1])
        out.append(
            Part(
                term=term,
                at=tuple(k),
                amount_m=amount[at],
                sigma_m=sigma[at],
                constants_sigma=sigma[of],
            )
        )
    return out


def _slopes(table: Table, term: Term, kept: Sequence[int], amount: np.ndarray) -> np.ndarray:
    """Derivative (N, c) of a term by its constants."""
    ranges = [np.ptp(table.covariates[f.covariate]) for f in term.factors for _ in range(f.free)]
    out = []
    for i, wide in enumerate(ranges):
        sides = []
        for by in (NUDGE * wide, -NUDGE * wide):
            constants = list(term.constants)
            constants[i] += by
            sides.append(term.at(constants).columns(table.covariates)[:, kept] @ amount)
        out.append((sides[0] - sides[1]) / (2 * NUDGE * wide))
    return np.stack(out, axis=1) if out else np.zeros((len(table), 0))


def _sigma(table: Table, fitted: np.ndarray, columns: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Sigma (q,) of what columns (N, q) are multiplied by, where some are fitted; clusters
    counted, no less than rows alone have it."""
    alone = table.projection().at(weight)
    beside = table.beside(fitted).projection().at(weight)
    unknowns = len(alone.step)
    at_best = alone.leaving(beside.left_m, beside.step[:unknowns])
    found = test(at_best.scores({}, columns), np.arange(columns.shape[1]))
    return found.sigma(1.0)


def _ends(values: np.ndarray) -> tuple[float, float]:
    return float(np.nanmin(values)), float(np.nanmax(values))


def _said(part: Part) -> str:
    """A term as people write it."""
    return (
        _shifted(part)
        or _turned(part)
        or " ".join(
            f"{_signed(amount, sigma)} mm * {_bare(text)}"
            for text, amount, sigma in zip(part.texts, part.amount_m, part.sigma_m, strict=True)
        )
    )


def _shifted(part: Part) -> str:
    """Of a line, or lines, whose zero is found too: two columns that differ by one line's text."""
    lines = [f for f in part.term.factors if f.kind == "line"]
    if len(part.at) != 2:
        return ""
    rows = list(product(*(f.texts for f in part.term.factors)))
    long, short = (rows[i] for i in part.at)
    differ = [i for i, (a, b) in enumerate(zip(long, short, strict=True)) if a != b]
    if len(differ) != 1 or short[differ[0]] != "1" or part.term.factors[differ[0]] not in lines:
        return ""
    (i,) = differ
    line, ratio = part.term.factors[i], part.amount_m[1] / part.amount_m[0]
    middle, half = line.constants
    relative = np.hypot(part.sigma_m[1], ratio * part.sigma_m[0]) / abs(part.amount_m[0])
    zero = with_sigma(middle - half * ratio, half * relative)
    texts = [f"({line.covariate} - {zero}) / {half:g}" if k == i else t for k, t in enumerate(long)]
    product_ = " * ".join(_bare(t) for t in texts if t != "1")
    return f"{_signed(part.amount_m[0], part.sigma_m[0])} mm * {product_.replace('- -', '+ ')}"


def _turned(part: Part) -> str:
    """Of a sine and a cosine: an amplitude and a phase."""
    texts = part.texts
    if len(texts) != 2 or texts[0].replace(*PHASE) != texts[1] or texts[0].count(PHASE[0]) != 1:
        return ""
    a, b = part.amount_m
    size = float(np.hypot(a, b))
    sigma = float(np.hypot(a * part.sigma_m[0], b * part.sigma_m[1]) / size)
    phase = float(np.hypot(b * part.sigma_m[0], a * part.sigma_m[1]) / size**2)
    before, _, after = texts[0].partition(PHASE[0])
    inside, _, rest = after.partition(")")
    turned = f"{before}sin({inside} + {with_sigma(float(np.arctan2(b, a)), phase)}){rest}"
    return f"{_signed(size, sigma)} mm * {_bare(turned).replace('+ -', '- ')}"


def _bare(text: str) -> str:
    """A column as people write it: in brackets where it is a sum or a comparison."""
    outside = text
    while (inner := re.sub(r"\([^()]*\)", "", outside)) != outside:
        outside = inner
    return f"({text})" if re.search(r"[<>=]| [-+] ", outside) else text


def _signed(amount_m: float, sigma_m: float) -> str:
    sign = "-" if amount_m < 0 else "+"
    return f"{sign} {with_sigma(1e3 * abs(amount_m), 1e3 * sigma_m)}"


def with_sigma(value: float, sigma: float) -> str:
    """``15.0(4)``: a number to as many digits as its sigma supports, that in the last of them
    (ISO 80000-1)."""
    if not (np.isfinite(sigma) and sigma > 0.0):
        return f"{value:.4g}"
    power = int(np.floor(np.log10(sigma)))
    digits = -power + (1 if sigma < 1.95 * 10.0**power else 0)
    last = round(sigma * 10.0**digits)
    if digits <= 0:
        return f"{round(value, digits):.0f}({last * 10**-digits})"
    return f"{value:.{digits}f}({last})"
