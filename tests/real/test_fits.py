"""The main job on real input, and on recordings made by an independent program."""

import json

import numpy as np
import pytest

from calib.effects import GEOMETRY
from calib.problem.model import Model
from calib.runs.calibrate import calibrate
from chains import se3

from ..thinned import thinned
from . import foreign

GEOMETRIC = Model(("arm_link_length", "arm_joint_offset", "arm_axis_tilt"))


@pytest.mark.long
def test_ur10(shared, tmp_path):
    """A geometric model takes the held-out position error of this arm from 0.7 to 0.4 mm."""
    recording = foreign.ur10("A", shared / "arms/ur10_tmac", tmp_path / "ur10", max_stops=2000)
    run = calibrate([recording], tmp_path / "run", GEOMETRIC)
    mean = run.summary["mean_mm"]
    assert mean["nominal"] > 0.6
    assert 0.25 < mean["held_out"] < 0.45
    # Ten times its repeatability is left: the sigmas are not to be believed as they stand.
    assert run.summary["misfit"]["tracker"] > 2
    # With the weights that rows had in the fit: a few wild ones widen no sigma.
    widened = run.summary["sigmas_widened_by"]
    assert 0.9 * run.summary["misfit"]["tracker"] < widened <= run.summary["misfit"]["tracker"]
    tied = {entry["name"]: entry["why"] for entry in run.solution.not_estimated}
    assert any("shoulder_pan_joint" in name for name in tied)


@pytest.mark.slow
def test_the_zeros_of_a_ur10_are_told_by_its_whole_geometry_and_not_by_its_tilts(shared, tmp_path):
    """Tilts of every axis take on what zeros of the wrist do; the geometry's are those that do not.
    It fits as well, with fewer numbers."""
    recording = foreign.ur10("A", shared / "arms/ur10_tmac", tmp_path / "ur10", max_stops=600)
    wrist, fit = {}, {}
    for model in (GEOMETRIC, Model(GEOMETRY)):
        run = calibrate([recording], tmp_path / "run", model, hold_out="none")
        wrist[model] = run.solution.shared.effects["arm_joint_offset"].sigma[3:5]
        fit[model] = run.summary["rms_mm"]["fit"]
    assert (wrist[Model(GEOMETRY)] < 2e-4).all()
    assert (wrist[GEOMETRIC] > 10 * wrist[Model(GEOMETRY)]).all()
    assert fit[Model(GEOMETRY)] < 1.01 * fit[GEOMETRIC]


def test_positioner(shared, tmp_path):
    """Two axes seen by a tracker: 0.4 mm, as others found."""
    source = shared / "arms/rosi_positioner_2axis"
    recording = foreign.rosi_positioner(source, tmp_path / "rosi")
    run = calibrate([recording], tmp_path / "run")
    assert 0.35 < run.summary["mean_mm"]["fit"] < 0.45


@pytest.mark.parametrize(("model", "thickest_mm"), [("qt64", 11.5), ("xt32", 5.1)])
def test_still_sweeps_prove_no_ring_offset(shared, tmp_path, model, thickest_mm):
    """From one pose planes are found and fitted, and ring offsets stay as unsure as they are."""
    recording = foreign.hesai(model, shared / "lidar/hesai_nebula", tmp_path / model)
    run = calibrate([recording], tmp_path / "run")
    assert 1.0 < run.summary["rms_mm"]["fit"] < thickest_mm
    sigma = run.solution.shared.effects["ring_range_offset"].sigma
    assert np.median(sigma) > 0.005


@pytest.mark.slow
def test_a_hidden_effect_does_not_pass_unseen(shared, tmp_path):
    """A range bias with incidence can hide in the surfaces: their errors then are past belief."""
    thinned(shared / "recordings/known_incidence", tmp_path / "rec", 2, 4)
    run = calibrate([tmp_path / "rec"], tmp_path / "run", hold_out="none")
    assert run.summary["misfit"]["reference"] > 3
    assert run.summary["sigmas_widened_by"] > 3


def test_a_recording_of_another_simulator(shared, tmp_path):
    """Links and rings within their sigmas of the truth, and the held-out error at its floor."""
    folder = shared / "recordings/known_nothing_hidden"
    thinned(folder, tmp_path / "rec", 1, 4)
    run = calibrate([tmp_path / "rec"], tmp_path / "run")
    truth = json.loads(folder.with_suffix(".truth.json").read_text())
    frames = truth["frames"] | {"faro": np.linalg.inv(truth["T_faro_opti"])}
    links = []
    for name, frame in run.solution.shared.frames.items():
        T = np.array(frames[name])
        turn = se3.log(se3.inverse(frame.T_parent_child) @ T)[:3]
        links += [turn / frame.sigma_rad, (T - frame.T_parent_child)[:3, 3] / frame.sigma_m]
    known = {
        "arm_link_length": "dlen",
        "arm_joint_offset": "joint_offset",
        "ring_range_offset": "ring_range_offset",
    }
    z = {}
    for name, key in known.items():
        effect = run.solution.shared.effects[name]
        told = effect.sigma > 0
        z[name] = (effect.estimate - np.array(truth[key]))[told] / effect.sigma[told]
    links = np.concatenate([*links, z["arm_link_length"], z["arm_joint_offset"]])
    rings = z["ring_range_offset"]
    assert np.mean(np.abs(links) < 1.96) > 0.85
    assert np.mean(np.abs(rings) < 1.96) > 0.85
    assert run.summary["sigmas_widened_by"] == 1.0
    rms = run.summary["rms_mm"]
    assert abs(rms["held_out"] / rms["noise_floor"] - 1.0) < 0.05
