"""What the workbench draws: points on their surfaces, rigs where they stood, colours that tell."""

import shutil

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from calib.runs.run import Run
from calib.show.scale import round_up
from calib.view.scene import Points, Scene, camera, sunk
from calib.view.shown import colours
from calib.view.shown.colours import RISING, SIGNED, coloured
from chains.errors import InputError
from sensors.recording import read_table, write_table
from tests.calib import rigs
from tests.calib.viewed import small_run


@pytest.fixture(scope="module")
def run(once) -> Run:
    return Run.open(once(small_run) / "run")


@pytest.fixture(scope="module")
def scene(run) -> Scene:
    return Scene.of(run)


@pytest.fixture
def copied(run, tmp_path) -> Run:
    shutil.copytree(run.folder, tmp_path / "run")
    return Run.open(tmp_path / "run")


def cloud(xyz_m: np.ndarray, **columns: np.ndarray) -> Points:
    count = len(xyz_m)
    given = {"weight": np.ones(count), "residual_m": np.zeros(count), **columns}
    return Points(np.asarray(xyz_m, float), np.zeros(3), given, count)


def off_mesh_m(scene: Scene, xyz_m: np.ndarray) -> np.ndarray:
    """Distance of points from the mesh, as Open3D has it."""
    open3d = pytest.importorskip("open3d")
    mesh = scene.sources[0].reference
    caster = open3d.t.geometry.RaycastingScene()
    caster.add_triangles(mesh.vertices_m.astype(np.float32), mesh.triangles.astype(np.uint32))
    return caster.compute_distance(xyz_m.astype(np.float32)).numpy()


# ------------------------------------------------------------------------------------------ points


def test_points_lie_off_the_mesh_by_their_residual(scene):
    for stop in scene.stops(0):
        points = scene.points(0, stop)
        residual, incidence = (points.columns[n] for n in ("residual_m", "incidence_rad"))
        expected = np.abs(residual) * np.cos(incidence)
        off = np.abs(off_mesh_m(scene, points.xyz_m) - expected)[points.inlier]
        assert np.quantile(off, 0.9) < 2e-5  # but beside edges, where another face is nearer
        assert points.inlier.mean() > 0.8


def test_points_lie_on_the_beams_of_the_scan(scene):
    stop = scene.stops(0)[1]
    points, source = scene.points(0, stop), scene.sources[0]
    scan = source.recording.scan(source.recording.stops.index(stop))
    row = {key: i for i, key in enumerate(zip(scan.ring, scan.column, strict=True))}
    keys = zip(points.columns["ring"], points.columns["column"], strict=True)
    pose = RigidTransform.from_matrix(scene.place(0, stop, source.rig.lidar_frame))
    scanned = pose.apply(scan.xyz_m[[row[key] for key in keys]])
    assert source.rig.lidar.beam_origin_m[0]  # so that beams do not all start in one point
    mine, theirs = (pose.inv().apply(xyz_m) for xyz_m in (points.xyz_m, scanned))
    turned = np.arctan2(
        np.cross(mine, theirs)[:, 2], np.einsum("ni,ni->n", mine[:, :2], theirs[:, :2])
    )
    assert np.abs(turned).max() < 1e-5
    ring_m = scene.run.solution.shared.effects["ring_range_offset"].estimate
    longer_m = np.linalg.norm(theirs, axis=1) - np.linalg.norm(mine, axis=1)
    # What is left is by how much the fit moved the surface, millimetres at most.
    assert np.quantile(np.abs(longer_m - ring_m[points.columns["ring"]]), 0.99) < 4e-3
    assert np.abs(ring_m).mean() > 0.01


def test_a_stop_without_a_table_is_said(copied):
    (copied.folder / "residuals.parquet" / "L00P01.parquet").unlink()
    scene = Scene.of(copied)
    assert scene.points(0, "L00P00") is not None
    with pytest.raises(InputError, match="the run is incomplete, fit it again"):
        scene.points(0, "L00P01")


def test_a_table_of_another_version_is_said(copied):
    path = copied.folder / "residuals.parquet" / "L00P00.parquet"
    write_table(path, {n: v for n, v in read_table(path).items() if n != "weight"})
    with pytest.raises(InputError, match="has no column weight; fit the run again"):
        Scene.of(copied).points(0, "L00P00")


@pytest.mark.parametrize("most", [1, 7, 99, 100, 1000])
def test_as_many_points_are_drawn_as_may_be_from_all_over(most):
    shown = cloud(np.random.default_rng(0).normal(size=(100, 3))).drawn(most=most)
    assert len(shown) <= most and len(shown) >= min(100, most) / 2
    assert len(set(shown)) == len(shown) and np.ptp(shown) >= 50 * (most > 1)


def test_points_above_the_height_are_not_drawn():
    points = cloud(np.random.default_rng(0).normal(size=(100, 3)))
    assert (points.xyz_m[points.drawn(0.5), 2] < 0.5).all()
    assert len(points.drawn(0.5)) == (points.xyz_m[:, 2] < 0.5).sum()


def test_a_click_picks_the_point_under_it_and_the_nearest_of_two():
    rng = np.random.default_rng(1)
    points = cloud(rng.uniform(2, 6, size=(300, 3)))
    every = np.arange(300)
    for wanted in (0, 17, 299):
        eye = np.array([-1.0, 0.5, 1.0])
        found = points.picked(every, eye, 3.0 * (points.xyz_m[wanted] - eye))
        reach = points.xyz_m - eye
        off = np.linalg.norm(np.cross(reach, reach[wanted]), axis=1)
        off /= np.linalg.norm(reach, axis=1) ** 2 * np.linalg.norm(reach[wanted]) / 1.0
        assert found == wanted or (
            np.linalg.norm(reach[found]) < np.linalg.norm(reach[wanted]) and off[found] < 0.01
        )
    line = cloud([[4.0, 0, 0], [2.0, 0, 0], [3.0, 0.001, 0], [-1.0, 0, 0]])
    assert line.picked(np.arange(4), np.zeros(3), [1, 0, 0]) == 1
    assert line.picked(np.array([0, 2, 3]), np.zeros(3), [1, 0, 0]) == 2
    assert line.picked(np.arange(4), np.zeros(3), [0, 1, 0]) is None
    assert line.picked(np.arange(0), np.zeros(3), [0, 1, 0]) is None


# -------------------------------------------------------------------------------------- rig, room


def test_bodies_stand_where_the_tracker_saw_them(scene):
    source = scene.sources[0]
    world = RigidTransform.from_matrix(scene.state[source.rig.reference_frame])
    for k, stop in enumerate(scene.stops(0)):
        for body in source.rig.tracker.bodies:
            x, y, z, *quat = source.recording.bodies[body][k]
            placed = world * RigidTransform.from_matrix(scene.place(0, stop, body))
            assert np.linalg.norm(placed.translation - [x, y, z]) < 2e-3
            turned = placed.rotation.inv() * Rotation.from_quat(quat, scalar_first=True)
            assert turned.magnitude() < 3e-3


def test_links_join_the_frames_and_the_arm_is_a_chain(scene):
    stop = scene.stops(0)[2]
    links, arm = scene.links(0, stop)
    frames = scene.frames(0, stop)
    np.testing.assert_allclose(links[arm][0, 0], frames["arm_base"][:3, 3], atol=1e-12)
    np.testing.assert_allclose(links[arm][-1, 1], frames["arm_end"][:3, 3], atol=1e-12)
    np.testing.assert_allclose(links[arm][:-1, 1], links[arm][1:, 0], atol=1e-5)
    ends = links[~arm][:, 1]
    for name in ("mount", "lidar", "base_markers"):
        assert np.linalg.norm(ends - frames[name][:3, 3], axis=1).min() < 1e-9


def test_the_room_faces_the_lidar(scene):
    vertices, triangles = scene.room(0)
    eye = scene.place(0, scene.stops(0)[0], "lidar")[:3, 3]
    a, b, c = np.moveaxis(vertices[triangles], 1, 0)
    assert (np.einsum("ni,ni->n", np.cross(b - a, c - a), eye - a) >= 0).all()
    wanted = np.sort(scene.sources[0].reference.triangles, axis=1)
    np.testing.assert_array_equal(np.sort(triangles, axis=1), wanted)


def test_a_sunk_box_is_larger_by_the_depth_on_every_side():
    vertices, triangles = rigs.room()
    a, b, c = np.moveaxis(vertices[triangles], 1, 0)
    away = np.einsum("ni,ni->n", np.cross(b - a, c - a), vertices.mean(axis=0) - a) < 0
    triangles = np.where(away[:, None], triangles[:, ::-1], triangles)
    moved = sunk(vertices, triangles, 0.01)
    inner = ((vertices > 1e-6) & (vertices < rigs.ROOM_M - 1e-6)).sum(axis=1) == 2
    np.testing.assert_allclose(np.linalg.norm(moved - vertices, axis=1), 0.01, atol=1e-9)
    outside = np.abs(moved - rigs.ROOM_M / 2) - rigs.ROOM_M / 2
    np.testing.assert_allclose(outside[inner].max(axis=1), 0.01, atol=1e-9)
    assert (outside.max(axis=1) > 0.004).all()


def test_the_whole_box_is_in_the_picture():
    rng = np.random.default_rng(2)
    for _ in range(50):
        low = rng.normal(0, 10, 3)
        high = low + rng.uniform(0.1, 20, 3)
        angle = rng.uniform(0.2, 1.2)
        eye, target = camera(low, high, angle)
        corners = np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(3, -1).T - eye
        axis = (target - eye) / np.linalg.norm(target - eye)
        along = corners @ axis
        beside = np.linalg.norm(corners - along[:, None] * axis, axis=1)
        assert (along > 0).all() and (np.arctan2(beside, along) < 0.75 * angle).all()
        assert eye[2] > high[2] - (high[2] - low[2])


def test_what_a_run_was_fitted_to_must_be_there(copied, tmp_path):
    from sensors.documents import read_yaml, write_yaml

    model = read_yaml(copied.folder / "model.yaml")[0]
    model["recordings"][0]["path"] = str(tmp_path / "gone")
    write_yaml(copied.folder / "model.yaml", model)
    with pytest.raises(InputError, match="is no longer there; put it back"):
        Scene.of(Run.open(copied.folder))


def test_a_state_of_another_model_is_said(copied):
    state = {n: v for n, v in copied.state().items() if not n.startswith("root@L00P01")}
    np.savez(copied.folder / "state.npz", **{f"state/{n}": v for n, v in state.items()})
    with pytest.raises(InputError, match="its state lacks 'root@L00P01'; fit the run again"):
        Scene.of(copied)


# ---------------------------------------------------------------------------------------- colours


def test_residuals_are_coloured_symmetrically_about_grey():
    residual = np.array([-0.05, -0.002, 0.0, 0.002, 0.05, np.nan])
    colour, scale = coloured(cloud(np.zeros((6, 3)), residual_m=residual), "residual_m", {})
    assert (scale.low, scale.high, scale.unit) == (-50.0, 50.0, "mm")
    assert np.ptp(colour[2].astype(int)) < 20  # grey
    assert colour[0][2] > colour[0][0] and colour[4][0] > colour[4][2]  # blue and red
    assert tuple(colour[0]) == tuple(bytes.fromhex(SIGNED[0][1:]))
    assert tuple(colour[4]) == tuple(bytes.fromhex(SIGNED[-1][1:]))


def test_other_numbers_grow_brighter():
    at = np.linspace(0, 1, 50)
    colour, scale = coloured(cloud(np.zeros((50, 3)), incidence_rad=at), "incidence_rad", {})
    assert scale.unit == "deg" and np.rad2deg(0.9) < scale.high <= np.rad2deg(1.0)
    brightness = colour @ [0.2126, 0.7152, 0.0722]
    assert (np.diff(brightness) > -1.5).all() and np.ptp(brightness) > 100
    assert len(RISING) == len(scale.stops)


def test_labels_have_names_and_colours_of_their_own():
    labels = np.array([2, 0, 2, 5])
    colour, scale = coloured(
        cloud(np.zeros((4, 3)), label=labels), "label", {0: "floor", 2: "wall"}
    )
    assert list(scale.names) == ["floor", "wall", "label 5"] and scale.low is None
    assert (colour[0] == colour[2]).all() and len({tuple(c) for c in colour}) == 3


@pytest.mark.parametrize(
    "value, wanted", [(0.0, 1), (0.3, 0.5), (1.0, 1), (1.01, 2), (4.2, 5), (70, 100), (2e-4, 2e-4)]
)
def test_limits_are_round(value, wanted):
    assert round_up(value) == pytest.approx(wanted)


def test_columns_without_a_number_are_not_offered():
    points = cloud(
        np.zeros((3, 3)), intensity=np.full(3, np.nan), patch=np.ones(3), dust=np.ones(3)
    )
    assert colours.choices(points) == ["residual_m", "weight", "dust"]
