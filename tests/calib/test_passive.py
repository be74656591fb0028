"""Joints that nothing reads: where they are is found from the tracker, and all else beside them."""

import json
import shutil

import numpy as np
import pandas as pd
import pytest
import yaml

import calib
from calib.diagnosis.formulas.arm import joint_tables
from calib.diagnosis.stand import Stand
from calib.problem import build
from calib.problem.model import Model, Source
from calib.problem.without import leave_out
from calib.results.check import check
from calib.results.sigmas import misfit
from calib.simulation import PRESETS, Spec, simulate
from calib.solve.fit import solve
from chains.errors import InputError

from .broken import cells

OFF_RAD = 0.03  # what hardware that is some mm and mrad off its drawing puts a start off by


def simulated(folder, *passive, seed=3, **changed):
    few = {"passive": passive, "occluded_share": 0, "locations": 4, "stops_per_location": 10}
    simulate(Spec(**{**PRESETS["arm-tracker"].model_dump(), **few, **changed}), folder, seed)
    return folder


def rewrite(folder, change):
    rig = yaml.safe_load((folder / "rig.yaml").read_text())
    change(rig)
    (folder / "rig.yaml").write_text(yaml.safe_dump(rig))


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """The same arm, all of its joints read, and two of them not."""
    folder = tmp_path_factory.mktemp("passive")
    both = ("joint_2", "joint_5")
    return simulated(folder / "read"), simulated(folder / "unread", *both)


def test_a_fit_begins_near_where_the_joints_were(folders):
    read, unread = (Source.open(folder).recording for folder in folders)
    away = np.abs(unread.joints - read.joints)
    assert 0 < away.max() < OFF_RAD and not away[:, [0, 2, 3, 5]].any()
    given = calib.Recording.open(folders[1]).joints
    assert np.isnan(given[:, [1, 4]]).all() and np.isfinite(given[:, [0, 2, 3, 5]]).all()


def only_the_tip(rig):
    rig["tracker"]["bodies"] = ["mount_markers"]
    del rig["frames"]["base_markers"]


@pytest.mark.parametrize(
    "passive",
    [
        ("joint_3",),
        ("joint_2", "joint_5"),
        ("joint_2", "joint_3"),
        ("joint_1",),
        ("joint_1", "joint_2"),
        ("joint_1", "joint_4"),
        ("joint_1", "joint_2", "joint_3"),
    ],
)
@pytest.mark.long
def test_where_the_base_stands_still_nothing_before_the_joints_need_be_seen(tmp_path, passive):
    """But for where the first joint's zero is, which goes with where the base stands."""
    read = Source.open(simulated(tmp_path / "read", seed=4, base_moves="never")).recording.joints
    folder = simulated(tmp_path / "rec", *passive, seed=4, base_moves="never")
    rewrite(folder, only_the_tip)
    off = Source.open(folder).recording.joints - read
    off[:, 0] = np.angle(np.exp(1j * (off[:, 0] - off[0, 0])))
    assert 0 < np.ptp(off, axis=0).max() < 2 * 1.5 * OFF_RAD
    assert np.abs(off[:, 1:]).max() < 3 * OFF_RAD


def test_a_fit_comes_to_the_same_optimum_where_the_first_joint_is_passive_too(tmp_path):
    """As from the joints that were there, to which a column leads it."""
    passive = ("joint_1", "joint_4")
    costs = []
    for name, given in (("rec", passive), ("led", ())):
        folder = simulated(tmp_path / name, *given, base_moves="never")
        rewrite(folder, only_the_tip)
        rewrite(folder, lambda rig: rig["arm"].update(passive=list(passive)))
        estimate = solve(build([Source.open(folder)], Model()))
        assert estimate.converged
        costs.append(estimate.cost)
    assert costs[0] == pytest.approx(costs[1], abs=1.0)


def test_a_single_marker_beyond_it_shows_a_joint(tmp_path):
    """The base is tracked, and of what the arm carries only where a marker is."""
    read = Source.open(simulated(tmp_path / "read", base_moves="never")).recording.joints
    folder = simulated(tmp_path / "rec", "joint_2", base_moves="never")
    table = pd.read_csv(folder / "stops.csv")
    turn = [f"mount_markers.q{part}" for part in "wxyz"]
    table.drop(columns=turn).to_csv(folder / "stops.csv", index=False)
    found = Source.open(folder).recording.joints
    assert 0 < np.abs(found - read).max() < OFF_RAD


def test_joints_and_parameters_come_out_within_their_sigmas(folders):
    read, unread = (Source.open(folder) for folder in folders)
    truth = json.loads((folders[1].parent / "unread.truth.json").read_text())["effects"]
    estimate = solve(build([unread], Model()))
    variables, z = estimate.problem.variables, []
    assert variables["arm_joint_offset"].dofs == ("joint_1", "joint_3", "joint_4", "joint_6")
    true = np.array(truth["arm_joint_offset"])
    off = estimate.values["arm_joint_offset"] - true[[0, 2, 3, 5]]
    z.append(off / np.sqrt(np.diag(estimate.covariance_of(["arm_joint_offset"]))))
    for k, stop in enumerate(unread.recording.stops):
        name = f"joints@{stop}"
        at = unread.recording.joints[k] + estimate.values[name]
        sigma = np.sqrt(np.diag(estimate.covariance_of([name])))
        # What encoders err by was drawn when the arm was simulated, at their sigma.
        both = np.hypot(sigma, unread.rig.sigma_joint_rad)
        z.append(((at - read.recording.joints[k] - true) / both)[[1, 4]])
    z = np.concatenate(z)
    assert np.abs(z).max() < 4.5 and np.sqrt(np.mean(np.square(z))) < 1.3
    assert 0.4 < misfit(estimate, calib.results.errors.Errors())["tracker"] < 1.2


def test_a_run_says_what_is_not_read_and_judges_stops_by_what_is_left(folders, tmp_path):
    run = calib.fit(folders[1], tmp_path / "run")
    rms = run.summary["rms_mm"]
    assert 0.7 < rms["held_out"] / rms["noise_floor"] < 1.3 and rms["noise_floor"] < 1.0
    why = {each["name"]: each["why"] for each in run.solution.not_estimated}
    assert "nothing reads this joint" in why["joint_2"] and "joint_5" in why
    found = calib.diagnose(run)
    assert found.verdict == "adequate" and not found.blunders


def test_a_check_says_which_joints_are_unread(folders):
    found = check(folders[1], graph=False)
    assert not found.suspects
    assert dict(found.contents)["joint_5"] == "read by nothing: estimated at each of 40 stops"
    assert not [odd for odd in found.odd if "joint_" in odd]


def test_a_column_of_a_passive_joint_is_where_its_estimate_begins(folders, tmp_path):
    folder = shutil.copytree(folders[0], tmp_path / "rec")
    rewrite(folder, lambda rig: rig["arm"].update(passive=["joint_2"]))
    cells("stops.csv", "joint_2", lambda q: q + 0.01)(folder)
    cells("stops.csv", "joint_2", lambda _: "", row=3)(folder)
    before, here = (Source.open(f).recording.joints[:, 1] for f in (folders[0], folder))
    off = here - before
    assert abs(off[3]) < OFF_RAD
    np.testing.assert_allclose(np.delete(off, 3), 0.01, atol=1e-12)
    assert solve(build([Source.open(folder)], Model())).converged


def test_what_makes_no_sense_of_passive_joints_is_refused(folders, tmp_path):
    folder = shutil.copytree(folders[1], tmp_path / "rec")
    with pytest.raises(InputError, match="no recording has that"):
        leave_out([Source.open(folder)], ["L00P01:joint_2"])
    rewrite(folder, lambda rig: rig["arm"].update(passive=["joint_22"]))
    with pytest.raises(
        InputError, match=r"rig\.yaml:\d+: arm\.passive\.0: joint 'joint_22'.*joint_2"
    ):
        Source.open(folder)
    rewrite(folder, lambda rig: rig["arm"].update(passive=["joint_2"]))
    with pytest.raises(InputError, match="column joint_5 is missing"):
        Source.open(folder)


def test_no_formula_is_sought_for_a_joint_that_nobody_read(folders, tmp_path):
    """All that it is off by is in its readings, which are free. One that was not read at a single
    stop has its formula: that stop hardly counts."""
    (source,) = leave_out([Source.open(folders[1])], ["L00P01:joint_3"])
    problem = build([source], Model())
    tables = dict(joint_tables(Stand([source], Model(), problem, solve(problem))))
    assert set(tables) == {f"joint_{i}" for i in (1, 3, 4, 6)}
    sigma = tables["joint_3"].sigma_m
    assert np.sum(sigma > 0.1) == 1 and np.sum(sigma < 0.01) == 39


@pytest.mark.parametrize(
    "passive",
    [("joint_2",), pytest.param(("joint_1", "joint_3", "joint_5"), marks=pytest.mark.long)],
)
def test_a_scan_tells_where_joints_were_whose_body_was_not_seen(tmp_path, passive):
    """The optimum is that of the same recording in which the body was seen at these stops, too."""
    scanned = {**PRESETS["tiny"].model_dump(), "passive": passive, "occluded_share": 0}
    simulate(Spec(**scanned), tmp_path / "rec", seed=22)
    seen = solve(build([Source.open(tmp_path / "rec")], Model()))
    table = pd.read_csv(tmp_path / "rec/stops.csv")
    untold = [0, 4, 5, 10]
    table.loc[untold, [c for c in table if c.startswith("mount_markers.")]] = np.nan
    table.to_csv(tmp_path / "rec/stops.csv", index=False)
    source = Source.open(tmp_path / "rec")
    estimate = solve(build([source], Model()))
    assert estimate.converged
    whole = seen.problem.sources[0].recording.joints
    for k in untold:
        name, missing = f"joints@{source.recording.stops[k]}", [int(j[-1]) - 1 for j in passive]
        was = (whole[k] + seen.values[name])[missing]
        off = (source.recording.joints[k] + estimate.values[name])[missing] - was
        sigma = np.sqrt(np.diag(estimate.covariance_of([name])))[missing]
        assert np.abs(off).max() < 4 * sigma.max() < 0.02
    assert np.abs(source.recording.joints - whole)[untold].max() > 20 * OFF_RAD
