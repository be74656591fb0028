"""Effects of beams, arm, mount, tracker and targets, against the geometry that they stand for."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from calib.diagnosis.candidates import finer
from calib.effects import View, find
from calib.problem.model import Source
from calib.rig import load_rig
from calib.rig.columns import stop_columns, tracked_poses
from calib.simulation import PRESETS, simulate
from chains import se3
from chains.errors import InputError
from sensors.lidar import beams

from . import rigs
from .hidden import FLAWLESS, coarse, hide, placed, stops_of
from .simulated import changed, made, nominal, pose, seen


@pytest.fixture(scope="module")
def source(tmp_path_factory) -> Source:
    return hide(tmp_path_factory.mktemp("geometry") / "rec", "range_offset", 0.0)[0]


# ------------------------------------------------------------------------------------------ beams


@pytest.mark.parametrize("origin_m", [(0.0, 0.0), (0.03, 0.01)])
@pytest.mark.parametrize("off_m", [(1e-4, 0.0), (0.0, 1e-4), (-7e-5, 5e-5)])
def test_a_beam_that_starts_elsewhere_reads_elsewhere(source, origin_m, off_m):
    """The sensor refers range to its centre: it measures range - H cos(elevation) from the start
    of the beam, and its driver lays the point there with the H and B that it believes in."""
    rng = np.random.default_rng(0)
    azimuth, elevation = rng.uniform(-3, 3, 200), rng.uniform(-1.0, 1.0, 200)
    range_m = rng.uniform(0.5, 6.0, 200)
    ahead = np.stack([np.cos(azimuth), np.sin(azimuth), 0 * azimuth], axis=1)
    left = np.stack([-np.sin(azimuth), np.cos(azimuth), 0 * azimuth], axis=1)
    direction = np.cos(elevation)[:, None] * ahead
    direction[:, 2] = np.sin(elevation)

    def point(H, B):
        from_start = range_m - H * np.cos(elevation)
        return H * ahead + B * left + from_start[:, None] * direction

    told = beams(point(*origin_m), origin_m)
    true = beams(point(*np.add(origin_m, off_m)), origin_m)
    error = np.stack(
        [
            told.range_m - true.range_m,
            np.angle(np.exp(1j * (told.azimuth_rad - true.azimuth_rad))),
            told.elevation_rad - true.elevation_rad,
        ],
        axis=1,
    )
    rig = replace(source.rig, lidar=replace(source.rig.lidar, beam_origin_m=np.array(origin_m)))
    columns = {"range_m": true.range_m, "elevation_rad": true.elevation_rad}
    basis = find("beam_origin_offset").basis(View(rig, 200, columns, np.zeros((1, 6))))
    np.testing.assert_allclose(basis @ off_m, error, atol=2e-7)
    assert np.abs(error).max() > 5e-5


def test_ring_offsets_turn_their_ring_only(source):
    columns = {"ring": np.array([3, 0, 3])}
    view = View(source.rig, 3, columns, np.zeros((1, 6)))
    for name, axis in (("ring_range", 0), ("ring_azimuth", 1), ("ring_elevation", 2)):
        found = find(f"{name}_offset").basis(view)
        np.testing.assert_array_equal(found.index, [3, 0, 3])
        np.testing.assert_array_equal(found.values, np.tile(np.eye(3)[axis], (3, 1)))


@pytest.mark.parametrize(
    ("name", "columns", "expected"),
    [
        ("range_cyclic@2", {"range_m": [0.5, 1.0]}, [[1, 0], [0, -1]]),
        ("range_step@2", {"range_m": [1.9, 2.1]}, [[0], [1]]),
        ("near_range_bias@0.5", {"range_m": [0.5, 1.0]}, [[np.exp(-1)], [np.exp(-2)]]),
        ("incidence_angle_bias", {"incidence_rad": [0, np.pi / 3]}, [[0], [1]]),
        (
            "intensity_range_walk",
            {"intensity": [np.e, np.nan, 0, 0.1, 2.6]},  # of the median
            [[1], [0], [-np.log(100)], [-np.log(10)], [np.log(2.6)]],
        ),
        ("warmup_drift@100", {"elapsed_s": [0, 100]}, [[0], [1 - np.exp(-1)]]),
        ("temperature_drift", {"temperature_c": [21.5, np.nan]}, [[1.5], [0]]),
        ("range_quantisation", {"range_m": [1.0013, 1.0133]}, [[-0.0013], [0.0067]]),
    ],
)
def test_range_errors_are_what_their_formulas_say(source, name, columns, expected):
    columns = {k: np.array(v, float) for k, v in columns.items()}
    view = View(coarse(source.rig), len(expected), columns, np.zeros((1, 6)))
    found = find(name).basis(view)
    assert not found[:, 1:].any()
    np.testing.assert_allclose(found[:, 0], expected, atol=1e-12)


@pytest.mark.parametrize(
    ("name", "axis", "columns", "expected"),
    [
        ("range_offset", 0, {}, [[1]]),
        ("range_scale", 0, {"range_m": [2.0, np.inf]}, [[2], [0]]),
        ("azimuth_range_harmonic", 0, {"azimuth_rad": [np.pi / 2]}, [[1, 0, 0, -1, -1, 0, 0, 1]]),
        ("elevation_scale", 2, {"elevation_rad": [0.3]}, [[0.3]]),
        ("encoder_eccentricity", 1, {"azimuth_rad": [np.pi / 6]}, [[0.5, np.sqrt(0.75)]]),
        ("encoder_second_harmonic", 1, {"azimuth_rad": [np.pi / 12]}, [[0.5, np.sqrt(0.75)]]),
        ("spin_axis_wobble", 2, {"azimuth_rad": [np.pi / 12]}, [[0.5, np.sqrt(0.75)]]),
        ("near_range_azimuth@2", 1, {"range_m": [2.0, 4.0]}, [[np.exp(-1)], [np.exp(-2)]]),
    ],
)
def test_beam_errors_are_what_their_formulas_say(source, name, axis, columns, expected):
    columns = {k: np.array(v, float) for k, v in columns.items()}
    found = find(name).basis(View(source.rig, len(expected), columns, np.zeros((1, 6))))
    np.testing.assert_allclose(found[:, axis], expected, atol=1e-12)
    assert np.count_nonzero(found) == np.count_nonzero(found[:, axis])


# -------------------------------------------------------------------------------------------- arm


def test_a_slip_is_a_step_creep_goes_with_time_and_what_settles_comes_to_rest(source):
    twist = np.array([1e-3, -2e-3, 3e-3, 1e-3, 2e-3, -1e-3])
    elapsed_s = source.columns["elapsed_s"]
    names = ("slip@300", "creep", "settle@200")
    slipped, crept, settled = (placed(source, f"mount_{n}", twist) for n in names)
    rested = 1 - np.exp(-elapsed_s / 200)
    assert 0 < (elapsed_s > 300).sum() < len(elapsed_s)
    for k, joints in enumerate(source.recording.joints):
        mount = nominal(source, "mount", joints)
        beyond = mount.inv() * nominal(source, "lidar", joints)
        shares = elapsed_s[k] > 300, elapsed_s[k] / 3600, rested[k]
        for found, share in zip((slipped, crept, settled), shares, strict=True):
            expected = mount * RigidTransform.from_exp_coords(twist * share) * beyond
            np.testing.assert_allclose(found[k], expected.as_matrix(), atol=1e-12)


def test_a_zero_that_slips_is_another_zero_from_then_on(source):
    offset = np.array([1e-3, -2e-3, 3e-3, -1e-3, 2e-3, 1e-3])
    late = source.columns["elapsed_s"] > 300
    assert 0 < late.sum() < len(late)
    found = placed(source, "arm_joint_slip@300", offset)
    zeroed, plain = (placed(source, "arm_joint_offset", x) for x in (offset, 0 * offset))
    np.testing.assert_allclose(found[late], zeroed[late], atol=1e-12)
    np.testing.assert_allclose(found[~late], plain[~late], atol=1e-12)
    assert np.abs(zeroed - plain).max() > 1e-4


@pytest.mark.parametrize("name", ["tracker_slip@300", "tracker_creep", "tracker_settle@200"])
def test_a_tracker_that_moves_moves_all_that_it_sees(source, name):
    """In its own axes: what is seen at ``T_opti_body`` is said to be at ``exp(theta) T``."""
    tracked = tracked_poses(source.rig, source.recording)
    stops = stops_of(source, tracked=tracked)
    elapsed_s = stops["elapsed_s"]
    share = {
        "tracker_slip@300": elapsed_s > 300,
        "tracker_creep": elapsed_s / 3600,
        "tracker_settle@200": 1 - np.exp(-elapsed_s / 200),
    }[name]
    twist = np.array([1e-3, -2e-3, 3e-3, 1e-3, 2e-3, -1e-3])
    found = np.nan_to_num(tracked) @ se3.exp(find(name).basis(stops) @ twist)
    expected = np.stack([RigidTransform.from_exp_coords(twist * s).as_matrix() for s in share])
    seen_there = np.isfinite(tracked).all(axis=(2, 3))
    expected = expected[:, None] @ np.nan_to_num(tracked)
    np.testing.assert_allclose(found[seen_there], expected[seen_there], atol=1e-12)


def test_a_tracker_moves_only_where_something_else_tells_where_the_base_is(source):
    """It cannot be told from a base that stands elsewhere at every stop, but by a LiDAR."""
    without = replace(source.rig, lidar=None, lidar_frame=None)
    for name in ("tracker_slip", "tracker_creep", "tracker_settle"):
        assert source.rig.moves == "stop" and len(find(name).params(source.rig)) == 6
        assert find(name).params(without) == ()
        assert len(find(name).params(replace(without, moves="never"))) == 6
        assert find(name).params(replace(source.rig, tracker=None)) == ()


def test_links_grow_with_the_temperature(source):
    alpha = 1e-3
    found = placed(source, "arm_thermal_growth", alpha)
    warmer = source.columns["temperature_c"] - 20
    for k, joints in enumerate(source.recording.joints):
        edges = []
        for edge in source.rig.tree.edges:
            T = edge.T_parent_child.copy()
            if edge.name in source.rig.arm_edges:
                T[:3, 3] *= 1 + alpha * warmer[k]
            edges.append(replace(edge, T_parent_child=T))
        grown = replace(source, rig=replace(source.rig, tree=type(source.rig.tree)(edges)))
        expected = nominal(grown, "lidar", joints).as_matrix()
        np.testing.assert_allclose(found[k], expected, atol=1e-12)


@pytest.mark.parametrize(
    ("name", "error"),
    [
        ("arm_joint_scale", lambda q: q),
        ("arm_gear_error@7", lambda q: np.sin(7 * q)),
        ("arm_joint_eccentricity", np.sin),
    ],
)
def test_joint_errors_are_what_their_formulas_say(source, name, error):
    params = [p.name for p in find(name).params(source.rig)]
    theta = np.zeros(len(params))
    theta[next(i for i, p in enumerate(params) if p in ("joint_3", "joint_3.sin"))] = 0.01
    for k, joints in enumerate(source.recording.joints):
        turned = joints + 0.01 * error(joints[2]) * np.eye(6)[2]
        expected = nominal(source, "lidar", turned).as_matrix()
        np.testing.assert_allclose(placed(source, name, theta)[k], expected, atol=1e-12)


def test_backlash_follows_the_way_each_joint_came(source):
    joints = np.array([[0.0, 1, 0, 0, 0, 0], [0.2, 1, 0, 0, 0, 0], [0.1, 2, 0, 0, 0, 0]])
    columns = stop_columns(source.rig, joints, np.array([50.0, 900.0, 400.0]), {})
    np.testing.assert_array_equal(columns["moved.joint_1"], [0, 1, 1])
    np.testing.assert_array_equal(columns["moved.joint_2"], [0, -1, 1])
    np.testing.assert_allclose(columns["travel.joint_1"], [0, 0.1, 0.1])
    np.testing.assert_allclose(columns["travel.joint_2"], [0, -1, 1])
    np.testing.assert_array_equal(columns["elapsed_s"], [0, 850, 350])
    np.testing.assert_array_equal(columns["waited.s"], [0, 500, 350])
    np.testing.assert_array_equal(columns["joint_2"], [1, 1, 2])
    basis = find("arm_backlash").basis(View(source.rig, 3, columns, joints))
    np.testing.assert_array_equal(basis[1], np.diag([1, -1, 0, 0, 0, 0]))
    basis = find("arm_joint_lag").basis(View(source.rig, 3, columns, joints))
    np.testing.assert_allclose(basis[1], np.diag([0.1, -1, 0, 0, 0, 0]))


# --------------------------------------------------------------------- tracker, targets, reference


def test_the_tracker_stretches_and_bends_where_it_sees(source):
    view, stretch = stops_of(source), 0.01
    for b, body in enumerate(source.rig.tracker.bodies):
        by = {n: find(f"optitrack_{n}").basis(view)[:, b] for n in ("scale", "distortion")}
        names = [p.name for p in find("optitrack_distortion").params(source.rig)]
        for k in range(view.rows):
            T = seen(source, body, k)
            found = T * RigidTransform.from_exp_coords(by["scale"][k, :, 0] * stretch)
            np.testing.assert_allclose(found.translation, 1.01 * T.translation, atol=1e-12)
            np.testing.assert_allclose(found.rotation.as_matrix(), T.rotation.as_matrix())
            c = np.zeros(18)
            c[names.index("y.xz")] = 0.02
            found = T * RigidTransform.from_exp_coords(by["distortion"][k] @ c)
            x, _, z = T.translation / 3
            moved = found.translation - T.translation
            np.testing.assert_allclose(moved, [0, 0.02 * x * z, 0], atol=1e-12)


def test_what_is_not_seen_is_not_stretched(tmp_path):
    source, _ = made(tmp_path / "rec", changed(FLAWLESS, occluded_share=0.5, lidar=None, targets=0))
    poses = tracked_poses(source.rig, source.recording)
    hidden = np.isnan(source.recording.bodies["mount_markers"][:, 0])
    assert 0 < hidden.sum() < len(hidden)
    np.testing.assert_array_equal(np.isnan(poses[:, 1, :3]).any(axis=(1, 2)), hidden)
    basis = find("optitrack_scale").basis(stops_of(source))
    assert not basis[hidden, 1].any() and basis[~hidden, 1].any() and basis[:, 0].any()


def test_points_are_turned_as_they_lie_together(tmp_path):
    spec = changed(PRESETS["laser-tracker"], noise=0, build_error=0, occluded_share=0)
    source, truth = made(tmp_path / "rec", spec)
    poses = tracked_poses(source.rig, source.recording)
    T_opti_faro = pose(truth["T_faro_opti"]).inv()
    for k, (stop, at) in enumerate(truth["stops"].items()):
        assert stop == source.recording.stops[k]
        for b, body in enumerate(source.rig.tracker.bodies):
            on_paper = nominal(source, body, source.recording.joints[k])
            expected = T_opti_faro * pose(at["T_faro_root"]) * on_paper
            np.testing.assert_allclose(poses[k, b], expected.as_matrix(), atol=1e-8)
    for body in source.rig.tracker.bodies[1:]:
        source.recording.bodies[body][:] = np.nan
    alone = tracked_poses(source.rig, source.recording)
    assert np.isnan(alone[:, :, :3, :3]).all()
    assert not find("optitrack_scale").basis(stops_of(replace(source))).any()


def test_spheres_hang_lower_and_rods_askew(source):
    view = View(source.rig, 5, {}, np.zeros((1, 0)))
    lower = find("target_sphere_offset").basis(view) @ [0.001]
    askew = find("target_rod_tilt").basis(view) @ [0.01, -0.02]
    np.testing.assert_allclose(lower, [[0, 0, -0.001]])
    np.testing.assert_allclose(askew, [[0.0018, -0.0036, 0]])


def test_the_mesh_is_stretched_about_its_origin(source):
    columns = {"point_m": np.array([[1.0, -2, 3], [np.inf] * 3])}
    found = find("faro_scale").basis(View(source.rig, 2, columns, np.zeros((1, 6))))
    np.testing.assert_array_equal(found @ [1e-3], [[1e-3, -2e-3, 3e-3], [0, 0, 0]])


def test_scanned_points_lie_further_from_the_nearest_station(source):
    stations = ((-2.0, 0.0, 1.0), (2.0, 0.0, 1.0))
    rig = replace(source.rig, reference=replace(source.rig.reference, scanner_m=stations))
    point_m = np.array([[-2.0, 3.0, 1.0], [2.5, 0.0, 1.0], [np.nan] * 3, stations[0]])
    effect = find("faro_range_offset")
    found = effect.basis(View(rig, 4, {"point_m": point_m}, np.zeros((1, 6)))) @ [0.002]
    np.testing.assert_allclose(found, [[0, 0.002, 0], [0.002, 0, 0], [0, 0, 0], [0, 0, 0]])
    nowhere = replace(rig, reference=replace(rig.reference, scanner_m=()))
    assert effect.of_scanner and effect.params(rig) and not effect.params(nowhere)


def test_the_mesh_is_moved_as_a_rigid_body_and_the_spheres_are_not(source):
    effect, twist = find("mesh_shift"), np.array([3e-3, -1e-3, 2e-3, 1e-5, -3e-5, 2e-5])
    point_m = np.random.default_rng(0).normal(size=(6, 3))
    view = View(source.rig, 6, {"point_m": point_m}, np.zeros((1, 6)))
    T = se3.exp(np.r_[twist[3:], twist[:3]])
    moved = point_m @ T[:3, :3].T + T[:3, 3] - point_m
    np.testing.assert_allclose(effect.basis(view) @ twist, moved, atol=1e-7)
    assert not effect.of_scanner and find("faro_scale").of_scanner


def test_the_mesh_alone_is_strained_as_by_any_affine_map(source):
    rng = np.random.default_rng(0)
    point_m, shift_m, rates = rng.normal(size=(6, 3)), rng.normal(size=3), rng.normal(size=(3, 3))
    view = View(source.rig, 6, {"point_m": point_m}, np.zeros((1, 6)))
    strain, scale = find("mesh_strain"), find("mesh_scale")
    names = [param.name for param in strain.params(source.rig)]
    given = dict(zip(("tx", "ty", "tz"), shift_m, strict=True))
    given |= {f"{a}{b}": rates[i, j] for i, a in enumerate("xyz") for j, b in enumerate("xyz")}
    found = strain.basis(view) @ [given[name] for name in names]
    np.testing.assert_allclose(found, point_m @ rates.T + shift_m)
    np.testing.assert_allclose(scale.basis(view) @ [1e-3], 1e-3 * point_m)
    for effect in (strain, scale):
        assert not effect.of_scanner and not effect.twin
        no_mesh = replace(source.rig, reference=replace(source.rig.reference, mesh=None))
        no_targets = replace(source.rig, target=None)
        assert not effect.params(no_mesh) and not effect.params(no_targets)


@pytest.mark.parametrize("name", ["mesh_seam_x", "mesh_seam_y"])
def test_the_mesh_is_moved_beyond_a_seam_alone(source, name):
    effect = find(name).at(0.5)
    axis = "xyz".index(name[-1])
    point_m = np.random.default_rng(0).normal(size=(40, 3))
    view = View(source.rig, 40, {"point_m": point_m}, np.zeros((1, 6)))
    beyond = point_m[:, axis] > 0.5
    expected = find("mesh_shift").basis(view) * beyond[:, None, None]
    np.testing.assert_array_equal(effect.basis(view), expected)
    assert 0 < beyond.sum() < 40 and not effect.of_scanner and not effect.twin
    # Seams lie inside the mesh, and those beside one to either side of it.
    low, high = -4.0 + axis, 4.0
    box_m = np.array([[[-4.0, -3.0, -1.0], [4.0, 4.0, 2.0]]])
    stops = View(source.rig, 1, {"mesh_box_m": box_m}, np.zeros((1, 6)))
    grid = np.array(find(name).shapes(stops))
    np.testing.assert_allclose(grid, low + (high - low) * np.array([0.25, 0.5, 0.75]))
    near = np.array(find(name).at(grid[0]).beside(stops))
    assert (near < grid[0]).any() and (near > grid[0]).any() and (near > low).all()
    middle, fine = find(name).at(grid[1]), grid.tolist()
    for _ in range(middle.refinements):
        fine = [one.shape for one in finer(middle, fine)]
    assert np.diff(fine).max() < 0.01 * (high - low) and grid[1] in fine
    assert not effect.shapes(View(source.rig, 1, {}, np.zeros((1, 6))))


def test_labels_have_names_and_only_theirs_move(source, tmp_path):
    labels = source.rig.labels
    assert labels[0] == "floor" and list(labels) == sorted(labels)
    columns = {"label": np.array([2, -1, 0, 77]), "normal": np.eye(4)[:, :3]}
    view = View(source.rig, 4, columns, np.zeros((1, 6)))
    for name in ("label_range_offset", "moved_surface"):
        found = find(name).basis(view)
        np.testing.assert_array_equal(found.index, [2, -1, 0, -1])
        assert find(name).params(source.rig)[2].name == f"2_{labels[2]}"
    simulate(FLAWLESS, tmp_path / "rec", 0)
    path = tmp_path / "rec/reference/labels.yaml"
    path.write_text("4: four\n1: one\n")
    rig = load_rig(tmp_path / "rec")
    assert list(rig.labels.items()) == [(1, "one"), (4, "four")]
    found = find("moved_surface").basis(
        replace(view, rig=rig, columns=columns | {"label": np.array([4, 2, 1, -1])})
    )
    np.testing.assert_array_equal(found.index, [1, -1, 0, -1])
    path.write_text("floor: 0\n")
    with pytest.raises(InputError, match=r"labels\.yaml.*number: name"):
        load_rig(tmp_path / "rec")


def test_a_mesh_without_names_has_no_labels(tmp_path):
    assert load_rig(rigs.write(tmp_path / "box")).labels == {}
