"""What check sees of numbers that stand in another's place: rings of some scans, times of two."""

from dataclasses import replace

import pytest

from calib.rig import load_rig
from calib.rig.inventory import odd_times
from calib.rig.recording import Recording
from calib.rig.scanned import ScanSums, odd_scans
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
