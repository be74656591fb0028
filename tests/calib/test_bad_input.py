"""Bad input on the command line: one sentence that names the place and the remedy, exit code 2.

A valid recording is simulated once; every case breaks one thing in a copy of it.
"""

import re
import shutil
import sys

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest

from calib import fit
from calib.cli import main
from calib.results.check import check
from calib.rig import load_rig
from calib.simulation import Spec, simulate
from sensors.recording import read_table, write_table

from .broken import (
    all_of,
    cells,
    mesh,
    overwrite,
    remove,
    rig,
    rows,
    table,
    text,
    thousandfold,
    without,
)

SPEC = Spec(lidar="hesai_pandarxt32", locations=2, stops_per_location=2, column_step=200)
STOPS, TARGETS, SCAN, FACES, MESH = (
    "stops.csv",
    "targets.csv",
    "scans/L00P00.parquet",
    "reference/faces.parquet",
    "reference/mesh.ply",
)
UNSEEN = cells(STOPS, r".*_markers\..*", "")
ZERO = dict.fromkeys("xyz", np.zeros_like)
ARM_2 = {"parent": "base", "xyz_m": [0, 0, 1], "sigma_m": 0, "sigma_rad": 0}
PARENT_MOUNT = [
    rig("frames", name, "parent", value="mount") for name in ("arm_base", "base_markers")
]


def on_a_line(before: str) -> str:
    """Targets whose spheres stand on one line."""
    head, *lines = before.splitlines()
    names = [line.split(",")[0] for line in lines]
    return "\n".join([head, *(f"{n},{i},0,1,{i},0,2,{i},0,1.5" for i, n in enumerate(names))])


MISSING = {
    "rig": (remove("rig.yaml"), "rig.yaml does not exist", "folder"),
    "stops": (remove(STOPS), "stops.csv does not exist", "row for every stop"),
    "urdf": (remove("arm.urdf"), "rig.yaml:", "arm.urdf does not exist", "drop the key"),
    "mesh": (remove(MESH), "reference.mesh", "mesh.ply does not exist"),
    "faces": (remove(FACES), "reference.faces", "faces.parquet does not exist"),
    "labels": (remove("reference/labels.yaml"), "reference.labels", "does not exist"),
    "joint": (without(STOPS, "joint_3"), "column joint_3 is missing", "URDF"),
    "body": (without(STOPS, r"base_markers\.[xyz]"), "column base_markers.x is missing"),
    "ring": (table(SCAN, ring=None), SCAN, "column ring is missing"),
}
UNREADABLE = {
    "rig": (text("rig.yaml", "name:", "name: ["), "rig.yaml:"),
    "urdf": (text("arm.urdf", "<robot", "<<robot"), "arm.urdf", "not XML", "URDF"),
    "scan": (overwrite(SCAN), SCAN, "not a Parquet file"),
    "mesh": (overwrite(MESH), MESH, "PLY, OBJ or STL"),
    "labels": (text("reference/labels.yaml", lambda t: "[floor]\n"), "labels.yaml", "0: floor"),
    "ragged stops": (text(STOPS, lambda t: t.rstrip() + ",1\n"), "stops.csv:5", "cells"),
    "semicolons": (text(STOPS, lambda t: t.replace(",", ";")), "stops.csv:1", "commas"),
    "tabs": (text(STOPS, lambda t: t.replace(",", "\t")), "stops.csv:1", "by tabs", "commas"),
    "empty stops": (text(STOPS, lambda t: ""), "stops.csv: the file is empty", "columns"),
}
TYPES = {
    "joint": (cells(STOPS, "joint_2", "abc", 1), "row 2 (L00P01)", "joint_2 is 'abc'"),
    "no joint": (cells(STOPS, "joint_2", "", 1), "row 2 (L00P01)", "joint_2 is empty"),
    "time": (cells(STOPS, "time_s", "nan", 2), "row 3 (L01P00)", "time_s is empty"),
    "stop twice": (cells(STOPS, "stop", "L00P00", 1), "row 2", "L00P00 is there twice"),
    "x": (table(SCAN, x=lambda x: x.astype(str)), SCAN, "column x is string", "float32"),
    "ring": (table(SCAN, ring=lambda r: r + 0.5), SCAN, "column ring is double", "uint16"),
    "key": (rig("lidar", "frme", value="x"), "rig.yaml:", "lidar.frme", "did you mean frame"),
    "model": (rig("lidar", "model", value="hesai_pandarx32"), "did you mean hesai_pandarxt32"),
    "name": (rig("name", value="a/b"), "rig.yaml:", "name", "a/b"),
}
POSES = {
    "nan": (cells(STOPS, r"base_markers\.y", "nan", 2), "row 3 (L01P00)", "base_markers.y"),
    "no unit": (cells(STOPS, r"base_markers\.qw", "2", 0), "row 1 (L00P00)", "length"),
    "degrees": (cells(STOPS, "joint_1", "45", 0), "row 1 (L00P00)", "joint_1", "degrees"),
    "never seen": (UNSEEN, "'L00P00'", "base_guess.x"),
    "base that is never seen nor moved": (
        all_of(UNSEEN, rig("base", "moves", value="never")),
        "'L00P00'",
        "base_guess.x",
    ),
    "mesh, but neither tracker nor guess": (
        all_of(
            rig("tracker", value=None),
            rig("target", value=None),
            rig("base", "moves", value="never"),
            remove(TARGETS),
        ),
        "'L00P00'",
        "base_guess.x",
    ),
    "no tie to the mesh": (remove(TARGETS), "'faro' to 'opti'", "targets.csv", "base_guess"),
    "a body twice": (
        rig("tracker", "bodies", value=["mount_markers"] * 2),
        "mount_markers",
        "twice",
    ),
}
FRAMES = {
    "two roots": (
        rig("frames", "mount", "parent", value="hand"),
        "rig.yaml:",
        "'hand'",
        "one root",
    ),
    "loop": (all_of(*PARENT_MOUNT), "rig.yaml:", "'mount'", "loop"),
    "two parents": (rig("frames", "arm_2", value=ARM_2), "rig.yaml:", "'arm_2' has two parents"),
    "one world": (rig("reference", "frame", value="opti"), "rig.yaml:", "'opti' is the tracker's"),
}
IMPOSSIBLE = {
    "ring": (table(SCAN, ring=lambda r: (r + 1).astype("u2")), SCAN, "ring 32", "0 to 31"),
    "empty scan": (rows(SCAN, slice(0)), SCAN, "no returns", "remove the file"),
    "scan of zeros": (table(SCAN, **ZERO), SCAN, "no returns"),
    "count": (table(SCAN, count=np.zeros_like), SCAN, "count is below 1"),
    "spread": (table(SCAN, range_std_m=np.negative), SCAN, "range_std_m is negative"),
    "faces too few": (rows(FACES, slice(1, None)), MESH, FACES, "give one each"),
    "faces of no use": (table(FACES, label=None, intensity=None), FACES, "label and intensity"),
    "mesh": (mesh(lambda v: np.where(v == v[0, 0], np.nan, v)), MESH, "vertex 0", "not finite"),
    "mesh elsewhere": (mesh(lambda v: v + np.full(3, 50.0)), "'L00P00'", "beams", "mesh"),
    "line of targets": (text(TARGETS, on_a_line), TARGETS, "one line", "area"),
    "two targets": (text(TARGETS, lambda t: "\n".join(t.splitlines()[:3])), TARGETS, "3 targets"),
}
MILLIMETRES = {
    "scan": (table(SCAN, **dict.fromkeys("xyz", thousandfold)), SCAN),
    "spread": (table(SCAN, range_std_m=thousandfold), SCAN, "range_std_m"),
    "tracker": (cells(STOPS, r"base_markers\.[xyz]", thousandfold), STOPS, "base_markers"),
    "targets": (cells(TARGETS, r".*_[xyz]", thousandfold), TARGETS, "row 1 (T1)"),
    "frame": (rig("frames", "mount", "xyz_m", value=[0, 0, 20]), "rig.yaml:", "frames.mount.xyz_m"),
    "rod": (rig("target", "sphere_below_lower_marker_m", value=180), "rig.yaml:", "target.sphere"),
    "mesh": (mesh(thousandfold), MESH),
    "urdf": (text("arm.urdf", "0.35", "350"), "arm.urdf", "'joint_3'"),
}
CASES = {
    f"{group} {name}": case
    for group, cases in {
        "missing": MISSING,
        "unreadable": UNREADABLE,
        "wrong type:": TYPES,
        "pose:": POSES,
        "frames:": FRAMES,
        "impossible": IMPOSSIBLE,
    }.items()
    for name, case in cases.items()
} | {f"millimetres in {name}": (*case, "millimetres") for name, case in MILLIMETRES.items()}


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """A recording with nothing wrong."""
    folder = tmp_path_factory.mktemp("bad_input") / "rec"
    simulate(SPEC, folder, seed=1)
    return folder


@pytest.fixture
def rec(recording, tmp_path):
    """A copy of it to break, alone in its folder."""
    return shutil.copytree(recording, tmp_path / "rec")


@pytest.fixture
def refused(rec, monkeypatch, capfd):
    """A function that runs a command, sees it refused, and returns the sentence that says why."""

    def run(*arguments):
        before = contents(rec.parent)
        monkeypatch.setattr(sys, "argv", ["rigcal", *map(str, arguments)])
        with pytest.raises(SystemExit) as exit_:
            main()
        out, err = capfd.readouterr()
        assert exit_.value.code == 2, err
        assert out == "" and err.startswith("rigcal: ") and err.count("\n") == 1, err
        assert contents(rec.parent) == before, "something was left behind, or changed"
        return err

    return run


def contents(folder):
    """Every file under a folder, hidden ones included, and every empty folder."""
    return {
        path.relative_to(folder): path.read_bytes() if path.is_file() else None
        for path in folder.rglob("*")
        if path.is_file() or not any(path.iterdir())
    }


@pytest.mark.parametrize("case", CASES)
def test_a_fit_refuses_a_recording_in_one_sentence(rec, refused, case):
    break_it, *parts = CASES[case]
    break_it(rec)
    sentence = refused("fit", rec, "-o", rec.parent / "run", "--hold-out", "none")
    for part in parts:
        assert part in sentence, sentence


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (["--effects", "arm_link_lenth"], ["arm_link_lenth", "did you mean 'arm_link_length'"]),
        (["--fix", "lidr"], ["--fix lidr", "lidar", "name.parameter"]),
        (["--fix", "faro"], ["--fix faro", "cannot be held"]),
        (["--hold-out", "never"], ["--hold-out never", "location, stop or none"]),
        (["--prior", "nowhere"], ["nowhere", "no run there", "rigcal fit"]),
        (["--folds", "9"], ["--folds", "5"]),
        (["nowhere"], ["nowhere", "rig.yaml does not exist"]),
        (["rec/../rec"], ["rec is given twice"]),
    ],
    ids=lambda value: " ".join(value[:1]),
)
def test_a_fit_refuses_an_argument_in_one_sentence(rec, refused, monkeypatch, arguments, parts):
    monkeypatch.chdir(rec.parent)
    sentence = refused("fit", rec, *arguments, "-o", rec.parent / "run")
    for part in parts:
        assert part in sentence, sentence


def test_a_copy_of_a_recording_is_refused(rec, refused):
    """As data it counts once, wherever it is."""
    shutil.copytree(rec, rec.parent / "copy")
    sentence = refused("fit", rec, rec.parent / "copy", "-o", rec.parent / "run")
    assert "rec and " in sentence and "copy hold the same measurements" in sentence


def test_a_stop_that_is_there_twice_is_refused_and_told(rec, refused):
    """Under another name and at another time; but not where the scans differ: several may be made
    at one pose, which was measured once. That `check` tells all the same."""
    stops = pd.read_csv(rec / "stops.csv", dtype=str)
    again = stops[:2].assign(stop=["again", "once_more"])
    pd.concat([stops, again.assign(time_s="99999")]).to_csv(rec / "stops.csv", index=False)
    for old, new in zip(stops["stop"], again["stop"], strict=False):
        shutil.copy(rec / "scans" / f"{old}.parquet", rec / "scans" / f"{new}.parquet")
    sentence = refused("fit", rec, "-o", rec.parent / "run")
    assert "again, once_more repeat other stops (again is L00P00 again)" in sentence
    for k, new in enumerate(again["stop"]):
        other = sorted((rec / "scans").glob("L0*.parquet"))[k + 2]
        table = pq.read_table(other).slice(1)
        pq.write_table(table, rec / "scans" / f"{new}.parquet")
    fit([rec], rec.parent / "run", hold_out="none")
    (odd,) = (each for each in check(rec).odd if "to every digit" in each)
    assert "again of L00P00, once_more of L00P01" in odd


def test_scans_that_two_recordings_hold_are_refused(rec, refused):
    """Whatever else has changed: a stop that one lacks, and digits of its table."""
    copy = shutil.copytree(rec, rec.parent / "copy")
    lines = (copy / "stops.csv").read_text().splitlines()
    digits = re.sub(r"(\d\.\d{6})\d+", r"\1", "\n".join(lines[:-1]))
    (copy / "stops.csv").write_text(digits)
    sentence = refused("fit", copy, rec, "-o", rec.parent / "run")
    assert "hold the same measurements: L00P00, L0" in sentence and "count once" in sentence


def test_another_lidar_under_the_same_name_is_refused(rec, refused):
    other = shutil.copytree(rec, rec.parent / "other")
    for scan in (other / "scans").glob("*.parquet"):
        table = read_table(scan)
        write_table(scan, table | {"x": table["x"] * 1.000001})  # no copy
    text = (other / "rig.yaml").read_text()
    model = load_rig(rec).lidar.name
    assert model != "ouster_os0_128_rev6"
    (other / "rig.yaml").write_text(text.replace(f"model: {model}", "model: ouster_os0_128_rev6"))
    sentence = refused("fit", rec, other, "-o", rec.parent / "run")
    assert (
        "ring_range_offset has other parameters here than in" in sentence and "ring_0" in sentence
    )
    assert "call this rig otherwise in rig.yaml" in sentence


def test_other_cad_under_the_same_name_is_refused(rec, refused):
    other = shutil.copytree(rec, rec.parent / "other")
    text = (other / "rig.yaml").read_text()
    at = re.search(r"base_markers:.*?xyz_m: \[([^,]*),", text, re.S)
    assert at
    (other / "rig.yaml").write_text(text[: at.start(1)] + "0.1" + text[at.end(1) :])
    for scan in (other / "scans").glob("*.parquet"):
        table = read_table(scan)
        write_table(scan, table | {"x": table["x"] * 1.000001})  # no copy
    sentence = refused("fit", rec, other, "-o", rec.parent / "run")
    assert (
        "base_markers elsewhere than that of" in sentence and "call one rig otherwise" in sentence
    )


def test_what_is_no_run_is_not_replaced(rec, refused):
    sentence = refused("fit", rec, "-o", rec)
    assert "rec exists" in sentence and "another folder" in sentence
    notes = rec.parent / "notes.txt"
    notes.write_text("mine")
    assert "notes.txt is a file; give a folder" in refused("fit", rec, "-o", notes)
    assert "run cannot be written" in refused("fit", rec, "-o", notes / "run")


def test_a_recording_is_no_run(rec, refused):
    assert "no run there" in refused("fit", rec, "-o", rec.parent / "run", "--prior", rec)
    assert "no run there" in refused("compare", rec)
    assert "no run there" in refused("export", rec, "-o", rec.parent / "out")


def test_the_recording_itself_is_fine(rec, monkeypatch, capfd):
    """Else every case above might be refused for another reason."""
    monkeypatch.setattr(sys, "argv", ["rigcal", "check", str(rec), "--json"])
    with pytest.raises(SystemExit) as exit_:
        main()
    assert exit_.value.code == 0, capfd.readouterr().out
