"""Real data against what other programs, or a plain least squares, make of it."""

import csv
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pandas
import pyarrow.parquet as pq
import pytest
import yaml
from scipy.optimize import least_squares
from scipy.spatial import cKDTree
from scipy.spatial.transform import RigidTransform, Rotation

from . import foreign

HALF_TURN = RigidTransform.from_rotation(Rotation.from_euler("z", np.pi))


def stops(recording: Path) -> dict[str, np.ndarray]:
    """The columns of stops.csv, as numbers where they are."""
    with (recording / "stops.csv").open() as file:
        names, *rows = csv.reader(file)
    columns = dict(zip(names, zip(*rows, strict=True), strict=True))
    text = {"stop", "location"}
    return {k: np.array(v) if k in text else np.array(v, float) for k, v in columns.items()}


def forward(recording: Path, table: dict[str, np.ndarray]) -> RigidTransform:
    """T_base_tip of every stop: the product of the joints of arm.urdf, each about its z."""
    chain = RigidTransform.identity(len(table["stop"]))
    for joint in ElementTree.parse(recording / "arm.urdf").iter("joint"):
        origin = joint.find("origin")
        xyz, rpy = (np.array(origin.get(key).split(), float) for key in ("xyz", "rpy"))
        chain *= RigidTransform.from_components(xyz, Rotation.from_euler("xyz", rpy))
        if joint.get("type") == "revolute":
            turn = Rotation.from_euler("z", table[joint.get("name")][:, None])
            chain *= RigidTransform.from_rotation(turn)
    return chain


def measured(table: dict[str, np.ndarray]) -> RigidTransform:
    """T_tracker_body of every stop."""
    pose = np.stack(
        [table[f"mount_markers.{key}"] for key in ("x", "y", "z", "qw", "qx", "qy", "qz")], axis=1
    )
    quat = Rotation.from_quat(pose[:, 3:], scalar_first=True)
    return RigidTransform.from_components(pose[:, :3], quat)


def nominal_mount(recording: Path) -> RigidTransform:
    mount = yaml.safe_load((recording / "rig.yaml").read_text())["frames"]["mount_markers"]
    return RigidTransform.from_components(
        mount["xyz_m"], Rotation.from_euler("xyz", mount["rpy_rad"])
    )


def base_and_mount_fit(recording: Path, m_per_rad: float) -> tuple[float, float, RigidTransform]:
    """Mean position error (mm) and angle (deg) once base and mount are free, and the mount.

    Started from the rig's own mount; rotation rows weigh `m_per_rad`.
    """
    table = stops(recording)
    arm, seen, mount = forward(recording, table), measured(table), nominal_mount(recording)
    base = (seen * (arm * mount).inv())[0]

    def errors(twists: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        moved = [RigidTransform.from_exp_coords(twist) for twist in twists.reshape(2, 6)]
        predicted = base * moved[0] * arm * mount * moved[1]
        turn = (predicted.rotation.inv() * seen.rotation).as_rotvec()
        return seen.translation - predicted.translation, turn

    def rows(twists: np.ndarray) -> np.ndarray:
        position, turn = errors(twists)
        return np.concatenate([position.ravel(), m_per_rad * turn.ravel()])

    best = least_squares(rows, np.zeros(12), x_scale="jac").x
    position, turn = (np.linalg.norm(error, axis=1).mean() for error in errors(best))
    return 1000 * position, np.degrees(turn), mount * RigidTransform.from_exp_coords(best[6:])


def sweep_table(recording: Path) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Points (N, 3) and the other columns of the one scan."""
    table = pq.read_table(recording / "scans/still.parquet")
    columns = {name: table[name].to_numpy().astype(float) for name in table.column_names}
    return np.stack([columns.pop(axis) for axis in "xyz"], axis=1), columns


@pytest.mark.parametrize("series", ["A", "D"])
def test_ur10_urdf_leads_to_the_planned_poses(series, shared, tmp_path):
    source = shared / "arms/ur10_tmac"
    recording = foreign.ur10(series, source, tmp_path / "ur10")
    table = stops(recording)
    plan = pandas.read_csv(source / foreign.UR10_FILES[series], sep=";", decimal=",")
    plan = plan.iloc[[int(stop.removeprefix("row")) for stop in table["stop"]]]
    xyz, rpy = (
        plan[[f"Goal {axis}" for axis in axes]].to_numpy(float)
        for axes in (("x", "y", "z"), ("roll", "pitch", "yaw"))
    )
    goal = RigidTransform.from_components(xyz, Rotation.from_euler("xyz", rpy))
    T_tool_flange = np.loadtxt(source / f"Series_{series}/Trafo_TM_F_init.txt")
    T_tool_flange[:3, 3] /= 1000
    flange = HALF_TURN * forward(recording, table)  # the maker's base is the DH base turned
    gap = goal.inv() * flange * RigidTransform.from_matrix(T_tool_flange).inv()
    assert np.median(np.linalg.norm(gap.translation, axis=1)) < 0.2e-3
    assert np.median(gap.rotation.magnitude()) < 2e-3


@pytest.mark.parametrize(("series", "expected_mm"), [("A", 0.75), ("D", 0.72)])
def test_ur10_nominal_error(series, expected_mm, shared, tmp_path):
    recording = foreign.ur10(series, shared / "arms/ur10_tmac", tmp_path / "ur10", max_stops=600)
    position_mm, angle_deg, mount = base_and_mount_fit(recording, m_per_rad=0.05)
    assert position_mm == pytest.approx(expected_mm, abs=0.03)
    assert angle_deg == pytest.approx(0.10, abs=0.015)  # the other Euler order leaves 1.4 or more
    nominal = yaml.safe_load((recording / "rig.yaml").read_text())["frames"]["mount_markers"]
    moved = nominal_mount(recording).inv() * mount
    assert moved.rotation.magnitude() < nominal["sigma_rad"]
    if series == "A":  # in D the tool points one way only, which leaves its length open
        assert np.linalg.norm(moved.translation) < nominal["sigma_m"]


def test_ur10_times_and_blocks(shared, tmp_path):
    """Series D has lost its times: each stamp is the same, and none is made up."""
    for series, days in (("A", 4.2), ("D", None)):
        recording = foreign.ur10(series, shared / "arms/ur10_tmac", tmp_path / series)
        table = stops(recording)
        assert ("time_s" in table) == (days is not None)
        if days is not None:
            assert np.all(np.diff(table["time_s"]) >= 0)
            assert np.ptp(table["time_s"]) / 86400 == pytest.approx(days, abs=0.1)
        blocks, sizes = np.unique(table["location"], return_counts=True)
        assert len(blocks) == 12 and np.ptp(sizes) <= 1
        assert len(np.unique(table["stop"])) == len(table["stop"])
        assert 20 < table["temperature_c"].min() < table["temperature_c"].max() < 24


def test_positioner_nominal_error(shared, tmp_path):
    recording = foreign.rosi_positioner(shared / "arms/rosi_positioner_2axis", tmp_path / "rosi")
    table = stops(recording)
    assert len(table["stop"]) == 205 and len(np.unique(table["location"])) == 13
    position_mm, angle_deg, mount = base_and_mount_fit(recording, m_per_rad=0.1)
    assert position_mm == pytest.approx(0.41, abs=0.01)
    assert angle_deg == pytest.approx(0.048, abs=0.002)
    moved = nominal_mount(recording).inv() * mount
    assert moved.rotation.magnitude() < 0.2 and np.linalg.norm(moved.translation) < 0.05


@pytest.mark.parametrize("model", ["qt64", "xt32"])
def test_hesai_sweeps_match_the_decoded_cloud(model, shared, tmp_path):
    source = shared / "lidar/hesai_nebula"
    xyz, columns = sweep_table(foreign.hesai(model, source, tmp_path / model))
    cloud = next((source / model).glob("*.pcd")).read_bytes().partition(b"DATA binary\n")[2]
    decoded = np.frombuffer(cloud, "<f4").reshape(-1, 3)
    gap, _ = cKDTree(xyz).query(decoded)
    # The decoder also keeps the earlier of two returns, which the recording leaves out.
    assert np.mean(gap < 1e-5) > 0.95
    direction, points = (p / np.linalg.norm(p, axis=1, keepdims=True) for p in (decoded, xyz))
    aside, near = cKDTree(points).query(direction, distance_upper_bound=1e-4)
    earlier = (gap >= 1e-5) & np.isfinite(aside)
    later_m = np.linalg.norm(xyz[near[earlier]], axis=1)
    assert np.mean(np.linalg.norm(decoded[earlier], axis=1) <= later_m + 0.02) > 0.95
    keys = np.stack([columns[name] for name in ("scan", "ring", "column")], axis=1)
    assert len(np.unique(keys, axis=0)) == len(keys)


@pytest.mark.parametrize("model", ["qt64", "xt32"])
def test_hesai_columns_count_clockwise_from_behind(model, shared, tmp_path):
    source = shared / "lidar/hesai_nebula"
    xyz, columns = sweep_table(foreign.hesai(model, source, tmp_path / model))
    steps = {"qt64": 600, "xt32": 2000}[model]
    table = source / f"calibration/{foreign.HESAI[model]}.csv"
    angles = np.loadtxt(table, delimiter=",", skiprows=1)
    elevation, clockwise = np.radians(angles[columns["ring"].astype(int), 1:]).T
    azimuth = np.pi - 2 * np.pi * columns["column"] / steps - clockwise
    expected = np.stack([np.cos(azimuth), np.sin(azimuth), np.tan(elevation)], axis=1)
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    range_m = np.linalg.norm(xyz, axis=1, keepdims=True)
    assert np.abs(xyz / range_m - expected).max() < 1e-6
    assert np.abs(range_m / 0.004 - np.rint(range_m / 0.004)).max() < 1e-2


def test_ouster_sweep_matches_the_makers_decoder(shared, tmp_path):
    xyz, columns = sweep_table(
        foreign.ouster(shared / "lidar/ouster_sdk_tests", tmp_path / "still")
    )
    # ouster-sdk 1.0.1 on the same file, sensor frame less its 36.18 mm of height.
    assert len(xyz) == 97299
    np.testing.assert_allclose(xyz.mean(axis=0), [-0.46398953, 0.82576326, 1.22832808], atol=1e-6)
    np.testing.assert_allclose(xyz.std(axis=0), [7.47890923, 6.62436137, 2.99932919], atol=1e-6)
    assert columns["ring"].max() == 127 and columns["column"].max() == 1023
