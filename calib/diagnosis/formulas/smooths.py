"""What a residual depends on: smooth functions of one, two or three covariates, tested together.

Every column that beams or stops have is looked at, alone, in pairs, and with the best pairs a
third. Few stops cannot confirm a function of many knots, and few knots do not see what turns over
a whole range; so products of lines, and of sines of angles, are looked at besides. The p-value is
adjusted for all tests (Westfall and Young 1993), and stops and surfaces are the clusters, as for
the catalogue's effects.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import combinations, pairwise

import numpy as np

from calib.blunders.chance import log_tail
from calib.diagnosis.formulas.factors import product_of
from calib.diagnosis.formulas.table import BeamTable, Projection, together
from calib.diagnosis.jackknife import squares_of
from calib.diagnosis.score import ScoreTest, score_tests
from calib.diagnosis.screen import by_rank, looked

# Knots of a function of one covariate, of each of two and of three. A pair of 5 x 5 sees what turns
# three times over its range; finer things are found alone or as formulas.
SMOOTH_KNOTS = {1: 12, 2: 5, 3: 3}
TURN_KNOTS = {1: 24, 2: 8, 3: 6}  # of azimuth, evenly round: 4 would not see two waves in a turn
STOPS_A_KNOT = 5  # of columns of the stops, as of bins: with fewer, tests have no power
FEW = 8  # values of a column, up to which each is a class of its own
MOST_THIRDS = 2  # pairs to which a third covariate is tried; also threes, by their product alone
THREES_AT_ONCE = 16  # of threes: what fits into a processor's cache; 200 take four times as long
MOST_CLASSES = 6  # of a label, those of most beams
PATTERN = 4  # rings after which electronics repeat: chips of 4, 8 and 16 channels


_Set = tuple[tuple[str, ...], bool]  # covariates, and whether by lines and sines


@dataclass(frozen=True)
class Smooth:
    """A smooth function of some covariates, tested.

    Args:
        covariates: their names.
        test: of its columns.
        looks: by how many independent looks a p-value pays.
        evidence: see `ScoreTest.evidence`.
        plain: whether it is a product of lines and sines; otherwise it is one of knots.
    """

    covariates: tuple[str, ...]
    test: ScoreTest
    looks: float
    evidence: float
    plain: bool = False


@dataclass(frozen=True)
class Bases:
    """Columns of smooth functions of each covariate, made when asked.

    Args:
        table: the beams.
        stops: how many there are.
    """

    table: BeamTable
    stops: int
    _made: dict[tuple[str, int], np.ndarray] = field(default_factory=dict, repr=False)
    _lines: dict[str, np.ndarray] = field(default_factory=dict, repr=False)

    def names(self) -> list[str]:
        """Covariates that differ; rings stand for elevations where these are the same."""
        return [n for n, v in self.table.covariates.items() if n != "ring" and _differs(v)]

    def of(self, covariates: Sequence[str], together: int = 0) -> np.ndarray:
        """(N, K) columns of a function of some covariates together, or of so many."""
        keys = [(name, together or len(covariates)) for name in covariates]
        for key in keys:
            if key not in self._made:
                self._made[key] = self._one(*key)
        return product_of([np.ones((len(self.table), 1)), *(self._made[key] for key in keys)])

    def columns(self, covariates: Sequence[str], plain: bool) -> np.ndarray:
        """(N, K) columns of one smooth function that is tested."""
        return self.plain(covariates) if plain else self.of(covariates)

    def plain(self, covariates: Sequence[str]) -> np.ndarray:
        """(N, K) columns of the product of a line of each; of a joint sine and cosine, of azimuth
        those of two harmonics."""
        for name in covariates:
            if name not in self._lines:
                self._lines[name] = self._line(name)
        return product_of([self._lines[name] for name in covariates])

    def _line(self, name: str) -> np.ndarray:
        """(N, K) columns of one covariate, each with a mean of zero but those of angles."""
        values = self.table.covariates[name]
        turns = {"azimuth_rad": (1, 2)}.get(name, (1,) if name in self.table.turning else ())
        if turns:
            waves = [f(m * values) for m in turns for f in (np.sin, np.cos)]
            columns = np.stack(waves, axis=1)
        else:
            columns = ((values - np.nanmean(values)) / np.nanstd(values))[:, None]
        return np.nan_to_num(columns)

    def _one(self, name: str, together: int) -> np.ndarray:
        """(N, K) columns of one covariate beside others."""
        values = self.table.covariates[name]
        distinct = np.unique(values[np.isfinite(values)])
        usual = SMOOTH_KNOTS[together]
        if name in self.table.by_stop:
            usual = max(2, min(usual, round((self.stops / STOPS_A_KNOT) ** (1 / together))))
        if name == "label" or len(distinct) <= min(FEW, usual):
            often, count = np.unique(values[np.isfinite(values)], return_counts=True)
            often = often[np.argsort(-count, kind="stable")[:MOST_CLASSES]]
            columns = (values[:, None] == often).astype(float)
        elif name == "azimuth_rad":
            columns = _round_hats(values, TURN_KNOTS[together])
        else:
            knots = np.unique(np.quantile(distinct, np.linspace(0, 1, usual)))
            columns = hats(values, knots)
        if name == "elevation_rad" and "ring" in self.table.covariates:
            which = np.mod(self.table.covariates["ring"], PATTERN).astype(int)
            columns = np.hstack([columns, np.eye(PATTERN)[which][:, 1:]])
        columns[~np.isfinite(values)] = 0.0
        return columns


def hats(values: np.ndarray, knots: np.ndarray) -> np.ndarray:
    """(N, K) piecewise linear functions, each 1 at one knot and 0 at the others."""
    if len(knots) < 2:
        return np.ones((len(values), 1))
    at = np.clip(np.nan_to_num(values, nan=knots[0]), knots[0], knots[-1])
    i = np.clip(np.searchsorted(knots, at, side="right") - 1, 0, len(knots) - 2)
    share = (at - knots[i]) / (knots[i + 1] - knots[i])
    out = np.zeros((len(values), len(knots)))
    every = np.arange(len(values))
    out[every, i], out[every, i + 1] = 1.0 - share, share
    return out


def _round_hats(values: np.ndarray, count: int) -> np.ndarray:
    """The same round a circle."""
    turn = np.mod(np.nan_to_num(values), 2 * np.pi) / (2 * np.pi) * count
    i = np.floor(turn).astype(int) % count
    share = turn - np.floor(turn)
    out = np.zeros((len(values), count))
    every = np.arange(len(values))
    out[every, i] += 1.0 - share
    out[every, (i + 1) % count] += share
    return out


def _differs(values: np.ndarray) -> bool:
    """Whether values differ by amounts whose squares are numbers: 1e200 and 1e-200 fill columns
    that nobody measured."""
    known = values[np.isfinite(values)]
    with np.errstate(over="ignore"):
        return len(known) > 0 and 0.0 < float(np.std(known)) < np.inf


def screen_smooths(
    projection: Projection,
    bases: Bases,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[Smooth]:
    """All smooth functions that could be missing, those with most evidence first."""
    table = bases.table
    names = bases.names()
    points = [n for n in names if n not in table.by_stop] or names  # of an arm, all are of stops
    sets: list[_Set] = [((n,), False) for n in names]
    pairs = [p for p in combinations(names, 2) if set(p) & set(points)]
    sets += [(p, plain) for p in pairs for plain in (False, True) if not (plain and "label" in p)]
    found = dict(_tested(projection, bases, sets, progress))
    common = _common([t for t, _ in found.values()])
    best = sorted((s for s in found if len(s[0]) == 2), key=lambda s: -found[s][0].evidence(common))
    thirds = {
        tuple(sorted((*pair, n), key=names.index)): None
        for pair in list(dict.fromkeys(pair for pair, _ in best))[:MOST_THIRDS]
        for n in names
        if n not in pair and "label" not in (n, *pair)
    }
    threes, tried = _threes(projection, bases, names, points)
    more = [(each, False) for each in thirds | dict.fromkeys(threes)]
    found |= dict(_tested(projection, bases, [*more, *((each, True) for each in threes)], progress))
    drawn = [chance for _, chance in found.values()]
    looks = looked(np.min(drawn, axis=0)) if drawn else 1.0
    every = [
        Smooth(
            covariates=s,
            test=t,
            # Of threes that were chosen by their products, all that there are have been looked at.
            looks=looks + tried * (s in threes and s not in thirds),
            evidence=t.evidence(common),
            plain=plain,
        )
        for (s, plain), (t, _) in found.items()
    ]
    return sorted(every, key=lambda s: -s.evidence)


def _threes(
    projection: Projection, bases: Bases, names: Sequence[str], points: Sequence[str]
) -> tuple[list[tuple[str, ...]], int]:
    """The three covariates whose product alone explains most, as may be where no two of them
    together explain anything, and the next; and of how many."""
    plain = [n for n in names if n != "label"]
    sets = [s for s in combinations(plain, 3) if set(s) & set(points)]
    if not sets:
        return [], 0
    explained = []
    for i in range(0, len(sets), THREES_AT_ONCE):
        some = [bases.plain(s) for s in sets[i : i + THREES_AT_ONCE]]
        statistic, dof = projection.explained(some)
        explained += [-log_tail(x, d) if d else 0.0 for x, d in zip(statistic, dof, strict=True)]
    best = np.argsort(-np.array(explained), kind="stable")[:MOST_THIRDS]
    return [sets[i] for i in best], len(sets)


def _tested(
    projection: Projection,
    bases: Bases,
    sets: Sequence[_Set],
    progress: Callable[[int, int], None],
) -> Iterator[tuple[_Set, tuple[ScoreTest, np.ndarray]]]:
    """Each set's test, and by rank the p-values (R,) of the same on scores by chance."""
    signs, number = projection.table.signs, 0
    for blocks in together(bases.columns(*each) for each in sets):
        scores = projection.scores(np.hstack(blocks))
        # Every set has the same clusters in the same order, so the same draw of signs is one world.
        shares = np.vstack([scores.by_stop, scores.by_place]).astype(signs.dtype)
        drawn = signs @ shares
        ends = np.cumsum([0, *(block.shape[1] for block in blocks)])
        for found in score_tests(scores, [np.arange(*pair) for pair in pairwise(ends)]):
            progress(number, len(sets))
            if found.dof:
                by_chance = squares_of(drawn[:, found.columns] @ found.whiten)
                yield sets[number], (found, by_rank(by_chance))
            number += 1


def _common(tests: Sequence[ScoreTest]) -> float:
    return float(np.median([t.inflation for t in tests])) if tests else 1.0
