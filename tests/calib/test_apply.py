"""Corrected clouds against clouds that never were wrong, and against the room they are of."""

import csv
import shutil

import numpy as np
import pytest

from calib.effects import find
from calib.evaluation.apply import apply
from calib.evaluation.correction import Correction, incidence
from calib.problem.model import Model, Source
from calib.runs.calibrate import calibrate
from calib.runs.run import Run
from calib.simulation import Spec
from chains.errors import InputError
from sensors.meshes import read_cloud, write_cloud
from sensors.recording import read_scan, read_table, write_table

from .simulated import EXACT, changed, made, off_mesh

WRONG = {"ring_range_offset": 1.0, "range_scale": 1.0, "ring_azimuth_offset": 1.0}


@pytest.fixture(scope="module")
def twins(tmp_path_factory):
    """One recording without any error, and its twin whose LiDAR lies in a known way."""
    folder = tmp_path_factory.mktemp("twins")
    spec = changed(EXACT, lidar="ouster_os0_128_rev6")
    clean, _ = made(folder / "clean", spec)
    wrong, truth = made(folder / "wrong", spec, **WRONG)
    return clean, wrong, truth


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    """A run on three locations of a recording with an incidence bias, and the fourth unseen."""
    folder = tmp_path_factory.mktemp("apply")
    spec = changed(EXACT, lidar="hesai_pandarqt64", locations=4, column_step=6, noise=1, room="box")
    whole, truth = made(folder / "whole", spec, seed=2, incidence_angle_bias=2.0)
    for name, kept in (("train", {"L00", "L01", "L02"}), ("unseen", {"L03"})):
        part(whole.recording.folder, folder / name, kept)
    model = Model(("ring_range_offset", "incidence_angle_bias"))
    return whole, truth, calibrate([folder / "train"], folder / "run", model, hold_out="none")


def part(recording, out, locations):
    """A copy of a recording with the stops of some locations."""
    shutil.copytree(recording, out)
    with open(recording / "stops.csv", newline="") as file:
        head, *rows = csv.reader(file)
    kept = [row for row in rows if row[head.index("location")] in locations]
    with open(out / "stops.csv", "w", newline="") as file:
        csv.writer(file).writerows([head, *kept])
    for row in rows:
        if row not in kept:
            (out / "scans" / f"{row[head.index('stop')]}.parquet").unlink()


def known(twins):
    """The correction by the errors that the twin is known to have."""
    _, wrong, truth = twins
    hidden = {name: np.array(theta) for name, theta in truth["effects"].items()}
    return Correction(wrong.rig, [(find(name), hidden[name]) for name in WRONG])


def test_what_is_known_of_a_lidar_is_taken_off(twins):
    """Range, azimuth and rings at once, back to the cloud of the twin that does not lie."""
    clean, wrong, _ = twins
    for k in range(2):
        true, read = clean.recording.scan(k), wrong.recording.scan(k)
        both = set(zip(true.ring, true.column, strict=True))
        same = [i for i, key in enumerate(zip(read.ring, read.column, strict=True)) if key in both]
        at = {key: i for i, key in enumerate(zip(true.ring, true.column, strict=True))}
        order = [at[read.ring[i], read.column[i]] for i in same]
        found = known(twins).apply(read.xyz_m, {"ring": read.ring})[same]
        before = np.linalg.norm(read.xyz_m[same] - true.xyz_m[order], axis=1)
        after = np.linalg.norm(found - true.xyz_m[order], axis=1)
        assert np.median(before) > 5e-3
        # A beam that is turned hits elsewhere; where it still does on one plane, nothing is left.
        assert np.median(after) < 2e-5


def test_a_correction_takes_the_estimates_of_its_run(fitted):
    run = fitted[2]
    effects = dict((e.name, theta) for e, theta in Correction.of(run).effects)
    for name, estimate in run.solution.shared.effects.items():
        if name in effects:
            np.testing.assert_array_equal(effects[name], estimate.estimate)
    assert set(effects) == {"ring_range_offset", "incidence_angle_bias"}


def test_incidence_is_told_by_neighbours(fitted):
    whole, truth, _ = fitted
    scan = whole.recording.scan(6)
    found = incidence(scan.xyz_m, whole.rig)
    _, hits = off_mesh(whole, truth, 6)
    told = np.isfinite(found) & (hits.incidence_rad < np.radians(75))
    assert told.mean() > 0.6
    off = np.degrees(np.abs(found - hits.incidence_rad)[told])
    assert np.median(off) < 2.0
    assert np.quantile(off, 0.9) < 8.0


def test_incidence_is_not_made_up_where_a_scan_is_thin(fitted):
    """Of few columns the neighbours of a point are those of its own, on a plane with the LiDAR."""
    whole, truth, _ = fitted
    scan = whole.recording.scan(6)
    columns = np.unique(scan.column)
    thin = np.isin(scan.column, columns[:: len(columns) // 20])
    found = incidence(scan.xyz_m[thin], whole.rig)
    _, hits = off_mesh(whole, truth, 6)
    told = np.isfinite(found)
    assert 0.05 < told.mean() < 0.9
    off = np.degrees(np.abs(found - hits.incidence_rad[thin])[told])
    assert np.quantile(off, 0.9) < 1.0


def test_no_incidence_is_told_of_scattered_points(fitted):
    cloud = np.random.default_rng(0).uniform(-3, 3, (2000, 3))
    assert np.isnan(incidence(cloud, fitted[0].rig)).mean() > 0.9


@pytest.mark.slow
def test_unseen_stops_come_closer_to_the_mesh_in_mean_and_spread(fitted, tmp_path):
    """By true poses, against the true mesh: the run saw neither."""
    _, truth, run = fitted
    unseen = run.folder.parent / "unseen"
    (done,) = apply(run, [unseen], tmp_path / "out")
    before, after = (errors_mm(Source.open(folder), truth) for folder in (unseen, done.path))
    assert abs(after.mean()) < 0.3 * abs(before.mean())
    assert after.std() < 0.9 * before.std()


def errors_mm(source, truth):
    """Measured less true range of all points of a recording, without mixed pixels."""
    found = [off_mesh(source, truth, k) for k in range(len(source.recording.stops))]
    error_m = np.concatenate([e[hits.triangle >= 0] for e, hits in found])
    return 1e3 * error_m[np.abs(error_m) < 0.1]


@pytest.mark.parametrize("suffix", [".ply", ".pcd", ".parquet"])
def test_a_cloud_keeps_every_field_and_every_point(fitted, tmp_path, suffix):
    whole, _, run = fitted
    table = read_table(whole.recording.folder / "scans" / f"{whole.recording.stops[6]}.parquet")
    table = {name: column.copy() for name, column in table.items()}
    table["ring"] = table["ring"].astype(np.float32)  # as many drivers have it
    table["x"][3] = np.nan
    table["y"][5] = table["x"][5] = table["z"][5] = 0.0
    table["near_infrared"] = np.arange(len(table["x"]), dtype=np.float32)
    read, write = (read_table, write_table) if suffix == ".parquet" else (read_cloud, write_cloud)
    write(tmp_path / f"cloud{suffix}", table)
    (done,) = apply(run, [tmp_path / f"cloud{suffix}"], tmp_path / "out")
    found = read(done.path)
    assert done.path.name == f"cloud{suffix}" and done.points == len(table["x"])
    assert found.keys() == table.keys()
    for name in table.keys() - {"x", "y", "z"}:
        np.testing.assert_array_equal(found[name], table[name], strict=True)
    for axis in "xyz":
        still = np.isclose(found[axis], table[axis], atol=1e-9, equal_nan=True)
        assert still[[3, 5]].all() and not still.all()


def test_of_its_own_recording_a_run_knows_the_mesh(fitted, tmp_path):
    """Range, incidence and label of what was met, so nothing is left uncorrected."""
    run = fitted[2]
    recording = run.recordings[0]
    (done,) = apply(run, [recording], tmp_path)
    stop = next((recording / "scans").iterdir()).name
    before, after = (read_scan(folder / "scans" / stop) for folder in (recording, done.path))
    assert done.left_out == {}
    assert np.linalg.norm(before.xyz_m - after.xyz_m, axis=1).max() > 1e-3
    assert (done.path / "rig.yaml").read_bytes() == (recording / "rig.yaml").read_bytes()


def test_what_stands_before_the_mesh_is_corrected_by_its_own_range(tmp_path):
    """Somebody at 1 m was taken for the wall 3 m behind him, in the run's own recording alone."""
    recording = made(tmp_path / "rec", "tiny", 3, range_scale=3.0)[0].recording.folder
    path = sorted((recording / "scans").iterdir())[0]
    table = read_table(path)
    xyz_m = np.stack([table[axis] for axis in "xyz"], axis=1)
    near = xyz_m[:40] / np.linalg.norm(xyz_m[:40], axis=1, keepdims=True)
    write_table(
        path, table | {a: np.append(near[:, k], table[a][40:]) for k, a in enumerate("xyz")}
    )
    run = calibrate([recording], tmp_path / "run", Model(("range_scale",)))
    shutil.copytree(recording, tmp_path / "copy")
    own, loose = (
        read_scan(apply(run, [some], tmp_path / out)[0].path / "scans" / path.name).xyz_m
        for some, out in ((recording, "own"), (tmp_path / "copy", "loose"))
    )
    scale = run.solution.part(None).effects["range_scale"].estimate[0]
    assert abs(scale) > 1e-3
    np.testing.assert_allclose(own[:40], near / (1.0 + scale), atol=2e-6)
    # A mixed pixel 50 mm before the mesh is not rejected, as ranges err by 10 mm here.
    np.testing.assert_allclose(own, loose, atol=3e-4)


def test_what_a_bare_cloud_does_not_tell_is_said(fitted, tmp_path):
    run = fitted[2]
    correction = Correction(fitted[0].rig, [(find("warmup_drift"), np.ones(1))])
    kept, why = correction.usable({"ring", "intensity"})
    assert kept.effects == [] and why == {"warmup_drift": "needs elapsed_s"}
    write_table(tmp_path / "cloud.parquet", {a: np.ones(9, np.float32) for a in "xyz"})
    (done,) = apply(run, [tmp_path / "cloud.parquet"], tmp_path / "out")
    assert done.left_out["ring_range_offset"] == "needs ring"


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda t: t.pop("y"), "column y is missing; a cloud has x, y and z in m"),
        (lambda t: t.update(ring=t["ring"] + 1), "ring 1 to 64, but hesai_pandarqt64 has 0 to 63"),
        (lambda t: t.update({a: 1e3 * t[a] for a in "xyz"}), "looks like millimetres; x, y and z"),
    ],
)
def test_a_cloud_that_is_none_is_refused(fitted, tmp_path, change, said):
    whole, _, run = fitted
    table = read_table(whole.recording.folder / "scans" / f"{whole.recording.stops[0]}.parquet")
    change(table)
    write_table(tmp_path / "cloud.parquet", table)
    with pytest.raises(InputError, match=said):
        apply(run, [tmp_path / "cloud.parquet"], tmp_path / "out")
    assert not (tmp_path / "out/cloud.parquet").exists()


def test_nothing_is_written_over(fitted, tmp_path):
    write_table(tmp_path / "cloud.parquet", {a: np.ones(9, np.float32) for a in "xyz"})
    with pytest.raises(InputError, match="would be written over"):
        apply(fitted[2], [tmp_path / "cloud.parquet"], tmp_path)


def test_a_rig_that_is_not_in_the_run_is_refused(fitted):
    with pytest.raises(InputError, match=r"--rig husky: .* has no such rig"):
        apply(fitted[2], [], "out", "husky")


def test_a_run_without_a_lidar_corrects_nothing(tmp_path):
    spec = Spec(lidar=None, mesh=False, targets=0, locations=2, stops_per_location=4)
    made(tmp_path / "rec", spec)
    run = calibrate([tmp_path / "rec"], tmp_path / "run", hold_out="none")
    with pytest.raises(InputError, match="this rig has no LiDAR"):
        Correction.of(Run.open(run.folder))


@pytest.mark.parametrize(
    ("was", "now", "said"),
    [
        ("name: husky-lwa4p", "name: other", "is of rig other-hesai_pandarqt64, and "),
        ("frame: lidar", "frame: lidar, beam_origin_m: [0.01, 0.02]", "(beam_origin_m) than that"),
        ("", "", None),
    ],
)
def test_a_recording_of_another_rig_is_told(fitted, tmp_path, was, now, said):
    whole, _, run = fitted
    other = shutil.copytree(whole.recording.folder.parent / "unseen", tmp_path / "unseen")
    text = (other / "rig.yaml").read_text()
    assert was in text
    (other / "rig.yaml").write_text(text.replace(was, now))
    (done,) = apply(run, [other], tmp_path / "out")
    assert [said in each for each in done.remarks] == ([True] if said else [])


def test_a_recording_of_another_lidar_is_refused(fitted, tmp_path):
    whole, _, run = fitted
    other = shutil.copytree(whole.recording.folder.parent / "unseen", tmp_path / "unseen")
    text = (other / "rig.yaml").read_text()
    (other / "rig.yaml").write_text(text.replace("hesai_pandarqt64", "ouster_os1_64"))
    with pytest.raises(InputError, match=r"unseen has .*64.*, and .*run is of .*; give a run of"):
        apply(run, [other], tmp_path / "out")
    assert not (tmp_path / "out").exists()
