"""URDF as a tree of links and joints: base and tip of the arm, and the zeros of its joints."""

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from chains.arm import read_arm
from chains.errors import InputError
from chains.frames import FrameTree
from chains.readers.urdf import apply_note, arm_ends, joint_names, parse_robot

ARM = """<robot name="r">
<link name="foot"/><link name="rail"/><link name="cart"/><link name="hand"/>
<joint name="bolted" type="fixed"><parent link="foot"/><child link="rail"/></joint>
<joint name="slide" type="prismatic"><parent link="rail"/><child link="cart"/>
<origin xyz="0.1 0 0.2" rpy="0.3 0 -0.5"/><axis xyz="0 2 0"/><limit lower="-1" upper="1"/></joint>
<joint name="turn" type="revolute"><parent link="cart"/><child link="hand"/>
<origin xyz="0 0.4 0" rpy="0 1 0"/><axis xyz="1 0 1"/><limit lower="-2" upper="2"/></joint>
</robot>"""
WHERE = Path("arm.urdf")


@pytest.fixture
def robot():
    """The arm as a tree."""
    return parse_robot(WHERE, ARM)


def hand(folder, robot, slide_m, turn_rad):
    """T_rail_hand (4, 4)."""
    (folder / "arm.urdf").write_text(ElementTree.tostring(robot, encoding="unicode"))
    tree = FrameTree(read_arm(folder / "arm.urdf", "rail", "hand"))
    return tree.place("hand", np.array([[slide_m, turn_rad]])).Ts_root_frame[0]


def test_an_arm_begins_where_something_moves(robot):
    assert arm_ends(WHERE, robot, None, None) == ("rail", "hand", "")
    assert joint_names(robot, "rail", "hand") == ["slide", "turn"]
    with pytest.raises(InputError, match="nothing moves between foot and rail"):
        arm_ends(WHERE, robot, "foot", "rail")


def test_a_reading_after_the_zeros_moved_is_what_its_sum_was(robot, tmp_path):
    before = hand(tmp_path, robot, 0.25, -0.6)
    said = apply_note(Path("offsets.yaml"), {"slide": 0.05, "turn": -0.2, "other": 1}, robot)
    assert "2 offsets" in said and "other are not joints" in said
    np.testing.assert_allclose(hand(tmp_path, robot, 0.2, -0.4), before, atol=1e-9)
