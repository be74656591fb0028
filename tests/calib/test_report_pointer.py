"""What a report's figures show under the pointer, how they are zoomed; and residuals by stop."""

import csv
import io
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import pytest

from calib.report import Evidence, figure, report
from calib.report.charts.residuals import map_limit
from calib.runs.residual_table import UNSEEN_FOLDER
from calib.runs.run import RESIDUALS, Run
from sensors.recording import read_table

from ..browser import browser_page
from .viewed import hidden

LARGEST_SCRIPT = 15_000  # bytes
OPEN = "document.querySelectorAll('details').forEach(d => d.open = true)"
# Where in the window the middle row or cell of each block of a figure is.
MIDDLES = """id => {
  const f = document.getElementById(id), svg = f.querySelector('svg');
  svg.scrollIntoView({ block: 'center' });
  const middle = a => a[a.length >> 1];
  const between = a => (a[a.length >> 1] + a[(a.length >> 1) - 1]) / 2;
  return JSON.parse(f.dataset.places).flatMap(b => b.places.filter(p => p.x.length).map(p => {
    const part = p.what ? between : middle;
    const at = new DOMPoint(part(p.x), part(p.y)).matrixTransform(svg.getScreenCTM());
    return [at.x, at.y] })) }"""


@pytest.fixture(scope="module")
def folder(once) -> Path:
    """A run with stops held out, in `run`, and its report."""
    folder = once(hidden)
    report([Run.open(folder / "run")], folder / "report.html")
    return folder


@pytest.fixture(scope="module")
def evidence(folder) -> Evidence:
    return Evidence.of([Run.open(folder / "run")])


@pytest.fixture
def page(folder):
    with browser_page(1300, 900) as watched:
        watched.page.goto((folder / "report.html").as_uri())
        watched.page.evaluate(OPEN)
        yield watched.page
        watched.assert_clean()


def numbers(page, name: str) -> list[list[str]]:
    """The rows of a figure's CSV."""
    address = page.locator(f"figure[id='{name}'] a.csv").get_attribute("href")
    return list(csv.reader(io.StringIO(unquote(address.partition(",")[2]))))


def told_at(page, name: str) -> list[str]:
    """What is told where the middle of each of its blocks is."""
    out = []
    for x, y in page.evaluate(MIDDLES, name):
        page.mouse.move(x, y)
        told = page.locator(f"figure[id='{name}'] .told")
        out.append(told.inner_text() if told.is_visible() else "")
    return out


# ---------------------------------------------------------------------------------------- the hover


@pytest.mark.long
def test_every_figure_tells_numbers_of_its_csv_under_the_pointer(page):
    for name in page.eval_on_selector_all("figure", "all => all.map(f => f.id)"):
        told = told_at(page, name)
        assert told and all(told[:1]), name
        known = {f"{float(f'{float(cell):.4g}'):g}" for row in numbers(page, name) for cell in row
                 if cell.lstrip("-")[:1].isdigit() and ":" not in cell}  # fmt: skip
        words = {word.rstrip(":") for each in told for word in each.split()}
        assert words & known or "seen" in words, (name, told)


@pytest.mark.parametrize(
    ("name", "part"),
    [
        ("ladder", "stops held out\nrms of the range residual: {held_out} mm\n"),
        ("rings", "ring_range_offset: "),
        ("residual-incidence", "deg\nmean: "),
        ("chain", " mrad\n"),
        ("map", " mm\nazimuth: "),
        ("tracker", " mm\nalong y: "),
    ],
)
@pytest.mark.long
def test_what_is_told_has_its_unit(page, folder, name, part):
    held_out = Run.open(folder / "run").summary["rms_mm"]["held_out"]
    told = told_at(page, name)
    # The CSV is rounded, and what is told is rounded from it.
    rounded = (f"{float(f'{held_out:.{digits}g}'):.4g}" for digits in (4, 5))
    assert any(part.format(held_out=size) in each for size in rounded for each in told), told
    assert all(" mm" in each or " mrad" in each for each in told[:1])


@pytest.mark.long
def test_a_point_is_told_as_its_row_and_nothing_where_there_is_none(page):
    rows = numbers(page, "rings")
    assert rows[0][1:3] == ["ring", "ring_range_offset, mm"]
    (told,) = told_at(page, "rings")
    row = rows[1 + (len(rows) - 1) // 2]
    ring, value, low, high = (f"{float(f'{float(x):.4g}'):g}" for x in row[1:])
    wanted = [f"ring: {ring}", f"ring_range_offset: {value} mm", f"from {low} to {high}"]
    assert told.splitlines() == wanted
    box = page.locator("#rings svg").bounding_box()
    page.mouse.move(box["x"] + 2, box["y"] + 2)
    assert not page.locator("#rings .told").is_visible()


# ----------------------------------------------------------------------------------------- the zoom


def view_box(page, name: str) -> list[float]:
    box = page.locator(f"figure[id='{name}'] svg").first.get_attribute("viewBox")
    return list(map(float, box.split()))


def test_a_dragged_box_is_zoomed_and_a_double_click_shows_all(page):
    (point,) = page.evaluate(MIDDLES, "rings")
    whole, box = view_box(page, "rings"), page.locator("#rings svg").bounding_box()
    left, top = point[0] - 0.1 * box["width"], point[1] - 0.05 * box["height"]
    page.mouse.move(left, top)
    page.mouse.down()
    page.mouse.move(left + 0.25 * box["width"], top + 0.1 * box["height"], steps=4)
    page.mouse.up()
    x, _, wide, high = view_box(page, "rings")
    assert wide == pytest.approx(0.25 * whole[2], rel=0.02)
    assert x / whole[2] == pytest.approx((left - box["x"]) / box["width"], abs=0.01)
    assert high / wide == pytest.approx(whole[3] / whole[2])
    now = page.locator("#rings svg").bounding_box()
    assert now["height"] == pytest.approx(box["height"], abs=1)
    assert page.locator("dialog[open]").count() == 0
    told = told_at(page, "rings")  # the numbers are found in what is zoomed as well
    assert "ring_range_offset: " in told[0] and " mm" in told[0]
    page.mouse.dblclick(left, top)
    assert view_box(page, "rings") == whole and page.locator("dialog[open]").count() == 0


def test_the_wheel_zooms_what_is_open_large_and_scrolls_the_page_elsewhere(page):
    page.locator("#moves svg").first.scroll_into_view_if_needed()
    whole, box = view_box(page, "moves"), page.locator("#moves svg").first.bounding_box()
    page.mouse.move(box["x"] + 0.5 * box["width"], box["y"] + 0.5 * box["height"])
    page.mouse.wheel(0, -200)
    assert view_box(page, "moves") == whole
    page.locator("#moves").get_by_text("Enlarge").click()
    box = page.locator("#moves svg").first.bounding_box()
    page.mouse.move(box["x"] + 0.5 * box["width"], box["y"] + 0.5 * box["height"])
    page.mouse.wheel(0, -200)
    page.wait_for_function(
        "w => document.querySelector('#moves svg').viewBox.baseVal.width < w", arg=0.9 * whole[2]
    )
    reset = page.locator("#moves").get_by_text("Reset zoom")
    assert reset.is_visible()
    reset.click()
    assert view_box(page, "moves") == whole and not reset.is_visible()


def test_scripts_are_small_and_a_page_without_them_promises_nothing(folder):
    text = (folder / "report.html").read_text("utf-8")
    script = text[text.rindex("<script>") : text.rindex("</script>")]
    assert text.count("<script") == 1 and 5_000 < len(script.encode()) < LARGEST_SCRIPT
    assert "drag a box" not in text.replace(script, "")


# ------------------------------------------------------------------------------------- stop by stop


def test_every_stop_has_its_map_and_those_held_out_another(folder, evidence):
    run = Run.open(folder / "run")
    seen = {p.stem: read_table(p) for p in (run.folder / RESIDUALS).glob("*.parquet")}
    unseen = {p.stem: read_table(p) for p in (run.folder / RESIDUALS / UNSEEN_FOLDER).iterdir()}
    stops = evidence.stops
    assert len(unseen) > 0
    assert {s.name for s in stops if not s.held_out} == {n for n in seen if n[0] != "_"}
    assert {s.name for s in stops if s.held_out} == unseen.keys()
    first = [s.rms_m for k, s in enumerate(stops) if not k or stops[k - 1].name != s.name]
    assert first == sorted(first, reverse=True)
    for stop in stops:
        table = (unseen if stop.held_out else seen)[stop.name]
        r = table["residual_m"][table["weight"] > 0].astype(float)
        assert stop.rms_m == pytest.approx(np.sqrt(np.mean(r**2)))
    rings = [len(s.map_m) for s in stops]
    assert set(rings) == {min(32, evidence.rings)}


def test_all_stops_are_drawn_the_first_few_in_the_page_and_the_others_folded(page, evidence):
    drawn = [t.split(":")[0] for name in ("stops", "stops-2") for t in titles(evidence, name)]
    wanted = [f"{s.name} held out" if s.held_out else s.name for s in evidence.stops]
    assert drawn == wanted
    limits = {im.get_clim() for name in ("stops", "stops-2")
              for ax in figure(evidence, name).axes for im in ax.images}  # fmt: skip
    assert len(limits) == 1
    assert page.locator("figure#stops-2").evaluate("f => f.closest('details') !== null")


def titles(evidence: Evidence, name: str) -> list[str]:
    axes = figure(evidence, name).axes
    return [ax.get_title(loc="left") for ax in axes if ax.images]


# --------------------------------------------------------------------------- before, now, held out


def test_maps_before_now_and_held_out_have_one_scale(evidence):
    drawn = figure(evidence, "map")
    images = [im for ax in drawn.axes for im in ax.images]
    assert len(images) == 3 and len({im.get_clim() for im in images}) == 1
    np.testing.assert_array_equal(
        np.ma.filled(images[2].get_array(), np.nan), 1e3 * evidence.held_out.map_m
    )


def test_the_scale_shows_what_is_left_beside_a_much_larger_error_before():
    was, now = np.full((4, 4), 20.0), np.full((4, 4), 0.3)
    assert 0.3 <= map_limit([was, now]) <= 20.0 / 4
    assert map_limit([now, now]) == 0.5


def test_curves_of_stops_held_out_stand_beside_those_of_the_fit(folder, evidence):
    parts = [read_table(p) for p in (folder / "run" / RESIDUALS / UNSEEN_FOLDER).iterdir()]
    kept = np.concatenate([p["weight"] > 0 for p in parts])
    assert evidence.held_out.kept == kept.sum()
    top, _, bottom = figure(evidence, "residual-incidence").axes
    labels = [line.get_label() for line in top.lines[:3]]
    assert labels == ["before, as in CAD", "now", "held out"]
    curve = evidence.held_out.curves["incidence_rad"]
    known = np.isfinite(curve.mean_m)
    np.testing.assert_allclose(
        np.sort(top.lines[2].get_ydata()), np.sort(1e3 * curve.mean_m[known])
    )
    assert (
        len(bottom.lines) == 3
        and top.get_ylim()[1] >= 1e3 * np.abs(curve.mean_m[known]).max() * 0.9
    )


def test_joints_are_shown_in_degrees(evidence):
    names = evidence.sources[0].rig.joint_names
    drawn = figure(evidence, f"residual-{names[0].replace('_', '-')}")
    assert drawn.axes[-1].get_xlabel().endswith(", deg")
    at = evidence.after.curves[names[0]].at
    shown = drawn.axes[-1].lines[-2].get_xdata()
    assert np.nanmax(shown) == pytest.approx(np.degrees(np.nanmax(at)))
