"""Planned stops as ghosts of the arm in the workbench."""

from __future__ import annotations

import json

import numpy as np
import pytest

import calib
from calib.planning import planner_of
from calib.view.plans.ghosts import PLANNED_PATH, draw, ghosts
from calib.view.scene import Scene
from chains.errors import InputError
from tests.calib.narrow import run_of
from tests.calib.workbench import button, field, shown, until


@pytest.fixture(scope="module")
def run(once):
    return run_of(once)


class Nodes(list):
    """What is drawn, by the method and the name."""

    def __getattr__(self, method):
        return lambda *given, **named: self.append((method, given, named))


def test_a_plan_beside_its_run_is_shown_as_the_arm_would_stand(run, rigcal):
    scene = Scene.of(run)
    assert ghosts(scene, 0) == []
    out = run.folder.with_name(f"{run.folder.name}-plan")
    words = ["plan", run.folder, "--for", "all", "--stops", 3, "--candidates", 40, "-o", out]
    assert rigcal(*words)[0] == 0
    found = ghosts(scene, 0)
    document = json.loads((out / "plan.json").read_text())
    assert [ghost.number for ghost in found] == [1, 2, 3]
    planner = planner_of(run, "all")
    tree, T = scene.sources[0].rig.tree, np.linalg.inv(planner.scene.T_world_reference)
    for ghost, stop in zip(found, document["stops"], strict=True):
        joints = np.array([[stop[name] for name in tree.joint_names]])
        root = T @ planner.places[stop["location"]]
        lidar = (root @ tree.place("lidar", joints).Ts_root_frame[0])[:3, 3]
        np.testing.assert_allclose(ghost.tip_m, lidar, atol=1e-9)
        assert (np.abs(ghost.lines_m - lidar).max(axis=(1, 2)) < 3.0).all()
        assert len(ghost.lines_m) == len(tree.edges)
    nodes = Nodes()
    draw(nodes, "/planned", found, np.ones(3), True)
    lines = [given for method, given, _ in nodes if method == "add_line_segments"]
    assert [given[0] for given in lines] == ["/planned/1", "/planned/2", "/planned/3"]
    np.testing.assert_allclose(lines[0][1], found[0].lines_m - 1.0)
    assert [given[1] for method, given, _ in nodes if method == "add_label"] == ["1", "2", "3"]

    (out / "plan.json").write_text(json.dumps(document | {"stops": [{"location": "L00"}]}))
    with pytest.raises(InputError, match="is no plan for this rig; write it again with"):
        ghosts(scene, 0)


def test_a_plan_says_where_the_base_is_to_stand(run):
    region = (-1.6, -1.2, 1.6, 1.2)
    plan = calib.plan(run, stops=3, purpose="all", candidates=40, region=region)
    places = plan.document()["places"]
    assert set(places) == {stop["location"] for stop in plan.stops}
    for place in places.values():
        x, y, _ = place["xyz_m"]
        assert -1.6 <= x <= 1.6 and -1.2 <= y <= 1.2
        w, qx, qy, _ = place["quat_wxyz"]
        assert w**2 + 1 > 1 and abs(qx) < 0.02 and abs(qy) < 0.02  # level


@pytest.mark.long
def test_a_box_of_the_workbench_shows_them(run, rigcal):
    """Where there is a browser."""
    out = run.folder.with_name(f"{run.folder.name}-plan")
    words = ["plan", run.folder, "--for", "all", "--stops", 2, "--candidates", 40, "-o", out]
    assert rigcal(*words)[0] == 0
    with shown(run.folder) as (watched, page):
        stage = page.picture.stage
        field(watched, "Planned stops").check(force=True)
        until(watched, lambda: PLANNED_PATH in stage.hidden, False)
        node = page.picture.stage.client.scene.get_handle_by_name(f"{PLANNED_PATH}/2")
        assert node is not None and len(stage.ghosts) == 2


@pytest.mark.long
def test_stops_are_planned_on_the_page_and_stand_in_the_room(run):
    """Where there is a browser. What the diagnosis needs is offered with what else there is."""
    calib.diagnose(run)
    out = run.folder.with_name(f"{run.folder.name}-plan")
    with shown(run.folder) as (watched, page):
        asked, stage = page._plan, page.picture.stage
        needed = [r for r in page.findings.remedies if r["plan"]]
        offered = [",".join(each["names"]) for each in needed]
        options = ["what the diagnosis needs", *offered, "all", "workspace", "reliability"]
        assert list(asked._for.options) == list(dict.fromkeys(options)) and needed
        watched.page.get_by_text("Measure next").click()
        asked._stops.value, asked._for.value = 2, "workspace"
        button(watched, "Plan").click()
        watched.page.get_by_text("The place of what the arm carries is then known").wait_for()
        until(watched, lambda: len(stage.ghosts), 2)
        assert PLANNED_PATH not in stage.hidden and page.picture.menu.planned.value
        until(watched, lambda: page.bench.busy, False)
        button(watched, "Plan").wait_for()
    document = json.loads((out / "plan.json").read_text())
    assert document["for"] == "workspace" and len(document["stops"]) == 2
