"""A formula of residual structure, as people see it: picture, ladder, file, warning."""

import json
import re
import shutil
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

from calib.diagnosis.formulas.picture import picture_of
from calib.diagnosis.formulas.seen import ColumnRanges
from calib.diagnosis.suggest import outward
from calib.effects import load_effects
from calib.evaluation.apply import apply
from calib.problem.model import Model
from calib.report import Evidence, plot, report
from calib.report.charts.fit import ladder as ladder_chart
from calib.report.charts.formulas import charts_of, pictures
from calib.runs.calibrate import calibrate
from calib.runs.explain import EXPLANATION, KEPT_EFFECTS, explain
from calib.runs.ladder import FORMULA, Rung, ladder
from calib.runs.run import Run
from calib.show.comparison import ladder_table
from calib.show.tables import terminal
from calib.simulation import simulate
from calib.view import panels
from calib.view.desk import Desk, Findings
from chains.errors import InputError
from sensors.recording import read_table

from ..browser import browser_page
from .test_empirical import HUMP, SPEC
from .test_view_browser import shown
from .viewed import diagnosed, grown, small_run

NAME = "empirical_temperature_c_ring"


def formula(*covariates, **changes):
    """A formula as diagnosis.json has it, over one column or two: a step of 5 mm."""
    shape = (4, 3)[: len(covariates)]
    edges = [np.linspace(0.0, 1.0, n + 1).tolist() for n in shape]
    value = np.where(np.indices(shape)[0] > 1, 5.0, -5.0)
    left = np.full(shape, 0.25)
    left.flat[0] = np.nan
    picture = {
        "covariates": list(covariates),
        "edges": edges,
        "unit": "mm",
        "measured": (value + left).tolist(),
        "formula": value.tolist(),
        "left": left.tolist(),
    }
    return {
        "covariates": list(covariates),
        "rms_mm": 5.0,
        "says": "range = true + 5.00(2) mm * (x > 0.5)",
        "held_out_rms_mm": {"before": 8.21, "after": 2.86},
        "formula": {"name": NAME, "basis": ["ring"]},
        "picture": picture | changes,
    }


class Beams:
    """Stands in for the table of a search."""

    def __init__(self, **covariates):
        self.covariates = covariates

    def __len__(self):
        return len(next(iter(self.covariates.values())))


# ------------------------------------------------------------------------------------- the picture


def test_bins_hold_the_weighted_means_of_their_beams():
    """Against a sum over beams, one by one."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-1.0, 3.0, 4000), rng.integers(0, 5, 4000).astype(float)
    value, left, weight = *rng.normal(size=(2, 4000)), rng.uniform(0.0, 2.0, 4000)
    beams, fit = Beams(range_m=x, ring=y), SimpleNamespace(weight=weight, left_m=left)
    found = picture_of(beams, ["range_m", "ring"], value, fit)
    edges, rings = map(np.array, found["edges"])
    assert rings.tolist() == [-0.5, 0.5, 1.5, 2.5, 3.5, 4.5]
    assert edges[[0, -1]] == pytest.approx([x.min(), x.max()])
    inside = (x > edges[7]) & (x < edges[8]) & (y == 3)
    assert inside.sum() > 20
    for key, of in (("measured", left + value), ("formula", value), ("left", left)):
        expected = 1e3 * (weight[inside] * of[inside]).sum() / weight[inside].sum()
        assert found[key][7][3] == pytest.approx(expected)
    single = picture_of(beams, ["ring"], value, fit)
    expected = 1e3 * np.average(left[y == 2], weights=weight[y == 2])
    assert single["left"][2] == pytest.approx(expected)


def test_bins_with_hardly_a_beam_are_empty():
    beams = Beams(ring=np.array([0.0, 0.0, 0.0, 0.0, 1.0]))
    fit = SimpleNamespace(weight=np.ones(5), left_m=np.ones(5))
    assert np.isnan(picture_of(beams, ["ring"], np.ones(5), fit)["left"]).tolist() == [0, 1]


def test_three_maps_stand_on_one_scale_in_the_units_of_people():
    (chart,) = charts_of({"unexplained": [formula("azimuth_rad", "ring")]})
    assert "azimuth and ring" in chart.title and "from 8.21 to 2.86 mm" in chart.title
    assert chart.reading.startswith("range = true + 5.00(2) mm") and chart.wide
    figure = chart.figure()
    maps = [mesh for ax in figure.axes[:3] for mesh in ax.collections]
    assert {mesh.get_clim() for mesh in maps} == {(-10.0, 10.0)}
    assert maps[0].get_coordinates()[0, -1, 0] == pytest.approx(np.degrees(1.0))
    assert figure.axes[0].get_xlabel() == "azimuth, deg"
    assert figure.axes[0].get_ylabel() == "ring"
    titles = [ax.get_title(loc="left") for ax in figure.axes[:3]]
    assert titles == ["measured, 5.03 mm rms", "formula, 5.00 mm rms", "left, 0.25 mm rms"]
    unseen = np.ma.getmaskarray(maps[2].get_array()).ravel()
    assert np.flatnonzero(unseen).tolist() == [0], "ring 0, the first azimuth"
    (turned,) = charts_of({"unexplained": [formula("ring", "azimuth_rad")]})
    assert turned.figure().axes[0].get_ylabel() == "ring"
    assert maps[1].get_array().ravel()[3] == 5.0, "ring 0, the last azimuth"


def test_one_column_is_a_plot_with_the_curve_and_what_is_left_on_the_same_scale():
    (chart,) = charts_of({"unexplained": [formula("temperature_c", measured=[-5, -5, 9, 5])]})
    figure = chart.figure()
    top, bottom = figure.axes
    assert top.get_ylim() == bottom.get_ylim() and top.get_ylim()[1] > 9
    assert bottom.get_xlabel() == "temperature, °C" and not chart.wide
    stairs = top.patches[0].get_data()
    assert stairs.values.tolist() == [-5, -5, 5, 5] and stairs.edges[-1] == 1.0
    assert bottom.lines[0].get_ydata()[1:].tolist() == [0.25] * 3


def test_a_third_column_is_said_to_be_averaged_over():
    each = formula("temperature_c", "ring") | {"covariates": ["temperature_c", "ring", "range_m"]}
    (picture,) = pictures({"unexplained": [each]})
    assert picture.reading.endswith("Averaged over range.")
    assert "temperature and ring and range" in picture.title


@pytest.mark.parametrize(
    "changes",
    [
        {"edges": [[0.0, 1.0]]},
        {"edges": [[0.0, 2.0, 1.0, 3.0, 4.0]]},
        {"left": "none"},
        {"formula": [[1.0, 2.0, 3.0, 4.0]]},
        {"covariates": []},
    ],
)
def test_a_picture_that_is_none_is_one_sentence(changes):
    with pytest.raises(InputError, match=r"diagnosis\.json.*diagnose the run again"):
        pictures({"unexplained": [formula("ring", **changes)]})


# ----------------------------------------------------------------------------- report and workbench


@pytest.fixture(scope="module")
def small(once):
    return Run.open(once(small_run) / "run")


@pytest.fixture
def described(small, tmp_path):
    """A run whose diagnosis has a formula, and one grown from it by that."""
    run = Run.open(shutil.copytree(small.folder, tmp_path / "run"))
    sentences = ["Its formula: range = true + 5.00(2) mm * (x > 0.5)."]
    found = {"unexplained": [formula("azimuth_rad", "ring")], "sentences": sentences}
    found |= {"verdict": "unexplained_structure", "candidates": []}
    found |= {"heading": "structure that no effect explains"}
    diagnosed(run.folder, **found)
    above = grown(run, tmp_path / "grown", NAME, 2.86)
    model = yaml.safe_load((above.folder / "model.yaml").read_text())
    effect = {"name": NAME, "site": "range", "unit": "m", "sigma": 0.01, "basis": ["ring"]}
    model["effects"][-1] = effect | {"seen": {"ring": [0, 127]}}
    (above.folder / "model.yaml").write_text(yaml.safe_dump(model))
    return run, Run.open(above.folder)


@pytest.mark.long
def test_the_report_shows_it_where_it_was_found(described, tmp_path):
    run, _ = described
    written = report([run], tmp_path / "report.html")
    (chart,) = (c for c in written.contents.charts if c.id == "formula")
    with browser_page(1400, 900) as watched:
        watched.page.goto(written.file.as_uri())
        figure = watched.page.locator("section", has_text="What was found").locator("#formula")
        assert figure.locator("h4").inner_text() == chart.title
        assert "range = true + 5.00(2) mm" in figure.locator("figcaption").inner_text()
        for text in ("measured, 5.03 mm rms", "left, 0.25 mm rms", "azimuth, deg"):
            assert figure.locator("svg text", has_text=text).count(), text
        assert figure.locator("svg").bounding_box()["width"] > 600
        watched.assert_clean()
    evidence = Evidence.of([run])
    assert plot(evidence, "formula", tmp_path / "formula.png").title == chart.title


@pytest.mark.long
def test_the_workbench_shows_it_and_offers_to_add_it(described):
    run, _ = described
    with shown(run.folder) as (watched, _):
        found = watched.page.locator("[data-is=formula]")
        found.locator("svg text", has_text="formula, 5.00 mm rms").wait_for()
        box = found.locator("svg").bounding_box()
        assert 300 < box["width"] < 400 and box["height"] > box["width"]
        assert "from 8.21 to 2.86 mm" in found.inner_text()
        assert not watched.page.get_by_label(NAME, exact=True).is_checked()


def test_names_in_a_picture_cannot_become_markup(described):
    run, _ = described
    evil = "<script>alert(1)</script>"
    each = formula("ring", evil) | {"says": evil}
    diagnosed(run.folder, unexplained=[each])
    html = panels.formulas(Findings.read(run))
    assert "<script" not in html and "&lt;script&gt;" in html


def test_a_rung_by_a_formula_is_drawn_otherwise(described, capsys):
    """In terminal, workbench and report, with a word in the legend."""
    rungs = ladder([described[1]])
    assert [rung.empirical for rung in rungs] == [[], [NAME]]
    assert rungs[1].step == f"~ {NAME}" and rungs[1].document()["empirical"] == [NAME]
    terminal().print(ladder_table(rungs))
    said = " ".join(capsys.readouterr().out.split())
    assert f"~ {NAME}" in said and FORMULA in said
    html = panels.ladder(rungs)
    assert html.count("repeating-linear-gradient") == 1 and FORMULA in html
    evidence = Evidence.of([described[1]])
    (chart,) = ladder_chart(evidence)
    (ax,) = chart.figure().axes
    diamonds = [line for line in ax.lines if line.get_marker() == "D"]
    assert len(diamonds) == 1 and diamonds[0].get_xydata().tolist() == [[2.86, 2.0]]
    assert "with a formula" in [line.get_label() for line in ax.lines] and FORMULA in chart.reading


def test_a_rung_by_a_known_effect_is_not(small, tmp_path):
    rungs = [Rung(small, None), Rung(grown(small, tmp_path / "up", "range_scale", 3.0), small)]
    assert rungs[1].step == "+ range_scale" and not rungs[1].empirical
    assert "gradient" not in panels.ladder(rungs)
    assert ladder_table(rungs).caption is None


# ------------------------------------------------------------------------- beyond where it was seen


def effect(tmp_path, **seen):
    document = {"name": "drift", "site": "range", "unit": "m", "sigma": 0.001}
    document |= {"basis": [" + ".join(seen) or "ring"], "seen": seen}
    path = tmp_path / "drift.yaml"
    path.write_text(yaml.safe_dump(document))
    return path


@pytest.mark.parametrize(
    "values, told",
    [
        ([20.0, 30.0], ""),
        ([20.0, 30.4], ""),
        (
            [20.0, 31.0],
            "temperature from 20 to 30 degrees C, and here goes from 20 to 31",
        ),
        ([15.0], "here goes from 15 to 15 degrees C"),
        ([np.nan, 25.0], ""),
        ([], ""),
    ],
)
def test_what_lies_beyond_is_told_and_a_bins_width_is_not(tmp_path, values, told):
    (drift,) = load_effects(str(effect(tmp_path, temperature=[20, 30])))
    reach = ColumnRanges([drift])
    for value in values:
        reach.look({"temperature_c": np.array([value]), "other": None})
    (sentence,) = reach.sentences() or [""]
    assert told in sentence and bool(sentence) == bool(told)
    assert not sentence or sentence.startswith("drift is empirical")


def test_rows_that_do_not_count_are_not_looked_at(tmp_path):
    (drift,) = load_effects(str(effect(tmp_path, ring=[0, 10])))
    reach, rings = ColumnRanges([drift]), np.array([0, 5, 99])
    reach.look({"ring": lambda: rings}, rings < 50)
    assert reach.sentences() == []
    reach.look({"ring": lambda: rings}, rings > 50)
    assert "ring from 0 to 10, and here goes from 0 to 99" in reach.sentences()[0]


def test_a_span_is_rounded_outward():
    for low, high in ((21.9579, 31.3904), (-3.1415, 3.1405), (1.7e9, 1.7e9 + 4123.4), (5.0, 5.0)):
        a, b = outward(low, high)
        assert a <= low <= high <= b and low - a <= 0.01 * (high - low) + 1e-9


def test_a_fit_and_a_correction_beyond_it_are_warned_of(small, tmp_path):
    """Rings reach 127; seen were those to 60."""
    recording, runs = small.recordings[0], {}
    for most in (60, 127):
        file = effect(tmp_path, ring=[0, most])
        chosen = load_effects(["arm_link_length", str(file)])
        out = tmp_path / str(most)
        runs[most] = calibrate([recording], out, Model(chosen), hold_out="none")
    (told,) = runs[60].extrapolated
    assert "ring from 0 to 60, and here goes from 0 to 127" in told
    assert told in runs[60].warning and runs[127].warning == []
    cloud = tmp_path / "cloud.parquet"
    shutil.copy(next((recording / "scans").iterdir()), cloud)
    assert read_table(cloud)["ring"].max() > 100
    for most, expected in ((60, (told,)), (127, ())):
        (done,) = apply(runs[most], [cloud], tmp_path / f"out{most}")
        assert tuple(done.extrapolated) == expected


@pytest.mark.parametrize(
    "seen, told",
    [
        ({"ring": [3, 1]}, "seen of ring: give its least value, then its largest"),
        ({"rang": [1, 3]}, "seen has rang, which its formulas do not look at; did you mean ring?"),
    ],
)
def test_a_span_that_is_none_is_one_sentence(tmp_path, seen, told):
    path = effect(tmp_path, ring=[0, 1])
    path.write_text(yaml.safe_dump(yaml.safe_load(path.read_text()) | {"seen": seen}))
    with pytest.raises(InputError, match=re.escape(told)):
        load_effects(str(path))


# ---------------------------------------------------------------------------------------- for real


@pytest.mark.long
def test_explain_climbs_by_a_formula_and_keeps_it_for_others(tmp_path, rigcal, diagnosed_once):
    """A hump of incidence is in no catalogue. Its file has a page, and fits another recording."""
    (tmp_path / "hump.yaml").write_text(yaml.safe_dump(HUMP))
    for seed, name in ((2, "rec"), (3, "other")):
        simulate(SPEC, tmp_path / name, seed, {str(tmp_path / "hump.yaml"): 1.0})
    found = explain([tmp_path / "rec"], tmp_path / "ladder")
    (name,) = found.steps[-1]["empirical"]
    assert name == "empirical_incidence" and found.steps[-1]["added"] == [name]
    assert [rung.empirical for rung in ladder([found.runs[-1]])] == [[], [name]]
    (kept,) = found.kept
    assert kept == tmp_path / "ladder" / KEPT_EFFECTS / f"{name}.yaml"
    written = json.loads((tmp_path / "ladder" / EXPLANATION).read_text())
    assert written["kept"] == [str(kept)] and written["ladder"][-1]["empirical"] == [name]
    document = yaml.safe_load(kept.read_text())
    estimate = found.runs[-1].solution.shared.effects[name].estimate
    assert document["start"] == pytest.approx(estimate, rel=1e-3)
    low, high = document["seen"]["incidence_rad"]
    assert low < 0.1 and 1.1 < high < 1.6
    assert any(name in sentence for sentence in found.diagnosis.sentences)
    code, said, err = rigcal("effects", kept)
    assert code == 0 and re.search(r"\n +seen +incidence from \S+ to \S+ degrees", said), err
    plain = calibrate([tmp_path / "other"], tmp_path / "plain").summary["rms_mm"]
    code, _, err = rigcal("fit", tmp_path / "other", "-o", tmp_path / "with", "--effects",
                          f"arm_link_length,arm_joint_offset,ring_range_offset,{kept}")  # fmt: skip
    assert code == 0, err
    fitted = Run.open(tmp_path / "with").summary
    assert fitted["rms_mm"]["held_out"] < plain["held_out"] / 1.2
    assert fitted["extrapolated"] == []
    assert Desk.of([tmp_path / "with"]).run.empirical == (name,)
    again = explain([tmp_path / "rec"], tmp_path / "ladder")  # takes up its rungs, writes it anew
    assert again.kept == found.kept and kept.is_file()
