"""What the tracker's cameras see: planned stops, and targets, in the sight of two of them."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from calib.planning import planner_of
from calib.planning.room.clear import TUBE_RADIUS_M, Clear, InTheWay
from calib.planning.room.hanging import plan_targets
from calib.planning.room.sight import CARRIES_M, _past_arm
from tests.calib.narrow import run_of


@pytest.fixture(scope="module")
def run(once):
    return run_of(once)


@pytest.fixture(scope="module")
def cameras(run):
    """Six below the ceiling, in the tracker's frame (6, 3)."""
    scene = planner_of(run, "all").scene
    low, high = (f(scene.source.reference.vertices_m, axis=0) for f in (np.min, np.max))
    share = np.array([(x, y, 0.9) for x in (0.1, 0.9) for y in (0.1, 0.5, 0.9)])
    at = low + share * (high - low)
    return at @ scene.T_world_reference[:3, :3].T + scene.T_world_reference[:3, 3]


def table(folder, cameras):
    path = folder / "cameras.csv"
    names = [f"C{k}" for k in range(len(cameras))]
    pd.DataFrame(cameras, columns=["x", "y", "z"], index=names).to_csv(path, index_label="camera")
    return path


def clear(points_m, mesh, camera, at, T):
    """Whether a line of sight stays clear of the mesh, by small steps, and of points of the arm but
    for those about the body."""
    way = camera + np.linspace(0.02, 0.98, 400)[:, None] * (at - camera)
    inside = (way - T[:3, 3]) @ T[:3, :3]
    near = np.linalg.norm(points_m - at, axis=1) < TUBE_RADIUS_M + CARRIES_M
    gaps = np.linalg.norm(way[:, None] - points_m[~near], axis=2)
    step = np.linalg.norm(at - camera) / 400
    return mesh.distance_m(inside).min() > step and gaps.min() > TUBE_RADIUS_M - step


def test_what_is_between_hides_what_is_behind_or_carries_does_not():
    camera, body = np.zeros(3), np.array([[2.0, 0.0, 0.0]])
    for tube, seen in (
        ((1.0, 0.04, 0.0), False),
        ((1.0, 0.06, 0.0), True),
        ((2.3, 0.0, 0.0), True),
        ((-0.5, 0.0, 0.0), True),
        ((1.95, 0.0, 0.0), True),
    ):
        arm = InTheWay(np.array([[tube]]), np.array([TUBE_RADIUS_M]))
        assert _past_arm(camera, body, arm).tolist() == [seen]


def test_two_cameras_see_every_body_at_every_candidate_and_not_at_others(run, cameras):
    from dataclasses import replace

    cameras = cameras[[0, 5]]  # both are to see all
    planner = replace(planner_of(run, "all"), cameras_m=cameras)
    scene, source = planner.scene, planner.scene.source
    seen, any_pose = planner.candidates(25, 0), planner_of(run, "all").candidates(60, 1)

    def told(poses):
        """How many bodies two cameras see, at worst, by small steps along each line of sight."""
        tubes = Clear(source).in_the_way(poses.joints).points_m
        counts = []
        for k, T in enumerate(poses.Ts_world_root):
            world = tubes[k] @ T[:3, :3].T + T[:3, 3]
            least = 9
            for body in source.rig.tracker.bodies:
                placed = source.rig.tree.place(body, poses.joints[k : k + 1]).Ts_root_frame[0]
                at = (T @ placed)[:3, 3]
                way = (world, source.reference)
                here = [clear(*way, c, at, scene.T_world_reference) for c in cameras]
                least = min(least, sum(here))
            counts.append(least)
        return np.array(counts)

    assert np.mean(told(seen) >= 2) > 0.9  # steps are coarser than what they are held against
    assert np.mean(told(any_pose) >= 2) < 0.9


def test_where_cameras_see_nothing_no_stop_and_no_target_is_planned(run, rigcal):
    folder = run.folder.parent / "rec"
    outside = table(folder, [[50.0, 50.0, 1.0], [50.0, 51.0, 1.0]])
    words = ["plan", run.folder, "--for", "all", "--candidates", 30]
    for more, said in (((), "in the cameras' sight"), (("--targets", 3), "in two cameras' sight")):
        code, out, err = rigcal(*words, *more)
        assert (code, out) == (2, "") and said in err and err.count("\n") == 1
    table(folder, [[0.0, 0.0, 1.0]])
    code, _, err = rigcal(*words)
    assert code == 2 and "it takes 2 cameras" in err
    outside.unlink()


def test_stops_and_targets_are_planned_in_sight(run, cameras, rigcal):
    path = table(run.folder.parent / "rec", cameras)
    words = ["plan", run.folder, "--for", "all", "--candidates", 40, "--stops", 2]
    assert rigcal(*words)[0] == 0
    assert len(plan_targets(run, 2, candidates=50).spheres_m) == 2
    path.unlink()
