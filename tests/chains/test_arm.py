"""An arm read from URDF: kinematics and gravity by elementary means, and every refusal."""

from itertools import pairwise
from math import cos, pi, sin

import numpy as np
import pytest

from chains.arm import Mass, gravity_torque, read_arm, read_masses
from chains.errors import InputError
from chains.frames import FrameTree

ARM = """<robot name="arm3">
  <link name="world"/> <link name="stand"/> <link name="upper"/> <link name="fore"/>
  <link name="hand"/> <link name="flange"/> <link name="camera"/>
  <joint name="foot" type="fixed">
    <parent link="world"/><child link="stand"/>
  </joint>
  <joint name="flange_joint" type="fixed">
    <origin xyz="0 0 0.1" rpy="0 0 0.5"/><parent link="hand"/><child link="flange"/>
  </joint>
  <joint name="shoulder" type="revolute">
    <origin xyz="0 0 0.2" rpy="1.5707963267948966 0 0"/><parent link="stand"/><child link="upper"/>
    <axis xyz="0 0 -2"/><limit lower="-1" upper="2" effort="1" velocity="1"/>
  </joint>
  <joint name="elbow" type="continuous">
    <origin xyz="0.3 0 0"/><parent link="upper"/><child link="fore"/>
  </joint>
  <joint name="reach" type="prismatic">
    <origin rpy="0 0.4 0"/><parent link="fore"/><child link="hand"/>
    <axis xyz="0 1 0"/><limit upper="0.5" effort="1" velocity="1"/>
  </joint>
  <joint name="camera_joint" type="floating">
    <parent link="hand"/><child link="camera"/>
  </joint>
</robot>"""


def shift(x, y, z):
    return np.array([[1, 0, 0, x], [0, 1, 0, y], [0, 0, 1, z], [0, 0, 0, 1]], float)


def turn(axis, angle_rad):
    c, s = cos(angle_rad), sin(angle_rad)
    blocks = {"x": [[1, 0, 0], [0, c, -s], [0, s, c]], "y": [[c, 0, s], [0, 1, 0], [-s, 0, c]]}
    blocks["z"] = [[c, -s, 0], [s, c, 0], [0, 0, 1]]
    T = np.eye(4)
    T[:3, :3] = blocks[axis]
    return T


@pytest.fixture
def read(tmp_path):
    """Write a URDF and read the chain of it."""

    def write_and_read(text=ARM, base="world", tip="flange"):
        path = tmp_path / "arm.urdf"
        path.write_text(text)
        return read_arm(path, base, tip)

    return write_and_read


def test_edges_are_the_joints_in_order(read):
    edges = read()
    names = ["foot", "shoulder", "elbow", "reach", "flange_joint"]
    assert [edge.name for edge in edges] == names
    links = ["world", "stand", "upper", "fore", "hand", "flange"]
    assert [(edge.parent, edge.child) for edge in edges] == list(pairwise(links))
    assert [edge.joint is None for edge in edges] == [True, False, False, False, True]


def test_forward_kinematics(read):
    joints = np.array([[0.7, -0.4, 0.25], [-0.3, 2.0, 0.1]])
    Ts = FrameTree(read()).place("flange", joints).Ts_root_frame
    for T, (shoulder, elbow, reach) in zip(Ts, joints, strict=True):
        expected = (
            shift(0, 0, 0.2)
            @ turn("x", pi / 2)
            @ turn("z", -shoulder)
            @ shift(0.3, 0, 0)
            @ turn("x", elbow)
            @ turn("y", 0.4)
            @ shift(0, reach, 0)
            @ shift(0, 0, 0.1)
            @ turn("z", 0.5)
        )
        np.testing.assert_allclose(T, expected, atol=1e-14)


def test_axes_and_limits_with_their_defaults(read):
    joints = {edge.name: edge.joint for edge in read()}
    np.testing.assert_array_equal(joints["shoulder"].axis, [0, 0, -1])
    assert (joints["shoulder"].lower, joints["shoulder"].upper) == (-1, 2)
    np.testing.assert_array_equal(joints["elbow"].axis, [1, 0, 0])
    assert (joints["elbow"].kind, joints["elbow"].lower) == ("revolute", -np.inf)
    assert (joints["reach"].kind, joints["reach"].lower, joints["reach"].upper) == (
        "prismatic",
        0,
        0.5,
    )


def test_a_chain_may_start_inside_the_arm(read):
    assert [edge.name for edge in read(base="upper", tip="hand")] == ["elbow", "reach"]


@pytest.mark.parametrize(
    ("base", "tip", "words"),
    [
        ("word", "flange", ["link 'word'", "'world'", "stand, upper"]),
        ("world", "tool", ["link 'tool'", "flange"]),
        ("flange", "world", ["'flange'", "'world'", "no chain"]),
        ("world", "camera", ["camera_joint", "floating", "prismatic"]),
    ],
)
def test_a_chain_that_is_not_there_is_refused(read, base, tip, words):
    refuses(read, words, base=base, tip=tip)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('xyz="0 0 0.2"', 'xyz="0 0 200"', ["shoulder", "200 m", "millimetres?"]),
        ('xyz="0 0 0.2"', 'xyz="0 0.2"', ["shoulder", "origin xyz", "'0 0.2'", "3 numbers"]),
        ('xyz="0 0 0.2"', 'xyz="0 0 nan"', ["shoulder", "origin xyz", "3 numbers"]),
        ('xyz="0 0 -2"', 'xyz="0 0 0"', ["shoulder", "axis"]),
        ('lower="-1"', 'lower="3"', ["shoulder", "lower 3", "upper 2"]),
        ('lower="-1"', 'lower="low"', ["shoulder", "limit lower", "'low'", "a number"]),
        ('<axis xyz="0 1 0"/>', '<mimic joint="elbo"/>', ["reach", "'elbo'", "no such joint"]),
        ('<axis xyz="0 1 0"/>', '<mimic joint="reach"/>', ["reach", "follows itself"]),
        ('<axis xyz="0 1 0"/>', '<mimic joint="elbow" multiplier="0"/>', ["reach", "0 times"]),
        ('<axis xyz="0 1 0"/>', '<mimic joint="elbow" multiplier="x"/>', ["multiplier", "'x'"]),
        ('type="continuous"', 'type="planar"', ["elbow", "planar"]),
        ('<child link="upper"/>', '<child link="fore"/>', ["'fore'", "'shoulder' and 'elbow'"]),
        ('<child link="upper"/>', "", ["shoulder", "no child link"]),
        ('<parent link="stand"/>', '<parent link="fore"/>', ["no chain", "'world'", "'flange'"]),
        ("</robot>", "", ["not XML"]),
    ],
)
def test_a_bad_joint_is_refused_by_name(read, old, new, words):
    assert old in ARM
    refuses(read, words, text=ARM.replace(old, new, 1))


WEIGHTS = """
  <link name="tool"><inertial><origin xyz="0.1 0 0"/><mass value="0.5"/></inertial></link>
  <joint name="grip" type="revolute">
    <origin xyz="0 0 0.2" rpy="0 0 1.5707963267948966"/>
    <parent link="fore"/><child link="tool"/><axis xyz="0 0 1"/>
  </joint>
</robot>"""


def weighing(**kg_and_centre):
    """The arm with masses: link=(kg, xyz)."""
    text = ARM
    for link, (kg, xyz) in kg_and_centre.items():
        inertial = f'<inertial><origin xyz="{xyz}"/><mass value="{kg}"/></inertial>'
        assert f'<link name="{link}"/>' in text
        text = text.replace(f'<link name="{link}"/>', f'<link name="{link}">{inertial}</link>')
    return text


def test_masses_are_those_that_the_joints_carry(tmp_path):
    path = tmp_path / "arm.urdf"
    text = weighing(stand=(9, "0 0 0"), upper=(2, "0.1 0 0.02"), camera=(0.1, "0 0 0.3"))
    path.write_text(text.replace("</robot>", WEIGHTS))
    masses = {mass.frame: mass for mass in read_masses(path, "stand", "hand")}
    assert set(masses) == {"upper", "fore", "hand"}
    assert (masses["upper"].kg, masses["fore"].kg, masses["hand"].kg) == (2, 0.5, 0.1)
    np.testing.assert_allclose(masses["upper"].centre_m, [0.1, 0, 0.02])
    # The tool hangs from the forearm: turned by 90 degrees, 0.2 m up.
    np.testing.assert_allclose(masses["fore"].centre_m, [0, 0.1, 0.2], atol=1e-15)


def test_masses_that_hang_from_nothing_weigh_nothing(tmp_path):
    loop = "".join(
        f'<link name="{a}"><inertial><mass value="1"/></inertial></link>'
        f'<joint name="{a}{b}" type="fixed"><parent link="{b}"/><child link="{a}"/></joint>'
        for a, b in ("pq", "qp")
    )
    path = tmp_path / "arm.urdf"
    path.write_text(ARM.replace("</robot>", f"{loop}</robot>"))
    assert read_masses(path, "world", "flange") == []


def test_a_pendulum_s_torque(tmp_path):
    """Shoulder turns about -z of a frame rolled by 90 degrees: at q its link points down by q."""
    path = tmp_path / "arm.urdf"
    path.write_text(weighing(upper=(2, "0.3 0 0")))
    tree = FrameTree(read_arm(path, "world", "flange"))
    joints = np.array([[0.0, 0.5, 0.1], [0.4, 0.0, 0.0], [pi / 2, 0.0, 0.0]])
    torque = gravity_torque(tree, read_masses(path, "world", "flange"), joints)
    expected = 2 * 9.80665 * 0.3 * np.cos(joints[:, 0])
    np.testing.assert_allclose(torque[:, 0], expected, atol=1e-12)
    assert not torque[:, 1:].any()


def test_gravity_pulls_down_the_potential(tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text(
        weighing(upper=(2, "0.1 0 0.02"), fore=(1, "0 0.1 0.1"), hand=(0.5, "0.1 -0.1 0"))
    )
    tree = FrameTree(read_arm(path, "world", "flange"))
    masses = read_masses(path, "world", "flange")
    joints = np.array([[0.7, -0.4, 0.25], [-0.3, 2.0, 0.1]])

    def potential(q):
        return sum(
            9.80665 * m.kg * (tree.place(m.frame, q).Ts_root_frame @ [*m.centre_m, 1])[:, 2]
            for m in masses
        )

    slopes = [(potential(joints + d) - potential(joints - d)) / 2e-6 for d in 1e-6 * np.eye(3)]
    torque = gravity_torque(tree, masses, joints)
    np.testing.assert_allclose(torque, -np.stack(slopes, axis=1), atol=1e-7)
    assert np.abs(torque).min() > 0.01  # the prismatic joint's, in N, too
    heavier = [Mass(m.frame, m.kg * np.array([1.0, 2.0]), m.centre_m) for m in masses]
    np.testing.assert_allclose(gravity_torque(tree, heavier, joints), torque * [[1], [2]])


@pytest.mark.parametrize(
    ("kg", "xyz", "words"),
    [
        (-1, "0 0 0", "weighs -1 kg"),
        ("heavy", "0 0 0", "'heavy'"),
        (1, "0 0", "inertial/origin"),
        (1, "500 0 0", "centre of mass .* lies 500 m"),
    ],
)
def test_a_bad_mass_is_refused_by_its_link(tmp_path, kg, xyz, words):
    path = tmp_path / "arm.urdf"
    path.write_text(weighing(upper=(kg, xyz)))
    with pytest.raises(InputError, match=words) as refused:
        read_masses(path, "world", "flange")
    assert "arm.urdf" in str(refused.value) and "link 'upper'" in str(refused.value)


def test_a_namespace_alone_is_no_xacro(read):
    named = ARM.replace("<robot", '<robot xmlns:xacro="http://www.ros.org/wiki/xacro"')
    assert len(read(named)) == 5


def test_what_is_no_urdf_is_refused(read, tmp_path):
    refuses(read, ["<mesh>", "<robot>"], text="<mesh/>")
    macro = '<robot xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:arm/></robot>'
    refuses(read, ["xacro FILE"], text=macro)
    with pytest.raises(InputError, match=r"none\.urdf"):
        read_arm(tmp_path / "none.urdf", "world", "flange")


def refuses(read, words, **arguments):
    """Check that reading fails by one sentence that holds the file and all the words."""
    with pytest.raises(InputError) as refused:
        read(**arguments)
    for word in ["arm.urdf", *words]:
        assert word in str(refused.value)
