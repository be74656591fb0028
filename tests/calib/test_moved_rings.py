"""One ring's range zero that changed since an earlier run, which knows it well."""

import shutil
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from calib.runs.belief import _another_rig
from calib.runs.calibrate import calibrate
from calib.runs.diagnose import diagnose

from .bumps import bumped

RING = 11


@pytest.fixture(scope="module")
def folder(once):
    """A rig before and after somebody bumped into its LiDAR, and runs of it."""
    return once(bumped)


def with_ring_longer(folder, by_m):
    """Of its LiDAR, whose beams begin at its origin."""
    for path in sorted((folder / "scans").glob("*.parquet")):
        table = pd.read_parquet(path)
        xyz = table[["x", "y", "z"]].to_numpy(float)
        longer = 1.0 + by_m / np.linalg.norm(xyz, axis=1)
        xyz = xyz * np.where(table["ring"] == RING, longer, 1.0)[:, None]
        table[["x", "y", "z"]] = xyz.astype(np.float32)
        table.to_parquet(path, index=False)
    return folder


@pytest.mark.parametrize(("moved", "told"), [(0, 9), (4, 9), (5, 9), (2, 2), (7, 9)])
def test_where_most_links_moved_it_is_asked_whether_it_is_the_same_rig(moved, told):
    links = [{"name": f"l{i}", "moved": i < moved, "p_value": 0.5} for i in range(told)]
    untold = {"name": "unseen", "moved": False, "p_value": None}
    asked = _another_rig(SimpleNamespace(summary={"links": [*links, untold]}))
    said = [f"{moved} of {told} links moved since the earlier run: was that a run of this rig?"]
    assert asked == (said if moved > 4 else [])
    assert not _another_rig(SimpleNamespace(summary={"links": None}))


@pytest.mark.slow
@pytest.mark.parametrize("mm", [3.0, 8.0])
def test_it_is_told_however_far_it_moved(folder, tmp_path, mm):
    """By little it is lost among all rings; by much its beams are rejected, as long as the earlier
    run holds it. The fit without that run says the same of it."""
    later = shutil.copytree(folder / "after", tmp_path / "after")
    with_ring_longer(later, 1e-3 * mm)
    run = calibrate([later], tmp_path / "run", hold_out="none", prior=folder / "a")
    links = {link["name"]: link for link in run.summary["links"]}
    assert {n for n, link in links.items() if link["moved"]} == {"lidar", "ring_range_offset"}
    rings = links["ring_range_offset"]
    z = np.array(rings["change"]) / np.array(rings["sigma"])
    assert np.abs(z).argmax() == RING and np.abs(np.delete(z, RING)).max() < 4
    off = np.array(rings["change"])[RING] - 1e-3 * mm
    assert abs(off) < 4 * rings["sigma"][RING] < 1e-3
    alone = calibrate([later], tmp_path / "alone", hold_out="none")
    now, fresh = (r.solution.shared.effects["ring_range_offset"] for r in (run, alone))
    assert abs(now.estimate[RING] - fresh.estimate[RING]) < fresh.sigma[RING]


@pytest.mark.long
def test_between_recordings_of_one_fit_it_is_told_and_nothing_beside_it(folder, tmp_path):
    """It had structure over whatever differed between the days."""
    later = shutil.copytree(folder / "after", tmp_path / "after")
    both = [folder / "before", with_ring_longer(later, 0.005)]
    found = diagnose(calibrate(both, tmp_path / "run"))
    names = {blunder["name"]: blunder for blunder in found.blunders}
    assert names.keys() == {"lidar", "ring_range_offset"}
    assert names["ring_range_offset"]["axis"] == f"ring_{RING:03d}"
    assert names["ring_range_offset"]["size"] == pytest.approx(0.005, abs=5e-4)
    assert not found.unexplained and not found.formulas and not found.scatter
