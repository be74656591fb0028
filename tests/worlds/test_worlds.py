"""The worlds are what they say: geometry by closed forms, files by the truth beside them."""

from __future__ import annotations

import ast
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from . import World, arm, effects, room, write
from .beams import TAIL_DOF, averaged, model
from .hardware import SIGMA_MESH_M, SIGMA_TRACKER_M
from .knobs import LIDARS
from .poses import inverse, moved, pose, quaternion, rpy, turn, turn_vector

SMALL = World(seed=3, locations=2, stops=2, beams=400)


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """A small recording and its truth."""
    folder = tmp_path_factory.mktemp("world") / "recording"
    return folder, write(SMALL, folder)


def test_nothing_of_the_program_is_imported():
    for path in Path(__file__).parent.glob("*.py"):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        names = [a.name for n in ast.walk(tree) if isinstance(n, ast.Import) for a in n.names]
        names += [n.module or "" for n in ast.walk(tree) if isinstance(n, ast.ImportFrom)]
        assert not {n.split(".")[0] for n in names} & {"calib", "chains", "sensors"}, path


def test_rotations_turn_as_they_should():
    assert np.allclose(turn([0.0, 0.0, 1.0], np.pi / 2) @ [1, 0, 0], [0, 1, 0])
    assert np.allclose(rpy(np.pi / 2, 0, np.pi / 2) @ [0, 1, 0], [0, 0, 1])
    vector = np.random.default_rng(0).standard_normal((50, 3))
    q = quaternion(turn_vector(vector))
    half = np.linalg.norm(vector, axis=1) / 2
    wanted = np.column_stack([np.cos(half), np.sin(half)[:, None] * vector / half[:, None] / 2])
    assert np.allclose(np.abs(np.sum(q * wanted, axis=1)), 1) and np.all(q[:, 0] >= 0)


def test_the_arm_reaches_where_trigonometry_says():
    rng = np.random.default_rng(1)
    extra = rng.normal(0, 0.003, 7) * (np.linalg.norm(arm.ORIGINS, axis=1) > 0)
    angles = rng.uniform(-1, 1, (20, 6))
    T = arm.along(angles, arm.lengthened(extra))[:, -1]
    q1, q2, q3, q4, q5, _ = angles.T
    zero, one = np.zeros(20), np.ones(20)
    upper = np.column_stack([-np.sin(q2), zero, np.cos(q2)])
    fore = np.column_stack([np.sin(q3 - q2), zero, np.cos(q3 - q2)])
    across = np.column_stack([np.cos(q3 - q2), zero, -np.sin(q3 - q2)])  # of the forearm, in plane
    side = np.column_stack([zero, one, zero])
    bent = np.cos(q4)[:, None] * across + np.sin(q4)[:, None] * side
    hand = np.cos(q5)[:, None] * fore + np.sin(q5)[:, None] * bent
    reach = (0.35 + extra[2]) * upper + (0.305 + extra[4]) * fore + (0.075 + extra[6]) * hand
    reach[:, 2] += 0.205 + extra[0]
    c, s = np.cos(q1), np.sin(q1)
    wanted = np.column_stack([c * reach[:, 0] - s * reach[:, 1], s * reach[:, 0] + c * reach[:, 1]])
    assert np.allclose(T[:, :2, 3], wanted, atol=1e-12)
    assert np.allclose(T[:, 2, 3], reach[:, 2], atol=1e-12)


def test_gravity_pulls_with_what_the_weights_gain_in_height():
    """Torque about a joint is minus the derivative of the potential energy."""
    angles = np.random.default_rng(2).uniform(-1, 1, (5, 6))

    def energy(q):
        return arm.G * arm.along(q)[:, :6, 2, 3] @ arm.MASSES_KG

    step = 1e-6 * np.eye(6)
    slope = [(energy(angles + d) - energy(angles - d)) / 2e-6 for d in step]
    assert np.allclose(arm.gravity_torque(angles), -np.transpose(slope), atol=1e-6)
    assert np.abs(arm.gravity_torque(angles)[:, 1]).max() > 1


def test_rays_end_on_the_nearest_rectangle():
    quads = room.furnished(np.random.default_rng(4))
    rng = np.random.default_rng(5)
    towards = rng.standard_normal((500, 3))
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    start = np.array([0.3, -0.2, 1.1])
    reach, which = quads.hit(start, towards)
    assert np.all(which >= 0) and len(set(which)) > 12
    points = start + reach[:, None] * towards
    corner, u, v = quads.corner[which], quads.u[which], quads.v[which]
    assert np.abs(np.sum((points - corner) * quads.normal[which], axis=1)).max() < 1e-12
    for edge in (u, v):
        share = np.sum((points - corner) * edge, axis=1) / np.sum(edge**2, axis=1)
        assert share.min() > -1e-12 and share.max() < 1 + 1e-12
    # Nothing stands nearer: short of the end, a ray met no rectangle's plane within its edges.
    for k in range(0, 500, 25):
        for q in range(len(quads.corner)):
            plane = np.column_stack([-towards[k], quads.u[q], quads.v[q]])
            if abs(np.linalg.det(plane)) > 1e-9:
                t, a, b = np.linalg.solve(plane, start - quads.corner[q])
                assert not (1e-6 < t < reach[k] - 1e-9 and 0 < a < 1 and 0 < b < 1)


def test_walls_of_the_room_face_inwards():
    quads = room.furnished(np.random.default_rng(4))
    middle = quads.corner[:6] + (quads.u + quads.v)[:6] / 2
    assert np.all(np.sum(([0, 0, 1.45] - middle) * quads.normal[:6], axis=1) > 1)


def test_the_mesh_is_off_as_much_as_it_should_be():
    quads = room.furnished(np.random.default_rng(6))
    sizes = []
    for seed in range(12):
        mesh = room.scanned(quads, np.random.default_rng(seed), 0.0006, 0.0)
        exact = room.scanned(quads, np.random.default_rng(seed), 0.0, 0.0)
        sizes.append(np.mean(np.sum((mesh.vertices - exact.vertices) ** 2, axis=1)))
    assert np.sqrt(np.mean(sizes)) == pytest.approx(0.0006, rel=0.08)
    bowed = room.scanned(quads, np.random.default_rng(0), 0.0, 0.005).vertices - exact.vertices
    assert np.linalg.norm(bowed, axis=1).max() == pytest.approx(0.005, rel=0.01)
    assert np.linalg.norm(bowed, axis=1)[: len(bowed) // 8].max() < 1e-12  # floor and ceiling


@pytest.mark.parametrize("lidar", LIDARS)
def test_ranges_scatter_as_much_as_they_should(lidar):
    one, rng = model(lidar), np.random.default_rng(0)
    true, sigma = rng.uniform(1, 5, 20000), np.full(20000, one.sigma_m)
    mean, spread = averaged(one, rng, true, sigma, 20)
    wanted = np.hypot(one.sigma_m, one.step_m / np.sqrt(12))
    assert np.sqrt(np.mean(spread**2)) == pytest.approx(wanted, rel=0.02)
    assert np.std(mean - true) == pytest.approx(wanted / np.sqrt(20), rel=0.03)
    single, unknown = averaged(one, rng, true, sigma, 1)
    assert np.all(np.isnan(unknown)) and TAIL_DOF > 4
    assert np.mean((single - true) ** 4) > 3.3 * np.mean((single - true) ** 2) ** 2


def test_a_seed_makes_the_same_bytes_again(small, tmp_path):
    folder, truth = small
    again = tmp_path / "again"
    assert write(SMALL, again) == truth
    files = sorted(p.relative_to(folder) for p in folder.rglob("*") if p.is_file())
    assert len(files) == 4 + 3 + 4
    assert all((folder / p).read_bytes() == (again / p).read_bytes() for p in files)
    assert json.loads(Path(f"{folder}.truth.json").read_text()) == json.loads(json.dumps(truth))


HIDDEN = (("gravity_sag", 1e-3), ("warm_up", 0.05), ("incidence", 0.02))


@pytest.mark.parametrize("hidden", [(), HIDDEN], ids=["nothing hidden", "much hidden"])
def test_points_lie_in_the_room_where_the_truth_puts_them(tmp_path, hidden):
    """Files alone, through the true frames: points of a scan are on the walls, to the noise."""
    world, folder = replace(SMALL, hidden=hidden), tmp_path / "recording"
    truth = write(world, folder)
    quads, rings = room.furnished(world.rng("room")), np.array(truth["ring_range_offset"])
    for _, stop in pd.read_csv(folder / "stops.csv").iterrows():
        T = T_faro_lidar(stop, truth)
        scan = pd.read_parquet(folder / "scans" / f"{stop['stop']}.parquet")
        xyz = scan[["x", "y", "z"]].to_numpy(float)
        length = np.linalg.norm(xyz, axis=1)
        towards = (xyz / length[:, None]) @ T[:3, :3].T
        reach, which = quads.hit(T[:3, 3], towards)
        cosine = np.abs(np.sum(towards * quads.normal[which], axis=1))
        where = (stop["time_s"], stop["temperature_c"])
        length = length - rings[scan["ring"]]
        length -= effects.of_range(world.hidden, cosine, np.zeros(len(length)), *where)
        assert np.median(np.abs(length - reach)) < 0.002
        on_walls = T[:3, 3] + length[:, None] * towards
        assert np.all(np.abs(on_walls[:, :2]) < room.SIZE_M[:2] / 2 + 0.05)


def T_faro_lidar(stop, truth):
    """Of a row of stops.csv: from the base that the tracker saw, the joints read, and the truth."""
    T = {name: np.array(each) for name, each in truth["frames"].items()}
    w, *xyz = (stop[f"base_markers.{part}"] for part in ("qw", "qx", "qy", "qz"))
    angle = 2 * np.arccos(w)
    R = turn(np.array(xyz) / np.sin(angle / 2), angle)
    seen = pose(R, np.array([stop[f"base_markers.{part}"] for part in "xyz"]))
    read = stop[list(arm.JOINTS)].to_numpy(float)[None]
    angles = read + truth["joint_offset"] + effects.of_joints(truth["params"].items(), read)
    tip = arm.along(angles, arm.lengthened(np.array(truth["dlen"])))[0, -1]
    T_faro_base = np.array(truth["T_faro_opti"]) @ seen @ inverse(T["base_markers"])
    return T_faro_base @ T["arm_base"] @ tip @ T["mount"] @ T["lidar"]


def test_knobs_change_what_they_name_and_nothing_else(small, tmp_path):
    folder, truth = small
    scattered = write(replace(SMALL, stop_scatter_m=0.003), tmp_path / "a")
    assert np.std(scattered["stop_zero_m"]) > 5e-4 and not np.any(truth["stop_zero_m"])
    assert (tmp_path / "a" / "stops.csv").read_bytes() == (folder / "stops.csv").read_bytes()
    name = "scans/L01P01.parquet"
    one, other = (pd.read_parquet(f / name) for f in (folder, tmp_path / "a"))
    longer = np.linalg.norm(other[["x", "y", "z"]], axis=1)
    longer = longer - np.linalg.norm(one[["x", "y", "z"]], axis=1)
    assert np.median(longer) == pytest.approx(scattered["stop_zero_m"][-1], abs=2e-4)
    write(replace(SMALL, tracker_factor=2.0), tmp_path / "b")
    assert (tmp_path / "b" / name).read_bytes() == (folder / name).read_bytes()
    near, far = (pd.read_csv(f / "stops.csv") for f in (folder, tmp_path / "b"))
    moved_m = (near["base_markers.x"] - far["base_markers.x"]).abs().max()
    assert 0 < moved_m < 5 * SIGMA_TRACKER_M
    for mesh in (replace(SMALL, mesh_error_factor=3.0), replace(SMALL, warp_m=0.005)):
        write(mesh, tmp_path / f"mesh {mesh.warp_m}")
        again = tmp_path / f"mesh {mesh.warp_m}"
        assert (again / name).read_bytes() == (folder / name).read_bytes()
        ply = "reference/mesh.ply"
        assert (again / ply).read_bytes() != (folder / ply).read_bytes()
    said = json.loads((folder / "rig.yaml").read_text())
    assert said["reference"]["sigma_m"] == SIGMA_MESH_M


def test_clutter_takes_the_share_that_is_asked_for(tmp_path):
    truth = write(replace(SMALL, clutter=0.1), tmp_path / "cluttered")
    assert 0.07 < truth["clutter_share"] < 0.2


def test_hidden_effects_have_their_formulas():
    hidden = (("incidence", 0.001), ("warm_up", 0.002), ("ring_by_temperature", 0.003))
    cosine, height = np.array([1.0, 0.5]), np.array([-1.0, 1.0])
    found = effects.of_range(hidden, cosine, height, effects.WARM_UP_S, 28.0)
    base = 0.002 / np.e
    assert np.allclose(found, [base - 0.003, base + 0.001 + 0.003])
    assert {name for name, _ in hidden} | {"gravity_sag", "joint_slip"} == set(effects.EFFECTS)
    angles = np.zeros((1, 6))
    angles[0, 1] = 0.5
    turned = effects.of_joints((("gravity_sag", 1e-4),), angles)
    low, high = (arm.along(q)[0, -1, 2, 3] for q in (angles + turned, angles))
    assert low < high  # it droops
    slipped = effects.of_joints((("joint_slip", 0.002),), np.zeros((4, 6)))
    assert np.array_equal(slipped, np.outer([0, 0, 0.002, 0.002], np.eye(6)[2]))


def test_moved_frames_move_in_the_axes_that_are_said():
    T = pose(rpy(0, 0, np.pi / 2), np.array([1.0, 2.0, 3.0]))
    other = moved(T, np.array([0.1, 0.0, 0.0]), np.array([0.2, 0.0, 0.0]))
    assert np.allclose(other[:3, 3], [1.1, 2, 3])
    assert np.allclose(T[:3, :3].T @ other[:3, :3], rpy(0.2, 0, 0))
