"""A part of the mesh that is off: named, placed, left out; the rest of its surface stays."""

import shutil

import numpy as np
import pytest

from calib.problem.model import Model, Source
from calib.problem.without import leave_out
from calib.residuals.surfaces import part_centre_m, patch_widths_m
from calib.runs.calibrate import calibrate
from calib.runs.diagnose import diagnose
from calib.simulation import Spec, simulate
from sensors.recording import read_table
from sensors.reference import Reference

from ..mishaps import Scene

SPEC = Spec(lidar="hesai_pandarxt32", locations=4, stops_per_location=3, column_step=40)


def bulge(folder, top_m, height_m, width_m):
    """Make a bell of the mesh of a recording, along the normal of the surface there; how far each
    vertex (V,) was moved."""
    reference = Source.open(folder).reference
    away_m = np.linalg.norm(reference.vertices_m - top_m, axis=1)
    nearest = reference.triangles[np.argmin(away_m[reference.triangles].min(axis=1))]
    corner = int(np.flatnonzero((reference.triangles == nearest).all(axis=1))[0])
    moved_m = height_m * np.exp(-np.square(away_m / width_m))
    normal = reference.planes[corner, :3]
    scene = Scene(folder, np.random.default_rng(0))
    scene.remesh(lambda at, triangles: at + moved_m[:, None] * normal)
    return moved_m


@pytest.fixture(scope="module")
def bulged(tmp_path_factory):
    """A recording whose mesh bulges where most beams meet it, how far (V,) it was moved, and the
    run that was fitted to it."""
    folder = tmp_path_factory.mktemp("bulged")
    simulate(SPEC, folder / "rec", 3, {})
    sound = calibrate([folder / "rec"], folder / "sound", Model(), "none")
    tables = sorted((sound.folder / "residuals.parquet").glob("L*.parquet"))
    met = np.concatenate([read_table(table)["patch"] for table in tables]).astype(int)
    top_m = part_centre_m(
        Source.open(folder / "rec").reference, f"patch_{np.bincount(met[met >= 0]).argmax()}"
    )
    moved_m = bulge(folder / "rec", top_m, height_m=0.02, width_m=0.5)
    return folder / "rec", moved_m, calibrate([folder / "rec"], folder / "run", Model(), "none")


@pytest.mark.long
def test_a_bulge_is_named_where_it_is(bulged):
    """By 20 mm, over a metre of a wall of several metres; and not as that wall. Regions are tilted
    at its flanks."""
    folder, moved_m, run = bulged
    found, source = diagnose(run, refits=False), Source.open(folder)
    assert found.verdict == "bad_data" and found.worth_adding == []
    tokens = [blunder["without"] for blunder in found.blunders]
    assert tokens and all(t.startswith(("mesh:patch_", "mesh:region_")) for t in tokens)
    worst = max((b for b in found.blunders if b["unit"] == "m"), key=lambda b: b["size"])
    top_m = source.reference.vertices_m[np.argmax(moved_m)]
    assert np.linalg.norm(part_centre_m(source.reference, worst["name"]) - top_m) < 0.8
    assert 5 * worst["sigma"] < worst["size"] < moved_m.max()  # its mean over that part
    assert "along its normal" in worst["sentence"] and "(about " in worst["sentence"]


@pytest.mark.long
def test_without_it_nothing_is_wrong(bulged, tmp_path):
    """And the other patches of that wall are still met."""
    folder, _, run = bulged
    tokens = tuple(b["without"] for b in diagnose(run, refits=False).blunders)
    less = calibrate([folder], tmp_path / "less", Model(without=tokens), "none")
    assert diagnose(less, refits=False).verdict == "adequate"
    lost = run.summary["points"] - less.summary["points"]
    assert 0 < lost < 0.2 * run.summary["points"]


@pytest.mark.long
def test_a_board_that_is_turned_about_its_middle_is_named_by_its_angle(bulged, tmp_path):
    """The face that most beams meet, of those that are one region, is turned by 20 mrad. Its middle
    is where it was, so it does not stand off as a whole."""
    simulate(SPEC, tmp_path / "rec", 3, {})
    table = sorted((bulged[2].folder / "residuals.parquet").glob("L*.parquet"))
    met = np.concatenate([read_table(each)["surface"] for each in table]).astype(int)
    mesh = Source.open(tmp_path / "rec").reference
    regions = np.bincount(mesh.patch_surface(patch_widths_m(mesh)["region"]))
    sides_m = np.sort(np.stack([_sides_m(mesh, s) for s in range(len(regions))]), axis=1)
    board = (regions == 1) & (sides_m[:, 1] > 0.8)
    face = int(np.argmax(np.where(board, np.bincount(met[met >= 0], minlength=len(board)), 0)))
    corners = np.unique(mesh.triangles[mesh.surface == face])
    middle_m = mesh.vertices_m[corners].mean(axis=0)
    _, _, (along, _, normal) = np.linalg.svd(mesh.vertices_m[corners] - middle_m)

    def turned(vertices_m, triangles):
        away_m = vertices_m[corners] - middle_m
        vertices_m[corners] += 0.02 * (away_m @ along)[:, None] * normal
        return vertices_m

    Scene(tmp_path / "rec", np.random.default_rng(0)).remesh(turned)
    run = calibrate([tmp_path / "rec"], tmp_path / "run", Model(), "none")
    found = diagnose(run, refits=False)
    (said,) = found.blunders
    assert found.verdict == "bad_data" and said["without"] == f"mesh:surface_{face}"
    assert said["unit"] == "rad" and "about its" in said["sentence"]
    assert abs(said["size"] - 0.02) < 4 * said["sigma"] < 0.008


def _sides_m(mesh: Reference, surface: int) -> np.ndarray:
    """Extents (3,) of a surface along its principal axes."""
    corners_m = mesh.vertices_m[mesh.triangles[mesh.surface == surface]].reshape(-1, 3)
    away_m = corners_m - corners_m.mean(axis=0)
    return np.ptp(away_m @ np.linalg.svd(away_m)[2].T, axis=0)


def test_the_middle_of_a_patch_is_in_it(bulged):
    reference: Reference = Source.open(bulged[0]).reference
    width_m, checked = patch_widths_m(reference)["patch"], 0
    of = reference.patch_surface(width_m)
    for patch in np.flatnonzero(np.bincount(of)[of] > 3).tolist():
        mine = np.flatnonzero(reference.surface == of[patch])[:1]
        middle_m = part_centre_m(reference, f"patch_{patch}")
        assert reference.patch(mine, middle_m[None], width_m).tolist() == [patch]
        checked += 1
    assert checked > 50


def test_the_centre_of_a_surface_is_on_it(bulged):
    """Of a flat one: the mean of its corners lies in its plane, and so does its centre."""
    reference = Source.open(bulged[0]).reference
    largest = int(np.argmax(np.bincount(reference.surface, weights=reference.area_m2)))
    mine = reference.surface == largest
    corners_m = reference.vertices_m[reference.triangles[mine]].reshape(-1, 3)
    centre_m = part_centre_m(reference, f"surface_{largest}")
    assert np.all(centre_m > corners_m.min(axis=0) - 1e-6)
    assert np.all(centre_m < corners_m.max(axis=0) + 1e-6)
    normal = np.linalg.svd(corners_m - corners_m.mean(axis=0))[2][2]
    spread = np.abs((corners_m - corners_m.mean(axis=0)) @ normal).max()
    assert abs((centre_m - corners_m.mean(axis=0)) @ normal) <= spread


@pytest.mark.long
@pytest.mark.parametrize("seed", range(3))
def test_a_bulge_in_a_room_of_another_program_is_named(shared, tmp_path, seed):
    """A bell of 16 mm and 1 m in the mesh of a recording in which nothing is hidden."""
    folder = shutil.copytree(
        shared / "recordings" / "mystery_e", tmp_path / "rec", copy_function=shutil.copy
    )
    for path in (folder, *folder.rglob("*")):
        path.chmod(0o755 if path.is_dir() else 0o644)
    rng, reference = np.random.default_rng(seed), Source.open(folder).reference
    walls = np.flatnonzero(np.bincount(reference.surface, weights=reference.area_m2) > 4.0)
    mine = np.flatnonzero(reference.surface == rng.choice(walls))
    where_m = reference.vertices_m[reference.triangles[rng.choice(mine), 0]]
    bulge(folder, where_m, height_m=0.016, width_m=1.0)
    found = diagnose(calibrate([folder], tmp_path / "run", Model(), "none"), refits=False)
    assert found.verdict == "bad_data"
    reference = Source.open(folder).reference
    for blunder in found.blunders:
        centre_m = part_centre_m(reference, blunder["name"])
        assert blunder["where"] == "mesh" and np.linalg.norm(centre_m - where_m) < 2.0


def test_a_patch_that_is_left_out_is_left_out_once(bulged):
    source = Source.open(bulged[0])
    (less,) = leave_out([source], ["mesh:patch_3"])
    assert [group.token for group in less.without] == ["mesh:patch_3"]
