"""A real scan as E57 becomes a surface on which its own planes lie."""

from pathlib import Path

import numpy as np
import pytest

from sensors.meshes import distance_to_mesh
from sensors.readers.base import Options
from sensors.readers.meshes.survey import read_blocks, read_survey

PUMP = Path(__file__).parents[3] / "shared/data/reference/e57_pump/pumpAVisualReferenceImage.e57"
pytestmark = [
    pytest.mark.long,
    pytest.mark.skipif(not PUMP.exists(), reason="the shared data are not beside the checkout"),
]


@pytest.fixture(scope="module")
def points():
    """The scan (N, 3), m."""
    return np.concatenate([block.points for block in read_blocks(PUMP)])


@pytest.fixture(scope="module")
def found():
    """The surface made of it."""
    return read_survey([PUMP], Options(), lambda *_: None)


def largest_plane(points):
    """Normal and offset of the plane with most points within 5 mm (RANSAC, then least squares)."""
    rng = np.random.default_rng(0)
    best = np.zeros(len(points), bool)
    for _ in range(500):
        a, b, c = points[rng.choice(len(points), 3, replace=False)]
        normal = np.cross(b - a, c - a)
        normal /= max(np.linalg.norm(normal), 1e-12)
        on = np.abs((points - a) @ normal) < 0.005
        best = on if on.sum() > best.sum() else best
    mean = points[best].mean(axis=0)
    normal = np.linalg.svd(points[best] - mean, full_matrices=False)[2][2]
    return normal, mean


@pytest.mark.long
def test_every_point_is_read(points, found):
    assert len(points) == 155_201
    assert any("155201 points; m, z up" in line for line in found.understood)


@pytest.mark.long
def test_the_surface_follows_the_scan(points, found):
    surface = found.surface
    off_m = distance_to_mesh(surface.vertices_m, surface.triangles, points)
    assert np.median(off_m) < 0.0015
    assert np.mean(off_m < 0.005) > 0.9


def roughness(points, normal, mean, least=30):
    """Per 0.1 m cell of a plane, std of what lies within 10 mm of it about the cell's own plane."""
    off = (points - mean) @ normal
    points = points[np.abs(off) < 0.01]
    axes = np.linalg.svd(np.eye(3) - np.outer(normal, normal))[0][:, :2]
    cell = np.floor((points - mean) @ axes / 0.1).astype(int)
    found = {}
    for key in np.unique(cell, axis=0):
        own = points[(cell == key).all(axis=1)]
        if len(own) >= least:
            values = np.linalg.svd(own - own.mean(axis=0), compute_uv=False)
            found[tuple(key)] = values[2] / np.sqrt(len(own))
    return found


def test_planes_of_the_surface_are_smoother_than_the_scans(points, found):
    normal, mean = largest_plane(points)
    scan = roughness(points, normal, mean)
    mesh = roughness(found.surface.vertices_m, normal, mean)
    both = scan.keys() & mesh.keys()
    assert len(both) > 50
    ratio = np.array([mesh[key] / scan[key] for key in both])
    assert np.median(ratio) < 0.9
    assert np.median([scan[key] for key in both]) < 0.005


def test_its_intensity_is_the_scans(found):
    low, high = np.quantile(found.surface.intensity, [0.01, 0.99])
    assert 0.38 < low < high < 0.70
