"""What gives way under its load, against the slope of the potential energy."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

import calib
from calib.diagnosis.candidates import NO_MASSES, lacking
from calib.effects import CATALOGUE, View, find
from calib.problem.build import stops_view
from calib.problem.model import Source
from calib.rig.columns import recorded_columns, stop_columns
from calib.simulation import Spec, load_spec
from chains.errors import InputError

from . import rigs, two_arms
from .hidden import hide, placed, stops_of
from .simulated import changed, made


@pytest.fixture(scope="module")
def source(tmp_path_factory) -> Source:
    return hide(tmp_path_factory.mktemp("elastic") / "rec", "range_offset", 0.0)[0]


def height_energy(source: Source, joints: np.ndarray, twists: np.ndarray | None = None):
    """Potential energy (K,) J of what weighs on the arm, by where each link's centre is."""
    energy = 0.0
    for mass in source.rig.masses:
        T = source.rig.tree.place(mass.frame, joints, twists).Ts_root_frame
        energy = energy + 9.80665 * mass.kg * (T @ np.append(mass.centre_m, 1.0))[:, 2]
    return energy


def test_joints_sag_along_gravity(source):
    """The torque is the slope of the potential energy, downhill."""
    joints, step = source.recording.joints, 1e-5
    basis = find("arm_gravity_sag").basis(stops_of(source))
    for j in range(joints.shape[1]):
        nudge = step * np.eye(joints.shape[1])[j]
        slope = height_energy(source, joints + nudge) - height_energy(source, joints - nudge)
        np.testing.assert_allclose(basis[:, j, j], -slope / (2 * step), atol=1e-6)
    assert np.abs(basis[:, 1, 1]).max() > 5  # N m, at the shoulder
    np.testing.assert_allclose(basis[:, 0, 0], 0, atol=1e-9)  # its axis is upright


@pytest.mark.parametrize("name", ["arm_gravity_sag", "base_flex"])
def test_weights_pull_where_levels_say_that_down_is(source, name):
    """The base leans otherwise at every stop; the slope of the height along up, downhill."""
    joints, tree, rng = source.recording.joints, source.rig.tree, np.random.default_rng(3)
    up = np.array([0.0, 0.0, 1.0]) + 0.2 * rng.normal(size=(len(joints), 3))
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    basis = find(name).basis(stops_of(source, up=up))

    def energy(twist, step):
        total = 0.0
        for mass in source.rig.masses:
            T = tree.transform(mass.frame, joints + step, twist)
            at = (T @ np.append(mass.centre_m, 1.0))[:, :3]
            total = total + 9.80665 * mass.kg * np.vecdot(at, up)
        return total

    edge, nothing = tree.edge_names.index("arm_base"), np.zeros(joints.shape[1])
    for axis in (0, 1):
        twist, step = np.zeros((1, len(tree.edges), 6)), np.zeros(joints.shape[1])
        if name == "base_flex":
            twist[0, edge, axis] = 1e-5
            found = basis[:, edge, axis, axis]
        else:
            step[axis] = 1e-5
            found = basis[:, axis, axis]
        slope = energy(twist, nothing + step) - energy(-twist, nothing - step)
        np.testing.assert_allclose(found, -slope / 2e-5, atol=1e-5)
    assert np.abs(basis[:, 0] if name == "arm_gravity_sag" else basis).max() > 1


def test_a_payload_weighs_at_the_tip(source):
    joints, kg = source.recording.joints, np.linspace(0, 2, len(source.recording.stops))
    kg[0] = np.nan
    effect = find("arm_gravity_sag")
    more = effect.basis(stops_of(source, payload_kg=kg)) - effect.basis(stops_of(source))
    step = 1e-5 * np.eye(6)[1]
    up, down = (source.rig.tree.place("arm_end", joints + s) for s in (step, -step))
    rise = (up.Ts_root_frame - down.Ts_root_frame)[:, 2, 3] / 2e-5
    np.testing.assert_allclose(more[:, 1, 1], -np.nan_to_num(kg) * 9.80665 * rise, atol=1e-6)


def test_joints_give_way_to_the_payload_alone_by_a_coefficient_of_its_own(source):
    kg = np.linspace(0, 2, len(source.recording.stops))
    sag = find("arm_gravity_sag")
    more = sag.basis(stops_of(source, payload_kg=kg)) - sag.basis(stops_of(source))
    found = find("arm_payload_sag").basis(stops_of(source, payload_kg=kg))
    np.testing.assert_allclose(found, more, atol=1e-9)
    assert np.abs(found).max() > 1


def test_joints_give_way_to_a_payload_beside_the_tip(source):
    """By how much higher its centre rises than the tip does."""
    kg = np.linspace(0, 2, len(source.recording.stops))
    amount = np.array([3e-6, -2e-6, 5e-6])
    found = find("arm_payload_offset").basis(stops_of(source, payload_kg=kg)) @ amount
    q, expected = source.recording.joints, np.zeros_like(found)
    for j, step in enumerate(1e-5 * np.eye(6)):
        up, down = (source.rig.tree.place("arm_end", q + s).Ts_root_frame for s in (step, -step))
        rise = ((up - down)[:, 2, :3] @ amount) / 2e-5
        expected[:, j] = -kg * 9.80665 * rise
    np.testing.assert_allclose(found, expected, atol=1e-10)
    assert np.abs(found).max() > 1e-5


def test_a_temperature_that_was_not_read_is_that_of_the_other_stops():
    celsius = np.array([20.0, np.nan, 23.0])
    found = recorded_columns({"temperature_c": celsius, "humidity": celsius})
    np.testing.assert_array_equal(found["temperature_c"], [20.0, 21.5, 23.0])
    np.testing.assert_array_equal(found["humidity"], celsius)
    unread = recorded_columns({"temperature_c": np.full(3, np.nan)})
    assert np.isnan(unread["temperature_c"]).all() and not recorded_columns({})


def test_each_tip_has_a_payload_of_its_own(tmp_path):
    """What the right hand carries pulls at the torso and the right arm, by the height it rises."""
    rng = np.random.default_rng(2)
    two_arms.write(tmp_path / "rec", two_arms.drawn(rng), 6, rng)
    table = pd.read_csv(tmp_path / "rec/stops.csv")
    kg = np.linspace(0.5, 3.0, len(table))
    table.assign(**{"right_hand.payload_kg": kg}).to_csv(tmp_path / "rec/stops.csv", index=False)
    source = Source.open(tmp_path / "rec")
    assert not source.columns["payload_kg"].any()  # the left hand carries none
    found = find("arm_payload_sag").basis(stops_view(source))
    rig, q = source.rig, source.recording.joints
    for j, step in enumerate(1e-5 * np.eye(q.shape[1])):
        up, down = (rig.tree.transform("right_hand", q + s)[:, 2, 3] for s in (step, -step))
        expected = -kg * 9.80665 * (up - down) / 2e-5
        np.testing.assert_allclose(found[:, j, j], expected, atol=1e-5)
        if rig.joint_names[j].startswith("left"):
            assert not found[:, j].any()
    beside = find("arm_payload_offset")
    names, moved = [p.name for p in beside.params(rig)], beside.basis(stops_view(source))
    assert [n for n, any_ in zip(names, moved.any(axis=(0, 1)), strict=True) if any_] == [
        "right_hand.centre_x",
        "right_hand.centre_y",
        "right_hand.centre_z",
    ]
    both = table.assign(**{"payload_kg": 1.0, "left_hand.payload_kg": 1.0})
    both.to_csv(tmp_path / "rec/stops.csv", index=False)
    with pytest.raises(InputError, match=r"payload_kg and left_hand\.payload_kg both say what"):
        _ = Source.open(tmp_path / "rec").columns


def test_joints_give_way_to_the_torques_that_were_measured(source):
    count = len(source.recording.stops)
    measured = np.linspace(-20, 30, count)
    measured[0] = np.nan
    given = {"joint_2.torque": measured}
    columns = stop_columns(source.rig, source.recording.joints, np.full(count, np.nan), given)
    found = find("arm_torque_sag").basis(stops_of(source, **columns))
    np.testing.assert_array_equal(found[:, 1, 1], np.nan_to_num(measured))
    assert np.count_nonzero(found) == count - 1


def test_links_bend_across_the_axes_along_gravity(source):
    """The moment is the slope of the potential energy, downhill; about the axis there is none."""
    tree, step = source.rig.tree, 1e-5
    basis = find("arm_link_bending").basis(stops_of(source))
    for p, joint in enumerate(source.rig.joint_names):
        edge = next(e for e in tree.edges if e.joint is not None and e.joint.name == joint)
        e, slope = tree.edge_names.index(edge.name), np.zeros((len(basis), 3))
        for axis in range(3):
            twist = np.zeros((1, len(tree.edges), 6))
            twist[0, e, axis] = step
            up, down = (height_energy(source, source.recording.joints, t) for t in (twist, -twist))
            slope[:, axis] = -(up - down) / (2 * step)
        slope -= np.outer(slope @ edge.joint.axis, edge.joint.axis)
        np.testing.assert_allclose(basis[:, e, :3, p], slope, atol=1e-5)
        basis[:, e, :3, p] = 0
    assert not basis.any()


def test_the_base_tilts_along_gravity(source):
    joints, tree = source.recording.joints, source.rig.tree
    basis = find("base_flex").basis(stops_of(source))
    edge = tree.edge_names.index("arm_base")
    for axis in (0, 1):
        twist = np.zeros((1, len(tree.edges), 6))
        twist[0, edge, axis] = 1e-5
        slope = height_energy(source, joints, twist) - height_energy(source, joints, -twist)
        np.testing.assert_allclose(basis[:, edge, axis, axis], -slope / 2e-5, atol=1e-5)
    elsewhere = basis.copy()
    elsewhere[:, edge, (0, 1), (0, 1)] = 0
    assert not elsewhere.any() and np.abs(basis).max() > 5


def test_without_a_frame_before_it_the_arm_s_first_edge_tilts(source):
    tree = source.rig.tree
    below = ("arm_base", "base_markers")
    inner = type(tree)([e for e in tree.edges if e.name not in below])
    assert inner.root == "arm_base"
    rig = replace(source.rig, tree=inner)
    view = View(rig, len(source.recording.stops), {}, source.recording.joints)
    found = find("base_flex").basis(view)
    moved = np.abs(found).max(axis=(0, 2, 3)) > 0
    assert [e for e, m in zip(inner.edge_names, moved, strict=True) if m] == ["joint_1"]


def test_the_mount_bends_down(source):
    """The LiDAR comes lower wherever its lever does not hang or stand along gravity."""
    plain, bent = placed(source, "mount_bending", 0.0), placed(source, "mount_bending", 1e-3)
    mount = source.rig.tree.place("mount", source.recording.joints).Ts_root_frame
    lever = plain[:, :3, 3] - mount[:, :3, 3]
    across = np.linalg.norm(lever[:, :2], axis=1)
    fall = (plain - bent)[:, 2, 3]
    # By an angle of 1 mrad times the sine between lever and gravity, at arm's length of the lever.
    np.testing.assert_allclose(fall, 1e-3 * across**2 / np.linalg.norm(lever, axis=1), atol=1e-7)
    assert fall.max() > 2e-5


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_mast_that_bends_falls_and_turns_as_a_cantilever_does(source, axis):
    """Its tip goes along what of gravity is across it, and turns about the axis across both."""
    effect, n = find("body_bending"), np.eye(3)[axis]
    sag_m, turn_rad = 2e-3, 0.01
    K = sag_m * (np.eye(3) - np.outer(n, n))
    theta = np.r_[K[np.triu_indices(3)], turn_rad * n]
    names = [param.name for param in effect.params(source.rig)]
    assert names[:3] == [f"mount_markers.{name}" for name in ("xx", "xy", "xz")]
    at = source.rig.tracker.bodies.index("mount_markers")
    basis = effect.basis(stops_of(source))
    assert not np.delete(basis, at, axis=1).any(), "bodies before the joints"
    turn, shift = np.split(basis[:, at] @ theta, 2, axis=1)
    R = source.rig.tree.place("mount_markers", source.recording.joints).Ts_root_frame[:, :3, :3]
    mast, down = R @ n, np.array([0.0, 0.0, -1.0])
    across = down - mast * (mast @ down)[:, None]
    np.testing.assert_allclose(np.matvec(R, shift), sag_m * across, atol=1e-12)
    np.testing.assert_allclose(np.matvec(R, turn), turn_rad * np.cross(mast, down), atol=1e-12)
    assert np.linalg.norm(across, axis=1).max() > 0.5


@pytest.mark.long
def test_a_mast_of_markers_that_bends_is_named(tmp_path):
    """The height of the arm was 6 to 7 sigmas off, and all was called adequate."""
    spec = Spec(lidar=None, mesh=False, targets=0, locations=6, stops_per_location=12)
    made(tmp_path / "rec", spec, 2)
    n, at = np.array([0.0, 0.0, 1.0]), "mount_markers"
    pose = pd.read_csv(tmp_path / "rec/stops.csv")
    seen = pose[[f"{at}.q{c}" for c in "wxyz"]].fillna(1.0)  # what was not seen stays empty
    mast, down = Rotation.from_quat(seen, scalar_first=True).apply(n), np.array([0.0, 0.0, -1.0])
    pose[[f"{at}.{c}" for c in "xyz"]] += 0.002 * (down - mast * (mast @ down)[:, None])
    pose.to_csv(tmp_path / "rec/stops.csv", index=False)
    run = calib.fit(tmp_path / "rec", tmp_path / "run")
    assert calib.diagnose(run).worth_adding == ["body_bending"]
    grown = calib.add(run, "body_bending", tmp_path / "grown")
    assert calib.diagnose(grown).verdict == "adequate"
    found = grown.solution.shared.effects["body_bending"]
    told = dict(zip(found.names, found.estimate, strict=True))
    assert told[f"{at}.xx"] - told[f"{at}.zz"] == pytest.approx(0.002, abs=3e-4)
    assert told[f"{at}.xy"] == pytest.approx(0.0, abs=3e-4)


@pytest.mark.long
@pytest.mark.parametrize("name", ["arm_payload_sag", "arm_payload_offset", "arm_torque_sag"])
def test_a_joint_that_gives_way_is_named_by_what_it_gives_way_to(tmp_path, name):
    """Gravity alone explains most of a measured torque, and comes first until it is fitted."""
    spec = changed(load_spec("laser-tracker"), stops_per_location=6)
    made(tmp_path / "rec", spec, 2, **{name: 0.5})
    run = calib.fit(tmp_path / "rec", tmp_path / "run", hold_out="none")
    assert calib.diagnose(run, refits=False).worth_adding == [name]


def test_what_weight_does_is_said_to_need_masses(tmp_path):
    """Of an arm whose URDF has none; no other effect lacks any."""
    source = Source.open(rigs.write(tmp_path / "rec"))
    assert source.rig.joint_names and not source.rig.masses
    lacked = {e.name: lacking(e, [source], frozenset(source.columns)) for e in CATALOGUE}
    assert {name for name, what in lacked.items() if NO_MASSES in what} == {
        "arm_gravity_sag", "arm_link_bending", "base_flex"
    }  # fmt: skip
