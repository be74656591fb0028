"""Holds found in logs: where they truly are, whatever logged them."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.intake.gather import joint_track
from calib.intake.rigfile import _without
from calib.intake.still import SETTLE_S, find_holds
from calib.intake.stops import locations, table
from chains.errors import InputError
from sensors.readers.base import Track
from sensors.stops import POSE

from .moving import JOINTS, T_TIP_CUP, T_WORLD_BASE, logged, plan, tip

HELD, SPANS = plan(9, seed=1)
TIME_S = np.arange(0, SPANS[-1, 1], 0.01)
VALUES = logged(HELD, SPANS, TIME_S)
RNG = np.random.default_rng(2)


def joints(noise=1e-5):
    values = VALUES + noise * RNG.normal(size=VALUES.shape)
    return Track(name="log", kind="joints", clock="c", time_s=TIME_S, names=JOINTS, values=values)


def cup(noise_m=1e-4, noise_rad=2e-4):
    pose = T_WORLD_BASE * tip(VALUES) * T_TIP_CUP
    turn = pose.rotation * Rotation.from_rotvec(noise_rad * RNG.normal(size=(len(TIME_S), 3)))
    xyz = pose.translation + noise_m * RNG.normal(size=(len(TIME_S), 3))
    values = np.hstack([xyz, turn.as_quat(scalar_first=True)])
    return Track(name="cup", kind="pose", clock="c", time_s=TIME_S, names=POSE, values=values)


def gyro():
    turn = tip(VALUES).rotation
    rate = (turn[:-1].inv() * turn[1:]).as_rotvec() / 0.01
    rate += [0.02, -0.03, 0.01] + 2e-3 * RNG.normal(size=rate.shape)
    return Track(
        name="imu", kind="gyro", clock="c", time_s=TIME_S[1:], names=("x", "y", "z"), values=rate
    )


def inside(found):
    """Holds lie within the true ones, and miss little of them at both ends."""
    assert len(found) == len(SPANS)
    early, late = found[:, 0] - SPANS[:, 0], SPANS[:, 1] - found[:, 1]
    for gap in (early, late):
        assert gap.min() > 0 and gap.max() < SETTLE_S + 0.35


@pytest.mark.parametrize("make", [joints, cup, gyro], ids=["joints", "tracker", "gyro"])
def test_holds_are_where_nothing_moves(make):
    inside(find_holds([make()], ()).spans_s)


@pytest.mark.parametrize("depth_m", [2e-4, 1e-3, 2e-3])
def test_noise_alone_splits_no_hold(depth_m):
    """A camera's poses scatter along its axis, hardly across: the rate comes near to 0 time and
    again, and is many times that as often."""
    seen = cup(noise_m=2e-5)
    seen.values[:, 2] += depth_m * np.random.default_rng(4).normal(size=len(TIME_S))
    few = replace(seen, time_s=seen.time_s[::4], values=seen.values[::4])
    inside(find_holds([few], ()).spans_s)


def test_a_wild_pose_is_in_no_hold():
    seen = cup()
    at = int(np.searchsorted(TIME_S, SPANS[2].mean()))
    seen.values[at, :3] += 0.02
    found = find_holds([seen], (), min_hold_s=0.5).spans_s
    assert not any(start <= TIME_S[at] <= end for start, end in found)


def test_all_that_moves_must_be_still():
    """The base is driven off in the middle of the third hold, with the arm at rest."""
    start, end = SPANS[2]
    middle = (start + end) / 2
    xyz = np.zeros((len(TIME_S), 7))
    xyz[:, 3] = 1
    xyz[:, 0] = np.clip((TIME_S - middle) / 0.2, 0, 1)
    base = Track(name="base", kind="pose", clock="c", time_s=TIME_S, names=POSE, values=xyz)
    found = find_holds([joints(), base], (), min_hold_s=0.5).spans_s
    assert not np.any((found[:, 0] < middle) & (found[:, 1] > middle + 0.2))


def test_what_is_dropped_is_said_with_the_reason():
    """The arm rests nine times; the base shakes all through the fourth rest, from end to end."""
    lengths = np.sort(SPANS[:, 1] - SPANS[:, 0])
    least_s = float(lengths[1:3].mean()) - 2 * SETTLE_S  # one or two of the nine are shorter
    found = find_holds([joints()], (), min_hold_s=least_s)
    (line,) = (line for line in found.understood if "dropped" in line)
    assert int(line.split()[1]) == len(SPANS) - len(found.spans_s) > 0

    xyz = np.zeros((len(TIME_S), 7))
    xyz[:, 3] = 1
    shaken = (SPANS[3, 0] - 0.5 < TIME_S) & (SPANS[3, 1] + 0.5 > TIME_S)
    xyz[:, 0] = np.where(shaken, 0.05 * np.sin(9 * TIME_S), 0.0)
    base = Track(name="base", kind="pose", clock="c", time_s=TIME_S, names=POSE, values=xyz)
    found = find_holds([joints(), base], ())
    assert len(found.spans_s) == len(SPANS) - 1
    (line,) = (line for line in found.understood if "while another log moves" in line)
    assert line.startswith("holds: 1 times log is at rest")
    said = float(line.split("first from ")[1].split()[0])
    assert abs(said - SPANS[3, 0]) < SETTLE_S
    assert not any("dropped" in line for line in find_holds([joints()], ()).understood)


def test_a_body_out_of_sight_breaks_no_hold():
    hidden = cup()
    hidden.values[(SPANS[4, 0] + 0.8 < TIME_S) & (SPANS[4, 1] - 0.8 > TIME_S)] = np.nan
    inside(find_holds([joints(), hidden], ()).spans_s)


def test_means_are_those_of_what_was_held():
    spans = find_holds([joints(), cup()], ()).spans_s
    minutes, heat = np.array([0.0, 100.0]), np.array([[20.0], [21.0]])
    slow = Track(
        name="air", kind="covariate", clock="c", time_s=minutes, names=("heat",), values=heat
    )
    columns, odd = table([joints(), cup(), slow], spans)
    assert not odd
    found = np.stack([columns[name] for name in JOINTS], axis=1)
    np.testing.assert_allclose(found, HELD, atol=5e-6)
    pose = T_WORLD_BASE * tip(HELD) * T_TIP_CUP
    xyz = np.stack([columns[f"cup.{p}"] for p in "xyz"], axis=1)
    np.testing.assert_allclose(xyz, pose.translation, atol=6e-5)
    quat = np.stack([columns[f"cup.{p}"] for p in POSE[3:]], axis=1)
    gap = Rotation.from_quat(quat, scalar_first=True).inv() * pose.rotation
    assert gap.magnitude().max() < 1e-4
    np.testing.assert_allclose(columns["heat"], 20 + spans.mean(axis=1) / 100)


def test_what_creeps_is_named():
    slow = joints()
    slow.values[:, 0] += 2.5e-3 * TIME_S
    spans = find_holds([slow], (), threshold=0.01).spans_s
    assert "creeps" in table([slow], spans)[1][0]


def test_nothing_that_stands_still_is_refused():
    wild = joints()
    wild.values[:, 1] += 0.5 * np.sin(TIME_S)
    with pytest.raises(InputError, match="--still"):
        find_holds([wild], ())
    with pytest.raises(InputError, match="no log shows"):
        find_holds([], ())


def test_locations_are_where_the_base_stood():
    at = np.array([0.0, 0.001, 2.0, 0.002, np.nan, 2.001])
    columns = {"stop": np.array(list("abcdef")), "base.x": at}
    columns |= {f"base.{p}": np.where(np.isnan(at), np.nan, p == "qw") for p in POSE[1:]}
    found, words = locations(columns, "base", None)
    assert found["location"].tolist() == ["L00", "L00", "L01", "L00", "L00", "L01"]
    assert "2 places" in words
    assert locations(columns, "base", 3)[0]["location"].tolist()[::2] == ["L00", "L01", "L02"]


def heat(name, celsius, **changes):
    values = np.full((len(TIME_S), 1), celsius)
    parts = {"kind": "covariate", "names": ("temperature_c",)} | changes
    return Track(name=name, clock="c", time_s=TIME_S, values=values, **parts)


def test_what_is_logged_beside_the_arm_is_a_covariate_and_none_is_lost():
    """A gripper in the arm's own log, one in a log of its own, and two thermometers."""
    own = Track(
        name="log", kind="joints", clock="c", time_s=TIME_S, names=("grip", *JOINTS),
        values=np.column_stack([np.full(len(TIME_S), 0.4), VALUES]),
    )  # fmt: skip
    other = heat("/tool/joints", 0.7, kind="joints", names=("finger",))
    tracks = joint_track([own, other, heat("/room", 20.0), heat("/arm/motor", 40.0)], JOINTS)
    columns, odd = table(tracks, SPANS)
    for name, value in {"grip": 0.4, "finger": 0.7, "temperature_c": 20.0}.items():
        np.testing.assert_allclose(columns[name], value)
    np.testing.assert_allclose(columns["arm_motor.temperature_c"], 40.0)
    assert any("temperature_c is logged twice" in line for line in odd)
    assert np.array(JOINTS)[[name in columns for name in JOINTS]].tolist() == list(JOINTS)


def test_a_body_that_is_left_out_takes_only_its_pose_along():
    columns = {"cup.x": 1, "cup.qw": 1, "cup.temperature_c": 1, "mug.x": 1}
    assert _without(columns, ["cup"]).keys() == {"cup.temperature_c", "mug.x"}
