"""Levels: accelerometers at rest tell tilt as well as they should; what is wrong is said."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import yaml
from scipy.stats import chi2

import calib
from calib.forward import place
from calib.planning.stops import Poses, at_their_places, extended
from calib.problem import build
from calib.problem.bodies import turned_by_zero
from calib.problem.model import Model, Source
from calib.problem.without import leave_out
from calib.report import report
from calib.residuals.levels import Level
from calib.results.check import check
from calib.rig.columns import up_in_root
from calib.runs.belief import cautions
from calib.runs.run import RESIDUALS
from calib.show.tables import print_run
from calib.simulation import PRESETS, Spec, simulate
from calib.solve.fit import solve
from chains import se3
from chains.errors import InputError
from sensors.recording import read_table

from . import rigs
from .broken import cells
from .test_arm_alone import arm_alone

FRAMES = ("base", "arm_3", "mount_markers")
UPRIGHT = {"up": [0.0, 0.0, 1.0], "sigma_up_rad": 1e-6}


def levelled(*frames, **more):
    return {"frames": list(frames), "sigma_rad": rigs.LEVEL_RAD, **more}


@pytest.fixture(scope="module")
def problem(tmp_path_factory):
    folder = tmp_path_factory.mktemp("levels") / "box"
    return build([Source.open(rigs.write(folder, levels=levelled("lidar")))], Model())


@pytest.mark.parametrize("apart_rad", [0.0, 1e-6, 1e-3, 0.5, 2.0, 3.0])
@pytest.mark.parametrize("stops", [[1], [0, 1, 2, 3]])
def test_a_level_is_off_by_the_angle_and_its_derivatives_are_right(problem, stops, apart_rad):
    values = rigs.shaken(problem.variables, problem.initial, 0.1)
    values["gravity"] = np.array([0.3, -0.4, -2.0])  # its length means nothing
    rig, joints = problem.sources[0].rig, problem.sources[0].recording.joints[stops]
    chain = place(rig, problem.terms[0], joints, {}, "root@a", None).with_joint_noise("joints@s0")
    T = chain.in_world("lidar", values).T
    up = np.matvec(T[:, :3, :3].mT, [-0.3, 0.4, 2.0]) / np.linalg.norm([0.3, 0.4, 2.0])
    across = np.cross(up, [0.6, 0.0, 0.8])
    across *= apart_rad / np.linalg.norm(across, axis=1, keepdims=True)
    block = Level(
        name="level",
        stops=chain,
        body="lidar",
        measured=np.matvec(se3.so3_exp(across), up),
        gravity="gravity",
        sigma_rad=0.002,
    )
    residual, _ = block.evaluate(values, False)
    size = np.linalg.norm(residual.reshape(-1, 2), axis=1)
    np.testing.assert_allclose(size, apart_rad / 0.002, rtol=1e-6, atol=1e-9)
    rigs.assert_block_derivatives(block, problem.variables, values)
    np.testing.assert_allclose(block.predicted(values), up, atol=1e-12)


def test_a_level_and_a_tracker_tell_tilt_as_the_sum_of_their_weights(tmp_path):
    """Where up is known, of two axes; about the third the tracker is alone."""
    tracker = rigs.drawing()["tracker"] | {"bodies": ["base_markers"], "sigma_rad": 0.002}
    said = {"tracker": tracker, "levels": levelled("base", **UPRIGHT)}
    source = Source.open(arm_alone(tmp_path / "rec", **said))
    held = tuple(source.rig.frame_sigma)
    problem = build([source], Model(("arm_joint_offset",), held))
    estimate = solve(problem)
    C = estimate.covariance_of(["root@a"])[:3, :3]
    R = estimate.values["root@a"][:3, :3]
    of = np.diag(R @ C @ R.T)
    alone, both = 0.002**2 / 2, 1 / (2 / 0.002**2 + 2 / rigs.LEVEL_RAD**2)  # two stops at a
    np.testing.assert_allclose(of, [both, both, alone], rtol=0.02)


def test_a_level_on_the_arm_tells_the_zero_of_a_joint_as_far_as_its_axis_lies_flat(tmp_path):
    """By the cross product of axis and up, at every stop; in closed form."""
    tracker = rigs.drawing()["tracker"] | {"bodies": ["base_markers"], "sigma_rad": 1e-6}
    arm = rigs.drawing()["arm"] | {"sigma_joint_rad": 0}
    said = {"tracker": tracker, "arm": arm, "levels": levelled("arm_3", **UPRIGHT)}
    source = Source.open(arm_alone(tmp_path / "rec", **said))
    frames = tuple(source.rig.frame_sigma)
    problem = build([source], Model(("arm_joint_offset",), frames))
    estimate = solve(problem)
    unknown = estimate.problem.variables["arm_joint_offset"]
    information = np.diag(1.0 / np.square(unknown.prior_sigma))
    levels = (block for block in estimate.problem.seen if block.kind == "level")
    weight = {group.where: w for block in levels for group, w in _weights(block)}
    turning = [list(rigs.JOINTS).index(n) for n in ("turn", "lift")]
    for stop, (location, joints) in rigs.STOPS.items():
        root = estimate.values[f"root@{location}"][:3, :3]
        at = np.array(joints) + estimate.values["arm_joint_offset"]
        axes = [
            root @ rigs.placed(child, at, rigs.Hardware()).rotation.as_matrix() @ axis
            for child, axis in (("arm_1", [0, 0, 1]), ("arm_2", [0, 1, 0]))
        ]
        J = np.cross(axes, [0.0, 0.0, 1.0]).T / rigs.LEVEL_RAD
        information[np.ix_(turning, turning)] += weight[stop] * J.T @ J
    expected = np.sqrt(np.diag(np.linalg.inv(information)))
    found = np.sqrt(np.diag(estimate.covariance_of(["arm_joint_offset"])))
    np.testing.assert_allclose(found, expected, rtol=1e-3)
    assert found[1] < 0.6 * rigs.LEVEL_RAD  # four stops


def _weights(block):
    weight = np.ones(len(block.groups)) if block.weight is None else block.weight
    return zip(block.groups, weight, strict=True)


# ------------------------------------------------------------------------------- what files hold


def spec(**changed):
    few = {"locations": 4, "stops_per_location": 4, "occluded_share": 0, "levels": FRAMES}
    return Spec(**{**PRESETS["arm-tracker"].model_dump(), **few, **changed})


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    folder = tmp_path_factory.mktemp("levels") / "rec"
    simulate(spec(), folder, seed=1)
    return folder


def test_levels_that_point_down_are_told(recording, tmp_path):
    """As those do that say where gravity pulls; the arm then seems to give way upwards."""
    shutil.copytree(recording, tmp_path / "rec")
    table = pd.read_csv(tmp_path / "rec" / "stops.csv")
    felt = [f"{frame}.{axis}" for frame in FRAMES for axis in ("ax", "ay", "az")]
    table[felt] = -table[felt]
    table.to_csv(tmp_path / "rec" / "stops.csv", index=False)
    for folder, wrong in ((recording, False), (tmp_path / "rec", True)):
        told = check(folder, graph=False).odd
        assert any("levels say that z of" in str(each) for each in told) == wrong
    found = calib.fit(tmp_path / "rec", tmp_path / "run", hold_out="none")
    assert [each for each in cautions(found) if "levels say that z of" in each]


@pytest.fixture(scope="module")
def run(recording):
    return calib.fit(recording, recording.parent / "run")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"ax": 0.0, "ay": 0.0, "az": 0.0}, "are all 0"),
        ({"ay": ""}, "arm_3.ay is empty or not finite, though the level in arm_3 was read"),
        ({"az": 25.0}, "at rest it is always that of gravity"),
    ],
)
def test_a_row_that_no_level_at_rest_reads_is_refused(recording, tmp_path, change, said):
    folder = shutil.copytree(recording, tmp_path / "rec")
    for axis, cell in change.items():
        cells("stops.csv", rf"arm_3\.{axis}", lambda _, cell=cell: cell, row=1)(folder)
    with pytest.raises(InputError, match=rf"stops\.csv: row 2 \(L00P01\).*{said}"):
        calib.Recording.open(folder)


def test_a_row_without_a_level_is_no_row_of_it(recording, tmp_path):
    folder = shutil.copytree(recording, tmp_path / "rec")
    for axis in ("ax", "ay", "az"):
        cells("stops.csv", rf"arm_3\.{axis}", lambda _: "", row=1)(folder)
    assert "read at 15 of 16 stops" in dict(check(folder, graph=False).contents)["level in arm_3"]
    blocks = build([Source.open(folder)], Model()).seen
    assert sum(b.name == "arm_3.level at L00P01" for b in blocks) == 0
    assert sum(b.kind == "level" and b.body == "arm_3" for b in blocks) == 15


def test_columns_that_rig_yaml_does_not_declare_are_named(recording, tmp_path):
    folder = shutil.copytree(recording, tmp_path / "rec")
    rig = yaml.safe_load((folder / "rig.yaml").read_text())
    rig["levels"]["frames"].remove("arm_3")
    (folder / "rig.yaml").write_text(yaml.safe_dump(rig))
    (said,) = (odd for odd in check(folder, graph=False).odd if "accelerometer" in odd)
    assert "arm_3.ax, arm_3.ay, arm_3.az" in said and "levels: {frames: [arm_3]" in said


@pytest.mark.parametrize(
    ("levels", "said"),
    [
        ({"frames": ["arm_33"], "sigma_rad": 0.001}, r"levels\.frames\.0: .*arm_3"),
        ({"frames": [], "sigma_rad": 0.001}, "neither frames nor up"),
        ({"frames": ["base"]}, "no sigma_rad"),
        ({"up": [0, 0, 1], "sigma_up_rad": 0.1, "sigma_rad": 0.1}, "name these, too"),
        ({"frames": ["base", "base"], "sigma_rad": 0.001}, "base is there twice"),
        ({"frames": ["base"], "sigma_rad": 0.001, "up": [0, 0, 1]}, "give both, or neither"),
        (levelled("base", up=[0, 0, 0], sigma_up_rad=0.1), "points nowhere"),
    ],
)
def test_levels_that_make_no_sense_are_refused(recording, tmp_path, levels, said):
    folder = shutil.copytree(recording, tmp_path / "rec")
    rig = yaml.safe_load((folder / "rig.yaml").read_text())
    (folder / "rig.yaml").write_text(yaml.safe_dump(rig | {"levels": levels}))
    with pytest.raises(InputError, match=rf"rig\.yaml:\d+: .*{said}"):
        calib.Recording.open(folder)


# --------------------------------------------------------------------------------- what runs hold


def test_a_run_tells_how_far_each_level_is_off(run):
    table = read_table(run.folder / RESIDUALS / "_level.parquet")
    assert set(table["body"]) == {f"{frame}.level" for frame in FRAMES}
    assert len(table["whitened"]) == 16 * 3 * 2 and set(table["unit"]) == {"rad"}
    assert 0.8 < run.summary["misfit"]["level"] < 1.2
    assert 0.7 < run.summary["misfit_by"]["body"]["arm_3.level"] < 1.3
    assert run.residuals("level").shape[0] == 96


def test_a_run_tells_which_way_is_up(recording, run, capsys):
    truth = json.loads((recording.parent / "rec.truth.json").read_text())
    up, true = run.summary["up"], np.linalg.inv(truth["T_faro_opti"])[:3, 2]
    assert up["frame"] == "opti" and 0 < up["sigma_rad"] < rigs.LEVEL_RAD
    assert np.linalg.norm(np.cross(up["xyz"], true)) < 4 * up["sigma_rad"]
    print_run(run)
    assert up["told"].split(",")[0] in " ".join(capsys.readouterr().out.split())


def test_levels_say_where_up_is_in_the_rig_at_every_stop(recording):
    source = Source.open(recording)
    truth = json.loads((recording.parent / "rec.truth.json").read_text())
    true = np.stack([np.array(at["T_faro_root"])[2, :3] for at in truth["stops"].values()])
    off = np.linalg.norm(np.cross(source.columns["up"], true), axis=1)
    assert off.max() < 0.01  # of hardware some mrad off its drawing
    assert np.abs(true[:, :2]).max() > 0.001 or off.max() < 0.005
    for felt in source.recording.levels.values():
        felt[3] = np.nan
    alone = up_in_root(source.rig, source.recording)
    assert np.isfinite(alone).all() and np.allclose(np.linalg.norm(alone, axis=1), 1.0)


def test_the_zeros_of_accelerometers_are_found_where_they_are_told_of(recording, tmp_path, capsys):
    """Some mg on each axis. The arm turns one level every way; the base's is always upright, and
    along what it feels its zero shows nowhere."""
    folder = shutil.copytree(recording, tmp_path / "rec")
    zeros = {frame: 1e-3 * np.random.default_rng(7).normal(0, 6.0, 3) for frame in FRAMES}
    for frame, zero in zeros.items():
        for axis, b in zip("xyz", zero, strict=True):
            cells("stops.csv", rf"{frame}\.a{axis}", lambda a, b=b: a + 9.80665 * b)(folder)
    off = calib.fit(folder, tmp_path / "off")
    assert off.summary["misfit"]["level"] > 2.0
    rig = yaml.safe_load((folder / "rig.yaml").read_text())
    rig["levels"]["sigma_zero_rad"] = 0.006
    (folder / "rig.yaml").write_text(yaml.safe_dump(rig))
    run = calib.fit(folder, tmp_path / "run")
    assert 0.8 < run.summary["misfit"]["level"] < 1.2
    found = {zero["frame"]: zero for zero in run.summary["level_zeros"]}
    z = [(found[f]["xyz"] - b) / found[f]["sigma_rad"] for f, b in zeros.items()]
    assert np.abs(z).max() < 3.5 and 0.3 < np.sqrt(np.mean(np.square(z))) < 1.6
    assert max(found["arm_3"]["sigma_rad"]) < 0.001 < 0.005 < found["base"]["sigma_rad"][2] < 0.0061
    print_run(run)
    assert found["arm_3"]["told"].split(",")[0] in " ".join(capsys.readouterr().out.split())
    assert calib.diagnose(run).verdict == "adequate"
    # Twice as far off as the levels are said to be: that widens what they tell, and no other.
    rig["levels"]["sigma_rad"] /= 2
    (folder / "rig.yaml").write_text(yaml.safe_dump(rig))
    wide = calib.fit(folder, tmp_path / "wide").summary
    more = {zero["frame"]: zero["sigma_rad"] for zero in wide["level_zeros"]}
    assert wide["sigmas_widened_by"] > 1.2
    assert max(more["base"]) < 1.05 * found["base"]["sigma_rad"][2]


def test_a_zero_turns_what_is_felt_as_it_does(problem):
    """To the first order; against the direction of the sum."""
    block = next(b for b in problem.blocks if isinstance(b, Level))
    zero = np.array([0.004, -0.003, 0.005])
    felt = block.predicted(problem.initial)
    moved = replace(block, bases={"zero": turned_by_zero(felt)})
    expected = felt + zero
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    found = moved.predicted({**problem.initial, "zero": zero})
    np.testing.assert_allclose(found, expected, atol=4e-5)


def test_a_level_that_was_knocked_is_named_and_left_out(recording, tmp_path):
    folder = shutil.copytree(recording, tmp_path / "rec")
    cells("stops.csv", r"mount_markers\.ax", lambda ax: ax + 0.2, row=5)(folder)
    run = calib.fit(folder, tmp_path / "run")
    found = calib.diagnose(run)
    (blunder,) = found.blunders
    assert (blunder["kind"], blunder["stop"]) == ("level", "L01P01")
    assert blunder["name"] == "mount_markers.level" and blunder["unit"] == "rad"
    assert blunder["without"] == "L01P01:mount_markers.level"
    assert blunder["size"] > 4 * blunder["sigma"] and not blunder["indistinguishable_from"]
    (source,) = leave_out([Source.open(folder)], [blunder["without"]])
    assert np.isnan(source.recording.levels["mount_markers"][5]).all()
    assert np.isfinite(source.recording.levels["base"]).all()


def test_a_plan_counts_on_levels(recording, run):
    """A planned stop has their rows, and they read there what they should."""
    source = Source.open(recording)
    known = build([source], Model()).initial
    joints, root = source.recording.joints[:1] + 0.1, known["root@L00P00"][None]
    poses = Poses(np.array(["L00"]), joints, root)
    longer = extended(source, poses, (), np.eye(4), apart=False)
    problem, values = at_their_places(build([longer], Model()), known, longer, 16, poses)
    planned = [b for b in problem.seen if b.stop_names[0][1] == 16]
    assert [b.kind for b in planned] == ["tracker"] * 2 + ["level"] * len(FRAMES)
    assert np.abs(np.concatenate([b.evaluate(values, False)[0] for b in planned])).max() < 1e-6
    assert len(calib.plan(run, stops=2).stops) == 2


def test_a_report_draws_levels(run, tmp_path):
    report([run], tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text()
    assert "arm_3.level" in page


@pytest.mark.parametrize("preset", ["lidar-arm", "tiny"])
def test_levels_hold_beside_beams(tmp_path, preset):
    few = {"locations": 3, "stops_per_location": 3, "column_step": 100, "levels": ("base", "lidar")}
    simulate(Spec(**{**PRESETS[preset].model_dump(), **few}), tmp_path / "rec", seed=2)
    run = calib.fit(tmp_path / "rec", tmp_path / "run")
    assert run.summary["converged"] and 0.7 < run.summary["misfit"]["level"] < 1.3


def test_what_levels_help_to_estimate_lies_within_its_sigmas(tmp_path):
    """Of eight arms, whose levels alone tell how the tracker's room leans."""
    errors, leans = [], []
    for seed in range(8):
        simulate(spec(build_error=1.0), tmp_path / f"{seed}", seed=100 + seed)
        fitted = solve(build([Source.open(tmp_path / f"{seed}")], Model()))
        truth = json.loads((tmp_path / f"{seed}.truth.json").read_text())
        for name, true in truth["effects"].items():
            unknown = fitted.problem.variables.get(name)
            sigma = np.sqrt(np.diag(fitted.covariance_of([name])))
            told = sigma < 0.9 * unknown.sigma
            at = [k for k, length in enumerate(true) if length] if len(true) != len(sigma) else ...
            errors.append(((fitted.values[name] - np.array(true)[at]) / sigma)[told])
        down = -np.linalg.inv(truth["T_faro_opti"])[:3, 2]
        across = np.linalg.svd(down[None])[2][1:]
        off = across @ fitted.values["gravity"]  # its length is 1 to a part in a million
        leans.append(
            off @ np.linalg.solve(across @ fitted.covariance_of(["gravity"]) @ across.T, off)
        )
    z = np.concatenate(errors)
    assert 0.8 < np.sqrt(np.mean(np.square(z))) < 1.2
    assert np.mean(np.abs(z) < 1.96) > 0.9
    low, high = chi2.ppf([0.001, 0.999], 16)
    assert low < sum(leans) < high
