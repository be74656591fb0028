"""Intensity counts against the median of its recording, so that no maker's unit matters."""

import json
import shutil

import numpy as np
import pytest

from calib import effects
from calib.evaluation.apply import apply
from calib.problem import build
from calib.problem.model import Model, Source
from calib.runs.calibrate import calibrate
from calib.simulation import Spec, simulate
from sensors.recording import read_table, write_table

WALK = "intensity_range_walk"
SPEC = Spec(lidar="hesai_pandarxt32", locations=3, stops_per_location=2, column_step=200)
UNITS = {"reflectance": 1 / 128, "16 bits": 512.0}  # powers of 2, so that float32 keeps all digits


def scaled(folder, out, change):
    """A copy of a recording whose intensities (N,) are changed."""
    shutil.copytree(folder, out)
    for path in sorted((out / "scans").iterdir()):
        columns = read_table(path)
        columns["intensity"] = change(columns["intensity"]).astype(np.float32)
        write_table(path, columns)
    return out


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The same recording in several units, and a run of each."""
    folder = tmp_path_factory.mktemp("intensity")
    simulate(SPEC, folder / "counts", 5, {WALK: 2.0})
    for unit, by in UNITS.items():
        scaled(folder / "counts", folder / unit, lambda i, by=by: by * i)
    model = Model((*effects.DEFAULT, WALK, "noise_intensity"))
    names = ("counts", *UNITS)
    return folder, {n: calibrate([folder / n], folder / f"{n}-run", model) for n in names}


def test_a_run_is_the_same_in_every_unit(made):
    _, runs = made
    first, *others = (run.solution.shared.effects for run in runs.values())
    for other in others:
        for name in (WALK, "noise_intensity", "ring_range_offset"):
            np.testing.assert_allclose(other[name].estimate, first[name].estimate, atol=1e-9)
            np.testing.assert_allclose(other[name].sigma, first[name].sigma, rtol=1e-6)


def test_the_truth_of_a_simulation_is_what_is_found(made):
    folder, runs = made
    truth = truth_in(folder / "counts.truth.json")
    found = runs["counts"].solution.shared.effects
    (walk,), (sigma,) = found[WALK].estimate, found[WALK].sigma
    assert abs(walk - truth[WALK][0]) < 4 * sigma < abs(truth[WALK][0]) / 5
    off_m = np.mean(found["ring_range_offset"].estimate - truth["ring_range_offset"])
    assert abs(off_m) < 1e-3  # a median of 32 taken for 100 would make it 4.5 mm


def test_a_correction_is_the_same_in_every_unit(made, tmp_path):
    folder, runs = made
    clouds = []
    for name, run in runs.items():
        (done,) = apply(run, [folder / name], tmp_path / name)
        assert WALK not in done.left_out
        stop = min((done.path / "scans").iterdir())
        clouds.append(np.stack([read_table(stop)[axis] for axis in "xyz"], axis=1))
    for cloud in clouds[1:]:
        np.testing.assert_allclose(cloud, clouds[0], atol=1e-6)


def test_recordings_by_one_lidar_share_what_intensity_is_held_against(made, tmp_path):
    """Or they would not share its range zero: the median of a darker room is another one."""
    folder, _ = made
    darker = scaled(folder / "counts", tmp_path / "darker", lambda i: i / 2)
    sources = [Source.open(folder / "counts"), Source.open(darker)]
    own = [source.store.median_intensity for source in sources]
    assert own[1] == pytest.approx(own[0] / 2)
    for chosen, wanted in ((sources, np.mean(own)), (sources[:1], own[0])):
        problem = build(chosen, Model())
        for scan in problem.scans:
            seen = scan.rows(problem.initial).view["intensity"]
            np.testing.assert_allclose(seen, scan.store.read(scan.index)[0].intensity / wanted)


@pytest.mark.parametrize("change", [lambda i: i - 1000.0, lambda i: np.nan * i, lambda i: 0 * i])
def test_where_intensity_has_no_scale_nothing_hangs_on_it(made, tmp_path, change):
    """Decibels below zero, say."""
    folder, _ = made
    source = Source.open(scaled(folder / "counts", tmp_path / "odd", change))
    assert np.isnan(source.store.median_intensity)
    problem = build([source], Model())
    view = problem.scans[0].rows(problem.initial).view
    assert not effects.find(WALK).basis(view).any()


def truth_in(path):
    return json.loads(path.read_text())["effects"]
