"""The workbench in a real browser: an effect found, added, undone; points clicked; bad input."""

from __future__ import annotations

import re
import shutil
import time

import numpy as np
import pytest

from calib.runs.diagnose import diagnose
from calib.runs.run import Run
from calib.view.page import Page
from calib.view.stage import PANEL_PX, PLOT_PX
from tests.browser import Watched
from tests.calib.viewed import blunder, diagnosed, small_run
from tests.calib.viewed import hidden as hidden_run
from tests.calib.workbench import (
    FIT_MS,
    SOON_MS,
    bars,
    button,
    check,
    choose,
    shown,
    tick,
    until,
)

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def small(once) -> Run:
    run = Run.open(once(small_run) / "run")
    diagnosed(run.folder)
    return run


@pytest.fixture
def copied(small, tmp_path) -> Run:
    return Run.open(shutil.copytree(small.folder, tmp_path / "run"))


@pytest.fixture(scope="module")
def hidden(once) -> Run:
    """A run whose model lacks what was hidden in its recording."""
    run = Run.open(once(hidden_run) / "run")
    diagnose(run)
    return run


@pytest.mark.long
def test_the_first_finding_is_added_and_the_ladder_falls(hidden):
    with shown(hidden.folder) as (watched, page):
        first = watched.page.locator("[data-is=findings] tr").nth(1).inner_text()
        assert first.startswith("incidence_angle_bias")
        before = bars(watched)
        assert before == [pytest.approx(hidden.summary["rms_mm"]["held_out"], abs=1e-3)]
        tick(watched, "incidence_angle_bias")
        fall = next(c for c in hidden.diagnosis()["candidates"] if c["step"])["held_out_rms_mm"]
        watched.page.get_by_text("{before:.2f} → {after:.2f} mm".format(**fall)).last.wait_for()
        button(watched, "Refit").click()
        button(watched, "Cancel").wait_for()
        until(watched, button(watched, "Refit").is_disabled)
        watched.page.locator("[data-is=ladder] [data-mm]").nth(1).wait_for(timeout=FIT_MS)
        after = bars(watched)
        assert after == pytest.approx(list(fall.values()), abs=0.01)
        assert after[0] == before[0] and after[-1] < before[0] / 2
        made = Run.open(f"{hidden.folder}+incidence_angle_bias")
        assert made.summary["rms_mm"]["held_out"] == pytest.approx(after[-1], abs=1e-3)
        button(watched, "Cancel").wait_for(state="hidden", timeout=FIT_MS)
        told = watched.page.locator("[data-is=verdict]")
        until(watched, told.inner_text, "Verdict: the model is adequate")
        assert (made.folder / "diagnosis.json").is_file()
        button(watched, "Undo").click()
        watched.page.get_by_text("stays on disk").wait_for()
        until(watched, lambda: bars(watched), before)
        assert made.folder.is_dir()
        # What was fitted once is known from then on, and what is taken away can be anything.
        tick(watched, "incidence_angle_bias")
        expected = watched.page.locator("[data-is=expected]")
        expected.get_by_text(f"as {made.folder.name}").wait_for()
        tick(watched, "ring_range_offset", False)
        expected.get_by_text("by one step of the linearised fit").wait_for()
        wanted = float(re.search(r"→ ([\d.]+) mm", expected.inner_text())[1])
        button(watched, "Refit").click()
        watched.page.get_by_text("+ incidence_angle_bias, - ring_range_offset").wait_for(
            timeout=FIT_MS
        )
        assert page.desk.run.summary["rms_mm"]["held_out"] == pytest.approx(wanted, rel=0.1)
        assert page.desk.run.effects == (*hidden.effects[:2], "incidence_angle_bias")


@pytest.mark.long
def test_a_blunder_is_left_out_by_a_click_and_undone(copied):
    """The button of one leaves out that one; what is left out is shown, and Undo goes back."""
    tokens = ["L00P01:base_markers", "L01P01:base_markers"]
    diagnosed(copied.folder, blunders=[blunder(token) for token in tokens])
    with shown(copied.folder) as (watched, page):
        for name in (*(f"Leave out {token}" for token in tokens), "Leave all out"):
            button(watched, name).wait_for()
        until(watched, watched.page.locator("[data-is=blunders] li").count, 2)
        button(watched, f"Leave out {tokens[1]}").click()
        watched.page.get_by_text(f"Left out: {tokens[1]}").first.wait_for(timeout=FIT_MS)
        made = page.desk.run
        assert made.left_out == tokens[1:]
        assert made.grown_from == copied.folder.resolve()
        watched.page.locator("[data-is=verdict]").wait_for(timeout=FIT_MS)
        until(watched, button(watched, "Leave all out").is_hidden)
        button(watched, "Undo").click()
        watched.page.get_by_text("stays on disk").wait_for()
        button(watched, "Leave all out").wait_for()
        assert page.desk.run.folder == copied.folder
        until(watched, watched.page.get_by_text("Left out:").first.is_hidden)


def on_screen(watched: Watched, page: Page) -> np.ndarray:
    """Where the points (N, 2) are drawn that the stage shows, by the camera as the page tells it,
    px."""
    camera = page.client.camera
    box = watched.page.locator("canvas").first.bounding_box()
    ahead = camera.look_at - camera.position
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, [0, 0, 1])
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(right, ahead), ahead])
    from_eye = (
        page.picture.stage.points.xyz_m[page.picture.stage.shown]
        - page.picture.stage._middle_m
        - camera.position
    )
    x, y, depth = axes @ from_eye.T
    focal = box["height"] / 2 / np.tan(camera.fov / 2)
    middle = [box["x"] + box["width"] / 2, box["y"] + box["height"] / 2]
    return middle + focal * np.stack([x / depth, -y / depth], axis=1)


@pytest.mark.long
def test_a_click_reads_the_point_that_it_meets(small):
    """Once the browser has turned its camera to where it was told to."""
    with shown(small.folder) as (watched, page):
        columns, told = page.picture.stage.points.columns, watched.page.locator("[data-is=point]")

        def clicked() -> tuple[dict[str, str], int | None, float]:
            """What is told after a click on a point, of which, and how many px off that is."""
            at = on_screen(watched, page)
            x, y = at.T
            inside = (x > PLOT_PX + 20) & (x < 1400 - PANEL_PX - 20) & (y > 200) & (y < 880)
            for wanted in np.flatnonzero(inside)[:1]:
                watched.page.mouse.click(*at[wanted])
                watched.page.wait_for_timeout(100)
                cells = told.locator("td").all_inner_texts() if told.is_visible() else []
                rows = dict(zip(cells[::2], cells[1::2], strict=True))
                if rows:
                    ring, column = map(int, rows["ring, column"].split(", "))
                    same = (columns["ring"] == ring) & (columns["column"] == column)
                    (found,) = np.flatnonzero(same[page.picture.stage.shown])
                    off = np.linalg.norm(at[found] - at[wanted])
                    return rows, page.picture.stage.shown[found], off
            return {}, None, np.inf

        end, off = time.monotonic() + SOON_MS / 1e3, np.inf
        while off >= 12:
            assert time.monotonic() < end, f"{off:.0f} px off"
            rows, found, off = clicked()
        assert float(rows["range"].split()[0]) == pytest.approx(columns["range_m"][found], abs=1e-3)
        assert rows["residual"].startswith(f"{1e3 * columns['residual_m'][found]:+.2f}")
        assert {"incidence", "label", "intensity", "temperature", "humidity", "location"} <= set(
            rows
        )
        stop = page.picture.stage.scene.sources[0].recording
        here = stop.stops.index(page.picture.menu.stop.value)
        said = float(rows["temperature"].split()[0])
        assert said == pytest.approx(stop.covariates["temperature_c"][here], abs=0.01)
        assert page.picture.panel.plot.series[-2]["label"] == "clicked"  # in the plot too


@pytest.mark.long
def test_stops_and_colours_are_chosen(small):
    with shown(small.folder) as (watched, page):
        watched.page.get_by_text("mm, short").wait_for()
        assert page.picture.menu.stop.value == "L00P00"
        choose(watched, "Stop", "L01P01")
        choose(watched, "Colour", "incidence, deg")
        watched.page.get_by_text("mm, short").wait_for(state="hidden")
        assert page.picture.menu.stop.value == "L01P01"
        count = len(page.picture.stage.scene.points(0, "L01P01").inlier)
        watched.page.get_by_text(f"{count:,} beams,").wait_for()

        def legend() -> list[str]:
            return watched.page.get_by_text(re.compile(r"^[\d.]+ deg$")).all_inner_texts()

        until(watched, lambda: len(legend()), 3)
        kept, count = legend(), len(page.picture.stage.scene.points(0, "L00P00").inlier)
        watched.page.keyboard.press("n")
        watched.page.wait_for_url(re.compile("stop=L00P00&"))
        watched.page.get_by_text(f"{count:,} beams,").wait_for()
        assert legend() == kept
        check(watched, "Keep scales", False)
        watched.page.wait_for_url(re.compile("scales=free"))
        until(watched, lambda: legend() != kept)


@pytest.mark.parametrize("width", [1400, 700])
@pytest.mark.long
def test_the_page_fits_its_window(small, width):
    with shown(small.folder, width=width) as (watched, _):
        assert button(watched, "Refit").is_visible()
        wide = watched.page.evaluate("document.documentElement.scrollWidth")
        assert wide <= width
        for text in ("Run", "Stop", "Ladder", "Findings"):
            box = watched.page.get_by_text(text, exact=True).first.bounding_box()
            assert box["x"] >= 0 and box["x"] + box["width"] <= width


@pytest.mark.long
def test_a_recording_that_is_gone_is_said_on_the_page(small, tmp_path):
    shutil.copytree(small.folder, tmp_path / "run")
    text = (tmp_path / "run" / "model.yaml").read_text()
    gone = text.replace(str(small.recordings[0]), str(tmp_path / "gone"))
    (tmp_path / "run" / "model.yaml").write_text(gone)
    (tmp_path / "run" / "diagnosis.json").write_text("{}")
    with shown(tmp_path / "run") as (watched, page):
        watched.page.get_by_text("is no diagnosis of this version").wait_for()
        (tmp_path / "run" / "diagnosis.json").unlink()
        page.open()
        watched.page.get_by_text("is no longer there; put it back").wait_for()
        until(watched, lambda: len(bars(watched)), 1)  # the ladder stands all the same
        button(watched, "Diagnose").click()
        watched.page.get_by_text("is no longer there").wait_for()
        button(watched, "Refit").click(trial=True, timeout=FIT_MS)  # enabled again
