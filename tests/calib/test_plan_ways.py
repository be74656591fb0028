"""What keeps an arm from a pose, and the way from stop to stop: the URDF's shapes as capsules."""

from __future__ import annotations

import shutil
from itertools import pairwise

import numpy as np
import pandas as pd
import pytest
from scipy.optimize import minimize

import calib
from calib.planning import planner_of
from calib.planning.room.capsules import about, segments_apart_m
from calib.planning.room.clear import SHAPE_CLEAR_M, Clear
from calib.planning.room.ways import between, way_document, way_over
from calib.planning.stops import Poses
from calib.problem.model import Source
from calib.rig.shapes import _solid
from calib.runs.run import Run
from tests.calib.narrow import JOINTS, run_of

BALL_M = 0.11  # radius of the balls that links are given


@pytest.fixture(scope="module")
def run(once) -> Run:
    return run_of(once)


def distance(a, b):
    """Between two segments, by a bounded search over where on each the nearest points are."""

    def squared(x):
        at = a[0] * (1 - x[0]) + a[1] * x[0] - b[0] * (1 - x[1]) - b[1] * x[1]
        return at @ at

    starts = [(0.5, 0.5), (0, 1), (1, 0)]
    tries = [minimize(squared, s, bounds=[(0, 1)] * 2, tol=1e-14) for s in starts]
    return np.sqrt(min(each.fun for each in tries))


def test_segments_are_as_far_apart_as_a_search_finds():
    rng = np.random.default_rng(4)
    a, b = rng.normal(size=(2, 40, 2, 3))
    b[:8] = a[:8] + rng.normal(size=(8, 1, 3))  # parallel
    a[8:12, 1], b[12:16, 1] = a[8:12, 0], b[12:16, 0]  # points
    b[16:20, 0] = a[16:20].mean(axis=1)  # they touch
    wanted = [distance(*pair) for pair in zip(a, b, strict=True)]
    np.testing.assert_allclose(segments_apart_m(a, b), wanted, atol=1e-5)
    np.testing.assert_allclose(segments_apart_m(b, a), wanted, atol=1e-5)


def elbow():
    """A tube with a housing across its end: 0.1 m wide, 0.5 and 0.3 m long."""
    tube, housing = (_solid("box")[0] * s for s in ([0.1, 0.1, 0.5], [0.1, 0.3, 0.1]))
    triangles = _solid("box")[1]
    return np.vstack([tube, housing + np.array([0, 0.1, 0.25])]), np.vstack(
        [triangles, triangles + 8]
    )


@pytest.mark.parametrize("shape", ["box", "cylinder", "sphere", "elbow"])
def test_capsules_hold_all_of_a_shape_and_little_besides(shape):
    rng = np.random.default_rng(2)
    if shape == "elbow":
        vertices, triangles = elbow()
    else:
        vertices, triangles = _solid(shape)
        vertices = vertices * [0.1, 0.1, 0.1 if shape == "sphere" else 0.6]
    capsules = about(vertices, triangles)
    corners = vertices[triangles[rng.integers(len(triangles), size=3000)]]
    points = np.einsum("nk,nkj->nj", rng.dirichlet(np.ones(3), 3000), corners)
    here = np.stack([points, points], axis=1)
    outside = [segments_apart_m(here, ends[None]) - radius for ends, radius in capsules]
    assert np.min(outside, axis=0).max() < 0.005  # what points drawn on its surface leave out
    volume = sum(
        np.pi * r**2 * (np.linalg.norm(ends[1] - ends[0]) + 4 / 3 * r) for ends, r in capsules
    )
    # Of a box a capsule is at least a cylinder about it, pi / 2 as large; one capsule about the
    # elbow would be ten times as large as it is.
    own = {"box": 6e-3, "cylinder": 4.71e-3, "sphere": 5.24e-4, "elbow": 7e-3}[shape]
    assert volume < {"box": 2.2, "cylinder": 1.5, "sphere": 1.1, "elbow": 3.0}[shape] * own
    assert (len(capsules) > 1) is (shape == "elbow")


def with_balls(run: Run, folder) -> Source:
    """The recording, with a ball for each link of the arm."""
    shutil.copytree(run.folder.parent / "rec", folder)
    path = folder / "arm.urdf"
    ball = f'<collision><geometry><sphere radius="{BALL_M}"/></geometry></collision>'
    text = path.read_text()
    for name in {"arm_base", "arm_end"}:
        text = text.replace(f'<link name="{name}"/>', f'<link name="{name}"></link>')
    path.write_text(text.replace("</link>", f"{ball}</link>"))
    return Source.open(folder)


def test_links_stay_clear_of_each_other_by_their_shapes(run, tmp_path):
    """Of balls, whose distance is that of their middles."""
    source = with_balls(run, tmp_path / "rec")
    clear = Clear(source)
    assert clear.lacking == []
    balls = [i for i, r in enumerate(clear.parts.radius_m) if r > 0]
    np.testing.assert_allclose(clear.parts.radius_m[balls], BALL_M, rtol=0.01)
    clear.room_m[:], clear.outside_m = -np.inf, np.inf  # of the room another test tells
    only = np.isin(clear.pairs, balls).all(axis=1)
    clear.pairs, clear.least_m = clear.pairs[only], clear.least_m[only]
    assert len(clear.pairs) >= 3
    joints = np.random.default_rng(0).uniform(-2.5, 2.5, (400, 6))
    tree, frames = source.rig.tree, [clear.frames[clear.parts.frames[i, 0]] for i in balls]
    at = {i: tree.transform(f, joints)[:, :3, 3] for i, f in zip(balls, frames, strict=True)}
    gaps = [np.linalg.norm(at[a] - at[b], axis=1) for a, b in clear.pairs]
    wanted = np.min(gaps, axis=0) - 2 * BALL_M - SHAPE_CLEAR_M
    told = clear.of_poses(joints, np.broadcast_to(np.eye(4), (400, 4, 4)))
    sure = np.abs(wanted) > 0.01 * BALL_M * 2  # a capsule about a ball is a little larger
    assert 20 < (wanted[sure] > 0).sum() < 380
    np.testing.assert_array_equal(told[sure], wanted[sure] > 0)


def test_what_the_arm_did_at_measured_stops_is_no_collision(run, tmp_path):
    source = with_balls(run, tmp_path / "rec")
    planner = planner_of(run, "all")
    T_reference_world = np.linalg.inv(planner.scene.T_world_reference)
    clear = Clear.of(source, planner.places, planner.scene.T_world_reference)
    recording = source.recording
    roots = np.stack([planner.places[str(at)] for at in recording.location])
    assert clear.of_poses(recording.joints, T_reference_world @ roots).all()


class Maze:
    """A room of two joints' angles, where nothing that is told by `shut` can be passed."""

    def __init__(self, shut):
        self.of_poses = lambda joints, T: ~shut(joints)


def poses(joints) -> Poses:
    joints = np.array(joints, float)
    n = len(joints)
    return Poses(np.array(["a"] * n), joints, np.broadcast_to(np.eye(4), (n, 4, 4)).copy())


def test_the_way_goes_round_what_is_shut():
    maze = Maze(lambda q: (np.abs(q[:, 0]) < 0.2) & (q[:, 1] < 1.0))
    stops = poses([(-1, 0), (1, 0), (-1.2, 0), (1.2, 0.1)])
    among = poses(np.random.default_rng(1).uniform(-2, 2, (200, 2)))
    order, legs = way_over(stops, among, maze, np.eye(4), ["a"])
    joints = stops.joints[order]
    assert [leg.to for leg in legs] == [1, 2, 3] and all(leg.clear for leg in legs)
    by = [leg for leg in legs if leg.via is not None]
    assert len(by) == 1  # once from one side to the other
    for leg in legs:
        pair = [joints[leg.to - 1], joints[leg.to]]
        points = pair if leg.via is None else [pair[0], leg.via, pair[1]]
        for a, b in pairwise(points):
            way = a + np.linspace(0, 1, 1000)[:, None] * (b - a)
            assert maze.of_poses(way, None).mean() > 0.99  # steps may cut a corner
    rows = way_document(stops.some(order), ["p", "q"], legs)
    assert [row["stop"] for row in rows].count(None) == 1 and len(rows) == 5
    assert rows[0]["clear"] is None and all(row["clear"] for row in rows[1:])


def test_where_nothing_leads_round_it_is_said():
    maze = Maze(lambda q: np.abs(q[:, 0]) < 0.2)
    stops = poses([(-1, 0), (1, 0)])
    _, (leg,) = way_over(stops, poses([(0.5, 0.5), (-0.5, 2)]), maze, np.eye(4), ["a"])
    assert leg.via is None and not leg.clear


def test_another_order_is_taken_before_a_detour():
    """The shortest way over three stops is shut on one leg; another order has none."""
    maze = Maze(lambda q: (np.abs(q[:, 0] - 0.5) < 0.05) & (np.abs(q[:, 1]) < 0.05))
    stops = poses([(0, 0), (1, 0), (0.5, 0.9)])
    _, legs = way_over(stops, poses([(5, 5)]), maze, np.eye(4), ["a"])
    assert all(leg.clear and leg.via is None for leg in legs)


def test_poses_on_a_way_are_close_together():
    way = between(np.zeros(3), np.array([1.0, -2.0, 0.5]))
    assert np.linalg.norm(np.diff(way, axis=0), axis=1).max() <= 0.05 + 1e-12
    np.testing.assert_allclose(way[[0, -1]], [[0, 0, 0], [1, -2, 0.5]])


def test_a_plan_has_its_way_and_says_for_what_the_arm_is_taken(run, rigcal, tmp_path):
    shutil.copytree(run.folder.parent / "rec", tmp_path / "rec")
    path = tmp_path / "rec" / "arm.urdf"
    mesh = '<collision><geometry><mesh filename="package://arm/a.stl"/></geometry></collision>'
    path.write_text(path.read_text().replace("</link>", f"{mesh}</link>", 1))
    calib.fit([tmp_path / "rec"], tmp_path / "run", hold_out="none")
    words = ["plan", tmp_path / "run", "--for", "all", "--candidates", 40, "--stops", 4]
    code, out, _ = rigcal(*words, "-o", tmp_path / "v1.2-plan")  # as of a run v1.2
    told = " ".join(out.split())
    assert code == 0 and "Taken for tubes, as their shapes are missing: " in told
    assert "the recording has no 'a.stl'" in told
    assert "clear of the arm's own links and room" in told or "goes by another pose" in told
    way, stops = (pd.read_csv(tmp_path / "v1.2-plan" / f"{name}.csv") for name in ("way", "stops"))
    at = way[way.stop.notna()]
    assert at.stop.tolist() == [1, 2, 3, 4]
    np.testing.assert_allclose(at[JOINTS], stops[JOINTS])
    assert np.isnan(way.clear.iloc[0])  # there it begins
