"""A run that has not converged, or lacks what was left out, says so wherever it is shown."""

import json
from types import SimpleNamespace
from unittest.mock import patch

import pytest

from calib.problem.model import Model
from calib.runs.calibrate import calibrate
from calib.runs.run import Run
from calib.simulation import Spec, simulate
from calib.solve.descent import AT_OPTIMUM
from chains.errors import InputError
from sensors.documents import read_yaml

SPEC = Spec(lidar="hesai_pandarxt32", locations=2, stops_per_location=3, column_step=250)
LEFT = "L01P02:mount_markers"
SAID = "NOT CONVERGED"


def _run(folder, *without, fall=AT_OPTIMUM):
    simulate(SPEC, folder / "rec", 1)
    model = Model.of(None, (), without, [folder / "rec"])
    with patch("calib.solve.loop.AT_OPTIMUM", fall):
        calibrate(folder / "rec", folder / "run", model, hold_out="none")


def _stopped_early(folder):
    _run(folder, fall=-1.0)  # nothing is


def _less(folder):
    _run(folder, LEFT)


@pytest.fixture
def loose(once):
    return once(_stopped_early)


@pytest.fixture
def less(once):
    return once(_less)


def _commands(home):
    """Every command that shows a run, and the file that it writes, if it is of text."""
    run, rec, out = home / "run", home / "rec", home / "out"
    yield ("evaluate", run), run / "evaluation.json"
    yield ("evaluate", run, "--at", rec / "stops.csv", "-o", home / "at.csv"), None
    yield ("plot", run, "misfit", "-o", home / "misfit.svg"), home / "misfit.svg"
    yield ("plan", run, "--stops", 1, "--candidates", 5), None
    yield ("report", run, "-o", home / "report.html"), home / "report.html"
    yield ("compare", run), None
    yield ("apply", run, rec, "-o", out, "--force"), None


@pytest.mark.long
def test_no_command_shows_it_in_silence(loose, rigcal):
    for words, file in _commands(loose):
        code, out, err = rigcal(*words)
        assert code == (0 if "--force" in words else 3), (words, err)
        assert SAID in out, words
        assert file is None or SAID in file.read_text(), words
        assert "--force" in words or SAID in err, words


@pytest.mark.long
def test_what_was_left_out_is_told_by_all_of_them(less, rigcal):
    for words, file in _commands(less):
        code, out, err = rigcal(*words)
        assert code == 0, (words, err)
        assert LEFT in out and SAID not in out, words
        assert file is None or LEFT in file.read_text(), words


def test_machines_are_told_as_well(loose, rigcal):
    run = loose / "run"
    for words in (("evaluate", run), ("evaluate", run, "--at", loose / "rec/stops.csv"),
                  ("apply", run, loose / "rec", "-o", loose / "out", "--force")):  # fmt: skip
        _, out, _ = rigcal(*words, "--json")
        assert SAID in json.loads(out)["warnings"][0], words
    assert json.loads(rigcal("compare", run, "--json")[1])["converged"] == [False]


def test_no_fit_takes_it_for_what_is_known(loose, tmp_path):
    simulate(SPEC, tmp_path / "later", 2)
    with pytest.raises(InputError, match=f"has {SAID}, so its numbers are not to be used"):
        calibrate(tmp_path / "later", tmp_path / "run", prior=loose / "run")


def test_what_a_diagnosis_found_wrong_is_told_by_all_that_takes_numbers(less, rigcal):
    """To people, to machines, in every file; not where the diagnosis found the model adequate."""
    run, told = less / "run", "X is missing: it changes the ranges."
    takes = ("apply", run, less / "rec", "-o", less / "out"), ("export", run, "-o", less / "files")
    for verdict, wrong in (("missing_effect", True), ("bad_data", True), ("adequate", False)):
        found = {"verdict": verdict, "sentences": [told]}
        with patch.object(Run, "diagnosis", lambda _, found=found: found):
            for words in takes:
                code, out, err = rigcal(*words)
                assert code == 0, err
                assert (told in " ".join(out.split())) == wrong, words
                warnings = json.loads(rigcal(*words, "--json")[1])["warnings"]
                assert any(told in each for each in warnings) == wrong, words
        for name in ("extrinsics.yaml", "rig.urdf"):
            text = " ".join((less / "files" / name).read_text().replace("#", "").split())
            assert (told in text) == wrong, name


def test_what_a_diagnosis_found_is_not_what_stands_above_it():
    found = {"sentences": ["Left out: s1:scan", "X is missing."]}
    assert Run.finding(SimpleNamespace(warning=["Left out: s1:scan"]), found) == "X is missing."


def test_the_solution_says_it_to_whoever_reads_only_that(loose, less):
    head = (loose / "run/solution.yaml").read_text().splitlines()[0]
    assert head.startswith(f"# {SAID}: ")
    assert (less / "run/solution.yaml").read_text().startswith(f"# Left out: {LEFT}\n")
    for home in (loose, less):
        found = Run.open(home / "run").solution.shared
        data, _ = read_yaml(home / "run/solution.yaml")
        assert data["frames"].keys() == found.frames.keys()
