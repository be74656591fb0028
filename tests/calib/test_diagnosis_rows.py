"""The rows behind a diagnosis: the linearised normal equations, and what clusters share of them."""

import time
from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse import csr_array

from calib import effects
from calib import problem as problems
from calib.diagnosis.judges import Shares
from calib.diagnosis.linear import rows_along
from calib.diagnosis.score import away_from_model, project, score_test
from calib.diagnosis.stand import Stand
from calib.linear.parallel import workers
from calib.linear.rows import PLACES, StopRows
from calib.problem.model import Model
from calib.simulation import Spec
from calib.solve.fit import solve

from .simulated import made

SMALL = Spec(lidar="hesai_pandarxt32", locations=4, stops_per_location=3, column_step=100)
ADDED = ("incidence_angle_bias", "ring_elevation_offset", "arm_gravity_sag", "optitrack_scale")


def quiet(what, done, total):
    pass


@pytest.fixture(scope="module")
def stand(tmp_path_factory):
    source, _ = made(tmp_path_factory.mktemp("rows") / "rec", SMALL, 4, incidence_angle_bias=0.4)
    problem = problems.build([source], Model())
    return Stand([source], Model(), problem, solve(problem))


@pytest.fixture(scope="module")
def looked(stand):
    return stand.look(quiet)


@pytest.fixture(scope="module")
def linear(stand):
    return stand.linearise([effects.find(name) for name in ADDED], quiet)[0]


@pytest.fixture(scope="module")
def every_row(stand, linear):
    """All rows, one by one, along every unknown."""
    wide = problem_with(stand, ADDED)
    away = np.eye(linear.whole.layout.size)
    found = list(rows_along(linear, wide, stand.estimate, away, lambda done, total: None))
    at = np.stack([np.concatenate([getattr(r, k) for r in found]) for k in ("stop", "place")])
    return np.vstack([rows.A for rows in found]), np.concatenate([rows.b for rows in found]), at


def sizes(A):
    """What all rows tell of each unknown; one where no row feels it."""
    size = np.linalg.norm(A, axis=0)
    return np.where(size > 0, size, 1.0)


def test_places_are_numbered_in_the_order_of_stops_however_many_threads(stand, linear, monkeypatch):
    """The first stop takes longest, and each meets a place of its own."""

    def places(rows, kinds):
        time.sleep(0.05 if rows.stop == 0 else 0.0)
        return np.array([rows.stop]), np.zeros(len(rows.b), int)

    monkeypatch.setattr(StopRows, "places", places)
    wide, nothing = problem_with(stand, ()), lambda done, total: None
    along = stand.estimate, np.zeros((linear.whole.layout.size, 1)), nothing

    def found(count):
        with workers(count):
            return [rows.place for rows in rows_along(replace(linear, places={}), wide, *along)]

    for alone, together in zip(found(1), found(4), strict=True):
        np.testing.assert_array_equal(together, alone)


def problem_with(stand, names):
    return stand.problem_of(stand.model.plus(tuple(effects.find(name) for name in names)))


def test_without_its_candidates_a_linearisation_is_that_of_the_fit(stand):
    both = [stand.linearise([effects.find(x) for x in names], quiet)[0] for names in (ADDED, ())]
    for name, less in both[1].raw.items():
        np.testing.assert_allclose(both[0].raw[name], less, rtol=1e-9, atol=1e-9 * less.max())
    wide, fitted = (linear.whole for linear in both)
    found = wide.onto(fitted.layout)
    assert found.layout.size < wide.layout.size
    size = np.sqrt(np.diag(fitted.kept))
    size[size == 0.0] = 1.0
    unit = np.outer(size, size)
    np.testing.assert_allclose(found.kept / unit, fitted.kept / unit, atol=1e-9)
    np.testing.assert_array_equal(found.touched, fitted.touched)
    kept = np.diag(1.0 + np.arange(len(fitted.layout.kept)))
    rows = np.random.default_rng(0).normal(size=(5, fitted.layout.size))
    expected = fitted.covariance(csr_array(rows), kept)
    np.testing.assert_allclose(found.covariance(csr_array(rows), kept), expected, rtol=1e-6)
    for stop, sums in fitted.scans.items():
        whole = np.zeros((2, len(sums.cross), fitted.layout.size))
        for out, each in zip(whole, (sums, found.scans[stop]), strict=True):
            np.add.at(out.T, each.columns, each.cross.T)
        np.testing.assert_allclose(*whole, rtol=1e-9, atol=1e-9 * np.abs(whole).max())


def test_gradients_of_clusters_are_those_of_their_rows_with_the_others_eliminated(
    linear, every_row
):
    A, b, at = every_row
    scale, (kept, gone, back) = sizes(A), eliminated(linear, A)
    left = (A[:, kept] / scale[kept] - A[:, gone] / scale[gone] @ back) * b[:, None]
    clusters, number = np.unique([linear.stop, linear.place], axis=1, return_inverse=True)
    places = {pair: i for i, pair in enumerate(map(tuple, clusters.T))}
    expected = np.zeros((len(places), len(kept)))
    np.add.at(expected, [places[pair] for pair in map(tuple, at.T)], left)
    found = np.zeros_like(expected)
    np.add.at(found, number, linear.gradient[:, linear.among(list(linear.at))] / scale[kept])
    np.testing.assert_allclose(found, expected, atol=1e-7)


def eliminated(linear, A):
    """Of rows over all unknowns, which columns are kept and which are not, and what these are by
    those, all in units of what the rows tell of each."""
    kept = np.concatenate([np.r_[linear.columns[name]] for name in linear.at])
    scale = sizes(A)
    unit = (A / scale).T @ (A / scale)
    gone = np.setdiff1d(np.arange(len(unit)), kept)
    return kept, gone, np.linalg.solve(unit[np.ix_(gone, gone)], unit[np.ix_(gone, kept)])


def test_the_equations_are_those_of_all_rows_with_the_others_eliminated(linear, every_row):
    """Raw, the plain sum; then the Schur complement on what is kept; and the way back."""
    A, _, _ = every_row
    kept, gone, back = eliminated(linear, A)
    order, scale = linear.among(list(linear.at)), sizes(A)
    unit = (A / scale).T @ (A / scale)
    schur = unit[np.ix_(kept, kept)] - unit[np.ix_(kept, gone)] @ back
    square, both = np.ix_(order, order), np.outer(scale[kept], scale[kept])
    for name, raw in linear.raw.items():
        at = linear.columns[name]
        found = raw / scale[at] / scale[at, None]
        np.testing.assert_allclose(found, unit[at, at], atol=1e-9)
    np.testing.assert_allclose(linear.information[square] / both, schur, atol=1e-9)
    directions = linear.whole.followed(np.eye(len(linear.information))[:, order] / scale[kept])
    np.testing.assert_allclose(directions[gone] * scale[gone, None], -back, atol=1e-7)
    np.testing.assert_allclose(directions[kept] * scale[kept, None], np.eye(len(kept)), atol=1e-12)


def test_the_fit_is_where_its_own_gradient_vanishes(linear, every_row):
    A, b, _ = every_row
    total, scale = A.T @ b, sizes(A)
    for name, at in linear.columns.items():
        # In sigmas of independent rows; priors from paper are left out here, all others are in.
        if name.startswith(("root@", "joints@", "0/reference")):
            assert np.abs(total[at] / scale[at]).max() < 0.05, name


def test_what_an_effect_would_explain_is_what_a_refit_finds(stand, linear):
    found = project(linear, linear.candidates)
    name = "incidence_angle_bias"
    one = score_test(found, np.r_[found.at[name]])
    refit = stand.with_effects([effects.find(name)], quiet)
    fitted = refit.estimate.values[name]
    assert one.estimate()[0] == pytest.approx(fitted[0], rel=0.1)
    assert abs(one.estimate()[0]) == pytest.approx(0.4 * 0.003, rel=0.3)


def test_rows_are_derivatives_of_the_cost(stand, linear, every_row):
    """By finite differences of the whitened rows of one stop, weights held."""
    scan, association = stand.estimate.scans[0], stand.estimate.associations[0]
    effect = effects.find("incidence_angle_bias")
    term = problems.build(stand.sources, stand.model.plus((effect,))).terms[0][-1]
    wide = replace(scan, terms=[*scan.terms, term])

    def rows(size):
        return wide.rows({**stand.estimate.values, term.variable: np.array([size])}, association)

    at, step = rows(0.0), 1e-5
    change = (rows(step).residual_m - rows(-step).residual_m) / (2 * step)
    weight = at.weight / np.square(at.sigma_m)
    expected = -np.sum(weight * change * at.residual_m)
    column = linear.columns[term.variable].start
    A, b, (stop, place) = every_row
    beams = (stop == 0) & (place >= 0)
    found = A[beams, column] @ b[beams]
    assert found == pytest.approx(expected, rel=1e-5)


def test_beams_cluster_by_surface_and_trackers_by_stop(stand, linear):
    assert PLACES[0] == "surface"
    assert set(range(12)) <= set(linear.stop[linear.place >= 0].tolist())
    alone = (linear.stop >= 0) & (linear.place < 0)
    assert set(linear.stop[alone].tolist()) == set(range(12))


@pytest.mark.parametrize("name", ["incidence_angle_bias", "arm_gravity_sag"])
def test_rows_of_clusters_add_up_to_what_is_known_of_each(looked, name):
    """Their information to the whole, and of each stop and place their score to its share."""
    candidate = next(c for c in looked.named.candidates if c.effect.name == name)
    whiten, scores, found = candidate.test.whiten, looked.named.scores, {}
    every = rows_of(looked, candidate)
    total = sum(rows.A.T @ rows.A for rows in every)
    np.testing.assert_allclose(total, np.eye(candidate.test.dof), atol=1e-5)
    shares = np.vstack([rows.A * rows.b[:, None] for rows in every])
    at = (np.concatenate([getattr(rows, way) for rows in every]) for way in ("stop", "place"))
    for pair, share in zip(zip(*at, strict=True), shares, strict=True):
        found[pair] = found.get(pair, 0.0) + share
    pairs = zip(scores.stop, scores.place, strict=True)
    for pair, share in zip(pairs, scores.cells[:, candidate.test.columns] @ whiten, strict=True):
        found[pair] = found.get(pair, 0.0) - share
    np.testing.assert_allclose(np.vstack([*found.values()]), 0.0, atol=1e-4)


def rows_of(look, candidate):
    names = [candidate.effect.name]
    away = away_from_model(look.linear, names) @ candidate.test.whiten
    told = look.stand.estimate, away, lambda done, total: None
    return [*rows_along(look.linear, problem_with(look.stand, names), *told)]


@pytest.fixture
def drawn(monkeypatch):
    """Of each stop 200 beams judge."""
    monkeypatch.setattr("calib.diagnosis.linear.JUDGING_NUMBERS", 0)
    monkeypatch.setattr("calib.diagnosis.linear.DRAWN_NUMBERS", 0)
    monkeypatch.setattr("calib.diagnosis.linear.FEWEST_DRAWN", 200)


def test_some_beams_stand_for_all_of_each_wall(looked, request):
    candidate = looked.named.candidates[0]
    every = rows_of(looked, candidate)
    request.getfixturevalue("drawn")
    some = rows_of(looked, candidate)
    fewer = [b for a, b in zip(every, some, strict=True) if len(b.A) < len(a.A)]
    assert len(fewer) == len(looked.stand.estimate.scans)
    for a, b in zip(every, some, strict=True):
        felt = np.any(a.A != 0, axis=1)
        assert np.isin(a.place[felt], b.place).all()
        if len(b.A) < len(a.A):
            assert np.sum(np.square(b.A)) == pytest.approx(np.sum(np.square(a.A)), rel=0.3)


@pytest.mark.parametrize("name", ["incidence_angle_bias", "ring_elevation_offset"])
def test_some_beams_judge_about_as_all_do(looked, name, request):
    """One parameter, and one for each ring."""
    candidate = next(c for c in looked.named.candidates if c.effect.name == name)
    by_all = looked.judged(candidate, quiet)
    request.getfixturevalue("drawn")
    by_some = looked.judged(candidate, quiet)
    some, every = by_some.chances[1].trace, by_all.chances[1].trace
    assert some != every and some == pytest.approx(every, rel=0.2)
    assert np.log(by_some.p_value()) == pytest.approx(np.log(by_all.p_value()), rel=0.1, abs=0.2)


@pytest.mark.parametrize("beams", ["all", "drawn"])
@pytest.mark.long
def test_planes_judge_as_a_mesh_does(tmp_path, beams, request):
    """Where no mesh was scanned, beams are drawn from each plane."""
    spec = SMALL.model_copy(update={"mesh": False, "targets": 0, "column_step": 20})
    source, _ = made(tmp_path / "rec", spec, 4, near_range_bias=3.0)
    problem = problems.build([source], Model())
    look = Stand([source], Model(), problem, solve(problem)).look(quiet)
    if beams == "drawn":
        request.getfixturevalue("drawn")
    best = next(c for c in look.named.candidates if c.effect.family == "near_range_bias")
    total = sum(rows.A.T @ rows.A for rows in rows_of(look, best))
    np.testing.assert_allclose(total, 1.0, atol=1e-5 if beams == "all" else 0.3)
    assert look.judged(best, quiet).p_value() < 1e-3


def test_a_signal_no_longer_widens_the_clusters_that_judge_it(looked):
    best = looked.named.candidates[0]
    assert best.effect.name == "incidence_angle_bias"
    judged = looked.judged(best, quiet)
    assert judged.statistic == best.test.statistic
    assert judged.inflation < 3.0 < best.test.inflation


def test_what_one_cluster_alone_says_is_not_believed():
    # Twenty stops with a little each, and one that has nearly all of the information and signal.
    scores, holds = [*(0.1 * (-1) ** k for k in range(20)), 6.0], [*[0.002] * 20, 0.96]
    assert left_out(scores, holds).trace > 10.0
    # One that has all of it: nothing is there to compare it with.
    assert left_out([6.0, 0.0], [1.0, 0.0]).trace > 1e9
    # The same signal, spread evenly over all of them, is believed.
    assert left_out([6.0 / 21] * 21, [1.0 / 21] * 21).trace < 1e-12


def left_out(scores, holds):
    """Chance from stops with such scores and shares of the information, of one parameter."""
    pairs = np.stack([np.arange(len(holds)), np.full(len(holds), -1)], axis=1)
    rows = np.sqrt(holds)[:, None]
    shares = Shares([*rows[:, None]], [*map(tuple, pairs)])
    return shares.left_out(pairs, np.array(scores)[:, None], 1.0)[0]


def test_a_gauge_is_named_not_observable(looked):
    assert "range_offset" in {g.name for g in looked.named.gauges}
