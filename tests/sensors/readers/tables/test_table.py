"""Tables with a header, as logs and as stops, against the numbers that they were written from."""

import numpy as np
import pandas
import pytest
from scipy.spatial.transform import Rotation

from chains.errors import InputError
from sensors.readers.base import Options
from sensors.readers.tables.table import read_table
from sensors.stops import POSE

RNG = np.random.default_rng(4)
TURN = Rotation.random(20, rng=4)
XYZ = RNG.normal(size=(20, 3))
JOINTS = {"j1": "revolute", "j2": "revolute"}


def quiet(what, done, total):
    pass


def write(path, columns, **how):
    pandas.DataFrame(columns).to_csv(path, index=False, **how)
    return path


def pose(stops, body="cup"):
    return np.stack([stops[f"{body}.{part}"] for part in POSE], axis=1)


def same_turns(quat, turn):
    return np.max((Rotation.from_quat(quat, scalar_first=True).inv() * turn).magnitude()) < 1e-6


@pytest.mark.parametrize("order", ["XYZ", "zyx", "YXZ"])
def test_euler_angles_millimetres_and_decimal_commas(tmp_path, order):
    """Angles rx ry rz are about x, y and z, whatever their order."""
    angles = TURN.as_euler(order, degrees=True)
    columns = {"when": 4.0 * np.arange(20), "p_x": 1e3 * XYZ[:, 0], "p_y": 1e3 * XYZ[:, 1]}
    columns |= {"p_z": 1e3 * XYZ[:, 2], "junk": XYZ[:, 0]}
    columns |= {f"p_r{axis}": angles[:, order.lower().index(axis)] for axis in "xyz"}
    path = write(tmp_path / "t.csv", columns, sep=";", decimal=",")
    mapped = {"time_s": "when", "cup.*": "p_*[mm]"}
    found = read_table([path], Options(columns=mapped, euler=order), quiet)
    assert found.stops["time_s"].tolist() == columns["when"].tolist()
    np.testing.assert_allclose(pose(found.stops)[:, :3], XYZ, atol=1e-9)
    assert same_turns(pose(found.stops)[:, 3:], TURN)
    assert "junk" not in found.stops and any("not taken: junk" in s for s in found.understood)


def test_a_log_has_bodies_joints_and_covariates_each_apart(tmp_path):
    quat = TURN.as_quat(scalar_first=True)
    quat[3] = np.nan
    columns = {"timestamp_ms": 10.0 * np.arange(20) + 5}
    columns |= dict(zip([f"cup.{p}" for p in POSE], np.hstack([XYZ, quat]).T, strict=True))
    columns |= {"j1 [deg]": np.linspace(0, 90, 20), "joint_states/j2/position": XYZ[:, 0]}
    columns |= {"gyro.x": XYZ[:, 0], "gyro.y": XYZ[:, 1], "gyro.z": XYZ[:, 2], "heat": XYZ[:, 1]}
    found = read_table([write(tmp_path / "t.csv", columns)], Options(joints=JOINTS), quiet)
    tracks = {track.kind: track for track in found.tracks}
    assert tracks.keys() == {"pose", "joints", "gyro", "covariate"}
    np.testing.assert_allclose(tracks["pose"].time_s, 0.01 * np.arange(20) + 0.005)
    assert np.isnan(tracks["pose"].values[3]).all() and np.isfinite(tracks["pose"].values[4]).all()
    np.testing.assert_allclose(tracks["joints"].values[:, 0], np.linspace(0, np.pi / 2, 20))
    np.testing.assert_allclose(tracks["joints"].values[:, 1], XYZ[:, 0])
    assert tracks["covariate"].names == ("heat",)
    assert {track.clock for track in found.tracks} == {"t"}


def test_times_that_are_missing_are_not_made_up(tmp_path):
    columns = {"Timestamp": np.full(20, 2.02103e13), "j1": XYZ[:, 0], "j2": XYZ[:, 1]}
    found = read_table([write(tmp_path / "t.csv", columns)], Options(joints=JOINTS), quiet)
    assert "time_s" not in found.stops and "Timestamp" in found.odd[0]
    np.testing.assert_array_equal(found.stops["j1"], XYZ[:, 0])
    del columns["Timestamp"]
    found = read_table([write(tmp_path / "t.csv", columns)], Options(joints=JOINTS), quiet)
    assert "time_s" not in found.stops and "no column of times" in found.odd[0]


@pytest.mark.parametrize("time", ["stamp", "time_s", None])
def test_a_joint_called_like_the_time_is_no_time(tmp_path, time):
    """A URDF's joint T, an angle: stops were sorted by it."""
    columns = {"T": XYZ[:, 0], "t": XYZ[:, 1], **({time: 10.0 * np.arange(20)} if time else {})}
    path = write(tmp_path / "t.csv", columns)
    found = read_table([path], Options(joints=dict.fromkeys("Tt", "revolute")), quiet)
    np.testing.assert_array_equal(found.stops["T"], XYZ[:, 0])
    np.testing.assert_array_equal(found.stops["t"], XYZ[:, 1])
    if time:
        assert found.stops["time_s"].tolist() == columns[time].tolist()
    else:
        assert "time_s" not in found.stops


def test_a_temperature_T_is_no_time(tmp_path):
    columns = {"T": 20 + XYZ[:, 0], "j1": XYZ[:, 1], "j2": XYZ[:, 2]}
    found = read_table([write(tmp_path / "t.csv", columns)], Options(joints=JOINTS), quiet)
    np.testing.assert_array_equal(found.stops["T"], columns["T"])
    columns["t"] = 10.0 * np.arange(20)
    found = read_table([write(tmp_path / "t.csv", columns)], Options(joints=JOINTS), quiet)
    assert found.stops["time_s"].tolist() == columns["t"].tolist()


def test_rows_out_of_order_are_put_in_order_and_keep_their_number(tmp_path):
    columns = {"time_s": 5.0 * np.arange(20)[::-1], "j1": np.arange(20) / 20, "j2": XYZ[:, 1]}
    found = read_table([write(tmp_path / "t.csv", columns)], Options(joints=JOINTS), quiet)
    assert found.stops["stop"][0] == "row00019" and found.stops["j1"][0] == 0.95


@pytest.mark.parametrize(
    ("columns", "options", "flag"),
    [
        ({"j1": 90.0 * XYZ[:, 0], "j2": XYZ[:, 1]}, {}, "--angle-unit deg"),
        ({"j1": 90.0 * XYZ[:, 0], "j2": XYZ[:, 1]}, {}, r"--column 'j1=j1\[deg\]'"),
        ({f"cup.{a}": 900 * XYZ[:, k] for k, a in enumerate("xyz")}, {}, "--length-unit mm"),
        ({"j1": XYZ[:, 0], "q2": XYZ[:, 1]}, {}, "--column j2=THEIRS"),
        ({"time_s": 0.5 * np.arange(20), "j1": XYZ[:, 0], "j2": XYZ[:, 1]}, {}, "--rows"),
        ({"j1": XYZ[:, 0], "j2": XYZ[:, 1]}, {"rows": "log"}, "--column time_s"),
        (
            {f"cup.{a}": XYZ[:, k % 3] for k, a in enumerate(["x", "y", "z", "rx", "ry", "rz"])},
            {},
            "--euler XYZ",
        ),
        ({f"cup.{a}": XYZ[:, k % 3] for k, a in enumerate(POSE)}, {}, "quaternion of length"),
    ],
)
def test_what_is_ambiguous_names_the_flag_that_decides(tmp_path, columns, options, flag):
    path = write(tmp_path / "t.csv", columns)
    with pytest.raises(InputError, match=flag):
        read_table([path], Options(joints=JOINTS, **options), quiet)


def test_a_table_without_header_is_refused(tmp_path):
    (tmp_path / "t.csv").write_text("1,2,3\n4,5,6\n")
    with pytest.raises(InputError, match="no header"):
        read_table([tmp_path / "t.csv"], Options(), quiet)


def test_columns_that_look_like_a_pose_are_pointed_out(tmp_path):
    """Unmapped they are covariates, and nothing would be calibrated by them."""
    names = [f"cup_{part}" for part in ("x", "y", "z", "rx", "ry", "rz")]
    columns = {"stop": range(20), **dict.fromkeys(names, XYZ[:, 0]), "goal x": 1.0, "lax": 2.0}
    path = write(tmp_path / "t.csv", columns)
    (line,) = read_table([path], Options(), quiet).odd[:1]
    assert "cup_x, y, z" in line and "--column BODY.*=cup_*" in line and "--euler" in line
    assert "goal" not in line and "la" not in line.split("columns")[1].split("may")[0]
    mapped = Options(columns={"cup.*": "cup_*"}, euler="XYZ", angle_unit="rad")
    assert not any("BODY" in line for line in read_table([path], mapped, quiet).odd)


def test_what_is_not_taken_is_said_and_nothing_else(tmp_path):
    """A column of words, and a triple beside one that is mapped: both were told to be taken."""
    columns = {"stop": range(20), "note": ["fine"] * 20, "heat": XYZ[:, 0]}
    found = read_table([write(tmp_path / "t.csv", columns)], Options(), quiet)
    assert "heat" in found.stops and "note" not in found.stops
    assert "t.csv: not taken: note" in found.understood
    names = [f"{body}_{axis}" for body in ("cup", "goal") for axis in "xyz"]
    columns = {"stop": range(20), **dict.fromkeys(names, XYZ[:, 0])}
    options = Options(columns={"cup.*": "cup_*"})
    found = read_table([write(tmp_path / "t.csv", columns)], options, quiet)
    assert "t.csv: not taken: goal_x, goal_y, goal_z" in found.understood
    assert not any("taken for covariates" in line for line in found.odd)
