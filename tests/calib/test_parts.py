"""An effect with parameters for every joint may be that of one: held against bins by that one."""

from dataclasses import replace

import numpy as np
import pytest

from calib.diagnosis.score import project, score_test
from calib.diagnosis.search.confirmed import outdoing
from calib.diagnosis.search.parts import likeliest_part
from calib.diagnosis.stand import Stand
from calib.effects import CATALOGUE
from calib.problem import build
from calib.problem.model import Model, Source
from calib.simulation import Spec, simulate
from calib.solve.fit import solve

SPEC = Spec(lidar="hesai_pandarxt32", locations=4, stops_per_location=3, column_step=400)
EFFECTS = {
    "arm_joint_scale": 1,
    "arm_gravity_sag": 1,
    "arm_joint_eccentricity": 2,
}  # dof of a joint


@pytest.fixture(scope="module")
def look(tmp_path_factory):
    folder = tmp_path_factory.mktemp("parts") / "rec"
    simulate(SPEC, folder, 3, {})
    source = Source.open(folder)
    problem = build([source], Model())
    stand = Stand([source], Model(), problem, solve(problem))
    return stand.look(lambda what, done, total: None)


def acting(look, name, theta):
    """The look, and an effect of it, had its parameters (q,) been these and no noise: its score is
    then ``information @ theta``."""
    candidate = next(c for c in look.named.candidates if c.effect.family == name)
    columns, scores = candidate.test.columns, look.named.scores
    score = scores.score.copy()
    score[columns] = scores.information[np.ix_(columns, columns)] @ theta
    scores = replace(scores, score=score)
    candidate = replace(candidate, test=score_test(scores, columns))
    return replace(look, named=replace(look.named, scores=scores)), candidate


@pytest.mark.parametrize("name", EFFECTS)
@pytest.mark.parametrize("joint", range(1, 5))  # of these gravity bends each
def test_what_one_joint_does_is_told_by_its_own_parameters(look, name, joint):
    """In closed form: what a joint alone explains is ``theta^T M theta``, with its block M."""
    each = EFFECTS[name]
    theta = np.zeros(6 * each)
    theta[each * joint : each * (joint + 1)] = 0.01
    moved, candidate = acting(look, name, theta)
    part = likeliest_part(moved, candidate, 1.0)
    assert part.dof <= each and part.price == pytest.approx(np.log(6))
    assert part.statistic == pytest.approx(candidate.test.statistic, rel=1e-6)
    assert part.evidence(1.0) > candidate.test.evidence(1.0)


@pytest.mark.parametrize("name", EFFECTS)
@pytest.mark.parametrize("joints", [(1, 2), (2, 4)])
def test_what_two_joints_do_is_told_by_theirs(look, name, joints):
    """At the price of having looked at every pair of six."""
    each = EFFECTS[name]
    theta = 0.01 * np.repeat(np.isin(np.arange(6), joints), each)
    moved, candidate = acting(look, name, theta)
    part = likeliest_part(moved, candidate, 1.0)
    assert each < part.dof <= 2 * each and part.price == pytest.approx(np.log(15))
    assert part.statistic == pytest.approx(candidate.test.statistic, rel=1e-6)


def test_what_all_joints_do_is_told_by_all(look):
    theta = np.where(np.arange(6) % 2, 0.01, -0.01)
    moved, candidate = acting(look, "arm_joint_scale", theta)
    part = likeliest_part(moved, candidate, 1.0)
    assert (part.statistic, part.dof) == (candidate.test.statistic, candidate.test.dof)
    assert part.price == 0.0


@pytest.mark.parametrize("joint", [1, 2])
def test_a_shape_between_those_of_the_grid_is_told_as_well(look, joint):
    """Once it is found its information is that of its own shape, and its score that of its test."""
    effect = next(e for e in CATALOGUE if e.name == "arm_gear_error").at(28)
    stand = look.stand
    linear, at, _ = stand.linearise([effect], lambda what, done, total: None)
    own = project(linear, linear.candidates, stand.spent)
    theta = np.zeros(12)
    theta[2 * joint : 2 * joint + 2] = 0.001
    columns = at[effect.name]
    score = own.information[np.ix_(columns, columns)] @ theta
    shaped = replace(own, score=score)  # it alone was linearised
    on_grid = next(c for c in look.named.candidates if c.effect.family == effect.family)
    finest = replace(on_grid, effect=effect, test=score_test(shaped, columns))
    near = replace(look, linear=linear, named=replace(look.named, scores=shaped))
    before, finest = look.with_shape(on_grid, near, finest)
    part = likeliest_part(before, finest, 1.0)
    assert part.dof == 2 and part.statistic == pytest.approx(finest.test.statistic, rel=1e-6)


@pytest.mark.parametrize("name", ["incidence_angle_bias", "label_range_offset", "mount_slip"])
def test_an_effect_that_is_not_of_joints_has_no_parts(look, name):
    candidate = next(c for c in look.named.candidates if c.effect.family == name)
    part = likeliest_part(look, candidate, 1.0)
    assert (part.statistic, part.dof) == (candidate.test.statistic, candidate.test.dof)


def test_effects_that_explain_as_much_as_values_by_chance(look):
    """Of those that stand out the best; none of less than chance explains, and none by chance."""
    assert outdoing(look, -np.inf) == []
    moved, candidate = acting(look, "arm_joint_scale", np.full(6, 0.01))
    loud = replace(candidate, evidence=candidate.test.evidence(moved.named.common))
    moved = replace(moved, named=replace(moved.named, candidates=[loud, *look.named.candidates]))
    assert outdoing(moved, 2 * loud.evidence - 1e-6) == [loud.effect]
    assert outdoing(moved, 2 * loud.evidence + 1e-6) == []
