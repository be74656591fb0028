"""What the workbench answers: beams of a part of a plot, moves of links, and files of both."""

import csv
import io
import queue
import re
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calib.exporters import export
from calib.results.holdout import held_out
from calib.runs.reopen import reopened, start_of
from calib.runs.run import RESIDUALS, Run
from calib.solve.fit import stepped
from calib.view import panels
from calib.view.effects.expected import Expected
from calib.view.job import Change, changed
from calib.view.scene import Points, Scene
from calib.view.shown import brush, plot
from calib.view.shown.moves import Move, moves, parameters
from calib.view.shown.taken import beams_csv, extrinsics_zip
from sensors.recording import read_table
from tests.browser import Watched
from tests.calib.viewed import diagnosed, hidden, small_run
from tests.calib.workbench import (
    SOON_MS,
    button,
    check,
    choose,
    drag,
    shown,
    until,
    value,
    write,
)


@pytest.fixture(scope="module")
def run(once) -> Run:
    run = Run.open(once(small_run) / "run")
    diagnosed(run.folder)
    return run


def cloud(**columns: np.ndarray) -> Points:
    count = len(next(iter(columns.values())))
    return Points(np.zeros((count, 3)), np.zeros(3), {"weight": np.ones(count)} | columns, count)


# ----------------------------------------------------------------------------------------- a brush


def test_a_range_is_two_numbers_in_any_order_and_nothing_else():
    for text in ("1.5 to 20", " 20to1.5 ", "20, 1.5", "1.5e0 to +2e1"):
        assert brush.ends(text) == (1.5, 20.0)
    assert brush.ends("-3 to -1") == (-3.0, -1.0)
    for text in ("", "3", "3 to", "2 to 2", "a to b", "1.2.3 to 4", "1 to 2 to 3", "nan to 1"):
        assert brush.ends(text) is None


def test_beams_are_within_a_range_in_the_unit_that_is_shown():
    points = cloud(incidence_rad=np.radians([10.0, 20.0, 30.0, np.nan]))
    assert list(brush.within(points, "incidence_rad", (15.0, 30.5))) == [False, True, True, False]


def test_dots_that_are_not_lit_are_faint_and_one_has_a_ring():
    rng = np.random.default_rng(1)
    points = cloud(range_m=rng.uniform(0, 9, 400), residual_m=rng.normal(0, 1e-3, 400))
    lit, rows = points.columns["range_m"] < 3, np.arange(1, 400)
    rgb = np.full((400, 3), 90, np.uint8)
    beside = {"lit": lit, "marked": 7}
    (x, *drawn, _), series = plot.chart(points, rows, "residual_m", "range_m", rgb, **beside)
    faint, bright, ring = ({*x[np.isfinite(each)]} for each in drawn)
    assert series[1]["points"]["fill"] == plot.FAINT and series[2]["points"]["fill"] == "#5a5a5a"
    assert faint == {*points.columns["range_m"][rows][~lit[rows]]}
    assert bright == {*points.columns["range_m"][rows][lit[rows]]}
    assert ring == {points.columns["range_m"][7]} and series[3]["points"]["stroke"] == plot.RING
    _, series = plot.chart(points, rows, "residual_m", "range_m", rgb, lit=lit, marked=0)
    assert len(series) == 4  # the marked beam is not among those that are looked at


def dragged(watched: Watched, start: float, end: float) -> None:
    """Drag across the plot of beams, from one share of its width to another."""
    box = watched.page.locator(".u-over").first.bounding_box()
    (left, right), y = (box["x"] + share * box["width"] for share in (start, end)), box["y"] + 80
    drag(watched, (left, y), (right, y))


@pytest.mark.long
def test_a_part_of_the_plot_lights_its_beams_in_the_room(run):
    """By dragging and by writing; how many they are and how far off is told; a link keeps it."""
    table = read_table(run.folder / RESIDUALS / "L00P00.parquet")
    with shown(run.folder) as (watched, page):
        tab, stage = watched.page, page.picture.stage
        choose(watched, "Over", "ring")
        tab.wait_for_url(re.compile("over=ring"))
        ring = table["ring"]
        room = 0.03 * np.ptp(ring)  # to either side of the plot
        span = np.ptp(ring) + 2 * room
        plotted, last = tab.locator("[data-is=plotted]").first, f"{ring.max() + room:.6g}"
        until(watched, lambda: plotted.get_attribute("data-high"), last)
        dragged(watched, 0.25, 0.6)
        told = tab.locator("[data-is=lit]")
        told.wait_for()
        low, high = brush.ends(value(watched, "Light up"))
        assert low == pytest.approx(ring.min() - room + 0.25 * span, abs=0.02 * span)
        assert high == pytest.approx(ring.min() - room + 0.6 * span, abs=0.02 * span)

        def answer(low: float, high: float) -> str:
            some = (table["ring"] >= low) & (table["ring"] <= high)
            residual = 1e3 * table["residual_m"][some & (table["weight"] > 0)].astype(float)
            rms, mean = np.sqrt(np.mean(residual**2)), residual.mean()
            return (
                f"{some.sum():,} of {len(ring):,} beams are lit; residual of the inliers "
                f"{rms:.2f} mm rms, {mean:+.2f} mm mean."
            )

        until(watched, told.inner_text, answer(low, high))
        write(watched, "Light up", "10 to 90")
        told.get_by_text(answer(10, 90)).wait_for()
        lit = stage.client.scene.get_handle_by_name("/lit")
        unlit = stage.client.scene.get_handle_by_name("/points")
        there = stage.points.columns["ring"][stage.shown]
        assert len(lit.points) == ((there >= 10) & (there <= 90)).sum()
        assert len(unlit.points) == len(there) - len(lit.points)
        assert np.unique(unlit.colors, axis=0).tolist() == [list(brush.UNLIT)]
        tab.wait_for_url(re.compile("lit=10%20to%2090"))
        link = tab.url
        tab.goto("about:blank")
        tab.goto(link)
        told.get_by_text(answer(10, 90)).wait_for()
        choose(watched, "Over", "range, m")  # of which that is no range
        told.wait_for(state="hidden")
        until(watched, lambda: value(watched, "Light up"), "")


# ---------------------------------------------------------------------------------- moves from CAD


def test_an_arrow_leads_from_where_cad_has_a_link_and_its_sigma_is_the_runs(run):
    """Whatever effects have moved it: where it is, less where CAD has it in its parent."""
    scene, solution = Scene.of(run), run.solution
    edges = {edge.name: edge for edge in scene.sources[0].rig.tree.edges}
    for stop in scene.stops(0):
        found = {move.link: move for move in moves(scene, 0, stop)}
        assert {"lidar", "mount", "joint_3"} <= set(found) and "joint_2" not in found
        for name, move in found.items():
            parent, T_cad = scene.place(0, stop, edges[name].parent), edges[name].T_parent_child
            wanted = scene.place(0, stop, edges[name].child)[:3, 3] - (parent @ T_cad)[:3, 3]
            np.testing.assert_allclose(move.move_m, wanted, atol=1e-12)
            np.testing.assert_allclose(np.diff(move.arrow_m, axis=0)[0], 100 * wanted, atol=1e-10)
    # CAD's sigma of this frame is the same along all axes, and the fit's nearly so.
    sigma_m = solution.shared.frames["lidar"].sigma_m
    assert sigma_m.min() * 0.999 <= found["lidar"].sigma_m <= sigma_m.max() * 1.001
    lengths = solution.shared.effects["arm_link_length"]
    k = lengths.names.index("joint_3")
    assert found["joint_3"].sigma_m == pytest.approx(lengths.sigma[k])
    assert found["joint_3"].length_m == pytest.approx(abs(lengths.estimate[k]))


def test_a_move_is_told_with_its_sigma_and_whether_it_is_chance():
    move = Move("a<b", np.zeros(3), np.array([0, 3e-3, 4e-3]), 1e-3)
    assert move.sure and move.text == "a<b: 5.00 ± 1.00 mm"
    assert not replace(move, sigma_m=3e-3).sure and not replace(move, sigma_m=np.nan).sure
    assert replace(move, sigma_m=np.nan).text == "a<b: 5.00 mm"
    assert "a&lt;b" in panels.moves([move]) and "No link" in panels.moves([])


def test_every_parameter_is_listed_with_its_sigma(run):
    html = parameters(run)
    cells = re.findall(r"<td[^>]*>(.*?)</td>", html.partition("<b>lidar</b> in mount, from CAD")[2])
    i = run.solution.names.index("lidar.rx")
    sigma_rad = np.sqrt(run.solution.covariance[i, i])
    assert cells[0] == "rx" and cells[1].endswith(f"± {1e3 * sigma_rad:.2f} mrad")
    assert "<b>faro</b> in opti, no CAD" in html and "128 values" in html


# ------------------------------------------------------------ what is expected of a set of effects


@pytest.fixture(scope="module")
def lacking(once) -> Run:
    """A run whose model lacks what was hidden in its recording."""
    return Run.open(once(hidden) / "run")


@pytest.mark.slow
@pytest.mark.parametrize(
    "added, dropped",
    [
        ([], []),
        (["incidence_angle_bias"], []),
        (["faro_scale", "range_scale"], []),
        (["incidence_angle_bias"], ["ring_range_offset"]),
    ],
)
def test_one_step_tells_what_a_fit_finds(lacking, added, dropped):
    """Of stops held out, within a tenth; the run's own error is far from all but the first."""
    sources = reopened(lacking)
    model = changed(lacking, Change(lacking.folder, added, dropped))
    how = sources, model, "location", 1, lambda *told: None, start_of(lacking, sources)
    fitted_mm = held_out(*how).rms_mm
    assert held_out(*how, fit=stepped).rms_mm == pytest.approx(fitted_mm, rel=0.1)
    before = lacking.summary["rms_mm"]["held_out"]
    assert (abs(fitted_mm / before - 1) > 0.2) is bool(added or dropped)


@pytest.mark.slow
def test_of_several_questions_the_last_is_answered(lacking):
    """And one that has no answer does not keep others from theirs."""
    heard: queue.Queue = queue.Queue()
    asked = [Change(lacking.folder, [name]) for name in ("no_such", "faro_scale", "range_scale")]
    expected = Expected({}, lambda *told: heard.put(told))
    try:
        for change in asked:
            expected.ask(lacking.folder, change)
        found = [heard.get(timeout=SOON_MS / 1e3)]
        while found[-1][0][1] != asked[-1]:
            found.append(heard.get(timeout=SOON_MS / 1e3))
        assert found[-1][1] > 1.0 and asked[1] not in [question for (_, question), _ in found]
        assert all(mm is None for (_, question), mm in found if question == asked[0])
    finally:
        expected.stop()
    assert not expected._process.is_alive()
    expected.ask(lacking.folder, asked[1])
    assert heard.empty()


# --------------------------------------------------------------------------------- taken away


def test_a_plot_is_taken_away_with_its_units_and_says_what_is_lit(tmp_path):
    columns = {"range_m": np.array([1.0, 2.0, np.nan]), "residual_m": np.array([1e-3, 0, -2e-3])}
    points = cloud(**columns, ring=np.arange(3), **{"=nan()": np.arange(3.0)})
    points.columns["weight"][1] = 0
    (tmp_path / "a.csv").write_bytes(
        beams_csv(
            points,
            np.array([0, 1, 2]),
            ["range_m", "residual_m", "=nan()", "range_m"],
            np.array([True, True, False]),
        )
    )
    with open(tmp_path / "a.csv", newline="") as file:
        heading, *rows = csv.reader(file)
    assert heading == ["ring", "range, m", "residual, mm", "'=nan()", "inlier", "lit"]
    assert rows == [
        ["0", "1", "1", "0", "1", "1"],
        ["1", "2", "0", "1", "0", "1"],
        ["2", "", "-2", "2", "1", "0"],
    ]


def test_extrinsics_are_what_export_writes_and_the_same_bytes_again(run, tmp_path):
    packed = extrinsics_zip(run)
    assert packed == extrinsics_zip(run)
    wanted = {file.name: file.read_bytes() for file in export(run, tmp_path / "out").files}
    with zipfile.ZipFile(io.BytesIO(packed)) as archive:
        found = {Path(name).name: archive.read(name) for name in archive.namelist()}
        assert {Path(name).parent.as_posix() for name in archive.namelist()} == {"extrinsics"}
    assert found == wanted and "extrinsics.yaml" in found


@pytest.mark.long
def test_arrows_are_ticked_and_files_are_taken_away(run):
    with shown(run.folder) as (watched, page):
        arrows = page.client.scene.get_handle_by_name("/moves")
        assert not arrows.visible
        check(watched, "Moves x 100")
        watched.page.wait_for_url(re.compile("moves=1"))
        assert arrows.visible
        found = page.picture.stage.moves
        told = watched.page.locator("[data-is=moves] div")
        until(watched, told.all_inner_texts, [move.text for move in found])
        assert len(found) > 5
        drawn = page.client.scene.get_handle_by_name("/moves/0").points[0]
        assert np.linalg.norm(drawn[1] - drawn[0]) == pytest.approx(100 * found[0].length_m)
        watched.page.keyboard.press("n")
        watched.page.wait_for_url(re.compile("stop=L00P01"))
        assert page.client.scene.get_handle_by_name("/moves").visible
        write(watched, "Only where", "ring > 40")
        watched.page.wait_for_url(re.compile("only=ring"))
        with watched.page.expect_download() as plot_file:
            button(watched, "CSV").click()
        assert plot_file.value.suggested_filename == "run-residual_m-over-range_m.csv"
        table = np.genfromtxt(plot_file.value.path(), delimiter=",", skip_header=1)
        points = page.picture.stage.points  # of L00P01
        rows = points.columns["ring"] > 40
        np.testing.assert_allclose(table[:, 4], 1e3 * points.columns["residual_m"][rows], 1e-5)
        with watched.page.expect_download() as archive:
            button(watched, "Exports").click()
        assert zipfile.ZipFile(archive.value.path()).testzip() is None
        watched.page.reload()
        watched.page.locator("[data-is=moves]").wait_for()
