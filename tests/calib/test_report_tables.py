"""The calibration in a report: its tables, the CSV of tables and figures, and what a click does."""

import csv
import io
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import pytest
from matplotlib.figure import Figure
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from calib.report import report
from calib.report.data import csv_link
from calib.report.numbers import blocks_of, figure_csv
from sensors.documents import read_yaml

from ..browser import browser_page
from .viewed import small_run

OPEN = "document.querySelectorAll('details').forEach(d => d.open = true)"


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """A recording in `rec`, its run, and `report.html`."""
    folder = tmp_path_factory.mktemp("tables")
    report([small_run(folder)], folder / "report.html")
    return folder


@pytest.fixture(scope="module")
def window():
    with browser_page(1400, 900) as watched:
        yield watched
        watched.assert_clean()


@pytest.fixture
def page(made, window):
    """The report, all that is folded opened."""
    window.page.goto((made / "report.html").as_uri())
    window.page.evaluate(OPEN)
    yield window.page
    window.page.emulate_media(media="screen", color_scheme="light")


def rows_of(address: str) -> list[list[str]]:
    """The rows of a CSV that a link holds."""
    kind, _, text = address.partition(",")
    assert kind == "data:text/csv;charset=utf-8"
    return list(csv.reader(io.StringIO(unquote(text))))


def downloaded(page, name: str) -> list[list[str]]:
    """What a click on the link to a CSV of that name saves."""
    with page.expect_download() as download:
        page.locator(f"a[download='{name}.csv']").click()
    return list(csv.reader(io.StringIO(Path(download.value.path()).read_text("utf-8"))))


def column(page, table: str, heading: str) -> list[str]:
    """A column of a table as it stands in the page: numbers as exact as they are there."""
    return page.evaluate(
        """([table, heading]) => {
            const t = document.getElementById(table);
            const at = [...t.tHead.rows[0].cells].findIndex(c => c.textContent === heading);
            const exact = c => (c.querySelector('data') || {}).value || c.textContent;
            return [...t.tBodies[0].rows].map(r => exact(r.cells[at])) }""",
        [table, heading],
    )


# ------------------------------------------------------------------------------------- what it says


@pytest.mark.long
def test_poses_are_those_of_the_solution_and_of_the_rig(made, page):
    found = read_yaml(made / "run" / "solution.yaml")[0]["frames"]
    drawn = read_yaml(made / "rec" / "rig.yaml")[0]["frames"]
    rows = {(r[0], r[2]): list(map(float, r[3:])) for r in downloaded(page, "table-poses")[1:]}
    assert {name for name, by in rows if by == "the fit"} == found.keys()
    assert {name for name, by in rows if by == "CAD"} == drawn.keys()
    for (name, by), six in rows.items():
        frame = found[name] if by == "the fit" else drawn[name]
        np.testing.assert_allclose(np.divide(six[:3], 1e3), frame["xyz_m"], atol=1e-9)
        turn = Rotation.from_euler("xyz", six[3:], degrees=True)
        of = (
            Rotation.from_quat(frame["quat_wxyz"], scalar_first=True)
            if by == "the fit"
            else Rotation.from_euler("xyz", frame["rpy_rad"])
        )
        assert (turn.inv() * of).magnitude() < 1e-8


def test_differences_lead_from_cad_to_the_fit(made, page):
    """T_cad exp(twist) = T, with the exponential of scipy."""
    found = read_yaml(made / "run" / "solution.yaml")[0]["frames"]
    drawn = read_yaml(made / "rec" / "rig.yaml")[0]["frames"]
    twist: dict[str, dict[str, float]] = {}
    for row in downloaded(page, "table-links")[1:]:
        if row[3]:
            assert row[6] == {"r": "mrad", "t": "mm"}[row[2][0]]
            twist.setdefault(row[0], {})[row[2]] = float(row[3]) / 1e3
            assert float(row[7]) == pytest.approx(float(row[3]) / float(row[4]), rel=1e-6)
            before = drawn[row[0]]["sigma_rad" if row[2][0] == "r" else "sigma_m"]
            assert float(row[5]) == pytest.approx(1e3 * before)
    assert len(twist) > 3
    for name, told in twist.items():
        rx, ry, rz, tx, ty, tz = (told.get(k, 0.0) for k in ("rx", "ry", "rz", "tx", "ty", "tz"))
        xi = np.array([[0, -rz, ry, tx], [rz, 0, -rx, ty], [-ry, rx, 0, tz], [0, 0, 0, 0]])
        T_cad, T = np.eye(4), np.eye(4)
        T_cad[:3, :3] = Rotation.from_euler("xyz", drawn[name]["rpy_rad"]).as_matrix()
        T[:3, :3] = Rotation.from_quat(found[name]["quat_wxyz"], scalar_first=True).as_matrix()
        T_cad[:3, 3], T[:3, 3] = drawn[name]["xyz_m"], found[name]["xyz_m"]
        np.testing.assert_allclose(T_cad @ expm(xi), T, atol=1e-9)


def test_rings_and_joints_are_those_of_the_solution(made, page):
    effects = read_yaml(made / "run" / "solution.yaml")[0]["effects"]
    rings = downloaded(page, "table-effect-ring_5f_range_5f_offset")[1:]
    told = effects["ring_range_offset"]
    assert [row[1] for row in rings] == told["names"]
    np.testing.assert_allclose([float(r[2]) / 1e3 for r in rings], told["estimate"], rtol=1e-7)
    np.testing.assert_allclose([float(r[3]) / 1e3 for r in rings], told["sigma"], rtol=1e-7)
    joints = {r[1]: r for r in downloaded(page, "table-effects") if r[0] == "arm_joint_offset"}
    told = effects["arm_joint_offset"]
    for name, estimate, sigma in zip(
        *(told[k] for k in ("names", "estimate", "sigma")), strict=True
    ):
        assert (name in joints) == (sigma > 0)
        if sigma > 0:
            assert float(joints[name][2]) == pytest.approx(1e3 * estimate, rel=1e-7)
            assert joints[name][5] == "mrad"
    untold = {e["name"] for e in read_yaml(made / "run" / "solution.yaml")[0]["not_estimated"]}
    alone = {name for name in joints if f"arm_joint_offset.{name}" in untold}
    assert {name for name, row in joints.items() if row[8] == "no"} >= alone


# -------------------------------------------------------------------------------- what a click does


def test_a_heading_sorts_by_the_numbers_and_says_so(page):
    heading = page.locator("#table-links th", has_text="difference")
    before = column(page, "table-links", "difference")
    everything = sorted(page.locator("#table-links tbody tr").all_inner_texts())
    assert "" in before and heading.get_attribute("aria-sort") is None
    heading.locator("button").press("Enter")
    up = column(page, "table-links", "difference")
    assert heading.get_attribute("aria-sort") == "ascending"
    blank = before.count("")
    assert up == [*sorted(filter(None, before), key=float), *[""] * blank] != before
    heading.locator("button").click()
    down = column(page, "table-links", "difference")
    assert heading.get_attribute("aria-sort") == "descending"
    assert down == [*sorted(filter(None, before), key=float, reverse=True), *[""] * blank]
    page.locator("#table-links th", has_text="link").locator("button").click()
    names = column(page, "table-links", "link")
    assert names == sorted(names) and heading.get_attribute("aria-sort") is None
    assert sorted(page.locator("#table-links tbody tr").all_inner_texts()) == everything


def test_a_figure_opens_large_and_goes_back_where_it_was(page):
    ids = "all => all.map(f => f.id)"
    before = page.eval_on_selector_all("main figure", ids)
    for name, opens in (("rings", "svg"), ("moves", "button")):
        figure = page.locator(f"figure[id='{name}']")
        width = figure.locator("svg").bounding_box()["width"]
        figure.locator(opens).first.click()
        assert page.locator("dialog[open] figure").get_attribute("id") == name
        assert figure.locator("svg").bounding_box()["width"] > 1.3 * width
        box = figure.bounding_box()
        assert box["y"] >= 0 and box["y"] + box["height"] <= 900
        page.keyboard.press("Escape")
        assert page.locator("dialog[open]").count() == 0
        assert page.eval_on_selector_all("main figure", ids) == before
        assert page.evaluate("document.activeElement.closest('figure').id") == name


def test_contents_stay_in_sight(page):
    links = page.locator("nav a")
    assert links.count() > 7
    links.last.click()
    page.wait_for_function("scrollY > 2000")
    assert page.locator("nav").bounding_box()["y"] == 0
    last = links.last.bounding_box()
    assert last["x"] + last["width"] <= 1400
    links.nth(4).click()
    id = links.nth(4).get_attribute("href").removeprefix("#")
    top = "id => document.getElementById(id).getBoundingClientRect().top"
    page.wait_for_function(f"id => Math.abs(({top})(id) - 100) < 100", arg=id)
    assert page.evaluate(top, id) >= page.locator("nav").bounding_box()["height"]


def brightness(page, selector: str, part: str) -> float:
    """Of a colour, from 0 to 255."""
    colour = page.evaluate(f"getComputedStyle(document.querySelector('{selector}')).{part}")
    return float(np.mean([int(x) for x in colour[colour.index("(") + 1 : -1].split(",")[:3]]))


def test_at_night_it_is_dark_and_on_paper_it_is_not(page):
    assert brightness(page, "body", "backgroundColor") == 255
    page.emulate_media(color_scheme="dark")
    paper = brightness(page, "body", "backgroundColor")
    for selector in ("body", "figcaption", "th button", "a.csv", ".word", "h1"):
        assert paper < 40 and brightness(page, selector, "color") > 110, selector
    shot = page.locator("#rings svg").screenshot()
    assert np.median(pixels(shot)) == pytest.approx(paper, abs=3)  # the picture's own ground
    page.emulate_media(media="print", color_scheme="dark")
    assert brightness(page, "body", "backgroundColor") == 255
    assert brightness(page, "body", "color") < 60
    assert not page.locator(".tools").first.is_visible()
    assert page.locator("#table-poses").is_visible()


def pixels(png: bytes) -> np.ndarray:
    from PIL import Image

    return np.asarray(Image.open(io.BytesIO(png)).convert("L"))


@pytest.mark.long
def test_without_scripts_all_is_there(made, window):
    context = window.page.context.browser.new_context(java_script_enabled=False)
    page = context.new_page()
    page.goto((made / "report.html").as_uri())
    assert page.locator("th button, dialog").count() == 0
    for fold in page.locator("summary").all():
        fold.click()
    assert page.locator("#table-links tbody tr").last.is_visible()
    assert len(downloaded(page, "table-links")) > 20
    assert len(downloaded(page, "rings")) > 20
    context.close()


# ----------------------------------------------------------------------------------- CSV of figures


def test_every_figure_of_numbers_gives_them(made, page):
    ids = page.eval_on_selector_all("figure", "all => all.map(f => f.id)")
    given = page.eval_on_selector_all("figure a.csv", "all => all.map(a => a.download)")
    assert [f"{name}.csv" for name in ids] == given
    links = downloaded(page, "chain")
    found = {row[0]: row[1] for row in links[1:]}
    frames = read_yaml(made / "run" / "solution.yaml")[0]["frames"]
    assert {name: frame["parent"] for name, frame in frames.items()}.items() <= found.items()
    moved = np.array([float(row[2]) for row in links[1:] if row[2]])
    assert links[0][2] == "origin moved, mm" and len(moved) > 3 and (moved > 0).all()
    assert "unseen: no stops were held out" in page.locator("main").inner_text()
    told = read_yaml(made / "run" / "solution.yaml")[0]["effects"]["ring_range_offset"]
    rows = downloaded(page, "rings")
    assert rows[0] == ["series", "ring", "ring_range_offset, mm", "from", "to"]
    estimate, sigma = 1e3 * np.array(told["estimate"]), 1e3 * np.array(told["sigma"])
    numbers = np.array([list(map(float, row[1:])) for row in rows[1:]])
    wanted = [np.arange(len(sigma)), estimate, estimate - 1.96 * sigma, estimate + 1.96 * sigma]
    np.testing.assert_allclose(numbers, np.transpose(wanted), rtol=1e-4)


def test_numbers_are_those_that_were_drawn():
    figure = Figure()
    line, bars, picture, dots = figure.subplots(1, 4)
    line.fill_between([1.0, 2.0, 4.0], [0, 1, 2], [3, 4, 6], color="#0072b2")
    line.plot([1.0, 2.0, 4.0, 5.0], [2, 3, 4, np.nan], color="#0072b2", label="now")
    line.axhline(0)
    line.set(xlabel="range, m", ylabel="mean, mm")
    bars.barh(["a, b", "=c"], [1.5, -2.0])
    map_of = picture.imshow([[1, 2, 3], [4, np.nan, 6]], extent=(0, 6, 0, 2), origin="lower")
    figure.colorbar(map_of, ax=picture).set_label("off, mm")
    dots.errorbar([1.0, 2.0], [0.0, 1.0], xerr=[0.25, 0.5], fmt="o", color="#0072b2")
    dots.set_yticks([0, 1], ["zero\nth", "first"])
    figure.canvas.draw()
    assert rows_of(figure_csv(blocks_of(figure))) == [
        ["series", "range, m", "mean, mm", "from", "to"],
        ["now", "1", "2", "0", "3"],
        ["now", "2", "3", "1", "4"],
        ["now", "4", "4", "2", "6"],
        [],
        ["series", "x", "y", "from", "to"],
        ["", "1.5", "a, b", "", ""],
        ["", "-2", "'=c", "", ""],
        [],
        ["off, mm; y down, x to the right", "1", "3", "5"],
        ["0.5", "1", "2", "3"],
        ["1.5", "4", "", "6"],
        [],
        ["series", "x", "y", "from", "to"],
        ["now", "1", "zero, th", "0.75", "1.25"],
        ["now", "2", "first", "1.5", "2.5"],
    ]
    assert figure_csv(blocks_of(Figure())) == ""


def test_a_link_holds_any_text():
    rows = [["a,b", 'say "x"', "#%&?<>'é"], ["1e-9", "-3", "@sum"]]
    address = csv_link(rows)
    assert not set(' "<>#\n') & set(address.partition(",")[2])
    assert rows_of(address) == [rows[0], ["1e-9", "-3", "'@sum"]]
