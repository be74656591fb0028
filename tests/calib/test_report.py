"""The report of a run and its single figures: what they say, and that a browser shows them."""

import json
import re
import shutil
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from calib.report import Evidence, charts_of, plot, report
from calib.report.page import LISTED_QUIET
from calib.report.statistics import Z_EDGES
from calib.runs.calibrate import calibrate, grow, grown_model
from calib.runs.diagnose import diagnose
from calib.runs.residual_table import UNSEEN_FOLDER
from calib.runs.run import RESIDUALS, SUMMARY, Run
from calib.simulation import Spec, simulate
from chains.errors import InputError
from sensors.documents import write_json
from sensors.recording import read_table, write_table

from ..browser import browser_page

SMALL = Spec(
    lidar="hesai_pandarxt32", room="box", locations=3, stops_per_location=2, column_step=200
)
ALWAYS = (
    "ladder",
    "misfit",
    "moved",
    "chain",
    "moves",
    "effects",
    "budget",
    "tracker",
    "correlation",
)
OF_BEAMS = (
    *("unseen", "variance", "scatter", "rings", "map", "room", "targets", "findings", "groups"),
    *(f"residual-{c}" for c in ("incidence", "range", "ring", "azimuth", "elevation", "intensity")),
    *(f"residual-{c}" for c in ("label", "stop", "elapsed", "temperature", "humidity", "near-ir")),
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A recording with an effect hidden in it, a run without and, grown from it, one with it.

    The runs' names are such as HTML and mathematical text would take for something else.
    """
    folder = tmp_path_factory.mktemp("report")
    simulate(SMALL, folder / "rec", 1, {"incidence_angle_bias": 3.0})
    for path in (folder / "rec" / "scans").iterdir():
        columns = read_table(path)
        write_table(path, columns | {"near_ir": columns["x"] ** 2})  # a column of its maker's own
    first = calibrate([folder / "rec"], folder / "<b>first & $x^2$")
    diagnose(first, refits=False)
    grow(first, grown_model(first, ["incidence_angle_bias"]), folder / "grown")
    return folder


@pytest.fixture(scope="module")
def runs(folder) -> tuple[Run, Run]:
    """The run that lacks the effect, and the one that has it."""
    return Run.open(folder / "<b>first & $x^2$"), Run.open(folder / "grown")


@pytest.fixture(scope="module")
def first(runs) -> Evidence:
    return Evidence.of([runs[0]])


@pytest.fixture(scope="module")
def grown(runs) -> Evidence:
    return Evidence.of([runs[1]])


@pytest.fixture(scope="module")
def pages(folder, runs):
    """Both runs' reports as written."""
    return report([runs[0]], folder / "first.html"), report([runs[1]], folder / "grown.html")


@pytest.fixture(scope="module", params=[1400, 700])
def window(request):
    """A browser of one of two widths."""
    with browser_page(request.param, 900) as watched:
        yield watched


@pytest.fixture
def shown(pages, window):
    """The first run's page in that."""
    window.page.goto(pages[0].file.as_uri())
    yield window
    window.page.emulate_media(media="screen")


# ------------------------------------------------------------------------------------- the browser


@pytest.mark.long
def test_a_browser_shows_every_chart_and_asks_nobody_for_anything(pages, shown):
    page, ids = shown.page, [chart.id for chart in pages[0].contents.charts]
    assert {*ALWAYS, *OF_BEAMS} <= set(ids)
    found = page.eval_on_selector_all("figure", "all => all.map(f => f.id)")
    assert found == sorted(found, key=found.index) and sorted(found) == sorted(ids)
    page.evaluate("document.querySelectorAll('details').forEach(d => d.open = true)")
    for chart in pages[0].contents.charts:
        figure = page.locator(f"figure[id='{chart.id}']")
        assert figure.locator("h4").inner_text() == chart.title
        assert (
            told_below(chart, pages[0].contents, pages[0].verdict.light)
            in figure.locator("figcaption").inner_text()
        )
        box = figure.locator("svg").bounding_box()
        assert box["width"] > 300 and box["height"] > 80, chart.id
    shown.assert_clean()


def is_open(chart, light):
    """Whether a page of that light shows a chart before anything is opened."""
    return not chart.quiet and (chart.answer or light == "green")


def told_below(chart, contents, light):
    """How it is read, or which figure above it in its section is read so."""
    section = next(charts for charts in contents.sections.values() if chart in charts)
    many = sum(each.quiet for each in section) > LISTED_QUIET
    shown = sorted(section, key=lambda each: (not is_open(each, light), many and each.quiet))
    first = next(each for each in shown if each.reading == chart.reading)
    return chart.reading if first is chart else f"Read as {first.id}."


@pytest.mark.parametrize("which", [0, 1])
def test_what_is_no_answer_is_a_title_until_it_is_opened(pages, shown, which):
    """Every chart is one or the other; a link to a folded one opens it, and all about it."""
    page, written = shown.page, pages[which]
    address, charts = written.file.as_uri(), written.contents.charts
    page.goto(address)
    folded = [chart for chart in charts if not is_open(chart, written.verdict.light)]
    assert 0 < len(folded) < len(charts)
    for chart in charts:
        assert page.locator(f"figure[id='{chart.id}']").is_visible() != (chart in folded)
    found = page.locator(".quiet details:has(> figure) > summary").all_text_contents()
    assert sorted(found) == sorted(chart.title for chart in folded)
    grouped = page.locator(".quiet details details > figure").evaluate_all(
        "all => all.map(f => f.id)"
    )
    assert grouped
    page.goto(f"{address}#{grouped[-1]}")
    assert page.locator(f"figure[id='{grouped[-1]}']").is_visible()
    assert not page.locator(f"figure[id='{grouped[0]}']").is_visible()


def test_a_bad_run_is_short_and_begins_with_its_answer(pages, shown):
    """Shorter than three screens of a desk, where it has been ten."""
    page, size = shown.page, shown.page.viewport_size
    assert pages[0].verdict.light == "red"
    page.set_viewport_size({"width": 1300, "height": 900})
    assert page.evaluate("document.documentElement.scrollHeight") < 4500  # five screens
    page.set_viewport_size(size)
    said = pages[0].verdict.sentence
    assert page.locator("#verdict").inner_text().count(said) == 1
    assert page.locator("main").inner_text().count(said) == 0
    assert not page.locator("table.sortable").first.is_visible()


def test_nothing_is_wider_than_the_window(shown):
    page = shown.page
    page.evaluate("document.querySelectorAll('details').forEach(d => d.open = true)")
    assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth")


def test_no_two_parts_of_the_page_have_one_id(shown):
    ids = shown.page.eval_on_selector_all("[id]", "all => all.map(e => e.id)")
    assert len(ids) == len(set(ids))
    missing = """() => [...document.querySelectorAll('[clip-path], a[href^="#"]')].filter(e => {
        const to = e.getAttribute('href') || e.getAttribute('clip-path').slice(4, -1);
        return !document.getElementById(to.slice(1)) }).length"""
    assert shown.page.evaluate(missing) == 0


def test_beams_end_on_the_mesh_where_they_are_drawn_on_the_room(grown):
    """Ends are made from a table's angles and ranges; the mesh says how far they are from it."""
    scan, mesh = grown.problem.scans[1], grown.sources[0].reference
    ends = grown._ends(scan)
    off_m = mesh.distance_m(ends.at_m[ends.weight > 0])
    assert np.median(off_m) < 0.005 and np.quantile(off_m, 0.95) < 0.03
    ((sigma_m, sides),) = grown.walls
    assert sigma_m == scan.reference_sigma_m
    assert sum(np.isfinite(side.mean_m).sum() for side in sides) > 60


def test_names_are_text_and_no_markup(shown):
    assert shown.page.locator("h1").inner_text() == "Calibration report: <b>first & $x^2$"
    assert "<b>first & $x^2$" in shown.page.locator("figure[id='ladder'] svg").text_content()
    assert shown.page.locator("h1 b").count() == 0


def test_print_opens_what_is_folded(shown):
    for folded in ("details figure", "details details figure"):
        shown.page.emulate_media(media="screen")
        figure = shown.page.locator(folded).first
        assert not figure.is_visible()
        shown.page.emulate_media(media="print")
        assert figure.is_visible() and figure.bounding_box()["height"] > 80
    assert not shown.page.locator("nav").is_visible()


# ------------------------------------------------------------------------------------ what it says


def test_the_verdict_names_what_is_missing_and_the_ladder_what_it_did(pages, runs):
    before, after = pages
    assert before.verdict.light == "red"
    assert before.verdict.sentence.startswith("incidence_angle_bias is missing")
    assert after.verdict.light != "red"
    errors = [f"{run.summary['rms_mm']['held_out']:.2f}" for run in runs]
    title = after.contents.charts[0].title
    assert title.startswith(f"The held-out error went from {errors[0]} to {errors[1]} mm")


def test_what_the_data_could_not_tell_is_told_with_what_would(pages, first):
    text = pages[0].file.read_text(encoding="utf-8")
    assert first.diagnosis["weak_directions"] and first.run.solution.not_estimated
    for weak in first.diagnosis["weak_directions"]:
        assert weak["needs"] in text
    for entry in first.run.solution.not_estimated:
        assert entry["name"] in text
    assert first.run.model["recordings"][0]["sha256"] in text


def test_figures_that_do_not_apply_are_named_with_the_reason(pages, folder):
    assert [a.id for a in pages[1].contents.absent] == [
        "groups",
        "formula",
        "findings",
        "workspace",
    ]
    assert "findings</code>: not diagnosed" in pages[1].file.read_text(encoding="utf-8")


def test_a_page_fetches_nothing(pages):
    text = pages[0].file.read_text(encoding="utf-8")
    links = re.findall(r"""(?:src|href)=["']?([^"'\s>]+)""", text)
    assert links and all(link.startswith(("#", "data:")) for link in links)
    assert text.count("<script") == 1 and "@import" not in text
    assert pages[0].file.stat().st_size < 4e6


def test_residuals_before_are_those_of_the_run_below_and_else_of_cad(first, grown, runs):
    for statistics, run in ((grown.earlier, runs[0]), (grown.after, runs[1])):
        parts = [read_table(p) for p in sorted((run.folder / RESIDUALS).glob("[!_]*"))]
        names = ("residual_m", "sigma_m", "weight")
        r, sigma, weight = (np.concatenate([p[n] for p in parts]).astype(float) for n in names)
        assert statistics.kept == (weight > 0).sum()
        counts = np.histogram((r / sigma)[weight > 0], Z_EDGES)[0]
        assert np.abs(counts - statistics.z).sum() <= 2  # on an edge, but for rounding
    nominal = runs[0].summary["rms_mm"]["nominal"]
    curve = first.earlier.curves["stop"]
    rms = 1e3 * np.sqrt(np.average(curve.std_m**2 + curve.mean_m**2, weights=curve.count))
    assert rms == pytest.approx(nominal, rel=0.3)  # robustly weighted, and that is not
    assert rms > 5 * runs[0].summary["rms_mm"]["fit"]


def test_stops_held_out_are_those_of_the_summary_and_the_worst_is_first(grown):
    tables = {
        p.stem: read_table(p) for p in (grown.run.folder / RESIDUALS / UNSEEN_FOLDER).iterdir()
    }
    left_out = {name[:3] for name in tables}
    assert len(left_out) == 1 and len(tables) == 2  # one location of the three, whole
    kept = {n: t["residual_m"][t["weight"] > 0].astype(float) for n, t in tables.items()}
    rms_mm = 1e3 * np.sqrt(np.mean(np.concatenate(list(kept.values())) ** 2))
    assert rms_mm == pytest.approx(grown.run.summary["rms_mm"]["held_out"], rel=1e-5)
    stops = grown.unseen
    rms_m = [np.sqrt(np.mean(kept[stop.name] ** 2)) for stop in stops]
    assert rms_m == sorted(rms_m, reverse=True)
    for stop, rms in zip(stops, rms_m, strict=True):
        assert stop.rms_m[2] == pytest.approx(rms) and stop.rms_m[1] < stop.rms_m[2]
        table, (rings, azimuths) = tables[stop.name], stop.map_m[2].shape
        for ring, part in ((0, 0), (rings - 1, azimuths // 2)):
            from_rad = 2 * np.pi * part / azimuths - np.pi
            there = (table["ring"] == ring) & (table["weight"] > 0)
            there &= table["azimuth_rad"] >= from_rad
            there &= table["azimuth_rad"] < from_rad + 2 * np.pi / azimuths
            mean = table["residual_m"][there].mean() if there.any() else np.nan
            assert stop.map_m[2][ring, part] == pytest.approx(mean, rel=1e-5, nan_ok=True)


def test_the_noise_floor_is_taken_apart_into_all_of_it(grown):
    from calib.report.charts.fit import variance_mm

    rms, parts = grown.run.summary["rms_mm"], variance_mm(grown)
    total = np.sqrt(sum(v * v for v in parts.values()))
    assert total == pytest.approx(max(rms["noise_floor"], rms["held_out"]), rel=1e-6)
    assert parts["range noise"] > 0 and parts["pose of an unseen stop"] > 0


# ---------------------------------------------------------------------------------- single figures


@pytest.mark.parametrize("ending", ["png", "svg", "pdf"])
def test_a_figure_is_written_for_a_paper(first, tmp_path, ending):
    path = tmp_path / f"ladder.{ending}"
    chart = plot(first, "ladder", path)
    assert chart.id == "ladder" and [p.name for p in tmp_path.iterdir()] == [path.name]
    if ending == "svg":
        assert ElementTree.parse(path).getroot().tag.endswith("svg")
    else:
        assert path.read_bytes().startswith({"png": b"\x89PNG", "pdf": b"%PDF"}[ending])


def test_the_command_line_lists_and_draws(rigcal, runs, tmp_path, first):
    code, out, _ = rigcal("plot", runs[0].folder, "--list", "--json")
    listed = [chart["id"] for chart in json.loads(out)["charts"]]
    assert code == 0 and listed == [*(c.id for c in charts_of(first).charts), "graph"]
    code, out, _ = rigcal("plot", runs[0].folder, "chain", "-o", tmp_path / "chain.png", "--json")
    assert code == 0 and json.loads(out)["id"] == "chain" and (tmp_path / "chain.png").is_file()
    code, out, err = rigcal("plot", runs[0].folder, "chainn", "-o", tmp_path / "x.png")
    assert (code, out) == (2, "") and "did you mean chain?" in err
    code, _, err = rigcal("plot", runs[1].folder, "findings", "-o", tmp_path / "x.png")
    assert code == 2 and "has no figure 'findings': not diagnosed" in err
    code, _, err = rigcal("plot", runs[0].folder, "chain", "-o", tmp_path / "x.jpg")
    assert code == 2 and ".png, .svg, .pdf" in err
    code, _, err = rigcal("plot", runs[0].folder)
    assert code == 2 and "--list" in err
    assert [p.name for p in tmp_path.iterdir()] == ["chain.png"]


# ------------------------------------------------------------------------------ what may be wrong


def without_table(run):
    next((run / RESIDUALS).glob("[!_]*")).unlink()


def without_column(run):
    path = next((run / RESIDUALS).glob("[!_]*"))
    write_table(path, {n: c for n, c in read_table(path).items() if n != "weight"})


def of_another_version(run):
    summary = json.loads((run / SUMMARY).read_text())
    del summary["misfit"]
    write_json(run / SUMMARY, summary)


def with_another_diagnosis(run):
    (run / "diagnosis.json").write_text("{}")


@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        (without_table, "the run is incomplete, fit it again"),
        (without_column, "has no column weight"),
        (of_another_version, "misfit is missing"),
        (with_another_diagnosis, "diagnose the run again"),
    ],
)
def test_a_run_that_is_spoilt_is_one_sentence_and_leaves_no_page(runs, tmp_path, spoil, told):
    shutil.copytree(runs[0].folder, tmp_path / "run")
    spoil(tmp_path / "run")
    with pytest.raises(InputError, match=re.escape(told)):
        report([Run.open(tmp_path / "run")], tmp_path / "page.html")
    assert not (tmp_path / "page.html").exists()


def test_a_recording_that_has_moved_is_one_sentence(folder, runs, tmp_path):
    (folder / "rec").rename(folder / "elsewhere")
    try:
        with pytest.raises(InputError, match="is no longer there; put it back"):
            report([runs[0]], tmp_path / "page.html")
    finally:
        (folder / "elsewhere").rename(folder / "rec")


def test_a_page_cannot_take_the_place_of_a_folder(runs, folder):
    with pytest.raises(InputError, match="cannot be written"):
        plot(Evidence.of([runs[0]]), "ladder", folder_like(folder / "taken.png"))
    assert (folder / "taken.png").is_dir()


def folder_like(path: Path) -> Path:
    path.mkdir()
    return path
