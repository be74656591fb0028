"""A URDF written back: two libraries read what was meant, and every other byte is as it was."""

import re

import numpy as np
import pinocchio
import pytest
import yourdfpy
from scipy.spatial.transform import RigidTransform, Rotation

from chains.arm import read_arm
from chains.errors import InputError
from chains.frames import Edge
from chains.readers.urdf_out import (
    empty_robot,
    with_comment,
    with_frames,
    with_mimics,
    with_origins,
)

# As people write them: comments that hold tags, a transmission with joints of the same name,
# both kinds of quotes, tags over several lines, origins and parts of them left out, letters of
# several bytes, line ends of two kinds, and a pitch at which roll and yaw are one.
TEXT = """<?xml version='1.0' encoding="utf-8"?>
<!DOCTYPE robot [<!ENTITY maker "Größe und Söhne">]>
<!-- <robot><joint name="a"><origin xyz="9 9 9"/></joint></robot> größe -->
<robot   xmlns:gz='http://gz' name="arm">\r
  <link name="l0"/><link name="l1"><visual><origin xyz="5 5 5" rpy="1 1 1"/>
    <geometry><box size="1 1 1"/></geometry></visual></link>
  <link name="l2"/>\t<link name="l3"/>
  <link name="l4"/> <link name="l5"/><link name='camera'/>
  <transmission name="t"><joint name="a"><origin xyz="8 8 8"/></joint></transmission>
  <joint name="a" type="revolute">
    <parent link="l0"/> <child link="l1"/>
    <origin rpy = '0.1 -0.2 0.3'   note="xyz='7 7 7'"
            xyz="0.1 0.2 0.3" /> <!-- é -->
    <axis xyz="0 0.6 0.8"/><limit lower="-2" upper="2" effort="1" velocity="1"/>
  </joint>\r
  <joint name="b" type="continuous"><parent link="l1"/><child link="l2"/>
    <axis xyz="0 0 -1"/></joint>
  <joint type="prismatic" name="c"><parent link="l2"/><child link="l3"/><origin xyz="0 0 .5"/>
    <axis xyz="1 0 0"/><limit lower="0" upper="1" effort="1" velocity="1"/></joint>
  <joint name="d" type="revolute"><origin rpy="0.3 1.5707963267948966 0"></origin>
    <parent link="l3"/><child link="l4"/><axis xyz="0 1 0"/>
    <limit lower="-2" upper="2" effort="1" velocity="1"/></joint>
  <joint name="e" type="fixed"><parent link="l4"/><child link="l5"/><origin/></joint>
  <joint name="side" type="fixed"><parent link="l1"/><child link="camera"/>
    <origin xyz="1e-3 0 0"/></joint>
  <gazebo><joint name="d"><origin xyz="8 8 8"/><parent link="l3"/></joint></gazebo>
</robot>
<!-- the end -->
"""
MOVING = ("a", "b", "c", "d")


@pytest.fixture(scope="module")
def origins():
    """New origins for all joints of the chain, that of d straight up."""
    rng = np.random.default_rng(4)
    found = {
        name: RigidTransform.from_components(rng.normal(size=3), Rotation.random(rng=rng))
        for name in "abce"
    }
    upright = Rotation.from_euler("xyz", [0.4, np.pi / 2 - 3e-8, -1.1])
    found["d"] = RigidTransform.from_components([0, 0, 0], upright)
    return {name: T.as_matrix() for name, T in found.items()}


@pytest.fixture(scope="module")
def written(origins):
    return with_origins(TEXT.encode(), origins, "arm.urdf")


@pytest.fixture
def path(written, tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_bytes(written)
    return path


def placed(origins, joints):
    """T_l0_l5, link after link."""
    axes = {"a": (0, 0.6, 0.8), "b": (0, 0, -1), "d": (0, 1, 0)}
    T = RigidTransform.identity()
    for name in "abcde":
        T = T * RigidTransform.from_matrix(origins[name])
        if name in axes:
            turn = Rotation.from_rotvec(joints[name] * np.array(axes[name]))
            T = T * RigidTransform.from_rotation(turn)
        elif name == "c":
            T = T * RigidTransform.from_translation([joints[name], 0, 0])
    return T.as_matrix()


def poses(count=5):
    rng = np.random.default_rng(1)
    return [dict(zip(MOVING, rng.uniform(-2, 2, 4), strict=True)) for _ in range(count)]


def test_yourdfpy_finds_the_arm_where_it_was_put(path, origins):
    robot = yourdfpy.URDF.load(path, load_meshes=False)
    for joints in poses():
        robot.update_cfg(joints)
        T = robot.get_transform("l5", "l0")
        np.testing.assert_allclose(T, placed(origins, joints), rtol=0, atol=1e-12)


def test_pinocchio_finds_the_arm_where_it_was_put(path, origins):
    model = pinocchio.buildModelFromUrdf(str(path))
    data = model.createData()
    for joints in poses():
        velocity = np.zeros(model.nv)
        for name, value in joints.items():
            velocity[model.idx_vs[model.getJointId(name)]] = value
        q = pinocchio.integrate(model, pinocchio.neutral(model), velocity)
        pinocchio.framesForwardKinematics(model, data, q)
        T = data.oMf[model.getFrameId("l5")].homogeneous
        np.testing.assert_allclose(T, placed(origins, joints), rtol=0, atol=1e-12)


def test_only_numbers_of_origins_differ(written):
    """With every origin of the chain cut out, what is left is the same, byte for byte."""
    original = TEXT.encode()
    for tag in (
        b"""<origin rpy = '[^']*'   note="xyz='7 7 7'"\n            xyz="[^"]*" />""",
        rb'<joint name="b" type="continuous">(<origin [^>]*/>)?',
        rb'<child link="l3"/><origin [^>]*/>',
        rb'<joint name="d" type="revolute"><origin [^>]*></origin>',
        rb'<child link="l5"/><origin[^>]*/>',
    ):
        both = [re.subn(tag, b"@", text) for text in (original, written)]
        assert [count for _, count in both] == [1, 1]
        original, written = (text for text, _ in both)
    assert original == written


def test_nothing_changes_where_the_origins_are_those_of_the_file(tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_bytes(TEXT.encode())
    same = {
        edge.name: edge.T_parent_child for edge in read_arm(path, "l0", "l5") if edge.name != "b"
    }
    assert with_origins(path.read_bytes(), same, path) == TEXT.encode()


def test_a_shift_leaves_the_rotation_as_it_was_written(tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_bytes(TEXT.encode())
    (edge,) = (edge for edge in read_arm(path, "l0", "l5") if edge.name == "a")
    T = edge.T_parent_child.copy()
    T[2, 3] += 1e-6
    text = with_origins(path.read_bytes(), {"a": T}, path).decode()
    assert text == TEXT.replace("0.1 0.2 0.3", f"0.1 0.2 {0.3 + 1e-6!r}")


@pytest.mark.parametrize("encoding", ["utf-8-sig", "latin-1"])
def test_the_encoding_stays(encoding, origins, tmp_path):
    text = TEXT.replace("utf-8", "latin-1") if encoding == "latin-1" else TEXT
    written = with_origins(text.encode(encoding), origins, "arm.urdf")
    assert "größe" in written.decode(encoding)
    path = tmp_path / "arm.urdf"
    path.write_bytes(written)
    for edge in read_arm(path, "l0", "l5"):
        np.testing.assert_allclose(edge.T_parent_child, origins[edge.name], rtol=0, atol=1e-14)


def test_a_comment_stands_before_the_robot_and_changes_nothing_else(written, path):
    lines = ["no -- ends it", "--->", "größe"]
    commented = with_comment(written, lines, "arm.urdf")
    start = written.index(b"<robot   xmlns")
    end = len(commented) - (len(written) - start)
    assert commented[:start] == written[:start] and commented[end:] == written[start:]
    assert commented[start:end].startswith(b"<!--") and commented[start:end].endswith(b"-->\n")
    path.write_bytes(commented)
    assert len(read_arm(path, "l0", "l5")) == 5


def frame(parent, child, seed=0):
    rng = np.random.default_rng([seed, *map(ord, child)])
    T = RigidTransform.from_components(rng.normal(size=3), Rotation.random(rng=rng))
    return Edge(child, parent, child, T.as_matrix())


def test_frames_are_added_where_they_fit(written, path):
    """Below a link, above the root, below what was added; the rest is named."""
    hung = [frame("m&m", "lidar"), frame("l5", "m&m"), frame("base", "l0"), frame("base", "b2")]
    left_out = [frame("opti", "faro"), frame("l5", "camera")]
    text, left = with_frames(written, [*hung, *left_out], "arm.urdf")
    assert left == ("faro", "camera")
    assert text.startswith(written[: written.rindex(b"</robot>")])
    assert text.endswith(b"</robot>\n<!-- the end -->\n")
    path.write_bytes(text)
    robot = yourdfpy.URDF.load(path, load_meshes=False)
    assert robot.base_link == "base"
    for edge in hung:
        T = robot.get_transform(edge.child, edge.parent)
        np.testing.assert_allclose(T, edge.T_parent_child, rtol=0, atol=1e-12)
    assert pinocchio.buildModelFromUrdf(str(path)).existFrame("lidar")


def test_frames_alone_are_a_robot(tmp_path):
    text, left = with_frames(empty_robot('a "rig"', "base"), [frame("base", "lidar")], "rig.urdf")
    path = tmp_path / "rig.urdf"
    path.write_bytes(text)
    robot = yourdfpy.URDF.load(path, load_meshes=False)
    assert left == () and robot.robot.name == 'a "rig"'
    T = robot.get_transform("lidar", "base")
    np.testing.assert_allclose(T, frame("base", "lidar").T_parent_child, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        (TEXT.encode("utf-16"), "UTF-16; save it as UTF-8"),
        (b"<robot>", "is not XML"),
        (b"<robot><joint name='z'/></robot>", "no joint 'a'; it has z"),
    ],
)
def test_what_cannot_be_edited_is_refused(text, complaint, origins):
    with pytest.raises(InputError, match=complaint):
        with_origins(text, {"a": origins["a"]}, "arm.urdf")


@pytest.mark.parametrize("quote", ["'", '"'])
def test_a_joint_that_follows_another_is_given_another_multiplier(tmp_path, quote):
    """Whatever the names of joints, and with an offset that the file leaves out."""
    leads = """a'"<b"""
    name = "".join(f"&#{ord(letter)};" for letter in leads)
    mimic = f"<mimic multiplier={quote}2{quote} joint={quote}{name}{quote}/>"
    links = "".join(f'<link name="l{i}"/>' for i in range(3))
    joint = '<joint name="{}" type="continuous"><parent link="l{}"/><child link="l{}"/>{}</joint>'
    text = f'<robot name="r">{links}{joint.format(name, 0, 1, "")}{joint.format("f", 1, 2, mimic)}'
    changed = with_mimics(f"{text}</robot>".encode(), {"f": (leads, 2.5, -0.1)}, "arm.urdf")
    (tmp_path / "arm.urdf").write_bytes(changed)
    _, follower = read_arm(tmp_path / "arm.urdf", "l0", "l2")
    joint = follower.joint
    assert (joint.name, joint.factor, joint.shift, joint.leads) == (leads, 2.5, -0.1, False)
    with pytest.raises(InputError, match="no joint 'g' that mimics"):
        with_mimics(changed, {"g": (leads, 1.0, 0.0)}, "arm.urdf")
