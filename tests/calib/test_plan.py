"""Plans: what they promise, held against fits of the stops that they ask for, in worlds that share
no code with the program."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

import calib
from calib.diagnosis.weak import to_be_told_apart
from calib.planning import planner_of
from calib.planning.stops import pattern
from calib.problem.surfaces import with_surfaces
from calib.residuals.tracker import TrackedBody
from calib.simulation import PRESETS, simulate
from chains.errors import InputError
from tests.bench.bench_plan import case_of
from tests.worlds import World, write

from .linear.dense import Dense
from .narrow import JOINTS, NARROW, fitted, followed, run_of

FEW = {"stops": 3, "candidates": 120}
REGION = (-1.6, -1.2, 1.6, 1.2)


def sigma(run):
    """Of every parameter, as the graph has it: what rows say, whatever chance made of a few."""
    return np.sqrt(np.diag(run.solution.graph))


@pytest.fixture(scope="module")
def narrow(once):
    return run_of(once)


@pytest.fixture(scope="module")
def planner(narrow):
    """What plans for it."""
    return planner_of(narrow, "all")


@pytest.mark.long
def test_sigmas_are_as_promised(narrow, tmp_path):
    """Of every parameter within 5 %, where planned stops bring much."""
    plan = calib.plan(narrow, **FEW)
    later = fitted(followed(plan), tmp_path)
    assert later.solution.names == tuple(plan.names)
    promised = plan.after.sigma / plan.now.sigma
    kept = sigma(later) / sigma(narrow)
    assert promised.min() < 0.2 and np.median(promised) < 0.95
    np.testing.assert_allclose(kept, promised, rtol=0.05)


def test_what_is_known_now_is_what_the_run_reports(narrow, planner):
    known = np.sqrt(np.diag(narrow.solution.covariance))
    np.testing.assert_allclose(planner.now.sigma, known, rtol=1e-6)
    model = planner.scene.now
    at = model.at(planner.scene.calibration)
    np.testing.assert_allclose(np.sqrt(np.diag(model.covariance(at))), sigma(narrow), rtol=1e-4)


def test_a_stop_says_what_its_rows_say_without_what_it_has_alone(planner):
    """By plain algebra on all rows of one planned stop, those of its own priors included."""
    scene, poses = planner.scene, planner.candidates(3, 0).some([1])
    keys = planner.lasting.keys
    (found,) = scene.each(poses, keys)
    problem, values = scene.planned_alone(poses)
    blocks = [b for b in problem.blocks if isinstance(b, TrackedBody)]
    met = [scan.associate(values, near_edges=True) for scan in problem.scans]
    problem = with_surfaces(replace(problem, blocks=blocks), met)
    values |= {name: problem.variables[name].mean for name in problem.cells}
    dense = Dense(problem, values, met)
    whole = (dense.A * dense.sigma).T @ (dense.A * dense.sigma)
    column = {}
    for name, at in dense.at.items():
        if name not in problem.cells:
            column |= dict(zip(((name, d) for d in problem.variables[name].dofs), at, strict=True))
    shared = [i for i, key in enumerate(keys) if key in column]
    kept = np.array([column[keys[i]] for i in shared])
    own = np.setdiff1d(np.arange(len(whole)), kept)
    cross = whole[np.ix_(own, kept)]
    left = whole[np.ix_(kept, kept)] - cross.T @ np.linalg.solve(whole[np.ix_(own, own)], cross)
    left -= np.eye(len(kept))  # their own priors are no stop's
    scale = np.abs(left).max()
    assert scale > 1e3
    np.testing.assert_allclose(found[np.ix_(shared, shared)], left, rtol=0, atol=1e-7 * scale)
    others = np.setdiff1d(np.arange(len(keys)), shared)
    assert not found[others].any()


def test_a_measured_stop_planned_anew_weighs_what_it_did(planner):
    """Within a tenth, wherever it was: noise, beams that are lost and robust weights included."""
    scene = planner.scene
    estimate, beams = scene.stand.estimate, [pattern(scene.source)[:2]]
    each = scene.worth(beams)
    assert each == pytest.approx(0.67, abs=0.05)  # ranges scatter more than the data sheet says
    for i, (scan, met) in enumerate(zip(estimate.scans, estimate.associations, strict=True)):
        real = scan.rows(estimate.values, met)
        there = scene.anew(i, beams, each=each)
        planned = there.rows(estimate.values, there.associate(estimate.values, near_edges=True))
        weights = [np.sum(rows.weight / rows.sigma_m**2) for rows in (planned, real)]
        assert weights[0] == pytest.approx(weights[1], rel=0.1)
        assert not planned.residual_m.any()


def test_beams_are_as_bright_as_those_recorded(planner):
    """The worlds' own law is another one: reflectance times the cosine to the power of 0.4."""
    stand = planner.scene.stand
    scan, met = stand.estimate.scans[4], stand.estimate.associations[4]
    rows = scan.rows(stand.estimate.values, met)
    bright = planner.scene.brightness
    cosine = np.cos(rows.view["incidence_rad"])
    there = bright.at(rows.view["label"], rows.view["range_m"], cosine)[rows.usable]
    assert bright.slant == pytest.approx(0.4, abs=0.05) and abs(bright.fall) < 0.05
    np.testing.assert_allclose(
        np.median(there / rows.view["intensity"][rows.usable]), 1.0, atol=0.03
    )
    assert np.std(np.log(there / rows.view["intensity"][rows.usable])) < 0.2


def test_candidates_turn_all_that_the_arm_can_and_stay_clear_of_the_room(planner):
    poses, source = planner.candidates(200, 1), planner.scene.source
    assert np.abs(poses.joints).max() < 2.97
    assert (np.ptp(poses.joints, axis=0) > 4).all()  # joint 5 of the recording never turned
    assert set(poses.location) == set(source.recording.location)
    T = np.linalg.inv(planner.scene.T_world_reference) @ poses.Ts_world_root
    T = T @ source.rig.tree.place("lidar", poses.joints).Ts_root_frame
    assert source.reference.distance_m(T[:, :3, 3]).min() > 0.1


@pytest.mark.long
def test_planned_stops_tell_rivals_apart_and_random_ones_less(narrow):
    case = case_of(narrow, "narrow", ("arm_gravity_sag", "arm_joint_scale"), seed=1)
    assert case.now > 10
    assert case.planned < 0.7 * np.median(case.random)
    assert case.planned < 0.1 * case.now


def test_until_takes_as_few_stops_as_do(narrow, rigcal, tmp_path):
    words = ["plan", narrow.folder, "--until", "joint_5 x"]
    assert rigcal(*words)[0] == 2
    text = "arm_joint_offset.joint_3 0.4 mrad, arm_link_length.joint_5 0.15 mm"
    words = ["plan", narrow.folder, "--until", text, "--candidates", 80, "--stops", 6]
    code, said, _ = rigcal(*words, "--json", "-o", tmp_path / "stops.csv")
    document = json.loads(said)
    assert code == 0 and document["reached"] is True
    curve = {step["stops"]: step["worst"] for step in document["learning_curve"]}
    last = document["number"]["after"]
    assert last > 10 and curve[last] <= 1 < curve[last - 1]
    assert curve[None] < curve[last]  # any number of stops
    assert document["sigma"]["arm_joint_offset.joint_3"]["after"] <= 4e-4
    table = pd.read_csv(tmp_path / "stops.csv")
    assert list(table.columns) == ["location", *JOINTS]
    assert table.to_dict("records") == document["stops"]


def test_what_a_still_joint_hides_is_told_and_what_cad_alone_knows_is_not(narrow):
    """While joint 5 stays at 0, joints 4 and 6 turn about one axis, and their zeros are as one; of
    the base's height only sums are ever seen."""
    plan = calib.plan(narrow, **FEW)
    now, after, ever = (
        {name for direction in weak for name in direction["parameters"]}
        for weak in (plan.now.weak, plan.after.weak, plan.untold)
    )
    assert "arm_joint_offset.joint_4" in now - after - ever
    assert "arm_base.tz" in now & after & ever


def test_until_says_what_no_stop_tells(narrow, rigcal):
    words = ["plan", narrow.folder, "--until", "lidar.xyz 0.1 mm", "--candidates", 20]
    code, said, _ = rigcal(*words, "--stops", 2)
    assert code == 0
    assert "NOT REACHED: no stop of this arm tells lidar.tz so well, so measure it directly" in said


def test_a_rig_that_nobody_measured_is_promised_what_a_recording_gives(narrow, tmp_path):
    """Nine random stops of a rig alone, and nine of a world: the same but for where they are."""
    folder = tmp_path / "rig"
    world = World(seed=8, locations=3, stops=3, beams=1280, sweeps=20)
    write(world, folder)
    run = calib.fit([folder], tmp_path / "run", hold_out="none")
    for name in ("stops.csv", "scans", "targets.csv"):
        path = folder / name
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    rig = json.loads((folder / "rig.yaml").read_text())  # YAML holds JSON
    rig["lidar"]["columns"] = 40
    (folder / "rig.yaml").write_text(json.dumps(rig))
    planner = planner_of(folder, None, region=REGION)
    assert len(planner.places) == 6
    promised = planner.after(planner.candidates(9, 0)).sigma
    assert planner.names == list(run.solution.names)
    ratio = promised / sigma(run)
    assert 0.7 < np.median(ratio) < 1.4
    links = [planner.names.index(f"arm_link_length.joint_{k}") for k in (3, 5)]
    assert (ratio[links] > 0.4).all() and (ratio[links] < 2.5).all()
    assert planner.now.sigma[links] == pytest.approx([0.005, 0.005])


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("--for lidar.tq", "--for lidar.tq: neither in the model nor an effect"),
        ("--for stop_range_scatter", "it is drawn by chance"),
        ("--for noise_range", "it moves no mean"),
        ("--for lidar --until 'lidar 1 mm'", "not both"),
        ("--until lidar", "give NAME NUMBER UNIT"),
        ("--until 'lidar 1 km'", "unit 'km' is unknown; give mm, m, mrad, rad, deg"),
        ("--until 'lidar -1 mm'", "'-1' is no number above 0"),
        ("--until 'tripod 1 mm'", "'tripod' is not in the model; it has base_markers"),
        ("--until 'links 1 mrad'", "parameters of 'links' are in m, not rad"),
        ("--stops 9 --candidates 4", "give at least 1, and no more"),
        ("--region 50 50 60 60", "--region 50 50 60 60: no place in it has a floor"),
        ("-o stops.txt", "give FILE.csv"),
    ],
)
def test_what_cannot_be_planned_is_said_in_a_sentence(narrow, rigcal, words, said):
    import shlex

    code, out, err = rigcal("plan", narrow.folder, *shlex.split(words))
    assert (code, out) == (2, "")
    assert said in err and err.count("\n") == 1


def test_what_is_no_run_and_no_rig_alone_is_said(narrow, rigcal, tmp_path):
    recording = narrow.folder.parent / "rec"
    code, _, err = rigcal("plan", recording, "--region", *REGION)
    assert code == 2 and "is a recording with stops; fit it" in err
    rig = tmp_path / "rig"
    rig.mkdir()
    for name in ("rig.yaml", "arm.urdf"):
        shutil.copy(recording / name, rig)
    shutil.copytree(recording / "reference", rig / "reference")
    code, _, err = rigcal("plan", rig)
    assert code == 2 and "say with --region" in err


@pytest.mark.parametrize(
    ("preset", "said"),
    [("planes", "there is no mesh"), ("lidar-tracker", "the rig has no arm")],
)
def test_rigs_that_cannot_be_planned_for_are_refused(tmp_path, preset, said):
    spec = PRESETS[preset].model_copy(
        update={"column_step": 32, "locations": 2, "stops_per_location": 2}
    )
    simulate(spec, tmp_path / "rec")
    run = calib.fit([tmp_path / "rec"], tmp_path / "run", hold_out="none")
    with pytest.raises(InputError, match=said):
        calib.plan(run, **FEW)


@pytest.mark.parametrize("preset", ["arm-tracker", "laser-tracker", "lidar-arm"])
@pytest.mark.long
def test_other_rigs_are_planned_for(tmp_path, preset):
    """Under a tracker alone; seen as points from a base that never moves; without a tracker."""
    spec = PRESETS[preset].model_copy(update={"column_step": 64})
    spec = spec.model_copy(update={"locations": 3, "stops_per_location": 4})
    simulate(spec, tmp_path / "rec")
    run = calib.fit([tmp_path / "rec"], tmp_path / "run", hold_out="none")
    plan = calib.plan(run, **FEW)
    assert len(plan.stops) == 3 and set(plan.poses.location) <= set(
        calib.Recording.open(tmp_path / "rec").location
    )
    ratio = plan.after.sigma / plan.now.sigma
    assert ratio.max() < 1 + 1e-6 and ratio.min() < 0.95


def test_a_diagnosis_names_the_plan_that_would_tell_its_rivals_apart():
    """Of a confirmed effect with rivals, or of effects of the model that may be another."""
    plain = {"step": None, "indistinguishable_from": ["x"], "rivals": [{"add": "x"}], "add": "w"}
    rivals = {"indistinguishable_from": ["base_slip"], "rivals": [{"add": "base_slip@816"}]}
    found = plain | {"step": 2, "add": "arm_gravity_sag"} | rivals
    weak = [
        {"parameters": ["lidar.tz"], "sigma_mm": 0.6},
        {"parameters": ["range_scale", "faro_scale"], "sigma_mm": None},
    ]
    assert to_be_told_apart([plain, found], weak) == ["arm_gravity_sag", "base_slip@816"]
    assert to_be_told_apart([plain], weak) == ["range_scale", "faro_scale"]
    assert to_be_told_apart([plain], weak[:1]) == []


def test_an_earlier_run_stands_for_paper_where_it_did_in_the_fit(narrow, tmp_path):
    write(replace(NARROW, locations=1), tmp_path / "rec")
    run = calib.fit([tmp_path / "rec"], tmp_path / "run", hold_out="none", prior=narrow.folder)
    scene = planner_of(run, "all").scene
    known = scene.now.covariance(scene.now.at(scene.calibration))
    np.testing.assert_allclose(np.sqrt(np.diag(known)), sigma(run), rtol=1e-4)
