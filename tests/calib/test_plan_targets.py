"""Where targets should hang: what is promised of them, held against registrations of simulated
ones, and where they are put."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pandas as pd
import pytest

import calib
from calib.planning import planner_without_places, silent
from calib.planning.room.hanging import plan_targets
from calib.planning.room.targets import ROD_M, TARGET_CLEAR_M, each_target, known_with
from chains import se3
from chains.errors import InputError
from tests.worlds import World, write

WORLD = World(seed=3, locations=2, stops=5, beams=1200)
REGION = (-1.6, -1.2, 1.6, 1.2)


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """Of a small world."""
    folder = tmp_path_factory.mktemp("small") / "rec"
    write(WORLD, folder)
    return folder


@pytest.fixture(scope="module")
def rig(recording):
    """Of which nothing was measured yet."""
    folder = recording.parent / "rig"
    folder.mkdir()
    for name in ("rig.yaml", "arm.urdf"):
        shutil.copy(recording / name, folder)
    shutil.copytree(recording / "reference", folder / "reference")
    return folder


@pytest.fixture(scope="module")
def run(recording):
    """Its fit."""
    return calib.fit([recording], recording.parent / "run", hold_out="none")


def registered(spheres_m, spec, rng):
    """Twist (6,) by which the frame of a scanner is off, found by matching points: spheres that it
    saw, and where two markers above each say that they hang."""
    up = np.array([0.0, 0.0, 1.0])
    lower = spheres_m + spec.sphere_below_lower_marker_m * up
    upper = lower + ROD_M * up
    lower, upper = (p + spec.sigma_marker_m * rng.standard_normal(p.shape) for p in (lower, upper))
    seen = spheres_m + spec.sigma_sphere_m * rng.standard_normal(spheres_m.shape)
    down = (lower - upper).sum(axis=0)
    hung = lower + spec.sphere_below_lower_marker_m * down / np.linalg.norm(down)
    middle = hung.mean(axis=0), seen.mean(axis=0)
    U, _, V = np.linalg.svd((hung - middle[0]).T @ (seen - middle[1]))
    T = np.eye(4)
    T[:3, :3] = U @ np.diag([1.0, 1.0, np.linalg.det(U @ V)]) @ V
    T[:3, 3] = middle[0] - T[:3, :3] @ middle[1]
    return se3.log(T)


def test_the_frame_of_the_scanner_is_known_as_well_as_registrations_of_the_targets_scatter(rig):
    plan = plan_targets(rig, 5, region=REGION, candidates=100)
    spec = calib.rig.load_rig(rig).target
    rng = np.random.default_rng(0)
    twists = [registered(plan.spheres_m, spec, rng) for _ in range(3000)]
    mine = plan.after.sigma[[k for k, key in enumerate(plan.keys) if key.unknown == "faro"]]
    np.testing.assert_allclose(np.std(twists, axis=0), mine, rtol=0.06)


def test_what_targets_tell_adds_up_and_the_chosen_tell_most(run):
    planner = planner_without_places(run, "all", None, silent)
    scene, rng = planner.scene, np.random.default_rng(1)
    places = rng.uniform([-1.2, -1.0, 0.4], [1.2, 1.0, 1.2], (30, 3))
    known, each = each_target(scene, places)
    some = [3, 11, 20]
    at = known.at(scene.calibration)
    whole = known.data + known.paper + each[some].sum(axis=0)
    by_sum = np.linalg.inv(whole)[np.ix_(at, at)] * np.outer(known.unit[at], known.unit[at])
    model = known_with(scene, places[some])
    together = model.covariance(model.at(scene.calibration))
    np.testing.assert_allclose(np.sqrt(np.diag(by_sum)), np.sqrt(np.diag(together)), rtol=1e-6)

    plan = plan_targets(run, 3, candidates=100)
    faro = [k for k, key in enumerate(plan.keys) if key.unknown == "faro"]

    def volume(spheres_m):
        model = known_with(scene, spheres_m)
        return np.linalg.slogdet(model.covariance(model.at(["faro"])))[1]

    low, high = plan.spheres_m.min(axis=0) - 0.01, plan.spheres_m.max(axis=0) + 0.01
    drawn = [volume(rng.uniform(low, high, (3, 3))) for _ in range(20)]
    assert volume(plan.spheres_m) < np.min(drawn)
    assert (plan.after.sigma <= plan.now.sigma * (1 + 1e-9)).all()
    assert (plan.after.sigma[faro] < 0.97 * plan.now.sigma[faro]).any()


def test_targets_hang_where_the_tracker_sees_and_clear_of_the_room(run, rig):
    plan = plan_targets(rig, 8, region=REGION, candidates=200)
    mesh = planner_without_places(rig, "all", None, silent).scene.source.reference
    x, y, _ = plan.spheres_m.T
    assert x.min() > -1.6 and x.max() < 1.6 and y.min() > -1.2 and y.max() < 1.2
    assert mesh.distance_m(plan.spheres_m).min() > TARGET_CLEAR_M
    source = planner_without_places(run, "all", None, silent).scene.source
    inside = plan_targets(run, 3, candidates=100).spheres_m
    assert source.reference.distance_m(inside).min() > TARGET_CLEAR_M


def test_targets_are_printed_and_written(run, rigcal, tmp_path):
    file = tmp_path / "targets.csv"
    words = ["plan", run.folder, "--targets", 2, "--candidates", 50]
    code, said, _ = rigcal(*words, "-o", file)
    assert code == 0 and said.startswith("2 targets for the whole calibration")
    document = json.loads(rigcal(*words, "--json")[1])
    table = pd.read_csv(file)
    assert list(table.columns) == ["target", "x", "y", "z"]
    assert table.to_dict("records") == document["targets"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("--stops 3", "not both"),
        ("--for scatter", "it is about stops"),
        ("--region 50 50 51 51", "no place for a target is 0.3 m clear"),
        ("-o targets.txt", "give FILE.csv"),
    ],
)
def test_what_is_wrong_is_said_in_a_sentence(run, rigcal, words, said):
    code, out, err = rigcal("plan", run.folder, "--targets", 3, *words.split())
    assert (code, out) == (2, "") and said in err and err.count("\n") == 1


def test_a_rig_whose_tracker_saw_nothing_needs_a_region(rig):
    with pytest.raises(InputError, match="has seen nothing yet, so say with --region"):
        plan_targets(rig, 3)
