"""Range zeros of rings that changed since an earlier run, which knows them well."""

import shutil
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from scipy.special import chdtrc

from calib.problem.prior import JointPrior
from calib.problem.unknowns import vector_unknown
from calib.recalibration.letgo import let_go
from calib.recalibration.newer import NewerData
from calib.recalibration.newer import tests as p_values_of
from calib.runs.belief import _another_rig
from calib.runs.calibrate import calibrate
from calib.runs.diagnose import diagnose

from .bumps import bumped

RING = 11


def rings_then_and_now(shift, seed, count=64):
    """What was known of range zeros of rings, in sigmas of a recording, and what another recording
    says where they have changed by a shift (count,)."""
    rng, wide = np.random.default_rng(seed), 1e3
    truth = rng.normal(size=count)
    first, second = truth + rng.normal(size=count), truth + shift + rng.normal(size=count)
    rings = vector_unknown(
        "rings",
        np.full(count, wide),
        dofs=map(str, range(count)),
        units=["m"] * count,
        of_members=True,
    )
    prior = JointPrior([rings], {"rings": first}, np.eye(count))
    return prior, NewerData(np.eye(count), second - first, np.zeros((count, count)))


def link_of_rings(shift, seed):
    prior, data = rings_then_and_now(shift, seed)
    return let_go(prior, data.fitted)[0]


def test_what_all_rings_have_changed_by_is_found_among_many():
    """Of 64 rings a common change of 1.5 sigmas is little for each; it is 8.5 of their mean's."""
    links = [link_of_rings(np.full(64, 1.5), seed) for seed in range(20)]
    assert all(link.moved and link.of_mean for link in links)
    z = [(link.of_mean[0] - 1.5) / link.of_mean[1] for link in links]
    assert abs(np.mean(z)) < 3 / np.sqrt(20) and 0.6 < np.std(z) < 1.4
    assert links[0].of_mean[1] == pytest.approx(np.sqrt(2 / 64), rel=1e-3)


def test_a_ring_that_changed_by_itself_is_told_by_itself():
    link = link_of_rings(12.0 * np.eye(64)[5], 1)
    assert link.moved and not link.of_mean
    assert np.argmax(np.abs(link.change) / link.sigma) == 5


def test_one_ring_among_many_is_not_lost_in_them():
    """A change of 6.4 sigmas of one of 64 is little for all of them together."""
    worlds = [rings_then_and_now(9.0 * np.eye(64)[5], seed) for seed in range(20)]
    together = [chdtrc(64, np.square(data.right).sum() / 2.0) for _, data in worlds]
    assert np.median(together) > 1e-4
    assert np.median([p_values_of(*world)["rings"] for world in worlds]) < 1e-6


def erring_together(data):
    """A fit to such data whose intervals take what it leaves of them for rows that err together."""

    def fit(held):
        now = data.fitted(held)
        gain = now.graph @ data.information
        left = np.linalg.solve(data.information, data.right) - now.change
        return now._replace(covariance=now.graph + gain @ np.diag(np.square(left)) @ gain.T)

    return fit


def test_a_change_is_not_hidden_by_the_residuals_that_it_leaves():
    """These widen the test of a fit that holds what was known; not of one that lets it go."""
    prior, data = rings_then_and_now(12.0 * np.eye(64)[5], 1)
    fit = erring_together(data)
    assert p_values_of(prior, NewerData.of(prior, fit(prior)))["rings"] > 0.1
    assert let_go(prior, fit)[0].moved
    still = (rings_then_and_now(np.zeros(64), seed) for seed in range(100))
    assert sum(let_go(p, erring_together(d))[0].moved for p, d in still) <= 3


def test_half_of_the_rings_are_not_all():
    """Though their mean has changed as well."""
    links = [link_of_rings(np.repeat([3.0, 0.0], 32), seed) for seed in range(5)]
    assert all(link.moved and not link.of_mean for link in links)


def test_several_looks_at_rings_alarm_no_more_often_than_one():
    worlds = (rings_then_and_now(np.zeros(64), seed) for seed in range(600))
    p = np.array([p_values_of(*world)["rings"] for world in worlds])
    for level in (0.02, 0.1):
        assert np.mean(p <= level) < level + 3 * np.sqrt(level / 600)
    assert np.mean(p <= 0.1) > 0.05


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
