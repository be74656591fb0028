"""A serial chain against the tree of frames, which scipy's exponentials judge elsewhere."""

import numpy as np
import pytest

from chains.frames import Edge, FrameTree
from chains.serial import CHUNK, SerialChain

from .arms import TABLES, edges_of


@pytest.mark.parametrize("name", TABLES)
def test_it_is_where_the_tree_is_and_moves_as_it_does(tmp_path, name):
    edges = edges_of(tmp_path, name)
    tree, chain = FrameTree(edges), SerialChain(edges)
    assert chain.joint_names == tree.joint_names
    joints = np.random.default_rng(0).uniform(-3, 3, (CHUNK + 3, len(tree.joint_names)))
    placed, axes = tree.place("arm_end", joints), chain.axes(joints)
    np.testing.assert_allclose(chain.place(joints), placed.Ts_root_frame, atol=1e-12)
    np.testing.assert_array_equal(chain.place(joints), axes.T)
    R = axes.T[:, None, :3, :3]
    own = placed.d_joint.mT.reshape(len(joints), -1, 2, 3)
    ours = axes.jacobian().mT.reshape(own.shape)
    np.testing.assert_allclose(ours, np.matvec(R[:, :, None], own), atol=1e-12)


def test_of_no_joint_and_of_no_pose_there_is_a_place_too():
    T = np.eye(4)
    T[:3, 3] = 1, 2, 3
    still = SerialChain([Edge(name="a", parent="base", child="tip", T_parent_child=T)])
    assert np.array_equal(still.place(np.zeros((2, 0))), [T, T])
    assert still.axes(np.zeros((2, 0))).jacobian().shape == (2, 6, 0)
    assert still.place(np.zeros((0, 0))).shape == (0, 4, 4)
