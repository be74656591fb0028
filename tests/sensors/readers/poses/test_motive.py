"""Motive's CSV: written here from its public description, read back, y up turned to z up."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from chains.errors import InputError
from sensors.readers import conventions
from sensors.readers.base import Options
from sensors.readers.poses.motive import read_motive

N = 6
TURN = Rotation.random(N, rng=2)  # of the body in a world with y up
XYZ = np.random.default_rng(2).normal(size=(N, 3))
UP = Rotation.from_euler("x", 90, degrees=True)  # the same in a world with z up: a quarter turn


def quiet(what, done, total):
    pass


def take(path, version="1.23", unit="Millimeters", rotation="Quaternion", rows=None, labels=True):
    """A take with a body, its marker, a target's marker and an unlabelled one."""
    scale = {"Millimeters": 1e3, "Meters": 1.0}[unit]
    turn = TURN.as_quat() if rotation == "Quaternion" else TURN.as_euler(rotation, degrees=True)
    order = "XYZW" if rotation == "Quaternion" else rotation
    parts = [("Rigid Body", "cup", "Rotation", a) for a in order]
    parts += [("Rigid Body", "cup", "Position", a) for a in "XYZ"]
    parts += [("Rigid Body", "cup", "Mean Marker Error", "")]
    for kind, name in (
        ("Rigid Body Marker", "cup:Marker1"),
        ("Marker", "cup:Marker1"),
        ("Marker", "T1:upper"),
        ("Marker", "Unlabeled 108"),
    ):
        parts += [(kind, name, "Position", a) for a in "XYZ"]
    heads = list(zip(*parts, strict=True))
    facts = f"Format Version,{version},Take Name,x,Export Frame Rate,120.000000"
    facts += f",Rotation Type,{rotation},Length Units,{unit},Coordinate Space,Global"
    head = [facts, ""]
    names = ("Type", "Name", "ID", "Parent") if labels else ("", "", "", "")
    rowed = [heads[0], heads[1], ["id"] * len(parts)]
    rowed += [["p"] * len(parts)] if version >= "1.24" else []
    for name, row in zip(names, rowed, strict=False):
        head.append(",".join(["", name, *row]))
    head.append(",".join(["", "", *heads[2]]))
    head.append(",".join(["Frame", "Time (Seconds)" if labels else "Time", *heads[3]]))
    body = np.hstack([turn, scale * XYZ, np.zeros((N, 1)), *[scale * XYZ] * 4])
    cells = [",".join(map(repr, row)) for row in body.tolist()]
    lines = [f"{k},{k / 120:.6f},{row}" for k, row in enumerate(cells)]
    lines[2] = f"2,{2 / 120:.6f}" + "," * body.shape[1]
    path.write_text("\n".join([*head, *(rows if rows is not None else lines), ""]))
    return path


@pytest.mark.parametrize("version", ["1.2", "1.21", "1.23", "1.25"])
@pytest.mark.parametrize("unit", ["Millimeters", "Meters"])
@pytest.mark.parametrize("rotation", ["Quaternion", "XYZ", "ZYX"])
def test_bodies_come_in_metres_and_z_up(tmp_path, version, unit, rotation):
    path = take(tmp_path / "t.csv", version, unit, rotation, labels=version > "1.21")
    found = read_motive([path], Options(), quiet)
    (body, point) = found.tracks
    assert (body.name, body.kind, point.name, point.kind) == ("cup", "pose", "T1:upper", "point")
    seen = np.arange(N) != 2  # a row of empty cells
    assert np.isnan(body.values[2]).all()
    expected = UP.apply(XYZ)
    np.testing.assert_allclose(body.values[seen, :3], expected[seen], atol=1e-9)
    np.testing.assert_allclose(point.values[seen], expected[seen], atol=1e-9)
    turn = Rotation.from_quat(body.values[seen, 3:], scalar_first=True)
    assert (turn.inv() * (UP * TURN)[seen]).magnitude().max() < 1e-9
    np.testing.assert_allclose(body.time_s, np.arange(N) / 120, atol=1e-6)
    assert any("y up to z up" in line for line in found.understood)
    assert any("1 unlabelled" in line for line in found.understood)


def test_z_up_stays_as_it_stands(tmp_path):
    body = read_motive([take(tmp_path / "t.csv")], Options(up="z"), quiet).tracks[0]
    np.testing.assert_allclose(body.values[0, :3], XYZ[0], atol=1e-9)


def test_turning_up_keeps_right_handed_axes():
    assert np.linalg.det(conventions.Z_FROM_Y) == pytest.approx(1)
    np.testing.assert_array_equal(conventions.z_up(np.array([[0.0, 1.0, 0.0]])), [[0, 0, 1]])


def test_tracking_tools_names_whom_each_frame_saw(tmp_path):
    quat = TURN.as_quat()
    lines = ["comment,x", "righthanded", "info,version,1.1", "info,framecount,6"]
    lines += ["info,rigidbodycount,2", 'rigidbody,"cup",7,3,0,0,0', "rigidbody,lid,9,3,0,0,0"]
    for k in range(N):
        pose = ",".join(map(repr, [*XYZ[k].tolist(), *quat[k].tolist(), 0, 0, 0]))
        seen = [f"7,{pose}"] * (k != 3) + [f"9,{pose}"] * (k > 1)
        lines.append(",".join([f"frame,{k},{k / 100}", str(len(seen)), *seen, "0"]))
    path = tmp_path / "t.csv"
    path.write_text("\n".join(lines))
    cup, lid = read_motive([path], Options(), quiet).tracks
    assert np.isnan(cup.values[3]).all() and np.isnan(lid.values[:2]).all()
    np.testing.assert_allclose(lid.values[2:, :3], UP.apply(XYZ)[2:], atol=1e-12)
    path.write_text("\n".join(["lefthanded", *lines[2:]]))
    with pytest.raises(InputError, match="left-handed"):
        read_motive([path], Options(), quiet)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda t: "time,x\n1,2\n", "no CSV of Motive"),
        (lambda t: t.replace("Millimeters", "Furlongs"), "--length-unit"),
        (lambda t: "\n".join(t.splitlines()[:4]), "'Frame'"),
        (lambda t: "\n".join(t.splitlines()[:7]), "no frames"),
        (lambda t: t.replace("Rigid Body,", "Bone,").replace("T1:upper", "Unlabeled 1")
         .replace("cup:Marker1", "Unlabeled 2"), "neither rigid bodies"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_one_sentence(tmp_path, change, said):
    path = take(tmp_path / "t.csv")
    path.write_text(change(path.read_text()))
    with pytest.raises(InputError, match=said):
        read_motive([path], Options(), quiet)


def test_a_take_cut_off_within_a_line_loses_that_line(tmp_path):
    path = take(tmp_path / "t.csv")
    path.write_text(path.read_text()[:-40])
    found = read_motive([path], Options(), quiet)
    assert len(found.tracks[0].time_s) == N - 1 and "breaks off" in found.odd[0]
