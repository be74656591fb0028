"""How widely values scatter by chance: against a dense likelihood, closed forms, and chance."""

import numpy as np
import pytest
from scipy import optimize, stats

from calib import add, diagnose, fit
from calib.diagnosis.chance.at_zero import AtZero
from calib.effects import CATALOGUE, find
from calib.problem import build
from calib.problem.model import Model, Source
from calib.problem.spread import spread_of
from calib.simulation import Spec, simulate
from calib.solve.components import spreads, squares
from calib.solve.components.checks import Checks
from calib.solve.components.told import Told
from calib.solve.fit import resume, solve

SD, PLACE_SD = 0.7, 0.4
SPEC = Spec(
    lidar="hesai_pandarxt32", locations=6, stops_per_location=4, column_step=100, world_seed=5
)

SPARSE = {"column_step": 200}  # where the scans need tell no more than where the LiDAR was


class Mixed:
    """Rows ``y = X b + Z u + e``, unit noise, with values u of members in two crossed groups."""

    def __init__(self, seed, sd=(SD, PLACE_SD), members=(20, 8), rows=300):
        rng = np.random.default_rng(seed)
        design = np.random.default_rng(99)
        self.X = np.column_stack([np.ones(rows), design.standard_normal((rows, 2))])
        index = [design.integers(0, count, rows) for count in members]
        self.Z = np.hstack([np.eye(c)[i] for c, i in zip(members, index, strict=True)])
        self.group = np.repeat([0, 1], members)
        u = np.repeat(sd, members) * rng.standard_normal(sum(members))
        self.y = self.X @ [1.0, -0.5, 2.0] + self.Z @ u + rng.standard_normal(rows)

    def told(self):
        """Score and information of the values, the others projected off."""
        left = np.eye(len(self.y)) - self.X @ np.linalg.pinv(self.X)
        return Told(self.Z.T @ left @ self.y, self.Z.T @ left @ self.Z, self.group)

    def minus_log_likelihood(self, log_variance):
        """Restricted, from the dense covariance of all rows (Patterson and Thompson 1971)."""
        variance = np.exp(log_variance)[self.group]
        V = np.eye(len(self.y)) + (self.Z * variance) @ self.Z.T
        inverse = np.linalg.inv(V)
        inner = self.X.T @ inverse @ self.X
        P = inverse - inverse @ self.X @ np.linalg.solve(inner, self.X.T @ inverse)
        logs = np.linalg.slogdet(V)[1] + np.linalg.slogdet(inner)[1]
        return (logs + self.y @ P @ self.y) / 2


def test_the_spread_has_the_greatest_restricted_likelihood():
    for seed in range(3):
        world = Mixed(seed)
        dense = optimize.minimize(world.minus_log_likelihood, [0.0, 0.0], method="Nelder-Mead")
        expected = np.exp(dense.x / 2)
        for start in ([0.05, 5.0], [1.0, 1.0]):
            found = world.told().spread(np.array(start))
            np.testing.assert_allclose(found, expected, rtol=2e-3)


def test_its_sigma_is_the_curvature_of_that_likelihood():
    world = Mixed(4, rows=900, members=(60, 40))
    sd = world.told().spread(np.ones(2))
    x, step = 2 * np.log(sd), 1e-3
    second = [
        world.minus_log_likelihood(x + step * e)
        + world.minus_log_likelihood(x - step * e)
        - 2 * world.minus_log_likelihood(x)
        for e in np.eye(2)
    ]
    observed = sd / 2 / np.sqrt(np.array(second) / step**2)  # of the sd, groups nearly independent
    np.testing.assert_allclose(world.told().sigma(sd), observed, rtol=0.15)


def test_a_balanced_design_has_the_closed_form():
    members, each = 12, 5
    rng = np.random.default_rng(3)
    member = np.repeat(np.arange(members), each)
    y = 0.8 * rng.standard_normal(members)[member] + rng.standard_normal(members * each)
    Z = np.eye(members)[member]
    left = np.eye(len(y)) - 1.0 / len(y)
    told = Told(Z.T @ left @ y, Z.T @ left @ Z, np.zeros(members, int))
    means = y.reshape(members, each).mean(axis=1)
    expected = np.sqrt(means.var(ddof=1) - 1.0 / each)  # the noise is known
    assert told.spread(np.array([0.1]))[0] == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("known", [1.0, 1e2, 1e3])
@pytest.mark.parametrize("times", [3, 30, 300])
def test_a_spread_is_found_however_far_from_the_start(known, times):
    """Each seen as well, `known` times better than the start is wide, but for the mean of each
    group, where rounding leaves less than nothing: a closed form."""
    start, rng = 3e-4, np.random.default_rng(times)
    sigma = start / known
    seen = times * start * rng.standard_normal((3, 8)) + sigma * rng.standard_normal((3, 8))
    about = np.kron(np.eye(3), np.eye(8) - 1 / 8)
    information = (about - 1e-15 * np.kron(np.eye(3), np.ones((8, 8)))) / sigma**2
    told = Told(about @ seen.ravel() / sigma**2, information, np.repeat(range(3), 8))
    expected = np.sqrt(seen.var(axis=1, ddof=1) - sigma**2)
    np.testing.assert_allclose(told.spread(np.full(3, start)), expected, rtol=1e-3)


def test_what_members_have_in_common_is_no_spread():
    """A weak prior on a range zero pulls at the mean of few members, and would widen them."""
    rng = np.random.default_rng(8)
    own, mean = 3e-3 * rng.standard_normal(4), 25e-3
    sigma, of_zero = 3e-5, 4.4e-3
    V = sigma**2 * np.eye(4) + of_zero**2  # the range zero, known beforehand, and taken out
    information = np.linalg.inv(V)
    told = Told(information @ (own + mean), information, np.zeros(4, int))
    expected = np.sqrt(own.var(ddof=1) - sigma**2)
    about = told.about_mean()
    assert about.spread(np.full(1, 3e-4))[0] == pytest.approx(expected, rel=1e-4)
    again = Told(information @ (own - mean), information, told.group).about_mean()
    np.testing.assert_allclose(again.score, about.score, atol=1e-6 * np.abs(about.score).max())
    assert told.spread(np.full(1, 3e-4))[0] > 2 * expected


def test_values_as_fitted_say_the_same_whatever_held_them():
    told = Mixed(5).told()
    for sd in (0.2, 3.0):
        variance = np.full(28, sd**2)
        covariance = np.linalg.inv(told.information + np.diag(1 / variance))
        again = Told.fitted(covariance @ told.score, covariance, variance, told.group)
        np.testing.assert_allclose(again.score, told.score, rtol=1e-7)
        np.testing.assert_allclose(again.information, told.information, atol=1e-8)


def test_rounding_beside_a_very_wide_spread_is_no_fault():
    """What is not seen at all stays at zero, however wide; what is seen, at what the rows say."""
    rng = np.random.default_rng(2)
    axes, _ = np.linalg.qr(rng.standard_normal((40, 40)))
    size = np.r_[np.geomspace(1e6, 1e2, 20), np.full(20, -1e-7)]  # as rounding may leave it
    information = (axes * size) @ axes.T
    with pytest.raises(np.linalg.LinAlgError):
        np.linalg.cholesky(np.eye(40) + 1e8 * information)
    truth = axes[:, :20] @ rng.standard_normal(20)
    told = Told(information @ truth, information, np.zeros(40, int))
    values, covariance, _ = told.given(np.full(1, 1e8))
    np.testing.assert_allclose(axes[:, :20].T @ values, axes[:, :20].T @ truth, atol=0.05)
    assert np.abs(axes[:, 20:].T @ values).max() < 1.0
    assert np.linalg.eigvalsh(covariance)[0] > -1e-3


def test_the_estimate_and_its_sigma_hold_over_many_worlds():
    found = [Mixed(seed).told() for seed in range(150)]
    sd = np.array([told.spread(np.ones(2)) for told in found])
    sigma = np.array([t.sigma(s) for t, s in zip(found, sd, strict=True)])
    np.testing.assert_allclose(np.sqrt((sd**2).mean(axis=0)), [SD, PLACE_SD], rtol=0.08)
    z = (sd[:, 0] - SD) / sigma[:, 0]
    assert 0.85 < z.std() < 1.2


def test_where_nothing_scatters_the_spread_is_nothing():
    sd = np.array([Mixed(seed, sd=(0, 0)).told().spread(np.ones(2))[0] for seed in range(60)])
    assert np.mean(sd < 0.01) > 0.3 and np.median(sd) < 0.12


# --------------------------------------------------------------------------------- tested at zero


def one_way(seed, sd=0.0, members=30, even=True):
    """A group whose members are seen by as many rows each, or by very different numbers."""
    rng = np.random.default_rng(seed)
    each = np.full(members, 20.0) if even else np.geomspace(1, 400, members)
    M = np.diag(each) - np.outer(each, each) / each.sum()
    u = sd * rng.standard_normal(members)
    noise = rng.standard_normal(members) * np.sqrt(each)
    score = each * u + noise
    return Told(score - each * score.sum() / each.sum(), M, np.zeros(members, int))


@pytest.mark.parametrize("even", [True, False])
@pytest.mark.parametrize("members", [6, 30])
def test_the_test_at_zero_has_its_size(even, members):
    p = [AtZero(one_way(s, members=members, even=even)).p_value()[1] for s in range(400)]
    for level in (0.01, 0.05, 0.2):
        least, most = stats.binom.ppf([0.001, 0.999], 400, level)
        assert least <= np.sum(np.array(p) < level) <= most


def test_a_spread_of_the_smallest_detectable_size_is_found_four_times_out_of_five():
    size = AtZero(one_way(0)).detectable(0.01)
    hits = [AtZero(one_way(seed, sd=size)).p_value()[1] < 0.01 for seed in range(300)]
    assert 0.72 < np.mean(hits) < 0.88


# ------------------------------------------------------------------- rows worse than their sigmas


class Shared:
    """Rows whose errors e show little in their residuals: ``y = A e + X b + n``, e about 0 with a
    sigma of 1 as joint readings are, and n noise with a sigma of `others`."""

    def __init__(self, seed, sd=1.0, members=40, others=2.0):
        rng, design = np.random.default_rng(seed), np.random.default_rng(7)
        self.A = design.standard_normal((2 * members, members)) * np.geomspace(0.05, 0.5, members)
        self.X = design.standard_normal((2 * members, 5))
        self.others = others
        e = sd * rng.standard_normal(members)
        noise = others * rng.standard_normal(2 * members)
        self.y = self.A @ e + self.X @ [1.0, 2.0, -1.0, 0.5, 3.0] + noise

    def checks(self, sigma=1.0):
        """From a fit of e and b together, as a graph does it, whose rows of e have this sigma."""
        count = self.A.shape[1]
        prior = np.hstack([np.eye(count), np.zeros((count, 5))]) / sigma
        rows = np.vstack([prior, np.hstack([self.A, self.X]) / self.others])
        C = np.linalg.inv(rows.T @ rows)
        best = C @ rows.T @ np.concatenate([np.zeros(count), self.y / self.others])
        return Checks.of(prior @ best, np.eye(count) - prior @ C @ prior.T)

    def minus_log_likelihood(self, variance):
        """Restricted, from the dense covariance of all rows (Patterson and Thompson 1971)."""
        V = variance * self.A @ self.A.T + self.others**2 * np.eye(len(self.y))
        inverse = np.linalg.inv(V)
        inner = self.X.T @ inverse @ self.X
        P = inverse - inverse @ self.X @ np.linalg.solve(inner, self.X.T @ inverse)
        return (np.linalg.slogdet(V)[1] + np.linalg.slogdet(inner)[1] + self.y @ P @ self.y) / 2


@pytest.mark.parametrize("sd", [0.5, 1.0, 3.0])
def test_rows_grow_to_the_greatest_restricted_likelihood_from_any_sigma(sd):
    world = Shared(1, sd)
    best = optimize.minimize_scalar(world.minus_log_likelihood, (0.1, 10), (1e-3, 100)).x
    for sigma in (1.0, 2.0):
        found = (1.0 + world.checks(sigma).growth()) * sigma**2
        assert found == pytest.approx(best, rel=1e-3)
    checks, grown = world.checks(), best - 1.0
    gained = world.minus_log_likelihood(1.0) - world.minus_log_likelihood(best)
    assert checks.statistic(grown) == pytest.approx(2 * gained, rel=1e-6)


def test_what_rows_would_say_with_another_sigma_needs_no_other_fit():
    world = Shared(2, 2.0)
    there, at_first = world.checks(3.0).had_variance(1 / 9), world.checks(1.0)
    for name in ("total", "left", "told", "scaled", "dof"):
        assert getattr(there, name) == pytest.approx(getattr(at_first, name), rel=1e-9)


def test_rows_that_show_little_are_found_worse_no_more_often_than_is_said():
    """Their squares scatter far less than those of a chi-square with their redundancy."""
    checks = [Shared(seed).checks() for seed in range(400)]
    assert checks[0].told < 0.6 * checks[0].left
    p = np.array([stats.chi2.sf(c.scaled, c.dof) for c in checks])
    for level in (0.01, 0.05, 0.2, 0.5):
        least, most = stats.binom.ppf([0.001, 0.999], 400, level)
        assert least <= np.sum(p < level) <= most
    grown = np.array([c.growth() for c in checks])
    assert abs(grown.mean()) < 0.1 and grown.std() == pytest.approx(checks[0].sigma(0.0), rel=0.2)


# ------------------------------------------------------------------------------------ in recordings


@pytest.fixture(scope="module")
def scattered(tmp_path_factory):
    """A recording whose stops scatter by 0.9 mm, and the truth's values."""
    folder = tmp_path_factory.mktemp("scatter")
    simulate(SPEC, folder / "rec", 7, {"stop_range_scatter": 3.0})
    return folder


def test_a_fit_estimates_the_spread_and_each_stop(scattered):
    source = Source.open(scattered / "rec")
    estimate = solve(build([source], Model().plus([find("stop_range_scatter")])))
    ((name, (sd, sigma)),) = spreads(estimate).items()
    assert abs(sd - 0.0009) < 3 * sigma and 0.1 < sigma / sd < 0.25
    assert estimate.converged and name not in estimate.problem.calibration
    assert len(estimate.values[name]) == 24


def test_shift_and_turn_of_the_lidar_have_a_spread_each(tmp_path):
    """0.9 mm and 0.9 mrad at size 3; the spreads come without the other ways to scatter."""
    simulate(SPEC, tmp_path / "rec", 7, {"stop_pose_scatter": 3.0})
    source = Source.open(tmp_path / "rec")
    problem = build([source], Model().plus([find("stop_pose_scatter")]))
    estimate = solve(problem)
    found = spreads(estimate)
    assert set(found) == {"stop_pose_scatter.sd.m", "stop_pose_scatter.sd.rad"}
    for sd, sigma in found.values():
        assert abs(sd - 0.0009) < 3 * sigma and 0.05 < sigma / sd < 0.15
    again = resume(problem, estimate.start)
    assert spread_of(again.problem) == pytest.approx(spread_of(estimate.problem))


WAYS = {  # a tracker that scatters is told further below
    "stop_pose_scatter": 3.0,
    "joint_scatter": 3.0,
    "target_scatter": 4.0,
}
# Others are long: stop_pose_scatter is named further below, joints as targets are.
QUICK = ("target_scatter",)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=() if n in QUICK else pytest.mark.long) for n in WAYS]
)
def test_which_way_to_the_lidar_scatters_is_told(tmp_path, name):
    """From base and mount, and by the scan: two of them tell what the third is off."""
    simulate(SPEC.model_copy(update=SPARSE), tmp_path / "rec", 9, {name: WAYS[name]})
    run = fit([tmp_path / "rec"], tmp_path / "run", hold_out="none")
    found = diagnose(run)
    assert found.verdict == "missing_effect" and found.worth_adding == [name]
    assert diagnose(add(run, [name], tmp_path / "grown")).verdict == "adequate"


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["stop_pose_scatter", pytest.param("tracker_scatter", marks=pytest.mark.long)]
)
def test_on_one_tracked_body_a_mount_that_gives_is_a_tracker_that_scatters(tmp_path, name):
    spec = SPEC.model_copy(update={"arm": False, "column_step": 60})
    simulate(spec, tmp_path / "rec", 9, {name: 3.0})
    found = diagnose(fit([tmp_path / "rec"], tmp_path / "run", hold_out="none"))
    (added,) = found.worth_adding
    (one,) = (c for c in found.candidates if c["add"] == added)
    assert {added, *one["indistinguishable_from"]} == {"stop_pose_scatter", "tracker_scatter"}
    assert any("not distinguishable from tracker_scatter" in each for each in found.sentences)


def test_two_recordings_share_the_spread_and_nothing_else(scattered, tmp_path):
    simulate(
        SPEC.model_copy(update={"locations": 4}), tmp_path / "other", 8, {"stop_range_scatter": 3.0}
    )
    sources = [Source.open(scattered / "rec"), Source.open(tmp_path / "other")]
    problem = build(sources, Model().plus([find("stop_range_scatter")]))
    (name,) = [u.name for u in problem.variables.values() if u.role.name == "SCATTER"]
    dofs = problem.variables[name].dofs
    assert len(set(dofs)) == len(dofs) == 24 + 16
    estimate = solve(problem)
    sd, sigma = spreads(estimate)[name]
    assert abs(sd - 0.0009) < 3 * sigma


@pytest.mark.parametrize(
    ("effect", "size", "keys"),
    [
        ("tracker_scatter", 3.0, {"base_markers.rad", "mount_markers.rad"}),
        ("tracker_scatter", 3.0, {"base_markers.m", "mount_markers.m"}),
        ("joint_scatter", 3.0, {f"joint_{i}.rad" for i in range(1, 7)}),
        ("target_scatter", 3.0, {"target/sphere.m"}),
        ("reference_scatter", 3.0, {"surface.m"}),
    ],
)
def test_rows_that_scatter_beyond_their_sigma_tell_by_how_much(worse, effect, size, keys):
    """Bodies at 24 stops each, five targets; some 70 surfaces of the mesh, of which those furthest
    off meet no beam that is believed. Of a joint all rows tell as much as 6 readings at least."""
    _, estimate = worse(effect, size)
    sigma = find(effect).sigma * size
    found = {key.partition(".")[2]: each for key, each in spreads(estimate).items()}
    for key in keys:
        sd, of = found[key]
        least = 0.7 * sigma if effect == "reference_scatter" else sigma - 3 * of
        widest = 0.6 if effect == "joint_scatter" else 0.3
        assert least < sd < sigma + 3 * of and 0.05 < of / sd < widest
    again = squares(estimate)
    for whose, checks in again.items():
        if f"{whose.text}.{whose.unit}" in keys:
            assert checks.growth() == pytest.approx(0.0, abs=0.05)  # they fit


@pytest.fixture(scope="module")
def worse(tmp_path_factory):
    """Recordings in which one thing scatters more than rig.yaml says, and fits that know of it."""
    made = {}

    def make(effect, size):
        if effect not in made:
            folder = tmp_path_factory.mktemp(effect) / "rec"
            simulate(SPEC, folder, 9, {effect: size})
            source = Source.open(folder)
            made[effect] = source, solve(build([source], Model().plus([find(effect)])))
        return made[effect]

    return make


@pytest.mark.parametrize("effect", [e.name for e in CATALOGUE if e.by_chance and e.widens])
def test_a_fit_goes_on_with_the_spread_that_it_had(worse, effect):
    source, estimate = worse(effect, 3.0)
    problem = build([source], Model().plus([find(effect)]))
    again = resume(problem, estimate.start)
    assert spread_of(again.problem) == pytest.approx(spread_of(estimate.problem))


@pytest.mark.slow
def test_a_tracker_worse_than_stated_is_named_and_then_nothing_is_missing(worse):
    source, _ = worse("tracker_scatter", 3.0)
    folder = source.recording.folder
    run = fit([folder], folder.parent / "run", hold_out="none")
    found = diagnose(run)
    assert found.verdict == "missing_effect" and found.worth_adding == ["tracker_scatter"]
    assert run.summary["sigmas_widened_by"] > 1.5
    grown = add(run, found.worth_adding, folder.parent / "grown")
    assert grown.summary["sigmas_widened_by"] == 1.0
    assert diagnose(grown).verdict == "adequate"


@pytest.mark.slow
def test_without_a_mesh_the_planes_are_no_bodies(tmp_path):
    """Planes are as uneven as the data say; what bodies scatter by is told of bodies alone."""
    spec = SPEC.model_copy(update={"mesh": False, "column_step": 60})
    simulate(spec, tmp_path / "rec", 9, {"tracker_scatter": 3.0})
    found = diagnose(fit([tmp_path / "rec"], tmp_path / "run", hold_out="none"))
    assert "tracker_scatter" in found.worth_adding
    of = {each["of"] for each in found.scatter if each["effect"] == "tracker_scatter"}
    assert of == {"base_markers", "mount_markers"}
    (p,) = (c["p_value"] for c in found.candidates if c["effect"] == "tracker_scatter")
    assert p >= 1e-6


@pytest.mark.parametrize("size", [1.0, 1e8, 1e16, 1e24])
def test_spreads_are_found_where_rounding_spoils_the_information(size):
    """Values that nothing but their sum is told of, to ever more digits than a double has: of such
    a matrix and 1, rounding makes eigenvalues that are negative."""
    rng = np.random.default_rng(0)
    along = rng.normal(size=(30, 2))
    information = size * along @ along.T
    information += 1e-15 * size * (noise := rng.normal(size=(30, 30))) + 1e-15 * size * noise.T
    score = information @ rng.normal(size=30)
    told = Told(score, information, np.repeat([0, 1], 15))
    sd = told.spread(np.array([0.1, 0.1]))
    assert np.isfinite(sd).all() and np.isfinite(told.statistic(sd))
    assert told.statistic(sd) >= told.statistic(np.array([0.1, 0.1]))
