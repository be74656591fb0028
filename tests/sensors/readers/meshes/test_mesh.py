"""Meshes with labels: files made by trimesh or by hand, of a room whose triangles are known."""

from pathlib import Path

import numpy as np
import pytest

from chains.errors import InputError
from sensors.ply import write_ply
from sensors.readers.base import Options
from sensors.readers.meshes.labels import Palette, labels_of_colours, most_frequent
from sensors.readers.meshes.mesh import read_meshes

RED, BLUE, GREY = (200, 30, 30), (30, 30, 200), (120, 120, 120)


def read(*paths, **options):
    """The mesh reader without anyone to be told of progress."""
    return read_meshes([Path(p) for p in paths], Options(**options), lambda *_: None)


@pytest.fixture(scope="module")
def room():
    """A box of 8 x 6 x 3 m, 192 triangles."""
    import trimesh

    return trimesh.creation.box((8, 6, 3)).subdivide().subdivide()


@pytest.fixture
def textured(room, tmp_path):
    """The same, red where x < 0 and blue elsewhere, from a JPEG; and which triangles are red."""
    from PIL import Image
    from trimesh import Trimesh
    from trimesh.visual import TextureVisuals

    image = np.full((256, 256, 3), BLUE, np.uint8)
    image[:, :128] = RED
    Image.fromarray(image).save(tmp_path / "paint.jpg", quality=75)
    uv = room.vertices[:, :2] / (8.2, 6.2) + 0.5
    visual = TextureVisuals(uv=uv, image=Image.open(tmp_path / "paint.jpg"))
    mesh = Trimesh(room.vertices, room.faces, process=False, visual=visual)
    return mesh, room.triangles_center[:, 0] < 0


def corners(surface):
    """Corners (F, 3, 3) of all triangles."""
    return surface.vertices_m[surface.triangles]


@pytest.mark.parametrize("suffix", [".obj", ".glb"])
def test_a_texture_of_few_colours_is_labels(textured, tmp_path, suffix):
    mesh, red = textured
    path = tmp_path / f"room{suffix}"
    mesh.export(path)
    found = read(path, up="z")
    names = [found.surface.names[n] for n in found.surface.label]
    assert len(set(names)) == 2
    for name, is_red in zip(names, red, strict=True):
        rgb = np.array(list(bytes.fromhex(name.removeprefix("colour_#"))))
        assert np.linalg.norm(rgb - (RED if is_red else BLUE)) < 12
    np.testing.assert_allclose(corners(found.surface), mesh.triangles, atol=1e-6)


def test_a_palette_names_colours_and_what_is_far_from_all_is_unlabelled(textured, tmp_path):
    mesh, red = textured
    mesh.export(tmp_path / "room.obj")
    for name, text in (
        ("pal.yaml", "brick: '#c81e1e'\npaint: [30, 30, 200]\n"),
        ("pal.csv", "name,red,green,blue\nbrick,200,30,30\npaint,30,30,200\n"),
        ("hex.csv", "name,colour\nbrick,#c81e1e\npaint,#1e1ec8\n"),
    ):
        (tmp_path / name).write_text(text)
        surface = read(tmp_path / "room.obj", metadata=tmp_path / name).surface
        assert [surface.names[n] for n in surface.label] == [
            "brick" if is_red else "paint" for is_red in red
        ]
    (tmp_path / "one.yaml").write_text("brick: '#c81e1e'\n")
    found = read(tmp_path / "room.obj", metadata=tmp_path / "one.yaml")
    assert found.surface.names == {0: "brick", 1: "unlabelled"}
    assert np.array_equal(found.surface.label == 0, red)
    assert any(f"{(~red).sum()} of 192 triangles have no label" in line for line in found.odd)
    (tmp_path / "bad.yaml").write_text("brick: reddish\n")
    with pytest.raises(InputError, match=r"bad.yaml: brick: 'reddish' is no colour"):
        read(tmp_path / "room.obj", metadata=tmp_path / "bad.yaml")


def test_a_photograph_is_no_palette():
    rng = np.random.default_rng(0)
    grey = rng.normal(120, 30, (5000, 4, 1)).clip(0, 255).astype(np.uint8).repeat(3, 2)
    assert labels_of_colours(grey, Palette()) is None
    flat = np.array([RED, BLUE, GREY], np.uint8)[rng.integers(0, 3, 5000)]
    noisy = flat[:, None] + rng.integers(-3, 4, (5000, 4, 3))
    labels = labels_of_colours(noisy.astype(np.uint8), Palette())
    assert len(labels.names) == 3
    assert all(len(np.unique(flat[labels.label == n], axis=0)) == 1 for n in labels.names)


def test_the_most_frequent_of_equals_is_the_first():
    rows = np.array([[1, 2, 2], [3, 1, 2], [2, 2, 1], [5, 5, 5]])
    assert most_frequent(rows).tolist() == [2, 3, 2, 5]


def ply(path, room, vertex=(), face=()):
    """The room as PLY with further columns."""
    xyz = dict(zip("xyz", room.vertices.T, strict=True))
    corners = {"vertex_indices": room.faces}
    write_ply(path, {"vertex": xyz | dict(vertex), "face": corners | dict(face)})
    return path


def test_numbers_per_face_are_labels_and_intensity_is_kept(room, tmp_path):
    number = np.arange(192) % 3 * 100
    bright = np.linspace(0, 1, 192)
    path = ply(tmp_path / "a.ply", room, face={"scalar_Label": number, "Intensity": bright})
    surface = read(path).surface
    assert np.array_equal(surface.label, number)
    assert surface.names == {0: "label_0", 100: "label_100", 200: "label_200"}
    assert np.array_equal(surface.intensity, bright)
    (tmp_path / "names.yaml").write_text("0: floor\n100: wall\n")
    named = read(path, metadata=tmp_path / "names.yaml").surface.names
    assert named == {0: "floor", 100: "wall", 200: "label_200"}


def test_numbers_per_vertex_go_by_majority_and_intensity_by_mean(room, tmp_path):
    number = (room.vertices[:, 2] > 0).astype(np.float32) * 4
    bright = room.vertices[:, 0].copy()
    path = ply(tmp_path / "a.ply", room, vertex={"class": number, "intensity": bright})
    surface = read(path).surface
    above = (room.vertices[:, 2] > 0)[room.faces].sum(axis=1) >= 2
    assert np.array_equal(surface.label, np.where(above, 4, 0))
    np.testing.assert_allclose(surface.intensity, room.triangles_center[:, 0], atol=1e-12)


def test_what_was_given_no_label_is_said(room, tmp_path):
    number = np.where(np.arange(192) < 10, -1, 3)
    found = read(ply(tmp_path / "a.ply", room, face={"label": number}))
    assert found.surface.names == {3: "label_3", 4: "unlabelled"}
    assert (found.surface.label == 4).sum() == 10
    assert any("10 of 192 triangles have no label" in line for line in found.odd)
    with pytest.raises(InputError, match=r"a.ply: property label: its labels are no whole numbers"):
        read(ply(tmp_path / "a.ply", room, face={"label": number + 0.5}))


def test_materials_are_labels_by_name(room, tmp_path):
    lines = [f"v {x} {y} {z}" for x, y, z in room.vertices]
    for k, face in enumerate(room.faces + 1):
        lines += [f"usemtl {'foam' if k < 50 else 'wood'}"] if k in (0, 50) else []
        lines.append("f {} {} {}".format(*face))
    (tmp_path / "a.mtl").write_text("newmtl foam\nKd 1 0 0\nnewmtl wood\nKd 0 1 0\n")
    (tmp_path / "a.obj").write_text("\n".join(["mtllib a.mtl", *lines]))
    surface = read(tmp_path / "a.obj").surface
    area = {n: (surface.label == k).sum() for k, n in surface.names.items()}
    assert area == {"foam": 50, "wood": 142}
    first = {tuple(np.round(c, 6).ravel()) for c in room.triangles[:50]}
    foam = next(k for k, name in surface.names.items() if name == "foam")
    assert {tuple(np.round(c, 6).ravel()) for c in corners(surface)[surface.label == foam]} == first


def test_several_files_are_labels_by_file(room, tmp_path):
    room.export(tmp_path / "shell.stl")
    table = room.copy().apply_scale(0.1)
    table.export(tmp_path / "table.stl")
    surface = read(tmp_path / "shell.stl", tmp_path / "table.stl").surface
    assert surface.names == {0: "shell", 1: "table"}
    assert np.array_equal(surface.label, np.repeat([0, 1], 192))
    np.testing.assert_allclose(
        corners(surface), np.concatenate([room.triangles, table.triangles]), atol=1e-6
    )


def test_units_and_axes_are_decided_by_flags(room, tmp_path):
    big = room.copy().apply_scale(1000)
    big.export(tmp_path / "mm.stl")
    with pytest.raises(InputError, match=r"mm.stl is 8000 units wide.*--length-unit mm"):
        read(tmp_path / "mm.stl")
    found = read(tmp_path / "mm.stl", length_unit="mm")
    np.testing.assert_allclose(corners(found.surface), room.triangles, atol=1e-6)
    up = corners(read(tmp_path / "mm.stl", length_unit="mm", up="y").surface)
    x, y, z = np.moveaxis(room.triangles, -1, 0)
    np.testing.assert_allclose(up, np.stack([x, -z, y], axis=-1), atol=1e-6)


def test_gltf_is_turned_to_z_up_aloud(room, tmp_path):
    room.export(tmp_path / "a.glb")
    found = read(tmp_path / "a.glb")
    assert np.ptp(found.surface.vertices_m, axis=0).tolist() == [8, 3, 6]
    assert any("y up, turned to z up (x, -z, y) as glTF has it" in u for u in found.understood)


def test_far_from_the_origin_doubles_are_kept_and_floats_are_odd(room, tmp_path):
    far = room.copy().apply_translation([5e5 + 0.123, 4e6 + 0.456, 100])
    far.export(tmp_path / "far.obj", digits=6)
    found = read(tmp_path / "far.obj")
    np.testing.assert_allclose(corners(found.surface), far.triangles, atol=1e-6)
    assert not any("precision" in line for line in found.odd)
    assert any("4031 km from its origin" in line for line in found.understood)
    far.export(tmp_path / "far.stl")
    assert any("rounded to 250.0 mm" in line for line in read(tmp_path / "far.stl").odd)


def test_no_labels_are_said(room, tmp_path):
    room.export(tmp_path / "a.stl")
    found = read(tmp_path / "a.stl")
    assert found.surface.label is None
    assert any("a.stl has neither labels, colours nor materials" in line for line in found.odd)


@pytest.mark.parametrize("suffix", [".obj", ".glb", ".stl", ".ply"])
def test_broken_files_are_one_sentence(room, tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    with pytest.raises(InputError, match=f"a{suffix} does not exist"):
        read(path)
    path.write_bytes(b"")
    with pytest.raises(InputError, match=rf"a{suffix} is empty \(0 bytes\)"):
        read(path)
    room.export(path)
    whole = path.read_bytes()
    for content in (b"hello", bytes(range(256)) * 20, whole[: len(whole) // 2]):
        path.write_bytes(content)
        with pytest.raises(InputError, match=f"a{suffix}"):
            read(path)


def test_indices_and_corners_that_cannot_be_are_refused(room, tmp_path):
    wrong = room.faces.copy()
    wrong[7, 1] = len(room.vertices)
    path = ply(tmp_path / "a.ply", room)
    xyz = dict(zip("xyz", room.vertices.T, strict=True))
    write_ply(path, {"vertex": xyz, "face": {"vertex_indices": wrong}})
    with pytest.raises(InputError, match=r"a.ply: a triangle has a vertex that is none of 0 to 97"):
        read(path)
    xyz["y"] = np.where(np.arange(98) == 5, np.nan, xyz["y"])
    write_ply(path, {"vertex": xyz, "face": {"vertex_indices": room.faces}})
    with pytest.raises(InputError, match=r"a.ply: a triangle has a corner that is not finite"):
        read(path)
    write_ply(path, {"vertex": xyz})
    with pytest.raises(InputError, match=r"a.ply has 98 points and no triangles.*survey"):
        read(path)
