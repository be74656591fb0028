"""What is hidden in a simulated recording is what its truth says."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

import calib.effects
from calib.effects import CATALOGUE, Effect, FrameOffset, Param, Site
from calib.problem.model import Source
from calib.rig import load_rig
from calib.simulation import Spec, simulate
from calib.simulation.room import build
from calib.simulation.truth import draw, stream

from .hidden import as_needed, coarse
from .simulated import BELOW_M, EXACT, changed, made, nominal, off_mesh, pose, rays, seen


@pytest.fixture(scope="module")
def exact(tmp_path_factory: pytest.TempPathFactory) -> tuple[Source, dict]:
    return made(tmp_path_factory.mktemp("exact") / "rec", EXACT)


# ------------------------------------------------------------------------------------------ truth


@pytest.fixture(scope="module")
def paper_rig(tmp_path_factory: pytest.TempPathFactory):
    folder = tmp_path_factory.mktemp("prior") / "rec"
    simulate(EXACT, folder, 0)
    return load_rig(folder)


def test_hardware_is_drawn_from_the_priors_on_paper(paper_rig):
    truths = [draw(paper_rig, Spec(), {}, seed) for seed in range(60)]
    z: dict[str, list] = {}
    for truth in truths:
        for effect, theta in truth.effects:
            sigma = np.array([p.sigma for p in effect.params(paper_rig)])
            if effect.site is not Site.BEAM:
                assert not theta[sigma == 0].any()
                kind = "frame" if isinstance(effect, FrameOffset) else effect.name
                z.setdefault(kind, []).append(theta[sigma > 0] / sigma[sigma > 0])
            else:
                lidar = paper_rig.lidar
                assert theta.mean() == pytest.approx(lidar.typical_range_offset_m)
                assert theta.std() == pytest.approx(lidar.typical_ring_offset_m)
    assert set(z) == {"frame", "arm_link_length", "arm_joint_offset"}
    for kind, values in z.items():
        spread = np.concatenate(values)
        expected = 1.0 if kind == "frame" else 0.6
        assert spread.std() == pytest.approx(expected, abs=4 * expected / np.sqrt(2 * len(spread)))


def test_the_truth_file_says_what_the_chain_does(tmp_path):
    source, truth = made(tmp_path / "rec", changed(EXACT, build_error=1))
    moved = {name: np.array(T) for name, T in truth["frames"].items()}
    edges = source.rig.tree.edges
    lengths = dict(zip(source.rig.arm_edges, truth["effects"]["arm_link_length"], strict=True))
    offsets = truth["effects"]["arm_joint_offset"]
    bent = []
    for edge in edges:
        T = moved.get(edge.name, edge.T_parent_child).copy()
        length_m = np.linalg.norm(T[:3, 3])
        if edge.name in lengths and length_m > 0:
            T[:3, 3] *= 1 + lengths[edge.name] / length_m
        bent.append(replace(edge, T_parent_child=T))
    source = replace(source, rig=replace(source.rig, tree=type(source.rig.tree)(bent)))
    for k, at in enumerate(truth["stops"].values()):
        chain = nominal(source, "lidar", source.recording.joints[k] + offsets)
        T_faro_lidar = pose(at["T_faro_root"]) * chain
        assert np.allclose(T_faro_lidar.as_matrix(), at["T_faro_lidar"], atol=1e-9)
        off_m, _ = off_mesh(source, truth, k)
        ring = np.array(truth["effects"]["ring_range_offset"])[source.recording.scan(k).ring]
        assert np.abs(off_m - ring).max() < 1e-5


def test_mesh_error_is_smooth_along_the_normals_and_of_the_size_asked():
    errors, near = [], []
    for seed in range(6):
        room = build("box", 0.0006, stream(seed, "room"))
        move = room.measured.vertices_m - room.true.vertices_m
        # Every wall of the box faces along an axis, so its error has one component only.
        assert (np.sort(np.abs(move), axis=1)[:, :2] < 1e-12).all()
        size = move.sum(axis=1)
        errors.append(size)
        a, b, _ = room.true.triangles.T
        near.append(size[a] - size[b])
    spread = np.concatenate(errors).std()
    assert spread == pytest.approx(0.0006, rel=0.25)
    assert np.concatenate(near).std() < 0.3 * spread


def test_recordings_of_one_world_share_all_but_the_lidar(tmp_path):
    spec = changed(EXACT, build_error=1, mesh_error_m=0.001, world_seed=5)
    a, truth_a = made(tmp_path / "a", spec, seed=1)
    b, truth_b = made(tmp_path / "b", changed(spec, lidar="hesai_pandarxt32"), seed=2)
    for file in ("reference/mesh.ply", "targets.csv"):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()
    same = {name: truth_a["frames"][name] == truth_b["frames"][name] for name in truth_a["frames"]}
    assert same == {name: name not in a.rig.beyond_arm for name in same}
    for name in ("arm_link_length", "arm_joint_offset"):
        assert truth_a["effects"][name] == truth_b["effects"][name]
    assert not np.allclose(a.recording.joints, b.recording.joints)


# ---------------------------------------------------------------------------------------- effects


class Lie(Effect):
    """One parameter that adds a constant at any site."""

    name = "lie"

    def __init__(self, site: Site, unit: np.ndarray, sigma: float = 0.001) -> None:
        self.site, self.unit, self.sigma = site, unit, sigma

    def params(self, rig):
        return (Param("a", "m", self.sigma),)

    def basis(self, view):
        return self.unit[None, ..., None]


@pytest.fixture
def lying(monkeypatch, tmp_path):
    """Simulates perfect hardware with one constant lie, and gives its size too."""

    def run(site: Site, unit: np.ndarray, size: float = 2.0, **fields: object):
        monkeypatch.setattr(calib.effects, "CATALOGUE", (*CATALOGUE, Lie(site, unit)))
        source, truth = made(tmp_path / "lie", changed(EXACT, **fields), lie=size)
        (theta,) = truth["effects"]["lie"]
        assert abs(theta) == pytest.approx(size * 0.001)
        assert truth["hidden"] == {"lie": size}
        return source, truth, theta

    return run


def test_a_range_lie_adds_to_the_measured_range(lying):
    source, truth, theta = lying(Site.BEAM, np.array([1.0, 0, 0]))
    assert np.abs(off_mesh(source, truth, 0)[0] - theta).max() < 1e-5


@pytest.mark.parametrize("axis", [1, 2])
def test_an_angle_lie_turns_the_measured_direction(lying, exact, axis):
    source, _, theta = lying(Site.BEAM, np.eye(3)[axis])
    told, true = source.recording.scan(0).xyz_m, exact[0].recording.scan(0).xyz_m
    ahead = source.rig.lidar.beam_origin_m[0]

    def angles(p):
        flat = np.hypot(p[:, 0], p[:, 1]) - ahead
        return np.arctan2(p[:, 1], p[:, 0]) if axis == 1 else np.arctan2(p[:, 2], flat)

    turned = np.angle(np.exp(1j * (angles(told) - angles(true))))
    assert np.abs(turned - theta).max() < 2e-5


def test_a_displaced_surface_is_met_where_it_truly_is(lying):
    source, truth, theta = lying(Site.REFERENCE, np.array([0, 0, 1.0]))
    off_m, hits = off_mesh(source, truth, 0)
    name = source.recording.stops[0]
    _, direction, _ = rays(source, 0, truth["stops"][name]["T_faro_lidar"])
    along = np.einsum("ni,ni->n", hits.normal, direction)
    assert np.abs(off_m - theta * hits.normal[:, 2] / along).max() < 1e-5
    assert np.abs(off_m).max() > abs(theta) / 2


def test_a_joint_lie_bends_the_arm_behind_its_report(lying):
    source, truth, theta = lying(Site.JOINTS, np.array([0, 1.0, 0, 0, 0, 0]))
    joints = source.recording.joints + theta * np.eye(6)[1]
    for k, at in enumerate(truth["stops"].values()):
        T = pose(at["T_faro_root"]) * nominal(source, "lidar", joints[k])
        assert np.allclose(T.as_matrix(), at["T_faro_lidar"], atol=1e-9)


def test_an_edge_lie_moves_the_frames_behind_it(lying, paper_rig):
    tree = paper_rig.tree
    unit = np.zeros((len(tree.edges), 6))
    unit[tree.edge_names.index("joint_3"), 3] = 1.0
    source, truth, theta = lying(Site.EDGE, unit)
    at = truth["stops"]["L00P00"]
    T_root_lidar = pose(at["T_faro_root"]).inv() * pose(at["T_faro_lidar"])
    joints = source.recording.joints[0]
    before = nominal(source, "arm_3", joints * [1, 1, 0, 1, 1, 1])
    behind = before.inv() * nominal(source, "lidar", joints)
    expected = before * RigidTransform.from_translation([theta, 0, 0]) * behind
    assert np.allclose(T_root_lidar.as_matrix(), expected.as_matrix(), atol=1e-9)


def test_a_tracker_lie_adds_to_what_is_seen(lying, exact):
    unit = np.zeros((2, 6))
    unit[1, 4] = 1.0
    source, _, theta = lying(Site.TRACKER, unit)
    for k in range(len(source.recording.stops)):
        step = seen(exact[0], "mount_markers", k).inv() * seen(source, "mount_markers", k)
        assert np.allclose(step.translation, [0, theta, 0], atol=1e-9)
        base = seen(exact[0], "base_markers", k).inv() * seen(source, "base_markers", k)
        assert np.allclose(base.as_matrix(), np.eye(4), atol=1e-9)


def test_a_target_lie_moves_the_sphere_on_its_rod(lying):
    source, truth, theta = lying(Site.TARGET, np.array([1.0, 0, 0]))
    targets = source.recording.targets
    rod = targets.lower_m - targets.upper_m
    hung = targets.lower_m + BELOW_M * rod / np.linalg.norm(rod, axis=1, keepdims=True)
    sphere = pose(truth["T_faro_opti"]).inv().apply(targets.faro_m)
    assert np.allclose(sphere - hung, [theta, 0, 0], atol=1e-9)


def test_a_noise_lie_scales_the_scatter(lying):
    source, truth, theta = lying(Site.NOISE, np.array([1.0]), size=1000.0, noise=1)
    scan = source.recording.scan(0)
    _, hits = off_mesh(source, truth, 0)
    sigma_m = source.rig.lidar.sigma_range(hits.range_m, hits.incidence_rad)
    found = np.sqrt(np.mean((scan.range_std_m / sigma_m) ** 2))
    assert found == pytest.approx(np.exp(theta), rel=0.05)


ON_THIS_RIG = [effect for effect in CATALOGUE if effect.joint_kind not in ("prismatic", "mimic")]


@pytest.mark.parametrize("effect", ON_THIS_RIG, ids=lambda e: e.name)
def test_every_effect_can_be_hidden_at_its_size(paper_rig, effect):
    rig = as_needed(coarse(paper_rig), effect)
    truth = draw(rig, Spec(build_error=0), {effect.name: 3.0}, 1)
    ((hidden, theta),) = (pair for pair in truth.effects if pair[0].name == effect.name)
    sigma = np.array([p.sigma for p in hidden.params(rig)])
    free = sigma > 0
    assert np.sqrt(np.mean((theta[free] / sigma[free]) ** 2)) == pytest.approx(3.0)
    assert not theta[~free].any()
