"""What people read: its width, its digits and units, and that the answer stands first."""

import re
from types import SimpleNamespace

import numpy as np
import pytest

from calib.effects import CATALOGUE
from calib.planning.purpose import Purpose
from calib.problem.unknowns import Key
from calib.results.check import Check
from calib.runs.run import Run
from calib.show.comparison import print_comparison
from calib.show.plan import print_plan
from calib.show.tables import estimate_cell, print_catalogue, print_check

from .viewed import grown, small_run

TIED = ": the data determine only their combination, and how it is divided follows from the sigmas"


@pytest.fixture
def run(once) -> Run:
    return Run.open(once(small_run) / "run")


# ---------------------------------------------------------------------------------------- the width


def test_the_catalogue_has_a_whole_line_for_every_effect(capsys):
    print_catalogue(CATALOGUE, whole=False)
    heading, *lines = capsys.readouterr().out.split("\n\n")[0].splitlines()
    assert [line.split()[0] for line in lines] == [effect.name for effect in CATALOGUE]
    assert max(map(len, lines)) <= 80 and "…" not in "".join(lines)
    assert heading.split() == ["effect", "what"]


def test_an_effect_of_ones_own_with_much_to_say_takes_one_line_as_well(capsys):
    class Long(type(CATALOGUE[0])):
        __doc__ = "This effect " + "is told at great length " * 9

    print_catalogue([Long()], whole=False)
    lines = capsys.readouterr().out.split("\n\n")[0].splitlines()
    assert len(lines) == 2 and len(lines[1]) <= 80 and lines[1].rstrip().endswith("…")


def test_the_page_of_an_effect_says_how_to_draw_it(rigcal):
    code, out, _ = rigcal("effects", "tracker_slip")
    assert code == 0 and "rigcal effects tracker_slip -o tracker_slip.svg" in out.splitlines()


def test_lists_of_figures_and_of_what_files_lack_fit_a_terminal(rigcal, run, tmp_path):
    code, out, _ = rigcal("plot", run.folder, "--list")
    names = re.findall(r"^  ([a-z][\w-]*)  ", out, re.M)
    assert code == 0 and {"ladder", "map", "residual-incidence", "graph"} <= set(names)
    title, *lines = out.splitlines()
    assert str(run.folder) in title and max(map(len, lines)) <= 80
    code, out, _ = rigcal("export", run.folder, "-o", tmp_path / "out")
    notes = [line for line in out.splitlines() if not line.startswith("wrote ")]
    assert code == 0 and max(map(len, notes)) <= 80
    lacks = out[out.index("what files do not hold") :]
    assert re.search(r"^  urdf +sigmas, ", lacks, re.M)


def test_a_check_names_what_is_tied_and_with_v_to_what(capsys, tmp_path):
    cannot = [{"name": name, "why": f"tied to {name}{TIED}"} for name in ("mount.tz", "lidar.rz")]
    cannot.append({"name": "targets", "why": "there is no targets.csv"})
    check = Check(
        folder=tmp_path, contents=[], problems=[], odd=[], suspects=[], expected={}, cannot=cannot
    )
    print_check(check)
    short = capsys.readouterr().out
    assert "mount.tz, lidar.rz" in short and "tied to" not in short
    assert "'rigcal -v check' names" in short and "there is no targets.csv" in short
    print_check(check, whole=True)
    assert "tied to lidar.rz" in capsys.readouterr().out


# -------------------------------------------------------------------------------- digits and units


@pytest.mark.parametrize(
    ("estimate", "sigma", "unit", "cell"),
    [
        (0.001618, 0.0004, "1", "+0.00162 ± 0.00040"),
        (0.0007027, 0.0002, "1", "+0.00070 ± 0.00020"),
        (-12.3456, 1.5, "m/h", "-12346 ± 1500"),
        (3.41e-9, 1.23e-9, "1", "+3.4e-09 ± 1.2e-09"),
        (0.00162, 0.0004, "m", "+1.62 ± 0.40"),
        (0.00616, 0.00002, "m", "+6.160 ± 0.020"),
    ],
)
def test_an_estimate_has_the_digits_of_its_sigma(estimate, sigma, unit, cell):
    assert estimate_cell(estimate, sigma, unit) == cell


def test_a_number_without_a_unit_says_so():
    from calib.show.diagnosis import _estimate

    parameters = {"unit": "1", "names": ["scale"], "estimate": [0.001618], "sigma": [0.0004]}
    assert _estimate(parameters) == "+0.00162 ± 0.00040 (no unit)"
    assert _estimate(parameters | {"unit": "m"}) == "+1.62 ± 0.40 mm"


# ------------------------------------------------------------------------------------- answer first


def test_a_comparison_begins_with_the_ladder(run, tmp_path, capsys):
    above = grown(run, tmp_path / "above", "range_scale", 1.4)
    print_comparison([run, above])
    out = capsys.readouterr().out
    assert "+ range_scale" in out
    assert out.index("+ range_scale  ") < out.index("base_markers.rx")


def plan_of(sigma, smallest=None):
    document = {
        "for": "all",
        "why": "",
        "rivals": [],
        "learning_curve": [],
        "predicted_mm": {"now": None, "after": None},
        "way": [],
        "tubes": [],
        "smallest_detectable": smallest or {},
        "never_told_apart": [],
        "sigma": sigma,
        "smallest_effect": {},
        "smallest_blunder": {},
        "unseen_blunder": {"now": None, "after": None},
        "weak_directions": {"now": [], "after": [], "with_any_number": []},
        "observability": {"now": {"lambda": 1.0}, "after": {"lambda": 2.0}},
    }
    now, after = (
        SimpleNamespace(sigma=np.array([each[when] for each in sigma.values()]), weak=[])
        for when in ("now", "after")
    )
    return SimpleNamespace(
        stops=[{"location": "L00"}],
        purpose=Purpose("all"),
        joints=[],
        curve=None,
        measured=SimpleNamespace(joints=np.zeros((1, 6))),
        unlike=(),
        keys=[Key(*name.rsplit(".", 1)) for name in sigma],
        units=[each["unit"] for each in sigma.values()],
        now=now,
        after=after,
        document=lambda: document,
    )


def test_a_plan_begins_with_what_it_achieves(capsys):
    sigma = {
        "lidar.tx": {"unit": "m", "now": 0.0006, "after": 0.0003},
        "lidar.ty": {"unit": "m", "now": 0.0006, "after": 0.0005},
        "lidar.tz": {"unit": "m", "now": 0.0006, "after": 0.0006},
    }
    plan = plan_of(sigma)
    print_plan(plan)
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "1 stop for the whole calibration"
    told = " ".join(" ".join(lines[1:3]).split())
    assert told == (
        "With them 2 of 3 sigmas fall; most of all that of lidar.tx, from 0.6 to 0.3 mm."
    )


def test_a_plan_that_achieves_nothing_says_so(capsys):
    plan = plan_of({"lidar.tx": {"unit": "m", "now": 0.0006, "after": 0.0006}})
    print_plan(plan)
    assert "None of 1 expected sigmas falls by more than 1 %." in capsys.readouterr().out


def test_a_plan_to_tell_effects_apart_says_from_which_size(capsys):
    sizes = {"now": None, "after": 0.0004}
    each = {"unit": "1", "beside_model": sizes, "beside_rivals": sizes}
    smallest = {"range_scale": {**each, "beside": {"faro_scale": sizes}}}
    plan = plan_of({"lidar.tx": {"unit": "m", "now": 0.0006, "after": 0.0006}}, smallest)
    print_plan(plan)
    out = " ".join(capsys.readouterr().out.split())
    assert "range_scale is found from 0.0004 (no unit), told from faro_scale; now never" in out


def test_the_table_of_a_run_says_what_is_identifiable(run):
    table = run.table() if hasattr(run, "table") else None
    if table is None:
        import calib.report.methods  # noqa: F401

        table = run.table()
    assert "told" not in table.columns
    untold = {each["name"] for each in run.solution.not_estimated}
    names = table.variable + "." + table.parameter
    assert not table.identifiable[names.isin(untold)].any() and table.identifiable.any()
