"""How widely values scatter by chance: in rows, and in fits of recordings."""

import numpy as np
import pytest
from scipy import optimize, stats

from calib import add, diagnose, fit
from calib.effects import CATALOGUE, find
from calib.problem import build
from calib.problem.model import Model, Source
from calib.problem.spread import spread_of
from calib.simulation import Spec, simulate
from calib.solve.components import _as_rows, spreads, squares
from calib.solve.components.checks import Checks
from calib.solve.components.told import Told
from calib.solve.fit import resume, solve

SPEC = Spec(
    lidar="hesai_pandarxt32", locations=6, stops_per_location=4, column_step=100, world_seed=5
)

SPARSE = {"column_step": 200}  # where the scans need tell no more than where the LiDAR was


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


@pytest.mark.long
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


@pytest.mark.long
@pytest.mark.parametrize("name", ["stop_pose_scatter", "tracker_scatter"])
def test_on_one_tracked_body_a_mount_that_gives_is_a_tracker_that_scatters(tmp_path, name):
    spec = SPEC.model_copy(update={"arm": False, "column_step": 60})
    simulate(spec, tmp_path / "rec", 9, {name: 3.0})
    found = diagnose(fit([tmp_path / "rec"], tmp_path / "run", hold_out="none"))
    (added,) = found.worth_adding
    (one,) = (c for c in found.candidates if c["add"] == added)
    assert {added, *one["indistinguishable_from"]} == {"stop_pose_scatter", "tracker_scatter"}
    assert any("not distinguishable from tracker_scatter" in each for each in found.sentences)


@pytest.mark.long
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
    off meet no beam that is believed. Of a joint all rows tell as much as 4 readings at least, if
    it scatters as it truly does."""
    _, estimate = worse(effect, size)
    sigma = find(effect).sigma * size
    found = {key.partition(".")[2]: each for key, each in spreads(estimate).items()}
    for key in keys:
        sd, of = found[key]
        least = 0.7 * sigma if effect == "reference_scatter" else sigma - 3 * of
        share = of / sigma if effect == "joint_scatter" else of / sd
        widest = 1 / np.sqrt(2 * 4) if effect == "joint_scatter" else 0.3
        assert least < sd < sigma + 3 * of and 0.05 < share < widest
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


@pytest.mark.long
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


@pytest.mark.long
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


def test_few_values_leave_a_spread_near_what_an_earlier_run_knew():
    """As a mean of squares, the earlier sd counting as so many values as have its sigma."""
    x, (sd, sigma) = np.array([0.1, -0.2]), (3.0, 0.6)
    seen = np.diag([1e8, 1e8])  # next to exactly
    told = Told(seen @ x, seen, np.zeros(2, int))
    (alone,) = told.spread(np.ones(1))
    assert alone == pytest.approx(np.sqrt(np.mean(x**2)), rel=1e-3)
    count = sd**2 / (2 * sigma**2)
    (found,) = told.spread(np.ones(1), [(sd, sigma)])
    assert found == pytest.approx(np.sqrt((x @ x + count * sd**2) / (2 + count)), rel=1e-3)
    (unknown,) = told.spread(np.ones(1), [(0.0, 0.0)])
    assert unknown == pytest.approx(alone, rel=1e-6)


@pytest.mark.parametrize(("sigma", "beyond"), [(1.0, 0.0), (1.25, 0.75), (5.0, 4.9)])
def test_what_no_row_tells_of_now_scatters_as_it_did(sigma, beyond):
    """Whatever spread the fit begins with: of the first sigma, the earlier sd is beyond."""
    first = np.sqrt(sigma**2 - beyond**2)
    grown = _as_rows(sigma, beyond, 2.0, 0.3).growth()
    assert np.sqrt((1 + grown) * sigma**2 - first**2) == pytest.approx(2.0, rel=1e-3)


@pytest.mark.long
def test_one_new_stop_does_not_make_rings_certain_where_stops_scatter(tmp_path):
    """By 3 mm, as the earlier run knew: the new stop's own zero is one draw of that."""
    spec = Spec(lidar="hesai_pandarxt32", locations=4, column_step=200, world_seed=5)
    simulate(spec, tmp_path / "first", 1, {"stop_range_scatter": 6.0})
    few = Spec(**{**spec.model_dump(), "locations": 1, "stops_per_location": 1})
    simulate(few, tmp_path / "later", 2, {"stop_range_scatter": 6.0})
    known = fit(tmp_path / "first", tmp_path / "a", hold_out="none")
    known = add(known, "stop_range_scatter", tmp_path / "b")
    new = fit(tmp_path / "later", tmp_path / "c", hold_out="none", prior=tmp_path / "b")
    before, after = (run.solution.shared.effects for run in (known, new))
    (sd_then,), (sd_now,) = (each["stop_range_scatter"].estimate for each in (before, after))
    rings_then, rings_now = (each["ring_range_offset"].sigma for each in (before, after))
    assert sd_now > 0.7 * sd_then and (rings_now > 0.8 * rings_then).all()
    (then,), (now,) = (each["stop_range_scatter"].sigma for each in (before, after))
    assert 0.7 * then < now < 1.01 * then  # what one stop adds to it is little, and is not lost
