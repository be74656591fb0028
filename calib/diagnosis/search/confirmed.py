"""What of a look is confirmed: candidates and structure, their clusters left out one by one."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from scipy import special

from calib.blunders.chance import LEVELS, after_looks, log_tail
from calib.diagnosis.rejects import FEWEST_STOPS
from calib.diagnosis.score import Scores, ScoreTest, away_from_model, project, score_test
from calib.diagnosis.screen import ODDS, Candidate, Screen
from calib.diagnosis.stand import Look, variables_of
from calib.effects import Effect
from calib.solve.fit import Progress

ALPHA_EFFECT = LEVELS["effect"]
ALPHA_UNNAMED = LEVELS["structure"]
ALPHA_NOISE = LEVELS["effect on the scatter"]
# Of the leading structure's evidence, for another covariate to be named too: a choice, as what has
# half of it may be the cause where covariates go together.
ALSO_NAMED = 0.5
SUSPECTS_JUDGED = 3  # of most evidence, before a look is called quiet: each costs a jackknife


def structures(look: Look, progress: Progress) -> list[Candidate]:
    """Structure that is confirmed, strongest first; single covariates that could stand for it."""
    out: list[Candidate] = []
    for candidate in look.unnamed.candidates:
        if not stands_out(candidate, ALPHA_UNNAMED):
            continue
        instead = out and len(candidate.effect.covariates) == 1
        instead = instead and candidate.evidence > ALSO_NAMED * out[0].evidence
        if instead or not _covered(look.unnamed, candidate, out):
            test, p = judged(look, candidate, progress)
            if p < ALPHA_UNNAMED:
                out.append(replace(candidate, p_value=test.p_value(), p_adjusted=p))
    return out


def _covered(screen: Screen, candidate: Candidate, by: Sequence[Candidate]) -> bool:
    """Whether others leave a candidate nothing to explain."""
    if not by:
        return False
    columns = np.unique(np.concatenate([c.test.columns for c in by]))
    there = score_test(screen.scores, columns)
    both = score_test(screen.scores, np.union1d(columns, candidate.test.columns))
    gain = max(both.statistic - there.statistic, 0.0) / max(screen.common, 1.0)
    more = both.dof - there.dof
    return more < 1 or -log_tail(gain, more) < np.log(candidate.looks / ALPHA_UNNAMED)


def scattering(look: Look, progress: Progress) -> Candidate | None:
    """The effect on the scatter that is confirmed, if one is."""
    for candidate in suspects(look.noise, ALPHA_NOISE):
        test, p = judged(look, candidate, progress)
        if p < ALPHA_NOISE:
            return replace(candidate, test=test, p_value=test.p_value(), p_adjusted=p)
    return None


def judged(look: Look, candidate: Candidate, progress: Progress) -> tuple[ScoreTest, float]:
    """A candidate's test, its clusters jackknifed, and its p-value adjusted for all tests."""
    found = look.judged(candidate, progress)
    return found, float(after_looks(found.p_value(), candidate.looks))


def as_fitted(look: Look, effect: Effect) -> tuple[Scores, np.ndarray]:
    """Scores of the parameters of an effect of a look's model, and these parameters (Q,)."""
    stand = look.stand
    names = variables_of(stand.problem, {effect.name})[effect.name]
    theta = np.concatenate([stand.estimate.values[name] for name in names])
    return project(look.linear, names, stand.spent - stand.spent_by(effect)), theta


def judged_as_fitted(
    look: Look, effect: Effect, looks: float, progress: Progress
) -> tuple[ScoreTest, float]:
    """The test of an effect of a look's model at what it was fitted to, clusters left out one by
    one (Wald's), and its p-value after so many looks. Of an effect so large that beams are rejected
    for it, more at one stop than at another, a test without it sees these stops differ."""
    scores, theta = as_fitted(look, effect)
    found = score_test(scores, np.arange(len(theta)))
    if not found.dof:
        return found, 1.0
    own = found.whiten.T @ scores.information @ theta
    away = away_from_model(look.linear, list(scores.at)) @ found.whiten
    test = found.at(own, look.shares(look.stand.problem, away, progress), scores)
    return test, float(after_looks(test.p_value(), looks))


def anything(look: Look, progress: Progress) -> bool:
    """Whether any candidate is confirmed, in its best shape."""
    closest = (look.closely(each, progress) for each in suspects(look.named, ALPHA_EFFECT))
    return any(judged(near, finest, progress)[1] < ALPHA_EFFECT for near, finest in closest)


def outlasts(look: Look, candidate: Candidate) -> bool:
    """Whether a candidate that has been fitted explains more than chance does, at the sigmas of the
    look's model, adjusted for all tests: with scatter in it these are right. As for a candidate
    that is not fitted, its own prior is no evidence against it: the score is that at zero."""
    scores, theta = as_fitted(look, candidate.effect)
    whiten = score_test(scores, np.arange(len(theta))).whiten
    explained = np.square(whiten.T @ (scores.score + scores.information @ theta)).sum()
    p = special.chdtrc(whiten.shape[1], explained)
    return float(after_looks(p, candidate.looks)) < ALPHA_EFFECT


def outdoing(look: Look, statistic: float) -> list[Effect]:
    """Effects of the catalogue that explain as much as values by chance do (a log-likelihood ratio,
    twice), less their parameters, and stand out, though too few stops, targets or surfaces show
    them to be named: that which does best, and those near it. They may be what seems to scatter."""
    found = [c for c in look.named.candidates if 2.0 * c.evidence > statistic]
    found = [c for c in found if stands_out(c, ALPHA_EFFECT)]
    return [c.effect for c in found if found[0].evidence - c.evidence < ODDS]


def suspects(screen: Screen, alpha: float) -> Iterator[Candidate]:
    """Candidates found if rows were independent, or found by clusters, best first."""
    standing_out = [c for c in screen.candidates if stands_out(c, alpha)]
    yield from standing_out[:SUSPECTS_JUDGED]


def stands_out(candidate: Candidate, alpha: float) -> bool:
    """Whether it is found if rows were independent, or by clusters; never by too few stops."""
    if candidate.test.clusters < FEWEST_STOPS:
        return False
    alone = -log_tail(candidate.test.statistic, candidate.test.dof)
    return candidate.p_adjusted < alpha or alone > np.log(candidate.looks / alpha)
