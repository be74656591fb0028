"""Effects on the scatter: estimated in the graph from what holds show, and moving no mean."""

import numpy as np
import pytest

from calib import effects
from calib import problem as problems
from calib.diagnosis.search.confirmed import judged
from calib.diagnosis.stand import Stand
from calib.effects import Effect, OneHot, Param, Site
from calib.problem.model import Model
from calib.residuals.spread import spread_rows
from calib.simulation import Spec
from calib.solve.fit import solve
from sensors.recording import Scan

from .simulated import made

SMALL = Spec(lidar="hesai_pandarxt32", locations=4, stops_per_location=3, column_step=50)
POWER = 0.4  # what size 1 stands for


def quiet(what, done, total):
    pass


def fitted(folder, size, model, seed=2):
    hide = {"noise_range": size} if size else {}
    source, truth = made(folder / "rec", SMALL, seed, **hide)
    problem = problems.build([source], model)
    return Stand([source], model, problem, solve(problem)), truth


def test_the_power_of_range_is_found_within_its_sigma(tmp_path):
    model = Model().plus((effects.find("noise_range"),))
    stand, truth = fitted(tmp_path, 1.0, model)
    true = truth["effects"]["noise_range"][0]
    names = [v.name for v in stand.estimate.variables]
    dims = np.cumsum([0, *(v.dim for v in stand.estimate.variables)])
    at = dims[names.index("noise_range")]
    sigma = np.sqrt(stand.estimate.covariance[at, at])
    assert abs(true) == pytest.approx(POWER)
    assert sigma < 0.02
    assert abs(stand.estimate.values["noise_range"][0] - true) < 4 * sigma


def test_added_to_a_model_it_ends_where_a_fit_from_the_start_does(tmp_path):
    """Sigmas change with it, so costs before and after are not of the same rows; no such fit was
    called converged."""
    with_it = Model().plus((effects.find("noise_range"),))
    stand, _ = fitted(tmp_path, 1.0, Model())
    added = stand.with_effects([effects.find("noise_range")], quiet).estimate
    anew = solve(problems.build(stand.sources, with_it))
    assert added.converged and anew.converged
    names = [v.name for v in anew.variables if v.kind == "vector"]
    for name in (*names, "noise_range"):
        sigma = np.sqrt(np.diag(anew.covariance_of([name])))
        assert np.abs(added.values[name] - anew.values[name]).max() < 0.02 * sigma.min()


@pytest.mark.long
def test_it_stands_out_where_it_is_and_not_where_it_is_not(tmp_path):
    found = {}
    for size in (0.0, 1.0):
        (tmp_path / str(size)).mkdir()
        look = fitted(tmp_path / str(size), size, Model())[0].look(quiet)
        found[size] = {c.effect.name: c for c in look.noise.candidates}
        # It moves no mean, so nothing else is made of it.
        assert min(c.p_adjusted for c in look.named.candidates) > 0.01
    assert found[0.0]["noise_range"].p_adjusted > 0.01
    assert found[1.0]["noise_range"].evidence > 50 > found[0.0]["noise_range"].evidence
    assert judged(look, found[1.0]["noise_range"], quiet)[1] < 1e-5
    one = found[1.0]["noise_range"].test.estimate()[0]
    assert abs(one) == pytest.approx(POWER, rel=0.35)  # one step


def scan(spread_m, count):
    n = len(spread_m)
    columns = {f.name: None for f in Scan.__dataclass_fields__.values()}
    columns |= {"range_std_m": spread_m, "count": np.full(n, count), "xyz_m": np.zeros((n, 3))}
    return Scan(**columns)


def test_rows_are_the_derivative_of_the_scatter():
    rng = np.random.default_rng(1)
    growth, count, theta = rng.uniform(-1, 1, (4000, 1)), 25, 0.05
    sigma_m = 0.004 * np.exp(growth[:, 0] * theta)
    spread_m = sigma_m * np.sqrt(rng.chisquare(count - 1, len(sigma_m)) / (count - 1))
    rows = spread_rows(
        scan(spread_m, count),
        np.full(len(growth), 0.004**2),
        np.ones(len(growth), bool),
        {"g": growth},
    )
    A = rows.columns["g"]
    found, information = -(A.T @ rows.residual), A.T @ A
    assert np.std(rows.residual) == pytest.approx(1.0, abs=0.15)
    assert found[0] / information[0, 0] == pytest.approx(theta, abs=4 / np.sqrt(information[0, 0]))


def test_a_direction_seen_once_says_nothing_of_scatter():
    spread_m, usable = np.full(5, np.nan), np.ones(5, bool)
    assert spread_rows(scan(spread_m, 1), np.ones(5), usable, {"g": np.ones((5, 1))}) is None


class RingNoise(Effect):
    """Every ring scatters in its own way; the basis as the test says."""

    name, site, covariates = "ring_noise", Site.NOISE, ("ring",)

    def __init__(self, of):
        self.of = of

    def params(self, rig):
        return tuple(Param(f"ring_{i}", "1", 0.4) for i in range(rig.lidar.rings))

    def basis(self, view):
        return self.of(view)


def test_the_basis_of_a_noise_effect_may_be_of_any_kind(tmp_path):
    source, _ = made(tmp_path / "rec", SMALL, 2)
    rings = source.rig.lidar.rings
    kinds = {
        "dense": lambda view: np.eye(rings)[view["ring"].astype(int)][:, None],
        "one of each row": lambda view: OneHot(
            view["ring"].astype(int), np.ones((view.rows, 1)), rings
        ),
        "one row for all": lambda view: np.ones((1, 1, rings)),
    }
    columns = {}
    for kind, basis in kinds.items():
        problem = problems.build([source], Model().plus((RingNoise(basis),)))
        columns[kind] = problem.scans[0].rows(problem.initial).spread.columns["ring_noise"]
    assert np.abs(columns["dense"]).max() > 1.0
    np.testing.assert_allclose(columns["one of each row"], columns["dense"])
    # Each stop's own level is taken off, so what is common to a stop says nothing.
    np.testing.assert_allclose(columns["one row for all"], 0.0, atol=1e-12)
