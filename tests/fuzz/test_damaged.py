"""Files of every format, damaged by chance: a result or one sentence, in little memory and time."""

import os
from pathlib import Path

import numpy as np
import pytest

from . import samples
from .mutations import mutated
from .outcomes import Sample, zygote

SEEDS = range(2)
MANY = range(1000, 1000 + int(os.environ.get("FUZZ", 200)))  # FUZZ=2000 make test-long looks longer
FEW = range(3000, 3000 + int(os.environ.get("FUZZ", 200)) // 8)  # of real files, which are larger


@pytest.fixture(scope="module")
def reader():
    with zygote() as process:
        yield process


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A whole file of every format."""
    return samples.made(tmp_path_factory.mktemp("samples"))


def faults(reader, sample: Sample, seeds: range) -> list[str]:
    """What came of damages that must not come of any; the file is whole again after."""
    whole, found = sample.path.read_bytes(), []
    try:
        for seed in seeds:
            sample.path.write_bytes(mutated(whole, seed))
            fault = reader.read(sample).fault(sample.path)
            if fault:
                found.append(f"{sample.kind} {sample.path.name}, seed {seed}: {fault}")
    finally:
        sample.path.write_bytes(whole)
    return found


@pytest.mark.long
def test_whole_files_are_read(reader, made):
    assert len(made) > 50
    refused = [(s.path.name, o.said) for s in made if (o := reader.read(s)).outcome != "read"]
    assert not refused


@pytest.mark.long
def test_damaged_files(reader, made):
    found = [fault for sample in made for fault in faults(reader, sample, SEEDS)]
    assert not found, "\n".join(found)


@pytest.mark.long
def test_many_damaged_files(reader, made):
    found = [fault for sample in made for fault in faults(reader, sample, MANY)]
    assert not found, "\n".join(found)


@pytest.mark.long
def test_damaged_real_files(reader, shared, tmp_path):
    found = [f for s in samples.real(shared, tmp_path) for f in faults(reader, s, FEW)]
    assert not found, "\n".join(found)


# -------------------------------------------------------------- what was found, and was then mended


def ply(*lines: str, data: bytes = b"") -> bytes:
    head = ("ply", "format ascii 1.0" if not data else "format binary_little_endian 1.0", *lines)
    return "\n".join([*head, ""]).encode() + data


def plate(y: object, joints: str) -> bytes:
    pose = f"{{x: 0, y: {y}, z: 0, qw: 1, qx: 0, qy: 0, qz: 0}}"
    return f"{{1: {{camera_joints: [], pose: {pose}, {joints}}}}}".encode()


SQUARE = ("element vertex 3", *(f"property float {axis}" for axis in "xyz"))
FACE = ("element face 1", "property list char int vertex_indices", "end_header")
FLOATS = np.zeros((90, 5), np.float32)
FLOATS[:, :3] = np.random.default_rng(0).normal(size=(90, 3))
FLOATS[7, 4] = np.nan
VICON = "Objects\n100\n,,Global Angle cup:cup\nFrame,Sub Frame,RX,RY,RZ,RW,TX,TY,TZ\n,,\n1,0,1\n"
MOTIVE = (
    "Format Version,1.23,Rotation Type,Quaternion,Length Units,Meters\n\n"
    ",Type,Rigid Body,Rigid Body\n,Name,cup,cup\n,ID,a,a\n,,Rotation,Position\n"
    "Frame,Time (Seconds),X,X\n0,0,1,1\n"
)
FOUND = {
    "vertex that is none": ("surface", "a.ply", ply(*SQUARE, *FACE, "0 0 0 1 0 0 0 1 0 3 0 1 900")),
    "list of length -1": ("mesh", "a.ply", ply(*SQUARE, *FACE, "0 0 0 1 0 0 0 1 0 -1 0 1 2")),
    "header without end": ("numpy", "a.npy", b"\x93NUMPY\x01\x00\x10\x00{'descr': ('<f4'"),
    "long header": ("numpy", "a.npy", b"\x93NUMPY\x01\x00\x20\x4e" + b"{" + b" " * 20_000),
    "flat vertices": ("mesh", "a.obj", b"v 0 0\nv 1 0\nv 0 1\nf 1 2 3\n"),
    "ring that is no number": ("nuscenes", "a.pcd.bin", FLOATS.tobytes()),
    "body without columns": ("vicon", "a.csv", VICON.encode()),
    "marker without columns": ("motive", "a.csv", MOTIVE.encode()),
    "centre without numbers": (
        "dh", "a.yaml", b"{joints: [{a: 0, alpha: 0, d: 1, centre_m: [x, null, 1]}]}"
    ),
    "pose of words": ("industrial_calibration", "a.yaml", plate("x", "target_joints: [1]")),
    "joints of nothing": ("industrial_calibration", "a.yaml", plate(1, "target_joints: 3")),
    "number of 400 digits": ("effects", "a.yaml", b"sigma: " + b"1" * 400),
    "label without a number": ("palette", "a.csv", b"label,name\n0,floor\n,wall\n"),
    "cell without end": ("table", "a.csv", b'time_s,a\n0,"' + b"x" * 200_000 + b"\n1,2\n"),
    "angle without end": ("angles", "a.csv", b'id,e,a\n1,"' + b"x" * 200_000),
    "number of zeros": ("lidar", "a.yaml", b"name: \0"),
}  # fmt: skip


@pytest.mark.parametrize(("kind", "name", "data"), FOUND.values(), ids=FOUND)
def test_what_was_found_is_one_sentence(reader, tmp_path, kind, name, data):
    path = tmp_path / name.replace("a.", "sample.", 1)
    path.write_bytes(data)
    outcome = reader.read(Sample(kind, path))
    assert not outcome.fault(path) and outcome.outcome == "refused", outcome


RUN = {
    "no effects": ("model.yaml", "effects:", "effects: null\nwas:"),
    "fixed is a number": ("model.yaml", "fixed:", "fixed: 3\nwas:"),
    "recording without a path": ("model.yaml", "path:", "place:"),
    "solution without frames": ("solution.yaml", "frames:", "frames: null\nwas:"),
    "solution of a word": ("solution.yaml", "frames:", "frames: x\nwas:"),
    "summary of a list": ("summary.json", "{", "[{"),
}


@pytest.mark.parametrize(("name", "before", "after"), RUN.values(), ids=RUN)
def test_a_run_that_was_edited_is_one_sentence(reader, made, name, before, after):
    path = next(s.path for s in made if s.kind == "run" and s.path.name == name)
    whole = path.read_text()
    try:
        path.write_text(whole.replace(before, after, 1))
        outcome = reader.read(Sample("run", path))
    finally:
        path.write_text(whole)
    assert outcome.outcome == "refused" and not outcome.fault(path), outcome


@pytest.mark.parametrize(
    ("key", "value"), [("stop", "../x"), ("turn", "0.5\0"), ("turn", "1" * 400)]
)
def test_a_table_of_stops_that_was_edited_is_one_sentence(reader, made, key, value):
    path = next(s.path for s in made if s.path.name == "stops.csv")
    whole = path.read_text()
    head, first, *rest = whole.splitlines()
    cells = first.split(",")
    cells[head.split(",").index(key)] = value
    try:
        path.write_text("\n".join([head, ",".join(cells), *rest]))
        outcome = reader.read(Sample("recording", path))
    finally:
        path.write_text(whole)
    assert outcome.outcome == "refused" and not outcome.fault(path), outcome


def test_a_crash_would_be_found(reader, made, tmp_path):
    """The oracle itself: a file is blamed for an exception, a crash, memory and a bad sentence."""
    path = Path(tmp_path / "sample.yaml")
    bad = {"raised": "KeyError: x", "killed": "by status 11", "refused": "something is wrong"}
    outcome = reader.read(made[0])
    for kind, said in bad.items():
        assert type(outcome)(kind, said, 0.0, 0.0).fault(path)
    assert type(outcome)("read", "", 10_000.0, 0.0).fault(path)
    assert not type(outcome)("refused", "sample.yaml is wrong", 0.0, 0.0).fault(path)
