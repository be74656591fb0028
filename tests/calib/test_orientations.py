"""Errors of orientations: as large as angles are, and counted where models are compared."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.problem import build
from calib.problem.model import Model, Source
from calib.results.errors import body_errors, held_out_size, judged_mm
from calib.runs.add import add
from calib.runs.calibrate import calibrate
from calib.runs.diagnose import diagnose
from calib.show.comparison import print_comparison

from . import arm_worlds
from .arm_worlds import TRACKER_M, TRACKER_RAD

POSES = 120
RATIO = 5e-4  # of the last joint, whose axis passes 36 mm from the tool


@pytest.fixture(scope="module")
def worlds(tmp_path_factory):
    """An arm as it reads, and one whose last joint's gear ratio is off, which turns the tool by up
    to 1.3 mrad, six sigmas, and moves it by up to 0.05 mm, one."""
    rng = np.random.default_rng(7)
    folder = tmp_path_factory.mktemp("arms")
    world = arm_worlds.bent(folder / "right", "stanford", rng)
    (folder / "off").mkdir()
    (folder / "off" / "arm.urdf").write_bytes((folder / "right" / "arm.urdf").read_bytes())
    q = world.draw(rng, POSES)
    T = world.seen(q) * arm_worlds.exp(arm_worlds.noise(rng, POSES))
    arm_worlds.save(folder / "right", world, q, T)
    arm_worlds.save(folder / "off", world, q * [1, 1, 1, 1, 1, 1 + RATIO], T)
    return folder


@pytest.fixture(scope="module")
def runs(worlds, tmp_path_factory):
    out = tmp_path_factory.mktemp("runs")
    return {name: calibrate([worlds / name], out / name) for name in ("right", "off")}


@pytest.fixture(scope="module")
def told(runs):
    return {name: diagnose(run) for name, run in runs.items()}


def test_they_are_the_angles_between_what_is_tracked_and_predicted(worlds):
    problem = build([Source.open(worlds / "off")], Model())
    (block,), values = problem.bodies, problem.initial
    errors = body_errors([block], values, None)
    apart = np.linalg.inv(block.predicted(values)) @ block.measured
    angle = Rotation.from_matrix(apart[:, :3, :3]).magnitude()
    moved = np.linalg.norm(apart[:, :3, 3], axis=1)
    assert errors.turned.rms == pytest.approx(np.sqrt(np.mean(angle**2)))
    assert errors.rms_mm == pytest.approx(1e3 * np.sqrt(np.mean(moved**2)))
    lever = TRACKER_M / TRACKER_RAD
    np.testing.assert_allclose(errors.each_m2, moved**2 + (lever * angle) ** 2)
    assert errors.size.judged_mm == pytest.approx(1e3 * np.sqrt(np.mean(errors.each_m2)))
    assert errors.turned.floor == pytest.approx(np.sqrt(3) * TRACKER_RAD)
    assert errors.size.floor_mm == pytest.approx(1e3 * np.sqrt(6) * TRACKER_M)


def test_what_scatters_beside_the_sigmas_weighs_neither_kind_otherwise(worlds):
    (block,) = build([Source.open(worlds / "off")], Model()).bodies
    wider = block.scattering("rad", 1e-3)
    assert wider.sigma_rad > 5 * block.sigma_rad
    assert wider.turns_at_m == pytest.approx(block.turns_at_m) == TRACKER_M / TRACKER_RAD


def test_a_point_has_none(worlds):
    problem = build([Source.open(worlds / "off")], Model())
    point = replace(problem.bodies[0], is_point=True)
    errors = body_errors([point], problem.initial, None)
    assert not errors.turned.count and errors.size.turned_mrad is None
    assert errors.size.judged_mm == errors.size.rms_mm == errors.rms_mm
    assert errors.size.floor_mm == errors.floor_mm


def test_of_a_right_model_they_are_as_expected(runs):
    """Of 24 poses with 3 angles each the ratio scatters by 6 %."""
    turned = runs["right"].summary["rms_mrad"]
    assert 0.8 < turned["held_out"] / turned["noise_floor"] < 1.2
    assert 0.3 < turned["fit"] < turned["nominal"]


def test_an_effect_that_turns_and_hardly_moves_is_named(runs, told, tmp_path):
    assert told["right"].verdict == "adequate", told["right"].sentences
    off = told["off"]
    assert off.verdict == "missing_effect" and off.worth_adding == ["arm_joint_scale"]
    (named,) = (c for c in off.candidates if c["step"])
    moved, turned = (named[f"held_out_rms_{unit}"] for unit in ("mm", "mrad"))
    assert turned["after"] < 0.6 * turned["before"] and moved["after"] > 0.9 * moved["before"]
    ends = "from {before:.2f} to {after:.2f} mrad".format(**turned)
    assert f"and, of orientations, {ends}" in off.sentences[0]


def test_with_it_they_are_as_expected_and_runs_show_it(runs, tmp_path, capsys):
    before, grown = runs["off"].summary, add(runs["off"], ["arm_joint_scale"], tmp_path / "grown")
    turned = grown.summary["rms_mrad"]
    assert 0.8 < turned["held_out"] / turned["noise_floor"] < 1.2
    sizes = held_out_size(before), held_out_size(grown.summary)
    assert [s.turned_mrad for s in sizes] == [before["rms_mrad"]["held_out"], turned["held_out"]]
    assert judged_mm(grown.summary)["held_out"] == sizes[1].judged_mm < 0.7 * sizes[0].judged_mm
    print_comparison([runs["off"], grown])
    fall = " -> ".join(f"{s.turned_mrad:.2f}" for s in sizes)
    assert fall in capsys.readouterr().out
