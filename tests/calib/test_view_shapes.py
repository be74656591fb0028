"""The arm's own shapes on the workbench: meshes of the recording, in the frames of its links."""

from dataclasses import replace

import numpy as np
import pytest

from calib.rig import Rig, load_rig
from calib.rig.shapes import PACKAGE
from calib.runs.run import Run
from calib.view.scene import Scene
from calib.view.shown.drawn import drawn_shapes
from calib.view.stage import RIG_PATH
from tests.calib.viewed import small_run
from tests.calib.workbench import shown

# A tetrahedron with one corner at the origin and three a metre away, its faces turned outwards.
STL = "solid t\n{}endsolid t\n".format(
    "".join(
        "facet normal 0 0 0\nouter loop\n"
        + "".join(f"vertex {x} {y} {z}\n" for x, y, z in face)
        + "endloop\nendfacet\n"
        for face in (
            ((0, 0, 0), (0, 1, 0), (1, 0, 0)),
            ((0, 0, 0), (1, 0, 0), (0, 0, 1)),
            ((0, 0, 0), (0, 0, 1), (0, 1, 0)),
            ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
        )
    )
)


@pytest.fixture(scope="module")
def run(once) -> Run:
    return Run.open(once(small_run) / "run")


@pytest.fixture(scope="module")
def rig(once) -> Rig:
    return load_rig(once(small_run) / "rec")


def with_meshes(rig: Rig, folder, file: str, kind: str = "visual", scale: str = "1 1 1") -> Rig:
    """The rig in another folder, with the same mesh for every link of its arm."""
    mesh = f'<geometry><mesh filename="{file}" scale="{scale}"/></geometry>'
    part = f'<{kind}><origin xyz="1 2 3" rpy="0 0 1.5707963267948966"/>{mesh}</{kind}>'
    text = rig.arm_urdf.read_text()
    for name in {"arm_base", "arm_end"}:
        text = text.replace(f'<link name="{name}"/>', f'<link name="{name}"></link>')
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "arm.urdf").write_text(text.replace("</link>", part + "</link>"))
    return replace(rig, folder=folder, arm_urdf=folder / "arm.urdf")


def put(folder, *names: str) -> None:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(STL)


def links_of(rig: Rig) -> list[str]:
    edges = [edge for edge in rig.tree.edges if edge.name in rig.arm_edges]
    return [edges[0].parent, *(edge.child for edge in edges)]


def volume_m3(shape) -> float:
    """Of what the faces enclose; positive where they are turned outwards."""
    a, b, c = np.moveaxis(shape.vertices_m[shape.triangles], 1, 0)
    return float(np.einsum("ni,ni->n", a, np.cross(b, c)).sum() / 6)


@pytest.mark.parametrize("scale", [(1e-3, 1e-3, 1e-3), (-0.5, 2, 1)])
def test_a_mesh_stands_where_the_urdf_puts_it_in_its_link(rig, tmp_path, scale):
    put(tmp_path, "meshes/part.stl")
    mine = with_meshes(rig, tmp_path, "meshes/part.stl", scale=" ".join(map(str, scale)))
    shapes, why = drawn_shapes(mine)
    assert why == ""
    assert sorted(shape.link for shape in shapes) == sorted(links_of(rig))
    x, y, z = scale
    # A quarter turn about z carries x to y and y to -x; then the shift.
    wanted = {(1, 2, 3), (1, 2 + x, 3), (1 - y, 2, 3), (1, 2, 3 + z)}
    for shape in shapes:
        found = {tuple(map(float, v)) for v in np.round(shape.vertices_m, 9)}
        assert found == {tuple(map(float, v)) for v in np.round(list(wanted), 9)}
        assert volume_m3(shape) == pytest.approx(abs(x * y * z) / 6)


@pytest.mark.parametrize("place", ["arm_description/meshes/part.stl", "meshes/part.stl"])
def test_a_mesh_of_a_package_lies_in_the_recording_with_or_without_its_name(rig, tmp_path, place):
    put(tmp_path, place)
    mine = with_meshes(rig, tmp_path, f"{PACKAGE}arm_description/meshes/part.stl")
    shapes, why = drawn_shapes(mine)
    assert why == "" and len(shapes) == len(links_of(rig))


@pytest.mark.parametrize("file", ["../part.stl", "{outside}/part.stl", "file://{outside}/part.stl"])
def test_a_mesh_outside_of_the_recording_is_not_read(rig, tmp_path, file):
    put(tmp_path, "part.stl")
    mine = with_meshes(rig, tmp_path / "rec", file.format(outside=tmp_path))
    shapes, why = drawn_shapes(mine)
    assert not shapes
    assert why.startswith("Drawn as lines: arm_base (the recording has no ")


def test_what_is_lacking_is_told_once_and_links_without_meshes_are_not_lacking(rig, tmp_path):
    assert drawn_shapes(rig) == ([], "")
    mine = with_meshes(rig, tmp_path, f"{PACKAGE}arm/meshes/part.stl")
    others = len(links_of(rig)) - 1
    assert drawn_shapes(mine) == (
        [],
        "Drawn as lines: arm_base (the recording has no 'meshes/part.stl'), and so are "
        f"{others} more links.",
    )


def test_what_is_to_be_collided_with_stands_in_for_what_cannot_be_read(rig, tmp_path):
    put(tmp_path, "part.stl", "part.dae")
    seen = with_meshes(rig, tmp_path, "part.dae")
    assert "a mesh is read from" in drawn_shapes(seen)[1]
    both = with_meshes(seen, tmp_path, "part.stl", kind="collision")
    shapes, why = drawn_shapes(both)
    assert why == "" and len(shapes) == len(links_of(rig))


@pytest.mark.long
def test_shapes_are_drawn_in_the_place_of_lines(run, rig, tmp_path, monkeypatch):
    put(tmp_path, "part.stl")
    mine = with_meshes(rig, tmp_path, "part.stl", scale="0.1 0.1 0.1")
    monkeypatch.setattr("calib.view.stage.drawn_shapes", lambda _: drawn_shapes(mine))
    scene, links = Scene.of(run), links_of(rig)
    assert not scene.links(0, scene.stops(0)[0], links)[1].any()
    assert scene.links(0, scene.stops(0)[0], links[:-1])[1].sum() == 1
    with shown(run.folder) as (watched, page):
        stage, stop = page.picture.stage, scene.stops(0)[1]
        page.picture._step(1)
        for i, shape in enumerate(stage._shapes):
            node = stage.client.scene.get_handle_by_name(f"{RIG_PATH}/shape{i}")
            at_m = scene.place(0, stop, shape.link)[:3, 3] - stage._middle_m
            np.testing.assert_allclose(node.position, at_m, atol=1e-6)
        assert stage.client.scene.get_handle_by_name(f"{RIG_PATH}/arm") is None
        assert watched.page.get_by_text("Drawn as lines").count() == 0
