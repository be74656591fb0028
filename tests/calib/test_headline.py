"""The last lines of a fit: its error, what it is worth, and the next command."""

import shlex
from pathlib import Path

import pytest

from calib.results.solution import Part, Solution
from calib.runs.run import Run
from calib.show.headline import closing, moved_sentence
from calib.view import panels

RMS_MM = {"fit": 3.34, "held_out": 3.47, "noise_floor": 3.62}
SUMMARY = {"residual": "range", "rms_mm": RMS_MM, "converged": True, "misfit": {"beams": 0.9}}


def fitted(folder="somewhere/run", recordings=("rec",), **summary):
    part, model = Part({}, {}), {"recordings": [{"path": each} for each in recordings]}
    solution = Solution(shared=part, recordings={}, not_estimated=[], keys=(), covariance=None)
    return Run(Path(folder), model, SUMMARY | summary, solution)


def closing_lines(folder="somewhere/run", **summary):
    return closing(fitted(folder, **summary))


def test_the_last_lines_are_the_error_what_it_is_worth_and_the_next_command():
    lines = closing_lines()
    assert lines[0] == "held-out error: 3.47 mm; 3.62 mm expected if the model is right"
    assert lines[1].startswith("verdict so far: no contradiction to the model")
    assert lines[2] == "next: rigcal diagnose somewhere/run"


@pytest.mark.parametrize(
    ("summary", "light", "reason"),
    [
        ({"misfit": {"tracker": 11.1}}, "do not use it yet", "tracker are 11.1 times larger"),
        ({"converged": False}, "do not use it yet", "has not converged"),
        ({"rms_mm": RMS_MM | {"held_out": 7.24}}, "use it with care", "2.0 times as"),
        ({"rms_mm": RMS_MM | {"held_out": None}}, "use it with care", "no stops were"),
    ],
)
def test_what_speaks_against_a_run_stands_in_its_last_lines(summary, light, reason):
    told = closing_lines(**summary)[1]
    assert told.startswith(f"verdict so far: {light}; ") and reason in told


def test_where_a_fit_did_not_converge_its_recordings_are_to_be_checked_first():
    *_, first, second, last = closing_lines(recordings=("a rec", "b"), converged=False)
    assert shlex.split(first) == ["first:", "rigcal", "check", "a rec"]
    assert (second, last) == ("first: rigcal check b", "next: rigcal diagnose somewhere/run")
    assert len(closing_lines(recordings="abcdefgh", converged=False)) == 2 + 3 + 1


def test_of_a_diagnosed_run_the_last_line_is_the_verdict_and_there_is_nothing_to_ask(monkeypatch):
    found = {"verdict": "missing_effect", "sentences": ["x is missing."], "too_few_stops": False}
    monkeypatch.setattr(Run, "diagnosis", lambda run: found)
    assert closing_lines()[1:] == ["verdict: do not use it yet. x is missing."]


def test_a_folder_with_a_blank_is_ready_to_be_pasted():
    assert shlex.split(closing_lines("a folder/run")[2])[-1] == "a folder/run"


def link(name, moved, change, sigma, parameters="rx ry rz tx ty tz", unit="rad rad rad m m m"):
    return {
        "name": name,
        "moved": moved,
        "p_value": 1e-5 if moved else 0.4,
        "parameters": parameters.split(),
        "units": unit.split(),
        "change": change,
        "sigma": sigma,
    }


LIDAR = link("lidar", True, [0, 0, 3.99e-3, 2.94e-3, 1e-5, 0], [9e-5] * 3 + [8e-5] * 3)


def test_what_moved_is_said_along_the_axes_that_show_it():
    said = moved_sentence([LIDAR, link("mount", False, [0] * 6, [1e-4] * 6)])
    expected = "lidar moved +2.94 ± 0.08 mm in x and turned +3.99 ± 0.09 mrad about z"
    assert said == f"{expected}; nothing else moved."


def test_a_move_that_no_axis_shows_alone_is_said_along_the_clearest():
    said = moved_sentence([link("lidar", True, [0] * 3 + [2e-4, 0, 0], [9e-5] * 6)])
    assert said == "lidar moved +0.20 ± 0.09 mm in x."


def test_what_the_new_data_do_not_show_is_not_said_to_stand_still():
    silent = link("mount", False, [0] * 6, [1e-4] * 6) | {"p_value": None}
    assert "nothing else moved" not in moved_sentence([LIDAR, silent])
    assert moved_sentence([LIDAR, silent]).endswith("the new data do not determine mount.")


def test_where_everything_moved_it_is_asked_whether_it_is_the_same_rig():
    every = [{**LIDAR, "name": name} for name in ("base", "arm", "mount", "lidar")]
    assert moved_sentence(every).endswith("stayed as it was: is it the same rig?")
    still = link("faro", False, [0] * 6, [1e-4] * 6)
    assert "same rig" not in moved_sentence([*every, still])
    assert "same rig" not in moved_sentence(every[:2])


def test_the_workbench_says_what_moved():
    assert "Since the earlier run: lidar moved +2.94" in panels.moved(fitted(links=[LIDAR]))
    assert panels.moved(fitted()) == ""
