"""What is wrong at stops that follow each other is told as one, and by chance hardly ever."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from calib.blunders.lasting import lasting
from calib.residuals.groups import JOINTS, SCAN, Group
from calib.rig.suspect import SO_BY_CHANCE, spells
from calib.rig.tracked import odd_bodies

from .test_check_suspects import BASE, MOUNT, changed, opened

NAMES = tuple(f"s{k:02}" for k in range(30))
TIMES_S = 60.0 * np.arange(30)


def told(at, stops=NAMES, time_s=TIMES_S):
    return [(s.stops[0], s.stops[-1]) for s in spells(stops, time_s, [stops[k] for k in at])]


@pytest.mark.parametrize("count", [3, 6, 15, 27])
def test_stops_that_are_wrong_by_themselves_hardly_ever_seem_to_last(count):
    rng, draws = np.random.default_rng(count), 2000
    seen = sum(bool(told(rng.choice(30, count, replace=False))) for _ in range(draws))
    assert seen <= draws * SO_BY_CHANCE + 2 * np.sqrt(draws * SO_BY_CHANCE)


def test_what_begins_half_way_or_ends_is_one_and_what_is_alone_stays_alone():
    assert told(range(15, 30)) == [("s15", "s29")]
    assert told(range(8)) == [("s00", "s07")]
    assert told([3, *range(15, 21), 22, 23, 24]) == [("s15", "s24")], "all but one of ten"
    many = [f"s{k:02}" for k in range(60)]
    twice = [*range(2, 9), *range(47, 56)]
    assert told(twice, many, np.arange(60.0)) == [("s47", "s55"), ("s02", "s08")]
    assert told([4, 5]) == [] and told([1, 9, 20]) == [] and told([0, 7, 8, 15, 22, 29]) == []


def test_stops_follow_each_other_in_time_and_not_in_the_file():
    order = np.random.default_rng(0).permutation(30)
    shuffled = [NAMES[k] for k in order]
    late = [shuffled.index(name) for name in NAMES[20:]]
    assert told(late, shuffled, TIMES_S[order]) == [("s20", "s29")]
    assert told(late, shuffled, np.full(30, np.nan)) == [], "without times the rows count"


def left_out(where, what, size=0.01, rivals=()):
    blunder = SimpleNamespace(
        group=Group("joints" if what == JOINTS else "scan", where, what),
        leading=lambda: (size, 1e-4, "m", "x"),
        possible=True,
    )
    return SimpleNamespace(blunder=blunder, rivals=rivals)


def test_a_sentence_tells_from_when_on_how_much_at_most_and_what_else_it_may_be():
    source = SimpleNamespace(recording=SimpleNamespace(stops=NAMES, time_s=TIMES_S, name="rec"))
    rivals = {name: [Group("joints", name, JOINTS)] for name in NAMES[12:]}
    found = [left_out(n, SCAN, 0.02 if n == "s17" else 0.01, rivals[n]) for n in NAMES[11:20][1:]]
    found += [left_out("s02", SCAN), left_out("s05", JOINTS)]
    (one,) = lasting(found, [Group("scan", name, SCAN) for name in NAMES], [source])
    assert one["without"] == [f"{name}:scan" for name in NAMES[12:20]]
    assert one["sentence"].startswith(
        "At all 8 stops from s12 to s19 the scan is off, by 20 ± 0.1 mm at s17, against everything "
        "else; or it is the joints: nothing measured here tells them apart. This began between s11 "
        "and s12 and ended between s19 and s20: stops"
    )


@pytest.mark.parametrize("count", [6, 15])
def test_stops_at_which_nothing_was_seen_make_no_spell(count):
    """A body that is tracked for the first half of the session has mishaps in that half alone."""
    long = [f"s{k:03}" for k in range(60)]
    times_s = np.arange(60.0)
    source = SimpleNamespace(recording=SimpleNamespace(stops=long, time_s=times_s, name="rec"))
    looked_at = [Group("scan", name, SCAN) for name in long[:30]]
    rng, draws, told_of = np.random.default_rng(count), 400, 0
    for _ in range(draws):
        wrong = [left_out(long[k], SCAN) for k in rng.choice(30, count, replace=False)]
        told_of += bool([*lasting(wrong, looked_at, [source])])
    assert told_of <= draws * SO_BY_CHANCE + 2 * np.sqrt(draws * SO_BY_CHANCE)
    assert [*lasting([left_out(n, SCAN) for n in long[:30]], looked_at, [source])] == []
    assert [*lasting([left_out(n, SCAN) for n in long[22:30]], looked_at, [source])]


@pytest.mark.parametrize(("long", "rest"), [(30, 15), (60, 10)])
def test_what_is_left_beside_a_spell_is_no_spell_by_chance(long, rest):
    many = [f"s{k:03}" for k in range(2 * long if long == 30 else 100)]
    rng, draws, seconds = np.random.default_rng(long), 400, 0
    for _ in range(draws):
        beside = long + rng.choice(len(many) - long, rest, replace=False)
        found = told([*range(long), *beside], many, np.arange(float(len(many))))
        seconds += len(found) > 1
    assert seconds <= draws * SO_BY_CHANCE + 2 * np.sqrt(draws * SO_BY_CHANCE)


@pytest.mark.parametrize(
    ("first", "change", "words"),
    [
        (150, lambda q: q[:, [0, 1, 2, 5, 4, 3]], "columns of joint_4 and joint_6 were exchanged"),
        (150, lambda q: q * [1, 1, 1, 1, -1, 1], "joint_5 had the other sign"),
        (220, lambda q: q + np.array([0, 0, 0.1, 0, 0, 0]), "to p299, most of all at p"),
    ],
    ids=["exchanged", "sign", "zero"],
)
def test_check_tells_joints_that_are_read_otherwise_from_a_row_on(shared, first, change, words):
    rig, recording = opened(shared, "arm_base_creeps")
    late = replace(recording, joints=recording.joints.copy())
    late.joints[first:] = change(recording.joints[first:])
    (found,) = odd_bodies(rig, late)
    assert words in found.sentence and f"to {recording.stops[-1]}" in found.sentence
    assert len(found.stops) > 0.9 * (len(recording.stops) - first)
    assert set(found.stops) <= set(recording.stops[first:])


def test_check_tells_bodies_that_are_exchanged_from_a_row_on(shared):
    rig, recording = opened(shared, "known_nothing_hidden")
    swapped = changed(recording, BASE, slice(20, None), lambda p: recording.bodies[MOUNT][20:])
    swapped = changed(swapped, MOUNT, slice(20, None), lambda p: recording.bodies[BASE][20:])
    (found,) = odd_bodies(rig, swapped)
    assert "exchanged" in found.sentence and "from " in found.sentence
    assert set(found.stops) <= set(recording.stops[20:]) and len(found.stops) > 5
