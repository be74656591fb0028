"""Errors of stops that follow each other: alike by chance as seldom as is said, and told where they
are alike."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from calib.diagnosis.chance.serial import FEWEST_PAIRS, drifting, p_of_pose, p_serial
from calib.diagnosis.search import search
from calib.effects import find
from calib.runs.calibrate import calibrate
from calib.runs.diagnose import diagnose
from calib.runs.reopen import stand_of

from . import arm_worlds

STOPS = [f"s{k:03}" for k in range(60)]


def quiet(*told):
    """Nothing."""


def of_a_body(errors, time_s=None, turn=None, joints=None, poses=None):
    """A problem and its blunders: errors (K, r) of a body at the stops of a table, with the times
    of these; what turns (K, r, r) the rows' own axes to theirs; how joints (K, J) stood; and where
    the body was seen (K, 4, 4)."""
    stops = STOPS[: len(errors)]
    time_s = np.full(len(stops), np.nan) if time_s is None else time_s  # as of no times
    joints = np.zeros((len(stops), 0)) if joints is None else joints
    recording = SimpleNamespace(stops=stops, time_s=time_s, joints=joints)
    rig = SimpleNamespace(carried=(), lidar_frame=None)
    if poses is not None:
        rig.carried, rig.joints_to = ("tool",), lambda body: ["joint"]
        rig.tree = SimpleNamespace(place=lambda *_: SimpleNamespace(Ts_root_frame=poses))
        quat = Rotation.from_matrix(poses[:, :3, :3]).as_quat(scalar_first=True)
        recording.bodies = {"tool": np.hstack([poses[:, :3, 3], quat])}
    problem = SimpleNamespace(sources=[SimpleNamespace(recording=recording, rig=rig)])
    known = 2.0 * np.eye(errors.shape[1])
    blunders = [
        SimpleNamespace(
            found=False,
            group=SimpleNamespace(kind="body"),
            shift=SimpleNamespace(
                group=SimpleNamespace(recording="", where=stop, what="tool"),
                dof=errors.shape[1],
                offset=error,
                covariance=known,
                turn=None if turn is None else turn[k],
            ),
        )
        for k, (stop, error) in enumerate(zip(stops, errors, strict=True))
    ]
    return problem, blunders


def told(errors, time_s=None, effect="tracker_scatter", turn=None):
    """The p-value of such errors."""
    problem, blunders = of_a_body(errors, time_s, turn)
    return p_serial(find(effect), SimpleNamespace(problem=problem), blunders)


@pytest.mark.parametrize("count", [10, 20, 60])
@pytest.mark.parametrize("size", [1, 6])
def test_random_errors_are_seldom_alike(count, size):
    """However unevenly they scatter: a few stops by ten times as much as others."""
    rng = np.random.default_rng([count, size])
    p = []
    for _ in range(400):
        wide = np.where(rng.random(count) < 0.1, 10.0, 1.0)[:, None]
        p.append(told(wide * rng.normal(size=(count, size))))
    p = np.array(p)
    for level in (0.01, 0.05):
        assert (p < level).mean() < level + 3 * np.sqrt(level * (1 - level) / len(p)), level
    assert 0.4 < np.median(p) < 0.6


def test_what_drifts_and_what_was_changed_for_a_while_is_correlated():
    rng, k = np.random.default_rng(0), np.arange(30)
    noise = rng.normal(size=(30, 6))
    along = rng.normal(size=6)
    for course in (k - 14.5, np.where((k >= 10) & (k < 20), 10.0, -5.0)):
        errors = course[:, None] * along + noise
        assert told(errors) < 0.01
        order = rng.permutation(30)
        assert told(errors[order]) > 0.01  # as a table has them
        assert told(errors[order], time_s=60.0 * order) == pytest.approx(told(errors))


def test_what_is_fixed_to_a_body_and_what_is_fixed_to_the_tracker_are_seen():
    """A body that is turned otherwise at every stop sits elsewhere on ten of thirty; or the tracker
    sees it elsewhere then."""
    rng, k = np.random.default_rng(2), np.arange(30)
    course = np.where((k >= 10) & (k < 20), 6.0, -3.0)[:, None] * np.array([1.0, -0.5, 0.3])
    turn = Rotation.random(30, rng).as_matrix()
    noise = rng.normal(size=(30, 3))
    assert told(np.matvec(turn, course) + noise) > 0.01
    assert told(np.matvec(turn, course) + noise, turn=turn) < 0.01
    assert told(course + noise, turn=turn) < 0.01
    random = [told(rng.normal(size=(30, 3)), turn=turn) for _ in range(300)]
    assert np.mean(np.array(random) < 0.05) < 0.08


def test_few_stops_and_other_instruments_tell_nothing():
    drift = np.arange(float(FEWEST_PAIRS))[:, None] - 4.0
    assert told(drift) == 1.0
    drift = np.arange(30.0)[:, None] - 14.5
    assert told(drift) < 0.01
    assert told(drift, effect="target_scatter") == 1.0


def of_pose(errors, joints):
    """How often chance makes errors (K, r) so much alike where joints (K, J) stand alike."""
    problem, blunders = of_a_body(errors, joints=joints)
    return p_of_pose(find("tracker_scatter"), SimpleNamespace(problem=problem), blunders)


def test_errors_that_go_with_the_pose_are_alike_where_the_arm_stands_again():
    """Five poses at each of six places, reached to a tenth of a milliradian, and one joint unread
    at a stop; errors of which half go with the pose. Where none do, they seldom seem to."""
    rng = np.random.default_rng(4)
    poses = np.tile(rng.uniform(-2, 2, (5, 6)), (6, 1)) + 1e-4 * rng.normal(size=(30, 6))
    poses[7, 2] = np.nan
    with_it = np.tile(rng.normal(size=(5, 3)), (6, 1)) + rng.normal(size=(30, 3))
    assert of_pose(with_it, poses) < 0.01
    assert of_pose(with_it, rng.permutation(poses)) > 0.01
    assert of_pose(with_it, rng.uniform(-2, 2, (30, 6))) == 1.0  # no pose was taken twice
    p = np.array([of_pose(rng.normal(size=(30, 3)), poses) for _ in range(2000)])
    assert np.mean(p < 0.05) == pytest.approx(0.05, abs=0.015)
    assert np.mean(p < 0.5) == pytest.approx(0.5, abs=0.03)


def at_random(rng, count=60):
    """Poses of a body (K, 4, 4), none twice."""
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, :3], T[:, :3, 3] = Rotation.random(count, rng).as_matrix(), rng.normal(size=(count, 3))
    return T


def near_pose(errors, T):
    """How often chance makes errors (K, r) so much alike where a body is nearly as turned."""
    problem, blunders = of_a_body(errors, poses=T)
    return p_of_pose(find("tracker_scatter"), SimpleNamespace(problem=problem), blunders)


@pytest.mark.parametrize(
    "of",
    [
        lambda T: np.diag([1.0, 1.0, 0.2]) @ T[:, 2, :3, None],  # up in its axes: a mast that bends
        lambda T: T[:, :3, :1] - 0.5 * T[:, :3, 1:2],  # as the tracker sees it turned
        lambda T: np.sin(T[:, :3, 3:]),  # where it is
    ],
)
def test_errors_that_go_with_how_a_body_hangs_or_is_seen_are_not_random(of):
    """Half of the error is noise, and no pose is taken twice."""
    rng = np.random.default_rng(8)
    T = at_random(rng)
    with_it = of(T)[..., 0]
    errors = with_it / with_it.std() + rng.normal(size=(60, 3))
    assert near_pose(errors, T) < 0.01
    assert near_pose(rng.permutation(errors), T) > 0.01


def test_random_errors_of_poses_that_lie_anywhere_seldom_seem_to_go_with_them():
    rng, p = np.random.default_rng(9), []
    T = at_random(rng)
    for _ in range(600):
        wide = np.where(rng.random(60) < 0.1, 10.0, 1.0)[:, None]
        p.append(near_pose(wide * rng.normal(size=(60, 3)), T))
    for level in (0.01, 0.05):
        assert np.mean(np.array(p) < level) < level + 3 * np.sqrt(level * (1 - level) / len(p))


def test_values_of_stops_are_taken_as_the_stops_were_made():
    """In each of two recordings, whose values stand in one unknown in any order."""
    rng, order = np.random.default_rng(5), np.random.default_rng(6).permutation(30)
    drift = np.arange(30.0) - 14.5
    for values, alike in ((drift, True), (rng.permutation(drift), False)):
        both = [
            SimpleNamespace(
                recording=SimpleNamespace(
                    folder=Path(day),
                    stops=[STOPS[k] for k in order],
                    time_s=60.0 * order,
                    joints=np.zeros((30, 0)),
                )
            )
            for day in ("mon", "tue")
        ]
        members = [f"{day}/{stop}" for day in ("mon", "tue") for stop in STOPS[:30]]
        effect = find("stop_range_scatter")
        terms = [
            [SimpleNamespace(effect=effect.among(members, f"{day}/"), variable="v")]
            for day in ("mon", "tue")
        ]
        variables = {"v": SimpleNamespace(sigma=np.full(60, 2.0))}
        others = SimpleNamespace(
            problem=SimpleNamespace(sources=both, terms=terms, variables=variables),
            whole=SimpleNamespace(values={"v": np.concatenate([values, rng.permutation(drift)])}),
        )
        assert (p_serial(effect, others, []) < 0.01) is alike


def test_turns_do_not_hide_shifts_in_another_unit():
    """Of values that turn at random by 5 mrad and shift by up to 1 mm, steadily."""
    rng, k = np.random.default_rng(8), np.arange(30)
    found = []
    for steady in (True, False):
        shift_m = np.outer(1e-3 * (k - 14.5) / 15, [1.0, 0.5, -0.5])
        shift_m = shift_m if steady else rng.permutation(shift_m)
        values = np.hstack([5e-3 * rng.normal(size=(30, 3)), shift_m])
        recording = SimpleNamespace(stops=STOPS[:30], time_s=np.full(30, np.nan))
        effect = find("stop_pose_scatter").among(STOPS[:30])
        sd = np.tile(np.repeat([5e-3, 6e-4], 3), 30)
        others = SimpleNamespace(
            problem=SimpleNamespace(
                sources=[SimpleNamespace(recording=recording)],
                terms=[[SimpleNamespace(effect=effect, variable="v")]],
                variables={"v": SimpleNamespace(sigma=sd)},
            ),
            whole=SimpleNamespace(values={"v": values.ravel()}),
        )
        found.append(p_serial(effect, others, []))
    assert found[0] < 0.01 < found[1]


@pytest.mark.parametrize(("random", "pure_shift"), [(True, True), (False, True), (False, False)])
def test_a_body_that_sat_elsewhere_for_a_while_is_not_called_random(tmp_path, random, pure_shift):
    """It is elsewhere for half of the poses, fifteen at a time; or for as many, here and there."""
    rng = np.random.default_rng(77)
    world = arm_worlds.bent(tmp_path / "rec", "puma560", rng)
    read = world.draw(rng, 90)
    away = (np.arange(90) // 15) % 2 == 1
    if random:
        away = rng.permutation(away)
    by = [0.0, 0.0, 0.0, 6e-4, 4e-4, -6e-4] if pure_shift else [4e-3, -3e-3, 2e-3, 0.0, 0.0, 0.0]
    twist = np.outer(away - 0.5, by)
    T = world.seen(read) * arm_worlds.exp(twist) * arm_worlds.exp(arm_worlds.noise(rng, 90))
    arm_worlds.save(tmp_path / "rec", world, read, T, {}, 2e-5)
    run = calibrate([tmp_path / "rec"], tmp_path / "run", hold_out="none")
    (chance,) = search(stand_of(run, quiet), quiet).chance
    assert chance.effect.name == "tracker_scatter"
    assert ("not at random" in chance.sentence) is not random
    assert (chance.document(step=1)["p_serial"] < 0.01) is not random
    assert ("random as far as these data show" in chance.sentence) is random


@pytest.mark.parametrize("rho", [0.0, 0.6])
def test_noise_that_is_correlated_in_time_is_told(tmp_path, rho):
    """As large as rig.yaml says, so that nothing scatters more than it should."""
    rng = np.random.default_rng(78)
    world = arm_worlds.bent(tmp_path / "rec", "puma560", rng)
    read, white = world.draw(rng, 90), arm_worlds.noise(rng, 90)
    errors = lfilter([np.sqrt(1 - rho**2)], [1.0, -rho], white, axis=0)
    T = world.seen(read) * arm_worlds.exp(errors)
    arm_worlds.save(tmp_path / "rec", world, read, T, {}, 2e-5)
    run = calibrate([tmp_path / "rec"], tmp_path / "run", hold_out="none")
    said = [s for s in diagnose(run, refits=False).sentences if "noise is correlated in time" in s]
    assert bool(said) is (rho > 0)


def test_a_step_that_was_found_may_be_one_of_such_noise():
    white = np.random.default_rng(3).normal(size=(40, 3))
    (sentence,) = drifting(*of_a_body(np.cumsum(white, axis=0)), ["a", "b"])
    assert "even with a and b in the model" in sentence and "can look like a and b" in sentence
    assert not list(drifting(*of_a_body(white), ["a"]))
