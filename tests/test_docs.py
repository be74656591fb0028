"""What README and examples show is run, and does what they say."""

import ast
import json
import os
import re
import shlex
import signal
import subprocess
import sys
from glob import glob
from pathlib import Path

import numpy as np
import pytest

from calib.effects import load_effects
from calib.rig import load_rig
from calib.simulate import load_spec, simulate

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
EXAMPLES = sorted((ROOT / "examples").glob("[0-9]*.py"))
LONGEST_EXAMPLE = 60


def blocks(language):
    """The code blocks of a language in README."""
    return re.findall(rf"^```{language}\n(.*?)^```", README, flags=re.M | re.S)


def execute(command, folder, variables=None):
    """Run a program in a folder, and give what it printed."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    env = os.environ | {"PATH": path} | (variables or {})
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, env=env)
    assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
    return done.stdout


def commands():
    """README's command lines, split into words, comments left out."""
    lines = (
        shlex.split(line, comments=True)
        for block in blocks("sh")
        for line in block.replace("\\\n", "").splitlines()
    )
    return [words for words in lines if words]


def look(command, folder):
    """Open the workbench, and leave it by Ctrl-C once it has said where it is."""
    program = Path(sys.executable).parent / command[0]
    with subprocess.Popen(
        [program, *command[1:], "--no-open"], cwd=folder, stdout=subprocess.PIPE, text=True
    ) as process:
        said = process.stdout.readline()
        process.send_signal(signal.SIGINT)
        assert process.wait(60) == 0
    assert re.search(r"http://(127\.0\.0\.1|localhost):\d+", said)
    return said


@pytest.fixture(scope="module")
def loop(tmp_path_factory):
    """A folder in which README's commands have been run in order, and what they said."""
    folder = tmp_path_factory.mktemp("readme")
    own = [words for words in commands() if words[0] != "make" and words[1] != "import"]
    said = [(look if words[1] == "view" else execute)(words, folder) for words in own]
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
    made = {"run", "grown", "report.html", "corrected", "extrinsics"}
    assert names == {"rec", "rec.truth.json", *made}
    files = {path.name for path in (folder / "extrinsics").iterdir()}
    assert {"extrinsics.yaml", "arm.urdf", "rig.urdf", "rings.csv"} <= files
    assert "<svg" in (folder / "report.html").read_text(encoding="utf-8")
    assert re.search(r"mount -> lidar +[+-]\d+\.\d+ ± \d", said)
    assert re.search(r"rms after, of stops held out +mm +\d", said)
    assert "incidence_angle_bias.amount" in said


@pytest.mark.slow
def test_what_readme_shows_is_what_is_printed(loop):
    """But for the numbers, which depend a little on libraries; those agree to a tenth or so."""
    _, said = loop
    shown = "\n".join(blocks("text"))
    for part in shown.split("\n\n"):
        assert shape(part) in shape(said), part
    (fall,) = set(re.findall(r"from (\S+) to (\S+)\s+mm", shown))
    (found,) = set(re.findall(r"held-out error goes\s+from (\S+) to (\S+)\s+mm", said))
    for there, here in zip(fall, found, strict=True):
        assert float(here) == pytest.approx(float(there), rel=0.15)


def shape(text):
    """A text without its numbers and the width of its blanks."""
    return " ".join(re.sub(r"[-+]?\d[\d.e-]*", "#", text).split())


@pytest.mark.slow
def test_the_import_in_readme_makes_a_recording(tmp_path):
    """Of files that example 8 writes for this; the shell would expand the stars."""
    simulate(
        load_spec("tiny").model_copy(update={"sweeps": 1, "occluded_share": 0.0}),
        tmp_path / "rec",
        1,
    )
    program = "import sys; from pathlib import Path; from foreign_files import write_files\n"
    program += "write_files(Path(sys.argv[1]), Path(sys.argv[2]))"
    here = {"PYTHONPATH": str(ROOT / "examples")}
    execute([sys.executable, "-c", program, str(tmp_path / "rec"), str(tmp_path)], ROOT, here)
    (words,) = [words for words in commands() if words[:2] == ["rigcal", "import"]]
    expanded = [sorted(glob(w, root_dir=tmp_path)) if "*" in w else [w] for w in words]
    said = execute([word for part in expanded for word in part], tmp_path)
    assert "what was understood" in said
    stops = (tmp_path / "mine" / "stops.csv").read_text().splitlines()
    assert len(stops) == len((tmp_path / "rec" / "stops.csv").read_text().splitlines())


@pytest.mark.slow
def test_recording_and_run_hold_the_files_in_their_tables(loop):
    folder, _ = loop
    for title, made in (("A recording", ("rec",)), ("A run", ("run", "grown"))):
        rows = re.search(rf"## {title}\n.*?\n\|---\|---\|\n(.*?)\n\n", README, flags=re.S)[1]
        listed = [
            name for row in rows.splitlines() for name in re.findall("`([^`]+)`", row.split("|")[1])
        ]
        assert len(listed) >= 5
        stop = next((folder / "rec" / "scans").iterdir()).stem
        for name in listed:
            path = name.replace("<stop>", stop)
            at = [folder / one / within for one in made for within in (".", "reference")]
            found = [(place / path).exists() for place in at]
            assert any(found), f"README lists {name}, which {made} has not"


@pytest.mark.slow
def test_the_rig_in_readme_is_one(loop):
    folder, _ = loop
    text = next(block for block in blocks("yaml") if "lidar:" in block)
    (folder / "rec" / "rig.yaml").write_text(text)
    rig = load_rig(folder / "rec")
    assert rig.lidar.rings == 128
    assert list(rig.frame_sigma) == ["base_markers", "arm_base", "mount", "mount_markers", "lidar"]


@pytest.mark.slow
def test_the_effect_in_readme_is_one(loop):
    folder, _ = loop
    text = next(block for block in blocks("yaml") if "basis:" in block)
    (folder / "rec" / "mine.yaml").write_text(text)
    (effect,) = load_effects([str(folder / "rec" / "mine.yaml")])
    assert effect.name == "humid_air" and effect.params(load_rig(folder / "rec"))


@pytest.mark.slow
def test_python_in_readme_runs(tmp_path):
    (program,) = blocks("python")
    said = execute([sys.executable, "-c", program], tmp_path)
    assert "incidence_angle_bias is missing" in said
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
    said = ast.get_docstring(ast.parse(text))
    assert len(text.splitlines()) - len(said.splitlines()) <= LONGEST_EXAMPLE
    assert f"python examples/{path.name} [FOLDER]" in said


def example(number, folder, *more):
    """What an example prints."""
    (path,) = (ROOT / "examples").glob(f"{number:02}_*.py")
    return execute([sys.executable, str(path), str(folder), *map(str, more)], folder)


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


@pytest.mark.slow
def test_the_missing_effect_is_found_and_sized(tmp_path):
    said = example(4, tmp_path)
    assert re.search(r"^incidence_angle_bias is missing", said, flags=re.M)
    errors = re.findall(r"(\S+) mm seen, (\S+) mm held out, noise floor (\S+) mm", said)
    (seen, unseen, floor), (_, after, _) = (map(float, numbers) for numbers in errors)
    assert seen < floor < unseen / 2 and after < unseen / 2
    found, sigma = map(float, re.search(r"bias: (\S+) ± (\S+) mm", said).groups())
    truth = json.loads((tmp_path / "recording.truth.json").read_text())["effects"]
    assert abs(found - 1e3 * truth["incidence_angle_bias"][0]) < 4 * sigma
    assert said.splitlines()[-1].startswith("The model is adequate")


@pytest.mark.slow
def test_ones_own_effect_is_found_as_a_formula_and_as_a_class(tmp_path):
    said = example(5, tmp_path)
    before, *after = map(float, re.findall(r"(\S+) mm held out", said))
    assert len(after) == 2 and max(after) < 0.9 * before
    found = re.findall(r"amount (\S+) ± (\S+)", said)
    truth = json.loads((tmp_path / "recording.truth.json").read_text())["effects"]["humid_air"]
    assert all(abs(float(a) - truth[0]) < 4 * float(s) for a, s in found) and len(found) == 2
    assert re.search("left over: .*humidity", said)


@pytest.mark.slow
def test_a_ur10_lacks_what_its_example_says(tmp_path, shared):
    said = example(6, tmp_path, shared / "arms/ur10_tmac")
    A, D = re.split("^series ", said, flags=re.M)[1:]
    for series in (A, D):
        assert "arm_gravity_sag" in series and "arm_gear_error@1" in series
        rows = re.findall(r"(\S+) mm held out, (\S+) mm in series", series)
        own, others = np.array(rows, float).T
        assert len(rows) == 4 and own[-1] < 0.72 * own[0] and others[-1] < 0.85 * others[0]


@pytest.mark.slow
def test_the_report_says_red_before_and_green_after(tmp_path):
    said = example(7, tmp_path)
    assert re.search(r"^first.html: red, incidence_angle_bias is missing", said, flags=re.M)
    assert re.search(r"^grown.html: (green|amber), The model is adequate", said, flags=re.M)
    assert (tmp_path / "incidence.png").read_bytes()[1:4] == b"PNG"


@pytest.mark.slow
def test_imported_files_give_the_same_fit(tmp_path):
    rows = re.findall(r"(\S+) mm and (\S+) mrad apart", example(8, tmp_path))
    assert len(rows) == 6 and np.array(rows, float).max() < 0.01


@pytest.mark.slow
def test_the_study_in_short_ranks_the_methods(tmp_path):
    program = [sys.executable, str(ROOT / "examples/paper_study.py"), str(tmp_path), "--quick"]
    said = execute(program, tmp_path)
    errors = re.findall(r"^Ouster6 .* held out +(\S+) mm", said, flags=re.M)
    errors = np.array(errors, float)  # paper, the study's sequence, joint graph, and with effects
    assert len(errors) == 4 and errors[2:].max() < 0.5 * errors[:2].min()
    assert "| joint graph" in (tmp_path / "study.md").read_text(encoding="utf-8")


def test_without_its_data_the_ur10_example_says_so(tmp_path):
    assert "skipped: nowhere" in example(6, tmp_path, "nowhere")
