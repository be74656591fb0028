"""Planes: found from imperfectly placed scans, kept apart, and given their points."""

import numpy as np
import pytest

from sensors.planes import PlaneFinder, cell_moments

ROOM_M = np.array([6.0, 5.0, 2.8])
NOISE_M = 0.010


def room_walls(rng, count):
    """Points (6 count, 3) on the walls of a room with a corner at the origin, and their wall."""
    wall = np.repeat(np.arange(6), count)
    points_m = rng.uniform(size=(6 * count, 3)) * ROOM_M
    rows = np.arange(len(wall))
    points_m[rows, wall // 2] = np.where(wall % 2, ROOM_M[wall // 2], 0.0)
    return points_m, wall


def ball(rng, count, centre_m, radius_m):
    towards = rng.normal(size=(count, 3))
    return centre_m + radius_m * towards / np.linalg.norm(towards, axis=1, keepdims=True)


def seen_from(rng, station_m, points_m, pose_m=0.005, pose_rad=0.003):
    """The points as one stop places them: range noise, and the stop's own pose error."""
    beam = points_m - station_m
    beam /= np.linalg.norm(beam, axis=1, keepdims=True)
    noisy = points_m + NOISE_M * rng.normal(size=(len(beam), 1)) * beam
    turn, shift = pose_rad * rng.normal(size=3), pose_m * rng.normal(size=3)
    return noisy + np.cross(turn, noisy - station_m) + shift


STATIONS_M = np.array([[1.5, 1.2, 1.1], [4.2, 1.5, 1.4], [3.0, 3.8, 0.9]])
BALL_CENTRE_M, BALL_RADIUS_M = np.array([3.1, 2.4, 1.3]), 0.45


@pytest.fixture(scope="module")
def room():
    """Planes of a box room with a ball in it, and one more scan of it with the truth."""
    rng = np.random.default_rng(7)
    finder = PlaneFinder()
    for stop, station_m in enumerate(STATIONS_M):
        walls, _ = room_walls(rng, 8000)
        clutter = ball(rng, 3000, BALL_CENTRE_M, BALL_RADIUS_M)
        finder.add(stop, seen_from(rng, station_m, np.concatenate([walls, clutter])), station_m)
    walls, wall = room_walls(rng, 4000)
    clutter = ball(rng, 3000, BALL_CENTRE_M, BALL_RADIUS_M)
    test_scan = seen_from(rng, STATIONS_M[0], np.concatenate([walls, clutter]))
    return finder.planes(min_stops=3), test_scan, walls, wall


def true_wall(planes):
    """Index (M,) of the room's wall that each plane should be."""
    axis = np.abs(planes.normal).argmax(axis=1)
    return 2 * axis + (planes.distance_m > 0.5)


def test_six_walls_and_nothing_else_are_found(room):
    planes, *_ = room
    assert sorted(true_wall(planes)) == list(range(6))


def test_wall_normals_and_distances_are_right(room):
    planes, *_ = room
    wall = true_wall(planes)
    cosine = np.abs(planes.normal[np.arange(6), wall // 2])
    assert np.degrees(np.arccos(np.minimum(cosine, 1))).max() < 0.5
    truth_m = np.where(wall % 2, ROOM_M[wall // 2], 0.0)
    middle = np.where(np.eye(3)[wall // 2] > 0, truth_m[:, None], ROOM_M / 2)
    off_m = np.einsum("mi,mi->m", planes.normal, middle) - planes.distance_m
    assert np.abs(off_m).max() < 0.015
    assert np.allclose(np.linalg.norm(planes.normal, axis=1), 1)


def test_points_inside_a_wall_are_given_to_it(room):
    planes, scan, walls, wall = room
    margin_m = np.minimum(walls, ROOM_M - walls)
    margin_m[np.arange(len(wall)), wall // 2] = np.inf
    inside = margin_m.min(axis=1) > 0.3
    assigned = planes.assign(scan[: len(wall)])
    right = true_wall(planes)[assigned] == wall
    assert np.mean((right & (assigned >= 0))[inside]) > 0.95
    assert np.mean((~right & (assigned >= 0))[inside]) == 0
    assert np.mean(~right & (assigned >= 0)) < 0.02


def test_no_point_of_a_ball_is_given_to_a_plane(room):
    planes, scan, _, wall = room
    assert np.all(planes.assign(scan[len(wall) :]) == -1)


def flat_square(rng, count, corner_m, u_m, v_m):
    s, t = rng.uniform(size=(2, count, 1))
    return np.array(corner_m) + s * np.array(u_m) + t * np.array(v_m)


SENSOR_M = np.array([1.7, 2.3, 1.1])


def found_in(points_m, sensor_m=SENSOR_M, **settings):
    finder = PlaneFinder(**settings)
    finder.add(0, points_m, sensor_m)
    return finder.planes()


@pytest.mark.parametrize("gap_m", [0.10, 0.06])
def test_parallel_surfaces_stay_apart(gap_m):
    """A table top over a floor that is hidden beneath it."""
    rng = np.random.default_rng(1)
    floor = flat_square(rng, 20000, [0, 0, 0.1], [4, 0, 0], [0, 3, 0])
    hidden = (floor[:, 0] > 1) & (floor[:, 0] < 2.6) & (floor[:, 1] > 1) & (floor[:, 1] < 2.4)
    table = flat_square(rng, 6000, [1, 1, 0.1 + gap_m], [1.6, 0, 0], [0, 1.4, 0])
    points = np.concatenate([floor[~hidden], table])
    points[:, 2] += NOISE_M * rng.normal(size=len(points))
    planes = found_in(points)
    assert len(planes.count) == 2
    assert np.allclose(np.sort(planes.distance_m), [0.1, 0.1 + gap_m], atol=0.004)
    height = planes.distance_m[planes.assign(np.array([[1.8, 1.7, 0.1 + gap_m], [3.4, 0.5, 0.1]]))]
    assert np.allclose(height, [0.1 + gap_m, 0.1], atol=0.004)


@pytest.mark.parametrize("turn_deg", [15.0, 45.0, 90.0])
def test_a_corner_is_two_planes(turn_deg):
    rng = np.random.default_rng(2)
    turn = np.radians(turn_deg)
    first = flat_square(rng, 12000, [0, 0, 0], [3, 0, 0], [0, 0, 2])
    second = flat_square(rng, 12000, [3, 0, 0], [3 * np.cos(turn), 3 * np.sin(turn), 0], [0, 0, 2])
    points = np.concatenate([first, second]) + 0.005 * rng.normal(size=(24000, 3))
    planes = found_in(points)
    assert len(planes.count) == 2
    between = np.degrees(np.arccos(abs(planes.normal[0] @ planes.normal[1])))
    assert between == pytest.approx(turn_deg, abs=0.7)


def test_a_slowly_bending_wall_is_no_plane():
    rng = np.random.default_rng(3)
    angle, height = rng.uniform(0, 1.2, size=40000), rng.uniform(0, 2, size=40000)
    wall = np.column_stack([5 * np.cos(angle), 5 * np.sin(angle), height])
    assert len(found_in(wall + 0.003 * rng.normal(size=wall.shape)).count) == 0


def test_planes_do_not_depend_on_where_the_world_begins():
    rng = np.random.default_rng(4)
    points, _ = room_walls(rng, 4000)
    shift_m = 300.0 * np.array([100.0, -40.0, 1.0])
    here, there = found_in(points), found_in(points + shift_m, SENSOR_M + shift_m)
    assert np.array_equal(here.count, there.count)
    assert np.allclose(np.abs(np.sum(here.normal * there.normal, axis=1)), 1, atol=1e-9)


def test_a_plane_seen_from_too_few_stops_is_left_out():
    rng = np.random.default_rng(5)
    finder = PlaneFinder()
    wall = flat_square(rng, 9000, [0, 0, 0], [3, 0, 0], [0, 0, 2])
    floor = flat_square(rng, 9000, [0, 0.5, 0.05], [3, 0, 0], [0, 2, 0])
    finder.add(0, np.concatenate([wall, floor]), SENSOR_M)
    finder.add(1, wall, SENSOR_M)
    assert len(finder.planes().count) == 2
    assert np.array_equal(finder.planes(min_stops=2).count, [18000])


def test_rings_that_fan_out_about_the_sensor_are_no_plane():
    """A few nearly level rings on scattered things fill a plane through the sensor."""
    rng = np.random.default_rng(8)
    azimuth, level = (
        rng.uniform(0, 2 * np.pi, 40_000),
        np.radians(rng.choice([-0.2, 0.0, 0.2], 40_000)),
    )
    ray = np.stack([np.cos(azimuth), np.sin(azimuth), np.tan(level)], axis=1)
    fan = SENSOR_M + rng.uniform(1.0, 2.5, (40_000, 1)) * ray
    assert len(found_in(fan).count) == 0
    seen_from_above = found_in(fan, SENSOR_M + np.array([0.0, 0.0, 2.0]))
    assert len(seen_from_above.count) == 1


def test_without_any_flat_cell_there_is_no_plane():
    rng = np.random.default_rng(6)
    cloud = rng.uniform(size=(5000, 3))
    planes = found_in(cloud)
    assert len(planes.count) == 0
    assert np.all(planes.assign(cloud[:10]) == -1)
    assert len(PlaneFinder().planes().count) == 0
    assert len(found_in(np.zeros((0, 3))).count) == 0


def test_cell_moments_are_those_of_numpy():
    rng = np.random.default_rng(8)
    points = rng.normal(size=(4000, 3))
    cells = cell_moments(points, cell_m=0.8)
    assert cells.count.sum() == 4000
    index = np.floor(points / 0.8).astype(int)
    key, count = np.unique(index, axis=0, return_counts=True)
    largest = key[count.argmax()]
    inside = points[np.all(index == largest, axis=1)]
    row = np.flatnonzero(cells.count == len(inside))[0]
    assert np.allclose(cells.mean_m[row], inside.mean(axis=0))
    assert np.allclose(cells.covariance_m2[row], np.cov(inside.T, bias=True))


def test_pooled_moments_are_those_of_all_points():
    rng = np.random.default_rng(9)
    points = rng.normal(size=(4000, 3)) + 50.0
    whole = cell_moments(points, cell_m=0.8).pool(
        np.zeros(len(cell_moments(points, 0.8).count), int)
    )
    assert np.allclose(whole.mean_m[0], points.mean(axis=0))
    assert np.allclose(whole.covariance_m2[0], np.cov(points.T, bias=True))
