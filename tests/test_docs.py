"""What README and examples show is run, and does what they say."""

import ast
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from calib.rig import load_rig

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
LONGEST_EXAMPLE = 60


def blocks(language):
    """The code blocks of a language in README."""
    return re.findall(rf"^```{language}\n(.*?)^```", README, flags=re.M | re.S)


def execute(command, folder):
    """Run a program in a folder, and give what it printed."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    done = subprocess.run(
        command, cwd=folder, capture_output=True, text=True, env=os.environ | {"PATH": path}
    )
    assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
    return done.stdout


def commands():
    """README's command lines, split into words, comments left out."""
    lines = (
        shlex.split(line, comments=True) for block in blocks("sh") for line in block.splitlines()
    )
    return [words for words in lines if words]


@pytest.fixture(scope="module")
def loop(tmp_path_factory):
    """A folder in which README's commands have been run in order, and what they said."""
    folder = tmp_path_factory.mktemp("readme")
    said = [execute(words, folder) for words in commands() if words[0] != "make"]
    return folder, "\n".join(said)


def test_every_command_line_is_one_of_two_programs():
    assert {words[0] for words in commands()} == {"make", "rigcal"}


def test_make_targets_exist():
    targets = set(re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(), flags=re.M))
    assert {words[1] for words in commands() if words[0] == "make"} <= targets


@pytest.mark.slow
def test_the_loop_runs_and_leaves_what_it_names(loop):
    folder, said = loop
    names = {path.name for path in folder.iterdir()}
    assert names == {"rec", "rec.truth.json", "run", "tilted", "extrinsics"}
    assert (folder / "extrinsics" / "extrinsics.yaml").is_file()
    assert re.search(r"mount -> lidar +[+-]\d+\.\d+ ± \d", said)
    assert re.search(r"rms after, of stops held out +mm +\d", said)
    assert "arm_axis_tilt.joint_1.a" in said


@pytest.mark.slow
def test_recording_and_run_hold_the_files_in_their_tables(loop):
    folder, _ = loop
    for title, made in (("A recording", "rec"), ("A run", "run")):
        rows = re.search(rf"## {title}\n.*?\n\|---\|---\|\n(.*?)\n\n", README, flags=re.S)[1]
        listed = [
            name for row in rows.splitlines() for name in re.findall("`([^`]+)`", row.split("|")[1])
        ]
        assert len(listed) >= 5
        stop = next((folder / "rec" / "scans").iterdir()).stem
        for name in listed:
            path = name.replace("<stop>", stop)
            found = [(folder / made / at / path).exists() for at in (".", "reference")]
            assert any(found), f"README lists {name}, which {made} has not"


@pytest.mark.slow
def test_the_rig_in_readme_is_one(loop):
    folder, _ = loop
    (text,) = blocks("yaml")
    (folder / "rec" / "rig.yaml").write_text(text)
    rig = load_rig(folder / "rec")
    assert rig.lidar.rings == 128
    assert list(rig.frame_sigma) == ["base_markers", "arm_base", "mount", "mount_markers", "lidar"]


@pytest.mark.slow
def test_python_in_readme_runs(tmp_path):
    (program,) = blocks("python")
    execute([sys.executable, "-c", program], tmp_path)
    assert (tmp_path / "extrinsics" / "extrinsics.yaml").is_file()


def test_files_that_readme_links_to_exist():
    linked = re.findall(r"\]\(([^)#:]+)\)", README) + re.findall(r"`(\w\w_\w+\.py)`", README)
    assert linked
    for name in linked:
        assert (ROOT / name).is_file() or (ROOT / "examples" / name).is_file(), name
    assert {path.name for path in EXAMPLES} <= set(linked)


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_is_a_screen_long_and_says_what_it_is(path):
    text = path.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= LONGEST_EXAMPLE
    assert f"python examples/{path.name} [FOLDER]" in ast.get_docstring(ast.parse(text))


def example(number, folder):
    """What an example prints."""
    (path,) = (ROOT / "examples").glob(f"{number:02}_*.py")
    return execute([sys.executable, str(path), str(folder)], folder)


@pytest.mark.slow
def test_recalibration_names_the_link_that_was_bumped(tmp_path):
    said = example(1, tmp_path)
    assert re.findall(r"(\w+) +has moved", said) == ["lidar"]
    assert len(re.findall("has not moved", said)) == 8
    moves = {
        name: (float(d), float(s)) for name, d, s in re.findall(r" (\w\w) (\S+) ± (\S+) m", said)
    }
    bump = {"rx": 0, "ry": 0, "rz": 4, "tx": 3, "ty": 0, "tz": 0}
    assert moves.keys() == bump.keys()
    for name, (change, sigma) in moves.items():
        assert sigma < 0.3
        assert abs(change - bump[name]) < 3.5 * sigma, name


@pytest.mark.slow
def test_ring_corrections_are_the_true_ones_and_help(tmp_path):
    said = example(2, tmp_path)
    rows = re.findall(r"^ +\d+ +(\S+) ± (\S+) +(\S+)$", said, flags=re.M)
    assert len(rows) == 8
    z = [(float(found) - float(true)) / float(sigma) for found, sigma, true in rows]
    assert max(map(abs, z)) < 4
    before, after = map(float, re.findall(r"median range error .*: (\S+) mm", said))
    assert after < before / 2


@pytest.mark.slow
def test_exported_extrinsics_are_those_of_the_rig(tmp_path):
    said = example(3, tmp_path)
    assert "mount -> lidar:" in said
    (cad, found) = re.findall(r"(\S+) mm, (\S+) mrad off", said)
    assert all(float(after) < 0.5 * float(before) for before, after in zip(cad, found, strict=True))
