"""Surveyed clouds: a scan simulated in a room with a window becomes that room, window and all."""

from pathlib import Path

import numpy as np
import pytest

from chains.errors import InputError
from sensors.meshes import distance_to_mesh, write_cloud
from sensors.readers.base import Options
from sensors.readers.meshes.pts import read_pts, read_ptx
from sensors.readers.meshes.reconstruction import Thinner
from sensors.readers.meshes.survey import read_survey
from sensors.reference import Reference

SCANNERS = np.array([[0.0, 0.0, 0.0], [0.5, 0.4, 0.1]])
T_SPUN = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])  # the second scanner stood turned


def read(*paths, **options):
    """The reader without anyone to be told of progress."""
    return read_survey([Path(p) for p in paths], Options(**options), lambda *_: None)


@pytest.fixture(scope="module")
def room():
    """Floor, walls and ceiling of 2 x 1.6 x 1.4 m about the origin, with a box in it."""
    import trimesh

    box = trimesh.creation.box((0.3, 0.3, 0.4)).apply_translation([0.6, -0.5, -0.5])
    both = trimesh.util.concatenate([trimesh.creation.box((2, 1.6, 1.4)), box])
    return Reference(both.vertices, both.faces)


@pytest.fixture(scope="module")
def scans(room):
    """Per scanner points (N, 3), 0.5 mm of noise, none through a window; intensity: of x."""
    rng = np.random.default_rng(0)
    elevation, azimuth = np.radians(np.mgrid[-88:89:1.2, 0:360:1.2]).reshape(2, -1)
    flat = np.cos(elevation)
    directions = np.stack(
        [flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=1
    )
    found = []
    for scanner_m in SCANNERS:
        hits = room.cast(scanner_m, directions)
        range_m = hits.range_m + rng.normal(0, 0.0005, len(directions))
        points = scanner_m + range_m[:, None] * directions
        window = (hits.point_m[:, 1] > 0.799) & (np.abs(points[:, [0, 2]]) < 0.35).all(axis=1)
        found.append((points[~window], 0.5 + 0.4 * points[~window, 0]))
    return found


def write_ptx(path, scans):
    """Each scan in its scanner's own frame, the second turned, with a return that is missing."""
    with path.open("w") as file:
        for scanner_m, R, (points, bright) in zip(
            SCANNERS, (np.eye(3), T_SPUN), scans, strict=True
        ):
            rows = [*R.T, scanner_m]
            file.write(f"{len(points) + 1}\n1\n" + "{} {} {}\n".format(*scanner_m))
            file.writelines("{} {} {}\n".format(*axis) for axis in R.T)
            ends = (0, 0, 0, 1)
            file.writelines(
                "{} {} {} {}\n".format(*row, e) for row, e in zip(rows, ends, strict=True)
            )
            file.write("0 0 0 0.5\n")
            np.savetxt(file, np.column_stack([(points - scanner_m) @ R, bright]), fmt="%.7f")


@pytest.fixture(scope="module")
def meshed(scans, tmp_path_factory):
    """What the reader makes of the PTX file."""
    path = tmp_path_factory.mktemp("survey") / "room.ptx"
    write_ptx(path, scans)
    return read(path)


def middles(surface):
    """Middle (F, 3) of every triangle."""
    return surface.vertices_m[surface.triangles].mean(axis=1)


def test_the_surface_lies_on_the_walls(room, meshed):
    """Away from edges, which Poisson's equation rounds, within 2 mm, and less than the noise."""
    at = middles(meshed.surface)
    off_m = distance_to_mesh(room.vertices_m, room.triangles, at)
    corners = np.unique(room.vertices_m, axis=0)
    axes = [np.unique(corners[:, i]) for i in range(3)]
    near = np.stack([np.abs(at[:, [i]] - axes[i]).min(axis=1) < 0.1 for i in range(3)])
    flat = near.sum(axis=0) < 2
    assert flat.sum() > 1000
    assert np.quantile(off_m[flat], 0.99) < 0.002
    assert np.median(off_m[flat]) < 0.0002


def test_all_walls_are_covered_and_the_window_stays_open(room, meshed, scans):
    surface = meshed.surface
    points = np.concatenate([points for points, _ in scans])
    off_m = distance_to_mesh(surface.vertices_m, surface.triangles, points)
    assert np.mean(off_m < 0.003) > 0.97
    at = middles(surface)
    pane = (at[:, 1] > 0.7) & (np.abs(at[:, [0, 2]]) < 0.25).all(axis=1)
    assert not pane.any()
    wall = (at[:, 1] > 0.7) & (np.abs(at[:, [0, 2]]) < 0.5).all(axis=1)
    assert wall.sum() > 50


def test_intensity_goes_to_the_triangles(meshed):
    expected = 0.5 + 0.4 * middles(meshed.surface)[:, 0]
    off = np.abs(meshed.surface.intensity - expected)
    assert np.median(off) < 0.005
    assert np.quantile(off, 0.99) < 0.03


def test_what_was_done_is_said(meshed, scans):
    said = "\n".join(meshed.understood)
    count = sum(len(points) for points, _ in scans)
    assert f"room.ptx: 2 scans, 2 with the scanner's place, {count} points; m, z up" in said
    assert "trimmed where the scan is thin" in said
    assert "cloud to mesh" in said
    assert meshed.odd == ()


def test_millimetres_are_refused_unless_a_flag_says_so(scans, tmp_path):
    points = scans[0][0][::7]
    rows = np.column_stack([1000 * points, np.zeros(len(points))])
    path = tmp_path / "mm.pts"
    np.savetxt(path, rows, fmt="%.3f", header=str(len(rows)), comments="")
    with pytest.raises(InputError, match=r"mm.pts is \d+ units wide.*--length-unit mm"):
        read(path)
    found = read(path, length_unit="mm")
    assert np.ptp(found.surface.vertices_m, axis=0).max() < 2.2
    assert any("the origin of its frame is taken" in line for line in found.odd)


# ---- files


def blocks(reader, path):
    """All points (N, 3) of a reader, and their intensity."""
    read = list(reader(path))
    return np.concatenate([b.points for b in read]), [b.intensity for b in read], read


def test_pts_of_several_scans_is_read_in_blocks(tmp_path, monkeypatch):
    monkeypatch.setattr("sensors.readers.meshes.pts.BLOCK_LINES", 4)
    path = tmp_path / "two.pts"
    rows = [f"{k}.5 {k} -{k} {k - 2048} 1 2 3" for k in range(10)]
    path.write_text("\n".join(["7", *rows[:7], "3", *rows[7:], ""]))
    points, bright, read = blocks(read_pts, path)
    assert np.array_equal(points, [[k + 0.5, k, -k] for k in range(10)])
    assert np.concatenate(bright).tolist() == [k - 2048 for k in range(10)]
    assert [b.scan for b in read] == [0, 0, 1]
    path.write_text("# by hand\n1,2,3\n4,5,6\n\n")
    points, bright, _ = blocks(read_pts, path)
    assert points.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert bright == [None]


def test_ptx_points_are_laid_into_the_common_frame(scans, tmp_path):
    path = tmp_path / "room.ptx"
    write_ptx(path, scans)
    points, bright, read = blocks(read_ptx, path)
    np.testing.assert_allclose(points, np.concatenate([p for p, _ in scans]), atol=1e-6)
    np.testing.assert_allclose(
        np.concatenate(bright), np.concatenate([b for _, b in scans]), atol=1e-6
    )
    assert [b.origin.tolist() for b in read] == SCANNERS.tolist()


PTX = "1\n2\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n1 2 3 0.5\n4 5 6 0.5\n"


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.pts", None, "does not exist"),
        ("a.pts", "", r"is empty \(0 bytes\)"),
        ("a.pts", "3\n1 2 3\n4 5 6\n", "ends too early: 2 of 3 points"),
        ("a.pts", "2\n1 2 3\n4 5\n", r":3: 2 numbers, but the lines above have 3"),
        ("a.pts", "2\n1 2 3\n4 5 x\n", r":3: `4 5 x` is no line of numbers"),
        ("a.pts", "hello\n", r":1: `hello` is no line of numbers"),
        ("a.ptx", PTX[:-10], "ends too early: 1 of 2 points"),
        ("a.ptx", PTX[:30], "ends too early, after line"),
        ("a.ptx", "2\n1 2 3\n" * 5, r":1: no PTX header"),
        ("a.xyzzy", "1 2 3\n", "a cloud is read from"),
        ("a.pts", "3\n1 2 3\n4 5 6\n7 8 9\n", "3 points do not make a surface"),
    ],
)
def test_broken_files_are_one_sentence(tmp_path, name, text, message):
    if text is not None:
        (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=f"{name}.*{message}"):
        read(tmp_path / name)


def test_a_file_cut_anywhere_is_refused(tmp_path):
    path = tmp_path / "a.ptx"
    for length in range(1, len(PTX) - 1):
        path.write_text(PTX[:length])
        with pytest.raises(InputError):
            read(path)


# ---- thinning


def test_thinning_keeps_sums_and_bounds_memory():
    rng = np.random.default_rng(0)
    points = 4e5 + rng.uniform(-1, 1, (5000, 3))
    value = rng.normal(size=(5000, 1))
    whole, blockwise = Thinner(0.4, 10**9), Thinner(0.05, 300)
    whole.add(0, points, value)
    for part in np.array_split(np.arange(5000), 7):
        blockwise.add(0, points[part], value[part])
    assert blockwise.voxel_m == pytest.approx(0.4)
    assert blockwise.count == 5000
    for a, b in zip(whole.means(), blockwise.means(), strict=True):
        assert a.shape == b.shape
    _, at, mean = blockwise.means()
    cell = np.floor((points - points[0]) / 0.4).astype(int)
    _, where, count = np.unique(cell, axis=0, return_inverse=True, return_counts=True)
    expected = np.bincount(where.ravel(), value[:, 0]) / count
    np.testing.assert_allclose(np.sort(mean[:, 0]), np.sort(expected), atol=1e-12)
    assert np.abs(at - 4e5).max() < 1


def test_scans_are_thinned_apart():
    thinner = Thinner(1.0)
    thinner.add(0, np.zeros((3, 3)), np.ones((3, 1)))
    thinner.add(1, np.full((1, 3), 0.5), np.full((1, 1), 5.0))
    scan, at, value = thinner.means()
    assert scan.tolist() == [0, 1]
    assert at[:, 0].tolist() == [0, 0.5]
    assert value[:, 0].tolist() == [1, 5]


def test_normals_of_the_file_and_positions_of_scanners_say_what_faces_out(scans, tmp_path):
    """Without either, the origin is taken, aloud."""
    points, bright = scans[0]
    columns = dict(zip("xyz", points.T, strict=True)) | {"intensity": bright}
    write_cloud(tmp_path / "bare.ply", columns)
    inwards = -points / np.linalg.norm(points, axis=1, keepdims=True)
    columns |= dict(zip(("nx", "ny", "nz"), inwards.T, strict=True))
    write_cloud(tmp_path / "normals.ply", columns)
    bare, normals = read(tmp_path / "bare.ply"), read(tmp_path / "normals.ply")
    assert any("100 % of the points do not say where" in line for line in bare.odd)
    assert not any("where their scanner stood" in line for line in normals.odd)
    for found in (bare, normals):
        off_m = distance_to_mesh(found.surface.vertices_m, found.surface.triangles, points)
        assert np.median(off_m) < 0.001
