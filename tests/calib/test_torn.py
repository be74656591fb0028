"""Stops whose bodies contradict each other by metres: the scan there says which is wrong."""

import shutil

import numpy as np
import pytest

from calib.problem import build
from calib.problem.model import Model, Source
from calib.problem.without import leave_out
from calib.runs.calibrate import calibrate
from calib.runs.diagnose import diagnose
from calib.runs.run import Run
from calib.simulation import simulate
from calib.solve.fit import solve

from ..mishaps import Scene
from ..mishaps.scene import QUAT, XYZ

pytestmark = pytest.mark.slow
MORE = 6  # passes that it may take more than without what is wrong; it was 140 in all
SPOILT = ("L00P02", "L02P01")


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    folder = tmp_path_factory.mktemp("torn") / "rec"
    simulate("tiny", folder, 4)
    return folder


def zeros(scene, body):
    """What trackers write where they see nothing."""
    with scene.sheet("stops.csv") as sheet:
        columns = [f"{body}.{p}" for p in (*XYZ, *QUAT)]
        values = sheet.numbers(*columns)
        values[[scene.names.index(stop) for stop in SPOILT]] = [0, 0, 0, 1, 0, 0, 0]
        sheet.put(values, *columns)


def stuck(scene):
    """An encoder that reads at these stops what it read at the first."""
    with scene.sheet("stops.csv") as sheet:
        values = sheet.numbers("joint_3")
        values[[scene.names.index(stop) for stop in SPOILT]] = values[0] + 0.4
        sheet.put(values, "joint_3")


CASES = {
    "zeros of the mount": (lambda scene: zeros(scene, "mount_markers"), "mount_markers", set()),
    "zeros of the base": (lambda scene: zeros(scene, "base_markers"), "base_markers", {"joints"}),
    "a stuck encoder": (stuck, "base_markers", {"joints"}),  # the body at its other end
}


@pytest.fixture(scope="module", params=CASES)
def spoilt(request, good, tmp_path_factory):
    """The recording, and token -> what else at that stop may be wrong in its place."""
    spoil, body, rivals = CASES[request.param]
    folder = shutil.copytree(good, tmp_path_factory.mktemp("spoilt") / "rec")
    spoil(Scene(folder, np.random.default_rng(1)))
    return folder, {f"{stop}:{body}": {f"{stop}:{r}" for r in rivals} for stop in SPOILT}


def fitted(folder, without=()):
    source = leave_out([Source.open(folder)], without)
    return solve(build(source, Model.of(None, (), without)))


@pytest.mark.long
def test_the_fit_is_that_without_them(spoilt):
    folder, wrong = spoilt
    ours, theirs = fitted(folder), fitted(folder, sorted(wrong))
    assert ours.converged and ours.problem.set_aside == wrong.keys()
    assert ours.iterations <= theirs.iterations + MORE
    sigma = np.sqrt(np.diag(theirs.covariance))
    at = 0
    for variable in theirs.variables:
        own = sigma[at : at + variable.dim]
        at += variable.dim
        if variable.kind == "vector":
            apart = ours.values[variable.name] - theirs.values[variable.name]
            assert np.abs(apart / own).max() < 0.01, variable.name


@pytest.mark.long
def test_the_diagnosis_names_them_or_what_they_cannot_be_told_from(spoilt, tmp_path):
    folder, wrong = spoilt
    run = calibrate([folder], tmp_path / "run", hold_out="none")
    assert set(Run.open(tmp_path / "run").set_aside) == wrong.keys()
    found = diagnose(run, refits=False)
    named = {b["without"]: set(b["indistinguishable_from"]) for b in found.blunders}
    assert found.verdict == "bad_data" and named == wrong


def test_where_nothing_is_wrong_nothing_is_set_aside(good):
    assert fitted(good).problem.set_aside == frozenset()


def test_without_scans_neither_body_is_taken_to_be_right(good, tmp_path):
    """Two bodies that contradict each other, and nothing else there to say which is wrong."""
    folder = shutil.copytree(good, tmp_path / "rec")
    scene = Scene(folder, np.random.default_rng(1))
    zeros(scene, "mount_markers")
    for stop in SPOILT:
        scene.scan_path(stop).unlink()
    found = fitted(folder)
    assert found.converged and not found.problem.set_aside
    weights = {
        g.token: w
        for block in found.problem.bodies
        if block.weight is not None
        for g, w in zip(block.groups, block.weight, strict=True)
    }
    for stop in SPOILT:
        assert min(weights.get(f"{stop}:{b}", 1) for b in ("mount_markers", "base_markers")) > 0
