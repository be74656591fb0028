"""Where the frames are, and how that moves with every unknown."""

import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from calib.effects import Effect, OneHot, Param, Site
from calib.forward import Term, place
from calib.problem.model import Model
from calib.problem.unknowns import pose_unknown
from calib.rig import load_rig

from . import rigs

JOINTS = np.array([joints for _, joints in rigs.STOPS.values()])
COLUMNS = {"temperature_c": np.array([15.0, 20.0, 27.0, 31.0])}


class Sag(Effect):
    """Edges bend as the arm reaches out: a basis that differs from stop to stop."""

    name, site = "sag", Site.EDGE

    def params(self, rig):
        return Param("lift", "rad", 0.01), Param("slide", "m", 0.01)

    def basis(self, view):
        basis = np.zeros((view.rows, len(view.rig.tree.edges), 6, 2))
        basis[:, view.rig.tree.edge_names.index("lift"), 1, 0] = np.cos(view.joints[:, 1])
        basis[:, view.rig.tree.edge_names.index("slide"), 5, 1] = view.joints[:, 2]
        return basis


class WarmEncoder(Effect):
    """Encoders drift with temperature."""

    name, site = "warm_encoder", Site.JOINTS

    def params(self, rig):
        return tuple(Param(joint, "rad", 0.01) for joint in rig.joint_names)

    def basis(self, view):
        warm = view["temperature_c"] - 20.0
        return warm[:, None, None] / 10 * np.eye(len(view.rig.joint_names))


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    return load_rig(rigs.write(tmp_path_factory.mktemp("forward") / "box"))


def everything(rig):
    terms = Model().terms(rig, several=False)
    terms += [Term(e, e.name, np.arange(len(e.params(rig)))) for e in (Sag(), WarmEncoder())]
    return [t for t in terms if t.effect.site in (Site.EDGE, Site.JOINTS)]


def state(rig, terms, size):
    rng = np.random.default_rng(3)
    values = {t.variable: size * rng.uniform(-1, 1, len(t.free)) for t in terms}
    values |= {"noise": size * rng.uniform(-1, 1, 3)}
    poses = rng.normal(0, 1, (2, 6))
    return values | {
        n: gtsam.Pose3.Expmap(xi).matrix() for n, xi in zip(("root", "faro"), poses, strict=True)
    }


@pytest.mark.parametrize("where", ["in_root", "in_world", "in_reference"])
@pytest.mark.parametrize("frame", ["lidar", "base_markers", "arm_2", "base"])
@pytest.mark.parametrize("stops", [[0], [0, 1, 2, 3]])
def test_derivatives_by_every_unknown(rig, where, frame, stops):
    terms = everything(rig)
    columns = {name: values[stops] for name, values in COLUMNS.items()}
    chain = place(rig, terms, JOINTS[stops], columns, "root", "faro").with_joint_noise("noise")
    # Far from zero: the derivatives must hold at any state, not at the drawing alone.
    values = state(rig, terms, 0.3)
    placed = getattr(chain, where)(frame, values)
    worlds = {"in_root": set(), "in_world": {"root"}, "in_reference": {"root", "faro"}}[where]
    assert placed.d.keys() == values.keys() - {"root", "faro"} | worlds
    assert placed.T.shape == (len(stops), 4, 4)
    T_back = np.linalg.inv(placed.T)

    def moved(values):
        T = getattr(chain, where)(frame, values).T
        return np.stack(
            [gtsam.Pose3.Logmap(gtsam.Pose3(b @ t)) for b, t in zip(T_back, T, strict=True)]
        )

    for name, d in placed.d.items():
        kind = "pose" if name in ("root", "faro") else "vector"
        expected = rigs.differences(moved, values, name, kind)
        found = np.broadcast_to(d, (len(stops), *d.shape[1:])).reshape(expected.shape)
        rigs.assert_derivative(found, expected, name)


def test_the_chain_is_the_product_of_its_links(rig):
    hardware = rigs.drawn(np.random.default_rng(5))
    terms = [t for t in Model().terms(rig, several=False) if t.effect.site is not Site.BEAM]
    values = {name: twist for name, twist in hardware.frames.items()}
    values["arm_base"] = np.delete(values["arm_base"], 2)  # held: its sigma is 0
    values |= {"arm_link_length": hardware.link_m, "arm_joint_offset": hardware.joint}
    world, reference = rigs.pose((1, 2, 3), (0.4, 0.5, 0.6)), rigs.T_OPTI_FARO
    values |= {"root": world.as_matrix(), "faro": reference.as_matrix()}
    chain = place(rig, terms, JOINTS, {}, "root", "faro")
    for frame in ("lidar", "mount_markers", "base_markers", "arm_end", "base"):
        for k, joints in enumerate(JOINTS):
            expected = reference.inv() * world * rigs.placed(frame, joints, hardware)
            np.testing.assert_allclose(
                chain.in_reference(frame, values).T[k], expected.as_matrix(), atol=1e-12
            )


def test_without_a_reference_the_world_is_the_reference(rig):
    chain = place(rig, [], JOINTS, {}, "root", None)
    values = {"root": rigs.T_OPTI_FARO.as_matrix()}
    placed, world = chain.in_reference("lidar", values), chain.in_world("lidar", values)
    np.testing.assert_array_equal(placed.T, world.T)
    assert placed.d.keys() == world.d.keys() == {"root"}


def test_joint_noise_adds_to_the_joints(rig):
    noise = np.array([0.01, -0.02, 0.003])
    quiet = place(rig, [], JOINTS + noise, {}, "root", None).in_root("lidar", {})
    noisy = place(rig, [], JOINTS, {}, "root", None).with_joint_noise("noise")
    assert noisy.variables == ("root", "noise")
    np.testing.assert_allclose(noisy.in_root("lidar", {"noise": noise}).T, quiet.T, atol=1e-14)


def test_a_term_shows_only_its_free_parameters(rig):
    ring = np.array([0, 1, -1, 2])

    class Offset(Effect):
        name, site = "offset", Site.BEAM

        def params(self, rig):
            return tuple(Param(str(k), "m", 1.0) for k in range(3))

        def basis(self, view):
            values = np.array([[1.0, 0, 0], [2.0, 0, 0], [3.0, 0, 0], [4.0, 0, 0]])
            if view is None:
                return OneHot(ring, values, 3)
            return values[:, :, None] * (ring[:, None, None] == np.arange(3))

    term = Term(Offset(), "offset", np.array([0, 2]))
    dense, sparse = term.basis("dense"), term.basis(None)
    assert sparse.size == 2
    picked = sparse.values[:, :, None] * (sparse.index[:, None, None] == np.arange(2))
    np.testing.assert_array_equal(picked, dense)
    np.testing.assert_array_equal(dense[:, 0], [[1, 0], [0, 0], [0, 0], [0, 4]])


def test_retract_moves_poses_as_the_chain_assumes():
    """The differences above move poses by gtsam's exponential, on the right."""
    twist = np.array([0.3, -0.2, 0.5, 1.0, 2.0, 3.0])
    T = rigs.T_OPTI_FARO
    unknown = pose_unknown("T", T.as_matrix(), np.ones(6))
    expected = (T * RigidTransform.from_exp_coords(twist)).as_matrix()
    np.testing.assert_allclose(
        rigs.retract(unknown.kind, unknown.mean, twist), expected, atol=1e-12
    )
    np.testing.assert_allclose(unknown.moved(unknown.mean, twist), expected, atol=1e-12)
    np.testing.assert_allclose(unknown.difference(unknown.mean, expected), twist, atol=1e-12)
