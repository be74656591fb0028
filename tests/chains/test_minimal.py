"""What geometry can be off by: complete, minimal, and counted as the literature does."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from chains import minimal, se3
from chains.frames import Edge, FrameTree, Joint
from chains.minimal import own_errors

from .arms import TABLES, edges_of


def in_any_frame(edges, rng):
    """The same arm, its links' frames drawn elsewhere: turned and slid along each joint's axis."""
    out, before = [], np.eye(4)
    for each in edges:
        T, joint = before @ each.T_parent_child, each.joint
        before = np.eye(4)
        if joint is not None:
            G = se3.exp(np.concatenate([rng.normal(size=3), np.zeros(3)]))
            if joint.kind == "revolute":
                G = se3.exp(np.concatenate([np.zeros(3), 0.3 * rng.normal() * joint.axis])) @ G
            T, before = T @ G, se3.inverse(G)
            joint = replace(joint, axis=G[:3, :3].T @ joint.axis)
        out.append(replace(each, T_parent_child=T, joint=joint))
    return out


def exp(twists):
    """Rigid transforms by scipy, of rad and m."""
    return RigidTransform.from_exp_coords(twists)


def tool(edges, twists, joints):
    """T_base_tip at every pose as plain products of scipy's transforms."""
    T = RigidTransform.identity(len(next(iter(joints.values()))))
    for each, twist in zip(edges, twists, strict=True):
        T = T * RigidTransform.from_matrix(each.T_parent_child) * exp(twist)
        if each.joint is not None:
            T = T * exp(joints[each.joint.name][:, None] * each.joint.screw)
    return T


def motions(edges, ways, poses=20):
    """How the tool moves (6 poses, n) per unit of each way (E, 6, n), by central differences."""
    rng, step = np.random.default_rng(7), 1e-5
    joints = {e.joint.name: rng.uniform(-3, 3, poses) for e in edges if e.joint is not None}
    back = tool(edges, np.zeros((len(edges), 6)), joints).inv()
    columns = []
    for way in np.moveaxis(ways, 2, 0):
        ahead, behind = ((back * tool(edges, s * step * way, joints)) for s in (1, -1))
        columns.append((ahead.as_exp_coords() - behind.as_exp_coords()) / (2 * step))
    return np.reshape(columns, (len(columns), -1)).T


def all_ways(edges, own, base_held, tip_held):
    """The base's and the tool's six, zeros, lengths and slips, as twists (E, 6, n) of the edges."""
    names, ways = [e.name for e in edges], []

    def way(edge, twist):
        ways.append(np.zeros((len(edges), 6)))
        ways[-1][edge] = twist

    for six, edge in ((base_held, 0), (tip_held, len(edges) - 1)):
        for twist in np.eye(6) if six else ():
            way(edge, twist)
    for i, each in enumerate(edges):
        if each.joint is not None:
            way(i, each.joint.screw)
        if each.name in own.lengths:
            way(i, [0, 0, 0, *own.lengths[each.name]])
    for slip in own.slips:
        way(names.index(slip.edge), slip.twist)
    return np.stack(ways, axis=2)


def rank(columns):
    s = np.linalg.svd(columns / np.linalg.norm(columns, axis=0), compute_uv=False)
    s = s / s[0]
    assert not ((s > 1e-7) & (s < 1e-4)).any(), "no doubt about the rank"
    return int((s > 1e-5).sum())


@pytest.mark.parametrize("drawn", ["as printed", "in any frame"])
@pytest.mark.parametrize("name", TABLES)
@pytest.mark.long
def test_all_that_geometry_can_be_and_nothing_twice(tmp_path, name, drawn):
    """Rank of all names together is 4 R + 2 P + 6, and each way here adds one to it."""
    edges = edges_of(tmp_path, name)
    if drawn == "in any frame":
        edges = in_any_frame(edges, np.random.default_rng(3))
    kinds = [e.joint.kind for e in edges if e.joint is not None]
    full = 4 * kinds.count("revolute") + 2 * kinds.count("prismatic") + 6
    arm = tuple(e.name for e in edges)
    for base_held, tip_held in ((True, True), (False, True), (True, False), (False, False)):
        own = own_errors(FrameTree(edges), (arm,), base_held, (tip_held,))
        ways = all_ways(edges, own, base_held, tip_held)
        columns = motions(edges, ways)
        assert rank(columns) == full, "complete"
        said = columns.shape[1] - len(own.slips)
        assert rank(columns[:, :said]) == full - len(own.slips), "minimal"


@pytest.mark.parametrize("name", TABLES)
def test_the_threshold_does_not_decide(tmp_path, monkeypatch, name):
    """A direction is new or it is not; and where a URDF holds calibrated axes, parallel ones
    0.3 mrad from it say, no direction becomes new."""

    edges, rng = edges_of(tmp_path, name), np.random.default_rng(5)

    def found(edges):
        slips = own_errors(FrameTree(edges), (tuple(e.name for e in edges),), True, (True,)).slips
        return [(slip.edge, slip.name) for slip in slips]

    ours = found(edges)
    for _ in range(3):
        off = [np.concatenate([3e-4 * rng.normal(size=3), np.zeros(3)]) for _ in edges]
        moved = [
            replace(e, T_parent_child=e.T_parent_child @ exp(x).as_matrix())
            for e, x in zip(edges, off, strict=True)
        ]
        assert found(moved) == ours
    monkeypatch.setattr(minimal, "NEW", 1e-6)
    assert found(edges) == ours


def test_axes_that_are_drawn_as_meeting_may_miss_each_other(tmp_path):
    """Of the Puma's wrist; a length has nothing to act on where the origin is zero."""
    edges = edges_of(tmp_path, "puma560")
    slips = own_errors(FrameTree(edges), (tuple(e.name for e in edges),), True, (True,)).slips
    assert [s.name for s in slips if s.edge == "j6"] == ["tilt_a", "shift_a", "shift_b"]
    for slip in slips:
        assert np.isclose(np.linalg.norm(slip.twist), 1)
        assert not np.any(slip.twist[:3]) or not np.any(slip.twist[3:]), "one unit each"
        joint = next(e.joint for e in edges if e.name == slip.edge)
        assert abs(joint.axis @ (slip.twist[:3] + slip.twist[3:])) < 1e-12


def test_an_arm_without_joints_has_no_geometry_of_its_own():
    edges = [Edge(name="a", parent="base", child="tip", T_parent_child=se3.exp(np.ones(6)))]
    assert own_errors(FrameTree(edges), (("a",),), False, (False,)).slips == ()
    joint = Joint("b", "revolute", np.array([0.0, 0, 1]))
    turn = Edge(name="b", parent="tip", child="end", T_parent_child=np.eye(4), joint=joint)
    tree = FrameTree([*edges, turn])
    assert [s.edge for s in own_errors(tree, (("a", "b"),), False, (False,)).slips] == ["b"] * 4
