"""Spheres: lists in the dialects of spreadsheets, and clouds whose spheres are known."""

from pathlib import Path

import numpy as np
import pytest

from chains.align import fit_sphere
from chains.errors import InputError
from sensors.meshes import write_cloud
from sensors.readers.base import Options
from sensors.readers.meshes.spheres import read_spheres

RADIUS_M = 0.0725
CENTRES_M = np.array([[2.0, 0.3, 0.1], [-1.0, 2.0, 0.4], [0.4, -2.4, -0.3]])


def read(*paths, **options):
    """The reader without anyone to be told of progress."""
    return read_spheres([Path(p) for p in paths], Options(**options), lambda *_: None)


def cap(centre_m, count, rng, noise_m=0.001):
    """What a scanner in the origin sees of a sphere (N, 3), noise along its beams."""
    normal = rng.normal(size=(count, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    normal = normal[normal @ -centre_m > 0.2 * np.linalg.norm(centre_m)]
    points = centre_m + RADIUS_M * normal
    beam = points / np.linalg.norm(points, axis=1, keepdims=True)
    return points + rng.normal(0, noise_m, (len(points), 1)) * beam


def write(path, points):
    write_cloud(path, dict(zip("xyz", points.T, strict=True)))
    return path


# ---- fitting


@pytest.mark.parametrize("radius_m", [None, RADIUS_M])
def test_exact_points_give_the_exact_sphere_however_far(radius_m):
    rng = np.random.default_rng(0)
    centre = CENTRES_M[0]
    points = cap(centre, 400, rng, noise_m=0) + 4e5
    found, radius, rms = fit_sphere(points, radius_m)
    np.testing.assert_allclose(found - 4e5, centre, atol=1e-9)
    assert radius == pytest.approx(RADIUS_M, abs=1e-9)
    assert rms < 1e-9


def test_the_fit_is_the_least_in_distance():
    """No neighbour of the solution has a smaller sum of squared distances."""
    rng = np.random.default_rng(1)
    points = cap(CENTRES_M[1], 300, rng, noise_m=0.003)
    centre, radius, rms = fit_sphere(points)

    def cost(change):
        away = np.linalg.norm(points - centre - change[:3], axis=1)
        return np.mean((away - radius - change[3]) ** 2)

    assert cost(np.zeros(4)) == pytest.approx(rms**2)
    for step in np.concatenate([np.eye(4), -np.eye(4), rng.normal(size=(20, 4))]) * 1e-5:
        assert cost(step) > rms**2


@pytest.mark.parametrize("points", [np.zeros((3, 3)), np.mgrid[0:4, 0:4, 0:1].reshape(3, -1).T])
def test_points_that_fix_no_sphere_are_refused(points):
    with pytest.raises(InputError, match="sphere"):
        fit_sphere(points)


# ---- clouds


def test_a_cloud_of_each_sphere_is_fitted_without_what_lies_beside(tmp_path):
    rng = np.random.default_rng(0)
    paths = []
    for k, centre in enumerate(CENTRES_M):
        stray = centre + rng.uniform(-0.3, 0.3, (60, 3))
        points = np.concatenate([cap(centre, 3000, rng), stray])
        paths.append(write(tmp_path / f"T{k}.ply", points))
    found = read(*paths)
    assert found.spheres.names == ("T0", "T1", "T2")
    np.testing.assert_allclose(found.spheres.centre_m, CENTRES_M, atol=0.0006)
    assert all("sphere of radius 72." in line or ".ply" in line for line in found.understood)
    known = read(*paths, sphere_radius_m=RADIUS_M).spheres
    np.testing.assert_allclose(known.centre_m, CENTRES_M, atol=0.0003)


@pytest.fixture(scope="module")
def scene():
    """Two walls, a pole of the spheres' radius, and the three spheres, 10 mm apart."""
    rng = np.random.default_rng(2)
    grid = np.mgrid[-1.5:1.5:0.01, -1.5:1.5:0.01].reshape(2, -1).T
    wall = np.full(len(grid), 3.0)
    turn, height = np.mgrid[np.pi : 2 * np.pi : 0.14, -1:1:0.01].reshape(2, -1)
    pole = np.stack([RADIUS_M * np.cos(turn), 1.5 + RADIUS_M * np.sin(turn), height], axis=1)
    caps = [cap(centre, 900, rng) for centre in CENTRES_M]
    walls = [np.column_stack([wall, grid]), np.column_stack([grid, wall - 4.2]), pole]
    return np.concatenate([*walls, *caps]) + rng.normal(0, 0.0005, (3, 1))[:, 0]


def test_spheres_of_a_known_radius_are_found_among_walls_and_poles(scene, tmp_path):
    found = read(write(tmp_path / "scene.pcd", scene), sphere_radius_m=RADIUS_M).spheres
    assert found.names == ("scene_1", "scene_2", "scene_3")
    away = np.linalg.norm(found.centre_m[:, None] - CENTRES_M, axis=2)
    assert sorted(away.argmin(axis=1)) == [0, 1, 2]
    assert away.min(axis=1).max() < 0.0015


def test_what_is_no_sphere_is_refused(scene, tmp_path):
    path = write(tmp_path / "scene.pcd", scene)
    with pytest.raises(InputError, match=r"scene.pcd is not the cloud of one sphere.*--sphere-rad"):
        read(path)
    with pytest.raises(InputError, match=r"scene.pcd shows no sphere of radius 300 mm"):
        read(path, sphere_radius_m=0.3)
    few = write(tmp_path / "few.ply", scene[:20])
    with pytest.raises(InputError, match=r"few.ply has 20 points"):
        read(few)


# ---- tables


@pytest.mark.parametrize(
    ("text", "options"),
    [
        ("Name;X;Y;Z\nA;1,5;2;-0,25\nB;1;2;3\n", {}),
        ("Name,X,Y,Z\nA,1.5,2,-0.25\nB,1,2,3\n", {}),
        ("A\t1500\t2000\t-250\nB\t1000\t2000\t3000\n", {"length_unit": "mm"}),
        ("Name,X [mm],Y [mm],Z [mm]\nA,1500,2000,-250\nB,1000,2000,3000\n", {}),
        (
            "# export\nObject;Type;Position X;Position Y;Position Z;Radius\n"
            "A;Sphere;1,5;2;-0,25;0,07\nB;Sphere;1;2;3;0,07\nP;Plane;0;0;1;\nQ;Plane;0;0;1;\n",
            {},
        ),
        ("Name,X,Y,Z\nA,1.5,-0.25,-2\nB,1,3,-2\n", {"up": "y"}),
    ],
)
def test_lists_are_read_in_any_dialect(tmp_path, text, options):
    path = tmp_path / "spheres.csv"
    path.write_text(text)
    found = read(path, **options).spheres
    assert found.names == ("A", "B")
    np.testing.assert_allclose(found.centre_m, [[1.5, 2, -0.25], [1, 2, 3]], atol=1e-12)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty"),
        ("a,b\nc,d\n", "no row with three numbers"),
        ("A,1500,2,3\nB,9000,2,3\n", "7500 units wide.*--length-unit mm"),
        ("A,1,2,3\nA,4,5,6\n", "a sphere A is there twice"),
        ("Channel,Elevation,Azimuth,Gain\nA,4,5,6\n", "has the columns Channel, .*x, y and z"),
        ("A,1,2,3,4\nB,4,5,6,7\n", "4 columns of numbers and no header"),
        ("Name,Type,X,Y,Z\nA,Sphere,1,2,x\nB,Sphere,1,2,3\n", "a number is wanted"),
    ],
)
def test_lists_that_cannot_be_read_are_one_sentence(tmp_path, text, message):
    path = tmp_path / "spheres.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=f"spheres.csv.*{message}"):
        read(path)
