"""What `import calib` gives a script: every name, late, and whatever was imported before."""

import ast
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

import calib
from calib.problem.model import Source

from . import rigs

ROOT = Path(__file__).resolve().parents[2]


def program(text):
    """What a program of its own prints."""
    done = subprocess.run([sys.executable, "-c", text], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


def declared():
    """Name -> the object that a type checker is told it is."""
    tree = ast.parse((ROOT / "calib" / "__init__.py").read_text(encoding="utf-8"))
    (block,) = (node for node in tree.body if isinstance(node, ast.If))
    return {
        alias.asname or alias.name: getattr(import_module(node.module), alias.name)
        for node in block.body
        for alias in node.names
    }


def test_every_name_is_what_a_type_checker_sees():
    assert {name: getattr(calib, name) for name in calib.__all__} == declared()
    assert set(calib.__all__) <= set(dir(calib))


def test_no_room_has_the_name_of_a_function():
    rooms = {path.stem for path in (ROOT / "calib").iterdir()}
    assert not rooms & set(calib.__all__)


def test_importing_it_imports_nothing_else():
    names = program("import sys, calib; print(*sys.modules)")
    ours = {name for name in names if name.split(".")[0] in ("chains", "sensors", "calib")}
    assert ours == {"calib"}
    assert not {"numpy", "gtsam", "open3d", "rich"} & set(names)


@pytest.mark.parametrize("first", ["import calib", "from calib.exporters import FORMATS, export"])
def test_functions_stay_functions_whatever_was_imported(first):
    text = f"{first}\nimport calib, calib.evaluation, calib.simulation, calib.runs.diagnose\n"
    calls = ", ".join(f"calib.{name}" for name in calib.__all__)
    assert program(f"{text}print(*(callable(each) for each in ({calls})))") == (
        ["True"] * len(calib.__all__)
    )


def test_a_notebook_shows_runs_that_come_from_it():
    assert program("import calib; print(callable(calib.Run._repr_html_))") == ["True"]


def test_an_unknown_name_is_no_attribute():
    with pytest.raises(AttributeError, match="fitt"):
        _ = calib.fitt


def test_a_recording_opens_by_its_folder_alone(tmp_path):
    folder = rigs.write(tmp_path / "box")
    recording, source = calib.Recording.open(folder), Source.open(folder)
    assert recording.joint_names == source.rig.joint_names
    assert recording.bodies.keys() == set(source.rig.tracker.bodies)
    np.testing.assert_array_equal(recording.joints, source.recording.joints)
    assert recording.rings == source.rig.lidar.rings
    assert recording.digest() == source.recording.digest()
    assert recording.to_pandas()["stop"].tolist() == list(rigs.STOPS)
