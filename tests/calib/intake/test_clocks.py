"""Clocks brought together by motion: known offsets recovered, and what is ambiguous refused."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.intake.clocks import align, estimate
from calib.intake.gather import chain
from calib.intake.motion import motions
from chains.errors import InputError
from chains.readers.dh import DhRow, to_urdf
from sensors.readers.base import ArmDescription, Sweeps, Track
from sensors.stops import POSE

from .moving import DH, JOINTS, T_TIP_CUP, T_WORLD_BASE, logged, plan, tip

RNG = np.random.default_rng(3)
HELD, SPANS = MOVES = plan(12)
END_S = float(SPANS[-1, 1])


@pytest.fixture(scope="module")
def edges():
    rows = [DhRow(n, a, alpha, d) for n, (a, alpha, d) in zip(JOINTS, DH, strict=True)]
    return chain(ArmDescription(to_urdf("arm", rows, False), "arm_base", "arm_end"))


def joints(offset_s=0.0, clock="joints", rate_hz=50, moves=MOVES):
    time_s = np.arange(0, moves[1][-1, 1], 1 / rate_hz)
    return Track(
        name=clock,
        kind="joints",
        clock=clock,
        time_s=time_s - offset_s,
        names=JOINTS,
        values=logged(*moves, time_s),
    )


def cup(offset_s, clock="take", rate_hz=100, noise=2e-4, within=(0, 1), moves=MOVES):
    time_s = np.arange(*(share * moves[1][-1, 1] for share in within), 1 / rate_hz)
    pose = T_WORLD_BASE * tip(logged(*moves, time_s)) * T_TIP_CUP
    turn = pose.rotation * Rotation.from_rotvec(noise * RNG.normal(size=(len(time_s), 3)))
    values = np.hstack([pose.translation, turn.as_quat(scalar_first=True)])
    return Track(
        name="cup", kind="pose", clock=clock, time_s=time_s - offset_s, names=POSE, values=values
    )


def other_motion():
    """As long as the logs, with moves at other times."""
    held, spans = plan(14, seed=9)
    time_s = np.arange(0, END_S, 0.01)
    pose = T_WORLD_BASE * tip(logged(held, spans, time_s))
    return np.hstack([pose.translation, pose.rotation.as_quat(scalar_first=True)])


def sweeps(time_s, clock="lidar"):
    return Sweeps("top", clock, np.asarray(time_s, float), lambda wanted: iter(()))


@pytest.mark.parametrize("offset_s", [0.0, 0.0037, -2.5, 1.6e9 + 0.123])
@pytest.mark.parametrize("within", [(0, 1), (0.3, 0.8)])
def test_an_offset_is_found_to_milliseconds(edges, offset_s, within):
    """The tip turns as the joints say, which is what a tracker sees: 100 Hz, 0.2 mrad of noise."""
    found = align([joints(), cup(offset_s, within=within)], [], edges, {})
    moved = found.tracks[1].time_s[0] - (within[0] * END_S - offset_s)
    assert abs(moved - offset_s) < 2e-3
    assert any("± 0.0" in line for line in found.understood) and not found.odd


def test_its_sigma_is_of_the_size_of_its_error(edges):
    """Over six draws of the noise, the offset scatters as it is said to, within a few."""
    (mine,) = motions(joints(), edges, 0.1)[:1]
    found = [estimate(motions(cup(0.5, noise=3e-3), (), 0.1)[0], mine) for _ in range(6)]
    errors = np.array([one.offset_s - 0.5 for one in found])
    sigma = np.median([one.sigma_s for one in found])
    assert sigma / 4 < np.sqrt(np.mean(errors**2)) < 4 * sigma


def test_gyro_and_pose_share_their_turns(edges):
    time_s = np.arange(0, END_S, 0.01)
    turn = tip(logged(HELD, SPANS, time_s)).rotation
    rate = (turn[:-1].inv() * turn[1:]).as_rotvec() / 0.01 + [0.01, -0.02, 0.005]
    gyro = Track(
        name="imu",
        kind="gyro",
        clock="imu",
        time_s=time_s[:-1] + 0.005 + 7.0,
        names=("x", "y", "z"),
        values=rate,
    )
    found = align([cup(0.0), gyro], [], (), {})
    assert abs(found.tracks[1].time_s[0] - 0.005) < 5e-3


def test_without_an_arm_joints_and_a_point_are_matched(edges):
    pose = cup(3.0)
    point = Track(
        name="cup",
        kind="point",
        clock="take",
        time_s=pose.time_s,
        names=POSE[:3],
        values=pose.values[:, :3],
    )
    found = align([joints(), point], [], (), {})
    assert abs(found.tracks[1].time_s[0]) < 0.05


def test_the_lidars_clock_leads_and_overlap_is_said(edges):
    found = align([joints(), cup(0.0, "joints")], [sweeps([1, 2, 3])], edges, {})
    assert "lidar" in found.understood[0] and "taken for the same" in found.odd[0]


def test_what_is_given_is_applied_and_not_estimated(edges):
    found = align([joints(), cup(2.0)], [], edges, {"take": 5.0})
    assert found.tracks[1].time_s[0] == pytest.approx(3.0) and "as given" in found.understood[1]


@pytest.mark.parametrize("warps", [False, True])
def test_a_clock_that_drifts_is_corrected(edges, warps):
    """A clock that is fast, and one whose speed changes, as a crystal's does while it warms up."""
    drifting = cup(0.0, noise=0)
    true_s = drifting.time_s
    late_s = 0.004 * true_s if not warps else 0.25 * (true_s / END_S) ** 2
    said = align([joints(), replace(drifting, time_s=true_s + late_s)], [], edges, {})
    off_s = said.tracks[1].time_s - true_s
    assert late_s[-1] > 0.2 and np.abs(off_s).max() < 0.006 and np.abs(off_s).mean() < 0.0015
    (line,) = said.odd
    assert "drifts by -0.2" in line and ("pieces" if warps else "straight line") in line


@pytest.mark.parametrize("periods", [None, 0.62, 1.0])
def test_a_clock_that_drifts_unevenly_and_far_is_corrected(edges, periods):
    """One that is right until the middle and 0.8 s off at the end, and two that go to and fro:
    further than a part of the logs is sought from the offset of all. All kept the one offset."""
    moves = plan(60)
    drifting = cup(0.0, noise=0, moves=moves)
    true_s, end_s = drifting.time_s, moves[1][-1, 1]
    late_s = np.maximum(0.0, 1.6 * (true_s / end_s - 0.5))
    if periods:
        late_s = 0.3 * np.sin(2 * np.pi * periods * true_s / end_s)
    tracks = [joints(moves=moves), replace(drifting, time_s=true_s + late_s)]
    said = align(tracks, [], edges, {})
    off_s = said.tracks[1].time_s - true_s
    assert np.abs(off_s).max() < 0.12 and np.abs(off_s).mean() < 0.02
    (line,) = said.odd
    assert "pieces" in line and ("in between" in line) == bool(periods)
    told_s = float(re.search(r"drifts by (\S+) s", line).group(1))
    # From the middle of the first part to that of the last, of eight.
    first, last = np.searchsorted(true_s, [end_s / 16, 15 * end_s / 16])
    assert told_s == pytest.approx(late_s[first] - late_s[last], abs=0.1)


def test_a_bent_clock_is_as_far_off_as_its_sigma_says(edges):
    """Over motions, bends and noise: what is corrected with pieces is within one and two sigmas as
    often as chance has it, 68 and 95 %; 71 and 93 % where this was written."""
    off = []
    for seed in range(20, 26):
        moves = plan(12, seed=seed)
        (mine,) = motions(joints(moves=moves), edges, 0.1)[:1]
        for bend_s in (0.1, 0.15, 0.2, 0.25, 0.3):
            bent = cup(0.0, noise=5e-3, moves=moves)
            true_s = bent.time_s
            bent = replace(bent, time_s=true_s + bend_s * (true_s / true_s[-1]) ** 2)
            found = estimate(motions(bent, (), 0.1)[0], mine)
            if len(found.added.at_s) > 2:
                off.extend(np.abs(found.added.to(bent.time_s) - true_s) / found.sigma_s)
    assert len(off) > 100_000
    assert 0.6 < np.mean(np.array(off) < 1) < 0.8 and 0.88 < np.mean(np.array(off) < 2) < 0.98


def test_a_clock_that_keeps_time_is_not_bent(edges):
    said = align([joints(), cup(0.7, noise=3e-3)], [], edges, {})
    assert not said.odd and np.ptp(said.tracks[1].time_s - cup(0.0).time_s) < 1e-9


def set_by(track, by_s, at=0.5):
    """The clock of a track was set so far ahead (n,), at shares of the time (n,)."""
    at_s = track.time_s[0] + np.atleast_1d(at) * np.ptp(track.time_s)
    ahead = np.atleast_1d(by_s) * (track.time_s[:, None] >= at_s)
    return replace(track, time_s=track.time_s + ahead.sum(axis=1))


@pytest.mark.parametrize("by_s", [0.6, 2.5, 40.0])
@pytest.mark.parametrize("whose", ["tracker", "joints"])
def test_a_clock_that_was_set_is_corrected_before_and_after(edges, by_s, whose):
    """One offset is right for half of the logs; in between, and elsewhere, none is."""
    moves = plan(40)
    mine, seen = joints(moves=moves), cup(3.2, moves=moves)
    if whose == "tracker":
        found = align([mine, set_by(seen, by_s)], [], edges, {})
        expected = seen.time_s + 3.2
    else:
        found = align([set_by(mine, by_s), seen], [], edges, {})
        expected = set_by(replace(seen, time_s=seen.time_s + 3.2), by_s).time_s
    (said,) = found.odd
    assert "was set at" in said
    off_s = np.abs(found.tracks[1].time_s - expected)
    wrong = off_s > 5e-3  # from the jump to where the arm moves next, at most
    assert wrong.mean() < 0.03
    assert off_s[~wrong].max() < 5e-3


@pytest.mark.parametrize("at", [(0.3, 0.6), (0.05,)])
def test_of_a_clock_that_was_set_twice_or_at_the_end_no_wrong_offset_is_believed(edges, at):
    moves = plan(40)
    seen = set_by(cup(3.2, moves=moves), [2.5] * len(at), list(at))
    try:
        found = align([joints(moves=moves), seen], [], edges, {})
    except InputError as error:
        assert "--clock-offset take=SECONDS" in str(error)
    else:
        times = seen.time_s if len(at) == 1 else np.nan
        assert np.median(np.abs(found.tracks[1].time_s - (times + 3.2 - 2.5))) < 0.01


def test_motion_that_repeats_is_ambiguous(edges):
    held = np.tile(HELD[:2], (8, 1))
    spans = 5.0 * np.arange(16)[:, None] + [0, 3]
    time_s = np.arange(0, 78, 0.01)
    values = logged(held, spans, time_s)
    pair = [
        Track(
            name=name, kind="joints", clock=name, time_s=time_s + late, names=JOINTS, values=values
        )
        for name, late in (("a", 0.0), ("b", 4.0))
    ]
    with pytest.raises(InputError, match="--clock-offset b=SECONDS"):
        align(pair, [], edges, {})


@pytest.mark.parametrize(
    ("tracks", "scans", "given", "said"),
    [
        ([joints()], [sweeps([1e9, 1e9 + 1])], {}, "do not overlap.*--clock-offset joints=SECONDS"),
        ([joints(), cup(0.0)], [], {"tak": 1.0}, "did you mean take"),
        (
            [joints(), replace(cup(0.0, "x"), values=other_motion())],
            [],
            {},
            "--clock-offset x=SECONDS",
        ),
    ],
)  # fmt: skip
def test_what_cannot_be_told_names_the_flag(edges, tracks, scans, given, said):
    with pytest.raises(InputError, match=said):
        align(tracks, scans, edges, given)
