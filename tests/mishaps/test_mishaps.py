"""Mishaps do what they say, and who judges them can tell right from wrong."""

from __future__ import annotations

import json
import shutil
import zlib

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.simulation import Spec, simulate
from sensors.documents import write_yaml

from . import MISHAPS, Scene
from .judge import (
    Said,
    TooLong,
    at_most,
    blunders,
    detectable,
    largest,
    matches,
    off,
    read_truth,
)

SPEC = Spec(lidar="hesai_pandarxt32", locations=3, stops_per_location=3, column_step=120)


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    folder = tmp_path_factory.mktemp("mishaps") / "recording"
    simulate(SPEC, folder, seed=2)
    return folder


def contents(folder):
    return {p.relative_to(folder): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def spoilt(recording, folder, kind, times=10):
    copy = shutil.copytree(recording, folder)
    scene = Scene(copy, np.random.default_rng(zlib.crc32(kind.encode())))
    return scene, MISHAPS[kind].apply(scene, times)


@pytest.mark.parametrize("kind", MISHAPS)
def test_a_mishap_changes_something_and_the_same_each_time(recording, tmp_path, kind):
    before = contents(recording)
    scene, done = spoilt(recording, tmp_path / "one", kind)
    again, done_again = spoilt(recording, tmp_path / "two", kind)
    assert contents(scene.folder) != before
    assert contents(scene.folder) == contents(again.folder)
    assert done == done_again
    assert MISHAPS[kind].needs <= Scene(recording, np.random.default_rng()).features()


@pytest.mark.parametrize("kind", ["mount body shifted at one stop", "a sphere misplaced"])
def test_a_size_is_in_times_of_what_can_be_detected(recording, tmp_path, kind):
    name = "stops.csv" if "stop" in kind else "targets.csv"
    columns = r"mount_markers.x", "mount_markers.y", "mount_markers.z"
    if "sphere" in kind:
        columns = "faro_x", "faro_y", "faro_z"
    sizes = []
    for times in (1, 3):
        folder = tmp_path / str(times)
        scene, done = spoilt(recording, folder, kind, times)
        with scene.sheet(name) as after, Scene(recording, scene.rng).sheet(name) as before:
            moved = after.numbers(*columns) - before.numbers(*columns)
        sizes.append(np.nanmax(np.linalg.norm(moved, axis=1)))
        assert np.count_nonzero(np.nan_to_num(moved).any(axis=1)) == 1
        assert len(done.right) == 1 and done.right <= done.group
    assert sizes[1] == pytest.approx(3 * sizes[0])
    assert sizes[0] == pytest.approx(0.001 if "body" in kind else 0.003)


def test_what_cannot_be_told_apart_is_what_stands_on_one_way(recording, tmp_path):
    """Three ways to the sensor's mount: over base and joints, the mount's body, and the scan."""
    copy = shutil.copytree(recording, tmp_path / "recording")
    scene = Scene(copy, np.random.default_rng(0))
    stop = scene.stop("mount_markers")
    assert scene.group(f"{stop}:mount_markers") == {f"{stop}:mount_markers"}
    assert scene.group(f"{stop}:scan") == {f"{stop}:scan"}
    by_arm = {f"{stop}:base_markers", f"{stop}:joints"}
    assert scene.group(f"{stop}:joints") == by_arm
    hidden = next(
        (n for n, s in zip(scene.names, scene.seen("mount_markers"), strict=True) if not s)
    )
    assert scene.group(f"{hidden}:scan") == {
        f"{hidden}:{x}" for x in ("base_markers", "joints", "scan")
    }


# ------------------------------------------------------------------------------------ the judge


@pytest.fixture
def run(tmp_path):
    """A run that found two frames and an effect exactly."""
    frame = {"parent": "mount", "xyz_m": [0, 0, 0.1], "quat_wxyz": [1, 0, 0, 0]}
    sigma = {"sigma_m": [0.001] * 3, "sigma_rad": [0.002] * 3}
    effect = {"unit": "m", "names": ["joint_1", "joint_2"], "estimate": [0.01, 0.0]}
    document = {
        "frames": {"lidar": frame | sigma, "mount": frame | sigma},
        "effects": {"arm_link_length": effect | {"sigma": [0.001, 0.0]}},
        "not_estimated": [
            {"name": "mount (rx, rz … ty)", "why": ""},
            {"name": "arm_link_length.joint_1", "why": ""},
        ],
    }
    write_yaml(tmp_path / "solution.yaml", document)
    return tmp_path


def truth(shift_m=0.0, turn_rad=0.0, longer_m=0.0):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec([0, 0, turn_rad]).as_matrix()
    T[:3, 3] = [shift_m, 0, 0.1]
    lengths = {"joint_1": 0.01 + longer_m, "joint_2": 0.5}
    return {"frames": {"lidar": T, "mount": np.eye(4)}, "effects": {"arm_link_length": lengths}}


def test_errors_are_distances_in_sigmas(run):
    errors = off(run, truth(shift_m=0.005, turn_rad=0.006, longer_m=0.002))
    assert errors["lidar.tx"].sigmas == pytest.approx(5)
    assert errors["lidar.rz"].sigmas == pytest.approx(3)
    assert errors["lidar.ty"].sigmas == pytest.approx(0)
    assert errors["arm_link_length.joint_1"].sigmas == pytest.approx(2)
    assert "arm_link_length.joint_2" not in errors  # it was held


def test_values_may_come_in_the_order_of_parameters(run):
    by_name = truth(longer_m=0.002)
    in_order = by_name | {"effects": {"arm_link_length": [0.012, 0.5]}}
    assert off(run, by_name) == off(run, in_order)


def test_what_is_not_told_is_not_counted(run):
    errors = off(run, truth(shift_m=0.005, longer_m=0.02))
    assert not errors["arm_link_length.joint_1"].told
    assert errors["mount.tz"].sigmas == pytest.approx(100) and not errors["mount.tz"].told
    assert not errors["mount.rz"].told and errors["lidar.tx"].told
    assert largest(errors) == pytest.approx(5)
    assert largest(errors, {"lidar.tx": 0.0005}) == pytest.approx(10)


def test_blunders_have_the_names_that_without_takes():
    listed = [
        {"kind": "body", "name": "base_markers", "stop": "L03P02", "p_adjusted": 1e-6},
        {"kind": "scan", "name": "", "stop": "L03P02", "p_adjusted": 1e-3},
        {"kind": "frame", "name": "lidar", "p_adjusted": 1e-4, "detectable": 2e-3, "unit": "m"},
        {"kind": "body", "name": "mount", "stop": "L0", "p_adjusted": 0.5},
        {"kind": "target", "without": "T1:rod", "p_adjusted": 0, "indistinguishable_from": ["x"]},
    ]
    found = blunders({"blunders": listed})
    assert found == [["L03P02:base_markers"], ["L03P02:scan"], ["cad:lidar"], ["T1:rod", "x"]]
    told = {"cad:lidar": {"m": 2e-3, "rad": float("inf")}}
    assert detectable({"detectable": told}) == {"cad:lidar m": 2e-3}
    assert matches("L0:x", ["*:x"]) and not matches("L0:y", ["*:x"])


def test_a_refusal_is_one_sentence_and_exit_code_2():
    said = {"document": {}, "seconds": 0.0}
    assert Said(code=2, complaint="rigcal: no.\n", **said).refused
    assert not Said(code=2, complaint="rigcal: no.\nmore\n", **said).refused
    assert not Said(code=1, complaint="rigcal: no.\n", **said).refused


def test_truths_of_both_simulators_are_read(tmp_path):
    turned = np.eye(4)
    turned[:3, 3] = [1, 2, 3]
    ours = {"frames": {"lidar": turned.tolist()}, "effects": {"arm_link_length": [0.1, 0.2]}}
    (tmp_path / "ours.json").write_text(json.dumps(ours))
    assert read_truth(tmp_path / "ours.json") == ours
    document = {"dlen": [0.1, 0.2], "zero": [0.3], "T_faro_opti": turned.tolist()}
    (tmp_path / "theirs.json").write_text(json.dumps(document))
    found = read_truth(tmp_path / "theirs.json")
    assert found["effects"]["arm_link_length"] == {"joint_1": 0.1, "joint_tip": 0.2}
    np.testing.assert_allclose(found["frames"]["faro"][:3, 3], [-1, -2, -3])


def test_what_takes_too_long_is_ended():
    with pytest.raises(TooLong), at_most(0.05) as over:
        while True:
            pass
    assert over
    with at_most(10) as over:
        pass
    assert not over
