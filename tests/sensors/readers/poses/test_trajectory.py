"""TUM's and EuRoC's trajectories, with their quaternions in the right order."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from chains.errors import InputError
from sensors.readers.base import Options
from sensors.readers.poses.trajectory import read_euroc, read_tum

N = 5
TIME_S = 1.4e9 + np.arange(N) / 8
XYZ = np.random.default_rng(1).normal(size=(N, 3))
TURN = Rotation.random(N, rng=1)
EUROC = "#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y []"


def quiet(what, done, total):
    pass


def write(path, head, rows, separator):
    lines = [separator.join(map(repr, row)) for row in rows.tolist()]
    path.write_text("\n".join([*head, *lines, ""]))
    return path


def check(track):
    np.testing.assert_allclose(track.time_s, TIME_S, atol=1e-6)
    np.testing.assert_allclose(track.values[:, :3], XYZ)
    turn = Rotation.from_quat(track.values[:, 3:], scalar_first=True)
    assert (turn.inv() * TURN).magnitude().max() < 1e-9


@pytest.mark.parametrize("separator", [" ", ", ", "\t"])
@pytest.mark.parametrize("head", [[], ["# time x y z", "# made by a test"]])
def test_tum(tmp_path, separator, head):
    rows = np.column_stack([TIME_S, XYZ, TURN.as_quat()])
    path = write(tmp_path / "cup.txt", head, rows, separator)
    (track,) = read_tum([path], Options(), quiet).tracks
    assert (track.name, track.kind, track.clock) == ("cup", "pose", "cup")
    check(track)


def test_euroc_has_w_first_nanoseconds_and_more_columns(tmp_path):
    rows = np.column_stack([1e9 * TIME_S, XYZ, TURN.as_quat(scalar_first=True), XYZ])
    path = write(tmp_path / "data.csv", [EUROC], rows, ",")
    check(read_euroc([path], Options(), quiet).tracks[0])
    check(read_tum([path], Options(), quiet).tracks[0])  # its header says so whatever the kind


def test_an_imu_is_a_gyro(tmp_path):
    rows = np.column_stack([1e9 * TIME_S, XYZ, 9.8 * XYZ])
    head = ["#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],a_RS_S_x"]
    (track,) = read_euroc([write(tmp_path / "imu.csv", head, rows, ",")], Options(), quiet).tracks
    assert track.kind == "gyro"
    np.testing.assert_allclose(track.values, XYZ)


@pytest.mark.parametrize(
    ("text", "said"),
    [("1 2 3\n", "3 numbers in a line"), ("1 2 3 4 0 0 0 2\n", "quaternion of length 2")],
)
def test_what_is_wrong_is_one_sentence(tmp_path, text, said):
    (tmp_path / "t.txt").write_text(text)
    with pytest.raises(InputError, match=said):
        read_tum([tmp_path / "t.txt"], Options(), quiet)
