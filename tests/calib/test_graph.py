"""The graph: what GTSAM does with its blocks, and the traps it would fall into alone."""

from collections.abc import Callable
from dataclasses import dataclass

import gtsam
import numpy as np
import pytest
from scipy.optimize import least_squares

from calib.problem import build
from calib.problem.model import Model, Source
from calib.problem.unknowns import Unknown, pose_unknown
from calib.residuals.robust import tukey_weight
from calib.solve.fit import solve
from calib.solve.graph import Graph

from . import rigs


def vector(name, size, mean=0.0, sigma=10.0):
    dofs = tuple(map(str, range(size)))
    return Unknown(
        name=name,
        kind="vector",
        mean=np.zeros(size) + mean,
        sigma=np.full(size, sigma),
        dofs=dofs,
        units=("m",) * size,
    )


@dataclass(frozen=True)
class Rows:
    """A block made of a function: values -> residual, {name: derivative}."""

    variables: tuple[str, ...]
    rows: int
    function: Callable
    name: str = "test rows"

    def evaluate(self, values, derivatives):
        residual, d = self.function(values)
        return residual, d if derivatives else None


# ------------------------------------------------------------------------------------------- traps


def outlying(seed=0):
    """200 measurements of one number, one in ten of them wild."""
    rng = np.random.default_rng(seed)
    z = rng.normal(0.0, 1.0, 200)
    z[::10] += 30.0
    return z


def gtsam_step(factors):
    """One Gauss-Newton step of a scalar from zero."""
    graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for factor in factors:
        graph.add(factor)
    start.insert(0, np.zeros(1))
    return start.retract(graph.linearize(start).optimize()).atVector(0)[0]


def custom(z, noise):
    def rows(_, values, jacobians):
        if jacobians is not None:
            jacobians[0] = np.ones((len(z), 1), order="F")
        return values.atVector(0) - z

    return gtsam.CustomFactor(noise, [0], rows)


def tukey(size):
    loss = gtsam.noiseModel.mEstimator.Tukey.Create(4.685)
    return gtsam.noiseModel.Robust.Create(loss, gtsam.noiseModel.Unit.Create(size))


def test_our_weights_are_those_of_one_robust_factor_per_row_and_gtsams_stacked_ones_are_not():
    z = outlying()
    root = np.sqrt(tukey_weight(-z))
    weighted = Rows(("x",), len(z), lambda v: (root * (v["x"] - z), {"x": root[:, None]}))
    x = vector("x", 1)
    ours = Graph([x], [weighted], frozenset({"x"})).step({"x": np.zeros(1)})[0]["x"][0]
    per_row = gtsam_step([custom(z[i : i + 1], tukey(1)) for i in range(len(z))])
    assert ours == pytest.approx(per_row, abs=1e-12)
    assert abs(ours) < 0.2
    # GTSAM gives the rows of a stacked factor one weight in common: here none at all, or with a
    # softer loss the plain mean, pulled to 3 by the wild rows.
    loss = gtsam.noiseModel.mEstimator.Huber.Create(1.345)
    noise = gtsam.noiseModel.Robust.Create(loss, gtsam.noiseModel.Unit.Create(len(z)))
    A, _ = custom(z, noise).linearize(_at_zero()).jacobian()
    np.testing.assert_allclose(A, A[0, 0])
    assert gtsam_step([custom(z, noise)]) == pytest.approx(z.mean(), rel=1e-9)


def _at_zero():
    values = gtsam.Values()
    values.insert(0, np.zeros(1))
    return values


@pytest.mark.parametrize("run", ["solve", "step"])
def test_a_residual_that_is_not_finite_raises(run):
    """GTSAM alone returns the start, without a word."""
    block = Rows(("x",), 2, lambda v: (v["x"] * [1.0, np.nan], {"x": np.eye(2)}), "stop 7")
    graph = Graph([vector("x", 2)], [block])
    with pytest.raises(FloatingPointError, match="'stop 7'"):
        getattr(graph, run)({"x": np.ones(2)})


@pytest.mark.parametrize("run", ["solve", "step"])
def test_a_derivative_that_is_not_finite_raises(run):
    block = Rows(("x",), 2, lambda v: (v["x"] - 1.0, {"x": np.diag([1.0, np.nan])}), "stop 7")
    graph = Graph([vector("x", 2)], [block])
    with pytest.raises(FloatingPointError, match="'stop 7'"):
        getattr(graph, run)({"x": np.zeros(2)})


@pytest.mark.parametrize("shape", [(3, 2), (2, 3), (2,), (6,)])
def test_a_derivative_of_the_wrong_shape_is_named(shape):
    block = Rows(("x",), 2, lambda v: (np.zeros(2), {"x": np.zeros(shape)}), "stop 7")
    with pytest.raises(ValueError, match=r"'stop 7': derivative by 'x' .*not \(2, 2\)"):
        Graph([vector("x", 2)], [block]).step({"x": np.zeros(2)})


def test_a_variable_twice_in_a_block_is_refused():
    """GTSAM takes it, and gets the Hessian wrong."""
    block = Rows(("x", "x"), 1, lambda v: (v["x"], {"x": np.eye(1)}), "stop 7")
    with pytest.raises(ValueError, match="'stop 7' names a variable twice"):
        Graph([vector("x", 1)], [block])


def test_a_sigma_of_zero_is_refused():
    """GTSAM makes it a constraint, and then calls the marginals of all others zero."""
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.array([0.01] * 5 + [0.0]))
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(), noise))
    values.insert(0, gtsam.Pose3())
    assert not gtsam.Marginals(graph, values).marginalCovariance(0).any()
    exact = Unknown(
        name="x",
        kind="vector",
        mean=np.zeros(2),
        sigma=np.array([0.01, 0.0]),
        dofs=("a", "b"),
        units=("m", "m"),
    )
    with pytest.raises(ValueError, match="'x'"):
        Graph([exact], [])


def slow_valley(scatter):
    """Least squares that Gauss-Newton approaches by halves, beside much scatter nothing explains.

    Fletcher's example, r = a [x + 1, x^2 / 2 + x - 1]: its minimum is at 0, with curvature a^2.
    """
    a = 100.0

    def rows(values):
        x = values["x"][0]
        d = np.array([[a], [a * (x + 1)], [0.0]])
        return np.array([a * (x + 1), a * (x**2 / 2 + x - 1), scatter]), {"x": d}

    return Rows(("x",), 3, rows), 1 / a


def test_solving_does_not_stop_short_where_rows_are_many():
    """A million rows that scatter as they should cost half a million; GTSAM stops at 1e-5 of it."""
    block, sigma = slow_valley(scatter=1e3)
    graph, start = Graph([vector("x", 1, sigma=1e6)], [block]), {"x": np.array([0.2])}
    values = gtsam.Values()
    values.insert(0, start["x"])
    params = gtsam.LevenbergMarquardtParams()
    short = gtsam.LevenbergMarquardtOptimizer(graph._graph, values, params).optimize().atVector(0)
    assert abs(short[0]) > sigma
    assert abs(graph.solve(start)[0]["x"][0]) < 1e-3 * sigma


# ---------------------------------------------------------------------------------- agreement


@pytest.fixture(scope="module")
def problem(tmp_path_factory):
    """A whole rig with tracker and targets, its frames known exactly in part."""
    folder = rigs.write(tmp_path_factory.mktemp("graph") / "box", lidar=None)
    return build([Source.open(folder)], Model())


def dense_information(problem, values):
    """J^T J of all blocks and priors, (P, P), and the place of every variable."""
    sizes = {name: v.dim for name, v in problem.variables.items()}
    ends = np.cumsum([0, *sizes.values()])
    at = {name: np.arange(a, a + n) for (name, n), a in zip(sizes.items(), ends, strict=False)}
    A = np.zeros((ends[-1], ends[-1]))
    for name, v in problem.variables.items():
        step = rigs.differences(lambda x, v=v: local(v, x[v.name]), values, name, v.kind)
        J = step / v.sigma[:, None]
        A[np.ix_(at[name], at[name])] += J.T @ J
    for block in problem.blocks:
        _, d = block.evaluate(values, True)
        J = np.zeros((block.rows, len(A)))
        for name, columns in d.items():
            J[:, at[name]] = columns
        A += J.T @ J
    return A, at


def local(v, value):
    """How far a value is from a variable's mean."""
    if v.kind == "pose":
        return gtsam.Pose3.Logmap(gtsam.Pose3(np.linalg.inv(v.mean) @ value))
    return value - v.mean


def test_marginals_are_those_of_the_dense_information(problem):
    graph = Graph(list(problem.variables.values()), problem.blocks)
    A, at = dense_information(problem, problem.initial)
    size = np.sqrt(np.diag(A))
    covariance = np.linalg.inv(A / np.outer(size, size)) / np.outer(size, size)
    names = ["mount_markers", "root@b", "gravity", "arm_link_length", "faro"]
    order = np.concatenate([at[name] for name in names])
    expected = covariance[np.ix_(order, order)]
    sigma = np.sqrt(np.diag(expected))
    found = graph.covariance(problem.initial, names)
    assert np.abs((found - expected) / np.outer(sigma, sigma)).max() < 1e-8
    alone = graph.covariance(problem.initial, ["faro"])
    np.testing.assert_allclose(alone, found[-6:, -6:], rtol=1e-9, atol=1e-18)


def test_error_is_half_chi_square_with_the_priors(problem):
    values = rigs.shaken(problem.variables, problem.initial, 0.01)
    graph = Graph(list(problem.variables.values()), problem.blocks)
    rows = [block.evaluate(values, False)[0] for block in problem.blocks]
    rows += [local(v, values[name]) / v.sigma for name, v in problem.variables.items()]
    chi2 = sum(r @ r for r in rows)
    assert graph.error(values) == pytest.approx(chi2 / 2, rel=1e-9)


def test_a_variable_without_prior_has_none(problem):
    x = vector("x", 1, mean=5.0, sigma=0.1)
    free, held = Graph([x], [], frozenset({"x"})), Graph([x], [])
    assert free.error({"x": np.zeros(1)}) == 0.0
    assert held.error({"x": np.zeros(1)}) == pytest.approx(0.5 * 50.0**2)


def test_solve_finds_what_scipy_finds():
    """A pose, a vector, and one whose length no row tells, in a problem of large residuals."""
    rng = np.random.default_rng(3)
    points, seen = rng.normal(size=(8, 3)), rng.normal(size=(8, 3))
    pose = pose_unknown("T", np.eye(4), np.full(6, 2.0))
    down, scale = vector("g", 3, np.array([0, 0, -1.0]), sigma=1.0), vector("s", 3, sigma=1.0)

    def residual(values):
        R, t = values["T"][:3, :3], values["T"][:3, 3]
        g = values["g"] / np.linalg.norm(values["g"])
        return (seen - (points * (1 + values["s"]) + 0.3 * g) @ R.T - t).ravel()

    def rows(values):
        kinds = {"T": "pose", "s": "vector", "g": "vector"}
        return residual(values), {
            n: rigs.differences(residual, values, n, kind) for n, kind in kinds.items()
        }

    start = {"T": np.eye(4), "g": np.array([0, 0, -1.0]), "s": np.zeros(3)}
    found, _ = Graph([pose, down, scale], [Rows(("T", "g", "s"), 24, rows)]).solve(start, 200)

    def moved(x):
        kinds = {"T": ("pose", x[:6]), "g": ("vector", x[6:9]), "s": ("vector", x[9:])}
        return {n: rigs.retract(kind, start[n], step) for n, (kind, step) in kinds.items()}

    def everything(x):
        values = moved(x)
        priors = [local(v, values[v.name]) / v.sigma for v in (pose, down, scale)]
        return np.concatenate([residual(values), *priors])

    best = moved(least_squares(everything, np.zeros(12), xtol=1e-15, ftol=1e-15, gtol=1e-15).x)
    for name in found:
        np.testing.assert_allclose(found[name], best[name], atol=2e-4)


# --------------------------------------------------------------------------- what is known exactly


def test_what_is_known_exactly_has_no_parameter_and_the_rest_keeps_its_spread(problem):
    arm_base = problem.variables["arm_base"]
    assert arm_base.dofs == ("rx", "ry", "tx", "ty", "tz")
    estimate = solve(problem)
    for name in problem.calibration:
        sigma = np.sqrt(np.diag(estimate.graph.covariance(estimate.values, [name])))
        assert (sigma > 1e-7).all() and (sigma <= 1.001 * problem.variables[name].sigma).all()
    stops = problem.blocks[0].stops
    found = stops.rig.tree.edges[stops.rig.tree.edge_names.index("arm_base")].T_parent_child
    placed = stops.in_root("arm_base", estimate.values).T[0]
    twist = gtsam.Pose3.Logmap(gtsam.Pose3(np.linalg.inv(found) @ placed))
    assert twist[2] == pytest.approx(0.0, abs=1e-12)
    assert np.abs(np.delete(twist, 2)).min() > 1e-7


def test_a_frame_whose_every_sigma_is_zero_stays_where_it_was_drawn(tmp_path):
    frames = rigs.drawing()["frames"]
    frames["mount"] |= {"sigma_m": 0, "sigma_rad": 0}
    source = Source.open(rigs.write(tmp_path / "box", lidar=None, frames=frames))
    problem = build([source], Model())
    assert "mount" not in problem.variables and "lidar" in problem.variables
    estimate = solve(problem)
    assert (np.diag(estimate.covariance) > 0).all()
