"""A plan as a folder: its table, its document and its picture."""

from __future__ import annotations

import json

import numpy as np
import pandas as pd
import pytest

import calib
from calib.planning.room.hanging import plan_targets
from calib.problem.model import Source
from calib.report.planned import MOST_SIGMAS, before_after
from tests.calib.narrow import run_of


@pytest.fixture(scope="module")
def run(once):
    return run_of(once)


def test_a_plan_is_written_as_a_folder_that_another_plan_replaces(run, rigcal, tmp_path):
    words = ["plan", run.folder, "--for", "all", "--candidates", 40]
    for count in (2, 3):
        code, _, _ = rigcal(*words, "--stops", count, "-o", tmp_path / "plan")
        assert code == 0
        files = sorted(path.name for path in (tmp_path / "plan").iterdir())
        assert files == ["before_after.svg", "plan.json", "stops.csv", "way.csv"]
        document = json.loads((tmp_path / "plan/plan.json").read_text())
        table = pd.read_csv(tmp_path / "plan/stops.csv")
        assert table.to_dict("records") == document["stops"] and len(table) == count
    code, _, err = rigcal(*words, "-o", run.folder)
    assert code == 2 and err.count("\n") == 1
    assert (run.folder / "solution.yaml").is_file()


def test_the_picture_shows_each_sigma_before_and_after_and_says_what_was_found(run):
    plan = calib.plan(run, stops=3, purpose="all", candidates=60)
    figure = before_after(plan)
    left, right = figure.axes
    now, after = (line.get_xdata() for line in left.lines[-2:])
    assert (now == 1.0).all() and len(after) <= MOST_SIGMAS
    assert (np.diff(after) >= 0).all()  # what gains most comes first
    best = np.min(plan.after.sigma / plan.now.sigma)
    assert after[0] == pytest.approx(best)
    title = figure.get_suptitle().replace("\n", " ")
    assert title.startswith("3 stops for the whole calibration. With them")
    assert plan.names[int(np.argmin(plan.after.sigma / plan.now.sigma))] in title
    drawn = np.concatenate([line.get_ydata() for line in right.lines])
    joints = np.degrees(np.concatenate([plan.measured.joints, plan.poses.joints]))
    np.testing.assert_allclose(np.sort(drawn), np.sort(joints.ravel()))
    assert len(plan.measured.joints) == 10


def test_targets_are_drawn_in_the_room(run, rigcal, tmp_path):
    out = tmp_path / "hang"
    words = ["plan", run.folder, "--targets", 2, "--candidates", 40, "-o", out]
    assert rigcal(*words)[0] == 0 and rigcal(*words)[0] == 0  # the second takes its place
    names = sorted(path.name for path in out.iterdir())
    assert names == ["before_after.svg", "plan.json", "targets.csv"]
    document, table = json.loads((out / "plan.json").read_text()), pd.read_csv(out / "targets.csv")
    assert table.to_dict("records") == document["targets"]
    plan = plan_targets(run, 2, candidates=40)
    figure = before_after(plan)
    left, right = figure.axes
    assert figure.get_suptitle().startswith("2 targets for the whole calibration. With them")
    assert left.get_legend().get_texts()[1].get_text() == "with the planned targets"
    *room, hung, planned = right.lines
    np.testing.assert_allclose(np.column_stack(planned.get_data()), plan.spheres_m[:, :2])
    np.testing.assert_allclose(np.column_stack(hung.get_data()), plan.hung_m[:, :2])
    assert len(plan.hung_m) == 5 and len(room) == len(plan.room_m)
    # Edges at which nothing turns are not drawn: a wall's two triangles share one.
    mesh = Source.open(run.folder.parent / "rec").reference
    assert 0 < len(plan.room_m) < 0.5 * len(mesh.triangles)
    low, high = (f(mesh.vertices_m, axis=0) for f in (np.min, np.max))
    for corner in (low, high):
        assert (np.abs(plan.room_m - corner).max(axis=2) < 0.01).any()  # walls are uneven
    assert f"P1, {plan.targets[0]['z']:.2f} m" in [text.get_text() for text in right.texts]


def test_a_plan_without_stops_is_written_too(run, rigcal, tmp_path):
    """What is wanted is known already."""
    words = ["plan", run.folder, "--until", "lidar.xyz 500 mm", "--candidates", 40]
    code, out, _ = rigcal(*words, "-o", tmp_path / "plan")
    assert code == 0 and "0 stops" in out
    for name in ("stops", "way"):
        table = pd.read_csv(tmp_path / "plan" / f"{name}.csv")
        assert table.empty and "joint_1" in table.columns
