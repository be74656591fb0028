"""What a rig has twice, each with a shape of its own: slips at two times, two orders of a gear, two
waves of the range. The second was told as scatter by chance, or as structure without a name."""

import numpy as np
import pytest

from calib.diagnosis.candidates import known_effects
from calib.diagnosis.search import MOST_NEEDED
from calib.diagnosis.search.shapes import retuned
from calib.problem.model import Model
from calib.runs.calibrate import calibrate, grow, grown_model
from calib.runs.diagnose import diagnose
from calib.runs.explain import explain
from calib.runs.reopen import model_of, stand_of

from . import arm_worlds
from .simulated import made

POSES = 120


def arm_of(folder, seed, name="ur5e", poses=POSES):
    """An arm in a folder, poses of it, and the generator that drew both."""
    rng = np.random.default_rng(seed)
    world = arm_worlds.bent(folder, name, rng, size=0.3)
    return world, world.draw(rng, poses), rng


def write_erring(folder, erring, seed, name="ur5e", poses=POSES):
    """Write an arm of which joints, by their number, err so many times a turn by so much, rad."""
    world, joints, rng = arm_of(folder, seed, name, poses)
    true = joints.copy()
    for j, order, by in erring:
        true[:, j] += by * np.sin(order * joints[:, j] + rng.uniform(0, 2 * np.pi))
    noise = arm_worlds.exp(arm_worlds.noise(rng, poses))
    arm_worlds.save(folder, world, joints, world.seen(true) * noise)


def test_a_tracker_that_slips_twice_is_named_at_both_times(tmp_path):
    world, joints, rng = arm_of(tmp_path / "rec", 2)
    time_s = np.cumsum(rng.uniform(8.0, 16.0, POSES))
    first, again = 40, 85
    by = np.zeros((POSES, 6))
    by[first:, 3:] += [4e-4, 2e-4, 5e-4]
    by[again:] += [0.0, 2e-4, 2e-4, 3e-4, -5e-4, 0.0]
    seen = arm_worlds.exp(by) * world.seen(joints)
    seen = seen * arm_worlds.exp(arm_worlds.noise(rng, POSES))
    columns = {"elapsed_s": time_s - time_s[0]}
    arm_worlds.save(tmp_path / "rec", world, joints, seen, columns)
    grown = explain([tmp_path / "rec"], tmp_path / "out")
    assert grown.diagnosis.verdict == "adequate"
    slips = [e for e in model_of(grown.runs[-1]).effects if e.family == "tracker_slip"]
    when = sorted(np.searchsorted(columns["elapsed_s"], e.shape) for e in slips)
    assert when == [first, again]


def test_two_slips_may_go_to_one_time_between_them(tmp_path):
    """Of slips a stop apart, either may be better there; that ended a diagnosis."""
    world, joints, rng = arm_of(tmp_path / "rec", 6)
    seen = world.seen(joints) * arm_worlds.exp(arm_worlds.noise(rng, POSES))
    columns = {"elapsed_s": 10.0 * np.arange(POSES)}
    arm_worlds.save(tmp_path / "rec", world, joints, seen, columns)
    model = ("arm_link_length", "arm_joint_offset", "tracker_slip@395", "tracker_slip@415")
    run = calibrate([tmp_path / "rec"], tmp_path / "run", Model(model))
    slips = [effect.name for effect in model_of(run).effects if effect.family == "tracker_slip"]
    stand, _ = retuned(stand_of(run, lambda *_: None, ()), slips, lambda *_: None)
    assert {*slips} <= {*stand.model.names}


def test_a_gear_that_errs_in_two_orders_is_named_in_both(tmp_path):
    write_erring(tmp_path / "rec", [(1, 100, 3e-4), (2, 50, 2e-4)], seed=1)
    found = diagnose(calibrate([tmp_path / "rec"], tmp_path / "run"))
    assert set(found.worth_adding) == {"arm_gear_error@100", "arm_gear_error@50"}


def test_another_order_of_a_gear_comes_after_all_else(tmp_path):
    """Though it explains more: what is no wave can be taken for many of them."""
    world, joints, rng = arm_of(tmp_path / "rec", 5)
    true = joints.copy()
    true[:, 1] += 5e-4 * np.sin(8 * joints[:, 1])
    true[:, 2] += 4e-4 * np.sin(17 * joints[:, 2])
    true[:, 3] *= 1.0 + 2e-4
    noise = arm_worlds.exp(arm_worlds.noise(rng, POSES))
    arm_worlds.save(tmp_path / "rec", world, joints, world.seen(true) * noise)
    found = diagnose(calibrate([tmp_path / "rec"], tmp_path / "run"))
    assert found.worth_adding == ["arm_gear_error@8", "arm_joint_scale", "arm_gear_error@17"]


# Six joints, each of which errs.
REST = "arm_gear_error@50"
EVERY = ((0, 2, 3e-4), (1, 1, 2.5e-4), (2, 80, 2.5e-4), (3, 1, 2e-4), (4, 50, 3e-4), (5, 2, 3e-4))


def test_while_effects_are_missing_nothing_else_is_called_random(tmp_path):
    """As many are named as are looked for at once. What was left was told as a tracker that
    scatters, which then stayed in the model."""
    write_erring(tmp_path / "rec", EVERY, 4, "kr6", 200)
    run = calibrate([tmp_path / "rec"], tmp_path / "run")
    found = diagnose(run)
    assert len(found.worth_adding) == MOST_NEEDED and found.scatter
    assert not any("scatter" in name for name in found.worth_adding)
    (said,) = (s for s in found.sentences if "tracker_scatter" in s)
    assert said.startswith("More effects are missing beside these: add them")
    all_of = diagnose(grow(run, grown_model(run, [*found.worth_adding, REST]), tmp_path / "all"))
    assert all_of.verdict == "adequate" and not all_of.scatter


@pytest.mark.long
@pytest.mark.parametrize("waves_m", [(1.0, 0.5), (2.0, 0.8)])
def test_a_range_that_errs_in_two_waves_is_named_in_both(tmp_path, waves_m):
    made(tmp_path / "rec", "tiny", 3, **{f"range_cyclic@{wave}": 1.0 for wave in waves_m})
    found = diagnose(calibrate([tmp_path / "rec"], tmp_path / "run"))
    named = [name.partition("@") for name in found.worth_adding]
    assert {family for family, _, _ in named} == {"range_cyclic"}
    waves = sorted(float(shape) for _, _, shape in named)
    assert waves == pytest.approx(sorted(waves_m), rel=0.01)


def test_only_other_shapes_of_what_a_model_has_are_asked_for(tmp_path):
    source, _ = made(tmp_path / "rec", "tiny", 1)
    columns = frozenset(source.columns) | {"range_m"}

    families = ("range_cyclic", "range_step", "near_range_bias")

    def asked(*mine):
        every = known_effects(Model(mine), [source], columns)
        return {family: {e.shape for e in every if e.family == family} for family in families}

    before, after = asked(), asked("range_cyclic@1.03", "range_step@3", "near_range_bias@0.5")
    # Between two waves of the grid, neither is another one.
    grid = sorted(before["range_cyclic"])
    beside = {max(s for s in grid if s < 1.03), min(s for s in grid if s > 1.03)}
    assert before["range_cyclic"] - after["range_cyclic"] == beside
    assert before["range_step"] - after["range_step"] == {3.0}
    assert before["near_range_bias"] and not after["near_range_bias"]
