"""The judge of the search for formulas, judged: by closed forms and by runs that are made up."""

from __future__ import annotations

import io
import json
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from rich.console import Console

from calib.effects import CATALOGUE
from calib.effects.own.expression import Expression
from sensors.documents import write_yaml

from ..worlds.poses import turn_vector
from . import formulas
from .formulas_effects import PAIRS, SINGLES, covariates, same, value
from .formulas_judge import at_floor, covariates_right, form, proposed
from .formulas_size import Absorbs, rms
from .formulas_table import show
from .formulas_worlds import RIGS, Case, cases, has_all, written

LOGGED = {
    "battery_v": (22, 26),
    "fan_rpm": (2000, 4000),
    "temperature_c": (20, 30),
    "range_m": (1, 6),
    "azimuth_rad": (-3, 3),
}
FORMULA = "sin(3 * azimuth_rad) * elevation_rad"
SMALL = Case("small", (FORMULA,), "arm", 3, times=1.0, beams=300)


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    return written(SMALL, tmp_path_factory.mktemp("formulas"))


def test_a_formula_says_what_it_looks_at():
    assert covariates("(ring < 4) * sin(joint_2) * exp(-time_s / 9)") == {
        "ring",
        "joint_2",
        "time_s",
    }
    assert covariates("elevation_rad * column") == same(["ring", "azimuth_rad"])
    assert covariates("elapsed_s") != covariates("temperature_c")


@pytest.mark.parametrize("formula", SINGLES)
def test_users_may_write_every_formula_and_it_means_the_same(formula):
    """So that the oracle, which adds the formula itself, fits what was hidden."""
    expression = Expression(formula, "it")
    assert same(expression.names) == covariates(formula) and 1 <= len(covariates(formula)) <= 3
    rng = np.random.default_rng(0)
    columns = {n: rng.uniform(*LOGGED.get(n, (0.3, 1.4)), 50) for n in expression.names}
    columns |= {name: np.arange(50) for name in ("ring", "label") if name in columns}
    found = expression.value(lambda name: columns[name].astype(float))
    assert np.allclose(found, value(formula, columns)) and np.ptp(found) > 0


def test_there_are_as_many_effects_as_were_asked_for():
    assert len(set(SINGLES)) == len(SINGLES) >= 40
    assert len(PAIRS) == 10 and max(map(max, PAIRS)) < len(SINGLES)
    assert not {e.formula.partition("+ ")[2] for e in CATALOGUE} & set(SINGLES)
    listed = cases(50, 100, RIGS, (1.0, 0.4), 0)
    assert len(listed) == 200 and len({case.name for case in listed}) == 200
    assert sum(len(case.formulas) == 2 for case in listed) == 20
    for some in (listed[:100], listed[100:]):
        assert 0.4 < np.mean([case.scatter_m > 0 for case in some]) < 0.6
        assert set(RIGS) == {case.rig for case in some}
        assert len({case.world.lidar for case in some}) == 3
    assert all(has_all(case.rig, case.formulas) for case in listed)
    assert not has_all("head", ("sin(joint_1)",)) and not has_all("planes", ("label == 2",))


@pytest.mark.long
def test_what_was_hidden_is_in_the_files_at_its_size(small, tmp_path):
    """Against the same world with nothing hidden: the difference is the formula's."""
    null = written(replace(SMALL, formulas=()), tmp_path)
    assert not np.any(null.error_m) and len(null.beams) == len(small.beams)
    parts = []
    for stop in null.beams["stop"].unique():
        file = f"scans/{stop}.parquet"
        one, other = (pd.read_parquet(w.folder / file) for w in (small, null))
        assert one.drop(columns=list("xyz")).equals(other.drop(columns=list("xyz")))
        lengths = [
            np.linalg.norm(each[list("xyz")].to_numpy(float), axis=1) for each in (one, other)
        ]
        x, y, z = other[list("xyz")].to_numpy(float).T
        wanted = np.sin(3 * np.arctan2(y, x)) * np.arctan2(z, np.hypot(x, y))
        parts.append((lengths[0] - lengths[1], wanted))
    longer, wanted = (np.concatenate(each) for each in zip(*parts, strict=True))
    slope = longer @ wanted / (wanted @ wanted)
    assert np.abs(longer - slope * wanted).max() < 2e-6  # of float32
    assert np.abs(longer - small.error_m).max() < 2e-6
    left = rms(Absorbs.of(small.beams).off(small.error_m))
    assert left == pytest.approx(small.shot_m) == pytest.approx(small.size_m)
    assert {"ambient", "battery_v", "fan_rpm"} <= set(small.beams)


def test_motions_and_zeros_are_absorbed_and_nothing_else(small):
    """A motion's ranges by intersecting rays with planes, not by its derivative."""
    beams, rng = small.beams, np.random.default_rng(0)
    stop = pd.factorize(beams["stop"])[0]
    point = beams[["x", "y", "z"]].to_numpy(float)
    normal = beams[["normal_x", "normal_y", "normal_z"]].to_numpy(float)
    length = np.linalg.norm(point, axis=1)
    towards = point / length[:, None]
    shift, turn = 1e-5 * rng.standard_normal((2, stop.max() + 1, 3))
    turned = np.einsum("nij,nj->ni", turn_vector(turn)[stop], towards)
    reach = np.sum(normal * (point - shift[stop]), axis=1) / np.sum(normal * turned, axis=1)
    absorbs = Absorbs.of(beams)
    assert rms(absorbs.off(reach - length)) < 1e-3 * rms(reach - length)
    zeros = rng.standard_normal(beams["ring"].max() + 1)[beams["ring"]]
    assert rms(absorbs.off(zeros)) < 1e-6
    noise = rng.standard_normal(len(beams))
    assert rms(absorbs.off(noise)) > 0.97
    assert np.allclose(Absorbs.of(beams.drop(columns="normal_x")).off(zeros), 0)


def test_what_the_model_absorbs_is_refused(tmp_path):
    with pytest.raises(ValueError, match="absorbs all but"):
        written(replace(SMALL, formulas=("elevation_rad ** 3",)), tmp_path)


@pytest.fixture
def run(small, tmp_path):
    """Writes a run of one formula, with its estimate and sigma, at nine tenths of the beams."""

    def made_up(estimate: float, sigma: float, text: str):
        folder = tmp_path / "run"
        (folder / "residuals.parquet").mkdir(parents=True, exist_ok=True)
        kept = ["ring", "column", "azimuth_rad", "elevation_rad"]
        for stop, rows in small.beams.groupby("stop"):
            some = rows[kept].sample(frac=0.9, random_state=0)
            some.to_parquet(folder / "residuals.parquet" / f"{stop}.parquet")
        effect = {"unit": "m", "names": ["a"], "estimate": [estimate], "sigma": [sigma]}
        write_yaml(folder / "solution.yaml", {"effects": {"f": effect}})
        return folder, [{"formula": {"name": "f", "site": "range", "basis": [text]}}]

    return made_up


@pytest.mark.parametrize(
    ("factor", "sigma", "text", "right"),
    [
        (1.0, 0.0, FORMULA, True),
        (1.08, 0.0, FORMULA, True),
        (1.15, 0.0, FORMULA, False),
        (1.15, 0.1, FORMULA, True),
        (-1.0, 0.0, FORMULA, False),
        (1.0, 0.0, "sin(3 * azimuth_rad) * abs(elevation_rad)", False),
        # A constant is taken by the rings' zeros.
        (1.0, 0.0, f"{FORMULA} + 2", True),
    ],
)
def test_a_form_is_right_within_a_tenth_or_two_sigmas(small, run, factor, sigma, text, right):
    stops = pd.read_csv(small.folder / "stops.csv")
    size = rms(small.error_m) / rms(value(FORMULA, small.beams))
    folder, rungs = run(factor * size, sigma * size, text)
    beams = small.beams.assign(error_m=small.error_m)
    found = form(folder, rungs, stops, beams)
    assert found["right"] is right, found
    assert found["effect_mm"] == pytest.approx(1e3 * small.size_m, rel=0.1)
    if text == FORMULA:
        wanted = abs(factor - 1) * found["effect_mm"]
        assert found["off_mm"] == pytest.approx(wanted, rel=1e-3, abs=1e-3)


ONE, TWO = frozenset({"humidity"}), frozenset({"azimuth_rad", "ring"})


@pytest.mark.parametrize(
    ("said", "right"),
    [
        (
            [("humidity", "log(humidity)"), ("azimuth_rad elevation_rad", "azimuth_rad * ring")],
            True,
        ),
        ([("humidity azimuth_rad ring", "humidity + azimuth_rad * ring")], True),
        ([("humidity", "humidity")], False),
        ([("humidity time_s", "humidity"), ("azimuth_rad ring", "azimuth_rad * ring")], False),
        # What one of three looks at was not hidden by itself.
        ([("humidity azimuth_rad ring", "humidity + azimuth_rad * ring"), ("ring", "ring")], False),
        ([], False),
    ],
)
def test_covariates_are_right_where_they_are_what_was_hidden(said, right):
    found = [
        {"covariates": names.split(), "formula": {"name": "f", "basis": [text]}}
        for names, text in said
    ]
    assert covariates_right(found, [ONE, TWO]) is right


@pytest.mark.parametrize(
    ("names", "right"),
    [
        (["temperature_drift"], True),
        (["temperature_drift", "stop_range_scatter"], True),
        ([], False),
        (["azimuth_range_harmonic"], False),
        (["temperature_drift", "range_scale"], False),
        (["temperature_drift", "warmup_drift@600"], False),
    ],
)
def test_what_the_catalogue_names_beside_a_formula_counts(names, right):
    found = [{"covariates": ["ring"], "formula": {"name": "f", "basis": ["sqrt(ring)"]}}]
    hidden = [frozenset({"ring"}), frozenset({"temperature_c"})]
    assert covariates_right(found, hidden, names) is right


def test_a_form_is_right_with_what_the_catalogue_names_beside_it(small, run):
    """A formula and a drift that the truth has not, of any size: what the drift is fitted to is
    what the formula lacks."""
    stops = pd.read_csv(small.folder / "stops.csv")
    size = rms(small.error_m) / rms(value(FORMULA, small.beams))
    text = f"{FORMULA} + temperature_c"
    folder, rungs = run(size, 0.0, text)
    beams = small.beams.assign(error_m=small.error_m)
    assert not form(folder, rungs, stops, beams)["right"]
    assert form(folder, rungs, stops, beams, ["temperature_drift"])["right"]
    assert not form(folder, rungs, stops, beams, ["azimuth_range_harmonic"])["right"]


@pytest.mark.parametrize(
    ("held_out", "rejected", "right"),
    [(1.05, 0.02, True), (1.15, 0.02, False), (1.0, 0.12, False), (None, 0.02, False)],
)
def test_what_is_thrown_away_is_not_explained(held_out, rejected, right):
    last = {"held_out_mm": held_out, "floor_mm": 1.0, "rejected": rejected}
    assert at_floor(last, {"rejected": 0.02}) is right


def test_a_user_adds_all_that_is_proposed():
    loose = {"covariates": ["ring"], "formula": None}
    shown = [{"covariates": ["ring"], "formula": {"name": name}, "says": name} for name in "fg"]
    assert proposed({"verdict": "adequate", "unexplained": [loose]}) == {}
    found = proposed({"verdict": "unexplained_structure", "unexplained": [loose, *shown]})
    assert found["effects"] == ["f", "g"] and found["formulas"][1]["says"] == "g"
    assert not found["named"]


RESULT = {
    "case": "00x1", "rig": "arm", "lidar": "a", "times": 1.0, "scatter_mm": 0.0,
    "hidden": ["sin(ring) * humidity"], "wanted": ["humidity", "ring"],
    "found": [["humidity", "ring"]], "says": ["s"], "basis": [["b"]], "named": [],
    "verdicts": ["unexplained_structure"], "formulas": [1], "stopped": "nothing more",
    "held_out_mm": [3.0, 1.0],
    "floor_mm": [1.0, 1.0], "rejected": [0.01, 0.01],
    "oracle": {}, "fit_s": 2.0, "search_s": [3.0], "covariates_right": True, "at_floor": True,
    "form": {"right": True, "off_mm": 0.1, "effect_mm": 3.0, "sigma_mm": 0.1},
}  # fmt: skip


def test_the_table_counts():
    wrong = {"case": "01x0.4", "times": 0.4, "covariates_right": False, "at_floor": False}
    formless = RESULT | {"case": "02x1", "form": {**RESULT["form"], "right": False}}
    nothing = {"hidden": [], "wanted": [], "found": [], "says": [], "basis": [], "formulas": [0]}
    null = RESULT | nothing | {"case": "null000"}
    alarm = RESULT | {"case": "null001", "hidden": []}
    failed = {"case": "03x1", "error": "Traceback\nValueError: no"}
    text = io.StringIO()
    listed = [RESULT, RESULT | wrong, formless, null, alarm, failed]
    show(listed, Console(file=text, width=200))
    said = text.getvalue()
    lines = [line.split() for line in said.splitlines()]
    assert ["all", "3", "0.67", "0.67", "0.67", "0.33", "1.5,", "1.5"] in lines
    assert ["0.4", "of", "a", "shot", "1", "0.00", "0.00", "1.00", "0.00", "1.5,", "1.5"] in lines
    assert "nulls: 2, a formula on 1" in said
    assert "--F 01x0.4" in said and "CH- 02x1" in said and "null001" in said
    assert " 00x1" not in said and "FAILED: 03x1: ValueError: no" in said


@pytest.mark.long
@pytest.mark.parametrize(
    ("rig", "most"), [("arm", 0), ("head", 1), pytest.param("planes", 0, marks=pytest.mark.long)]
)
def test_a_case_is_run_from_the_world_to_the_count(rig, most, tmp_path):
    """With the truth itself the error comes down to the floor: it is there to be found."""
    sector = "(azimuth_rad > 0.4) * (azimuth_rad < 1.1)"
    case = replace(SMALL, formulas=(sector,), rig=rig)
    result = formulas.run(case, tmp_path, most)
    assert json.loads(json.dumps(result)) == result
    # Without it the window is rejected, or stays: either is told from the floor.
    first = {k: result[k][0] for k in ("held_out_mm", "floor_mm", "rejected")}
    assert not at_floor(first, result["oracle"]) and at_floor(result["oracle"], result["oracle"])
    assert len(result["verdicts"]) == len(result["search_s"]) == most
    show([result], Console(file=io.StringIO()))
    rows = pd.read_parquet(tmp_path / "small.parquet")
    inside = value(sector, rows) > 0
    assert {"humidity", "ambient", "azimuth_rad"} <= set(rows)
    # The window stands out of the residuals of the first fit.
    mean_m = [rows["residual_m"][each].mean() for each in (inside, ~inside)]
    assert abs(mean_m[0] - mean_m[1]) > 2 * 1e-3 * result["size_mm"]


@pytest.mark.long
def test_where_nothing_is_hidden_the_model_is_at_the_floor():
    result = formulas.run(replace(SMALL, formulas=(), times=0.0))
    assert result["at_floor"] and "form" not in result and not result["oracle"]
