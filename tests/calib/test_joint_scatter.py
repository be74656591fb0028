"""Readings of joints scatter, each joint's by its own; against a dense likelihood."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import optimize

from calib.blunders.shifts import told_by_stop
from calib.diagnosis.search import search
from calib.effects import DEFAULT
from calib.problem import build
from calib.problem.model import Model, Source
from calib.problem.spread import Whose, readings, sigmas, spread_of, with_spread
from calib.problem.without import leave_out
from calib.runs.calibrate import calibrate
from calib.runs.reopen import stand_of
from calib.solve.components.told import Told, ToldApart
from chains.errors import InputError

from . import arm_worlds

MODEL = Model((*DEFAULT, "arm_geometry", "joint_scatter"))


def quiet(*told):
    """Nothing."""


def scattering(folder, joint, sd, poses=60, seed=0):
    """A recording in which the readings of one joint scatter."""
    rng = np.random.default_rng([31, seed])
    world = arm_worlds.bent(folder, "puma560", rng)
    read = world.draw(rng, poses)
    off = sd * np.outer(rng.normal(size=poses), np.eye(6)[joint])
    T = world.seen(read + off) * arm_worlds.exp(arm_worlds.noise(rng, poses))
    arm_worlds.save(folder, world, read, T, {}, 2e-5)
    return folder


def parts(rng, sd, count=40, joints=3):
    """What is told of readings of joints, of which a stop tells two directions."""
    found = []
    for _ in range(count):
        J = rng.normal(size=(2, joints))
        y = J @ (sd * rng.normal(size=joints)) + rng.normal(size=2)
        found.append(Told(J.T @ y, J.T @ J, np.arange(joints)))
    return ToldApart(found)


def test_stops_with_rows_of_some_kinds_count_for_these():
    """Stops whose groups are the same are told of together, and each stop alone says the same."""
    rng, least = np.random.default_rng(4), np.full(3, 0.1)
    some = [*parts(rng, np.array([3.0, 0.5, 2.0])).parts]
    some += [each.of(0, 2) for each in some[:10]]
    some[-10:] = [replace(each, group=2 * each.group) for each in some[-10:]]
    some += [replace(each.of(1), group=np.array([1])) for each in some[:3]]
    apart, together = ToldApart(some), ToldApart.at_stops(some)
    assert len(together.parts) == 3
    for of in ((0, 1, 2), (2,), (1, 0)):
        each, stacked = apart.of(*of), together.of(*of)
        sd = each.spread(least[: len(of)])
        np.testing.assert_allclose(stacked.spread(least[: len(of)]), sd, rtol=1e-6)
        np.testing.assert_allclose(stacked.sigma(sd), each.sigma(sd), rtol=1e-9)
        assert stacked.statistic(sd) == pytest.approx(each.statistic(sd), rel=1e-9)


def test_spreads_of_all_joints_have_the_greatest_likelihood_that_bounds_allow():
    rng, least = np.random.default_rng(3), np.full(3, 1.0)
    told = parts(rng, np.array([4.0, 0.2, 2.0]))

    def unlikely(log_sd):
        return -told.statistic(np.exp(log_sd))

    ends = [(0.0, 5.0)] * 3
    dense = optimize.minimize(unlikely, np.ones(3), method="Nelder-Mead", bounds=ends)
    found = told.spread(least, least=least)
    np.testing.assert_allclose(found, np.exp(dense.x), rtol=2e-3)
    assert found[1] == pytest.approx(1.0)
    # Sigmas follow from the information: half the second derivative of twice the likelihood.
    free = told.of(0, 2)
    sd, step = free.spread(np.ones(2)), 1e-3
    bent = [
        (2 * free.statistic(sd) - free.statistic(sd + e) - free.statistic(sd - e)) / step**2
        for e in step * np.eye(2)
    ]
    assert free.sigma(sd) == pytest.approx(np.sqrt(2.0 / np.array(bent)), rel=0.35)


@pytest.mark.parametrize("left_out", [False, True])
def test_readings_that_are_left_out_tell_nothing(tmp_path, left_out):
    """Of half the stops the reading of the joint that scatters is left out; others tell of it."""
    scattering(tmp_path / "rec", 4, 1e-3)
    tokens = [f"p{k:04d}:j5" for k in range(30)] if left_out else []
    sources = leave_out([Source.open(tmp_path / "rec")], tokens)
    model = Model(MODEL.effects[:-1], (), tuple(tokens))
    run = calibrate([tmp_path / "rec"], tmp_path / "run", model)
    stand = stand_of(run, quiet)
    problem, look = stand.estimate.problem, stand.look(quiet)
    whose = {each: j for j, each in enumerate(w for w in sigmas(problem) if w.kind == "joints")}
    told = told_by_stop(look.others, whose, [])
    j5 = whose[Whose("joints", "j5", "rad")]
    told_of = sum(part.score[..., part.group == j5].size for part in told.parts)
    assert told_of == 60 - len(tokens)
    sd = told.of(j5).spread(np.ones(1))[0]
    assert sd * 2e-5 == pytest.approx(1e-3, rel=0.4)
    grown = build(sources, MODEL)
    assert not [k for k in spread_of(grown) if k.startswith("joint_scatter") and "j" not in k]


def test_a_joint_that_is_read_nowhere_has_no_spread(tmp_path):
    scattering(tmp_path / "rec", 4, 1e-3, poses=20)
    (source,) = leave_out([Source.open(tmp_path / "rec")], [f"p{k:04d}:j5" for k in range(20)])
    problem = build([source], MODEL)
    assert {w.what for w in sigmas(problem) if w.kind == "joints"} == {"j1", "j2", "j3", "j4", "j6"}


def test_a_spread_that_is_given_widens_its_joint_alone(tmp_path):
    scattering(tmp_path / "rec", 4, 1e-3, poses=20)
    problem = build([Source.open(tmp_path / "rec")], MODEL)
    wide = with_spread(problem, {"joint_scatter.j5.rad": 1e-3})
    for before, after in zip(readings(problem), readings(wide), strict=True):
        j5 = [dof == "j5" for dof in after.dofs]
        assert after.sigma[j5] == pytest.approx(np.hypot(2e-5, 1e-3))
        np.testing.assert_array_equal(np.delete(after.sigma - before.sigma, np.flatnonzero(j5)), 0)
    assert spread_of(wide)["joint_scatter.j5.rad"] == 1e-3


def test_a_run_whose_scatter_was_one_number_is_to_be_fitted_again(tmp_path):
    """As earlier versions had it, of all joints."""
    scattering(tmp_path / "rec", 4, 1e-3)
    run = calibrate([tmp_path / "rec"], tmp_path / "run", MODEL, hold_out="none")
    state = {n: v for n, v in run.state().items() if not n.startswith("joint_scatter.")}
    state["joint_scatter.joints.rad.sd"] = np.float64(6e-4)
    np.savez(run.folder / "state.npz", **{f"state/{n}": v for n, v in state.items()})
    with pytest.raises(InputError, match=r"lacks 'joint_scatter\.j1\.rad'; fit the run again"):
        stand_of(run, quiet)


@pytest.mark.parametrize("joint", [None, 0])
def test_a_tracker_that_scatters_is_no_joint_that_does_and_the_other_way_round(tmp_path, joint):
    """Errors of six joints move a tool in as many ways as a tracker errs, a single one's in one."""
    rng, folder, poses = np.random.default_rng(110), tmp_path / "rec", 80
    world = arm_worlds.bent(folder, "puma560", rng)
    read, noise = world.draw(rng, poses), arm_worlds.noise(rng, poses)
    off = 0.0 if joint is None else 1e-3 * np.outer(rng.normal(size=poses), np.eye(6)[joint])
    T = world.seen(read + off) * arm_worlds.exp(noise * (7.0 if joint is None else 1.0))
    arm_worlds.save(folder, world, read, T, {}, 2e-5)
    done = search(stand_of(calibrate([folder], tmp_path / "run", hold_out="none"), quiet), quiet)
    name = "tracker_scatter" if joint is None else "joint_scatter"
    assert [chance.effect.name for chance in done.chance] == [name]
