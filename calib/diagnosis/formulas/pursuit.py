"""The fewest terms that say what a residual does: products of functions of one covariate each.

Orthogonal matching pursuit (Pati, Rezaiifar and Krishnaprasad 1993) on the beams' table: of all
covariates those that a smooth function needs; of all products of their `factors` that which
explains most, its constants refined; beside it the next, until nothing stands out. Where several
forms do equally well, stop by stop (Vuong 1989), the simplest is taken and the others are listed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import product

import numpy as np
from scipy import special

from calib.blunders.chance import after_looks, at_least, log_tail
from calib.diagnosis.formulas.factors import Factor, factors
from calib.diagnosis.formulas.needed import needed
from calib.diagnosis.formulas.smooths import Bases, Smooth, screen_smooths
from calib.diagnosis.formulas.table import BeamTable, Projection, together
from calib.diagnosis.formulas.terms import FormulaTerm, refine
from calib.diagnosis.score import ScoreTest
from calib.solve.fit import Progress

FACTORS_KEPT = 4  # factors of each covariate whose products are tried
REFINED = 5  # products whose constants are refined
# Sigmas by which stops must prefer a form for it to be told from a simpler one; of one that hangs
# on more, as little likely among as many covariates as those might have been.
SIGMAS_APART = 2.0
# A form is told from another by the sum of what stops prefer it by, over how that scatters among K
# stops: where it varies by twice its mean, as a gross structure makes it vary, half the root of K
# at most. With fewer than 4 z^2 stops, which could then never tell z sigmas, covariates are tested.
SPREAD_OF_STOPS = 4
MOST_TERMS = 4  # a choice: bounds the time, as each has a whole search; more are read by nobody
# Smooth functions that are judged before nothing is said to be there, and the sets of covariates,
# beside the best one, over which forms are tried. Choices: each costs a jackknife, or a search.
SMOOTHS_JUDGED, RIVALS = 3, 2
# Adjusted p-value of a smooth function, from which forms are tried: a choice, ten times the level
# of a structure, as a form of fewer parameters stands out further than a smooth function.
PLAUSIBLE = 0.1
EXPLAINS_AS_MUCH = 0.8  # of the best set's statistic, that another must for that: a choice
AS = {"ring": "elevation_rad"}  # what goes along with another covariate
# Of what a form explains, that a smooth function must for the form to be one of them: a choice, as
# knots are few.
COVERS = 0.9
SAME_FORM = 1e-6  # of what two forms explain: one is the other and what the model absorbs


@dataclass(frozen=True)
class ConfirmedTerm:
    """A term that is confirmed.

    Args:
        form: that.
        alike: other forms that stops cannot tell from it.
        p_value: how often chance alone explains as much, in some form over these covariates.
        p_adjusted: or over any.
    """

    form: Form
    alike: Sequence[Form]
    p_value: float
    p_adjusted: float


@dataclass(frozen=True, eq=False)
class Form:
    """A term beside what the model has.

    Args:
        term: with its constants refined.
        statistic: what it explains, in squared sigmas.
        dof: in how many directions.
        left: (K,) what it leaves of each stop's chi-square.
        tried: of how many it is the best.
    """

    term: FormulaTerm
    statistic: float
    dof: int
    left: np.ndarray
    tried: int = 1

    def other_than(self, form: Form) -> bool:
        """Whether it says something else than another: not that with more columns, nor the same
        function written otherwise, or of a covariate that goes along."""
        mine, its = (
            {(AS.get(f.covariate, f.covariate), f.kind) for f in each.term.factors}
            for each in (self, form)
        )
        more = self.term.cost > form.term.cost and set(form.term.texts) <= set(self.term.texts)
        alike = abs(self.statistic - form.statistic) < SAME_FORM * form.statistic
        same = alike and {c for c, _ in mine} == {c for c, _ in its}
        return not (mine == its or more or same)

    @property
    def evidence(self) -> float:
        return _evidence(self.statistic, self.dof)


def forms(projection: Projection, bases: Bases, covariates: Sequence[str]) -> list[Form]:
    """The best terms over some covariates, that which explains most first.

    Args:
        projection: the table, and the model fitted to it.
        bases: its smooth functions.
        covariates: which.
    """
    table = projection.table
    best = [_best_factors(projection, bases, covariates, c) for c in covariates]
    tried = int(np.prod([count for _, count in best]))
    terms = [FormulaTerm(each) for each in product(*(some for some, _ in best))]
    statistic, dof = _explained(projection, [t.columns(table.covariates) for t in terms])
    evidence = np.array([_evidence(s, d) for s, d in zip(statistic, dof, strict=True)])
    first = [terms[i] for i in np.argsort(-evidence, kind="stable")[:REFINED]]
    refined = dict.fromkeys(refine(projection, term) for term in first)
    found = [form(projection, term, tried) for term in refined]
    return sorted((f for f in found if f.dof), key=lambda f: -f.evidence)


def pursue(
    table: BeamTable,
    alpha: float,
    progress: Progress,
    most: int = MOST_TERMS,
    found: Sequence[ConfirmedTerm] = (),
) -> list[ConfirmedTerm]:
    """Terms that stand out from chance, one beside the other, strongest first.

    Args:
        table: beams at a solution.
        alpha: chance that any is told where nothing is missing.
        progress: called with what is being done, how far it is, and of how much.
        most: how many terms there are at most.
        found: those that are known already, to go on from.
    """
    bases, found = Bases(table, int(table.stop.max()) + 1), list(found)
    while len(found) < most:
        columns = [s.form.term.columns(table.covariates) for s in found]
        fitted = table.beside(np.hstack(columns)).projection() if found else table.projection()
        smooths = screen_smooths(
            fitted,
            bases,
            lambda done, total: progress("searching covariates of the residuals", done, total),
        )
        step = _step(fitted, bases, smooths, alpha)
        if step is None or step.p_adjusted >= alpha:
            break
        found.append(step)
    return found


def _step(
    fitted: Projection, bases: Bases, smooths: Sequence[Smooth], alpha: float
) -> ConfirmedTerm | None:
    """The best term over the sets of covariates that explain most, judged."""

    @cache
    def judged(covariates: tuple[str, ...], plain: bool) -> ScoreTest:
        return _judged(fitted, bases.columns(covariates, plain))

    likely = (s for s in smooths[:SMOOTHS_JUDGED] if s.evidence > np.log(s.looks / alpha))
    best = next((s for s in likely if _stands_out(judged(s.covariates, s.plain), s)), None)
    if best is None:
        return None
    inside = [s for s in smooths if set(s.covariates) < set(best.covariates)]
    others = [s for s in smooths if not set(s.covariates) >= set(best.covariates)]
    rivals = [s for s in others if s.test.statistic > EXPLAINS_AS_MUCH * best.test.statistic]
    sets = list({s.covariates: s for s in (best, *inside[:1], *rivals[:RIVALS])}.values())
    over = {f: s for s in sets for f in forms(fitted, bases, s.covariates)}
    if not over:
        return None
    count = len(bases.names())

    def lacks(simpler: Form, best: Form) -> bool:
        """Whether a covariate of the best form stands out beside a simpler one, where stops confirm
        a smooth function of its covariates: a form may live on few beams."""
        further = _further(simpler, best)
        if not further or len(best.left) > SPREAD_OF_STOPS * _sigmas_apart(count, further) ** 2:
            return False
        smooth = over[best]
        known = judged(smooth.covariates, smooth.plain).p_value()
        if after_looks(known, smooth.looks) >= alpha:
            return False
        mine, more = (f.term.columns(fitted.table.covariates) for f in (simpler, best))
        beside = fitted.table.beside(mine).projection(more).judged(more)
        return beside.p_value() < _tail_apart(count, further)

    chosen, alike = simplest(sorted(over, key=lambda f: -f.evidence), count, lacks)
    p = _by_chance(fitted, chosen, over[chosen], judged)
    return ConfirmedTerm(
        form=chosen,
        alike=alike,
        p_value=p,
        p_adjusted=float(after_looks(p, best.looks)),
    )


def _stands_out(judged: ScoreTest, smooth: Smooth) -> bool:
    """Whether chance hardly makes so large a smooth function: of others no forms are tried, which
    takes time. One of as many directions as there are stops, as over a few walls, none of them
    can confirm; a form has fewer, and is judged on its own."""
    p = float(after_looks(judged.p_value(), smooth.looks))
    return p < PLAUSIBLE or judged.dof >= judged.clusters


def _judged(fitted: Projection, columns: np.ndarray) -> ScoreTest:
    """The test of columns (N, k), stops left out one by one, and beams weighed as they are once
    these are known: what is clipped before would seem to differ from stop to stop."""
    return fitted.table.projection(columns).judged(columns)


def _by_chance(
    fitted: Projection,
    form: Form,
    smooth: Smooth,
    judged: Callable[[tuple[str, ...], bool], ScoreTest],
) -> float:
    """How often chance makes a form of these covariates that explains as much.

    No more often than as many forms do as were tried, whole or with those of its columns alone that
    are needed (Bonferroni). Where a smooth function explains it, nor more often than the best of
    such functions does (the S-method of Scheffe 1953), by what the form itself scatters, or than
    that function does, in all its directions. Half of the level is for the test of that function,
    and the other bounds share the other half equally (weighted Bonferroni, Holm 1979).
    """
    columns = form.term.columns(fitted.table.covariates)
    (kept,) = needed(fitted, [form.term], [columns])
    whole = _judged(fitted, columns)
    bounds = [form.tried * _tail(whole)]
    if 0 < len(kept) < columns.shape[1]:
        ways = special.comb(columns.shape[1], len(kept))
        bounds.append(form.tried * ways * _tail(_judged(fitted, columns[:, kept])))
    covered = smooth.test.statistic > COVERS * form.statistic
    if covered:
        bounds.append(_tail(whole, max(smooth.test.dof, whole.dof)))
    p = len(bounds) * min(bounds)
    if covered:
        p = 2.0 * min(p, judged(smooth.covariates, smooth.plain).p_value())
    return at_least(min(1.0, p))


def _tail(found: ScoreTest, among: int = 0) -> float:
    """How often chance explains as much as a test found, or, with `among`, as the best function of
    so many parameters does."""
    chance = found.chance
    if chance.d <= 0.0 or not found.dof:
        return 1.0
    narrower = min(chance.trace / found.dof, 1.0)  # by chance: no less than single rows scatter
    each = chance.over(found.statistic) * found.dof * narrower
    tail = float(special.fdtrc(among or chance.nu, chance.d, each / (among or found.dof)))
    return min(chance.looks * tail, 1.0)


def form(projection: Projection, term: FormulaTerm, tried: int) -> Form:
    """A term with what it leaves of each stop."""
    columns = term.columns(projection.table.covariates)
    (statistic,), (dof,) = projection.explained([columns])
    return Form(term, float(statistic), int(dof), left=_left(projection, columns), tried=tried)


def _left(projection: Projection, columns: np.ndarray) -> np.ndarray:
    """(K,) what columns (N, k) beside the model leave of each stop's chi-square."""
    kept, _ = projection.off(columns)
    root = np.sqrt(projection.weight)
    size = np.maximum(np.sqrt(np.square(root[:, None] * columns).sum(axis=0)), 1e-300)
    theta = np.linalg.lstsq(root[:, None] * kept / size, root * projection.left_m, rcond=1e-3)[0]
    left = np.square(root * (projection.left_m - kept @ (theta / size)))
    return np.bincount(projection.table.stop, left)


def simplest(
    found: Sequence[Form],
    covariates: int,
    lacks: Callable[[Form, Form], bool] = lambda simpler, best: False,
) -> tuple[Form, list[Form]]:
    """The simplest of the forms that stops cannot tell from the best, nor from the best of the same
    covariates, and the others of these.

    Args:
        found: best first.
        covariates: how many there are.
        lacks: whether the best form, the second, says more than a simpler one by a test of its own:
            few stops differ so much in what a gross structure does to each that the first test can
            tell nothing apart (`SPREAD_OF_STOPS`).
    """
    best = {frozenset(f.term.covariates): f for f in reversed(found)}
    both = [(f, {found[0], best[frozenset(f.term.covariates)]}) for f in found]
    near = [f for f, than in both if not any(_told_apart(f, b, covariates) for b in than)]
    order = sorted(near, key=lambda f: (f.term.cost, f.dof, -f.statistic))
    chosen = next(f for f in order if f is found[0] or not lacks(f, found[0]))
    passed = order[: order.index(chosen)]
    return chosen, [f for f in near if f is not chosen and f not in passed]


def _told_apart(form: Form, best: Form, covariates: int) -> bool:
    worse = (form.left - best.left)[best.left > 0.0]
    limit = _sigmas_apart(covariates, _further(form, best))
    if form is best or worse.sum() <= limit**2:
        return False
    scatter = np.sqrt(len(worse) * np.var(worse, ddof=1)) if len(worse) > 1 else np.inf
    return bool(worse.sum() > limit * scatter)


def _further(form: Form, best: Form) -> int:
    """How many covariates the best form has that another has not."""
    return len(set(best.term.covariates) - set(form.term.covariates))


def _tail_apart(covariates: int, further: int) -> float:
    """How often chance alone may tell a form from one of so many covariates less."""
    return float(special.ndtr(-SIGMAS_APART) / max(covariates, 1) ** further)


def _sigmas_apart(covariates: int, further: int) -> float:
    """How many sigmas that is."""
    return -float(special.ndtri(_tail_apart(covariates, further)))


def _best_factors(
    projection: Projection, bases: Bases, covariates: Sequence[str], name: str
) -> tuple[list[Factor], int]:
    """The functions of one covariate that explain most beside any smooth one of the others, and of
    how many."""
    table = projection.table
    others = bases.of([c for c in covariates if c != name], len(covariates))
    names = [name, "ring"] if name == "elevation_rad" and "ring" in table.covariates else [name]
    levels = bases.stops if name in table.by_stop else len(table)
    round_ = name in table.turning
    every = [f for n in names for f in factors(n, table.covariates[n], levels, round_)]
    blocks = []
    for each in every:
        mine = each.columns(table.covariates)
        blocks.append((mine[:, :, None] * others[:, None, :]).reshape(len(mine), -1))
    statistic, dof = _explained(projection, blocks)
    evidence = [_evidence(s, d) for s, d in zip(statistic, dof, strict=True)]
    order = np.argsort(-np.array(evidence), kind="stable").tolist()
    kinds: dict[tuple[str, str], int] = {}  # of each kind the best: others become it when refined
    for i in order:
        kinds.setdefault((every[i].covariate, every[i].kind), i)
    chosen = [every[i] for i in list(kinds.values())[:FACTORS_KEPT]]
    plain = next((every[i] for i in order if every[i].kind in ("line", "class")), None)
    if plain is not None and plain not in chosen:
        chosen.append(plain)
    return chosen, len(every)


def _explained(
    projection: Projection, blocks: Sequence[np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """As `Projection.explained`, some columns at a time."""
    found = [projection.explained(part) for part in together(blocks)]
    return tuple(np.concatenate(each) for each in zip(*found, strict=True))


def _evidence(statistic: float, dof: int) -> float:
    return -log_tail(statistic, dof) if dof else 0.0
