"""A formula that was found: its constants with their sigmas, as people and as files read it."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import count, pairwise, product
from typing import Any

import numpy as np

from calib.diagnosis.formulas.factors import columns_of
from calib.diagnosis.formulas.needed import needed, reduced
from calib.diagnosis.formulas.picture import picture_of
from calib.diagnosis.formulas.pursuit import ConfirmedTerm, Form
from calib.diagnosis.formulas.table import BeamTable, Projection
from calib.diagnosis.formulas.terms import FormulaTerm, refine, slopes, times
from calib.diagnosis.suggest import outward
from calib.effects.own.formula import FormulaEffect

WIDER = 3.0  # times the largest amplitude: the sigma that the prior of an amplitude has
REFINING_PASSES = 2  # of refining every term beside the others
PHASE = ("sin(", "cos(")
RANGE_SITE, JOINT_SITE = "range", "joint:"  # sites; of the latter the joint's name follows
AMOUNT_UNITS = {"m": "mm", "rad": "mrad"}  # of amounts -> in which they are said
# The prior of an amount is no narrower: errors of ranges and of joints that a rig may have.
LEAST_SIGMA = {"m": 0.01, "rad": 0.003}


@dataclass(frozen=True)
class FittedTerm:
    """One term of a formula, with what its columns are multiplied by.

    Args:
        term: with its constants.
        at: which of its columns are kept.
        amount: (k,) by which each is multiplied, in the unit of the formula.
        covariance: (k, k) of these.
        constants_sigma: (c,) of the term's constants.
    """

    term: FormulaTerm
    at: tuple[int, ...]
    amount: np.ndarray
    covariance: np.ndarray
    constants_sigma: np.ndarray

    @property
    def sigma(self) -> np.ndarray:
        """(k,) of the amounts."""
        return np.sqrt(np.diag(self.covariance))

    def sigma_of(self, slope: Sequence[float]) -> float:
        """Of a function of the amounts that has these derivatives (k,) by them."""
        return float(np.sqrt(max(np.array(slope) @ self.covariance @ np.array(slope), 0.0)))

    @property
    def texts(self) -> tuple[str, ...]:
        """Its columns as formulas."""
        return tuple(self.term.texts[i] for i in self.at)

    @property
    def rows(self) -> list[tuple[str, ...]]:
        """Of each column the texts of its factors, with ``@i@`` for the i-th constant found."""
        every = (f"@{i}@" for i in count())
        written = [f.written([next(every) for _ in range(f.free)]) for f in self.term.factors]
        rows = list(product(*written))
        return [rows[i] for i in self.at]

    @property
    def numbers(self) -> list[str]:
        """The constants found, with their sigmas."""
        pairs = zip(self.term.constants, self.constants_sigma, strict=True)
        return [with_sigma(c, s) if s > 0.0 else f"{c:.6g}" for c, s in pairs]


@dataclass(frozen=True)
class Formula:
    """What the ranges, or a joint, do, over some covariates, beyond the model.

    Args:
        parts: its terms.
        steps: how each of them was found.
        rms_m: of what it changes the residuals by, beyond what the model absorbs.
        seen: covariate -> its least and largest value.
        picture: of residuals over two of the covariates, as measured, as the formula has them and
            what is left; see `picture_of`.
        unit: of its amounts: m of a range or of a linear joint, rad of another.
        site: what it changes, as a file of formulas has it.
        joints: which covariates are joints of the arm.
    """

    parts: Sequence[FittedTerm]
    steps: Sequence[ConfirmedTerm]
    rms_m: float
    seen: dict[str, tuple[float, float]]
    picture: dict[str, Any]
    unit: str = "m"
    site: str = RANGE_SITE
    joints: frozenset[str] = frozenset()

    @property
    def alike(self) -> list[Form]:
        """Other forms that stops cannot tell from the first term."""
        chosen = self.steps[0].form
        return [form for form in self.steps[0].alike if form.other_than(chosen)]

    @property
    def covariates(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(c for p in self.parts for c in p.term.covariates))

    @property
    def texts(self) -> tuple[str, ...]:
        """All its columns."""
        return tuple(text for part in self.parts for text in part.texts)

    @cached_property
    def amount(self) -> np.ndarray:
        """(k,) by which each is multiplied."""
        return np.concatenate([part.amount for part in self.parts])

    @property
    def constants(self) -> int:
        """How many were found: amounts, and constants of factors."""
        free = (factor.free for part in self.parts for factor in part.term.factors)
        return len(self.amount) + sum(free)

    @property
    def says(self) -> str:
        """The formula as people write it, each number with the sigma of its last digits."""
        what = (
            "range = true"
            if self.site == RANGE_SITE
            else f"{self.site.removeprefix(JOINT_SITE)} = read"
        )
        return " ".join([what, *(_said(part, AMOUNT_UNITS[self.unit]) for part in self.parts)])

    def name(self, taken: Collection[str] = ()) -> str:
        """Of its effect; another where that is taken."""
        joint = self.site.removeprefix(JOINT_SITE)
        bare = (c.removesuffix("_rad").removesuffix("_m") for c in self.covariates if c != joint)
        of = [] if self.site == RANGE_SITE else [re.sub(r"\W", "_", joint, flags=re.ASCII)]
        name = "_".join(["empirical", *of, *(re.sub(r"\W", "_", c, flags=re.ASCII) for c in bare)])
        every = (name if i == 1 else f"{name}_{i}" for i in count(1))
        return next(each for each in every if each not in taken)

    def effect(self, taken: Collection[str], what: str) -> dict[str, Any]:
        """The effect, as a file of formulas has it.

        Args:
            taken: names that the model has already.
            what: for its page.
        """
        largest = float(np.abs(self.amount).max())
        document = {
            "name": self.name(taken),
            "site": self.site,
            "unit": self.unit,
            "sigma": float(f"{max(WIDER * largest, LEAST_SIGMA[self.unit]):.1g}"),
            "basis": list(self.texts),
            "start": [float(f"{amount:.4g}") for amount in self.amount],
            "seen": {name: outward(*ends) for name, ends in self.seen.items()},
            "what": what,
        }
        FormulaEffect.read(document, "diagnosis.json", {})
        return document

    def value_m(self, covariates: dict[str, np.ndarray]) -> np.ndarray:
        """What it adds to ranges (N,)."""
        return columns_of(self.texts, covariates) @ self.amount


def settled(
    table: BeamTable, steps: Sequence[ConfirmedTerm], site: str = RANGE_SITE
) -> list[Formula]:
    """All terms fitted together, their constants refined; those over the same covariates are one
    formula of the site."""
    terms = [step.form.term for step in steps]
    kept = [list(range(len(term.texts))) for term in terms]
    for _ in range(REFINING_PASSES):
        terms = _refined(table, terms, kept)
    columns = [t.columns(table.covariates) for t in terms]
    kept = needed(table.projection(np.hstack(columns)), terms, columns)
    there = [i for i, k in enumerate(kept) if k]
    if not there:
        return []
    plain = [reduced(terms[i], kept[i]) for i in there]
    kept = [k for _, k in plain]
    # Without a column that was dropped, other constants are best.
    terms = [_centred(t, table) for t in _refined(table, [t for t, _ in plain], kept)]
    return [replace(f, site=site) for f in _grouped(table, terms, kept, [steps[i] for i in there])]


def _refined(
    table: BeamTable, terms: Sequence[FormulaTerm], kept: Sequence[Sequence[int]]
) -> list[FormulaTerm]:
    """Terms with the constants that are best for the columns kept of each, beside the others."""
    terms = list(terms)
    columns = [t.columns(table.covariates)[:, k] for t, k in zip(terms, kept, strict=True)]
    model = table.projection(np.hstack(columns))
    for i, term in enumerate(terms):
        others = [c for k, c in enumerate(columns) if k != i]
        beside = model.beside(np.hstack(others)) if others else model
        terms[i] = refine(beside, term, kept[i])
        columns[i] = terms[i].columns(table.covariates)[:, kept[i]]
    return terms


def _centred(term: FormulaTerm, table: BeamTable) -> FormulaTerm:
    """A term with its edges midway between the values that they part."""
    return term.at(term.gaps(table.covariates).mean(axis=1).tolist())


def _grouped(
    table: BeamTable,
    terms: Sequence[FormulaTerm],
    kept: Sequence[Sequence[int]],
    steps: Sequence[ConfirmedTerm],
) -> list[Formula]:
    """Formulas of terms, each with its numbers."""
    columns = [t.columns(table.covariates)[:, k] for t, k in zip(terms, kept, strict=True)]
    model = table.projection(np.hstack(columns))
    parts = _parts(model, terms, columns, kept)
    fit = model.fitted(np.hstack(columns))[0]
    groups: dict[frozenset[str], list[int]] = {}
    for i, term in enumerate(terms):
        groups.setdefault(frozenset(term.covariates), []).append(i)
    out = []
    for some in groups.values():
        mine = [parts[i] for i in some]
        value = sum(columns[i] @ p.amount for i, p in zip(some, mine, strict=True))
        left = model.off(value[:, None])[0][:, 0]
        names = list(dict.fromkeys(c for p in mine for c in p.term.covariates))
        out.append(
            Formula(
                parts=mine,
                steps=[steps[i] for i in some],
                rms_m=float(np.sqrt(model.weight @ np.square(left) / model.weight_m2)),
                seen={n: _ends(table.covariates[n]) for n in names},
                picture=picture_of(table, names, value, fit, AMOUNT_UNITS[table.unit]),
                unit=table.unit,
                joints=table.joints & set(names),
            )
        )
    return out


def _parts(
    model: Projection,
    terms: Sequence[FormulaTerm],
    columns: Sequence[np.ndarray],
    kept: Sequence[Sequence[int]],
) -> list[FittedTerm]:
    """Terms with what their columns are multiplied by, and the sigmas of that and of their
    constants, all of them unknown together."""
    beside, amount = model.fitted(np.hstack(columns))
    ends = np.cumsum([c.shape[1] for c in columns])[:-1]
    amounts = np.split(amount, ends)
    each = zip(terms, kept, amounts, strict=True)
    along = [slopes(model.table.covariates, *one) for one in each]
    every = np.hstack([*columns, *along])
    covariance = beside.test(every).covariance(1.0)
    starts = np.array([0, *ends, len(amount)])
    blocks = [covariance[a:b, a:b] for a, b in pairwise(starts.tolist())]
    others = np.sqrt(np.diag(covariance)[len(amount) :])
    others = np.split(others, np.cumsum([s.shape[1] for s in along])[:-1])
    # An edge is anywhere between its neighbours, by a uniform distribution (GUM 4.3.7).
    gaps = [t.gaps(model.table.covariates) for t in terms]
    others = [np.hypot(o, np.ptp(g, axis=1) / 12**0.5) for o, g in zip(others, gaps, strict=True)]
    return [
        FittedTerm(term=term, at=tuple(k), amount=a, covariance=c, constants_sigma=o)
        for term, k, a, c, o in zip(terms, kept, amounts, blocks, others, strict=True)
    ]


def _ends(values: np.ndarray) -> tuple[float, float]:
    return float(np.nanmin(values)), float(np.nanmax(values))


def _said(part: FittedTerm, unit: str) -> str:
    """A term as people write it."""
    each = zip(part.rows, part.amount, part.sigma, strict=True)
    says = (
        _shifted(part, unit)
        or _turned(part, unit)
        or " ".join(f"{_signed(amount, s)} {unit} * {_product(row)}" for row, amount, s in each)
    )
    for i, number in enumerate(part.numbers):
        says = says.replace(f"@{i}@", number)
    return says.replace("- -", "+ ").replace("+ -", "- ")


def _shifted(part: FittedTerm, unit: str) -> str:
    """Of a line, or lines, whose zero is found too: two columns that differ by one line's text."""
    if len(part.at) != 2:
        return ""
    long, short = part.rows
    differ = [i for i, (a, b) in enumerate(zip(long, short, strict=True)) if a != b]
    if len(differ) != 1 or short[differ[0]] != "1" or part.term.factors[differ[0]].kind != "line":
        return ""
    (i,) = differ
    slope, level = part.amount
    line, ratio = part.term.factors[i], level / slope
    middle, half = line.constants
    sigma = part.sigma_of((-ratio / slope, 1 / slope))
    zero = with_sigma(middle - half * ratio, half * sigma)
    texts = [f"({line.covariate} - {zero}) / {half:g}" if k == i else t for k, t in enumerate(long)]
    return f"{_signed(slope, part.sigma[0])} {unit} * {_product(texts)}"


def _turned(part: FittedTerm, unit: str) -> str:
    """Of a sine and a cosine: an amplitude and a phase."""
    texts = [times(row) for row in part.rows]
    if len(texts) != 2 or texts[0].replace(*PHASE) != texts[1] or texts[0].count(PHASE[0]) != 1:
        return ""
    a, b = part.amount
    size = float(np.hypot(a, b))
    sigma = part.sigma_of((a / size, b / size))
    phase = part.sigma_of((-b / size**2, a / size**2))
    before, _, after = texts[0].partition(PHASE[0])
    inside, _, rest = after.partition(")")
    turned = f"{before}sin({inside} + {with_sigma(float(np.arctan2(b, a)), phase)}){rest}"
    return f"{_signed(size, sigma)} {unit} * {bare(turned)}"


def _product(row: Sequence[str]) -> str:
    """Factors as people write their product."""
    return " * ".join(bare(text) for text in row if text != "1") or "1"


def bare(text: str) -> str:
    """A column as people write it: in brackets where it is a sum or a comparison."""
    outside = text
    while (inner := re.sub(r"\([^()]*\)", "", outside)) != outside:
        outside = inner
    return f"({text})" if re.search(r"[<>=]| [-+] ", outside) else text


def _signed(amount: float, sigma: float) -> str:
    sign = "-" if amount < 0 else "+"
    return f"{sign} {with_sigma(1e3 * abs(amount), 1e3 * sigma)}"


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
