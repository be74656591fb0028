"""Clouds in files of every format, written by the libraries that own it, or byte by byte."""

from pathlib import Path

import laspy
import numpy as np
import open3d as o3d
import pye57
import pytest

from chains.errors import InputError
from sensors.lidar import load_lidar
from sensors.readers import READERS
from sensors.readers.base import Options
from sensors.readers.clouds.e57 import read_e57_scans

from ..room import box_scan

POINTS, RING, COLUMN = box_scan(load_lidar("velodyne_vlp16").elevation_rad, 90)
XYZ = POINTS.astype(np.float32)
INTENSITY = (COLUMN % 64).astype(np.float32)
TABLE = np.column_stack([XYZ, INTENSITY, RING.astype(np.float32)])


def write_tensor(path: Path) -> None:
    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(XYZ))
    cloud.point["intensity"] = o3d.core.Tensor(INTENSITY[:, None])
    cloud.point["ring"] = o3d.core.Tensor(RING.astype(np.uint16)[:, None])
    assert o3d.t.io.write_point_cloud(str(path), cloud)


def write_las(path: Path) -> None:
    las = laspy.LasData(laspy.LasHeader(point_format=3, version="1.2"))
    las.header.scales = [1e-6] * 3
    las.add_extra_dim(laspy.ExtraBytesParams("ring", np.uint8))
    las.x, las.y, las.z = POINTS.T
    las.intensity, las.ring = INTENSITY.astype(np.uint16), RING.astype(np.uint8)
    las.write(path)


def write_e57(path: Path) -> None:
    fields = {f"cartesian{axis.upper()}": POINTS[:, k].copy() for k, axis in enumerate("xyz")}
    fields |= {"intensity": INTENSITY, "rowIndex": RING.astype(np.uint16)}
    fields["columnIndex"] = COLUMN.astype(np.uint16)
    with pye57.E57(str(path), mode="w") as file:
        quarter = np.array([np.sqrt(0.5), 0, 0, np.sqrt(0.5)])
        file.write_scan_raw(fields, rotation=quarter, translation=np.array([10.0, 20.0, 30.0]))


def write_structured(path: Path) -> None:
    fields = {"x": XYZ[:, 0], "y": XYZ[:, 1], "z": XYZ[:, 2], "intensity": INTENSITY, "ring": RING}
    np.save(path, np.rec.fromarrays(list(fields.values()), names=list(fields)))


WRITERS = {
    "pcd": ("a.pcd", write_tensor),
    "ply": ("a.ply", write_tensor),
    "las": ("a.las", write_las),
    "e57": ("a.e57", write_e57),
    "kitti": ("a.bin", lambda path: TABLE[:, :4].tofile(path)),
    "nuscenes": ("a.pcd.bin", lambda path: TABLE.tofile(path)),
    "numpy": ("a.npy", write_structured),
}


def quiet(what: str, done: int, total: int) -> None:
    """No progress."""


def points_of(found) -> dict[str, np.ndarray]:
    (sweeps,) = found.sweeps
    assert np.isnan(sweeps.time_s).all()
    assert list(sweeps.read(np.array([False]))) == []
    (turn,) = sweeps.read(np.array([True]))
    return turn.points


@pytest.mark.parametrize("kind", WRITERS)
def test_every_format_comes_back_as_written(kind, tmp_path):
    name, write = WRITERS[kind]
    write(tmp_path / name)
    options = Options(lidar="velodyne_vlp16" if kind == "kitti" else None)  # or an XT16
    found = READERS[kind].read([tmp_path / name], options, quiet)
    points = points_of(found)
    xyz = np.stack([points[axis] for axis in "xyz"], axis=1)
    np.testing.assert_allclose(xyz, XYZ, atol=1e-6)
    np.testing.assert_array_equal(points["ring"], RING)
    np.testing.assert_array_equal(points["column"], COLUMN)
    np.testing.assert_array_equal(points["intensity"], INTENSITY)
    assert found.sweeps[0].name == "a"


def test_laz_is_las(tmp_path):
    write_las(tmp_path / "a.laz")
    points = points_of(READERS["las"].read([tmp_path / "a.laz"], Options(), quiet))
    np.testing.assert_array_equal(points["ring"], RING)
    assert (tmp_path / "a.laz").stat().st_size < 30 * len(RING)  # it was compressed


def test_numpy_arrays_of_any_shape(tmp_path):
    np.save(tmp_path / "flat.npy", TABLE)
    np.save(tmp_path / "grid.npy", TABLE[:, :3].reshape(16, 90, 3))
    np.savez(tmp_path / "points.npz", points=TABLE[:, :3], ring=RING, intensity=INTENSITY)
    np.savez(tmp_path / "one.npz", TABLE)
    for name in ("flat.npy", "grid.npy", "points.npz", "one.npz"):
        points = points_of(READERS["numpy"].read([tmp_path / name], Options(), quiet))
        np.testing.assert_array_equal(points["ring"], RING)
        np.testing.assert_array_equal(points["column"], COLUMN)
    np.save(tmp_path / "wide.npy", np.zeros((5, 9)))
    np.savez(tmp_path / "no.npz", a=np.zeros(3), b=np.zeros(3))
    for name in ("wide.npy", "no.npz"):
        with pytest.raises(InputError, match=name):
            READERS["numpy"].read([tmp_path / name], Options(), quiet)


def test_an_organised_pcd_has_its_rings_in_rows(tmp_path):
    head = "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 90\nHEIGHT 16\n"
    head += "VIEWPOINT 0 0 0 1 0 0 0\nPOINTS 1440\nDATA binary\n"
    (tmp_path / "a.pcd").write_bytes(head.encode() + XYZ.tobytes())
    found = READERS["pcd"].read([tmp_path / "a.pcd"], Options(), quiet)
    np.testing.assert_array_equal(points_of(found)["ring"], RING)
    assert any("rows of the cloud" in line for line in found.understood)


def test_every_file_is_a_stop_of_one_layout(tmp_path):
    for k in range(3):
        TABLE.tofile(tmp_path / f"{k}.pcd.bin")
    files = sorted(tmp_path.glob("*.bin"))
    found = READERS["nuscenes"].read(files, Options(), quiet)
    assert [sweeps.name for sweeps in found.sweeps] == ["0", "1", "2"]
    np.savez(tmp_path / "a.npz", points=POINTS, ring=RING)
    np.savez(tmp_path / "b.npz", points=POINTS, channel=RING)
    with pytest.raises(InputError, match=r"b\.npz lacks the field ring"):
        READERS["numpy"].read([tmp_path / "a.npz", tmp_path / "b.npz"], Options(), quiet)


def test_the_scans_of_an_e57_know_where_their_scanner_stood(tmp_path):
    write_e57(tmp_path / "a.e57")
    (scan,) = read_e57_scans(tmp_path / "a.e57")
    assert scan.posed
    np.testing.assert_allclose(scan.pose[:3, 3], [10, 20, 30])
    with pye57.E57(str(tmp_path / "a.e57")) as file:  # pye57 applies the pose itself
        placed = file.read_scan(0, ignore_missing_fields=True)
    expected = np.stack([placed[f"cartesian{axis}"] for axis in "XYZ"], axis=1)
    np.testing.assert_allclose(scan.xyz_in_file(), expected, atol=1e-9)
    np.testing.assert_allclose(scan.xyz_in_file()[:, 2], POINTS[:, 2] + 30, atol=1e-9)


@pytest.mark.parametrize("kind", WRITERS)
@pytest.mark.parametrize("part", [0.0, 0.02, 0.7])
def test_a_file_cut_short_is_one_sentence(kind, part, tmp_path):
    name, write = WRITERS[kind]
    path = tmp_path / name
    write(path)
    data = path.read_bytes()
    path.write_bytes(data[: int(part * len(data)) | (part > 0)])
    with pytest.raises(InputError) as told:
        READERS[kind].read([path], Options(), quiet)
    assert name in str(told.value) and "\n" not in str(told.value)


@pytest.mark.parametrize("kind", WRITERS)
def test_a_file_that_is_not_there_or_something_else_is_one_sentence(kind, tmp_path):
    name, _ = WRITERS[kind]
    with pytest.raises(InputError, match=name):
        READERS[kind].read([tmp_path / name], Options(), quiet)
    (tmp_path / name).write_bytes(b"this is no cloud at all, only a line of text" * 9 + b".")
    with pytest.raises(InputError, match=name):
        READERS[kind].read([tmp_path / name], Options(), quiet)
