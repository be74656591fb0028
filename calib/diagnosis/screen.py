"""All candidates tested together: by family, adjusted for how many were tested, and ranked."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calib.blunders.chance import after_looks
from calib.diagnosis.score import Scores, ScoreTest, score_test
from calib.diagnosis.structure.empirical import EachAlone
from calib.effects import Effect, Site

# Of a rival, within which it can stand in for the best: from 20 to 1 on, evidence is called strong
# (Kass and Raftery 1995, JASA 90).
ODDS = np.log(20.0)
# Of the smallest p-value, at which dependent tests are counted: by convention, and near the level
# at which claims are made.
QUANTILE = 0.05


@dataclass(frozen=True)
class Candidate:
    """An effect that might be missing, in its best shape.

    Args:
        effect: with that shape.
        test: its test.
        p_value: how often chance alone does as much, adjusted for the shapes tried; of the screen's
            test until it is judged, then of that.
        p_adjusted: how often chance does so in any candidate that was tested, so no less.
        evidence: see `ScoreTest.evidence`.
        looks: by how many independent looks p_adjusted pays.
    """

    effect: Effect
    test: ScoreTest
    p_value: float
    p_adjusted: float
    evidence: float
    looks: float


@dataclass(frozen=True)
class Screen:
    """What one pass over all rows says of all candidates.

    Args:
        scores: as projected.
        common: the inflation that candidates have in common; 1 where all sigmas are right.
        candidates: best first.
        gauges: effects of which the data could show nothing.
        at: effect's name -> its columns among the scores.
    """

    scores: Scores
    common: float
    candidates: Sequence[Candidate]
    gauges: Sequence[Effect]
    at: Mapping[str, np.ndarray]

    def size_m(self, candidate: Candidate) -> float:
        """Root mean square of what it does to the ranges, all that the model absorbs included."""
        moved = self.scores.moved(candidate.test.columns, candidate.test.estimate())
        return float(np.sqrt(moved / max(self.scores.weight_m2, 1e-300)))

    def rms_m(self, candidate: Candidate) -> float:
        """Root mean square of the range residual that it alone can explain."""
        return float(np.sqrt(candidate.test.statistic / max(self.scores.weight_m2, 1e-300)))

    def taken_up(self, candidate: Candidate, theta: np.ndarray) -> float:
        """Share of what a test says of a candidate that its parameters (q,) have once it is fitted:
        little, where it would have to be far larger than it may be."""
        columns, wanted = candidate.test.columns, candidate.test.estimate()
        told = self.scores.information[np.ix_(columns, columns)] @ wanted
        return (
            float(theta @ told / max(wanted @ told, 1e-300)) if len(theta) == len(wanted) else 1.0
        )


def screen(
    scores: Scores,
    effects: Sequence[Effect],
    columns: Mapping[str, np.ndarray],
    common: float | None = None,
) -> Screen:
    """Test effects, and shapes of one family together.

    Args:
        scores: of all of them.
        effects: those to test.
        columns: effect's name -> its columns among the scores.
        common: inflation from elsewhere, if not from these effects.
    """
    tests = {e.name: score_test(scores, columns[e.name]) for e in effects if e.name in columns}
    gauges = [e for e in effects if e.name not in tests or not tests[e.name].dof]
    tests = {name: t for name, t in tests.items() if t.dof}
    families: dict[str, list[Effect]] = {}
    for effect in effects:
        if effect.name in tests:
            families.setdefault(effect.family, []).append(effect)
    if common is None:
        common = _common([(e, tests[e.name]) for some in families.values() for e in some])
    by_chance = _by_chance(scores, tests)
    least, found, many = [], [], 0
    for family in families.values():
        drawn, looks = np.min([by_chance[e.name] for e in family], axis=0), float(len(family))
        best = max(family, key=lambda e: tests[e.name].evidence(common))
        p = tests[best.name].p_value()
        if not isinstance(best, EachAlone):  # shapes of one effect, which have much in common
            looks, p = looked(drawn), min(tests[e.name].p_value() for e in family)
        if looks < QUANTILE * len(drawn):
            least.append(after_looks(drawn, looks))
        else:  # so few draws cannot tell how small its smallest p-value is
            many += 1
        found.append((best, after_looks(p, looks), looks))
    together = max(many + (looked(np.min(least, axis=0)) if least else 0.0), 1.0)
    candidates = [
        Candidate(
            effect=effect,
            test=tests[effect.name],
            p_value=float(p),
            p_adjusted=float(after_looks(p, together)),
            evidence=tests[effect.name].evidence(common),
            looks=looks * together,
        )
        for effect, p, looks in found
    ]
    ranked = sorted(candidates, key=lambda c: -c.evidence)
    return Screen(scores, common, ranked, gauges, at=columns)


def _common(tests: Sequence[tuple[Effect, ScoreTest]]) -> float:
    """The median inflation; of what beams tell, where they tell anything: their rows share errors
    of surfaces, of which those of trackers and targets know nothing."""
    of_beams = [t.inflation for e, t in tests if e.site not in (Site.TRACKER, Site.TARGET)]
    every = of_beams or [t.inflation for _, t in tests]
    return float(np.median(every)) if every else 1.0


def _by_chance(scores: Scores, tests: Mapping[str, ScoreTest]) -> dict[str, np.ndarray]:
    """p-values (R,) of every test on scores that are nothing but chance: each by its rank."""
    drawn = scores.draws
    return {
        name: by_rank(np.sum(np.square(drawn[:, t.columns] @ t.whiten), axis=1))
        for name, t in tests.items()
    }


def by_rank(statistic: np.ndarray) -> np.ndarray:
    """p-value (R,) of each of some draws of a statistic among all of them."""
    rank = np.empty(len(statistic))
    rank[np.argsort(-statistic, kind="stable")] = np.arange(1, len(statistic) + 1)
    return rank / (len(statistic) + 1)


def looked(smallest: np.ndarray) -> float:
    """How many independent tests have so small a smallest p-value, by chance (R,), at 5 %."""
    limit = float(np.quantile(smallest, QUANTILE))
    return max(1.0, float(np.log1p(-QUANTILE) / np.log1p(-min(max(limit, 1e-12), QUANTILE))))


def rivals(
    screen: Screen, best: Candidate, log_odds: Callable[[Candidate], float]
) -> list[Candidate]:
    """Candidates that are expected to predict other rows about as well as the best one, or better.

    Args:
        screen: the look at which all of them were missing.
        best: the leading candidate.
        log_odds: log of how much likelier other rows are expected to be with that than with each.
    """
    others = (c for c in screen.candidates if c.effect.family != best.effect.family)
    return [c for c in others if log_odds(c) < ODDS]


def angle_deg(screen: Screen, a: Candidate, b: Candidate) -> float:
    """Smallest principal angle between what two candidates would do to the residuals."""
    cross = screen.scores.information[np.ix_(a.test.columns, b.test.columns)]
    cosine = np.linalg.svd(a.test.whiten.T @ cross @ b.test.whiten, compute_uv=False)[0]
    return float(np.degrees(np.arccos(min(1.0, cosine))))
