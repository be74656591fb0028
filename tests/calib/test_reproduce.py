"""Runs made again from what they say of themselves, and what differs where one was changed."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

import calib
from calib.problem.model import Model
from calib.runs.calibrate import calibrate
from calib.runs.ladder import ladder
from calib.runs.reproduce import reproduce
from calib.runs.run import Run
from chains.errors import InputError
from sensors.documents import read_yaml, write_json, write_yaml
from sensors.recording import read_table, write_table

from . import rigs

SMALL = Model(("ring_range_offset",), ("mount.tx",))
FORMULA = "{name: lean, site: range, unit: m, sigma: 0.01, basis: [sin(2 * azimuth)]}"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Recordings, and runs that grew: first, second of an effect and a blunder, third of another;
    ``both`` of two recordings, ``later`` with a prior and ``after`` that, not to be changed."""
    folder = tmp_path_factory.mktemp("again")
    for seed in (4, 5):
        rigs.write(folder / f"rec{seed}", seed=seed)
    (folder / "lean.yaml").write_text(FORMULA)
    first = calibrate([folder / "rec4"], folder / "first", SMALL, "stop")
    second = calib.add(first, ["mount_slip@150"], folder / "second", without=["s3:scan"])
    calib.add(second, [str(folder / "lean.yaml")], folder / "deeper/third")
    both = [folder / "rec4", folder / "rec5"]
    calibrate(both, folder / "both", SMALL, "none")
    later = calibrate([folder / "rec5"], folder / "later", SMALL, "none", prior=folder / "first")
    calib.add(later, ["arm_joint_offset"], folder / "after")
    return folder


@pytest.fixture
def run(folder, tmp_path):
    """A copy of the first run, to be changed."""
    return Run.open(shutil.copytree(folder / "first", tmp_path / "run"))


def changed(run, name, change):
    """The run with something else in one of its documents."""
    path = run.folder / name
    if path.suffix == ".json":
        data = json.loads(path.read_text())
        change(data)
        write_json(path, data)
    else:
        data = read_yaml(path)[0]
        change(data)
        write_yaml(path, data)
    return Run.open(run.folder)


# --------------------------------------------------------------------------------- what is the same


@pytest.mark.parametrize("name", ["first", "second", "deeper/third", "both", "later", "after"])
@pytest.mark.long
def test_a_run_is_made_again(folder, name):
    found = reproduce(Run.open(folder / name))
    assert (found.identical, found.versions) == (True, {})
    assert found.files == 4 + len(list((folder / name / "residuals.parquet").iterdir()))


@pytest.mark.long
def test_the_steps_of_growth_are_made_again_and_not_the_runs(folder, tmp_path):
    """A run that stands alone holds all that it needs, but for its recording."""
    alone = Run.open(shutil.copytree(folder / "deeper/third", tmp_path / "x/alone"))
    assert [len(step["without"]) for step in alone.model["steps"]] == [0, 1]
    assert reproduce(alone).identical


def test_a_recording_may_have_moved(folder, run, tmp_path):
    """Its old path leads nowhere now."""
    there = str(tmp_path / "gone")
    run = changed(run, "model.yaml", lambda m: m["recordings"][0].update(path=there))
    with pytest.raises(InputError, match=r"gone, which .*run was fitted to, is not there; say wi"):
        reproduce(run)
    moved = shutil.copytree(folder / "rec4", tmp_path / "moved")
    assert reproduce(run, [moved]).identical
    with pytest.raises(InputError, match=r"^2 recordings are given, and .* fitted to 1; give each"):
        reproduce(run, [moved, moved])


# ------------------------------------------------------------------------------------- what is not


def test_another_recording_is_refused(folder, run, tmp_path):
    with pytest.raises(InputError, match=r"rec5 has changed since .* was fitted to it"):
        reproduce(run, [folder / "rec5"])
    bent = shutil.copytree(folder / "rec4", tmp_path / "bent")
    lines = (bent / "stops.csv").read_text().splitlines()
    (bent / "stops.csv").write_text("\n".join([*lines[:-1], lines[-1] + " "]))
    with pytest.raises(InputError, match=r"bent has changed since"):
        reproduce(run, [bent])


def test_a_changed_estimate_is_told_in_its_sigmas(run):
    def move(document):
        lidar = document["frames"]["lidar"]
        w, *v = lidar["quat_wxyz"]
        R = np.array(rigs.Rotation.from_quat([*v, w]).as_matrix())
        along_z = 2.0 * lidar["sigma_m"][2] * R[:, 2]
        lidar["xyz_m"] = [x + by for x, by in zip(lidar["xyz_m"], along_z, strict=True)]

    found = reproduce(changed(run, "solution.yaml", move))
    name, sigmas = found.furthest
    assert name == "lidar.tz" and sigmas == pytest.approx(2.0, rel=1e-6)
    (difference,) = found.differences
    assert (difference.file, difference.entries) == ("solution.yaml", 1)
    assert difference.most == "frames.lidar.xyz_m"


def test_a_changed_error_is_told(run):
    told = run.summary["rms_mm"]["held_out"]
    found = reproduce(changed(run, "summary.json", lambda s: s["rms_mm"].update(held_out=0.5)))
    (difference,) = found.differences
    assert (difference.most, difference.was) == ("rms_mm.held_out", 0.5)
    assert difference.now == pytest.approx(told, rel=1e-12)
    assert found.furthest[1] == 0.0


def test_how_long_it_took_is_no_difference(run):
    assert reproduce(changed(run, "summary.json", lambda s: s.update(seconds=1e6))).identical


def test_changed_and_missing_rows_are_told(run):
    table = run.folder / "residuals.parquet/s1.parquet"
    columns = read_table(table)
    columns["residual_m"][7] += 0.25
    write_table(table, columns)
    (run.folder / "residuals.parquet/s2.parquet").unlink()
    shutil.copyfile(table, run.folder / "residuals.parquet/s9.parquet")
    first, second, third = reproduce(run).differences
    assert first.file == "residuals.parquet/s1.parquet" and first.most == "residual_m"
    assert first.was - first.now == pytest.approx(0.25, rel=1e-5)
    assert (second.file[-10:], second.most) == ("s2.parquet", "the file is missing from the run")
    assert (third.file[-10:], third.most) == ("s9.parquet", "the file is only in the run")


def test_a_changed_covariance_and_state_are_told(run):
    for name, key in (("covariance.npz", "covariance"), ("state.npz", "state/faro")):
        with np.load(run.folder / name) as stored:
            arrays = dict(stored)
        arrays[key].flat[3] *= 1 + 1e-12
        np.savez(run.folder / name, **arrays)
    assert [(d.file, d.most) for d in reproduce(run).differences] == [
        ("covariance.npz", "covariance"),
        ("state.npz", "state/faro"),
    ]


def test_another_model_gives_other_numbers(run):
    """The model says what is fitted: a run whose model was edited does not follow from it."""
    found = reproduce(changed(run, "model.yaml", lambda m: m.update(fixed=[])))
    assert not found.identical and found.furthest[1] > 0


def test_other_versions_are_told(run):
    bent = changed(run, "model.yaml", lambda m: m["versions"].update(numpy="1.0", python="2.7"))
    found = reproduce(bent)
    assert found.identical and found.versions.keys() == {"numpy", "python"}
    assert found.versions["numpy"] == ("1.0", np.__version__)


def test_a_changed_prior_is_refused(folder, run, tmp_path):
    later = calibrate([folder / "rec5"], tmp_path / "later", SMALL, "none", prior=run.folder)
    assert later.model["prior"] == "../run" and later.prior == run.folder.resolve()
    changed(run, "solution.yaml", lambda s: s["frames"]["lidar"].update(xyz_m=[0, 0, 0.1]))
    with pytest.raises(InputError, match=r"run, the prior of .*later, has changed since"):
        reproduce(later)


# ------------------------------------------------------------------------ runs that stand elsewhere


def test_runs_that_are_moved_together_still_know_each_other(folder, tmp_path):
    for name in ("first", "second", "deeper/third"):
        shutil.copytree(folder / name, tmp_path / "else" / name)
    third = Run.open(tmp_path / "else/deeper/third")
    assert [rung.run.folder.resolve() for rung in ladder([third])] == [
        (tmp_path / "else" / name).resolve() for name in ("first", "second", "deeper/third")
    ]


def test_a_stranger_in_the_place_of_a_run_is_not_taken_for_it(folder, tmp_path):
    third = shutil.copytree(folder / "deeper/third", tmp_path / "deeper/third")
    shutil.copytree(folder / "both", tmp_path / "second")
    (rung,) = ladder([Run.open(third)])
    assert rung.below is None and "which is gone" in rung.step


# ------------------------------------------------------------------------------------------ formats


def test_a_run_without_a_number_is_read(folder, run):
    """Those of before there were numbers: they name each other by absolute paths."""

    def back(model):
        for key in ("format", "steps", "prior_sha256"):
            del model[key]
        model["grown_from"] = str(folder / "first")

    old = changed(run, "model.yaml", back)
    assert old.grown_from == (folder / "first").resolve()
    with pytest.raises(InputError, match=r"grew from a run, and it or one below it was written by"):
        reproduce(old)
    after = calib.add(old, ["arm_joint_offset"], run.folder.parent / "after")
    with pytest.raises(InputError, match=r"note by which steps; fit and add anew$"):
        reproduce(after)
    first = changed(replace(old), "model.yaml", lambda m: m.update(grown_from=None))
    assert reproduce(first).identical


def test_a_newer_run_is_refused_by_what_wrote_it(run):
    sentence = (
        r"model\.yaml: this run is of format 7, and this version of rigcal reads formats up to 2; "
        r"open it with rigcal 3\.1, which wrote it$"
    )
    with pytest.raises(InputError, match=sentence):
        changed(run, "model.yaml", lambda m: m.update(format=7, versions={"rigcal": "3.1"}))


@pytest.mark.parametrize("number", [0, "2", 1.5, True, None])
def test_a_number_that_is_none_is_refused(run, number):
    with pytest.raises(InputError, match=r"model\.yaml: format: a whole number from 1 is wanted"):
        changed(run, "model.yaml", lambda m: m.update(format=number))


# ------------------------------------------------------------------------------- the command line


def test_the_command_says_it_and_its_exit_code_too(run, rigcal):
    code, out, err = rigcal("reproduce", run.folder)
    assert (code, err) == (
        0,
        "",
    ) and "identical: of the repeated run all 12 files hold the same." in out
    assert json.loads(rigcal("reproduce", run.folder, "--json")[1])["identical"] is True
    changed(run, "summary.json", lambda s: s.update(points=3))
    changed(run, "model.yaml", lambda m: m["versions"].update(gtsam="4.2"))
    code, out, _ = rigcal("reproduce", run.folder)
    assert code == 3 and "differs: made again, 1 of 12 files hold something else." in out
    assert "Of the estimates none moved." in out and "4.2 then" in out
    code, out, _ = rigcal("reproduce", run.folder, "--json")
    document = json.loads(out)
    assert (code, document["identical"]) == (3, False)
    assert document["differences"][0]["most"] == "points"
    code, out, err = rigcal("reproduce", run.folder, "--recording", run.folder / "nowhere")
    assert (code, out) == (2, "") and "say with --recording PATH where it is now" in err
