"""Turns of a LiDAR given to stops, by time or by name, and written stop by stop."""

import numpy as np
import pytest

from calib.intake import scans, targets
from calib.outputs.parts import Kept
from chains.errors import InputError
from sensors.readers.base import Spheres, Sweep, Sweeps, Track
from sensors.recording import read_table
from sensors.stops import POSE

STOPS = ("a", "b", "c")
SPANS = np.array([[0.0, 1.0], [2.0, 3.0], [5.0, 6.0]])


def turns(time_s, name="top", first=0):
    """Turn k has k + 1 points, all with intensity k."""

    def read(wanted):
        for k in np.flatnonzero(wanted):
            points = {axis: np.full(k + 1, 1.0, np.float32) for axis in "xyz"}
            points |= {n: np.zeros(k + 1, np.uint16) for n in ("ring", "column")}
            points["intensity"] = np.full(k + 1, first + k, np.float32)
            yield Sweep(time_s[k], points)

    return Sweeps(name, name, np.asarray(time_s, float), read)


def write(folder, share):
    folder.parent.mkdir(exist_ok=True)
    return scans.write(folder, STOPS, share, Kept(folder.with_name("kept")), lambda *a: None)


def written(folder, share):
    write(folder, share)
    return {path.stem: read_table(path) for path in folder.iterdir()}


def test_turns_belong_to_the_hold_in_which_their_middle_lies(tmp_path):
    share, odd = scans.by_time([turns([0.5, 0.9, 1.5, 2.0, 3.0, 5.5])], SPANS)
    found = written(tmp_path / "scans", share)
    assert not odd and found.keys() == {"a", "b", "c"}
    assert sorted(set(found["a"]["intensity"])) == [0, 1]
    assert sorted(set(found["b"]["intensity"])) == [3, 4]
    assert found["b"]["scan"].tolist() == [0] * 4 + [1] * 5
    assert "scan" not in found["c"]


def test_a_hold_that_two_files_share_is_one_scan(tmp_path):
    files = [turns([2.6, 2.8, 5.5], "late", 10), turns([0.5, 2.2, 2.4], "early")]
    found = written(tmp_path / "scans", scans.by_time(files, SPANS)[0])
    assert sorted(set(found["b"]["intensity"])) == [1, 2, 10, 11]
    assert sorted(set(found["b"]["scan"])) == [0, 1, 2, 3]


def test_holds_without_turns_are_said_and_none_is_refused():
    assert "2 of 3 holds" in scans.by_time([turns([0.5])], SPANS)[1][0]
    with pytest.raises(InputError, match="--clock-offset"):
        scans.by_time([turns([9.5])], SPANS)


def test_scans_of_an_import_that_was_killed_are_not_read_again(tmp_path):
    """From several files, of which the second fails in its last turn."""
    files = [turns([0.5, 0.9, 2.5], "early"), turns([2.6, 5.5, 5.6], "late", 10)]
    share, _ = scans.by_time(files, SPANS)
    whole = written(tmp_path / "whole/scans", share)
    asked = []

    def failing(one, at):
        def read(wanted):
            for k, sweep in zip(np.flatnonzero(wanted), one.read(wanted), strict=True):
                asked.append((one.name, int(k)))
                if (one.name, k) == at:
                    raise KeyboardInterrupt
                yield sweep

        return Sweeps(one.name, one.clock, one.time_s, read)

    def read_from(at):
        asked.clear()
        return [(failing(one, at), stop) for one, stop in share]

    with pytest.raises(KeyboardInterrupt):
        write(tmp_path / "cut/scans", read_from(("late", 2)))
    (tmp_path / "cut/scans").rename(tmp_path / "gone")
    found = written(tmp_path / "cut/scans", read_from(None))
    assert asked == [("late", 1), ("late", 2)]  # the last hold's
    assert found.keys() == whole.keys() == set(STOPS)
    for stop, columns in whole.items():
        for name, values in columns.items():
            np.testing.assert_array_equal(found[stop][name], values)


def test_times_that_go_back_are_refused(tmp_path):
    """A stop's turns would be two scans of one name."""
    share, _ = scans.by_time([turns([0.5, 2.5, 0.9])], SPANS)
    with pytest.raises(InputError, match=r"turns of stop a do not .* go back"):
        write(tmp_path / "scans", share)


def test_two_lidars_at_once_are_refused():
    with pytest.raises(InputError, match="--topic"):
        scans.by_time([turns([0, 2]), turns([1, 3], "rear")], SPANS)


def test_files_go_to_stops_by_name_or_in_order():
    nan = [np.nan]
    share, odd = scans.by_name([turns(nan, "c"), turns(nan, "a")], STOPS)
    assert [stop.tolist() for _, stop in share] == [[2], [0]] and not odd
    share, odd = scans.by_name([turns(nan, n) for n in ("p2", "p0", "p1")], STOPS)
    assert [stop.tolist() for _, stop in share] == [[2], [0], [1]] and "order of name" in odd[0]
    with pytest.raises(InputError, match="2 clouds have no time, and there are 3 stops"):
        scans.by_name([turns(nan, "p"), turns(nan, "q")], STOPS)
    with pytest.raises(InputError, match="cloud x is named after no stop"):
        scans.by_name([turns(nan, "a"), turns(nan, "x")], STOPS)


def test_targets_are_joined_by_name():
    centre = np.arange(12.0).reshape(4, 3)
    spheres = Spheres(("T1", "T2", "T3", "T4"), centre)
    points = [
        Track(
            name=f"{root}T{k}{mark}{part}",
            kind="point",
            clock="c",
            time_s=np.arange(3.0),
            names=POSE[:3],
            values=np.array([[k, 0, 2.0], [k, 0, 2.0], [np.nan] * 3]) - [0, 0, part == "lower"],
        )
        for k, root in ((1, ""), (2, "/"), (3, ""))  # topics of ROS begin with a slash
        for part, mark in (("upper", ":"), ("lower", " "))
    ]
    found, odd = targets.join(spheres, points)
    assert found["target"].tolist() == ["T1", "T2", "T3"] and "T4" in odd[0]
    assert found["faro_y"].tolist() == [1, 4, 7]
    assert found["upper_x"].tolist() == [1, 2, 3] and found["lower_z"].tolist() == [1, 1, 1]
    assert targets.join(spheres, points[:4])[0] is None
    assert targets.join(None, []) == (None, [])


def test_turns_without_any_point_are_told_and_a_recording_of_them_is_refused(tmp_path):
    """All returns were too near: the import ended well, with a folder of no scan."""

    def emptied(one, some):
        def read(wanted):
            for k, sweep in zip(np.flatnonzero(wanted), one.read(wanted), strict=True):
                none = {n: v[:0] for n, v in sweep.points.items()}
                yield Sweep(sweep.time_s, none) if k in some else sweep

        return Sweeps(one.name, one.clock, one.time_s, read)

    each = turns([0.5, 2.5, 5.5])
    share, _ = scans.by_time([emptied(each, {1})], SPANS)
    assert write(tmp_path / "some/scans", share) == ["stop b: turns without any point, so no scan"]
    share, _ = scans.by_time([emptied(each, {0, 1, 2})], SPANS)
    with pytest.raises(InputError, match="none of 3 turns"):
        write(tmp_path / "none/scans", share)
