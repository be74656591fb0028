"""Progress on the command line: the stage, of how many, and the time left."""

import re

import pytest

from calib.cli.stages import DIAGNOSE, FIT, Staged

HIDE = ("--seed", 1, "--hide", "incidence_angle_bias=2")


@pytest.mark.parametrize("stages", [FIT, DIAGNOSE])
def test_shares_are_of_the_whole(stages):
    assert sum(stage.share for stage in stages) == pytest.approx(1.0)


def test_time_left_ends_with_the_command_where_it_runs_as_it_was_measured():
    staged, total_s = Staged(FIT), 50.0
    texts = ("pass 3", "errors in common of rows", "without fold 1: pass 1", "writing residuals")
    begins_s = 0.0
    for number, (stage, text) in enumerate(zip(FIT, texts, strict=True), 1):
        for elapsed_s in (begins_s, begins_s + 0.5 * stage.share * total_s):
            said = staged(text, elapsed_s)
            assert said.startswith(f"{number} of 4, {stage.title}") and said.endswith(f": {text}")
            left = re.search("about ([0-9]+) s left", said)
            assert (left is None) == (number == 1)
            if left:
                assert float(left[1]) == pytest.approx(total_s - elapsed_s, abs=0.51)
        begins_s += stage.share * total_s


def test_stages_are_passed_over_and_never_gone_back_to():
    staged = Staged(FIT)
    assert staged("pass 1", 1.0) == "1 of 4, estimate: pass 1"
    assert staged("writing residuals", 9.2).startswith("4 of 4, residuals")
    assert staged("pass 2", 9.3).startswith("4 of 4, residuals")
    assert "left" not in staged("writing residuals", 99.0)


def test_without_stages_a_step_is_told_as_it_is():
    assert Staged()("drawing", 3.0) == "drawing"
    assert Staged(FIT)("reading", 0.0) == "1 of 4, estimate: reading"


def test_every_step_of_a_fit_and_a_diagnosis_has_its_stage(rigcal, tmp_path):
    """Each stage is reached, in order, by what the commands say themselves."""
    assert rigcal("simulate", "tiny", "-o", tmp_path / "rec", *HIDE)[0] == 0
    for command, stages in (
        (("fit", tmp_path / "rec", "-o", tmp_path / "run"), FIT),
        (("diagnose", tmp_path / "run"), DIAGNOSE),
    ):
        code, _, err = rigcal("-v", *command)
        numbers = [int(n) for n in re.findall(rf" ([0-9]) of {len(stages)}, ", err)]
        assert code == 0 and numbers == sorted(numbers) and numbers[0] == 1
        titles = [stages[n - 1].title for n in dict.fromkeys(numbers)]
        wanted = [stage.title for stage in stages if stage.title != "formulas"]
        assert [title for title in titles if title != "formulas"] == wanted
