"""Residuals on the sides of a room: in the right cell, whatever way the room is turned."""

from functools import partial

import numpy as np
import pytest

from calib.report.walls import WALL_CELL_M, Box, Ends, faces, repeats_m, yaw_of
from sensors.reference import Reference

CORNER_M = np.array([3.0, -2.0, 0.5])
MANY = 1_000_000  # beams: cells are as small as they get
SIZE_M = np.array([6.0, 4.0, 2.6])


def turned(at, yaw_rad):
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    return at @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T


def box_mesh(yaw_rad):
    """A closed box, turned."""
    corner = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * SIZE_M
    sides = [(0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5)]
    triangles = [t for a, b, c, d in sides for t in ((a, b, c), (a, c, d))]
    return Reference(turned(corner, yaw_rad) + CORNER_M, np.array(triangles))


def stop(rng, yaw_rad, off, noise_m, count=40_000):
    """Ends on all sides of the box; `off` gives each its residual, by the side's axis, which of
    its two ends, and where on it."""
    k, end = rng.integers(0, 3, count), rng.integers(0, 2, count)
    at = rng.uniform(0, 1, (count, 3)) * SIZE_M
    at[np.arange(count), k] = end * SIZE_M[k]
    residual = np.array([off(*each) for each in zip(k, end, at, strict=True)])
    residual += rng.normal(0, noise_m, count)
    return Ends(turned(at, yaw_rad) + CORNER_M, residual, weight=np.ones(count))


@pytest.mark.parametrize("yaw_rad", [-0.7, 0.0, 0.3])
def test_the_walls_of_a_mesh_say_how_the_room_is_turned(yaw_rad):
    assert yaw_of(box_mesh(yaw_rad)) == pytest.approx(yaw_rad, abs=1e-9)


def test_what_is_wrong_on_one_wall_is_seen_there_and_nowhere_else():
    def off(k, end, at):
        return 2e-3 if (k, end) == (1, 1) and at[0] > 3.0 else 0.0

    rng, yaw_rad = np.random.default_rng(1), 0.3
    stops = [stop(rng, yaw_rad, off, 1e-3) for _ in range(4)]
    found = {face.name: face for face in faces(Box.of(yaw_rad, stops, MANY), stops)}
    assert list(found) == [
        "wall at x = 0.0 m",
        "wall at y = 0.0 m",
        "floor",
        "wall at x = 6.0 m",
        "wall at y = 4.0 m",
        "ceiling",
    ]
    wall = found.pop("wall at y = 4.0 m")
    assert wall.axes == ("x", "z") and wall.mean_m.shape == (13, 30)
    middle = round(3.0 / WALL_CELL_M)
    assert np.nanmean(wall.mean_m[:, middle + 1 :]) == pytest.approx(2e-3, abs=1e-4)
    assert np.nanmean(wall.mean_m[:, : middle - 1]) == pytest.approx(0.0, abs=1e-4)
    for other in found.values():
        assert abs(np.nanmean(other.mean_m)) < 1e-4


def waves(size_m, k, end, at):
    """A residual that varies over all sides."""
    return size_m * np.sin(2.0 * at.sum())


def test_what_repeats_is_told_from_noise():
    """A wave over all walls has the rms that it has, though noise is ten times larger; noise alone
    repeats by much less than the mean of a cell scatters."""
    rng = np.random.default_rng(2)
    for size_m in (0.0, 0.4e-3):
        wave = partial(waves, size_m)
        stops = [stop(rng, 0.0, wave, 4e-3) for _ in range(10)]
        found = faces(Box.of(0.0, stops, MANY), stops)
        seen = np.concatenate([face.mean_m.ravel() for face in found])
        scatter = np.nanstd(seen)
        repeats = repeats_m(found)
        if size_m:
            assert repeats == pytest.approx(size_m / np.sqrt(2), rel=0.15)
        else:
            assert repeats < 0.25 * scatter


def test_cells_are_larger_where_beams_are_few():
    rng = np.random.default_rng(4)
    ends = stop(rng, 0.0, lambda *_: 0.0, 1e-3, 1000)
    box = Box.of(0.0, [ends], 1000)
    x, y, z = SIZE_M
    assert box.cell_m == pytest.approx(np.sqrt(2 * (x * y + y * z + z * x) / 100), abs=0.05)
    drawn = [np.isfinite(face.mean_m).mean() for face in faces(box, [ends])]
    assert min(drawn) > 0.5


def test_beams_thrown_away_and_what_stands_in_the_room_are_not_drawn():
    rng = np.random.default_rng(3)
    ends = stop(rng, 0.0, lambda *_: 1e-3, 0.0, 20_000)
    inside = np.tile([[6.0, 0.0, 1.8]], (500, 1))  # the middle of the room
    with_more = Ends(
        np.concatenate([ends.at_m, ends.at_m, inside]),
        np.concatenate([ends.residual_m, 0 * ends.residual_m + 9.0, np.full(500, 9.0)]),
        weight=np.concatenate([ends.weight, 0 * ends.weight, np.ones(500)]),
    )
    box = Box.of(0.0, [ends], MANY)
    for alone, more in zip(faces(box, [ends]), faces(box, [with_more]), strict=True):
        np.testing.assert_array_equal(alone.mean_m, more.mean_m)
        assert np.nanmax(alone.mean_m) == pytest.approx(1e-3)
