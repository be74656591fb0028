"""The score test: against a dense re-solve, against chance, and against what it must not see."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats
from scipy.sparse import csr_array

from calib.blunders.chance import log_tail
from calib.diagnosis import score
from calib.diagnosis.judges import Shares
from calib.diagnosis.linear import Linear
from calib.diagnosis.screen import ODDS, looked, rivals, screen
from calib.diagnosis.search.parts import Explained
from calib.effects import Site
from calib.problem.unknowns import Owner

STOPS, PLACES, EACH = 30, 25, 6
THEIRS = {"one": 1, "twin": 1, "several": 3, "gauge": 1, "rings": 40}


class World:
    """Rows of stops that see places, with errors of both, and candidates beside a model of two
    unknowns; each row knows its stop and its place."""

    def __init__(self, seed, stop_sd=0.0, place_sd=0.0, wrong=1.0, **effects):
        rng = np.random.default_rng(seed)
        design = np.random.default_rng(7)
        stop, place = np.divmod(np.arange(STOPS * PLACES), PLACES)
        self.stop, self.place = np.repeat(stop, EACH), np.repeat(place, EACH)
        rows = len(self.stop)
        self.model = np.column_stack([np.ones(rows), design.standard_normal(rows)])
        a = design.standard_normal(rows) + design.standard_normal(STOPS)[self.stop]
        several = (
            design.standard_normal((rows, 3)) + design.standard_normal((PLACES, 3))[self.place]
        )
        ring = design.integers(0, THEIRS["rings"], rows)
        self.columns = {
            "one": a[:, None],
            "twin": (a + 0.05 * design.standard_normal(rows))[:, None],
            "several": several,
            "gauge": self.model @ [[2.0], [1.0]],
            "rings": (ring[:, None] == np.arange(THEIRS["rings"])).astype(float),
        }
        self.b = wrong * rng.standard_normal(rows)
        self.b += stop_sd * rng.standard_normal(STOPS)[self.stop]
        self.b += place_sd * rng.standard_normal(PLACES)[self.place]
        for name, size in effects.items():
            self.b += self.columns[name] @ np.full(THEIRS[name], size)

    def linear(self):
        """Normal equations once a fit has taken off what the model explains; nothing is eliminated
        from them."""
        names = list(self.columns)
        J = np.hstack([self.model, *self.columns.values()])
        ends = np.cumsum([2, *(THEIRS[n] for n in names)])
        columns = {"model": slice(0, 2)}
        pairs = zip(names, ends, ends[1:], strict=False)
        columns |= {n: slice(int(i), int(k)) for n, i, k in pairs}
        _, cell = np.unique(self.stop * PLACES + self.place, return_inverse=True)
        fitted = self.b - self.model @ np.linalg.lstsq(self.model, self.b, rcond=None)[0]
        pick = csr_array((fitted, (cell, np.arange(len(cell)))))
        stop, place = np.divmod(np.arange(STOPS * PLACES), PLACES)
        return Linear(
            candidates=tuple(names),
            owner=dict.fromkeys(columns, Owner()),
            at={name: np.r_[at] for name, at in columns.items()},
            columns=columns,
            information=J.T @ J,
            raw={name: J[:, at].T @ J[:, at] for name, at in columns.items()},
            gradient=np.asarray(pick @ J),
            score=J.T @ fitted,
            others=(),
            stop=stop,
            place=place,
            places={},
            weight_m2=float(len(J)),
            whole=None,
        )


def scores(world):
    linear = world.linear()
    return score.project(linear, linear.candidates)


def trial(world, name):
    found = scores(world)
    return score.score_test(found, np.r_[found.at[name]])


def judged(world, name):
    """The test of a candidate with its clusters jackknifed."""
    every = scores(world)
    found = score.score_test(every, np.r_[every.at[name]])
    column = world.columns[name]
    away = column - world.model @ np.linalg.lstsq(world.model, column, rcond=None)[0]
    shares = Shares()
    shares.add(away @ found.whiten, world.stop, world.place)
    return found.judged(shares, every)


@pytest.mark.parametrize("name", ["one", "several", "rings"])
def test_the_statistic_is_the_fall_of_chi_square_in_a_dense_refit(name):
    world = World(1, one=0.05)
    found = trial(world, name)
    wide = np.hstack([world.model, world.columns[name]])
    chi2 = [
        np.sum(np.square(world.b - J @ np.linalg.lstsq(J, world.b, rcond=None)[0]))
        for J in (world.model, wide)
    ]
    np.testing.assert_allclose(found.statistic, chi2[0] - chi2[1], rtol=1e-6)


@pytest.mark.parametrize("name", ["one", "several"])
def test_the_estimate_is_that_of_a_dense_refit(name):
    world = World(2, one=0.3, several=-0.1)
    J = np.hstack([world.model, world.columns[name]])
    expected = np.linalg.lstsq(J, world.b, rcond=None)[0][2:]
    np.testing.assert_allclose(trial(world, name).estimate(), expected, rtol=1e-6)


def test_what_the_model_can_take_on_is_a_gauge():
    found = trial(World(3), "gauge")
    assert found.dof == 0
    assert found.smallest_detectable(1.0, 0.05) == np.inf


def test_a_gauge_direction_of_a_candidate_is_left_out():
    # The rings' columns add up to one of the model's.
    assert trial(World(3), "rings").dof == THEIRS["rings"] - 1


def null_p_values(count, **kind):
    out = {name: [] for name in ("one", "several", "rings")}
    for seed in range(count):
        found = scores(World(seed, **kind))
        for name in out:
            t = score.score_test(found, np.r_[found.at[name]])
            out[name].append(t.p_value())
    return {name: np.array(p) for name, p in out.items()}


@pytest.mark.parametrize(
    "kind",
    [{}, {"stop_sd": 0.5, "place_sd": 0.5}, {"wrong": 2.0}],
    ids=["rows", "two ways", "sigma"],
)
def test_p_values_hold_where_rows_err_together_and_sigmas_are_wrong(kind):
    p = null_p_values(200, **kind)
    for name in ("one", "several"):
        # 200 at 5 %: between 1 % and 10 % with 99.9 % probability.
        assert 0.005 < np.mean(p[name] < 0.05) < 0.10, name
    assert np.mean(p["rings"] < 0.05) < 0.10


def test_a_naive_test_would_not_hold():
    """The same worlds, rows taken for independent: the test above has teeth."""
    naive = []
    for seed in range(100):
        t = trial(World(seed, stop_sd=0.5, place_sd=0.5), "several")
        naive.append(stats.chi2.sf(t.statistic, t.dof))
    assert np.mean(np.array(naive) < 0.05) > 0.3


def test_the_order_of_rows_and_candidates_does_not_matter():
    world = World(4, one=0.1)
    linear = world.linear()
    forward = score.project(linear, linear.candidates)
    backward = score.project(linear, linear.candidates[::-1])
    for name in ("one", "several", "rings"):
        a, b = (score.score_test(s, np.r_[s.at[name]]) for s in (forward, backward))
        np.testing.assert_allclose(a.statistic, b.statistic, rtol=1e-8)
        np.testing.assert_allclose(a.p_value(), b.p_value(), rtol=1e-6)


@pytest.mark.long
def test_an_effect_of_the_smallest_detectable_size_is_found_four_times_out_of_five():
    alpha = 0.001
    sizes = [trial(World(seed), "one").smallest_detectable(1.0, alpha) for seed in range(20)]
    size = float(np.median(sizes))
    hits = [judged(World(seed, one=size), "one").p_value() < alpha for seed in range(300)]
    assert 0.72 < np.mean(hits) < 0.88


def test_a_signal_widens_the_clusters_that_judge_it_unless_they_are_jackknifed():
    world = World(1, one=0.5)
    before, after = trial(world, "one"), judged(world, "one")
    np.testing.assert_allclose(before.statistic, after.statistic, rtol=1e-6)
    assert after.inflation < 3 < 10 < before.inflation


@pytest.mark.long
def test_intervals_cover():
    z = []
    for seed in range(200):
        t = judged(World(seed, stop_sd=0.3, one=0.1), "one")
        z.append((t.estimate()[0] - 0.1) / t.sigma(t.inflation)[0])
    assert 0.90 < np.mean(np.abs(z) < 1.96) < 0.99


def named(world, chosen=("one", "twin", "several", "rings", "gauge")):
    found = scores(world)
    site = Site.BEAM
    effects = [SimpleNamespace(name=n, family=n, covariates=(n,), site=site) for n in chosen]
    return screen(found, effects, {n: np.r_[found.at[n]] for n in chosen})


def test_the_best_explanation_comes_first_and_a_gauge_is_said_to_be_one():
    found = named(World(5, several=0.3))
    assert found.candidates[0].effect.name == "several"
    assert found.candidates[0].p_adjusted < 1e-3
    assert [g.name for g in found.gauges] == ["gauge"]


def test_looking_at_more_costs_more_but_twins_count_once():
    found = named(World(6))
    looks = found.candidates[0].looks
    # Four candidates, two of which are nearly one.
    assert 2.0 < looks < 4.0
    assert all(c.p_adjusted >= c.p_value for c in found.candidates)


def test_independent_looks_are_counted():
    p = np.random.default_rng(1).uniform(size=(20000, 12))
    assert looked(p.min(axis=1)) == pytest.approx(12, rel=0.1)
    assert looked(p[:, 0]) == pytest.approx(1, rel=0.1)


def test_the_smallest_of_many_is_adjusted_to_five_percent():
    least = [min(c.p_adjusted for c in named(World(seed)).candidates) for seed in range(150)]
    assert np.mean(np.array(least) < 0.05) < 0.11


@pytest.mark.parametrize("name", ["one", "several", "rings"])
@pytest.mark.parametrize("size", [0.0, 0.05])
@pytest.mark.long
def test_the_log_score_is_what_other_rows_gain_by_a_fit(name, size):
    """The same stops once more, with other errors: half the fall of their chi-square by what was
    estimated from the first, on average over draws."""
    gains = []
    for seed in range(120):
        first, again = (World(s, **({name: size} if size else {})) for s in (seed, 10_000 + seed))
        found = trial(first, name)
        column = first.columns[name] @ found.whiten
        away = column - first.model @ np.linalg.lstsq(first.model, column, rcond=None)[0]
        effect = away @ (found.whiten.T @ found.score)
        fell = np.sum(np.square(again.b)) - np.sum(np.square(again.b - effect))
        gains.append((Explained(found.statistic, found.dof).log_score(1.0), fell / 2))
    told, seen = np.mean(gains, axis=0)
    sigma = np.std(np.subtract(*np.transpose(gains))) / np.sqrt(len(gains))
    assert told == pytest.approx(seen, abs=4 * sigma)
    assert sigma < 1.5  # of the price of 1 to 39


def than(best):
    """Log odds of the best one against another."""

    def told(candidate):
        return Explained(candidate.test.statistic, candidate.test.dof).log_score(1.0)

    return lambda other: told(best) - told(other)


def test_what_explains_as_much_with_more_parameters_is_a_rival(monkeypatch):
    """It is none by the price that ranks candidates, which favours few parameters the more, the
    larger an effect is."""
    world, rng = World(8, several=1.0), np.random.default_rng(3)
    more = rng.standard_normal((len(world.b), 2))
    world.columns["wider"] = np.hstack([world.columns["several"], more])
    monkeypatch.setitem(THEIRS, "wider", 5)
    found = named(world, ("several", "wider"))
    best, other = found.candidates
    assert best.effect.name == "several"
    assert best.evidence - other.evidence > ODDS
    assert rivals(found, best, than(best)) == [other]


def test_a_twin_is_a_rival_and_another_effect_is_none():
    found = named(World(8, one=0.4))
    best = found.candidates[0]
    assert best.effect.name in ("one", "twin")
    others = [c.effect.name for c in rivals(found, best, than(best))]
    assert set(others) <= {"one", "twin"}
    clear = named(World(8, several=0.3))
    best = clear.candidates[0]
    assert rivals(clear, best, than(best)) == []


@pytest.mark.parametrize("q", [1, 5, 60])
def test_the_tail_goes_on_where_the_library_ends(q):
    inside = np.linspace(200.0, 900.0, 5)
    for x in inside:
        expected = stats.chi2.logsf(x, q)
        assert log_tail(x, q) == pytest.approx(expected, abs=1e-9)
    beyond = [log_tail(x, q) for x in (2e3, 2e4, 2e5)]
    assert np.isfinite(beyond).all() and np.all(np.diff(beyond) < 0)
    # Just past where the library underflows, both agree to the first order.
    assert log_tail(1400.0, q) == pytest.approx(stats.chi2.logsf(1400.0, q), rel=1e-3)
