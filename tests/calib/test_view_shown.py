"""What the workbench shows of the beams: columns, other runs, filters, scales, and links to it."""

import re
import shutil

import numpy as np
import pytest

from calib.runs.run import Run
from calib.view.effects.own import document
from calib.view.scene import Points, Scene
from calib.view.shown import colours, look, plot
from calib.view.shown.columns import comparable, gathered, kept
from chains.errors import InputError
from sensors.documents import read_yaml, write_yaml
from sensors.recording import read_table, write_table
from tests.calib.viewed import diagnosed, hidden, small_run
from tests.calib.workbench import (
    FIT_MS,
    bars,
    button,
    check,
    choose,
    shown,
    until,
    write,
)

TABLES = "residuals.parquet"


@pytest.fixture(scope="module")
def run(once) -> Run:
    return Run.open(once(small_run) / "run")


@pytest.fixture(scope="module")
def other(run, tmp_path_factory) -> Run:
    """A run that grew from it, whose residuals at L00P00 are larger by 0.5 mm at odd rings; it has
    neither the first beam there nor the scan of L01P01."""
    folder = shutil.copytree(run.folder, tmp_path_factory.mktemp("other") / "other")
    model = read_yaml(folder / "model.yaml")[0]
    write_yaml(folder / "model.yaml", model | {"grown_from": str(run.folder.resolve())})
    table = read_table(folder / TABLES / "L00P00.parquet")
    changed = table | {"residual_m": table["residual_m"] + 5e-4 * (table["ring"] % 2)}
    order = np.random.default_rng(4).permutation(np.arange(1, len(table["ring"])))
    write_table(folder / TABLES / "L00P00.parquet", {n: c[order] for n, c in changed.items()})
    (folder / TABLES / "L01P01.parquet").unlink()
    diagnosed(folder)
    return Run.open(folder)


@pytest.fixture(scope="module")
def scene(run) -> Scene:
    return Scene.of(run)


# ----------------------------------------------------------------------------------------- columns


def test_beams_know_what_is_known_of_their_stop(scene):
    recording = scene.sources[0].recording
    points = gathered(scene, 0, scene.stops(0))
    assert (
        points.measured
        == len(points.xyz_m)
        == sum(len(scene.points(0, stop).xyz_m) for stop in scene.stops(0))
    )
    k = points.columns["stop"].astype(int) - 1
    np.testing.assert_array_equal(np.unique(k), np.arange(4))
    np.testing.assert_array_equal(
        points.columns["temperature_c"], recording.covariates["temperature_c"][k]
    )
    joint = recording.joint_names[1]
    np.testing.assert_array_equal(points.columns[joint], recording.joints[k, 1])
    np.testing.assert_array_equal(
        np.unique(recording.location)[points.columns["location"]], recording.location[k]
    )
    offered = colours.choices(points)
    assert {"temperature_c", "humidity", joint, "stop", "location"} <= set(offered)


def test_of_many_beams_some_of_every_stop_are_looked_at(scene):
    points = gathered(scene, 0, scene.stops(0), most=200)
    assert 100 <= len(points.xyz_m) <= 200 < points.measured
    assert set(points.columns["stop"]) == {1, 2, 3, 4}
    one = gathered(scene, 0, ["L00P00"], most=10)
    assert len(one.xyz_m) == one.measured > 10  # of one stop all, as each may be clicked


def test_residuals_of_another_run_are_those_of_the_same_beams(scene, other):
    points = gathered(scene, 0, ["L00P00"], other)
    there, difference = (points.columns[n] for n in ("other_m", "difference_m"))
    assert np.isnan(there[0]) and np.isfinite(there[1:]).all()
    wanted = -5e-4 * (points.columns["ring"] % 2)
    np.testing.assert_allclose(difference[1:], wanted[1:], atol=1e-8)
    lost = gathered(scene, 0, ["L01P01"], other)
    assert np.isnan(lost.columns["other_m"]).all()
    assert "other_m" not in colours.choices(lost)


def test_only_runs_of_the_same_recordings_are_compared(run, other, tmp_path):
    assert comparable(run, other)
    text = (other.folder / "model.yaml").read_text()
    copy = shutil.copytree(other.folder, tmp_path / "copy")
    (copy / "model.yaml").write_text(re.sub("sha256: .{8}", "sha256: 00000000", text))
    assert not comparable(run, Run.open(copy))


def cloud(**columns: np.ndarray) -> Points:
    count = len(next(iter(columns.values())))
    weight = {"weight": np.ones(count), "ring": np.arange(count)}
    return Points(np.zeros((count, 3)), np.zeros(3), weight | columns, count)


def test_a_filter_is_a_formula_in_metres_and_radians():
    range_m = np.array([1.0, 2.0, 3.0, np.nan])
    points = cloud(range_m=range_m, residual_m=np.array([-3e-3, 1e-3, 3e-3, 3e-3]))
    assert kept(points, "  ").all()
    assert list(kept(points, "range > 1.5")) == [False, True, True, False]
    assert list(kept(points, "(abs(residual) > 0.002) * (range_m < 2)")) == [True] + 3 * [False]
    assert list(kept(points, "ring - 1")) == [True, False, True, True]
    with pytest.raises(InputError, match="no column rang here; did you mean range"):
        kept(points, "rang > 1")
    with pytest.raises(InputError, match="is no function here"):
        kept(points, "__import__('os').system('x') > 1")


def test_all_residuals_have_one_scale():
    points = cloud(residual_m=np.array([-4e-3, 0, 4e-3]), other_m=np.array([-4e-2, 0, 4e-2]))
    assert colours.scale_key("other_m") == colours.scale_key("difference_m") == "residual_m"
    assert colours.scale_key("range_m") == "range_m"
    assert colours.limits(points, "residual_m") == (-5, 5)
    _, scale = colours.coloured(points, "other_m", {}, (-5.0, 5.0))
    assert (scale.low, scale.high) == (-5, 5)


# -------------------------------------------------------------------------------------------- plot


def test_a_plot_has_every_beam_once_in_its_colour_and_means_of_inliers():
    rng = np.random.default_rng(0)
    points = cloud(range_m=rng.uniform(0, 16, 500), residual_m=rng.normal(0, 1e-3, 500))
    points.columns["residual_m"][:20] = 1.0
    points.columns["weight"][:20] = 0
    rgb = np.array([[255, 0, 0], [0, 0, 255]], np.uint8)[
        (points.columns["range_m"] > 8).astype(int)
    ]
    rows = np.arange(0, 500, 2)
    (x, *dots, mean), series = plot.chart(points, rows, "residual_m", "range_m", rgb)
    assert len(series) == len(dots) + 2 and (np.diff(x) >= 0).all() and len(x) == len(rows)
    assert (np.isfinite(dots).sum(axis=0) == 1).all()
    for drawn, about in zip(dots, series[1:], strict=False):
        side = x[np.isfinite(drawn)] > 8
        assert side.all() if about["points"]["fill"] == "#0000ff" else not side.any()
    inlier = rows[points.columns["weight"][rows] > 0]
    bins = np.minimum(
        (points.columns["range_m"] - x[0]) / (x[-1] - x[0]) * plot.BINS, plot.BINS - 1
    ).astype(int)
    first = inlier[bins[inlier] == 0]
    assert mean[0] == pytest.approx(1e3 * points.columns["residual_m"][first].mean())
    assert plot.chart(points, rows[:0], "residual_m", "range_m", rgb) is plot.EMPTY


# ------------------------------------------------------------------------------------------- links


def test_an_address_says_what_it_was_made_of():
    asked = {"run": "a/b c&d=e?#%", "only": "(range > 1) * 2 + 1", "camera": "1.0,-2.000,3"}
    text = look.write(asked | {"other": "", "unknown": "x"})
    assert re.fullmatch(r"[\w.~%=&,:-]+", text)  # nothing that ends a path or a script
    assert look.read(text) == asked
    assert look.read("favicon.ico") == look.read("a=%ff&&=") == {}
    assert look.numbers("1,2", 2) == (1, 2)
    assert [look.numbers(t, 2) for t in ("1", "1,x", "1,nan", "1,inf")] == [None] * 4


# ------------------------------------------------------------------------- a formula of one's own


def test_a_formula_of_ones_own_becomes_an_effect_of_a_plausible_size():
    points = cloud(range_m=np.full(50, 4.0), residual_m=np.ones(50), humidity=np.full(50, 0.5))
    found = document(" humidity * range ", "range", points, ["own_humidity_range"])
    assert found["name"] == "own_humidity_range_2" and found["basis"] == ["humidity * range"]
    assert found["sigma"] * 2.0 == pytest.approx(0.01) and found["unit"] == "m"
    assert document("ring + 1", "azimuth", points, [])["unit"] == "rad"
    for text, why in (
        ("residual * 2", "a result of the fit"),
        ("difference_m", "a result of the fit"),
        ("0 * range", "is 0 at every beam"),
        ("1 / (range - 4)", "no number at some"),
        ("humid", "did you mean humidity"),
        ("  ", "write a formula first"),
    ):
        with pytest.raises(InputError, match=why):
            document(text, "range", points, [])


# ----------------------------------------------------------------------------------- in a browser


def near(one: str, other: str) -> bool:
    """Whether two addresses ask for the same, cameras to what a turning browser rounds."""
    looks = [look.read(url.rpartition("/")[2]) for url in (one, other)]
    cameras = [look.numbers(each.pop("camera"), 6) for each in looks]
    return looks[0] == looks[1] and np.allclose(*cameras, atol=0.01)


@pytest.mark.long
def test_keys_go_from_stop_to_stop_and_a_link_shows_the_same(run, other):
    with shown(other.folder, run.folder) as (watched, _):
        tab = watched.page
        choose(watched, "Other run", "other")
        tab.wait_for_url(re.compile("other=other"))
        tab.keyboard.press("p")
        tab.wait_for_url(re.compile("stop=L01P01&"))
        tab.keyboard.press("n")
        tab.wait_for_url(re.compile("stop=L00P00&"))
        choose(watched, "Stop", "L00P01")
        tab.keyboard.press("n")  # at once: a menu that was used does not keep the key
        tab.wait_for_url(re.compile("stop=L01P00&"))
        legend = tab.get_by_text("mm, short").inner_text()
        for label, option in (
            ("Colour", "difference to the other run, mm"),
            ("Beams of", "its location"),
            ("Plot", "incidence, deg"),
            ("Over", "temperature, °C"),
        ):
            choose(watched, label, option)
        check(watched, "Dark")
        write(watched, "Only where", "ring > 40")
        tab.wait_for_url(re.compile("only=ring.*over=temperature.*dark=1"))
        tables = (read_table(run.folder / TABLES / f"L01P0{i}.parquet") for i in range(2))
        count = sum(int((table["ring"] > 40).sum()) for table in tables)
        tab.locator("[data-is=plotted]", has_text=f"{count:,} beams").wait_for()
        tab.mouse.move(600, 300)
        before = tab.url
        tab.mouse.wheel(0, 300)
        tab.wait_for_url(lambda url: url.partition("camera")[2] != before.partition("camera")[2])
        link = tab.url
        tab.goto("about:blank")
        tab.goto(link)
        tab.locator("[data-is=plotted]", has_text=f"{count:,} beams").wait_for()
        for label, wanted in (
            ("Run", "run"),
            ("Other run", "other"),
            ("Stop", "L01P00"),
            ("Colour", "difference to the other run, mm"),
            ("Plot", "incidence, deg"),
            ("Over", "temperature, °C"),
            ("Beams of", "its location"),
        ):
            until(watched, tab.get_by_label(label, exact=True).input_value, wanted)
        shorter = legend.replace("short", "shorter")
        until(watched, tab.get_by_text("mm, shorter").inner_text, shorter)
        scheme = tab.locator("html")
        until(watched, lambda: scheme.get_attribute("data-mantine-color-scheme"), "dark")
        tab.wait_for_url(lambda url: near(url, link))
        tab.goto("about:blank")
        tab.goto(link.replace("stop=L01P00", "stop=gone"))
        tab.get_by_text("the address asks for stop 'gone', which is not here").wait_for()
        tab.wait_for_url(re.compile("stop=L00P00"))


@pytest.mark.long
def test_a_formula_of_ones_own_is_tried_and_stops_held_out_answer(once, tmp_path):
    """What was hidden is written as a formula; a wrong one is told beside its box."""
    folder = shutil.copytree(once(hidden) / "run", tmp_path / "run")
    with shown(folder) as (watched, page):
        write(watched, "Own formula", "abs(residual)")
        button(watched, "Try").click()
        watched.page.get_by_text("residual_m is a result of the fit").wait_for()
        assert not page.bench.busy
        write(watched, "Own formula", "1 / maximum(cos(incidence), 0.2) - 1")
        button(watched, "Try").click()
        watched.page.get_by_text(re.compile(r"Held-out error: \d")).wait_for(timeout=FIT_MS)
        page.bench.stop()
        until(watched, lambda: len(bars(watched)), 2)
        before, after = bars(watched)
        assert after < before / 2
        made = page.desk.run
        assert made.folder.parent == tmp_path and made.grown_from == folder.resolve()
        assert made.effects[-1] == "own_1_maximum_cos_incidence_0_2_1"
        assert made.summary["rms_mm"]["held_out"] == pytest.approx(after, abs=1e-3)
        button(watched, "Cancel").wait_for(state="hidden", timeout=FIT_MS)
