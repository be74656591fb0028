"""Where a model does not fit: the rows of trackers, targets and priors, one by one and by group."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pyarrow.dataset
import pyarrow.parquet as pq
import pytest
import yaml

from calib.problem import build
from calib.problem.model import Model, Source
from calib.results.errors import Errors
from calib.results.misfit import (
    InstrumentRows,
    instrument_rows,
    misfit_by,
    prior_rows,
    seen_rows,
    target_rows,
)
from calib.runs.calibrate import calibrate
from calib.show.comparison import print_comparison
from calib.show.misfit import misfit_warnings
from calib.solve.components.checks import Checks
from calib.solve.fit import solve

from . import arm_worlds, broken, rigs

SMALL = Model(("arm_joint_offset", "ring_range_offset"))


def arm_alone(folder):
    """A recording of an arm and a tracker, and of nothing else."""
    rigs.write(folder, seed=8, lidar=None, target=None, reference=None)
    (folder / "targets.csv").unlink()
    return folder


def fitted(folder, spoil=None, **changes):
    recording = rigs.write(folder / "rec", seed=8, **changes)
    if spoil:
        spoil(recording)
    return calibrate([recording], folder / "run", SMALL, "none")


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    return fitted(tmp_path_factory.mktemp("good"))


def ratios(run):
    """(stop, body) -> misfit."""
    stops = run.summary["misfit_by"]["stop"]
    return {(s, body): x for s, found in stops.items() for body, x in found["bodies"].items()}


def test_nothing_stands_out_where_nothing_is_wrong(good):
    found = good.summary["misfit_by"]
    assert set(found["stop"]) == set(rigs.STOPS)
    assert set(found["body"]) == {"base_markers", "mount_markers"}
    assert set(found["target"]) == {"t0", "t1", "t2", "t3"}
    for stop in found["stop"].values():
        assert stop["tracker"] < 2 and stop["joints"] < 2.5 and 0.5 < stop["beams"] < 1.5
    assert max(ratios(good).values()) < 2 and max(found["target"].values()) < 2
    assert all(each["move_sigmas"] < 4 for each in found["prior"].values())
    assert {"lidar", "mount", "arm_joint_offset.lift"} <= set(found["prior"])
    assert not any(name.startswith("ring_range_offset") for name in found["prior"])


def test_a_body_that_moved_at_one_stop_stands_out(tmp_path, good):
    moved = broken.cells("stops.csv", r"base_markers\.x", lambda x: x + 0.003, row=2)
    run = fitted(tmp_path, moved)
    found = ratios(run)
    assert max(found, key=found.get) == ("s2", "base_markers")
    assert found["s2", "base_markers"] > 4 > 2 > max(ratios(good).values())
    assert run.summary["misfit_by"]["body"]["base_markers"] > 2


def test_a_target_that_is_off_stands_out(tmp_path):
    run = fitted(tmp_path, broken.cells("targets.csv", "faro_x", lambda x: x + 0.02, row=1))
    found = run.summary["misfit_by"]["target"]
    assert max(found, key=found.get) == "t1" and found["t1"] > 5


def test_a_wrong_cad_value_moves_its_frame_by_many_of_its_sigmas(tmp_path):
    frames = rigs.drawing()["frames"]
    frames["lidar"]["xyz_m"] = [0.0, 0.01, -0.085]
    run = fitted(tmp_path, frames=frames)
    found = run.summary["misfit_by"]["prior"]
    lidar = found["lidar"]
    assert max(found, key=lambda name: found[name]["move_sigmas"]) == "lidar"
    assert lidar["worst"] == "tz" and lidar["unit"] == "m" and lidar["move_sigmas"] > 50
    assert 0.1 < lidar["change"] < 0.17  # the mount's CAD takes the rest
    assert lidar["move_sigmas"] == pytest.approx(abs(lidar["change"]) / lidar["sigma"])


def test_one_wild_row_widens_no_sigma_and_a_wrong_sigma_all_of_them(tmp_path, shared):
    """Of 1,495 poses one is 0.5 m off: it is told, and no other is less well known for it."""
    folder = tmp_path / "rec"
    shutil.copytree(shared / "recordings/arm_one_wild_row", folder, copy_function=shutil.copyfile)
    run = calibrate([folder], tmp_path / "run", hold_out="none")
    assert run.summary["misfit"]["tracker"] > 100 and run.summary["sigmas_widened_by"] == 1.0
    rig = yaml.safe_load((folder / "rig.yaml").read_text())
    for name in ("sigma_m", "sigma_rad"):
        rig["tracker"][name] = float(rig["tracker"][name]) / 5
    (folder / "rig.yaml").write_text(yaml.safe_dump(rig))
    run = calibrate([folder], tmp_path / "again", hold_out="none")
    assert 2 < run.summary["sigmas_widened_by"] < 6


@pytest.mark.parametrize(("sigma_joint_rad", "told"), [(2e-5, False), (2e-3, True)])
def test_a_sigma_that_is_far_too_large_is_told(tmp_path, sigma_joint_rad, told):
    """Encoders are a hundred times as good as rig.yaml says: all is better known than it seems."""
    rng = np.random.default_rng(3)
    world = arm_worlds.bent(tmp_path / "rec", "puma560", rng)
    read = world.draw(rng, 80)
    T = world.seen(read) * arm_worlds.exp(arm_worlds.noise(rng, 80))
    arm_worlds.save(tmp_path / "rec", world, read, T, {}, sigma_joint_rad)
    run = calibrate([tmp_path / "rec"], tmp_path / "run")
    said = " ".join(misfit_warnings(run.summary))
    assert ("times smaller than expected: a sigma in rig.yaml is too large" in said) is told


def of_cad(run):
    """Of frames in residuals.parquet: how far each moved in its sigmas, and its redundancy."""
    table = pq.read_table(run.folder / "residuals.parquet/_prior.parquet").to_pydict()
    mine = np.isin(table["unknown"], list(rigs.drawing()["frames"]))
    return (np.array(table[name])[mine] for name in ("whitened", "redundancy"))


def test_cad_that_contradicts_itself_widens_what_rests_on_it(tmp_path, good):
    """The LiDAR and the mount's markers sit on one mount, and nothing tells which of the two is 10
    sigmas off. The truth is then within a few of the sigmas told, and what does not rest on CAD is
    as well known as before."""
    frames = rigs.drawing()["frames"]
    frames["lidar"]["rpy_rad"][2] += 10 * frames["lidar"]["sigma_rad"]
    run = fitted(tmp_path, frames=frames)
    moved, redundancy = of_cad(run)
    times = np.sqrt(np.square(moved).sum() / redundancy.sum())
    assert run.summary["misfit"]["cad"] == pytest.approx(times, rel=1e-6)
    assert good.summary["misfit"]["cad"] < 1.2 and good.summary["cad_widened_by"] == 1.0
    wider = run.summary["cad_widened_by"]
    assert 1.5 < wider <= times and run.summary["sigmas_widened_by"] == 1.0
    before, after = (
        dict(zip(r.solution.names, np.sqrt(np.diag(r.solution.covariance)), strict=True))
        for r in (good, run)
    )
    assert after["lidar.rz"] == pytest.approx(wider * before["lidar.rz"], rel=0.05)
    rings = [name for name in after if name.startswith("ring_range_offset")]
    assert np.median([after[n] / before[n] for n in rings]) == pytest.approx(1.0, abs=0.05)
    graph = dict(zip(run.solution.names, np.sqrt(np.diag(run.solution.graph)), strict=True))
    assert graph["lidar.rz"] == pytest.approx(before["lidar.rz"], rel=0.1)


def test_redundancy_is_that_of_the_hat_matrix(tmp_path):
    """Against the projection of all rows, priors included, written out densely."""
    problem = build([Source.open(arm_alone(tmp_path / "rec"))], SMALL)
    estimate = solve(problem)
    start, at = 0, {}
    for unknown in problem.variables.values():
        at[unknown.name] = slice(start, start + unknown.dim)
        start += unknown.dim
    rows = []
    for block in problem.blocks:
        residual, d = block.evaluate(estimate.values, True)
        A = np.zeros((len(residual), start))
        for name, part in d.items():
            A[:, at[name]] = part
        rows.append(A)
    prior = np.diag(1 / np.concatenate([u.sigma for u in problem.variables.values()]))
    measured = np.vstack(rows)
    A = np.vstack([measured, prior])
    hat = np.einsum("ij,ji->i", A, np.linalg.solve(A.T @ A, A.T))
    tracker, known = seen_rows(estimate, "tracker"), prior_rows(estimate)
    np.testing.assert_allclose(tracker.redundancy, 1 - hat[: len(measured)], atol=1e-6)
    vectors = np.concatenate(
        [np.arange(s.start, s.stop) for n, s in at.items() if problem.variables[n].kind == "vector"]
    )
    np.testing.assert_allclose(known.redundancy, 1 - hat[len(measured) + vectors], atol=1e-6)
    # All rows have as much as they are more than the unknowns; priors of places say nothing.
    both = tracker.redundancy.sum() + known.redundancy.sum()
    assert both == pytest.approx(len(measured) + len(vectors) - start, abs=0.1)
    assert target_rows(estimate) is None


def test_what_nothing_checks_has_no_misfit():
    rows = InstrumentRows(
        names={"stop": np.array(["a", "a", "b"])},
        unit=np.full(3, "m"),
        sigma=np.ones(3),
        whitened=np.array([3.0, 0.0, 1e-5]),
        redundancy=np.array([0.5, 1.0, 1e-9]),
    )
    assert rows.misfit("stop") == {("a",): pytest.approx(np.sqrt(6)), ("b",): None}


def test_rows_can_be_found_in_the_run_and_readers_of_beams_pass_them_by(good):
    folder = good.folder / "residuals.parquet"
    hidden = {path.name for path in folder.glob("_*")}
    assert hidden == {"_tracker.parquet", "_target.parquet", "_prior.parquet"}
    beams = pyarrow.dataset.dataset(folder)
    assert {"ring", "residual_m"} <= set(beams.schema.names)
    assert beams.count_rows() == sum(pq.read_metadata(p).num_rows for p in folder.glob("[!_]*"))
    last = ["residual", "unit", "sigma", "whitened", "redundancy"]
    for kind, first, count in (
        ("tracker", ["recording", "stop", "body", "axis"], 4 * 2 * 6),
        ("target", ["recording", "target", "part", "axis"], 4 * 9),
        ("prior", ["recording", "stop", "unknown", "parameter"], None),
    ):
        table = pq.read_table(folder / f"_{kind}.parquet").to_pydict()
        assert list(table) == first + last
        assert count is None or len(table["sigma"]) == count
        residual, sigma, z = (np.array(table[name]) for name in ("residual", "sigma", "whitened"))
        np.testing.assert_allclose(residual, sigma * z)
    stops = {(s, u) for s, u in zip(table["stop"], table["unknown"], strict=True) if s}
    assert stops == {(stop, f"joints@{stop}") for stop in rigs.STOPS}


def test_a_tracker_row_is_measured_less_predicted(tmp_path):
    """One row off by 0.5 m, and a fit that holds all else: the row says so, in the body's axes."""
    recording = arm_alone(tmp_path / "rec")
    plain = solve(build([Source.open(recording)], SMALL))
    broken.cells("stops.csv", r"mount_markers\.z", lambda z: z + 0.5, row=1)(recording)
    problem = build([Source.open(recording)], SMALL)
    before, after = (seen_rows(e, "tracker") for e in (plain, _at(plain, problem)))
    change = after.table()["residual"] - before.table()["residual"]
    mine = (after.names["stop"] == "s1") & (after.names["body"] == "mount_markers")
    shift = mine & np.char.startswith(after.names["axis"], "t")
    assert np.linalg.norm(change[shift]) == pytest.approx(0.5)
    assert not change[~mine].any()


def _at(estimate, problem):
    """Another problem's rows at an estimate's state."""
    return replace(estimate, problem=problem)


def test_several_recordings_are_told_apart(tmp_path):
    folders = [rigs.write(tmp_path / f"rec{seed}", seed=seed) for seed in (4, 5)]
    run = calibrate(folders, tmp_path / "run", SMALL, "none")
    found = run.summary["misfit_by"]
    assert set(found["stop"]) == {f"box.{k}.{stop}" for k in (0, 1) for stop in rigs.STOPS}
    assert set(found["target"]) == {f"box.{k}.t{m}" for k in (0, 1) for m in range(4)}
    for stop in found["stop"].values():
        assert {"tracker", "bodies", "joints", "beams"} <= set(stop)


def test_all_beams_that_meet_a_surface_are_counted(good):
    parts = [pq.read_table(p) for p in (good.folder / "residuals.parquet").glob("[!_]*")]
    r, weight = (
        np.concatenate([part[name].to_numpy() for part in parts]).astype(float)
        for name in ("residual_m", "weight")
    )
    summary = json.loads((good.folder / "summary.json").read_text())
    assert summary["rejected_share"] == pytest.approx(np.mean(weight == 0))
    assert summary["rms_all_mm"] == pytest.approx(1e3 * np.sqrt(np.mean(r**2)), rel=1e-5)
    assert summary["rms_mm"]["fit"] == pytest.approx(
        1e3 * np.sqrt(np.mean(r[weight > 0] ** 2)), rel=1e-5
    )


def test_errors_add_up():
    a = Errors(2, 1.0, squares_m2=5.0, expected_m2=4.0, rejected=1, rejected_m2=16.0)
    both = a + Errors(1, 0.0, squares_m2=1.0, expected_m2=1.0)
    assert both == Errors(3, 1.0, squares_m2=6.0, expected_m2=5.0, rejected=1, rejected_m2=16.0)
    assert both.rejected_share == 0.25
    assert both.rms_all_mm == pytest.approx(1e3 * np.sqrt(22 / 4))
    assert Errors().rejected_share is None and Errors().rms_all_mm is None


def test_nothing_tracked_and_no_targets_leaves_what_is_known_of_beams(tmp_path):
    problem = build([Source.open(rigs.write(tmp_path / "rec", tracker=None, target=None))], SMALL)
    estimate = solve(problem)
    rows, beams = instrument_rows(estimate), {("box", "s1"): Errors(4, 0.0, 4.0, 1.0)}
    assert set(rows) == {"prior"}
    found = misfit_by(estimate, rows, beams)
    assert found["stop"]["s1"]["beams"] == 2 and found["body"] == found["target"] == {}


def test_bodies_and_targets_are_compared_the_worst_first(good, capsys):
    targets = {f"t{k:02d}": 1.0 + k for k in range(20)}
    found = good.summary["misfit_by"] | {"target": targets, "body": {"tool": 0.5}}
    print_comparison([good, replace(good, summary=good.summary | {"misfit_by": found})])
    compared = " ".join(capsys.readouterr().out.split())
    assert compared.index("target t19 20.00") < compared.index("target t08 9.00")
    assert "target t07" not in compared and "over sigma, tool" not in compared
    assert "more that are less" in compared and "in its sigmas, lidar" in compared


@pytest.mark.parametrize("times", [1.5, 120.0, 3000.0])
def test_rows_may_scatter_by_far_more_than_their_sigmas(times):
    """An encoder said to read to 0.1 mrad, on a joint that slips by 12."""
    grown = Checks.alone(times**2 * 300.0, 300.0).growth()
    assert np.sqrt(1.0 + grown) == pytest.approx(times, rel=1e-3)
