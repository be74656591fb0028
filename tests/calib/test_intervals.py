"""Intervals where rows err together: by dense algebra, by Monte Carlo, and in another's worlds."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from calib import problem as problems
from calib.linear.clusters import ClusteredRows, Gradients
from calib.problem.model import Model, Source
from calib.results.intervals import PARTS, Intervals, _Sums, intervals
from calib.simulation import Spec
from calib.solve.clustered import of_beams
from calib.solve.fit import solve

from ..worlds import World, write
from .simulated import made

SMALL = Spec(lidar="hesai_pandarxt32", locations=4, stops_per_location=3, column_step=100)


# ------------------------------------------------------------------------------- made-up rows


def rows(A, b, stop, part):
    return ClusteredRows(A, b, np.arange(A.shape[1]), stop, part)


def by_hand(moved, share, cluster):
    """The jackknife's square and degrees of freedom, cluster by cluster."""
    clusters = np.unique(cluster)
    t = np.array([moved[cluster == c].sum(axis=0) for c in clusters])
    h = np.array([share[cluster == c].sum(axis=0) for c in clusters])
    # Covariance of the t / (1 - h) where rows err alone, for each parameter by itself.
    d = []
    for x in (h / (1 - h)).T:
        covariance = -np.outer(x, x)
        np.fill_diagonal(covariance, x)
        d.append(np.trace(covariance) ** 2 / np.square(covariance).sum())
    return np.square(t / (1 - h)).sum(axis=0), np.array(d)


def test_the_formula_is_that_of_the_module():
    rng = np.random.default_rng(0)
    count = 400
    stop, part = rng.integers(0, 12, count), rng.integers(0, 5, count)
    A = rng.normal(size=(count, 3))
    paper = rng.normal(size=(2, 3))
    whole = np.square(A).sum(axis=0) + np.square(paper).sum(axis=0)
    A, paper = A / np.sqrt(whole), paper / np.sqrt(whole)
    b = rng.normal(size=count) + rng.normal(size=12)[stop] + rng.normal(size=5)[part]
    sums = _Sums(np.zeros((3, 3)))
    for some in np.array_split(rng.permutation(count), 7):
        sums.add(rows(A[some], b[some], stop[some], part[some]))
    sums.add(rows(paper, np.zeros(2), np.full(2, -1), np.full(2, -1)))
    moved, share = A * b[:, None], np.square(A)
    by_stop, d_stop = by_hand(moved, share, stop)
    by_part, d_part = by_hand(moved, share, part)
    by_both, _ = by_hand(moved, share, 5 * stop + part)
    beyond = np.maximum(by_part - by_both, 0)
    v = np.square(paper).sum(axis=0) + by_stop + beyond
    d = v**2 / (by_stop**2 / d_stop + beyond**2 / d_part)
    expected = np.sqrt(v) * stats.t.isf(0.025, d) / stats.norm.isf(0.025)
    np.testing.assert_allclose(sums.wider(), np.maximum(1, expected), rtol=1e-9)


@pytest.mark.parametrize(
    ("stops", "together", "least", "most"),
    [(30, 0.0, 0.945, 0.975), (30, 1.0, 0.92, 0.97), (8, 1.0, 0.88, 0.97), (8, 0.0, 0.945, 0.985)],
)
def test_intervals_hold_the_truth_where_stops_err_together(stops, together, least, most):
    """A mean and a slope of 40 rows a stop, which share an error of so many of their own. With 8
    stops, some of which tell far more of the slope than others, 0.90 do (measured): degrees of
    freedom are those of rows that err alone."""
    rng, each, held, plain = np.random.default_rng(stops), 40, [], []
    stop = np.repeat(np.arange(stops), each)
    for _ in range(1500):
        J = np.column_stack([np.ones(len(stop)), rng.normal(size=len(stop))])
        J[:, 1] += rng.normal(size=stops)[stop]
        y = rng.normal(size=len(stop)) + together * rng.normal(size=stops)[stop]
        C = np.linalg.inv(J.T @ J)
        x, sigma = C @ J.T @ y, np.sqrt(np.diag(C))
        sums = _Sums(np.zeros((2, 2)))
        sums.add(rows(J @ C / sigma, y - J @ x, stop, np.full(len(stop), -1)))
        held.append(np.abs(x / sigma) < 1.96 * sums.wider())
        plain.append(np.abs(x / sigma) < 1.96)
    shares = np.mean(held, axis=0)
    assert np.all((least < shares) & (shares < most)), shares
    if together:
        assert np.mean(plain) < 0.6  # what rows alone would have said


def test_where_nothing_can_be_compared_the_graph_is_believed():
    one = _Sums(np.zeros((1, 1)))
    A = np.array([[0.6], [0.8]])
    one.add(rows(A, np.zeros(2), np.zeros(2, int), np.full(2, -1)))
    none = _Sums(np.zeros((1, 1)))
    none.add(rows(A, np.zeros(2), np.full(2, -1), np.full(2, -1)))
    assert one.wider() == none.wider() == 1.0


def known(wider):
    """Two parameters of which the data tell the sum alone to 0.01, paper each to 1; and another."""
    J = np.array([[1.0, 1.0, 0.0], [0.0, 0.0, 0.1]]) / 0.01
    graph = np.linalg.inv(J.T @ J + np.eye(3))
    return Intervals(
        names=("tied", "alone"),
        dims=(2, 1),
        graph=graph,
        data=graph @ J.T @ J @ graph,
        wider=np.array(wider),
    )


def test_what_comes_on_top_is_as_large_as_it_should_be_and_a_covariance():
    found = known([1.1, 1.0, 4.0])
    more = found.covariance - found.graph
    assert np.linalg.eigvalsh(more).min() > -1e-12
    ratio = np.sqrt(np.diag(found.covariance) / np.diag(found.graph))
    np.testing.assert_allclose(ratio, found.wider)
    np.testing.assert_allclose(found.of(["alone"]).covariance, found.covariance[2:, 2:])
    least = np.sqrt(np.diag(found.at_least(1.5).covariance) / np.diag(found.graph))
    np.testing.assert_allclose(least, [1.5, 1.5, 4.0])


def test_what_the_data_determine_is_as_much_wider_as_they_say():
    """Rows that err together make their sum twice as uncertain. Each of both, which paper alone
    tells, is hardly wider for it; were that correlated as the graph is, the sum would not be."""
    found, both = known([1.0, 1.0, 1.0]), np.array([1.0, 1.0, 0.0])
    share = np.diag(found.data) / np.diag(found.graph)
    found = replace(found, wider=np.sqrt(1 + 3 * share))
    assert found.wider[:2] == pytest.approx(1.0, abs=1e-3)
    before = both @ found.graph @ both
    assert before == pytest.approx(1e-4, rel=1e-3)
    assert both @ found.covariance @ both == pytest.approx(4 * before, rel=1e-3)
    more = np.sqrt(np.square(found.wider) - 1)
    naive = found.graph * (1 + np.outer(more, more))
    assert both @ naive @ both == pytest.approx(before, rel=0.01)


# ---------------------------------------------------------------------------------------- fits


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    source, _ = made(tmp_path_factory.mktemp("rows") / "rec", SMALL, 4)
    return solve(problems.build([source], Model()))


def test_the_rows_of_a_fit_are_all_that_is_known_and_lead_nowhere(fitted, monkeypatch):
    """Their shares add up to all that is known of each parameter, priors included; and at the
    optimum, what they add moves none of them."""
    seen = SimpleNamespace(moved=0.0, share=0.0)

    def add(self, rows):
        seen.moved = seen.moved + (rows.A.T @ rows.b)
        seen.share = seen.share + np.square(rows.A).sum(axis=0)

    monkeypatch.setattr(_Sums, "add", add)
    monkeypatch.setattr(_Sums, "wider", lambda self: np.ones(len(self.priors)))
    intervals(fitted)
    np.testing.assert_allclose(seen.share, 1.0, atol=1e-6)
    np.testing.assert_allclose(seen.moved, 0.0, atol=2e-3)


def test_beams_are_told_apart_by_region(fitted):
    layout, places = fitted.linear.layout, Gradients(fitted.linear.layout.size)
    directions = np.zeros((layout.size, 1))
    found = list(
        of_beams(
            *(fitted.problem, layout, fitted.values, fitted.associations),
            *(directions, places, PARTS),
        )
    )
    regions = {int(p) for a in fitted.associations for p in np.unique(a.patches["region"])}
    assert {int(p) for each in found for p in np.unique(each.place)} == set(range(len(regions)))
    assert len(regions) > 30


# ------------------------------------------------------------------ worlds of another simulator


def rings_off(world, folder):
    """Error over sigma of each ring zero, as the graph has it and as its interval does."""
    write(world, folder)
    estimate = solve(problems.build([Source.open(folder)], Model()))
    truth = json.loads(folder.with_name(f"{folder.name}.truth.json").read_text())
    error = estimate.values["ring_range_offset"] - np.array(truth["ring_range_offset"])
    known = intervals(estimate).of(["ring_range_offset"])
    graph, wider = np.sqrt(np.diag(known.graph)), known.wider
    return np.sqrt(np.mean(np.square(error / graph))), np.sqrt(
        np.mean(np.square(error / graph / wider))
    )


@pytest.mark.slow
def test_ring_zeros_are_honest_where_stops_scatter(tmp_path):
    """Each stop has a range zero of its own, of 1 mm, that no model speaks of. A good fit says 0.1
    mm of its ring zeros; they are several times that off."""
    found = [
        rings_off(World(seed=seed, beams=1000, stop_scatter_m=1e-3), tmp_path / f"{seed}")
        for seed in range(4)
    ]
    graph, honest = np.sqrt(np.mean(np.square(found), axis=0))
    assert graph > 2.5
    assert honest < 2.0  # of four draws of nearly one number each, more in half a percent
