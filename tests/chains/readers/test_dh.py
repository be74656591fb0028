"""Tables of Denavit and Hartenberg as URDF, against products of elementary matrices."""

import numpy as np
import pytest

from chains.arm import read_arm, read_masses
from chains.frames import FrameTree
from chains.readers.dh import DhRow, to_urdf

ROWS = (
    DhRow("a", 0.1, 0.7, 0.3, theta_rad=0.2, mass_kg=2.5, centre_m=(0.1, 0.0, -0.2)),
    DhRow("b", -0.6, -1.2, 0.0),
    DhRow("c", 0.05, np.pi / 2, -0.15, theta_rad=-0.9, kind="prismatic"),
    DhRow("d", 0.0, 0.3, 0.08, theta_rad=np.pi),
)


def turn(axis, angle):
    c, s = np.cos(angle), np.sin(angle)
    T = np.eye(4)
    i, j = {"x": (1, 2), "z": (0, 1)}[axis]
    T[i, i], T[i, j], T[j, i], T[j, j] = c, -s, s, c
    return T


def shift(x, z):
    T = np.eye(4)
    T[0, 3], T[2, 3] = x, z
    return T


def product(rows, q, modified):
    """The convention's own formula, row by row."""
    T = np.eye(4)
    for row, value in zip(rows, q, strict=True):
        theta = row.theta_rad + (value if row.kind == "revolute" else 0)
        d = row.d_m + (value if row.kind == "prismatic" else 0)
        along_z = turn("z", theta) @ shift(0, d)
        along_x = turn("x", row.alpha_rad) @ shift(row.a_m, 0)
        T = T @ (along_x @ along_z if modified else along_z @ along_x)
    return T


@pytest.mark.parametrize("modified", [False, True])
def test_forward_kinematics_is_the_product_of_the_rows(tmp_path, modified):
    path = tmp_path / "arm.urdf"
    path.write_text(to_urdf("dh", ROWS, modified))
    tree = FrameTree(read_arm(path, "arm_base", "arm_end"))
    q = np.random.default_rng(1).uniform(-1, 1, (6, 4))
    found = tree.place("arm_end", q).Ts_root_frame
    expected = np.array([product(ROWS, row, modified) for row in q])
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_masses_stand_in_the_frames_of_their_joints(tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text(to_urdf("dh", ROWS, False))
    (mass,) = read_masses(path, "arm_base", "arm_end")
    assert (mass.frame, mass.kg, mass.centre_m.tolist()) == ("a_link", 2.5, [0.1, 0.0, -0.2])
