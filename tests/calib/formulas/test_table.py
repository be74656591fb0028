"""The beams' table: against dense least squares of all rows, and against what a fit holds."""

import numpy as np
import pytest

from calib.diagnosis.formulas.table import HUBER, BeamTable, Projection
from calib.diagnosis.score import score_test
from calib.effects import DEFAULT
from calib.problem import build
from calib.problem.model import Model
from calib.simulation import Spec
from calib.solve.fit import solve

from .. import simulated
from .made import SIGMA, dense, solved, table

SMALL = {"stops": 8, "each": 60}


def some_columns(beams: BeamTable) -> np.ndarray:
    c = beams.covariates
    return np.column_stack([c["range_m"] * c["humidity"], np.sin(3 * c["azimuth_rad"])])


def weighted(beams: BeamTable) -> np.ndarray:
    """Weights that differ from row to row."""
    rng = np.random.default_rng(5)
    return rng.uniform(0.2, 1.0, len(beams)) / beams.sigma_m**2


@pytest.fixture(scope="module")
def case():
    beams = table(1, **SMALL, hidden=lambda c: 0.004 * np.sin(3 * c["azimuth_rad"]))
    return Projection.of(beams, weighted(beams)), some_columns(beams)


def test_the_model_alone_leaves_what_dense_least_squares_leave(case):
    model, columns = case
    rows, off = dense(model.table, model.weight, columns[:, :0])
    step, _ = solved(rows, off)
    left = (off + rows @ step)[: len(model.table)] / np.sqrt(model.weight)
    assert model.left_m == pytest.approx(left, abs=1e-9)
    assert model.step == pytest.approx(step, abs=1e-7)


def test_columns_explain_what_they_take_off_dense_least_squares(case):
    model, columns = case
    _, alone = solved(*dense(model.table, model.weight, columns[:, :0]))
    blocks = [columns, columns[:, :1], columns[:, 1:]]
    fall = [alone - solved(*dense(model.table, model.weight, b))[1] for b in blocks]
    statistic, dof = model.explained(blocks)
    assert statistic == pytest.approx(fall, rel=1e-6)
    assert dof.tolist() == [2, 1, 1]
    tests = [score_test(model.scores(b), np.arange(b.shape[1])) for b in blocks]
    assert [t.statistic for t in tests] == pytest.approx(fall, rel=1e-6)


def test_information_is_the_inverse_of_their_covariance(case):
    model, columns = case
    rows, _ = dense(model.table, model.weight, columns)
    covariance = np.linalg.inv(rows.T @ rows)[-2:, -2:]
    information = model.scores(columns).information
    assert information == pytest.approx(np.linalg.inv(covariance), rel=1e-6)


def test_columns_are_fitted_as_by_dense_least_squares(case):
    model, columns = case
    rows, off = dense(model.table, model.weight, columns)
    step, _ = solved(rows, off)
    fit, theta = model.fitted(columns)
    assert theta == pytest.approx(step[-2:], rel=1e-6)
    assert fit.step == pytest.approx(step[:-2], abs=1e-7)
    left = (off + rows @ step)[: len(model.table)] / np.sqrt(model.weight)
    assert fit.left_m == pytest.approx(left, abs=1e-9)


def test_a_model_with_columns_beside_it_is_the_larger_model(case):
    model, columns = case
    larger = model.beside(columns[:, 1:])
    rows, off = dense(model.table, model.weight, columns[:, 1:])
    step, whole = solved(rows, off)
    assert larger.step == pytest.approx(step, abs=1e-7)
    _, both = solved(*dense(model.table, model.weight, columns))
    assert larger.explained([columns[:, :1]])[0] == pytest.approx([whole - both], rel=1e-6)


def test_what_the_model_can_take_on_explains_nothing(case):
    model, _ = case
    beams = model.table
    zero, ring = np.ones((len(beams), 1)), (beams.covariates["ring"] == 3)[:, None].astype(float)
    assert np.abs(model.off(ring)[0]).max() < 1e-2  # but for the prior of a ring
    beams = type(beams)(**{**vars_of(beams), "others": beams.others * 1e-4})
    free = Projection.of(beams, model.weight)
    statistic, dof = free.explained([zero, ring])
    assert dof.tolist() == [0, 0] and statistic.tolist() == [0.0, 0.0]
    assert free.fitted(np.hstack([zero, ring]))[1].tolist() == [0.0, 0.0]


def vars_of(beams: BeamTable) -> dict:
    return {name: getattr(beams, name) for name in beams.__dataclass_fields__}


def test_a_column_that_is_added_comes_back_as_its_amount():
    """Sign and size, of ranges that a formula lengthens: measured = true + formula."""
    beams = table(2, stops=20, each=150, hidden=lambda c: 0.01 * c["range_m"] * c["humidity"])
    column = (beams.covariates["range_m"] * beams.covariates["humidity"])[:, None]
    fit, theta = beams.projection(column).fitted(column)
    sigma = score_test(fit.scores(column), np.arange(1)).sigma(1.0)
    assert theta[0] > 0 and abs(theta[0] - 0.01) < 4 * sigma[0] < 0.004
    assert np.std(fit.left_m) < 1.05 * SIGMA


def test_beams_far_out_are_held_in_bounds_and_none_is_thrown_away():
    beams = table(3, **SMALL, outliers=0.05)
    model = beams.projection()
    huber = model.weight * SIGMA**2
    z = model.left_m / SIGMA
    wild = np.abs(z) > 12
    assert 0.02 < wild.mean() < 0.09
    assert huber.min() > 0 and huber.max() <= 1.0
    assert np.median(huber[~wild]) == 1.0
    # It pulls as one at the bound does, not as its 25 sigmas would; the passes are not quite done.
    assert np.abs(huber * z)[wild].max() < 2 * HUBER


def test_weights_speak_of_all_beams_when_a_share_is_drawn():
    whole, tenth = (table(4, **SMALL, share=s).projection() for s in (1.0, 0.1))
    assert np.median(tenth.weight) == pytest.approx(10 * np.median(whole.weight))


def test_leaving_out_stops_scatters_a_score_as_stops_do():
    """A range zero of each stop's own makes a column of the stops far less certain."""

    def sigma(scatter_m: float) -> float:
        beams = table(5, stops=25, each=80, scatter_m=scatter_m)
        column = (beams.covariates["temperature_c"] - 25)[:, None]
        model = beams.projection()
        found = model.judged(column)
        assert len(found.chances) == 2
        return float(found.chances[1].covariance[0, 0])

    quiet, loud = sigma(0.0), sigma(0.003)
    # Of one stop, 80 beams of 2 mm say its zero to 0.22 mm.
    assert 0.4 < quiet < 2.5
    assert loud > 10 * quiet


# A fit --------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def estimate(tmp_path_factory):
    folder = tmp_path_factory.mktemp("table")
    spec = Spec(
        lidar="hesai_pandarxt32", room="box", locations=3, stops_per_location=2, column_step=250
    )
    source, _ = simulated.made(folder / "rec", spec)
    return solve(build([source], Model(DEFAULT)))


def test_the_same_beams_are_drawn_each_time(estimate):
    one, two = (BeamTable.of(estimate, most=1000) for _ in range(2))
    assert np.array_equal(one.residual_m, two.residual_m)
    assert all(np.array_equal(v, two.covariates[n]) for n, v in one.covariates.items())
    assert (one.twists != two.twists).nnz == 0


def test_a_share_of_each_stop_is_drawn(estimate):
    every, some = BeamTable.of(estimate), BeamTable.of(estimate, most=1000)
    assert every.share == 1.0
    assert len(some) == pytest.approx(1000, abs=len(np.unique(some.stop)))
    assert some.share == pytest.approx(1000 / len(every), rel=0.02)
    of_each = np.bincount(some.stop) / np.bincount(every.stop)
    assert of_each == pytest.approx(some.share, rel=0.02)


def test_columns_of_stops_are_told_from_those_of_beams(estimate):
    beams = BeamTable.of(estimate, most=2000)
    assert {"range_m", "incidence_rad", "azimuth_rad", "ring"} <= set(beams.covariates)
    assert "temperature_c" in beams.by_stop
    for name, values in beams.covariates.items():
        spread = max(np.ptp(values[beams.stop == k]) for k in np.unique(beams.stop))
        assert (spread == 0.0) == (name in beams.by_stop), name
