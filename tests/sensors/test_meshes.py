"""Clouds through the Open3D door: fields kept, broken files refused in silence."""

import numpy as np
import pytest

from chains.errors import InputError
from sensors.meshes import open3d_cloud, read_cloud, write_cloud

KINDS = ("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")


def cloud(count=11):
    rng = np.random.default_rng(0)
    columns = dict(zip("xyz", 4e5 + rng.normal(size=(3, count)), strict=True))
    columns |= {f"field_{kind}": np.arange(count).astype(kind) for kind in KINDS}
    return columns | {"ring": np.arange(count, dtype=np.uint16)}


@pytest.mark.parametrize("suffix", [".ply", ".pcd"])
def test_every_field_is_kept_in_its_type(tmp_path, suffix):
    path, columns = tmp_path / f"cloud{suffix}", cloud()
    normal = {name: np.full(11, i, np.float32) for i, name in enumerate(("nx", "ny", "nz"))}
    colour = {name: np.full(11, i, np.uint8) for i, name in enumerate(("red", "green", "blue"))}
    columns |= normal | colour
    write_cloud(path, columns)
    found = read_cloud(path)
    assert found.keys() == columns.keys()
    for name, values in columns.items():
        same = name not in normal or suffix == ".ply"  # Open3D has normals like positions
        assert found[name].dtype == (values.dtype if same else np.float64), name
        assert np.array_equal(found[name], values), name


def test_a_pcd_as_pcl_writes_it_is_read(tmp_path):
    """With padding between the fields, and as text."""
    header = (
        "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z _ intensity ring\nSIZE 4 4 4 1 4 2\n"
        "TYPE F F F U F U\nCOUNT 1 1 1 4 1 1\nWIDTH 3\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\n"
        "POINTS 3\nDATA "
    )
    records = np.zeros(3, [("p", "f4", 3), ("_", "u1", 4), ("i", "f4"), ("r", "u2")])
    records["p"], records["i"], records["r"] = np.arange(9).reshape(3, 3), [7, 8, 9], [0, 1, 300]
    path = tmp_path / "pcl.pcd"
    path.write_bytes(f"{header}binary\n".encode() + records.tobytes())
    found = read_cloud(path)
    assert set(found) == {"x", "y", "z", "intensity", "ring"}
    assert found["ring"].tolist() == [0, 1, 300]
    assert found["z"].tolist() == [2, 5, 8]
    path.write_text(
        header.replace("_ ", "").replace("4 1 4 2", "4 4 2").replace("F U F U", "F F U")
        .replace("1 4 1 1", "1 1 1") + "ascii\n0 1 2 7 0\n3 4 5 8 1\n6 7 8 9 300\n"
    )  # fmt: skip
    assert read_cloud(path)["ring"].tolist() == [0, 1, 300]


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("no.pcd", None, "cannot be read: No such file"),
        ("zero.pcd", b"", r"empty \(0 bytes\)"),
        ("junk.pcd", bytes(range(256)) * 9, "no PCD file"),
        ("half.pcd", "half", "should hold 11 points, but they cannot be read"),
        ("cloud.xyzzy", b"1", r"read from a .ply or .pcd file, not '.xyzzy'"),
    ],
)
def test_a_broken_cloud_is_refused_in_silence(tmp_path, capfd, name, content, message):
    path = tmp_path / name
    if content == "half":
        write_cloud(path, cloud())
        content = path.read_bytes()[:-30]
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match=f"{name}.*{message}"):
        read_cloud(path)
    assert capfd.readouterr() == ("", "")


def test_a_cloud_becomes_open3ds_with_its_attributes():
    columns = cloud()
    made = open3d_cloud(columns)
    assert np.array_equal(made.point["positions"].numpy()[:, 1], columns["y"])
    assert made.point["ring"].numpy().dtype == np.uint16
    assert np.array_equal(made.point["ring"].numpy().ravel(), columns["ring"])
