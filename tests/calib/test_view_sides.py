"""Runs compared in the workbench: residuals held out and as in CAD, two rooms, sizes, areas."""

import io
import re
import xml.etree.ElementTree as ET
import zipfile
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.runs.add import add
from calib.runs.calibrate import calibrate
from calib.runs.run import RESIDUALS, Run
from calib.simulation import simulate
from calib.view.scene import Points, Scene
from calib.view.shown import colours, plot, sizes
from calib.view.shown.area import Area
from calib.view.shown.columns import AS_IN_CAD, gathered
from calib.view.shown.taken import run_zip
from sensors.recording import read_table
from tests.browser import Watched
from tests.calib.simulated import EXACT
from tests.calib.viewed import hidden
from tests.calib.workbench import (
    FIT_MS,
    button,
    check,
    choose,
    drag,
    shown,
    until,
    value,
    write,
)


def pair(folder: Path) -> None:
    """A run whose model lacks what was hidden in its recording, and one that has it."""
    hidden(folder)
    add(Run.open(folder / "run"), ["incidence_angle_bias"], folder / "better")


@pytest.fixture(scope="module")
def run(once) -> Run:
    return Run.open(once(hidden) / "run")


@pytest.fixture(scope="module")
def runs(once) -> Path:
    """Where two runs of one recording are."""
    return once(pair)


def by_beam(path: Path) -> dict[tuple[int, int], float]:
    """Residuals in a table, by ring and column, m."""
    table = read_table(path)
    rings, columns = table["ring"].tolist(), table["column"].tolist()
    return dict(zip(zip(rings, columns, strict=True), table["residual_m"], strict=True))


def cloud(**columns: np.ndarray) -> Points:
    count = len(next(iter(columns.values())))
    return Points(np.zeros((count, 3)), np.zeros(3), {"weight": np.ones(count)} | columns, count)


# ----------------------------------------------------------------------------------------- columns


def test_beams_have_their_residual_as_a_fit_without_their_stop_left_it(run):
    """Of stops that were held out; of others there is none, and their columns are not offered."""
    scene = Scene.of(run)
    stops = {path.stem for path in (run.folder / RESIDUALS / "_held_out").iterdir()}
    assert 0 < len(stops) < len(scene.stops(0))
    stop = min(stops)
    columns = gathered(scene, 0, [stop]).columns
    wanted = by_beam(run.folder / RESIDUALS / "_held_out" / f"{stop}.parquet")
    beams = zip(columns["ring"].tolist(), columns["column"].tolist(), strict=True)
    known = np.array([wanted.get(beam, np.nan) for beam in beams])
    np.testing.assert_array_equal(columns["held_out_m"], known)
    assert np.isfinite(known).mean() > 0.9
    np.testing.assert_allclose(
        columns["held_out_less_fitted_m"], known - columns["residual_m"], atol=1e-9
    )
    rest = gathered(scene, 0, [next(s for s in scene.stops(0) if s not in stops)])
    assert not {"held_out_m", "held_out_less_fitted_m"} & set(colours.choices(rest))
    for name in ("held_out_m", "other_held_out_m", "held_out_difference_m"):
        assert colours.scale_key(name) == "residual_m"


def test_of_a_rig_that_is_as_in_cad_nothing_is_left_before_the_fit(tmp_path, run):
    """Beams and poses without an error measure what CAD says; of the other rig they do not."""
    simulate(EXACT, tmp_path / "rec", 3, {})
    calibrate([tmp_path / "rec"], tmp_path / "run", hold_out="none")
    found = []
    for each in (Run.open(tmp_path / "run"), run):
        scene = Scene.of(each)
        points = gathered(scene, 0, scene.stops(0)[:2], AS_IN_CAD)
        off = points.columns["residual_m"] - points.columns["other_m"]
        np.testing.assert_allclose(points.columns["difference_m"], off, atol=1e-9)
        found.append(np.nanmedian(np.abs(points.columns["other_m"])))
    assert found[0] < 1e-3 < found[1]


# ------------------------------------------------------------------------------------------- sizes


def test_sizes_go_in_even_steps_from_end_to_end_and_signed_ones_from_zero():
    points = cloud(range_m=np.array([0.9, 1.0, 1.9, 2.0, 4.9, 5.0, 9.0, np.nan]))
    assert list(sizes.steps(points, "range_m", (1.0, 5.0))) == [0, 0, 0, 1, 3, 3, 3, 0]
    points = cloud(residual_m=np.array([-5e-3, -1.3e-3, 0.0, 1e-3, 3e-3]))
    assert list(sizes.steps(points, "residual_m", (-5.0, 5.0))) == [3, 1, 0, 0, 2]
    of, steps = sizes.key("residual_m", (-5.0, 5.0))
    assert of == "absolute residual, mm" and steps[0] == "0 to 1.25" and steps[-1] == "3.75 to 5"


def test_every_dot_of_a_plot_is_drawn_once_in_its_size():
    rng = np.random.default_rng(2)
    points = cloud(range_m=rng.uniform(0, 8, 300), residual_m=rng.normal(0, 1e-3, 300))
    steps = sizes.steps(points, "range_m", (0.0, 8.0))
    rgb = np.full((300, 3), 90, np.uint8)
    rgb[::2] = 200
    beside = {"steps": steps}
    (x, *dots, _), series = plot.chart(
        points, np.arange(300), "residual_m", "range_m", rgb, **beside
    )
    assert (np.isfinite(dots).sum(axis=0) == 1).all() and len(dots) == 2 * len(sizes.FACTORS)
    for drawn, about in zip(dots, series[1:], strict=False):
        factor = about["points"]["size"] / plot.DOT
        step = np.minimum(x[np.isfinite(drawn)] / 2, 3).astype(int)
        assert {sizes.FACTORS[each] for each in step} == {factor}


# ------------------------------------------------------------------------------------------- areas


def test_an_area_holds_what_a_camera_shows_between_two_corners():
    """Against a projection by scipy's rotations; what lies behind the camera is not in it."""
    rng = np.random.default_rng(3)
    eye, turn = np.array([1.0, -2.0, 0.5]), Rotation.random(random_state=4)
    xyz = eye + rng.normal(0, 3, (4000, 3))
    x, y, ahead = turn.inv().apply(xyz - eye).T
    aspect, fov = 0.7, 0.9
    u = 0.5 + x / ahead / (2 * np.tan(fov / 2) * aspect)
    v = 0.5 + y / ahead / (2 * np.tan(fov / 2))
    wanted = (ahead > 0) & (u > 0.2) & (u < 0.6) & (v > 0.1) & (v < 0.9)
    area = Area.drawn((eye, turn.as_quat(scalar_first=True)), fov, aspect, [(0.2, 0.1), (0.6, 0.9)])
    assert 50 < wanted.sum() < 2000
    np.testing.assert_array_equal(area.holds(xyz), wanted)
    np.testing.assert_array_equal(area.moved(np.ones(3)).holds(xyz + 1), wanted)
    again = Area.read(area.write())
    assert (again.holds(xyz) != wanted).mean() < 1e-3
    for text in ("", "1,2", area.write() + ",1", ",".join(["0"] * 11), "x" + area.write()):
        assert Area.read(text) is None


# ------------------------------------------------------------------------------------------- files


def test_a_runs_folder_is_packed_whole_and_the_same_bytes_again(run, tmp_path):
    packed = run_zip(run)
    assert packed == run_zip(run)
    with zipfile.ZipFile(io.BytesIO(packed)) as archive:
        archive.extractall(tmp_path)
    found, wanted = (
        {
            path.relative_to(folder): path.read_bytes()
            for path in folder.rglob("*")
            if path.is_file()
        }
        for folder in (tmp_path / "run", run.folder)
    )
    assert found == wanted and len(found) > 10


# ----------------------------------------------------------------------------------- in a browser


def taken(watched: Watched, name: str) -> tuple[str, bytes]:
    """Name and content of the file that a button gives."""
    with watched.page.expect_download(timeout=FIT_MS) as file:
        button(watched, name).click()
    return file.value.suggested_filename, Path(file.value.path()).read_bytes()


def lit(watched: Watched) -> list[int]:
    """How many beams are told to be lit, in each plot."""
    texts = watched.page.locator("[data-is=lit]").all_inner_texts()
    return [int(text.split()[0].replace(",", "")) for text in texts]


@pytest.mark.long
def test_two_runs_stand_side_by_side(runs):
    """In two rooms and two plots, on one scale, through a link and back to one room."""
    with shown(runs / "better", runs / "run") as (watched, page):
        tab, sides = watched.page, page.picture._sides
        choose(watched, "Other run", "better")
        check(watched, "Side by side")
        tab.wait_for_url(re.compile("beside="))
        names = tab.locator("[data-is=side]")
        until(watched, names.all_inner_texts, ["run", "better"])
        first, second = sides.first, sides.second
        there = by_beam(runs / "better" / RESIDUALS / "L00P00.parquet")
        columns = second.points.columns
        beams = zip(columns["ring"].tolist(), columns["column"].tolist(), strict=True)
        np.testing.assert_array_equal(columns["residual_m"], [there[beam] for beam in beams])
        until(watched, tab.locator(".u-over:visible").count, 2)
        charts = [each[1] for each in page.picture.panel._plots]
        assert charts[0].scales == charts[1].scales
        assert first.scale.high == second.scale.high == charts[0].scales["y"]["range"][1]
        cloud = page.client.scene.get_handle_by_name("/beside/points")
        assert len(cloud.points) == len(second.stage.shown) > 100
        # One camera sees both rooms, and neither hides the other.
        shift = np.array(sides.shift_m)
        camera = page.client.camera
        R = Rotation.from_quat(camera.wxyz, scalar_first=True).as_matrix()
        assert abs(R[:, 2] @ shift) < 0.05 * np.linalg.norm(shift)
        tab.keyboard.press("n")
        tab.wait_for_url(re.compile("stop=L00P01"))
        next_one = by_beam(runs / "better" / RESIDUALS / "L00P01.parquet")
        assert len(second.points.xyz_m) == len(next_one)
        gone = runs / "better" / RESIDUALS / "L01P00.parquet"
        gone.rename(gone.with_suffix(".gone"))
        choose(watched, "Stop", "L01P00")  # the first is shown all the same
        tab.get_by_text("the run is incomplete").wait_for()
        assert second.points is None and len(first.points.xyz_m) > 100
        gone.with_suffix(".gone").rename(gone)
        choose(watched, "Stop", "L00P01")
        tab.wait_for_url(re.compile("stop=L00P01"))
        tab.get_by_text("the run is incomplete").wait_for(state="hidden")
        link = tab.url
        tab.goto("about:blank")
        tab.goto(link)
        until(watched, names.all_inner_texts, ["run", "better"])
        tab.wait_for_url(re.compile(re.escape(re.search("beside=[^&]+", link)[0])))
        check(watched, "Side by side", False)
        tab.wait_for_url(lambda url: "beside=" not in url)
        names.first.wait_for(state="hidden")
        until(watched, tab.locator(".u-over:visible").count, 1)


@pytest.mark.long
def test_an_area_of_the_room_lights_its_beams_in_the_plots(runs):
    """How many they are and how far off is told; the same part of the room at the next stop."""
    with shown(runs / "better", runs / "run") as (watched, page):
        tab, sides = watched.page, page.picture._sides
        choose(watched, "Over", "ring")
        write(watched, "Light up", "10 to 20")
        until(watched, lambda: len(lit(watched)), 1)
        box = tab.locator("canvas").first.bounding_box()
        corners = [(0.3, 0.45), (0.62, 0.8)]
        at = [(box["x"] + u * box["width"], box["y"] + v * box["height"]) for u, v in corners]
        tab.keyboard.down("Shift")
        drag(watched, *at)
        tab.keyboard.up("Shift")
        tab.wait_for_url(re.compile("area="))
        assert value(watched, "Light up") == ""  # one or the other
        camera, points = page.client.camera, sides.first.points
        R = Rotation.from_quat(camera.wxyz, scalar_first=True)
        x, y, ahead = R.inv().apply(points.xyz_m - sides.first.stage._middle_m - camera.position).T
        high = 2 * np.tan(camera.fov / 2) * ahead
        u, v = 0.5 + x / high / (box["width"] / box["height"]), 0.5 + y / high
        wanted = (ahead > 0) & (u > 0.3) & (u < 0.62) & (v > 0.45) & (v < 0.8)
        assert 20 < wanted.sum() < len(wanted) - 20
        (found,) = lit(watched)
        assert found == pytest.approx(wanted.sum(), abs=0.02 * len(wanted) + 2)
        series = page.picture.panel.plot.series
        assert any(each.get("points", {}).get("fill") == plot.FAINT for each in series)
        assert page.client.scene.get_handle_by_name("/lit") is not None
        tab.keyboard.press("n")
        tab.wait_for_url(re.compile("stop=L00P01.*area="))
        choose(watched, "Other run", "better")
        check(watched, "Side by side")
        until(watched, lambda: len(lit(watched)), 2)
        both = lit(watched)
        assert both[0] == pytest.approx(both[1], rel=0.1, abs=3)
        button(watched, "Light up all").click()
        until(watched, lambda: lit(watched), [])
        tab.wait_for_url(lambda url: "area=" not in url)
        button(watched, "Light up all").wait_for(state="hidden")


@pytest.mark.long
def test_sizes_are_chosen_and_all_is_taken_away(runs):
    """Plots as figures, the report, and the run's folder."""
    with shown(runs / "better", runs / "run") as (watched, page):
        tab, scene = watched.page, page.client.scene
        assert scene.get_handle_by_name("/points3") is None
        choose(watched, "Colour", "label")
        choose(watched, "Dot size", "residual held out, mm")
        tab.wait_for_url(re.compile("size=held_out_m"))
        until(watched, tab.locator("[data-is=sizes]").is_visible)
        clouds = [scene.get_handle_by_name(f"/points{i}") for i in range(len(sizes.FACTORS))]
        large = [cloud.point_size for cloud in clouds if cloud is not None]
        assert len(large) > 2 and large == sorted(large) and len(set(large)) == len(large)
        assert scene.get_handle_by_name("/points") is None
        count = len(page.picture._sides.first.points.xyz_m)
        name, content = taken(watched, "SVG")
        assert name == "run-residual_m-over-range_m.svg"
        root = ET.fromstring(content)
        assert root.tag.endswith("svg")
        assert len(root.findall(".//{http://www.w3.org/2000/svg}use")) > count
        name, content = taken(watched, "PNG")
        assert name.endswith(".png") and content.startswith(b"\x89PNG")
        name, content = taken(watched, "Run folder")
        assert name == "run.zip"
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            assert archive.read("run/summary.json") == (runs / "run/summary.json").read_bytes()
        name, content = taken(watched, "Report")
        assert name == "run.html" and b"<html" in content[:500] and b"held out" in content
        until(watched, button(watched, "Refit").is_enabled)
        choose(watched, "Dot size", "—")
        tab.wait_for_url(lambda url: "size=" not in url)
        assert scene.get_handle_by_name("/points") is not None
        assert scene.get_handle_by_name("/points1") is None
