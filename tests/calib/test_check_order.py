"""What check sees of numbers that stand in another's place, and of rows: rings of some scans, times
of two, and many rows that stand out."""

from dataclasses import replace

import numpy as np
import pytest

from calib.rig import load_rig
from calib.rig.inventory import odd_times
from calib.rig.recording import Recording
from calib.rig.scanned import ScanSums, odd_scans
from calib.rig.tracked import odd_bodies
from sensors.recording import read_scan


@pytest.fixture(scope="module")
def sound(shared):
    folder = shared / "recordings" / "known_nothing_hidden"
    return load_rig(folder), Recording.open(folder)


@pytest.mark.parametrize("by", [1, -2])
def test_rings_of_some_scans_that_are_numbered_otherwise(sound, by):
    """As by firmware that was updated, or a driver that dropped a ring."""
    rig, recording = sound
    paths = sorted((recording.folder / "scans").iterdir())[:5]
    sums = ScanSums(rig.lidar)
    for k, path in enumerate(paths):
        scan = read_scan(path, rig.lidar.rings)
        if k in (1, 3):
            ring = scan.ring + by
            there = (ring >= 0) & (ring < rig.lidar.rings)
            fields = ("xyz_m", "column", "intensity", "count", "range_std_m")
            cut = {name: getattr(scan, name)[there] for name in fields}
            scan = replace(scan, ring=ring[there], extra={}, **cut)
        sums.add(path.stem, scan)
    found = [one for one in odd_scans(rig, recording, sums) if "rings of the scans" in str(one)]
    (one,) = found
    assert one.stops == (paths[1].stem, paths[3].stem)
    assert f"are numbered {abs(by)} {'higher' if by > 0 else 'lower'} than those" in one.sentence


def test_two_times_that_are_exchanged(sound):
    _, recording = sound
    assert not [*odd_times(recording)]
    time_s = recording.time_s.copy()
    time_s[[3, 7]] = time_s[[7, 3]]
    (said,) = odd_times(replace(recording, time_s=time_s))
    assert f"but for {recording.stops[3]} and {recording.stops[7]}," in said


def test_a_clock_that_started_again(sound):
    """Rows of days that were written in another order step back as well, but do not overlap."""
    _, recording = sound
    at = len(recording.stops) // 2
    time_s = recording.time_s - np.where(np.arange(len(recording.stops)) < at, 0.0, 0.9) * (
        recording.time_s[at] - recording.time_s[0]
    )
    (said,) = odd_times(replace(recording, time_s=time_s))
    assert f"once, from {recording.stops[at - 1]} to {recording.stops[at]}," in said
    assert not [*odd_times(replace(recording, time_s=np.roll(recording.time_s, at)))]


@pytest.fixture
def arm(shared):
    folder = shared / "recordings" / "arm_axes_miss_each_other"
    return load_rig(folder), Recording.open(folder)


def with_rows_off(arm, count, of):
    """What bodies look like where some rows of the first stops are off."""
    rig, recording = arm
    (body,) = rig.tracker.bodies
    chance = np.random.default_rng(3)
    rows = chance.choice(of, count, replace=False)
    poses = recording.bodies[body].copy()
    far = chance.uniform(0.03, 0.1, (count, 1)) * np.eye(7)[chance.integers(0, 3, count)]
    poses[rows] += far
    poses[of:] = np.nan
    found = list(odd_bodies(rig, replace(recording, bodies={body: poses})))
    return body, {recording.stops[k] for k in rows}, found


@pytest.mark.parametrize(("count", "of"), [(3, 300), (2, 12), (5, 40)])
def test_a_few_rows_are_a_mishap_each(arm, count, of):
    _, stops, found = with_rows_off(arm, count, of)
    assert {one.stops[0] for one in found} == stops


def test_many_rows_are_said_once(arm):
    """What acts at all stops shows at some of them; a fit without these would hide it."""
    body, _, (found,) = with_rows_off(arm, 40, 300)
    assert found.startswith(f"at 40 of 300 stops, here and there, {body} is far from where")
