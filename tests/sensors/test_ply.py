"""PLY: every type, either byte order, text, lists of unequal lengths; against trimesh's reader."""

import numpy as np
import pytest

from chains.errors import InputError
from sensors.ply import read_ply, write_ply

TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2",
    "int": "i4", "uint": "u4", "float": "f4", "double": "f8",
}  # fmt: skip
ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}


def extremes(kind):
    """The least and the greatest value of a type, and some between."""
    dtype = np.dtype(kind)
    if dtype.kind == "f":
        return np.array([np.finfo(dtype).min, -1 / 3, 0, 1e-30, np.finfo(dtype).max], dtype)
    info = np.iinfo(dtype)
    return np.array([info.min, info.min // 2, 0, info.max // 3, info.max], dtype)


@pytest.mark.parametrize("order", ORDERS)
def test_every_type_is_read_as_it_is(tmp_path, order):
    columns = {name: extremes(kind) for name, kind in TYPES.items()}
    header = f"ply\r\nformat {order} 1.0\r\ncomment by hand\r\nelement vertex 5\r\n"
    header += "".join(f"property {name} {name}\r\n" for name in TYPES) + "end_header\r\n"
    if order == "ascii":
        rows = zip(*(values.tolist() for values in columns.values()), strict=True)
        body = "\n".join(" ".join(repr(value) for value in row) for row in rows).encode()
    else:
        records = np.empty(5, [(n, ORDERS[order] + kind) for n, kind in TYPES.items()])
        for name, values in columns.items():
            records[name] = values
        body = records.tobytes()
    path = tmp_path / "all.ply"
    path.write_bytes(header.encode() + body)
    found = read_ply(path)["vertex"]
    for name, values in columns.items():
        assert found[name].dtype == values.dtype
        assert np.array_equal(found[name], values)


@pytest.mark.parametrize("order", ORDERS)
def test_polygons_of_any_number_of_corners_keep_their_properties(tmp_path, order):
    polygons = [[0, 1, 2], [0, 1, 2, 3], [3, 2, 1], [4, 3, 2, 1, 0], [0, 1, 2]]
    header = f"ply\nformat {order} 1.0\nelement extra 2\nproperty short a\nelement face 5\n"
    header += "property uchar before\nproperty list uchar int vertex_indices\n"
    header += "property ushort after\nelement last 1\nproperty float f\nend_header\n"
    if order == "ascii":
        rows = [f"{k} {len(p)} {' '.join(map(str, p))} {500 + k}" for k, p in enumerate(polygons)]
        body = "\n".join(["-7", "8", *rows, "0.5"]).encode()
    else:
        o = ORDERS[order]
        body = np.array([-7, 8], o + "i2").tobytes()
        for k, polygon in enumerate(polygons):
            body += bytes([k, len(polygon)]) + np.array(polygon, o + "i4").tobytes()
            body += np.array([500 + k], o + "u2").tobytes()
        body += np.array([0.5], o + "f4").tobytes()
    path = tmp_path / "polygons.ply"
    path.write_bytes(header.encode() + body)
    found = read_ply(path)
    assert found["extra"]["a"].tolist() == [-7, 8]
    assert [[v for v in row if v >= 0] for row in found["face"]["vertex_indices"].tolist()] == (
        polygons
    )
    assert found["face"]["before"].tolist() == [0, 1, 2, 3, 4]
    assert found["face"]["after"].tolist() == [500, 501, 502, 503, 504]
    assert found["last"]["f"].tolist() == [0.5]


def test_what_is_written_is_read_by_others_and_back(tmp_path):
    import trimesh

    rng = np.random.default_rng(0)
    vertex = dict(zip("xyz", rng.normal(size=(3, 9)) + 5e5, strict=True))
    vertex |= {"ring": np.arange(9, dtype=np.uint16), "seen": np.arange(9) % 2 == 0}
    corners = rng.integers(0, 9, (4, 3))
    path = tmp_path / "mesh.ply"
    label = np.arange(4, dtype=np.uint16)
    write_ply(path, {"vertex": vertex, "face": {"vertex_indices": corners, "label": label}})
    back = read_ply(path)
    assert back["vertex"]["ring"].dtype == np.uint16
    for name, values in vertex.items():
        assert np.array_equal(back["vertex"][name], values)
    assert np.array_equal(back["face"]["vertex_indices"], corners)
    theirs = trimesh.load_mesh(path, process=False)
    assert np.array_equal(theirs.vertices, np.stack([vertex[axis] for axis in "xyz"], axis=1))
    assert np.array_equal(theirs.faces, corners)
    assert np.array_equal(theirs.metadata["_ply_raw"]["face"]["data"]["label"].ravel(), label)


def test_whole_numbers_that_would_be_rounded_are_refused(tmp_path):
    path = tmp_path / "big.ply"
    write_ply(path, {"vertex": {"t": np.array([2**53, 2**40])}})
    assert read_ply(path)["vertex"]["t"].tolist() == [2.0**53, 2.0**40]
    with pytest.raises(InputError, match=r"t has whole numbers beyond 2\^53"):
        write_ply(path, {"vertex": {"t": np.array([2**53 + 1])}})
    assert read_ply(path)["vertex"]["t"].tolist() == [2.0**53, 2.0**40]


HEADER = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nend_header\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"empty \(0 bytes\)"),
        ("hello", "no PLY file"),
        (HEADER.replace("end_header\n", ""), "no PLY file"),
        (HEADER, "ends too early: 0 of 3 rows"),
        (HEADER + "1\n2\n", "ends too early: 2 of 3 rows"),
        (HEADER + "1\nx\n3\n", "ends too early: 1 of 3 rows"),
        (HEADER.replace("float", "string"), "`property string x` is no line of a PLY header"),
        (HEADER.replace("vertex 3", "vertex"), "`element vertex` is no line"),
        (HEADER.replace("ascii", "binary"), "`format binary 1.0` is no line"),
        (HEADER.replace("format ascii 1.0\n", ""), "no line `format`"),
    ],
)
def test_a_broken_file_is_refused_in_one_sentence(tmp_path, text, message):
    path = tmp_path / "broken.ply"
    path.write_text(text)
    with pytest.raises(InputError, match=f"broken.ply.*{message}"):
        read_ply(path)


def test_a_binary_file_cut_anywhere_is_refused(tmp_path):
    path = tmp_path / "whole.ply"
    corners = np.zeros((2, 3), int)
    write_ply(path, {"vertex": {"x": np.zeros(2)}, "face": {"vertex_indices": corners}})
    whole = path.read_bytes()
    assert len(read_ply(path)["face"]["vertex_indices"]) == 2
    for length in range(len(whole)):
        path.write_bytes(whole[:length])
        with pytest.raises(InputError):
            read_ply(path)
