"""Meshes that are wrong as a whole: surfaces that lean, another metre, a scanner's range offset."""

import numpy as np
import pytest

from calib import add, diagnose, fit

from ..mishaps.judge import off, read_truth
from ..mishaps.scene import Scene
from ..worlds import World, write

LAB = World(seed=101, locations=4, stops=5, beams=500)


def lab(folder, change):
    """A recording whose mesh is not as the room is."""
    write(LAB, folder)
    Scene(folder, np.random.default_rng(0)).remesh(change)
    return folder


def sigmas(run, folder):
    """Parameter -> by how many sigmas it is off, of those that are told."""
    truth = read_truth(folder.with_name(f"{folder.name}.truth.json"))
    return {name: each.sigmas for name, each in off(run.folder, truth).items() if each.told}


def leaning_floor(vertices, triangles):
    """It rises by 1 mrad."""
    floor = vertices[triangles][..., 2].max(axis=1) < 0.001
    corners = np.unique(triangles[floor])
    vertices[corners, 2] += 0.001 * vertices[corners, 0]
    return vertices


@pytest.fixture(scope="module")
def leaning(tmp_path_factory):
    folder = lab(tmp_path_factory.mktemp("leaning") / "rec", leaning_floor)
    return folder, fit([folder], folder.with_name("run"))


def test_a_floor_that_leans_hardly_turns_the_room(leaning):
    """By 4 mm at the walls, seven times the sigma of the mesh; it turned the room by 7 sigmas."""
    folder, run = leaning
    found = sigmas(run, folder)
    assert found["faro.ry"] < 4.0 and max(found.values()) < 4.0


def test_a_floor_that_leans_is_named_by_its_angle(leaning, tmp_path):
    folder, run = leaning
    found = diagnose(run)
    (blunder,) = found.blunders
    assert blunder["without"] == "mesh:surface_0" and blunder["axis"] == "about its second axis"
    assert blunder["size"] == pytest.approx(0.001, abs=3 * blunder["sigma"])
    without = add(run, [], tmp_path / "without", without=["mesh:surface_0"])
    assert max(sigmas(without, folder).values()) < 3.0


@pytest.mark.long
@pytest.mark.parametrize(
    ("stretch", "name"),
    [((1.002, 1.002, 1.002), "mesh_scale"), ((1.001, 1.0, 1.0), "mesh_strain")],
)
def test_a_mesh_that_is_stretched_is_named_where_the_spheres_are_right(tmp_path, stretch, name):
    """One of another metre was named; one stretched along an axis was called a seam of the mesh and
    rods that lean, and left a frame 10 sigmas off."""
    folder = lab(tmp_path / "rec", lambda vertices, _: vertices * stretch)
    run = fit([folder], tmp_path / "run")
    found = diagnose(run)
    assert found.worth_adding == [name]
    grown = add(run, found.worth_adding, tmp_path / "grown")
    effect = grown.solution.shared.effects[name]
    first = effect.estimate[list(effect.names).index("scale" if name == "mesh_scale" else "xx")]
    assert first == pytest.approx(1.0 / stretch[0] - 1.0, abs=2.5e-4)
    assert max(sigmas(grown, folder).values()) < 4.0


def test_a_scanner_whose_ranges_are_too_long_is_named_where_it_is_known_where_it_stood(tmp_path):
    """Mesh and spheres move away from there; it was called a metre that is too long, and left the
    frame 5 sigmas off."""
    station, too_long_m = np.array([-3.0, -2.5, 1.5]), 0.003

    def scanned(points):
        away = points - station
        return points + too_long_m * away / np.linalg.norm(away, axis=1, keepdims=True)

    folder = lab(tmp_path / "rec", lambda vertices, _: scanned(vertices))
    scene = Scene(folder, np.random.default_rng(0))
    with scene.sheet("targets.csv") as targets:
        names = ("faro_x", "faro_y", "faro_z")
        targets.put(scanned(targets.numbers(*names)), *names)
    with scene.description() as rig:
        rig["reference"]["scanner_m"] = [station.tolist()]
    run = fit([folder], tmp_path / "run")
    found = diagnose(run)
    assert found.worth_adding == ["faro_range_offset"]
    grown = add(run, found.worth_adding, tmp_path / "grown")
    effect = grown.solution.shared.effects["faro_range_offset"]
    assert effect.estimate[0] == pytest.approx(-too_long_m, abs=3 * effect.sigma[0])
    assert max(sigmas(grown, folder).values()) < 4.0


@pytest.mark.long
@pytest.mark.parametrize("size_rad", [0.0003, 0.001])
def test_walls_that_all_lean_are_told_as_such(tmp_path, size_rad):
    """Each by a way of its own; a cell of one was called wrong instead, and the room turned."""
    rng = np.random.default_rng(12)

    def change(vertices, triangles):
        for axis in range(3):
            for end in (vertices[:, axis].min(), vertices[:, axis].max()):
                wall = np.abs(vertices[:, axis] - end) < 0.02
                slope = np.where(np.arange(3) == axis, 0.0, size_rad * rng.normal(size=3))
                vertices[wall, axis] += (vertices[wall] - [0.0, 0.0, 1.45]) @ slope
        return vertices

    folder = lab(tmp_path / "rec", change)
    run = fit([folder], tmp_path / "run")
    found = diagnose(run)
    assert max(sigmas(run, folder).values()) < 4.0
    assert found.blunders or found.worth_adding == ["reference_scatter"]
    for blunder in found.blunders:
        assert blunder["without"].startswith("mesh:surface_") and blunder["unit"] == "rad"
    if not found.blunders:
        assert "ends of leaning surfaces by" in found.sentences[0]
