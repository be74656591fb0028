"""Arms under a tracker alone: what is held out, what is predicted elsewhere, what is said."""

import csv
import json
import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from calib.diagnosis.candidates import concerned
from calib.effects import CATALOGUE, GEOMETRY
from calib.linear.layout import Layout
from calib.problem import build
from calib.problem.model import Model, Source
from calib.problem.without import leave_out
from calib.results.check import check
from calib.results.holdout import FOLDS, POSE_BLOCKS, folds, held_out, pose_blocks, unit_of
from calib.results.intervals import intervals
from calib.results.reach import Reach, joint_range, reach
from calib.results.solution import solution_of
from calib.runs.calibrate import calibrate
from calib.runs.diagnose import diagnose
from calib.show import tables
from calib.solve.fit import solve
from sensors.stops import POSE

from . import arm_worlds, rigs

SMALL = Model(("arm_link_length", "arm_joint_offset"))


def quiet(*_):
    pass


def arm_alone(folder, **changes):
    """A recording of an arm and a tracker, and of nothing else."""
    frames = {name: f for name, f in rigs.drawing()["frames"].items() if name != "lidar"}
    changes |= {"lidar": None, "target": None, "reference": None, "frames": frames}
    rigs.write(folder, seed=8, **changes)
    (folder / "targets.csv").unlink()
    shutil.rmtree(folder / "scans")
    return folder


def bent(source, at_m, **changes):
    """A source whose tool was seen at these places (K, 3)."""
    seen = np.hstack([at_m, np.tile([1.0, 0, 0, 0], (len(at_m), 1))])
    said = {
        "stops": [f"p{k}" for k in range(len(at_m))],
        "location": np.array(["a"] * len(at_m)),
        "has_scan": np.zeros(len(at_m), bool),
        "bodies": {"mount_markers": seen, "base_markers": np.zeros((len(at_m), 7))},
    }
    return SimpleNamespace(rig=source.rig, recording=SimpleNamespace(**(said | changes)))


def as_if_rows_told_all(known):
    """Intervals as the graph has them, of which nothing is due to rig.yaml."""
    return replace(known, wider=np.ones(len(known.graph)), given=0.0 * known.given)


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    return Source.open(arm_alone(tmp_path_factory.mktemp("arm") / "rec"))


@pytest.fixture(scope="module")
def solved(source):
    problem = build([source], SMALL)
    return problem, solve(problem)


# ---------------------------------------------------------------------------------------- held out


def test_folds_are_blocks_of_neighbours_all_over_the_workspace(source):
    at = np.random.default_rng(1).uniform(-1, 1, (300, 3))
    many = bent(source, at)
    assert unit_of([many], "location") == "poses" and unit_of([many], "stop") == "stop"
    block = pose_blocks(many)
    assert len(set(block)) == POSE_BLOCKS and np.array_equal(block, pose_blocks(many))
    left = [fold[0] for fold in folds([many], "location")]
    assert len(left) == FOLDS and np.array_equal(np.sum(left, axis=0), np.ones(300))
    for fold in left:
        assert 30 <= fold.sum() <= 90
        # Further from what is kept than a single pose is from its neighbours.
        far = np.linalg.norm(at[fold][:, None] - at[~fold], axis=2).min(axis=1)
        near = np.linalg.norm(at[:, None] - at + 9 * np.eye(300)[..., None], axis=2).min(axis=1)
        assert np.median(far) > 1.5 * np.median(near)
        assert np.linalg.norm(np.ptp(at[fold], axis=0)) > 1.5  # of 3.5 m: not one corner


def test_poses_that_were_not_seen_and_few_of_them_are_in_some_fold(source):
    at = np.random.default_rng(1).uniform(-1, 1, (8, 3))
    at[2] = np.nan
    left = [fold[0] for fold in folds([bent(source, at)], "location")]
    assert np.array_equal(np.sum(left, axis=0), np.ones(8))
    one = bent(source, np.zeros((5, 3)))
    assert len(folds([one], "location")) == 5  # where all are at one place, one by one


def test_scans_and_a_base_that_moves_keep_their_locations(source):
    at = np.random.default_rng(1).uniform(-1, 1, (20, 3))
    two = np.array(["a", "b"] * 10)
    assert unit_of([bent(source, at, location=two)], "location") == "location"
    still = bent(source, at, location=two)
    still.rig = replace(source.rig, moves="never")
    assert unit_of([still], "location") == "poses"
    scanned = bent(source, at, has_scan=np.ones(20, bool))
    scanned.rig = replace(source.rig, lidar=object())
    assert unit_of([scanned], "location") == "stop"


# --------------------------------------------------------------------------------------- predicted


def test_what_is_predicted_is_what_the_covariance_does_to_the_chain(solved, source):
    """Against hardware drawn from the covariance and placed link by link by scipy."""
    problem, estimate = solved
    found = reach(problem, estimate)
    assert found.body == "mount_markers"
    rng, count = np.random.default_rng(5), 4000
    theta = rng.multivariate_normal(np.zeros(len(estimate.covariance)), estimate.covariance, count)

    def hardware(errors):
        parts, start = {}, 0
        for v in estimate.variables:
            parts[v.name] = {d: errors[:, start + i] for i, d in enumerate(v.dofs)}
            start += v.dim
        zero = np.zeros(len(errors))

        def of(name, dofs):
            value = dict(zip(problem.variables[name].dofs, estimate.values[name], strict=True))
            moved = parts[name]
            return np.stack([value.get(d, 0.0) + moved.get(d, zero) for d in dofs], axis=-1)

        twist = ("rx", "ry", "rz", "tx", "ty", "tz")
        frames = {n: of(n, twist) for n in rigs.FRAMES if n in parts}
        return rigs.Hardware(
            frames, of("arm_link_length", rigs.ARM), of("arm_joint_offset", rigs.JOINTS)
        )

    def apart(joints):
        def at(errors):
            made = hardware(errors)
            base, tool = (rigs.placed(b, joints, made) for b in ("base_markers", "mount_markers"))
            return (base.inv() * tool).translation

        return np.quantile(np.linalg.norm(at(theta) - at(0 * theta), axis=1), 0.95)

    anywhere = rng.uniform(-3, 3, (count, 3))
    seen = source.recording.joints[rng.integers(4, size=count)]
    assert found.anywhere_m == pytest.approx(apart(anywhere), rel=0.06)
    assert found.at_poses_m == pytest.approx(apart(seen), rel=0.06)
    assert found.is_small and found.box_share < 0.1 and "add poses" in found.warning
    known = intervals(estimate)
    twice = as_if_rows_told_all(known).at_least(2.0)
    assert reach(problem, estimate, twice).anywhere_m == pytest.approx(2 * found.anywhere_m)


def test_joints_without_limits_turn_once(source):
    low, high = joint_range(source.rig, source.recording.joints)
    assert low.tolist() == [-3, -3, -3] and high.tolist() == [3, 3, 3]
    edges = [
        replace(e, joint=replace(e.joint, lower=-np.inf, upper=np.inf)) if e.joint else e
        for e in source.rig.tree.edges
    ]
    tree = type(source.rig.tree)(edges)
    free = replace(source.rig, tree=tree)
    low, high = joint_range(free, source.recording.joints)
    np.testing.assert_allclose(low, [-np.pi, -np.pi, 0.0])
    np.testing.assert_allclose(high, [np.pi, np.pi, 0.15])


def test_a_rig_with_scans_or_without_an_arm_has_none(tmp_path):
    problem = build([Source.open(rigs.write(tmp_path / "rec"))], SMALL)
    assert reach(problem, solve(problem)) is None


def test_it_stands_in_the_summary_and_is_said(tmp_path, capsys):
    recording = arm_alone(tmp_path / "rec")
    run = calibrate([recording], tmp_path / "run", SMALL)
    summary = json.loads((run.folder / "summary.json").read_text())
    told = summary["predicted_mm"]
    assert 0 < told["at_poses"] < told["anywhere"] and told["body"] == "mount_markers"
    assert summary["rejected_share"] is None and summary["rms_all_mm"] is None
    tables.print_run(run)
    said = " ".join(capsys.readouterr().out.split())
    assert (
        f"within the poses to {told['at_poses']:.2g} mm" in said and "add poses out there" in said
    )
    found = check(recording)
    assert found.document()["predicted_mm"]["anywhere"] > 0
    assert any("fill a box of" in sentence for sentence in found.odd)


def test_what_a_model_that_is_too_small_predicts_stands_beside_what_it_is_off_by(tmp_path):
    """Axes lean by 3 mrad, which lengths and zeros cannot say: its place was "predicted within the
    poses to 0.42 mm" of a fit that was 1.64 mm off in stops that were held out."""
    world = arm_worlds.bent(tmp_path / "rec", "ur10", np.random.default_rng(1))
    arm_worlds.write(tmp_path / "rec", world, np.random.default_rng(2), poses=100)
    told = {}
    for name, effects in (("small", GEOMETRY[:2]), ("whole", GEOMETRY)):
        run = calibrate([tmp_path / "rec"], tmp_path / name, Model(effects))
        told[name] = run.summary["predicted_mm"]["told"], run.summary["rms_mm"]["held_out"]
    (whole, _), (small, off_mm) = told["whole"], told["small"]
    assert len(whole) == 1 and len(small) == 2
    assert f"stops held out are off by {off_mm:.2f} mm" in small[1] and off_mm > 0.5


def test_a_box_is_small_where_the_prediction_outside_is_much_worse():
    def of(anywhere_m):
        return Reach("tool", 1e-4, anywhere_m, box_m=np.array([1.0, 0.5, 0.25]), box_share=0.4)

    assert not of(1.9e-4).is_small and of(2.1e-4).is_small
    assert "1.00 x 0.50 x 0.25 m, which holds 40 %" in of(2.1e-4).warning
    assert "0.1 mm, anywhere in the joints' range to 0.21 mm (95 %)" in of(2.1e-4).sentence


def nearest_poses(folder, to, count):
    """A copy of a recording of an arm, of whose poses those nearest to the first are left."""
    shutil.copytree(folder, to, copy_function=shutil.copyfile)
    with (to / "stops.csv").open() as file:
        rows = list(csv.DictReader(file))
    at = np.array([[float(row[f"tool.{axis}"]) for axis in "xyz"] for row in rows])
    near = np.argsort(np.linalg.norm(at - at[0], axis=1))[:count]
    with (to / "stops.csv").open("w", newline="") as file:
        table = csv.DictWriter(file, rows[0])
        table.writeheader()
        table.writerows(rows[k] for k in sorted(near))
    return to


def test_a_small_box_is_warned_of_however_much_wider_intervals_are(shared, tmp_path):
    """An effect is missing, so that rows err together and what they tell is widened: each
    parameter's own factor took from 4.5 to 1.6 how much worse the place is known elsewhere."""
    folder = nearest_poses(shared / "recordings/arm_payload", tmp_path / "rec", 20)
    (checked,) = check(folder).predicted
    run = calibrate([folder], tmp_path / "run", hold_out="none")
    told = run.summary["predicted_mm"]
    assert checked.is_small and checked.box_share < 0.05 and run.summary["sigmas_widened_by"] > 2
    assert len(told["told"]) == 2 and "add poses out there" in told["told"][1]
    before = checked.anywhere_m / checked.at_poses_m
    assert told["anywhere"] / told["at_poses"] == pytest.approx(before, rel=0.1)


def test_wider_sigmas_never_make_a_place_better_known(shared, tmp_path):
    folder = nearest_poses(shared / "recordings/arm_payload", tmp_path / "rec", 20)
    problem = build([Source.open(folder)], Model())
    estimate = solve(problem)
    known, plain = intervals(estimate), reach(problem, estimate)
    found = [reach(problem, estimate, known.at_least(least)) for least in (1.0, 2.0, 4.0, 8.0)]
    for at in ("at_poses_m", "anywhere_m"):
        sizes = [getattr(each, at) for each in found]
        assert np.all(np.diff(sizes) > -1e-3 * sizes[0]), at  # of a sample
        assert sizes[0] > getattr(plain, at), at
        assert sizes[-1] == pytest.approx(8.0 * getattr(plain, at), rel=0.05), (
            "rows tell nearly all"
        )


# -------------------------------------------------------------------------------- what is not there


def test_nothing_is_said_of_a_lidar_or_a_scanner_that_the_rig_does_not_have(solved, source):
    untold = {each["name"] for each in solution_of(*solved).not_estimated}
    assert not untold & {"lidar", "faro", "opti", "arm"}
    there = {e.family for e in CATALOGUE if concerned(e, [source])}
    assert {"arm_gravity_sag", "mount_creep", "optitrack_scale"} <= there
    gone = {"range_offset", "faro_scale", "moved_surface", "target_sphere_offset"}
    assert not there & gone and gone <= {e.family for e in CATALOGUE}


def test_a_lidar_without_scans_is_still_named(tmp_path):
    recording = rigs.write(tmp_path / "rec")
    for scan in (recording / "scans").iterdir():
        scan.unlink()
    problem = build([Source.open(recording)], SMALL)
    untold = {each["name"] for each in solution_of(problem, solve(problem)).not_estimated}
    assert "lidar" in untold


@pytest.mark.parametrize("moves", ["never", "stop"])
def test_an_arm_whose_base_nothing_tracks_is_predicted_in_the_trackers_frame(source, moves):
    """Where it stands is unknown as well, and no part of the calibration: for all stops, or for
    each, and then it is in no graph."""
    bodies = {"mount_markers": source.recording.bodies["mount_markers"]}
    tracker = replace(source.rig.tracker, bodies=("mount_markers",))
    rig = replace(source.rig, tracker=tracker, moves=moves)
    alone = replace(source, rig=rig, recording=replace(source.recording, bodies=bodies))
    problem = build([alone], SMALL)
    estimate = solve(problem)
    found, known = reach(problem, estimate), intervals(estimate)
    twice = as_if_rows_told_all(known).at_least(2.0)
    assert reach(problem, estimate, twice).anywhere_m == pytest.approx(2 * found.anywhere_m)


def test_a_pose_whose_joints_are_left_out_is_not_predicted(source):
    """Nothing else tells where its body should be; the readings are what is in doubt."""
    (less,) = leave_out([source], [f"{source.recording.stops[0]}:joints"])
    whole, without = (held_out([s], SMALL, "stop", FOLDS, quiet) for s in (source, less))
    assert without.count == whole.count - 1
    # Three stops for four, so others are less well foretold; not as by a joint a radian off.
    assert whole.floor_mm < without.floor_mm < 2 * whole.floor_mm
    assert whole.size.floor_mm < without.size.floor_mm < 2 * whole.size.floor_mm


@pytest.mark.parametrize("seen", [True, False])
def test_a_scan_whose_joints_are_left_out_is_placed_by_what_else_there_is(tmp_path, seen):
    """By the body beyond them, or, where that is not seen, by its own beams."""
    source = Source.open(rigs.write(tmp_path / "rec", seed=4))
    stop = source.recording.stops[0]
    tokens = [f"{stop}:joints"] + ([] if seen else [f"{stop}:mount_markers"])
    (less,) = leave_out([source], tokens)
    whole, without = (held_out([s], SMALL, "stop", FOLDS, quiet) for s in (source, less))
    assert without.count == pytest.approx(whole.count, rel=0.05)
    assert without.floor_mm == pytest.approx(whole.floor_mm, rel=0.2)
    assert without.rms_mm == pytest.approx(whole.rms_mm, rel=0.2)


def test_what_depends_on_a_parameter_by_rounding_alone_does_not_depend_on_it(source):
    """Whatever else a derivative is: told in sigmas of the row and of what was known before."""
    layout = Layout.of(build([source], SMALL))
    columns = np.array([layout.at["arm_link_length"].start, layout.at["arm_joint_offset"].start])
    by_sigma = np.array([[2e-10, 1e-3], [0.0, 0.0]])
    assert layout.moves(by_sigma / layout.sigma[columns], columns).tolist() == [False, True]


def test_stops_at_which_nothing_is_measured_do_not_count(tmp_path):
    """Ten poses, of which the tracker saw three: too few to say anything."""
    folder = arm_alone(tmp_path / "rec")
    with (folder / "stops.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))[:10]
    for row in rows[3:]:
        row.update({name: "" for name in row if name.rpartition(".")[2] in POSE})
    with (folder / "stops.csv").open("w", newline="") as file:
        table = csv.DictWriter(file, rows[0].keys())
        table.writeheader()
        table.writerows(rows)
    run = calibrate([folder], tmp_path / "run", hold_out="none")
    found = diagnose(run)
    assert found.too_few and "3 stops are too few" in found.sentences[0]
