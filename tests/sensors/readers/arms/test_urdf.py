"""Arms as URDF and xacro: base and tip found, other files applied, what is missing named."""

from pathlib import Path

import numpy as np
import pytest

from chains.arm import read_arm
from chains.errors import InputError
from chains.frames import FrameTree
from sensors.readers.arms.urdf import read_urdf
from sensors.readers.base import Options

LINKS = "".join(f'<link name="{n}"/>' for n in ("foot", "a", "b", "hand", "tool", "wheel"))
JOINT = '<joint name="{}" type="{}"><parent link="{}"/><child link="{}"/>{}</joint>'
TURN = '<origin xyz="0 0 0.3" rpy="0.4 0 0"/><axis xyz="0 0 1"/><limit lower="-2" upper="2"/>'
JOINTS = (
    JOINT.format("mounted", "fixed", "foot", "a", "")
    + JOINT.format("q1", "revolute", "a", "b", TURN)
    + JOINT.format("q2", "revolute", "b", "hand", TURN)
    + JOINT.format("held", "fixed", "hand", "tool", "")
    + JOINT.format("rolls", "continuous", "foot", "wheel", "")
)
ARM = f'<robot name="r">{LINKS}{JOINTS}</robot>'
FINGERS = '<link name="f1"/><link name="f2"/>' + "".join(
    JOINT.format(f"g{k}", "prismatic", "tool", f"f{k}", "") for k in (1, 2)
)
MACRO = """<robot xmlns:xacro="http://www.ros.org/wiki/xacro">
  <xacro:include filename="$(find nowhere)/urdf/common.xacro"/>
  <xacro:macro name="two" params="parent name *origin big">
    <joint name="${name}_base" type="fixed"><xacro:insert_block name="origin"/>
      <parent link="${parent}"/><child link="${name}_0"/></joint>
    <link name="${name}_0"><xacro:default_inertial/></link>
    <joint name="${name}_1" type="revolute"><origin xyz="0 0 ${0.1 + 0.2}" rpy="${M_PI / 2} 0 0"/>
      <parent link="${name}_0"/><child link="${name}_end"/><axis xyz="0 0 1"/></joint>
    <link name="${name}_end"/>
  </xacro:macro>
</robot>"""


def quiet(what, done, total):
    pass


def read(folder, files, **options):
    for name, text in files.items():
        (folder / name).write_text(text)
    return read_urdf([folder / name for name in files], Options(**options), quiet)


def tip(folder, arm, joints):
    (folder / "out.urdf").write_text(arm.urdf)
    tree = FrameTree(read_arm(folder / "out.urdf", arm.base, arm.tip))
    return tree.place(arm.tip, np.array([joints])).Ts_root_frame[0]


def test_the_longest_chain_is_the_arm(tmp_path):
    found = read(tmp_path, {"arm.urdf": ARM})
    assert (found.arm.base, found.arm.tip) == ("a", "hand")
    assert "q1, q2; from hand hang tool" in found.understood[0]


def test_flags_name_other_ends(tmp_path):
    found = read(tmp_path, {"arm.urdf": ARM}, base="foot", tip="tool")
    assert (found.arm.base, found.arm.tip) == ("foot", "tool")


def test_an_srdf_names_the_ends(tmp_path):
    chain = '<chain base_link="foot" tip_link="tool"/>'
    srdf = f'<robot name="r"><group name="g">{chain}</group></robot>'
    found = read(tmp_path, {"arm.urdf": ARM, "arm.srdf": srdf})
    assert (found.arm.base, found.arm.tip) == ("foot", "tool")


def test_limits_are_narrowed(tmp_path):
    limits = "joint_limits: {q1: {has_position_limits: true, min_position: -1, max_position: 0.5}}"
    arm = read(tmp_path, {"arm.urdf": ARM, "joint_limits.yaml": limits}).arm
    (tmp_path / "out.urdf").write_text(arm.urdf)
    first = read_arm(tmp_path / "out.urdf", arm.base, arm.tip)[0].joint
    assert (first.lower, first.upper) == (-1.0, 0.5)


def test_offsets_move_the_zeros(tmp_path):
    plain = read(tmp_path, {"arm.urdf": ARM}).arm
    moved = read(tmp_path, {"arm.urdf": ARM, "offsets.yaml": "{q1: 0.1, q2: -0.3}"}).arm
    expected = tip(tmp_path, plain, [0.6, -0.8])
    np.testing.assert_allclose(tip(tmp_path, moved, [0.5, -0.5]), expected, atol=1e-9)


def test_a_file_of_macros_is_called_and_what_is_missing_is_named(tmp_path):
    found = read(tmp_path, {"arm.xacro": MACRO})
    assert (found.arm.base, found.arm.tip) == ("arm_0", "arm_end")
    np.testing.assert_allclose(tip(tmp_path, found.arm, [0.0])[:3, 3], [0, 0, 0.3], atol=1e-12)
    said = " ".join(found.odd)
    for part in ("--package nowhere=", "common.xacro", "default_inertial", "name = arm"):
        assert part in said


def test_a_package_that_is_named_is_used(tmp_path):
    (tmp_path / "pkg/urdf").mkdir(parents=True)
    (tmp_path / "pkg/urdf/common.xacro").write_text(
        '<robot xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:property name="M_PI" value="2"/>'
        '<xacro:macro name="default_inertial" params=""><inertial><mass value="7"/></inertial>'
        "</xacro:macro></robot>"
    )
    found = read(tmp_path, {"arm.xacro": MACRO}, packages={"nowhere": tmp_path / "pkg"})
    assert 'value="7"' in found.arm.urdf
    assert len(found.odd) == 1 and "called" in found.odd[0]


@pytest.mark.parametrize(
    ("files", "options", "said"),
    [
        ({"arm.urdf": ARM}, {"tip": "hnad"}, "did you mean hand"),
        ({"arm.urdf": ARM.replace("</robot>", FINGERS + "</robot>")}, {}, "f1, f2; say --tip"),
        ({"arm.urdf": ARM}, {"base": "tool", "tip": "tool"}, "nothing moves"),
        ({"arm.urdf": "<robot"}, {}, "not XML"),
        ({"arm.urdf": "<sdf/>"}, {}, "no URDF"),
        ({"arm.urdf": " "}, {}, "is empty"),
        ({"arm.yaml": "q1: 1"}, {}, "one description"),
        ({"arm.urdf": ARM, "x.yaml": "q9: 1"}, {}, "neither joint_limits nor offsets"),
        ({"arm.xacro": MACRO}, {"packages": {"nowhere": Path("/no")}}, "no such folder"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_one_sentence(tmp_path, files, options, said):
    with pytest.raises(InputError, match=said):
        read(tmp_path, files, **options)


def test_an_expanded_file_may_name_the_namespace_of_macros(tmp_path, monkeypatch):
    """As xacro itself writes it: nothing is left to expand, so nothing is needed to do so."""
    expanded = ARM.replace("<robot", '<robot xmlns:xacro="http://www.ros.org/wiki/xacro"')

    def write_out(path, packages):
        raise AssertionError("taken for macros")

    monkeypatch.setattr("chains.readers.xacro.write_out", write_out)
    found = read(tmp_path, {"arm.urdf": expanded})
    (tmp_path / "arm.urdf").write_text(found.arm.urdf)
    assert [e.name for e in read_arm(tmp_path / "arm.urdf", "a", "hand")] == ["q1", "q2"]
    with pytest.raises(AssertionError, match="taken for macros"):
        read(tmp_path, {"macro.urdf": MACRO})
