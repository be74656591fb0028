"""`rigcal export` as its users meet it: what it prints, its JSON, its exit codes."""

import json

import pytest
import yaml

from calib.cli.exporting import export as command
from calib.exporters import FORMATS
from calib.runs.calibrate import calibrate

from . import rigs


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with a run of a real fit."""
    folder = tmp_path_factory.mktemp("command")
    calibrate([rigs.write(folder / "rec")], folder / "run", hold_out="none")
    return folder


@pytest.fixture
def rigcal(rigcal, folder, monkeypatch):
    """A function that runs a command there, and returns its exit code, stdout and stderr."""
    monkeypatch.chdir(folder)
    return rigcal


def test_json_says_what_was_written_and_what_was_not(rigcal, folder):
    code, out, err = rigcal("export", "run", "-o", "all", "--json")
    assert (code, err) == (0, "")
    told = json.loads(out)
    assert told.keys() == {"warnings", "files", "not_held", "left_out"}
    assert {folder / file for file in told["files"]} == set((folder / "all").iterdir())
    assert told["left_out"].keys() == {"hesai", "ouster"} - told["not_held"].keys()
    assert told["left_out"].keys() | told["not_held"].keys() == set(FORMATS)
    assert [name for name, said in told["not_held"].items() if not said] == ["yaml"]


def test_people_are_told_the_same(rigcal):
    code, out, err = rigcal("export", "run", "-o", "told")
    assert (code, err) == (0, "")
    lines = out.splitlines()
    assert "wrote told/arm.urdf" in lines
    told = [" ".join(line.split()) for line in lines]
    lacks = told.index("what files do not hold")
    assert "urdf sigmas, ring_range_offset, faro" in told[lacks:]
    assert any(line.startswith("hesai ") for line in told[told.index("left out") : lacks])


def test_formats_are_chosen(rigcal, folder):
    code, out, _ = rigcal("export", "run", "-o", "few", "--format", "tree,yaml")
    assert code == 0 and out.startswith("wrote few/tree.svg\nwrote few/extrinsics.yaml\n")
    assert {file.name for file in (folder / "few").iterdir()} == {"tree.svg", "extrinsics.yaml"}
    assert yaml.safe_load((folder / "few/extrinsics.yaml").read_text())["frames"]


def test_a_format_with_nothing_to_hold_is_bad_input(rigcal, folder):
    code, out, err = rigcal("export", "run", "-o", "none", "--format", "hesai")
    assert (code, out) == (2, "") and "--format hesai: " in err and err.count("\n") == 1
    assert not (folder / "none").exists()


def test_the_help_names_every_format(rigcal):
    _, out, _ = rigcal("export", "--help")
    assert all(name in out for name in FORMATS)
    assert command.__doc__
