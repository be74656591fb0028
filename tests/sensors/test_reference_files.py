"""The reference as files: meshes, faces and labels, read or refused."""

from pathlib import Path

import numpy as np
import pytest

from chains.errors import InputError
from sensors.reference import Reference

REAL = Path(__file__).parents[3] / "shared/data/recordings/known_nothing_hidden/reference"


# ---- files

PLY = """ply
format ascii 1.0
element vertex 4
property double x
property double y
property double z
element face 2
property list uchar int vertex_indices
end_header
500000.0000001 0 0
500001.0000002 0 0
500001 1 0.0000003
500000 1 0
3 0 1 2
3 0 2 3
"""
OBJ = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3\nf 1 3 4\n"
STL = """solid plate
facet normal 0 0 1
outer loop
vertex 0 0 0
vertex 1 0 0
vertex 1 1 0
endloop
endfacet
facet normal 0 0 1
outer loop
vertex 0 0 0
vertex 1 1 0
vertex 0 1 0
endloop
endfacet
endsolid plate
"""


def written(folder, name, text):
    path = folder / name
    path.write_text(text)
    return path


def test_a_ply_in_doubles_is_read_in_doubles(tmp_path):
    reference = Reference.read(written(tmp_path, "mesh.ply", PLY))
    assert reference.vertices_m[1, 0] == 500001.0000002
    assert reference.vertices_m[2, 2] == 0.0000003
    assert np.array_equal(reference.triangles, [[0, 1, 2], [0, 2, 3]])


@pytest.mark.parametrize(("name", "text"), [("mesh.obj", OBJ), ("mesh.stl", STL)])
def test_other_formats_keep_triangles_in_order(tmp_path, name, text):
    reference = Reference.read(written(tmp_path, name, text))
    middle = reference.vertices_m[reference.triangles].mean(axis=1)
    assert np.allclose(middle, [[2 / 3, 1 / 3, 0], [1 / 3, 2 / 3, 0]], atol=1e-6)
    assert len(np.unique(reference.surface)) == 1


def test_faces_and_labels_are_read_with_the_mesh(tmp_path):
    from sensors.recording import write_table

    mesh = written(tmp_path, "mesh.ply", PLY)
    faces = tmp_path / "faces.parquet"
    write_table(faces, {"label": np.array([4, 1], np.uint16), "intensity": np.array([0.5, 0.25])})
    labels = written(tmp_path, "labels.yaml", "1: floor\n4: foam\n")
    reference = Reference.read(mesh, faces, labels)
    assert np.array_equal(reference.label, [4, 1])
    assert np.array_equal(reference.intensity, [0.5, 0.25])
    assert reference.label_names == {1: "floor", 4: "foam"}


def test_faces_of_another_mesh_are_refused(tmp_path):
    from sensors.recording import write_table

    mesh, faces = written(tmp_path, "mesh.ply", PLY), tmp_path / "faces.parquet"
    write_table(faces, {"label": np.zeros(3, np.uint16)})
    with pytest.raises(InputError, match=r"mesh.ply with .*faces.parquet: label has .*2 triangles"):
        Reference.read(mesh, faces)
    write_table(faces, {"colour": np.zeros(2)})
    with pytest.raises(InputError, match=r"faces.parquet: .*neither"):
        Reference.read(mesh, faces)


def test_labels_that_are_no_numbers_are_refused(tmp_path):
    mesh, labels = written(tmp_path, "mesh.ply", PLY), written(tmp_path, "l.yaml", "floor: 1\n")
    with pytest.raises(InputError, match=r"l.yaml: each line should read"):
        Reference.read(mesh, labels=labels)


def test_a_file_that_is_no_mesh_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"none.ply: no such mesh"):
        Reference.read(tmp_path / "none.ply")
    cloud = PLY.split("element face")[0] + "end_header\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n"
    for name, text in (("cloud.ply", cloud), ("noise.ply", "hello"), ("mesh.xyzzy", OBJ)):
        with pytest.raises(InputError, match=rf"{name}: no triangles in it"):
            Reference.read(written(tmp_path, name, text))


SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=float)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"triangles": [[0, 1, 4]]}, "names vertex 4, but the vertices are 0 to 3"),
        ({"triangles": [[0, 1, -1]]}, "names vertex -1"),
        ({"triangles": np.zeros((0, 3))}, r"triangles have shape \(0, 3\)"),
        ({"vertices_m": SQUARE[:, :2]}, r"vertices have shape \(4, 2\)"),
        ({"vertices_m": np.where(SQUARE == 1, np.nan, 0)}, "vertex 1 of the mesh is not finite"),
        ({"triangles": [[0, 1, 1]]}, "no triangle with an area"),
        ({"label": [1, 2]}, "label has shape"),
        ({"intensity": [[1.0]]}, "intensity has shape"),
        ({"label": [-1]}, "a label is no whole number"),
        ({"label": [1.5]}, "a label is no whole number"),
        ({"label": [np.nan]}, "a label is no whole number"),
    ],
)
def test_arrays_that_do_not_fit_are_refused(change, message):
    good = {"vertices_m": SQUARE, "triangles": [[0, 1, 2]]}
    Reference(**good)
    with pytest.raises(InputError, match=message):
        Reference(**(good | change))


# ---- a recording made by others


@pytest.mark.skipif(not REAL.is_dir(), reason="the shared recordings are not beside the checkout")
def test_a_furnished_room_has_tens_of_surfaces():
    """Twenty-three boxes and slabs, their sides divided into up to 2048 triangles."""
    reference = Reference.read(REAL / "mesh.ply", REAL / "faces.parquet", REAL / "labels.yaml")
    assert reference.label_names[3] == "wallpaper"
    directions = np.random.default_rng(0).normal(size=(20000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    hits = reference.cast([0.4, 0.5, 1.2], directions)
    assert np.all(hits.triangle >= 0)
    assert len(reference.surface) > 40000
    assert 6 <= len(np.unique(reference.surface[hits.triangle])) <= 60
    assert len(np.unique(reference.surface)) < 200
    for surface in np.unique(reference.surface):
        assert len(np.unique(reference.label[reference.surface == surface])) == 1
