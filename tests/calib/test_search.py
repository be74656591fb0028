"""What the search names first: an effect in its true shape, and one that predicts before chance."""

import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from calib.diagnosis import search as searching
from calib.diagnosis.candidates import shape_limits
from calib.diagnosis.search import MOST_NEEDED, nameless, search, steps
from calib.diagnosis.search.named import NamedEffect, Rival
from calib.diagnosis.search.shapes import retuned
from calib.diagnosis.verdict.matters import Consequences
from calib.effects import GEOMETRY, find
from calib.problem.build import shapes_of
from calib.problem.model import Model
from calib.runs.calibrate import calibrate
from calib.runs.reopen import stand_of
from chains import se3
from chains.errors import InputError

from ..bench import arm_effects
from . import arm_worlds
from .simulated import made


def quiet(what, done, total):
    pass


def found(folder, seed=1, **hidden):
    """What is found in a small recording with these hidden, by the default model."""
    _, truth = made(folder / "rec", "tiny", seed, **hidden)
    run = calibrate([folder / "rec"], folder / "run", hold_out="none")
    return search(stand_of(run, quiet), quiet), truth


@pytest.mark.long
def test_an_effect_that_no_shape_of_the_grid_fits_is_named_in_its_own(tmp_path):
    """A wave of 8 mm between two lengths of the grid, each of which is a third of a period or more
    off at 7 m: beams near and far contradict either."""
    done, truth = found(tmp_path, **{"range_cyclic@0.815": 3.0})
    (step,) = done.found
    assert step.effect.family == "range_cyclic"
    assert step.effect.shape == pytest.approx(0.815, abs=3e-4)
    grid = next(c for c in step.before.named.candidates if c.effect.family == "range_cyclic")
    assert step.candidate.test.statistic == pytest.approx(step.judged.statistic, rel=1e-6)
    assert step.candidate.test.statistic > 1.1 * grid.test.statistic
    size = step.after.stand.theta(step.effect)
    assert size == pytest.approx(truth["effects"]["range_cyclic@0.815"], abs=5e-4)
    assert not done.chance


@pytest.mark.long
def test_what_was_named_beside_chance_lets_others_take_its_place(tmp_path):
    """Three effects, none of which explains as much alone as a zero of its own at every stop: all
    are found, one beside the other, and the zeros are not."""
    hidden = {"label_range_offset": 5.0, "optitrack_distortion": 3.0, "warmup_drift@400": 3.0}
    done, _ = found(tmp_path, seed=738, **hidden)
    names = [step.effect.family for step in done.found]
    assert sorted(names) == ["label_range_offset", "optitrack_distortion", "warmup_drift"]
    warmup = done.found[names.index("warmup_drift")].effect
    assert warmup.shape == pytest.approx(400, rel=0.1)
    assert not done.chance and not done.unnamed
    assert any(chance.found for chance in done.looks[0].chance), "zeros seemed to scatter at first"
    first, *between, last = done.looks
    assert between and all(each.linear.whole is None for each in between)
    thin = [each.named.scores for each in between]
    assert all(not len(s.cells) and s.score.base is None for s in thin)
    assert all(len(each.named.scores.cells) == len(each.linear.stop) > 0 for each in (first, last))
    rms_mm = {"held_out": 5.0, "noise_floor": 3.0}
    whole, thin = (
        Consequences(look, rms_mm).of(done.found[0].candidate, look.named)
        for look in (first, first.thinned())
    )
    assert thin == whole and whole.largest_shift_sigmas > 0


def test_a_shape_stays_where_the_name_means_what_it_says(tmp_path):
    """What fades with range over 9 m is nearly a line where all ranges are shorter: not near."""
    made(tmp_path / "rec", "tiny", 1, **{"near_range_bias@9": 5.0})
    effects = ("arm_link_length", "arm_joint_offset", "ring_range_offset", "near_range_bias@2")
    run = calibrate([tmp_path / "rec"], tmp_path / "run", Model(effects), "none")
    stand, swapped = retuned(stand_of(run, quiet), ["near_range_bias@2"], quiet)
    grid = shapes_of(find("near_range_bias"), stand.sources)
    (low, high), found = shape_limits(grid), swapped["near_range_bias@2"]
    assert found.shape == pytest.approx(high, rel=1e-5) and found.name in stand.model.names
    assert low < grid[0] and high / grid[-1] == pytest.approx(grid[-1] / grid[-2])


@pytest.mark.long
def test_a_drift_that_another_effect_covers_is_no_scatter_of_stops(tmp_path):
    """At first a zero of its own at every stop explains more than any effect alone."""
    done, _ = found(tmp_path, **{"warmup_drift@700": 3.0, "optitrack_distortion": 3.0})
    assert done.looks[0].chance[0].effect.name == "stop_range_scatter"
    assert [step.effect.family for step in done.found] == ["warmup_drift", "optitrack_distortion"]
    assert done.found[0].effect.shape == pytest.approx(700, rel=0.1)
    assert not done.chance


@pytest.mark.parametrize("wild", [False, True])
@pytest.mark.long
def test_poses_that_scatter_of_the_joints_moves_far_are_no_blunders(tmp_path, wild):
    """One error of a joint moves the tool further at some poses than at others. Before that scatter
    is in the model three poses stand out; a row that was written down wrongly stands out after."""
    rng, folder = np.random.default_rng([20, 5]), tmp_path / "rec"
    world = arm_worlds.bent(folder, "panda", rng)
    read = world.draw(rng, 80)
    T = world.seen(read + 5e-4 * rng.normal(size=read.shape))
    off = arm_worlds.noise(rng, 80)
    off[30, 3:] += 0.03 * wild
    arm_worlds.save(folder, world, read, T * arm_worlds.exp(off), {}, 2e-5)
    run = calibrate([folder], tmp_path / "run", hold_out="none")
    done = search(stand_of(run, quiet), quiet)
    assert done.chance[0].effect.name == "joint_scatter"
    assert [each.blunder.group.where for each in done.blunders] == ["p0030"] * wild


@pytest.mark.long
def test_a_name_that_is_nothing_beside_scatter_is_dropped(tmp_path):
    """Five targets that are 3 mm off take the mesh with them, which then seems shifted."""
    done, _ = found(tmp_path, seed=36, target_scatter=3.0)
    assert not done.found and [c.effect.name for c in done.chance] == ["target_scatter"]
    assert "mesh_shift" not in done.looks[-1].stand.model.names
    shift = next(c for c in done.looks[0].named.candidates if c.effect.name == "mesh_shift")
    assert shift.test.statistic > 50.0  # in squared sigmas, of six parameters
    beside = done.looks[-1].stand.with_effects([shift.effect], quiet).look(quiet)
    named = [SimpleNamespace(candidate=shift, effect=shift.effect)]
    look, kept = searching._outlasting(beside, named, quiet)
    assert not kept and "mesh_shift" not in look.stand.model.names
    # Were it left, and taken away later, scatter would be what it is without it: in a fit from the
    # same state, as the search's last one weighs three spheres as it did before they scattered.
    again = nameless(replace(done, looks=[done.looks[0], beside], found=named), quiet)
    assert not again.found and "mesh_shift" not in again.looks[-1].stand.model.names
    plain = done.looks[-1].stand.with_effects([], quiet).look(quiet)
    (one,), (other,) = plain.still(done.chance), again.chance
    for spread, same in zip(one.spreads, other.spreads, strict=True):
        assert same.sd == pytest.approx(spread.sd, abs=0.01 * spread.sigma)


@pytest.mark.parametrize(
    "first", [95, *(pytest.param(n, marks=pytest.mark.long) for n in (96, 97, 98))]
)
def test_what_slips_does_so_between_two_stops_and_none_of_them_is_a_blunder(tmp_path, first):
    """A grid of times, and a finer one beside the best of it, are 4 stops apart. Stops between the
    true time and one of these stand out alone."""
    rng, folder = np.random.default_rng(40 + first), tmp_path / "rec"
    world, poses = arm_worlds.bent(folder, "puma560", rng), 300
    read, time_s = world.draw(rng, poses), np.cumsum(rng.uniform(8.0, 16.0, poses))
    late = np.arange(poses) >= first
    T = world.seen(read - 4e-3 * np.outer(late, np.eye(6)[5]))
    T = T * arm_worlds.exp(arm_worlds.noise(rng, poses))
    arm_worlds.save(folder, world, read, T, {"time_s": time_s})
    done = search(stand_of(calibrate([folder], tmp_path / "run"), quiet), quiet)
    assert not done.blunders
    (step,) = done.found
    assert step.effect.family in ("arm_joint_slip", "mount_slip")
    elapsed_s = time_s - time_s[0]
    assert elapsed_s[first - 1] < step.effect.shape < elapsed_s[first]


@pytest.mark.parametrize("wild", [False, True])
@pytest.mark.long
def test_poses_are_no_blunders_where_one_joint_scatters_more_than_all(tmp_path, wild):
    """Scatter of the joints is one number, and an encoder may be worse than the others: what its
    readings do to a pose is judged as these readings are. A row far beyond them is named."""
    rng, folder = np.random.default_rng([21, 10]), tmp_path / "rec"
    world, poses = arm_worlds.bent(folder, "stanford", rng), 150
    read = world.draw(rng, poses)
    q = read + 1.2e-3 * np.outer(rng.normal(size=poses), np.eye(6)[4])
    q[70, 4] += 12e-3 * wild
    T = world.seen(q) * arm_worlds.exp(arm_worlds.noise(rng, poses))
    arm_worlds.save(folder, world, read, T, {}, 2e-5)
    done = search(stand_of(calibrate([folder], tmp_path / "run"), quiet), quiet)
    (chance,) = (found for found in done.chance if found.effect.name == "joint_scatter")
    (worst,) = (spread for spread in chance.spreads if spread.sd > 1e-4)
    assert worst.of == "j5" and abs(worst.sd - 1.2e-3) < 3 * worst.sigma
    assert [each.blunder.group.stop for each in done.blunders] == ["p0070"] * wild


def test_effects_see_bodies_where_the_model_has_them(tmp_path):
    """A scale of what was measured would shrink its errors as well: of a tracker that is worse than
    its sigma it was named, 7 % of it; and where it was added, it was 1.6 to 1.9 % in four of six
    arms that have none, two of its sigmas."""
    rng, folder, poses = np.random.default_rng(7), tmp_path / "rec", 80
    world = arm_worlds.bent(folder, "puma560", rng)
    read = world.draw(rng, poses)
    seen, noise = world.seen(read), arm_worlds.noise(rng, poses)
    arm_worlds.save(folder, world, read, seen * arm_worlds.exp(7.0 * noise), {}, 2e-5)
    stand = stand_of(calibrate([folder], tmp_path / "run", hold_out="none"), quiet)
    problem = stand.problem_of(stand.model.plus((find("optitrack_scale"),)))
    values = {"optitrack_scale": np.ones(1), **stand.estimate.values}
    shift = []
    for block in problem.bodies:
        away = se3.inverse(block.stops.in_world(block.body, values).T) @ block.seen(values).T
        shift += [*np.linalg.norm(away[:, :3, 3], axis=1)]
    measured = [np.linalg.norm(b.measured[0, :3, 3]) for b in problem.bodies]
    true = np.linalg.norm(seen.translation, axis=1)
    assert np.std(shift - true) < 0.5 * np.std(measured - true)


@pytest.mark.parametrize("arm", ["ur5e", "irb120"])
@pytest.mark.long
def test_a_joint_that_slipped_is_not_the_tracker_or_the_mount(tmp_path, arm):
    """What the first joint does to all that is seen a tracker that moved may do as well, and what
    the last does, the mount: with six parameters for one."""
    folder = tmp_path / "rec"
    folder.mkdir()
    arm_effects.written(folder, (arm, "joint slip", 1.0, 300))
    done = search(stand_of(calibrate([folder], tmp_path / "run", hold_out="none"), quiet), quiet)
    assert [step.effect.family for step in done.found] == ["arm_joint_slip"]


@pytest.mark.parametrize(
    ("more", "dof", "sure", "there"),
    [
        (6.0, 1, 0.01, ()),
        (6.0, 6, None, ()),
        (1.0, 1, "kept", ()),
        (6.0, 1, "kept", ("arm_gear_error@17",)),
    ],
)
def test_a_likelier_rival_takes_the_name_and_need_not_be_confirmed_again(
    monkeypatch, more, dof, sure, there
):
    """That something is missing is confirmed; which of two of one parameter it is, the odds say.
    One more order of a gear that the model has takes no name."""

    named, rival = (
        SimpleNamespace(test=SimpleNamespace(dof=each), effect=find(name))
        for each, name in ((1, "arm_gravity_sag"), (dof, "arm_gear_error@8"))
    )
    step = NamedEffect(
        candidate=named,
        before=SimpleNamespace(stand=SimpleNamespace(model=Model(there))),
        after=None,
        judged=None,
        p_adjusted=0.01,
        rivals=[Rival(rival, log_odds=-more, more=more)],
    )
    asked = []
    monkeypatch.setattr(steps, "_fitted", lambda *a, sure: asked.append((a[1], sure)) or [rival])
    found = steps._by_likelier(None, step, [], None)
    assert (found, asked) == (([], []) if sure == "kept" else ([rival], [(rival, sure)]))


@pytest.mark.parametrize(
    ("costs", "converged", "named"),
    [
        ({"arm_joint_scale": 95.0, "arm_joint_coupling": 93.0}, True, "arm_joint_coupling"),
        ({"arm_joint_scale": 98.0, "arm_joint_coupling": 97.5}, True, None),  # not by 20 to 1
        ({"arm_joint_scale": 96.8, "arm_joint_coupling": 99.0}, True, None),  # but one of two does
        ({"arm_joint_scale": 95.0, "arm_joint_coupling": 93.0}, False, None),
        ({"arm_joint_scale": 95.0}, True, "arm_joint_scale"),  # the other is not confirmed
    ],
)
@pytest.mark.parametrize("common", [1.0, 4.0])
def test_of_rivals_that_explain_more_the_fits_decide(monkeypatch, common, costs, converged, named):
    """By their costs with rows weighed as beside the one named, in units of how they scatter."""

    def estimate(cost):
        return SimpleNamespace(robust_cost=(cost - 2.0) * common, converged=converged, start=None)

    def step_of(name, rivals=()):
        stand = SimpleNamespace(model=name, estimate=estimate(100.0 if rivals else 0.0))
        stand.compared = lambda model, *_: SimpleNamespace(estimate=estimate(costs[model]))
        return NamedEffect(
            candidate=SimpleNamespace(test=SimpleNamespace(dof=2), effect=find(name)),
            before=SimpleNamespace(stand=SimpleNamespace(model=Model())),
            after=SimpleNamespace(stand=stand, named=SimpleNamespace(common=common)),
            judged=SimpleNamespace(inflation=0.5),
            p_adjusted=0.01,
            rivals=rivals,
        )

    def fitted(look, candidate, found, progress, sure):
        name = candidate.effect.name
        return [step_of(name)] if name in costs else []

    names = {"arm_joint_scale": -4.3, "arm_joint_coupling": -4.2, "arm_link_bending": -1.0}
    rivals = [
        Rival(SimpleNamespace(effect=find(name)), log_odds=odds, more=0.0)
        for name, odds in names.items()
    ]
    monkeypatch.setattr(steps, "_fitted", fitted)
    found = steps._by_likelier(None, step_of("arm_gravity_sag", rivals), [], None)
    assert [step.effect.name for step in found] == ([named] if named else [])


def test_what_slips_in_two_rigs_has_one_time_and_each_its_own_size(tmp_path):
    """A mount is of one rig, so its slip is estimated for each; the time, for both together."""
    rng, poses, first = np.random.default_rng(3), 60, 33
    time_s = np.arange(poses) * 12.0
    world = arm_worlds.bent(tmp_path / "one", "ur10", rng)
    shutil.copytree(tmp_path / "one", tmp_path / "two")
    for rig, size_m in (("one", 1e-3), ("two", -2e-3)):
        folder = tmp_path / rig
        read = world.draw(rng, poses)
        slip = size_m * np.outer(np.arange(poses) >= first, np.eye(6)[3])
        T = world.seen(read) * arm_worlds.exp(slip) * arm_worlds.exp(arm_worlds.noise(rng, poses))
        arm_worlds.save(folder, world, read, T, {"time_s": time_s})
        path = folder / "rig.yaml"
        path.write_text(path.read_text("utf-8").replace("name: arm", f"name: {rig}"), "utf-8")
    model = Model((*GEOMETRY, "mount_slip@366"))  # two stops early
    run = calibrate([tmp_path / "one", tmp_path / "two"], tmp_path / "run", model, "none")
    stand, swapped = retuned(stand_of(run, quiet), ["mount_slip@366"], quiet)
    assert time_s[first - 1] < swapped["mount_slip@366"].shape < time_s[first]
    sizes = {name: x for name, x in stand.estimate.values.items() if "mount_slip" in name}
    assert len(sizes) == 2
    for (_, x), size_m in zip(sorted(sizes.items()), (1e-3, -2e-3), strict=True):
        assert x[3] == pytest.approx(size_m, abs=1e-4)


@pytest.mark.parametrize(
    ("names", "wild", "fits"),
    [(["a"], [], 0), (["a", "b"], [], 0), (["b"], [], 1), (["a"], [0], 1)],
)
def test_names_that_led_nowhere_are_not_fitted_again(names, wild, fits):
    asked = []

    def fitted(effects, progress):
        asked.append([effect.name for effect in effects])
        raise InputError("no fit comes of this")

    beside = [], [SimpleNamespace(effect=SimpleNamespace(name=name)) for name in names], wild
    stand, nowhere = SimpleNamespace(with_effects=fitted), [["a", "b"]]
    assert searching._in_place_of_chance(stand, None, beside, quiet, MOST_NEEDED, nowhere) is None
    assert asked == [names] * fits
