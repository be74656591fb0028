"""Progress on the command line: the stage, of how many, and the time left."""

import re

import pytest
import yaml

from calib.results.stages import DIAGNOSE, FIT, PLAN, REPORT, Staged, staged

BOX = {  # of examples 4 and 7
    "lidar": "hesai_pandarxt32",
    "room": "box",
    "locations": 3,
    "stops_per_location": 2,
    "column_step": 200,
}
HIDE = ("--seed", 1, "--hide", "incidence_angle_bias=3")


@pytest.mark.parametrize("stages", [FIT, DIAGNOSE, PLAN, REPORT])
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


def test_a_step_before_the_first_stage_is_told_as_of_it():
    assert Staged(FIT)("reading", 0.0) == "1 of 4, estimate: reading"


def test_steps_are_passed_on_with_their_stage():
    heard = []
    tell = staged(lambda *step: heard.append(step), REPORT)
    tell("residuals before", 1, 7)
    tell("drawing", 2, 9)
    assert heard[0] == ("1 of 2, residuals: residuals before", 1, 7)
    assert heard[1][0].startswith("2 of 2, figures") and heard[1][1:] == (2, 9)


def stages_told(lines: str, stages) -> list[str]:
    """Titles of the stages that lines of progress tell, each once; their numbers never fall."""
    numbers = [int(n) for n in re.findall(rf" ([0-9]) of {len(stages)}, ", lines)]
    assert numbers == sorted(numbers) and numbers[0] == 1
    return [stages[n - 1].title for n in dict.fromkeys(numbers)]


def simulated(rigcal, folder) -> None:
    """A recording in ``rec``, which lacks an effect that the catalogue has."""
    (folder / "box.yaml").write_text(yaml.safe_dump(BOX), encoding="utf-8")
    assert rigcal("simulate", folder / "box.yaml", "-o", folder / "rec", *HIDE)[0] == 0


@pytest.mark.long
def test_every_step_of_what_takes_long_has_its_stage(rigcal, tmp_path):
    """Each stage is reached, in order, by what the commands say themselves."""
    simulated(rigcal, tmp_path)
    run = tmp_path / "run"
    for command, stages in (
        (("fit", tmp_path / "rec", "-o", run), FIT),
        (("diagnose", run), DIAGNOSE),
        (("plan", run, "--stops", 1, "--candidates", 20), PLAN),
        (("report", run, "-o", tmp_path / "run.html"), REPORT),
    ):
        code, _, err = rigcal("-v", *command)
        wanted = [stage.title for stage in stages if stage.title != "formulas"]
        titles = stages_told(err, stages)
        assert code == 0 and [title for title in titles if title != "formulas"] == wanted
        assert len(re.findall(r" \d of \d, ", err)) == len(err.splitlines())  # of every step


@pytest.mark.long
def test_an_explanation_tells_the_stages_of_each_rung(rigcal, tmp_path):
    simulated(rigcal, tmp_path)
    code, out, err = rigcal("-v", "explain", tmp_path / "rec", "-o", tmp_path / "study")
    assert code == 0
    rungs = {label: [x for x in err.splitlines() if f" {label}: " in x] for label in ("00", "01")}
    assert stages_told("\n".join(rungs["00"]), FIT) == [stage.title for stage in FIT]
    fitted = [x for x in rungs["01"] if f" of {len(FIT)}, {FIT[2].title}" in x]
    assert fitted and "1 of 4, tests" in rungs["01"][0]
    held_out, verdict = out.splitlines()[-2:]
    assert re.match(r"held-out error: [0-9.]+ -> [0-9.]+ mm; ", held_out)
    assert verdict == "verdict: the model is adequate"
