"""What ``--without`` leaves out: just what it names, in the fit and in all that follows it."""

import shutil

import numpy as np
import pytest

from calib.evaluation import evaluate
from calib.exporters import export
from calib.problem import build
from calib.problem.model import Model, Source
from calib.problem.unknowns import Role
from calib.problem.without import leave_out
from calib.report import report
from calib.residuals.targets import TARGET_PARTS
from calib.runs.add import add
from calib.runs.asked.commands import command_without
from calib.runs.calibrate import calibrate, grow
from calib.runs.reopen import model_of, reopened
from calib.runs.run import Run
from calib.view.scene import Scene
from chains import se3
from chains.errors import InputError
from sensors.documents import read_yaml

from .. import mishaps
from . import broken, rigs

MODEL = Model(("arm_link_length", "arm_joint_offset", "ring_range_offset"))
BY_STOP = {"base": {"moves": "stop"}}
TOKENS = {  # token: which rows are gone (blocks, scans), zero, or free
    "s1:mount_markers": {"gone": ["body s1 mount_markers"]},
    "s1:base_markers": {"gone": ["body s1 base_markers"]},
    "s2:scan": {"gone": ["scan s2"]},
    "t1:sphere": {"zero": ["target t1 sphere"]},
    "t1:upper": {"zero": ["target t1 upper"]},
    "t1:lower": {"zero": ["target t1 lower"]},
    "t1:rod": {"gone": [f"target t1 {part}" for part in TARGET_PARTS]},
    "s3:joints": {"free": ["joints@s3 turn", "joints@s3 lift", "joints@s3 slide"]},
    "s3:lift": {"free": ["joints@s3 lift"]},
    "cad:lidar": {"free": [f"lidar {dof}" for dof in ("rx", "ry", "rz", "tx", "ty", "tz")]},
    "cad:arm_link_length.slide": {"free": ["arm_link_length slide"]},
    "cad:arm_joint_offset.turn": {"free": ["arm_joint_offset turn"]},
}
SEVERAL = (
    *("s0:base_markers", "s1:base_markers", "s1:mount_markers", "s2:scan", "s3:lift"),
    *("t1:sphere", "t2:lower", "t3:rod", "cad:mount", "cad:arm_joint_offset.lift"),
)


@pytest.fixture(scope="module")
def box(tmp_path_factory):
    """A recording in which the base moves at every stop."""
    return rigs.write(tmp_path_factory.mktemp("without") / "box", seed=3, **BY_STOP)


def rows_of(sources, values):
    """All rows at a state: of blocks by group, of scans by stop; and sigmas of priors, one by one,
    of what is known before any data."""
    problem = build(sources, MODEL)
    rows, sigma = {}, {}
    for block in problem.blocks:
        residual, d = block.evaluate(values, True)
        every = np.hstack([residual[:, None], *(d[name] for name in sorted(d))])
        for group, mine in zip(block.groups, np.split(every, len(block.groups)), strict=True):
            rows[f"{group.kind} {group.where} {group.what}"] = mine
    for scan in problem.scans:
        found = scan.rows(values, scan.associate(values, near_edges=True))
        whitened = [found.residual_m[:, None], found.weight[:, None], found.by_twist]
        rows[f"scan {scan.name}"] = np.hstack(whitened)
    for name, unknown in problem.variables.items():
        if unknown.kind == "vector" and unknown.role is not Role.TARGET:
            pairs = zip(unknown.dofs, unknown.sigma, strict=True)
            sigma |= {f"{name} {dof}": s for dof, s in pairs}
    return rows, sigma


def state(sources):
    """Where a fit starts, shaken."""
    problem = build(sources, MODEL)
    return rigs.shaken(problem.variables, problem.initial, 1e-4)


# --------------------------------------------------------------------------------------------- rows


@pytest.mark.parametrize("token", TOKENS)
def test_just_what_is_named_is_left_out(box, token):
    source = Source.open(box)
    values, gone = state([source]), TOKENS[token]
    (rows, sigma), (left, loose) = (
        rows_of(s, values) for s in ([source], leave_out([source], [token]))
    )
    assert rows.keys() - left.keys() == {*gone.get("gone", ())}
    assert left.keys() <= rows.keys() and loose.keys() == sigma.keys()
    for name, mine in left.items():
        expected = 0 * rows[name] if name in gone.get("zero", ()) else rows[name]
        np.testing.assert_array_equal(mine, expected, err_msg=name)
    free = {name for name in sigma if loose[name] != sigma[name]}
    assert free == {*gone.get("free", ())}
    assert all(loose[name] == 1.0 for name in free), "m or rad: as good as unknown"


@pytest.mark.parametrize("part", ["surface", "patch"])
def test_no_beam_meets_a_part_of_the_mesh_that_is_left_out(box, tmp_path, part):
    """And all others meet what they met, whether they look anew or are known to."""
    source = Source.open(box)
    values, gone = state([source]), 2
    if part == "patch":
        scan = build([source], MODEL).scans[0]
        met = scan.associate(values, near_edges=False).part
        gone = int(scan.settled(met, values).patches[part].max())
    token = f"mesh:{part}_{gone}"
    whole, less = build([source], MODEL), build(leave_out([source], [token]), MODEL)
    for a, b in zip(whole.scans, less.scans, strict=True):
        met = a.associate(values, near_edges=False).part
        number = source.reference.facts(met)[2]
        if part == "patch":
            number = a.settled(met, values).patches["patch"]
        expected = np.where(number == gone, -1, met)
        np.testing.assert_array_equal(b.associate(values, near_edges=False).part, expected)
        np.testing.assert_array_equal(b.settled(met, values).part, expected)
        assert 0 < np.sum(expected >= 0) < np.sum(met >= 0)
    # A run that grows from another knows what beams met there.
    run = calibrate([box], tmp_path / "run", Model(("ring_range_offset",)), "none")
    grown = add(run, (), tmp_path / "grown", without=[token])
    fresh = calibrate([box], tmp_path / "fresh", model_of(grown), "none")
    assert run.summary["points"] > grown.summary["points"] == fresh.summary["points"]


def test_a_rod_without_both_markers_is_left_out(box):
    source = Source.open(box)
    values = state([source])
    found = [
        rows_of(leave_out([source], t), values)[0] for t in (["t1:rod"], ["t1:lower", "t1:upper"])
    ]
    assert found[0].keys() == found[1].keys()
    for name, rows in found[0].items():
        np.testing.assert_array_equal(rows, found[1][name])


@pytest.mark.parametrize("guessed", [True, False], ids=["a guess", "no guess"])
def test_a_fit_starts_where_too_few_targets_are_left(box, tmp_path, guessed):
    """From what is guessed, or from all targets that there are; no row of theirs comes back."""
    rec = shutil.copytree(box, tmp_path / "rec")
    if not guessed:
        broken.without("stops.csv", r"base_guess\..*")(rec)
    tokens = [f"t{i}:sphere" for i in range(3)]
    few, none = (
        leave_out([Source.open(rec)], t) for t in (tokens, [f"t{i}:rod" for i in range(4)])
    )
    whole = build([Source.open(rec)], MODEL)
    for problem in (build(few, MODEL), build(none, MODEL)):
        away = se3.log(se3.inverse(whole.initial["faro"]) @ problem.initial["faro"])
        assert np.abs(away).max() < (0.1 if guessed else 1e-2)
    assert not any(block.kind == "target" for block in problem.blocks)


def test_where_joints_have_no_error_one_reading_is_left_out_alone(tmp_path):
    arm = rigs.drawing()["arm"] | {"sigma_joint_rad": 0}
    source = Source.open(rigs.write(tmp_path / "box", arm=arm, **BY_STOP))
    for sources, count in (([source], 0), (leave_out([source], ["s1:lift"]), 1)):
        unknowns = build(sources, MODEL).variables
        assert sum(u.role is Role.JOINTS for u in unknowns.values()) == count
    np.testing.assert_allclose(unknowns["joints@s1"].sigma, [1e-7, 1.0, 1e-7])


def test_the_recording_on_disk_and_the_one_that_was_opened_stay_as_they_are(box):
    source = Source.open(box)
    before = source.recording.digest(), source.recording.bodies["base_markers"].copy()
    leave_out([source], [t for t in TOKENS if not t.startswith("t1:") or t == "t1:rod"])
    assert source.without == () and source.recording.digest() == before[0]
    np.testing.assert_array_equal(source.recording.bodies["base_markers"], before[1])
    assert source.recording.has_scan.all() and len(source.recording.targets.names) == 4


# --------------------------------------------------------------------------------------------- runs


@pytest.fixture(scope="module")
def run(box, tmp_path_factory):
    """A run without something of every kind; one stop is tracked by nothing."""
    model = Model(("arm_joint_offset", "ring_range_offset"), without=SEVERAL)
    return calibrate([box], tmp_path_factory.mktemp("run") / "run", model, "stop")


def test_a_run_without_all_that_is_a_fit_like_any_other(box, run):
    summary = run.summary
    assert summary["converged"] and summary["rms_mm"]["held_out"] > 0
    assert read_yaml(run.folder / "model.yaml")[0]["without"] == [*SEVERAL]
    assert model_of(run).without == SEVERAL
    assert {*reopened(run)[0].lacks("body")} == {
        ("s0", "base_markers"),
        ("s1", "base_markers"),
        ("s1", "mount_markers"),
    }


def test_what_follows_a_fit_leaves_it_out_too(box, run, tmp_path):
    problem = build(reopened(run), model_of(run))
    assert [scan.name for scan in problem.scans] == ["s0", "s1", "s3"]
    beams = sum(scan.rows(run.state(), None).usable.sum() for scan in problem.scans)
    rings = evaluate(run, tmp_path / "evaluated")["by"]["ring"]
    returns = sum(ring["n"] for ring in rings)  # four sweeps of three stops
    assert 4 * beams <= returns <= 4 * 3 * rigs.RINGS * rigs.COLUMNS
    assert Scene.of(run).stops(0) == [*rigs.STOPS], "bodies of the other are still seen"
    export(run, tmp_path / "export")
    assert any((tmp_path / "export").iterdir())


@pytest.mark.long
def test_a_run_without_all_that_is_reported(run, tmp_path):
    report([run], tmp_path / "report.html")
    assert (tmp_path / "report.html").stat().st_size > 0


def test_more_is_left_out_of_a_run_and_what_was_stays_out(box, run, tmp_path):
    grown = add(run, "arm_link_length", tmp_path / "grown", without=["s3:scan"])
    assert model_of(grown).without == (*SEVERAL, "s3:scan")
    assert "arm_link_length" in grown.effects
    assert grown.summary["points"] < run.summary["points"]
    with pytest.raises(InputError, match=r"--without s2:scan: that is left out already"):
        add(run, (), tmp_path / "again", without=["s2:scan"])


def test_what_a_model_leaves_out_is_what_is_left_out(box, run, tmp_path):
    """A run may grow into one with all of its recording again."""
    grown = grow(run, Model(("ring_range_offset",)), tmp_path / "whole")
    fresh = calibrate([box], tmp_path / "fresh", Model(("ring_range_offset",)), "stop")
    assert grown.summary["points"] == fresh.summary["points"] > run.summary["points"]


def test_the_command_that_is_printed_fits_the_same_without_more(box, run, rigcal, tmp_path):
    copy = Run.open(shutil.copytree(run.folder, tmp_path / "run"))
    command = command_without(copy, ["s0:scan"])
    program, *arguments = command.split()
    assert program == "rigcal" and rigcal(*arguments)[0] == 0
    again = Run.open(tmp_path / "run-without")
    expected = copy.model | {"without": [*SEVERAL, "s0:scan"]}
    assert again.model == expected


# --------------------------------------------------------------------------------------- bad input


@pytest.mark.parametrize(
    ("tokens", "said"),
    [
        (["s9:scan"], "--without s9:scan: no recording has that"),
        (["s1:base_marker"], "mesh:region_N or mesh:patch_N; did you mean s1:base_markers?"),
        (["lidar"], "write STOP:BODY"),
        (["s1:scan", "s1:scan"], "--without s1:scan: that is left out already"),
        (["s1:lift", "s1:lift"], "--without s1:lift: that is left out already"),
        (["cad:lidar", "box/cad:lidar"], "--without box/cad:lidar: that is left out already"),
        (["s1:mount_markers", "s1:mount_markers"], "left out already"),
        (["mesh:surface_99"], "no recording has that"),
        ([f"t{i}:lower" for i in range(4)], "no target has both of its markers"),
    ],
)
def test_what_cannot_be_left_out_is_said_in_one_sentence(box, tokens, said, rigcal, tmp_path):
    without = [part for token in tokens for part in ("--without", token)]
    code, out, err = rigcal("fit", box, "-o", tmp_path / "run", *without)
    assert (code, out) == (2, "") and said in " ".join(err.split())
    assert "Traceback" not in err and not (tmp_path / "run").exists()


@pytest.mark.parametrize("places", [("monday", "tuesday"), ("monday/rec", "tuesday/rec")])
def test_of_several_recordings_it_is_said_which(box, places, tmp_path):
    """By its folder, with as much of the path as tells it from the others."""
    folders = [shutil.copytree(box, tmp_path / place) for place in places]
    with mishaps.Scene(folders[1], np.random.default_rng()).sheet("targets.csv") as targets:
        targets.columns["lower_x"] = [repr(float(x) + 1e-6) for x in targets.columns["lower_x"]]
    sources = [Source.open(folder) for folder in folders]
    with pytest.raises(InputError) as refused:
        leave_out(sources, ["s1:scan"])
    assert str(refused.value) == (
        "--without s1:scan: several recordings have that; say which: "
        f"{places[0]}/s1:scan or {places[1]}/s1:scan"
    )
    first, second = leave_out(sources, [f"{places[1]}/s1:scan"])
    assert first.recording.has_scan.all() and not second.recording.has_scan[1]
    groups = {g for b in build(sources, MODEL).blocks for g in b.groups}
    assert len(groups) == 2 * (8 + 12), "no two are called the same"
    for each in leave_out(sources, ["cad:lidar"]):
        assert each.lacks("frame") == {("cad", "lidar")}, "one LiDAR, however many recordings"


def test_targets_of_a_later_recording_tell_an_earlier_one_where_the_scanner_is(box, tmp_path):
    first, second = (shutil.copytree(box, tmp_path / name) for name in ("first", "second"))
    (first / "targets.csv").unlink()
    one = build([Source.open(second), Source.open(first)], MODEL).initial["faro"]
    other = build([Source.open(first), Source.open(second)], MODEL).initial["faro"]
    np.testing.assert_array_equal(one, other)


def test_adding_nothing_and_leaving_nothing_out_is_refused(run, rigcal, tmp_path):
    code, out, err = rigcal("add", run.folder, "-o", tmp_path / "out")
    assert (code, out) == (2, "") and not (tmp_path / "out").exists()
    assert "give an EFFECT to add, or what to leave out with --without" in " ".join(err.split())
