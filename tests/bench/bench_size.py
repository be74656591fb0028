"""How often a test of an effect finds one in rows where there is none, at a nominal 0.05.

    python tests/bench/bench_size.py [--draws 240] [--families "rows; stops err; ..."]

Own rows: a number of stops that see 25 surfaces, two rows each; a model that the rows' errors are
fitted by; and a candidate of 1 to 64 parameters. Every family makes the candidate, or the errors,
otherwise. A line is a family, a number of stops and one of parameters; its columns are shares of
draws in which a test finds something:

signs   the screen's test (`calib.diagnosis.jackknife`, by signs)
out     a judged candidate's second test (the same module, by leaving out; 0 where too few are left)
judged  the smaller p-value of both, which decides a name
CV3     the second test, its degrees of freedom times nu, however few the clusters: left
webb    a restricted wild bootstrap by stops, with Webb's weights, studentised by leaving
        out: left
KS      largest distance of the judged p-values from a uniform distribution

The last table is power: effects of some sizes that all stops show, or three of them. One thread,
and some two minutes a family.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain

import numpy as np
from scipy import stats
from threadpoolctl import threadpool_limits

from calib.diagnosis.jackknife import Clusters, ScoreSpread, by_signs
from calib.diagnosis.judges import CellRows, Judges

PLACES, EACH = 25, 2
STOPS, PARAMETERS = (6, 8, 12, 20, 30, 60), (1, 4, 16, 64)
DESIGNS = 8  # worlds' candidates; draws of errors are spread over them
LEVEL = 0.05
WEBB = np.sqrt([0.5, 1.0, 1.5])
BOOTSTRAPS, FOR_POWER = 199, 2999  # the least p-value is one over their number plus one


@dataclass(frozen=True)
class Family:
    """A kind of world.

    Args:
        act: how the candidate acts: sizes of its columns by row, by stop and by surface; `within`:
            its mean of every stop is taken off; `stops`, `places`: all but so many of
            them show 0.15 of it; `owned`: the first two surfaces show so much of its parameters,
            all others 0.05 of these.
        stop_sd, place_sd: errors that the rows of a stop, or a surface, share, in those of a row.
        by_stop: how many unknowns of the model differ by stop alone.
        model: how many more of its unknowns all rows share.
        lone_sd: errors that the rows of the first stop and, where places differ, of the first
            surface share.
    """

    by_row: float = 1.0
    by_stop: float = 1.0
    by_place: float = 0.5
    within: bool = False
    stops: int = 0
    places: int = 0
    owned: float = 0.0
    stop_sd: float = 0.0
    place_sd: float = 0.0
    model_by_stop: int = 0
    model: int = 0
    lone_sd: float = 0.0


FAMILIES = {
    "rows": Family(),
    "stops err a little": Family(stop_sd=0.5),
    "stops err": Family(stop_sd=3.0),
    "by stop, stops err": Family(by_row=0.05, by_place=0.0, stop_sd=3.0),
    "three stops": Family(stops=3),
    "three stops, stops err": Family(stops=3, stop_sd=3.0),
    "within stops, stops err": Family(by_stop=0.0, within=True, stop_sd=3.0),
    "surfaces err": Family(place_sd=3.0),
    "three surfaces, these err": Family(places=3, place_sd=3.0),
    "three surfaces": Family(places=3),
    "one stop": Family(stops=1),
    "one stop, stops err": Family(stops=1, stop_sd=3.0),
    "one surface": Family(places=1),
    "one surface, surfaces err a little": Family(places=1, place_sd=0.5),
    "one stop, it errs, wide model": Family(stops=1, lone_sd=10.0, model=15),
    "one surface, it errs, wide model": Family(places=1, lone_sd=3.0, model=15),
    "two surfaces own half": Family(owned=0.5),
    "two surfaces own half, stops err": Family(owned=0.5, stop_sd=3.0),
    "two surfaces own half, both err": Family(owned=0.5, stop_sd=0.5, place_sd=0.5),
    "two surfaces own half, one errs": Family(owned=0.5, lone_sd=3.0),
    "two surfaces own half, one errs, wide model": Family(owned=0.5, lone_sd=3.0, model=15),
    "both err": Family(stop_sd=0.5, place_sd=0.5),
    "model by stop, stops err": Family(stop_sd=3.0, model_by_stop=3),
}


class World:
    """Stops that see surfaces, a model's columns, and those of a candidate, projected off it and
    whitened."""

    def __init__(self, family: Family, stops: int, parameters: int, seed: int) -> None:
        rng = np.random.default_rng([seed, stops, parameters])
        self.family, self.stops = family, stops
        self.stop = np.repeat(np.arange(stops), PLACES * EACH)
        self.place = np.tile(np.repeat(np.arange(PLACES), EACH), stops)
        rows = len(self.stop)
        mine = family.by_row * rng.standard_normal((rows, parameters))
        mine += family.by_stop * rng.standard_normal((stops, parameters))[self.stop]
        mine += family.by_place * rng.standard_normal((PLACES, parameters))[self.place]
        if family.within:
            mine -= mine.reshape(stops, -1, parameters).mean(axis=1)[self.stop]
        if family.stops:
            mine *= np.where(self.stop < family.stops, 1.0, 0.15)[:, None]
        if family.places:
            mine *= np.where(self.place < family.places, 1.0, 0.15)[:, None]
        if family.owned:
            last = round(family.owned * parameters)
            theirs = self.place[:, None] == np.arange(last) % 2
            mine[:, :last] *= np.where(theirs, 1.0, 0.05)
        model = rng.standard_normal((stops, family.model_by_stop))[self.stop]
        shared = rng.standard_normal((rows, 1 + family.model))
        shared += rng.standard_normal((stops, 1 + family.model))[self.stop] * bool(family.model)
        model = np.column_stack([np.ones(rows), shared, model])
        self.model = np.linalg.qr(model)[0]
        mine -= self.model @ (self.model.T @ mine)
        values, axes = np.linalg.eigh(mine.T @ mine)
        seen = values > 1e-6 * values.max()
        self.columns = mine @ (axes[:, seen] / np.sqrt(values[seen]))
        pairs = np.stack(np.divmod(np.arange(stops * PLACES), PLACES), axis=1)
        cells = CellRows(pairs, self.columns, np.repeat(np.arange(len(pairs)), EACH))
        self.judges = Judges.of(cells, family.model_by_stop)
        self.clusters = self.judges.every.clusters

    def _cells(self) -> np.ndarray:
        return self.columns.reshape(self.stops * PLACES, EACH, -1)

    def _ways(self, cells: np.ndarray) -> list[np.ndarray]:
        """Sums over cells by stop, by place, and the cells."""
        both = cells.reshape(self.stops, PLACES, *cells.shape[1:])
        return [both.sum(axis=1), both.sum(axis=0), cells]

    def scores(self, rng: np.random.Generator, effect: float = 0.0) -> list[np.ndarray]:
        """Scores (c, r) by stop, place and both of errors drawn, and an effect in their sigmas."""
        b = rng.standard_normal(len(self.stop))
        b += self.family.stop_sd * rng.standard_normal(self.stops)[self.stop]
        b += self.family.place_sd * rng.standard_normal(PLACES)[self.place]
        if self.family.lone_sd:
            lone = self.place if self.family.places or self.family.owned else self.stop
            b += self.family.lone_sd * rng.standard_normal() * (lone == 0)
        b += effect * self.columns.sum(axis=1) / np.sqrt(self.columns.shape[1])
        b -= self.model @ (self.model.T @ b)
        return self._ways(np.einsum("bki,bk->bi", self._cells(), b.reshape(-1, EACH)))


def p_values(
    world: World, ways: list[np.ndarray], rng: np.random.Generator, bootstraps: int
) -> dict[str, float]:
    """Of every test, by its name."""
    score = ways[0].sum(axis=0)
    statistic = float(score @ score)
    spent = world.family.model_by_stop
    signs = by_signs(ways, world.stops, spent)
    out = min(c.p_value(statistic) for c in world.judges.chances(ways[2], signs.nu))
    found = {"signs": signs.p_value(statistic), "out": out}
    found["judged"] = min(found.values())
    stop, place, both = (c.covariance(w) for c, w in zip(world.clusters, ways, strict=True))
    more = (place - both) * (np.trace(place - both) > 0.0)
    d = min(clusters.d for clusters in world.clusters[:2]) * signs.nu
    wide = ScoreSpread(stop + more, signs.nu, d, d)
    return found | {
        "CV3": wide.p_value(statistic),
        "webb": webb(world.clusters[0], ways[0], rng, bootstraps),
    }


def webb(
    clusters: Clusters, scores: np.ndarray, rng: np.random.Generator, bootstraps: int
) -> float:
    """Restricted wild cluster bootstrap of scores (c, r), studentised by CV3."""
    count, r = scores.shape
    inverse = np.stack([clusters.apart.get(c, np.eye(r)) for c in range(count)])
    predicted = inverse @ clusters.information
    own = np.einsum("cij,cj->ci", inverse, scores)
    square = np.einsum("cki,ckj->ij", predicted, predicted)
    cross = np.einsum("cki,ck->ci", predicted, own)

    def ratio(weights: np.ndarray) -> np.ndarray:
        total = weights @ scores
        trace = np.square(weights) @ np.square(own).sum(axis=1)
        trace += ((total @ square - 2.0 * weights @ cross) * total).sum(axis=1)
        return np.square(total).sum(axis=1) / np.maximum(trace, 1e-300)

    drawn = rng.choice(np.concatenate([WEBB, -WEBB]), (bootstraps, count))
    there = ratio(np.ones((1, count)))[0]
    return float(1 + np.sum(ratio(drawn) >= there * (1 - 1e-9))) / (bootstraps + 1)


def drawn(
    family: Family, stops: int, parameters: int, draws: int, effect: float = 0.0
) -> dict[str, np.ndarray]:
    """p-values (draws,) of every test."""
    found: dict[str, list[float]] = {}
    bootstraps = FOR_POWER if effect else BOOTSTRAPS
    for seed in range(DESIGNS):
        world, rng = World(family, stops, parameters, seed), np.random.default_rng([seed, 1])
        for _ in range(draws // DESIGNS):
            ways = world.scores(rng, effect)
            for name, p in p_values(world, ways, rng, bootstraps).items():
                found.setdefault(name, []).append(p)
    return {name: np.array(p) for name, p in found.items()}


def sizes(names: list[str], draws: int) -> Iterator[str]:
    """Lines of the table of sizes."""
    tests = ("signs", "out", "judged", "CV3", "webb")
    yield f"{'family':44}{'r':>4}{'stops':>6}" + "".join(f"{t:>8}" for t in (*tests, "KS"))
    for name in names:
        for parameters in PARAMETERS:
            for stops in STOPS:
                p = drawn(FAMILIES[name], stops, parameters, draws)
                share = "".join(f"{np.mean(p[t] < LEVEL):8.3f}" for t in tests)
                distance = stats.kstest(p["judged"], "uniform").statistic
                yield f"{name:44}{parameters:4}{stops:6}{share}{distance:8.3f}"


def power(draws: int) -> Iterator[str]:
    """Lines of the table of power at 0.001."""
    yield f"\n{'power at 0.001, 30 stops':44}{'sigmas':>10}{'signs':>8}{'judged':>8}{'webb':>8}"
    for name, family in (
        ("all stops", Family()),
        ("three stops", Family(stops=3)),
        ("two surfaces", Family(places=2)),
        ("of 16 parameters, two surfaces own half", Family(owned=0.5)),
    ):
        parameters = 16 if family.owned else 1
        for effect in (4.0, 6.0, 10.0, 30.0, 100.0):
            p = drawn(family, 30, parameters, draws // 4, effect)
            share = "".join(f"{np.mean(p[t] < 1e-3):8.2f}" for t in ("signs", "judged", "webb"))
            yield f"{name:44}{effect:10.0f}{share}"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--draws", type=int, default=240)
    parser.add_argument("--families", default="; ".join(FAMILIES))
    asked = parser.parse_args()
    chosen = [name.strip() for name in asked.families.split(";")]
    with threadpool_limits(1):
        for line in chain(sizes(chosen, asked.draws), power(asked.draws)):
            print(line, flush=True)
