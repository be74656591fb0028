"""The last lines of a fit: its error, what it is worth, and the next command."""

import shlex
from pathlib import Path

import pytest

from calib.results.solution import Part, Solution
from calib.runs.run import Run
from calib.show.headline import closing

RMS_MM = {"fit": 3.34, "held_out": 3.47, "noise_floor": 3.62}
SUMMARY = {"residual": "range", "rms_mm": RMS_MM, "converged": True, "misfit": {"beams": 0.9}}


def closing_lines(folder="somewhere/run", **summary):
    part = Part({}, {})
    solution = Solution(shared=part, recordings={}, not_estimated=[], names=(), covariance=None)
    return closing(Run(Path(folder), {}, SUMMARY | summary, solution), None)


def test_the_last_lines_are_the_error_what_it_is_worth_and_the_next_command():
    lines = closing_lines()
    assert lines[0] == "held-out error: 3.47 mm; 3.62 mm expected if the model is right"
    assert lines[1].startswith("verdict so far: nothing speaks against the model")
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


def test_a_folder_with_a_blank_is_ready_to_be_pasted():
    assert shlex.split(closing_lines("a folder/run")[2])[-1] == "a folder/run"
