"""Clouds of every field's name: rings, columns, units and where beams start."""

import numpy as np
import pytest

from chains.errors import InputError
from sensors.lidar import load_lidar
from sensors.readers.base import Options
from sensors.readers.clouds.fields import Cloud
from sensors.readers.clouds.origin import fit_beam_origin
from sensors.readers.clouds.rings import find_format

from ..room import box_scan

VLP16 = load_lidar("velodyne_vlp16")
OS0 = load_lidar("ouster_os0_32")
POINTS, RING, COLUMN = box_scan(VLP16.elevation_rad, 180)


def cloud(points=POINTS, shape=None, **fields) -> Cloud:
    columns = {axis: points[:, k].astype(np.float32) for k, axis in enumerate("xyz")}
    return Cloud(columns | fields, shape)


@pytest.mark.parametrize(
    "name", ["ring", "Ring", "channel", "laser_id", "line", "scalar_ring", "row"]
)
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_ring_goes_by_any_name(name, dtype):
    given = cloud(**{name: RING.astype(dtype), "intensity": COLUMN, "reflectivity": RING})
    points = find_format("c", given, Options()).layout.points(given)
    np.testing.assert_array_equal(points["ring"], RING)
    np.testing.assert_array_equal(points["column"], COLUMN)
    np.testing.assert_array_equal(points["intensity"], COLUMN)
    np.testing.assert_array_equal(points["reflectivity"], RING)
    kinds = {name: values.dtype for name, values in points.items()}
    assert kinds["x"] == np.float32 and kinds["ring"] == kinds["column"] == np.uint16


def test_a_named_column_is_the_ring():
    given = cloud(strange=RING, ring=np.zeros(len(RING), int))
    points = find_format("c", given, Options(columns={"ring": "strange"})).layout.points(given)
    np.testing.assert_array_equal(points["ring"], RING)
    with pytest.raises(InputError, match="no field nothing"):
        find_format("c", given, Options(columns={"ring": "nothing"}))
    with pytest.raises(InputError, match="no whole numbers"):
        find_format("c", cloud(line=RING + 0.5), Options())


def test_rings_from_1_are_counted_from_0_and_that_is_said():
    given = cloud(ring=RING + 1)
    seen = find_format("c", given, Options())
    np.testing.assert_array_equal(seen.layout.points(given)["ring"], RING)
    assert any("count from 1 to 16" in line for line in seen.odd)
    told = find_format("c", given, Options(first_ring=0))
    np.testing.assert_array_equal(told.layout.points(given)["ring"], RING + 1)
    above = RING > 0  # the lowest ring sees nothing: still counted from 0
    given = cloud(POINTS[above], ring=RING[above])
    np.testing.assert_array_equal(
        find_format("c", given, Options()).layout.points(given)["ring"], RING[above]
    )
    with pytest.raises(InputError, match="--first-ring"):
        find_format("c", cloud(ring=RING), Options(first_ring=1))


def test_points_without_a_return_are_left_out():
    points = POINTS.copy()
    points[::3], points[1::3] = 0, np.nan
    given = cloud(points, ring=RING, intensity=COLUMN)
    kept = find_format("c", given, Options()).layout.points(given)
    np.testing.assert_array_equal(kept["ring"], RING[2::3])
    np.testing.assert_array_equal(kept["intensity"], COLUMN[2::3])
    with pytest.raises(InputError, match="no returns"):
        find_format("c", cloud(np.zeros_like(POINTS), ring=RING), Options())


def test_rows_of_one_elevation_are_rings():
    given = cloud(shape=(16, 180))
    points = find_format("c", given, Options()).layout.points(given)
    np.testing.assert_array_equal(points["ring"], RING)
    np.testing.assert_array_equal(points["column"], COLUMN)
    order = np.random.default_rng(1).permutation(len(POINTS))  # rows that mean nothing
    mixed = cloud(POINTS[order], shape=(16, 180))
    seen = find_format("c", mixed, Options(lidar="velodyne_vlp16"))
    np.testing.assert_array_equal(seen.layout.points(mixed)["ring"], RING[order])
    assert any("inferred from elevation" in line for line in seen.odd)


@pytest.mark.parametrize(
    "model",
    [
        *("hesai_pandar40p", "hesai_pandarqt64", "hesai_pandarxt32", "hesai_qt128", "hesai_xt16"),
        *("hesai_xt32m2x", "velodyne_vlp16"),
    ],
)
def test_rings_are_told_by_elevation(model):
    lidar = load_lidar(model)
    points, ring, _ = box_scan(lidar.elevation_rad, lidar.columns // 2)
    given = cloud(points)
    seen = find_format("c", given, Options())
    np.testing.assert_array_equal(seen.layout.points(given)["ring"], ring)
    assert seen.lidar["model"] == model


def test_two_models_with_one_set_of_elevations_are_told_by_azimuth_steps_or_asked_for():
    """A VLP-16 and an XT16 look at -15 to 15 degrees, and number their rings the other way round"""
    names = ("hesai_xt16", "velodyne_vlp16")
    for name in names:
        points, ring, _ = box_scan(VLP16.elevation_rad, load_lidar(name).columns)
        seen = find_format("c", cloud(points), Options())
        assert seen.lidar["model"] == name
        downwards = name == "hesai_xt16"
        expected = 15 - ring if downwards else ring
        np.testing.assert_array_equal(seen.layout.points(cloud(points))["ring"], expected)
        (line,) = [line for line in seen.odd if "inferred from elevation" in line]
        assert all(other in line for other in names)
    points, ring, _ = box_scan(VLP16.elevation_rad, 1200)
    with pytest.raises(InputError, match=r"hesai_xt16 and of velodyne_vlp16.*1200 .*--lidar"):
        find_format("c", cloud(points), Options())
    seen = find_format("c", cloud(points), Options(lidar="velodyne_vlp16"))
    np.testing.assert_array_equal(seen.layout.points(cloud(points))["ring"], ring)


def test_a_ring_of_a_few_points_is_no_other_ring():
    """Too few to be a group, and told by their model's elevation all the same."""
    lidar = load_lidar("hesai_pandarqt64")
    points, ring, column = box_scan(lidar.elevation_rad, lidar.columns)
    kept = (ring != 20) | (column % 400 == 0)
    given = cloud(points[kept])
    seen = find_format("c", given, Options())
    np.testing.assert_array_equal(seen.layout.points(given)["ring"], ring[kept])


def test_rings_are_told_by_elevation_where_beams_start_aside():
    """Seen from the axis an Ouster's rings blur in a small room, and from its beams they do not."""
    points, ring, _ = box_scan(OS0.elevation_rad, 128, OS0.beam_origin_m[0])
    given = cloud(points)
    seen = find_format("c", given, Options())
    np.testing.assert_array_equal(seen.layout.points(given)["ring"], ring)


@pytest.mark.parametrize("downwards", [False, True])
@pytest.mark.parametrize("forwards", [False, True])
def test_rings_are_told_by_the_order_of_the_points(downwards, forwards):
    """As KITTI has them: one turn after another, no cones for the car moves, some points lost."""
    sway = 0.1 * np.sin(3 * np.arctan2(POINTS[:, 1], POINTS[:, 0]))
    points, ring = POINTS + np.c_[np.zeros((len(RING), 2)), sway], RING
    half = np.pi / 180  # a step's half, so that no point lies just where turns begin
    c, s = np.cos(half), np.sin(half)
    points = points @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    start = 90 * forwards  # turns begin before the LiDAR, or behind it
    order = (np.arange(len(RING)) + start) % 180 + RING * 180
    lost = np.random.default_rng(7).random(len(order)) < 0.1
    order = order[~lost]
    if downwards:
        order = order[np.argsort(-RING[order], kind="stable")]
    given = cloud(points[order])
    seen = find_format("c", given, Options())
    np.testing.assert_array_equal(seen.layout.points(given)["ring"], ring[order])
    assert any("order of the points" in line for line in seen.odd)
    fewer = cloud(points[order][RING[order] > 3])
    with pytest.raises(InputError, match="12 turns of azimuth"):
        seen.layout.points(fewer)


def test_rings_that_are_not_clear_are_refused():
    rng = np.random.default_rng(0)
    with pytest.raises(InputError, match=r"no field for the ring .*--column ring=FIELD"):
        find_format("c", cloud(rng.normal(size=(5000, 3))), Options())
    blurred = rng.permutation(POINTS + rng.normal(size=POINTS.shape) * 0.05)
    with pytest.raises(InputError, match="clear groups"):
        find_format("c", cloud(blurred), Options())


def test_millimetres_are_refused_until_they_are_told():
    given = cloud(POINTS * 1000, ring=RING)
    with pytest.raises(InputError, match="--length-unit mm"):
        find_format("c", given, Options())
    points = find_format("c", given, Options(length_unit="mm")).layout.points(given)
    np.testing.assert_allclose(points["x"], POINTS[:, 0], rtol=1e-6)


@pytest.mark.parametrize("radial_m", [0.0, 0.027])
@pytest.mark.parametrize("height_m", [0.0, 0.036])
def test_where_beams_start_is_found(radial_m, height_m):
    rng = np.random.default_rng(3)
    elevation = np.radians(np.linspace(-40, 40, 32))
    points, ring, _ = box_scan(elevation, 256, radial_m)
    out = points * [1, 1, 0] * (radial_m / np.linalg.norm(points[:, :2], axis=1))[:, None]
    reach = points - out
    reach *= 1 + rng.normal(size=(len(reach), 1)) * 0.01 / np.linalg.norm(reach, axis=1)[:, None]
    found = fit_beam_origin(out + reach + [0, 0, height_m], ring)
    assert found.radial_m == pytest.approx(radial_m, abs=max(4 * found.sigma_radial_m, 1e-5))
    assert found.height_m == pytest.approx(height_m, abs=max(4 * found.sigma_height_m, 1e-5))
    assert found.sigma_radial_m < 0.001


def test_lasers_at_heights_of_their_own_tell_no_origin():
    heights = np.random.default_rng(4).normal(size=16) * 0.02
    assert fit_beam_origin(POINTS + np.c_[np.zeros((len(RING), 2)), heights[RING]], RING) is None


def test_a_correction_left_off_is_said():
    points, ring, _ = box_scan(OS0.elevation_rad, 256)  # as if every beam started in the axis
    seen = find_format("c", cloud(points, ring=ring), Options(lidar="ouster_os0_32"))
    assert any("left its correction off" in line for line in seen.odd)
    assert seen.lidar["beam_origin_m"] == [0.0, 0.0]
    points, ring, _ = box_scan(OS0.elevation_rad, 256, OS0.beam_origin_m[0])
    seen = find_format("c", cloud(points, ring=ring), Options(lidar="ouster_os0_32"))
    assert not any("left its correction off" in line for line in seen.odd)
    assert seen.lidar["beam_origin_m"][0] == pytest.approx(OS0.beam_origin_m[0], abs=2e-5)


def test_points_in_the_frame_of_the_housing_are_moved_to_the_centre():
    points, ring, _ = box_scan(OS0.elevation_rad, 256, OS0.beam_origin_m[0])
    given = cloud(points + np.array([0, 0, 0.03618]), ring=ring)
    seen = find_format("c", given, Options())
    assert any("36.2 mm above the origin" in line for line in seen.odd)
    np.testing.assert_allclose(seen.layout.points(given)["z"], points[:, 2], atol=1e-5)


@pytest.mark.parametrize(("unit", "scale"), [("s", 1), ("us", 1e6), ("ns", 1e9)])
def test_the_middle_of_a_turn_is_in_seconds(unit, scale):
    offset = COLUMN / 180 * 0.1
    seen = find_format("c", cloud(ring=RING, t=(offset * scale)), Options())
    assert seen.middle_s == pytest.approx(0.05, abs=1e-3)
    absolute = cloud(ring=RING, timestamp=(1.7e9 + offset))
    absolute = Cloud(absolute.fields, None, stamp_s=1.7e9)
    assert find_format("c", absolute, Options()).middle_s == pytest.approx(0.05, abs=1e-3)


def test_axes_that_turn_the_wrong_way_are_said():
    offset = COLUMN / 180 * 0.1
    assert not any(
        "right-handed" in o for o in find_format("c", cloud(ring=RING, t=offset), Options()).odd
    )
    mirrored = cloud(POINTS * [1, -1, 1], ring=RING, t=offset)
    assert any("right-handed" in o for o in find_format("c", mirrored, Options()).odd)


def test_a_model_that_several_could_be_is_asked_for():
    strange = np.radians(np.linspace(-7, 31, 16))
    points, ring, _ = box_scan(strange, 180)
    seen = find_format("c", cloud(points, ring=ring), Options())
    assert "model" not in seen.lidar and any("--lidar" in line for line in seen.odd)
    assert find_format("c", cloud(points, ring=ring), Options(lidar="velodyne_vlp16")).lidar[
        "model"
    ]
