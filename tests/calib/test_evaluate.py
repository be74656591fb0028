"""Evaluations against other ways to the same number: rays cast anew, every return one by one."""

import json
import shutil

import numpy as np
import pandas as pd
import pytest

from calib.evaluation import accuracy, evaluate
from calib.problem import build
from calib.problem.model import Model
from calib.runs.calibrate import calibrate
from calib.runs.run import Run
from calib.simulation import Spec
from calib.solve.estimate import values_of
from chains.errors import InputError
from sensors.recording import read_table

from .simulated import QUICK, made, rays

LEVEL = {"lidar": "hesai_pandarxt32", **QUICK, "sweeps": 8}


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """The same hold averaged and raw, and a run of each, fitted without effects of beams."""
    folder = tmp_path_factory.mktemp("evaluate")
    found = {}
    for kind in ("averaged", "raw"):
        made(folder / kind, Spec(**LEVEL, raw=kind == "raw"), seed=5)
        found[kind] = calibrate([folder / kind], folder / f"{kind}_run", hold_out="none")
    return found


@pytest.fixture(scope="module")
def evaluated(runs):
    """What evaluation.json says of the averaged run, and the table of its points."""
    found = evaluate(runs["averaged"])
    return found, pd.read_parquet(runs["averaged"].folder / "points.parquet")


def poses(run):
    """T_reference_lidar of every stop of a run, by name."""
    source, problem = problem_of(run)
    values = values_of(problem, run.state())
    return source, {scan.name: scan.pose(values) for scan in problem.scans}


def problem_of(run):
    from calib.runs.reopen import reopened

    sources = reopened(run)
    return sources[0], build(sources, Model.read(run.model, run.folder))


def test_accuracy_is_the_mean_size_of_normal_errors():
    rng = np.random.default_rng(0)
    error, spread = np.array([0.0, 0.3, -1.0, 4.0]), np.array([1.0, 1.0, 2.0, 0.5])
    drawn = error + spread * rng.standard_normal((400_000, 4))
    np.testing.assert_allclose(accuracy(error, spread), np.abs(drawn).mean(axis=0), rtol=5e-3)


def test_accuracy_of_a_single_return_is_its_size():
    np.testing.assert_allclose(accuracy(np.array([-0.02]), np.array([np.nan])), [0.02])


def test_raw_errors_are_those_of_rays_cast_anew(runs, evaluated):
    source, Ts = poses(runs["averaged"])
    for k, stop in enumerate(source.recording.stops):
        origin, direction, range_m = rays(source, k, Ts[stop])
        hits = source.reference.cast(origin, direction)
        error_m = (range_m - hits.range_m)[hits.triangle >= 0]
        points = evaluated[1].query("stop == @stop")
        assert len(points) == np.count_nonzero(hits.incidence_rad < np.radians(89))
        flat = hits.incidence_rad[hits.triangle >= 0] < np.radians(89)
        np.testing.assert_allclose(points["raw_signed_error_m"], error_m[flat], atol=1e-6)


def test_ring_offsets_are_what_the_correction_takes_off(runs, evaluated):
    rings = runs["averaged"].solution.shared.effects["ring_range_offset"].estimate
    points = evaluated[1]
    taken_m = points["raw_signed_error_m"] - points["signed_error_m"]
    np.testing.assert_allclose(taken_m, rings[points["ring"]], atol=1e-6)


def test_corrected_points_lie_where_their_error_says(runs, evaluated):
    """The distance from a point to the sensor's origin, less its error, is the surface's."""
    _, Ts = poses(runs["averaged"])
    points = evaluated[1]
    at = np.stack([Ts[stop][:3, 3] for stop in points["stop"]])
    away_m = np.linalg.norm(points[["x_m", "y_m", "z_m"]].to_numpy() - at, axis=1)
    beam_m = (
        points["distance_m"] + points["signed_error_m"]
    )  # this LiDAR's beams start in its origin
    np.testing.assert_allclose(away_m, beam_m, atol=2e-4)


def test_sums_are_those_of_all_returns_one_by_one(evaluated):
    found, points = evaluated
    n, e, s = (points[c].to_numpy(float) for c in ("count", "signed_error_m", "precision_m"))
    mean = np.average(e, weights=n)
    # Of n returns with mean e and standard deviation s, the squares add up to n e2 + (n - 1) s2.
    std = np.sqrt(np.sum(n * e**2 + (n - 1) * np.nan_to_num(s) ** 2) / n.sum() - mean**2)
    assert found["returns"] == n.sum()
    assert found["signed_error_mm"]["mean"] == pytest.approx(1e3 * mean, rel=1e-5)
    assert found["signed_error_mm"]["std"] == pytest.approx(1e3 * std, rel=1e-5)
    assert found["precision_mm"] == pytest.approx(1e3 * np.nanmean(s), rel=1e-5)
    accuracy_m = np.average(points["accuracy_m"].to_numpy(float), weights=n)
    assert found["accuracy_mm"] == pytest.approx(1e3 * accuracy_m, rel=1e-5)


@pytest.mark.parametrize("covariate", ["ring", "incidence_deg", "distance_m", "label"])
def test_bins_add_up_to_the_whole(evaluated, covariate):
    found, _ = evaluated
    rows = found["by"][covariate]
    n = np.array([row["n"] for row in rows])
    assert n.sum() == found["returns"]
    total = np.sum(n * [row["mean_mm"] for row in rows]) / n.sum()
    assert total == pytest.approx(found["signed_error_mm"]["mean"], abs=1e-6)
    assert [row["value"] for row in rows] == sorted(row["value"] for row in rows)


def test_a_bin_holds_what_lies_in_it(evaluated):
    found, points = evaluated
    row = max(found["by"]["incidence_deg"], key=lambda row: row["n"])
    angle = np.degrees(points["incidence_rad"])
    inside = points[(angle >= row["value"] - 2.5) & (angle < row["value"] + 2.5)]
    assert row["n"] == inside["count"].sum()


def test_a_hold_says_the_same_raw_or_averaged(runs):
    """Averaging loses which return was which, and no mean or spread over them."""
    both = [evaluate(runs[kind]) for kind in ("averaged", "raw")]
    assert both[0]["returns"] == pytest.approx(both[1]["returns"], rel=5e-3)  # some are outliers
    for key in ("accuracy_mm", "precision_mm"):
        assert both[0][key] == pytest.approx(both[1][key], rel=0.02)


def test_errors_of_returns_one_by_one_scatter_as_the_sums_say(runs):
    run = runs["raw"]
    found = evaluate(run)
    points = pd.read_parquet(run.folder / "points.parquet").set_index(["stop", "ring", "column"])
    errors = []
    for stop in run_stops(run):
        table = pd.DataFrame(read_table(run.recordings[0] / "scans" / f"{stop}.parquet"))
        table["range_m"] = np.linalg.norm(table[["x", "y", "z"]], axis=1)
        keyed = table.assign(stop=stop).set_index(["stop", "ring", "column"])
        both = keyed.join(points[["raw_signed_error_m", "distance_m", "count"]], how="inner")
        error_m = both["range_m"] - both["distance_m"]
        # The returns that the average set aside as outliers are no part of the hold.
        errors.append(error_m[np.abs(error_m - both["raw_signed_error_m"]) < 0.012])
    errors = 1e3 * np.concatenate(errors)
    raw = evaluate(run, raw=True)
    assert raw["signed_error_mm"]["mean"] == pytest.approx(errors.mean(), abs=0.1)
    assert raw["signed_error_mm"]["std"] == pytest.approx(errors.std(), rel=0.02)
    assert raw["accuracy_mm"] == pytest.approx(np.abs(errors).mean(), rel=0.02)
    assert not raw["corrected"] and found["corrected"]


def run_stops(run):
    return [path.stem for path in (run.recordings[0] / "scans").glob("*.parquet")]


def test_the_cloud_lies_as_far_from_the_mesh_as_trimesh_says(runs, evaluated):
    import trimesh

    source, _ = problem_of(runs["averaged"])
    mesh = trimesh.Trimesh(source.reference.vertices_m, source.reference.triangles, process=False)
    some = evaluated[1].iloc[::40]
    _, away_m, _ = trimesh.proximity.closest_point_naive(mesh, some[["x_m", "y_m", "z_m"]])
    ours = source.reference.distance_m(some[["x_m", "y_m", "z_m"]].to_numpy(float))
    np.testing.assert_allclose(ours, away_m, atol=2e-6)


def test_points_are_found_by_sensor_location_and_stop(runs, evaluated):
    _, points = evaluated
    recording = problem_of(runs["averaged"])[0].recording
    assert set(points["sensor"]) == {"hesai_pandarxt32"}
    where = dict(zip(recording.stops, recording.location, strict=True))
    assert all(
        where[s] == at for s, at in set(zip(points["stop"], points["location"], strict=True))
    )
    assert set(points["stop"]) == set(recording.stops)


def test_what_is_written_is_what_is_returned(runs, tmp_path):
    found = evaluate(runs["averaged"], tmp_path / "out", raw=True)
    assert json.loads((tmp_path / "out/evaluation.json").read_text()) == found


def test_a_run_without_a_lidar_cannot_be_evaluated(tmp_path):
    spec = Spec(lidar=None, mesh=False, targets=0, locations=2, stops_per_location=4)
    made(tmp_path / "rec", spec)
    run = calibrate([tmp_path / "rec"], tmp_path / "run", hold_out="none")
    with pytest.raises(InputError, match="no scans, so there is no LiDAR to evaluate"):
        evaluate(run)


def test_a_recording_that_has_gone_is_said(runs, tmp_path):
    without = shutil.ignore_patterns("evaluation.json", "points.parquet")
    run = Run.open(shutil.copytree(runs["averaged"].folder, tmp_path / "run", ignore=without))
    run.model["recordings"][0]["path"] = str(tmp_path / "elsewhere")
    with pytest.raises(InputError, match=r"elsewhere, which .* is no longer there"):
        evaluate(run)
    assert not (run.folder / "evaluation.json").exists()
