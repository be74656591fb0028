"""FrameTree against a plain product of matrices and against central differences."""

import numpy as np
import pytest
import scipy.linalg

from chains import se3
from chains.errors import InputError
from chains.frames import Edge, FrameTree, Joint

RNG = np.random.default_rng(2)


def edge(name, parent, child, joint=None):
    return Edge(
        name=name,
        parent=parent,
        child=child,
        T_parent_child=se3.exp(RNG.normal(size=6)),
        joint=joint,
    )


def unit(vector):
    return np.asarray(vector, float) / np.linalg.norm(vector)


@pytest.fixture
def tree():
    """A base with markers, and an arm of slide, elbow and wrist that carries a lidar."""
    return FrameTree(
        [
            edge("markers", "base", "markers"),
            edge("lidar", "tip", "lidar"),
            edge("slide", "base", "carriage", Joint("slide", "prismatic", unit([1, -2, 0.5]))),
            edge("elbow", "carriage", "arm", Joint("elbow", "revolute", unit([0.2, 1, 3]))),
            edge("link", "arm", "forearm"),
            edge("wrist", "forearm", "tip", Joint("wrist", "revolute", unit([0, 0, -1]))),
            edge("camera", "forearm", "camera"),
        ]
    )


def motion(joint, value):
    """Return the motion (4, 4) of one joint from scipy's matrix exponential, independent of se3."""
    T = np.eye(4)
    if joint is not None and joint.kind == "revolute":
        T[:3, :3] = scipy.linalg.expm(value * np.cross(np.eye(3), joint.axis))
    elif joint is not None:
        T[:3, 3] = value * joint.axis
    return T


@pytest.fixture
def stops(tree):
    return RNG.normal(size=(3, 3)), 0.4 * RNG.normal(size=(3, len(tree.edges), 6))


def test_joints_are_named_along_the_tree_whatever_the_order_of_edges(tree):
    assert tree.joint_names == ("slide", "elbow", "wrist")
    assert FrameTree(tree.edges[::-1]).joint_names == ("slide", "elbow", "wrist")
    assert tree.edge_names == ("markers", "lidar", "slide", "elbow", "link", "wrist", "camera")


def test_path_leads_from_the_root(tree):
    assert tree.root == "base"
    assert tree.path("lidar") == (2, 3, 4, 5, 1)
    assert tree.path("base") == ()
    assert set(tree.frames) == {
        "base",
        "markers",
        "carriage",
        "arm",
        "forearm",
        "tip",
        "lidar",
        "camera",
    }


def test_place_is_the_product_along_the_path(tree, stops):
    joints, twists = stops
    value = dict(zip(tree.joint_names, joints[1], strict=True))
    expected = np.eye(4)
    for i in tree.path("lidar"):
        e = tree.edges[i]
        moved = motion(e.joint, value.get(e.name, 0.0))
        expected = expected @ e.T_parent_child @ se3.exp(twists[1, i]) @ moved
    placed = tree.place("lidar", joints, twists)
    np.testing.assert_allclose(placed.Ts_root_frame[1], expected, atol=1e-13)


def increments(tree, frame, plus, minus, step):
    """Return the central difference (K, 6) of a frame's increment on the right."""
    ahead, behind = (tree.place(frame, *at).Ts_root_frame for at in (plus, minus))
    return se3.log(se3.inverse(behind) @ ahead) / (2 * step)


@pytest.mark.parametrize("frame", ["base", "markers", "arm", "lidar", "camera"])
def test_derivatives_by_twist(tree, stops, frame):
    joints, twists = stops
    step = 1e-6
    d_twist = tree.place(frame, joints, twists).d_twist
    for i, k in np.ndindex(len(tree.edges), 6):
        d = np.zeros_like(twists)
        d[:, i, k] = step
        numerical = increments(tree, frame, (joints, twists + d), (joints, twists - d), step)
        np.testing.assert_allclose(d_twist[:, :, i, k], numerical, atol=1e-7)
        if i not in tree.path(frame):
            assert not d_twist[:, :, i].any()


@pytest.mark.parametrize("frame", ["base", "markers", "arm", "lidar", "camera"])
def test_derivatives_by_joint(tree, stops, frame):
    joints, twists = stops
    step = 1e-6
    d_joint = tree.place(frame, joints, twists).d_joint
    for j in range(3):
        d = np.zeros_like(joints)
        d[:, j] = step
        numerical = increments(tree, frame, (joints + d, twists), (joints - d, twists), step)
        np.testing.assert_allclose(d_joint[:, :, j], numerical, atol=1e-7)
    assert not tree.place("markers", joints, twists).d_joint.any()


def test_no_twists_are_zero_twists_and_one_row_serves_all_stops(tree, stops):
    joints, twists = stops
    for left, right in [
        (tree.place("lidar", joints), tree.place("lidar", joints, np.zeros_like(twists))),
        (
            tree.place("lidar", joints, twists[:1]),
            tree.place("lidar", joints, np.repeat(twists[:1], 3, axis=0)),
        ),
    ]:
        np.testing.assert_allclose(left.Ts_root_frame, right.Ts_root_frame, atol=1e-15)
        np.testing.assert_allclose(left.d_twist, right.d_twist, atol=1e-15)
        np.testing.assert_allclose(left.d_joint, right.d_joint, atol=1e-15)


def test_each_stop_is_placed_as_if_alone(tree, stops):
    joints, twists = stops
    together = tree.place("lidar", joints, twists)
    for k in range(3):
        alone = tree.place("lidar", joints[k : k + 1], twists[k : k + 1])
        np.testing.assert_allclose(together.Ts_root_frame[k], alone.Ts_root_frame[0], atol=1e-14)
        np.testing.assert_allclose(together.d_twist[k], alone.d_twist[0], atol=1e-14)


def test_a_frame_may_stand_alone():
    tree = FrameTree([], root="lidar")
    placed = tree.place("lidar", np.zeros((2, 0)), np.zeros((2, 0, 6)))
    np.testing.assert_array_equal(placed.Ts_root_frame, np.stack([np.eye(4)] * 2))
    assert placed.d_twist.shape == (2, 6, 0, 6)
    assert placed.d_joint.shape == (2, 6, 0)


SLIDE = Joint("slide", "prismatic", np.array([1.0, 0, 0]))


@pytest.mark.parametrize(
    ("edges", "root", "words"),
    [
        ([edge("1", "base", "arm"), edge("2", "opti", "faro")], None, ["'base', 'opti'", "root"]),
        ([edge("1", "base", "arm")], "opti", ["'opti', 'base'", "no parent"]),
        ([edge("1", "base", "arm")], "arm", ["'arm' cannot be the root", "'base'"]),
        ([edge("1", "arm", "tip"), edge("2", "tip", "arm")], None, ["'tip', 'arm'", "loop"]),
        (
            [edge("1", "base", "x"), edge("2", "arm", "tip"), edge("3", "tip", "arm")],
            None,
            ["'tip', 'arm'", "loop", "'base'"],
        ),
        (
            [edge("1", "base", "lidar"), edge("2", "arm", "lidar")],
            None,
            ["'lidar'", "'base' and 'arm'"],
        ),
        ([edge("1", "base", "arm"), edge("1", "arm", "tip")], None, ["edge '1'", "twice"]),
        (
            [edge("1", "base", "arm", SLIDE), edge("2", "arm", "tip", SLIDE)],
            None,
            ["joint 'slide'", "twice"],
        ),
        ([], None, ["without edges"]),
    ],
)
def test_what_is_no_tree_is_refused_by_name(edges, root, words):
    with pytest.raises(InputError) as refused:
        FrameTree(edges, root)
    for word in words:
        assert word in str(refused.value)


def test_an_unknown_frame_is_refused_and_the_nearest_named(tree):
    for ask in (tree.path, lambda frame: tree.place(frame, np.zeros((1, 3)))):
        with pytest.raises(InputError, match="frame 'lidr' is unknown; did you mean 'lidar'"):
            ask("lidr")


@pytest.mark.parametrize("shape", [(1, 2), (1, 4), (3,)])
def test_a_wrong_number_of_joints_is_refused(tree, shape):
    with pytest.raises(ValueError, match="joints must be"):
        tree.place("markers", np.zeros(shape))
