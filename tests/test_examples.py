"""Every example is run, and does what it says."""

import ast
import json
import re
from types import SimpleNamespace
from unittest.mock import patch

import numpy as np
import pytest

import calib

from .programs import ROOT, script

EXAMPLES = sorted((ROOT / "examples").glob("[0-9]*.py"))
LONGEST = 60


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_is_a_screen_long_and_says_what_it_is(path):
    text = path.read_text(encoding="utf-8")
    said = ast.get_docstring(ast.parse(text))
    assert len(text.splitlines()) - len(said.splitlines()) <= LONGEST
    assert f"python examples/{path.name} [FOLDER]" in said


def example(number, folder, *more):
    """What an example prints."""
    (path,) = (ROOT / "examples").glob(f"{number:02}_*.py")
    return script(path, [folder, *more], folder)


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
    errors = re.findall(r"(\S+) mm seen, (\S+) mm held out, expected (\S+) mm", said)
    (seen, unseen, floor), (_, after, _) = (map(float, numbers) for numbers in errors)
    assert seen < floor < unseen / 2 and after < unseen / 2
    found, sigma = map(float, re.search(r"bias: (\S+) ± (\S+) mm", said).groups())
    truth = json.loads((tmp_path / "recording.truth.json").read_text())["effects"]
    assert abs(found - 1e3 * truth["incidence_angle_bias"][0]) < 4 * sigma
    assert said.splitlines()[-1].startswith("The model is adequate")


@pytest.mark.long
def test_ones_own_effect_is_found_as_a_formula_and_as_a_class(tmp_path):
    said = example(5, tmp_path)
    before, *after = map(float, re.findall(r"(\S+) mm held out", said))
    assert len(after) == 2 and max(after) < 0.9 * before
    found = re.findall(r"amount (\S+) ± (\S+)", said)
    truth = json.loads((tmp_path / "recording.truth.json").read_text())["effects"]["humid_air"]
    assert all(abs(float(a) - truth[0]) < 4 * float(s) for a, s in found) and len(found) == 2
    assert re.search("left over: .*humidity", said)


def ur10_table():
    """(K, 2) errors in the table of the README: held out in A, and of D by the arm from A."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    return np.array(re.findall(r"^\| [^|]+ \| (0\.\d+) \| (0\.\d+) \|$", readme, re.M), float)


def of_a_ur10(folder, data, diagnosed="D"):
    """The folder of example 6, and what it prints; of these series, what the diagnosis says."""
    nothing, diagnose = SimpleNamespace(sentences=[]), calib.diagnose

    def some(run, **options):
        return diagnose(run, **options) if run.folder.name[0] in diagnosed else nothing

    with patch.object(calib, "diagnose", some):
        (folder / "said.txt").write_text(example(6, folder, data), encoding="utf-8")


@pytest.mark.long
@pytest.mark.parametrize("diagnosed", ["D", pytest.param("AD", marks=pytest.mark.long)])
def test_a_ur10_lacks_what_its_example_says(once, shared, diagnosed):
    """Of series A the errors are of its table, and its diagnosis takes as long as all of that."""
    said = (once(of_a_ur10, shared / "arms/ur10_tmac", diagnosed) / "said.txt").read_text("utf-8")
    A, D = re.split("^series ", said, flags=re.M)[1:]
    sentences = D.partition("geometry ")[0]
    assert "arm_gravity_sag is missing" in sentences and "arm_gear_error@1" in sentences
    assert ("missing" in A or "structure" in A) == ("A" in diagnosed)
    for series in (A, D):
        rows = re.findall(r"(\S+) mm held out, (\S+) mm in series", series)
        own, others = np.array(rows, float).T
        assert len(rows) == 4 and own[-1] < 0.72 * own[0] and others[-1] < 0.85 * others[0]
    found = np.array(re.findall(r"(\S+) mm held out, (\S+) mm in series D", A), float)
    np.testing.assert_allclose(ur10_table()[:3], found[[0, 1, 3]], rtol=0.05)


@pytest.mark.long
def test_the_report_says_red_before_and_green_after(tmp_path):
    said = example(7, tmp_path)
    assert re.search(r"^first.html: red, incidence_angle_bias is missing", said, flags=re.M)
    assert re.search(r"^grown.html: (green|amber), The model is adequate", said, flags=re.M)
    assert (tmp_path / "incidence.png").read_bytes()[1:4] == b"PNG"


@pytest.mark.slow
def test_imported_files_give_the_same_fit(tmp_path):
    rows = re.findall(r"(\S+) mm and (\S+) mrad apart", example(8, tmp_path))
    assert len(rows) == 6 and np.array(rows, float).max() < 0.01


@pytest.mark.long
def test_two_series_of_a_ur10_give_one_formula(shared, tmp_path):
    """Places that one series gives are those of the other, and so are the amounts at them."""
    said = example(9, tmp_path, shared / "arms/ur10_tmac")
    found = re.findall(r"^series \w: shoulder_lift_joint = read (.+)$", said, re.M)
    assert len(found) == 2
    steps = [re.findall(r"\(shoulder_lift_joint > -(\d\.\d{3})\(\d+\)\)", each) for each in found]
    a, d = np.array(sorted(steps[0]), float), np.array(sorted(steps[1])[-2:], float)
    np.testing.assert_allclose(a, d, atol=0.02)  # 2.5 sigmas of the wider of them
    for formula in said.split("formula of series ")[1:]:
        errors = np.array(re.findall(r"(\S+) -> (\S+) mm held out", formula), float)
        assert errors.shape == (2, 2) and (errors[:, 1] < 0.9 * errors[:, 0]).all()
        rows = np.array(re.findall(r"(\S+) ± (\S+) mrad", formula), float).reshape(-1, 2, 2)
        assert len(rows) == 3
        (here, sigma), (there, spread) = rows[:, 0].T, rows[:, 1].T
        assert (np.abs(here - there) < 3 * np.hypot(sigma, spread)).all()
        assert (np.abs(there) > 5 * spread).all()
    rungs = re.findall(
        r"^(\S+) +(\S+) mm, (\S+) mrad held out in A, (\S+) mm, (\S+) mrad in D", said, re.M
    )
    names, ladder = [rung[0] for rung in rungs], np.array([rung[1:] for rung in rungs], float)
    best = ladder[np.argmin(ladder[:, 0])]
    np.testing.assert_allclose(best[[0, 2]], ur10_table()[-1], rtol=0.05)
    before, after = ladder[(at := names.index("empirical_wrist_3_joint")) - 1 : at + 1]
    assert after[1] < 0.9 * before[1] and after[3] > 1.1 * before[3]


@pytest.mark.long
def test_the_study_in_short_ranks_the_methods(tmp_path):
    said = script(ROOT / "examples/paper_study.py", [tmp_path, "--quick"], tmp_path)
    errors = re.findall(r"^Ouster6 .* held out +(\S+) mm", said, flags=re.M)
    errors = np.array(errors, float)  # paper, the study's sequence, joint graph, and with effects
    assert len(errors) == 4 and errors[2:].max() < 0.5 * errors[:2].min()
    assert "| joint graph" in (tmp_path / "study.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("number", [6, 9])
def test_without_their_data_the_ur10_examples_say_so(number, tmp_path):
    assert "skipped: nowhere" in example(number, tmp_path, "nowhere")
