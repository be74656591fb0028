"""Results as a notebook shows them: the numbers of the terminal's tables, as sound HTML."""

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from calib.diagnosis.verdict import Diagnosis
from calib.effects.rig import DOF
from calib.problem.unknowns import Key
from calib.results.solution import EffectEstimate, FrameEstimate, Part, Solution
from calib.runs.ladder import Rung
from calib.runs.run import Run
from calib.show.blunders import blunder_cells
from calib.show.notebook import ProgressLine, diagnosis_html, run_html, rung_html
from calib.show.tables import print_run

KEYS = tuple(Key("lidar", dof) for dof in DOF)


@pytest.fixture
def run():
    """A run of one frame and two effects, with a name that would break HTML."""
    frame = FrameEstimate("mount", np.eye(4), np.full(3, 2e-4), np.full(3, 3e-4))
    effects = {
        "ring<offset>": EffectEstimate("m", ("a & b", "c"), np.array([0.0012, -0.0034]),
                                       np.array([0.0001, 0.0])),
        "many": EffectEstimate("rad", tuple(f"p{i}" for i in range(20)),
                               np.linspace(-0.001, 0.001, 20), np.full(20, 1e-5)),
    }  # fmt: skip
    solution = Solution(
        shared=Part({"lidar": frame}, effects),
        recordings={},
        not_estimated=[{"name": "lidar.tz", "why": "no <floor> in sight"}],
        keys=KEYS,
        covariance=np.diag(np.full(6, 9e-8)),
    )
    rms = {"fit": 0.86, "held_out": 1.42, "noise_floor": 1.74}
    summary = {
        **{"points": 10, "stops": 2, "converged": True, "iterations": 3, "seconds": 1.0},
        "misfit": {},
        **{"rms_mm": rms, "mean_mm": {"fit": 0.01}, "std_mm": {"fit": 0.86}, "residual": "range"},
    }
    model = {"effects": [], "fixed": [], "prior": None, "recordings": []}
    return Run(Path("runs/a&b"), model, summary, solution)


def blunder(token, axis="x", rivals=(), **more):
    """A blunder of a diagnosis."""
    found = {"without": token, "size": 0.00292, "sigma": 0.000254, "unit": "m", "axis": axis}
    found |= {"indistinguishable_from": list(rivals), "belongs_to": None, "wrong_sign": None}
    return found | more


def parsed(html):
    """The page as a tree: it must be well-formed."""
    return ElementTree.fromstring(html)


def cells(html):
    """The text of every cell, row by row."""
    return [["".join(c.itertext()).strip() for c in row] for row in parsed(html).iter("tr")]


def test_a_run_shows_what_the_terminal_shows(run, capsys):
    rows = cells(run_html(run))
    print_run(run)
    printed = " ".join(capsys.readouterr().out.split())
    for row in rows:
        for cell in row:
            assert " ".join(cell.split()) in printed
    assert ["ring<offset>", "a & b", "+1.20 ± 0.10", "mm", ""] in rows
    assert any("1.42" in row for row in rows)
    assert not any(row for row in rows if not any(row))
    said = "".join(parsed(run_html(run)).itertext())
    assert "runs/a&b" in said
    assert "not identifiable: lidar.tz: no <floor> in sight" in said


def test_a_card_begins_with_its_finding_and_folds_the_rest(run):
    page = parsed(run_html(run))
    assert page.find("p/b").text.startswith("runs/a&b: held-out error: 1.42 mm")
    folded = [each.find("summary").text for each in page.iter("details")]
    assert folded == ["links", "effects", "errors", "not identifiable: 1"]
    assert not [each for each in page.iter("details") if each.get("open")]
    assert not [each for each in page if each.tag == "table"]
    alone = parsed(rung_html(Rung(run, None))).find("details")
    assert alone.get("open")  # there is nothing else to see


def candidate(name):
    """A confirmed candidate of a diagnosis."""
    return {
        "effect": name, "add": name, "site": "range", "step": 1, "p_adjusted": 3e-36,
        "unabsorbed_rms_mm": 0.44, "held_out_rms_mm": {"before": 7.71, "after": 1.42},
        "parameters": {"unit": "m", "names": ["a"], "estimate": [0.00619], "sigma": [0.00012]},
        "smallest_detectable": 0.0004, "dressed_up": False, "indistinguishable_from": [],
    }  # fmt: skip


def test_what_else_may_be_said_of_a_blunder():
    about = blunder("cad:lidar", "about x", wrong_sign="z")
    assert blunder_cells(about)[1:] == (
        "2.92 ± 0.25 mm about x",
        "its z may have the wrong sign",
    )
    scan = blunder("s1:scan", "along the beams", belongs_to="s2")
    assert blunder_cells(scan)[1:] == ("2.92 ± 0.25 mm along the beams", "it was taken at s2")
    assert blunder_cells(blunder("s1:scan", None))[1:] == ("2.92 ± 0.25 mm", "")


def test_a_diagnosis_shows_its_verdict_sentences_and_candidates():
    sentences = ["incidence_angle_bias is missing: 2.97 mm < rms & so on."]
    found = Diagnosis(
        verdict="bad_data",
        sentences=sentences,
        candidates=[candidate("incidence_angle_bias")],
        unexplained=[],
        weak_directions=[],
        untestable={},
        blunders=[blunder("a<b:base_markers", rivals=["a<b:joints"])],
        groups=[],
        misfit={},
        curves=[],
        command="rigcal fit rec -o run-without --without 'a<b:base_markers'",
    )
    html = diagnosis_html(found)
    said = "".join(parsed(html).itertext())
    assert "verdict: something in the recording is wrong" in said
    assert sentences[0] in said
    assert found.command == "".join(parsed(html).find("pre").itertext())
    row = next(row for row in cells(html) if "a<b:base_markers" in row)
    assert row[1:] == ["2.92 ± 0.25 mm in x", "or a<b:joints: nothing tells them apart"]
    row = next(row for row in cells(html) if "incidence_angle_bias" in row)
    assert "7.71 -> 1.42" in row
    assert any("+6.19 ± 0.12" in cell for cell in row)


def test_a_rung_shows_its_errors(run):
    rows = cells(rung_html(Rung(run, None)))
    assert rows[0] == ["ladder", "model", "held out, mm", "fit, mm", "expected, mm"]
    assert rows[1] == ["a&b", "start", "1.42", "0.86", "1.74"]


def test_progress_is_one_line_that_ends_with_the_last_step(capsys, monkeypatch):
    """Steps that follow each other faster than one reads are left out, the last one never."""
    now = iter([0.0, 0.01, 0.2, 0.21])
    monkeypatch.setattr("calib.show.notebook.time.monotonic", lambda: 1.0 + next(now))
    tell = ProgressLine()
    for done in range(4):
        tell("fitting", done, 4)
    told = capsys.readouterr().err
    assert "\n" not in told
    assert [line.strip() for line in told.split("\r") if line] == [
        "fitting 1/4",
        "fitting 3/4",
        "fitting 4/4",
    ]


def test_texts_are_plain_where_the_environment_asks_for_colours(run, monkeypatch):
    """As a notebook's does."""
    monkeypatch.setenv("FORCE_COLOR", "1")
    assert "\x1b" not in str(run) and str(run).startswith("runs/a&b")


def test_results_are_shown_by_notebooks(run):
    assert run._repr_html_() == run_html(run)
    assert Rung(run, None)._repr_html_() == rung_html(Rung(run, None))
    assert Diagnosis._repr_html_ is diagnosis_html
