"""Poses of the one body of a rig without an arm that are written otherwise: the scans tell."""

import shutil
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from calib.results.check import check
from chains import se3

from .handheld import HAND, handheld, rewritten

LEVEL = replace(HAND, seed=6, turned=(0.0,) * 6)  # a cart: turned about the vertical only
WORLDS = {
    "hand": (HAND, {}),
    "cart": (LEVEL, {}),
    "guessed": (replace(HAND, seed=7), {"guess": (0.08, 0.03), "targets": False}),
    "clutter": (replace(HAND, seed=8, clutter=0.1), {}),
}


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    """Sound ones, by their name."""
    folder = tmp_path_factory.mktemp("readings")
    for name, (world, how) in WORLDS.items():
        handheld(folder / name, world, **how)
    return {name: folder / name for name in WORLDS}


def inverted(pose):
    T = se3.inverse(se3.from_xyz_quat(pose[:, :3], pose[:, 3:]))
    return np.concatenate([T[:, :3, 3], se3.to_quat_wxyz(T)], axis=1)


def left_handed(pose):
    """y points the other way, of the world and of the body; what turns about y still does."""
    return pose * [1, -1, 1, 1, -1, 1, -1]


def both(first, then):
    return lambda pose: then(first(pose))


ORDER = [0, 1, 2, 4, 5, 6, 3]  # qx, qy, qz, qw
HOLD = "the columns qw, qx, qy, qz of markers hold "
WRITTEN = {
    "xyzw": (lambda pose: pose[:, ORDER], HOLD + "qx, qy, qz, qw; write"),
    "conjugate": (lambda pose: pose * [1, 1, 1, 1, -1, -1, -1], HOLD + "qw, -qx, -qy, -qz"),
    "inverse": (inverted, "if the poses of markers are inverted"),
    "inverse in another order": (
        both(inverted, lambda pose: pose[:, ORDER]),
        HOLD + "qx, qy, qz, qw and the poses of markers are inverted",
    ),
    "y up": (lambda pose: pose[:, [0, 2, 1, 3, 4, 6, 5]], "x, z, y and qw, qx, qz, qy of markers"),
    "left-handed": (left_handed, "x, -y, z and qw, -qx, qy, -qz of markers in place"),
}


@pytest.mark.parametrize("name", WORLDS)
@pytest.mark.parametrize(("change", "said"), WRITTEN.values(), ids=WRITTEN)
def test_poses_that_are_written_otherwise_are_told(recordings, tmp_path, name, change, said):
    folder = shutil.copytree(recordings[name], tmp_path / "other")
    rewritten(folder, change)
    found = check(folder)
    told = [line for line in found.odd if line.startswith("the scans")]
    assert len(told) == 1 and said in told[0] and "targets.csv" not in told[0], told
    (suspect,) = found.suspects
    assert suspect["name"] == "markers" and suspect["without"] is None and not found.command


@pytest.mark.parametrize("name", WORLDS)
def test_nothing_is_told_of_sound_ones(recordings, name):
    assert [line for line in check(recordings[name]).odd if line.startswith("the scans")] == []


def test_a_body_that_is_seen_where_nothing_was_scanned_says_nothing(recordings, tmp_path):
    folder = shutil.copytree(recordings["guessed"], tmp_path / "other")
    seen = np.arange(8)[:, None] == 0
    rewritten(folder, lambda pose: np.where(seen, inverted(pose), np.nan))
    (folder / "scans" / "L00P00.parquet").unlink()
    found = check(folder)
    assert found.problems == [] and not any("poses of" in line for line in found.odd)


# ------------------------------------------------------------------------------------- left-handed

MIRRORS = {  # what of the tracker's x, y, z is written, and its sign
    "y": ([0, 1, 2], [1, -1, 1]),
    "z": ([0, 1, 2], [1, 1, -1]),
    "y and z exchanged": ([0, 2, 1], [1, 1, 1]),
}


def mirrored(folder, order, sign):
    """All that the tracker says of targets, in a left-handed world."""
    table = pd.read_csv(folder / "targets.csv")
    for part in ("upper", "lower"):
        columns = [f"{part}_{axis}" for axis in "xyz"]
        table[columns] = table[columns].to_numpy()[:, order] * sign
    table.to_csv(folder / "targets.csv", index=False)


@pytest.mark.parametrize(("order", "sign"), MIRRORS.values(), ids=MIRRORS)
def test_no_sphere_is_blamed_where_all_are_mirrored(recordings, tmp_path, order, sign):
    folder = shutil.copytree(recordings["hand"], tmp_path / "other")
    mirrored(folder, order, sign)
    (told,) = [s for s in check(folder, graph=False).odd if "targets" in s]
    assert told.startswith("tracker and scanner place all targets within ")
    assert "left-handed" in told


def test_one_sphere_elsewhere_is_named(recordings, tmp_path):
    """No mirror sets right what is wrong with one."""
    folder = shutil.copytree(recordings["hand"], tmp_path / "other")
    table = pd.read_csv(folder / "targets.csv")
    table.loc[0, "faro_x"] += 0.3
    table.to_csv(folder / "targets.csv", index=False)
    assert [s["name"] for s in check(folder, graph=False).suspects] == [table.target[0]]


def test_a_left_handed_export_of_all_is_told_of_bodies_and_targets(recordings, tmp_path):
    folder = shutil.copytree(recordings["hand"], tmp_path / "other")
    rewritten(folder, left_handed)
    mirrored(folder, *MIRRORS["y"])
    found = check(folder)
    assert [(s["kind"], s["name"]) for s in found.suspects] == [
        ("target", "handedness"),
        ("body", "markers"),
    ]
    assert not found.command
    (told,) = [line for line in found.odd if line.startswith("the scans")]
    assert "x, -y, z and qw, -qx, qy, -qz of markers in place" in told
    assert told.endswith("write them so, and x, -y, z of upper and lower in targets.csv")
