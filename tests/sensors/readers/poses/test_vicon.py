"""Vicon's CSV: blocks written here from their description, read back in metres."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from chains.errors import InputError
from sensors.readers.base import Options
from sensors.readers.poses.vicon import read_vicon

N = 4
XYZ = np.random.default_rng(1).normal(size=(N, 3))
TURN = Rotation.random(N, rng=1)


def quiet(what, done, total):
    pass


def block(title, name, axes, units, rows, separator=","):
    head = [title, "100", f",,{name}", ",".join(["Frame", "Sub Frame", *axes])]
    head.append(",".join(["", "", *units]))
    lines = [",".join([str(k + 1), "0", *map(repr, row)]) for k, row in enumerate(rows.tolist())]
    return "\n".join([*head, *lines, "", ""])


def bodies(turn, unit):
    axes = ["RX", "RY", "RZ", "RW"][: turn.shape[1]]
    axes += ["TX", "TY", "TZ"]
    units = [unit] * turn.shape[1] + ["mm"] * 3
    return block("Objects", "Global Angle cup:cup", axes, units, np.hstack([turn, 1e3 * XYZ]))


MARKERS = block("Trajectories", "cup:A1", ["X", "Y", "Z"], ["mm"] * 3, 1e3 * XYZ)


@pytest.mark.parametrize(
    ("turn", "unit", "euler"),
    [
        (TURN.as_quat(), "", None),
        (TURN.as_rotvec(), "rad", "vector"),
        (TURN.as_rotvec(degrees=True), "deg", "vector"),
        (TURN.as_euler("XYZ", degrees=True), "deg", "XYZ"),
    ],
)
def test_a_body_and_a_marker(tmp_path, turn, unit, euler):
    path = tmp_path / "t.csv"
    path.write_text(bodies(turn, unit) + MARKERS)
    body, marker = read_vicon([path], Options(euler=euler), quiet).tracks
    assert (body.name, body.kind, marker.name, marker.kind) == ("cup", "pose", "A1", "point")
    np.testing.assert_allclose(body.values[:, :3], XYZ)
    found = Rotation.from_quat(body.values[:, 3:], scalar_first=True)
    assert (found.inv() * TURN).magnitude().max() < 1e-9
    np.testing.assert_allclose(marker.values, XYZ)
    np.testing.assert_allclose(body.time_s, np.arange(N) / 100)


def test_three_numbers_are_not_taken_for_a_rotation_unasked(tmp_path):
    path = tmp_path / "t.csv"
    path.write_text(bodies(TURN.as_rotvec(), "rad"))
    with pytest.raises(InputError, match="--euler vector"):
        read_vicon([path], Options(), quiet)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a,b\n1,2\n", "no CSV of Vicon"),
        (MARKERS.replace("100", "fast", 1), "no rate in Hz"),
        (MARKERS.replace("mm", "px"), "--length-unit"),
        ("\n".join(MARKERS.splitlines()[:5]), "no frames"),
    ],
)
def test_what_is_wrong_is_one_sentence(tmp_path, text, said):
    (tmp_path / "t.csv").write_text(text)
    with pytest.raises(InputError, match=said):
        read_vicon([tmp_path / "t.csv"], Options(), quiet)
