"""Bad input on the command line: one sentence that names the place and the remedy, exit code 2.

A valid recording is simulated once; every case breaks one thing in a copy of it.
"""

import re
import shutil
import sys

import numpy as np
import pytest

from calib.cli import main
from calib.simulate import Spec, simulate
from sensors.documents import read_yaml, write_yaml
from sensors.recording import read_table, write_table

SPEC = Spec(lidar="hesai_pandarxt32", locations=2, stops_per_location=2, column_step=200)
STOPS = ("L00P00", "L00P01", "L01P00", "L01P01")
GUESS = [f"base_guess.{part}" for part in ("x", "y", "z", "qw", "qx", "qy", "qz")]


@pytest.fixture(scope="session")
def recording(tmp_path_factory):
    """A recording with nothing wrong."""
    folder = tmp_path_factory.mktemp("bad_input") / "rec"
    simulate(SPEC, folder, seed=1)
    return folder


@pytest.fixture
def rec(recording, tmp_path):
    """A copy of it to break, alone in its folder."""
    shutil.copytree(recording, tmp_path / "rec")
    return tmp_path / "rec"


@pytest.fixture
def refused(rec, monkeypatch, capfd):
    """A function that runs a command, sees it refused, and returns the sentence that says why."""

    def run(*arguments):
        before = contents(rec.parent)
        capfd.readouterr()
        monkeypatch.setattr(sys, "argv", ["rigcal", *map(str, arguments)])
        with pytest.raises(SystemExit) as exit_:
            main()
        out, err = capfd.readouterr()
        assert exit_.value.code == 2, err
        import os

        os.environ.get("SHOW") and open(os.environ["SHOW"], "a").write(err)
        assert out == "" and err.startswith("rigcal: ") and err.count("\n") == 1, err
        assert contents(rec.parent) == before, "something was left behind"
        return err

    return run


def contents(folder):
    """Every file and folder under a folder, hidden ones included, with size and time of change."""
    return {
        str(path.relative_to(folder)): (path.stat().st_size, path.stat().st_mtime_ns)
        for path in folder.rglob("*")
        if path.is_file() or not any(path.iterdir())
    }


# ------------------------------------------------------------------------------- how to break it


def edit(name, change):
    """Break a text file: `change` is called with its text, or is (old, new) to replace once."""

    def apply(rec):
        text = (rec / name).read_text()
        if callable(change):
            text = change(text)
        else:
            assert change[0] in text, change[0]
            text = text.replace(*change, 1)
        (rec / name).write_text(text)

    return apply


def cell(name, column, row, value):
    """Break cells of a CSV file: of one row, or of all where `row` is None.

    `value` is a text, a function of the number there, or None to leave the column out.
    """

    def change(text):
        head, *rows = [line.split(",") for line in text.splitlines()]
        at = [i for i, c in enumerate(head) if re.fullmatch(column, c)]
        assert at, column
        if value is None:
            rows = [[c for i, c in enumerate(r) if i not in at] for r in rows]
            head = [c for i, c in enumerate(head) if i not in at]
        for r in rows if row is None and value is not None else rows[row or 0 : (row or 0) + 1]:
            for i in at if value is not None else ():
                r[i] = value(float(r[i] or "nan")) if callable(value) else value
        return "\n".join(",".join(map(str, r)) for r in (head, *rows)) + "\n"

    return edit(name, change)


def table(name, **columns):
    """Break a Parquet file: columns as functions of what is there; None leaves one out."""

    def apply(rec):
        old = read_table(rec / name)
        new = {c: f(old[c]) if f else None for c, f in columns.items()}
        write_table(rec / name, {c: v for c, v in (old | new).items() if v is not None})

    return apply


def rig(*keys, value):
    """Break a value of rig.yaml; None takes the key out."""

    def apply(rec):
        data, _ = read_yaml(rec / "rig.yaml")
        part = data
        for key in keys[:-1]:
            part = part[key]
        if value is None:
            del part[keys[-1]]
        else:
            part[keys[-1]] = value(part[keys[-1]]) if callable(value) else value
        write_yaml(rec / "rig.yaml", data)

    return apply


def overwrite(name):
    """Put a text where a binary file was."""
    return lambda rec: (rec / name).write_text("x,y,z\n")


def remove(name):
    """Take a file or folder away."""

    def apply(rec):
        path = rec / name
        shutil.rmtree(path) if path.is_dir() else path.unlink()

    return apply


def mesh(change):
    """Move the mesh's vertices."""

    def apply(rec):
        raw = (rec / "reference/mesh.ply").read_bytes()
        start = raw.index(b"end_header\n") + len(b"end_header\n")
        count = int(re.search(rb"element vertex (\d+)", raw)[1])
        vertices = np.frombuffer(raw, "<f8", 3 * count, start).reshape(-1, 3)
        new = np.ascontiguousarray(change(vertices.copy()), "<f8").tobytes()
        (rec / "reference/mesh.ply").write_bytes(raw[:start] + new + raw[start + len(new) :])

    return apply


def both(*breaks):
    """Break several things."""

    def apply(rec):
        for each in breaks:
            each(rec)

    return apply


def on_a_line(text):
    """Move all spheres and markers of targets.csv onto one line."""
    head, *rows = text.splitlines()
    out = [head]
    for i, row in enumerate(rows):
        name = row.split(",")[0]
        numbers = [i, 0, 1, i, 0, 2, i, 0, 1.5]
        out.append(",".join([name, *map(str, numbers)]))
    return "\n".join(out) + "\n"


URDF_ROOT = '<link name="arm_base"/>'
FIRST = "scans/L00P00.parquet"
MILLI = lambda x: 1000 * x  # noqa: E731
UNSEEN = cell("stops.csv", r".*_markers\..*", None, "")

CASES = {
    # missing
    "no rig": (remove("rig.yaml"), "rig.yaml", "does not exist"),
    "no stops": (remove("stops.csv"), "stops.csv", "does not exist"),
    "no urdf": (remove("arm.urdf"), "rig.yaml:", "arm.urdf", "does not exist"),
    "no mesh": (remove("reference/mesh.ply"), "mesh.ply does not exist", "drop the key"),
    "no faces": (remove("reference/faces.parquet"), "reference.faces", "faces.parquet"),
    "no labels": (remove("reference/labels.yaml"), "reference.labels", "labels.yaml"),
    # of the wrong type or shape
    "rig is no yaml": (edit("rig.yaml", ("name:", "name: [")), "rig.yaml:"),
    "unknown key": (rig("lidar", "frme", value="x"), "lidar.frme", "did you mean frame"),
    "unknown lidar": (rig("lidar", "model", value="hesai_xt32"), "hesai_pandarxt32"),
    "joint is text": (cell("stops.csv", "joint_2", 1, "abc"), "row 2 (L00P01)", "joint_2", "'abc'"),
    "joint is empty": (cell("stops.csv", "joint_2", 1, ""), "row 2 (L00P01)", "joint_2"),
    "time is nan": (cell("stops.csv", "time_s", 2, "nan"), "row 3 (L01P00)", "time_s"),
    "stop twice": (cell("stops.csv", "stop", 1, "L00P00"), "row 2", "L00P00", "twice"),
    "ragged": (edit("stops.csv", lambda t: t.rstrip() + ",1\n"), "stops.csv:5", "cells"),
    "semicolons": (edit("stops.csv", lambda t: t.replace(",", ";")), "stops.csv:1", "commas"),
    "x is text": (table(FIRST, x=lambda x: x.astype(str)), FIRST, "column x", "float32"),
    "ring is float": (table(FIRST, ring=lambda r: r + 0.5), FIRST, "column ring", "uint16"),
    "no ring": (table(FIRST, ring=None), FIRST, "column ring is missing"),
    "no parquet": (overwrite(FIRST), FIRST, "not a Parquet file"),
    "urdf is no xml": (edit("arm.urdf", ("<robot", "<<robot")), "arm.urdf", "not XML"),
    "mesh is no mesh": (overwrite("reference/mesh.ply"), "mesh.ply", "PLY, OBJ or STL"),
    "labels are a list": (edit("reference/labels.yaml", lambda t: "[floor]\n"), "labels.yaml", "0: floor"),
    "faces too few": (
        table("reference/faces.parquet", label=lambda a: a[:-3], intensity=lambda a: a[:-3]),
        "mesh.ply", "faces.parquet", "triangles",
    ),
    "faces of no use": (
        table("reference/faces.parquet", label=None, intensity=None), "faces.parquet", "label",
    ),
    # poses
    "nan in a pose": (cell("stops.csv", r"base_markers\.y", 2, "nan"), "row 3 (L01P00)", "base_markers.y"),
    "no unit quaternion": (cell("stops.csv", r"base_markers\.qw", 0, "2"), "row 1", "base_markers.qw", "length"),
    "no such body": (cell("stops.csv", r"base_markers\.[xyz]", None, None), "base_markers.x is missing"),
    "joint is missing": (cell("stops.csv", "joint_3", None, None), "column joint_3 is missing", "URDF"),
    "degrees": (cell("stops.csv", "joint_1", 0, "45"), "row 1", "joint_1", "degrees"),
    "never seen": (UNSEEN, "no tracker sees", "base_guess"),
    "never seen, no targets": (both(UNSEEN, remove("targets.csv")), "targets.csv", "base_guess"),
    "never seen, never moves": (both(UNSEEN, rig("base", "moves", value="never")), "base_guess"),
    "mesh but no pose": (
        both(rig("tracker", value=None), rig("base", "moves", value="never"), remove("targets.csv")),
        "base_guess",
    ),
    # frames
    "two roots": (rig("frames", "mount", "parent", value="elsewhere"), "frames", "'elsewhere'", "one tree"),
    "a loop": (
        both(rig("frames", "arm_base", "parent", value="mount"), rig("frames", "base_markers", "parent", value="mount")),
        "loop",
    ),
    "two parents": (rig("frames", "arm_2", value={"parent": "base", "xyz_m": [0, 0, 1], "sigma_m": 0, "sigma_rad": 0}), "'arm_2' has two parents"),
    # what the sensor cannot have delivered
    "ring beyond": (table(FIRST, ring=lambda r: (r + 1).astype("u2")), FIRST, "ring 32", "0 to 31"),
    "empty scan": (table(FIRST, **dict.fromkeys(("x", "y", "z", "ring", "column", "intensity", "count", "range_std_m"), lambda a: a[:0])), FIRST, "no returns"),
    "scan of zeros": (table(FIRST, x=np.zeros_like, y=np.zeros_like, z=np.zeros_like), FIRST, "no returns"),
    "count is zero": (table(FIRST, count=np.zeros_like), FIRST, "count is below 1"),
    # millimetres
    "scan in mm": (table(FIRST, x=MILLI, y=MILLI, z=MILLI), FIRST, "millimetres"),
    "tracker in mm": (cell("stops.csv", r"base_markers\.[xyz]", None, MILLI), "stops.csv", "base_markers", "millimetres"),
    "targets in mm": (cell("targets.csv", r".*_[xyz]", None, MILLI), "targets.csv", "millimetres"),
    "frame in mm": (rig("frames", "mount", "xyz_m", value=[0, 0, 20]), "rig.yaml:", "mount.xyz_m", "millimetres"),
    "frame in degrees": (rig("frames", "mount", "rpy_rad", value=[0, 0, 30]), "mount.rpy_rad", "degrees"),
    "mesh in mm": (mesh(MILLI), "mesh.ply", "millimetres"),
    "urdf in mm": (edit("arm.urdf", ("0.35", "350")), "arm.urdf", "joint_3", "millimetres"),
    # what cannot be computed with
    "mesh with nan": (mesh(lambda v: np.where(v == v[0, 0], np.nan, v)), "mesh.ply", "not finite"),
    "targets on a line": (edit("targets.csv", on_a_line), "targets.csv", "one line", "area"),
    "two targets": (edit("targets.csv", lambda t: "\n".join(t.splitlines()[:3])), "targets.csv", "3 targets"),
    "all rays miss": (mesh(lambda v: v + [0, 0, 500]), "rec", "L00P00", "beams", "reference"),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_a_fit_refuses_in_one_sentence(rec, refused, case):
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
        (["--prior", "nowhere"], ["nowhere", "no run there"]),
        (["--folds", "9"], ["--folds"]),
        (["--nope"], ["--nope"]),
        (["no/such/recording"], ["no/such/recording"]),
    ],
    ids=lambda value: value[0] if value[0].startswith("-") or "/" in value[0] else "",
)
def test_a_fit_refuses_its_arguments(rec, refused, arguments, parts):
    sentence = refused("fit", rec, *arguments, "-o", rec.parent / "run")
    for part in parts:
        assert part in sentence, sentence


def test_a_folder_that_is_no_run_is_not_replaced(rec, refused):
    sentence = refused("fit", rec, "-o", rec)
    assert "rec exists" in sentence and "another folder" in sentence
    (rec.parent / "notes.txt").write_text("mine")
    assert "notes.txt exists" in refused("fit", rec, "-o", rec.parent / "notes.txt")


@pytest.mark.parametrize("command", ["compare", "export"])
def test_a_recording_is_no_run(rec, refused, command):
    out = ["-o", rec.parent / "out"] if command == "export" else []
    assert "no run there" in refused(command, rec, *out)


def test_the_recording_itself_is_fine(rec, monkeypatch, capfd):
    """Else every case above might be refused for another reason."""
    monkeypatch.setattr(sys, "argv", ["rigcal", "check", str(rec), "--json"])
    with pytest.raises(SystemExit) as exit_:
        main()
    assert exit_.value.code == 0, capfd.readouterr().out
