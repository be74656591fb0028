"""Stops that predict best wherever the arm can go: what they are chosen by, and what they bring."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import calib
from calib.planning import planner_of
from calib.planning.criteria import PredictionVariance, chosen
from calib.planning.information import Information
from calib.planning.room.hanging import plan_targets
from calib.planning.room.workspace import moved_anywhere
from calib.planning.worth import criterion
from calib.problem.unknowns import Key
from calib.results.reach import at_joints, placed
from chains.errors import InputError
from tests.calib.narrow import run_of


@pytest.fixture(scope="module")
def narrow(once):
    return run_of(once)


def silent(done: int, total: int) -> None:
    """Progress that nobody sees."""


def test_designs_are_rated_by_the_mean_variance_of_what_is_predicted():
    rng = np.random.default_rng(3)
    keys = tuple(Key("u", f"p{k}") for k in range(4))
    J = rng.standard_normal((50, 3, 4))
    by = PredictionVariance(
        Information(keys, np.ones(4), np.zeros((4, 4)), np.eye(4)),
        np.einsum("nip,niq->pq", J, J) / 50,
    )
    rows = rng.standard_normal((5, 9, 4))
    designs = by.start + rows.mT @ rows
    errors = [rng.multivariate_normal(np.zeros(4), np.linalg.inv(M), 40_000) for M in designs]
    mean = [np.mean(np.sum((J @ e.T) ** 2, axis=1)) for e in errors]
    np.testing.assert_allclose(by.of(designs), -np.log(mean), atol=0.02)


def test_errors_of_the_calibration_move_the_lidar_by_as_much_as_is_told(narrow):
    """By finite differences, of a parameter of every kind."""
    planner = planner_of(narrow, "workspace")
    scene, known = planner.scene, planner.lasting
    poses = planner.candidates(30, 5)
    W = moved_anywhere(scene, known, poses)
    base, lidar = scene.source.rig.tracker.bodies[0], scene.source.rig.lidar_frame
    values = dict(scene.values)

    def at(moved):
        first = np.zeros(len(poses.joints), int)
        stops = at_joints(scene.stand.estimate.problem, first, poses.joints, "")
        return placed(stops, lidar, base, moved).T[:, :3, 3]

    here, count = at(values), 0
    for i, key in enumerate(known.keys):
        if key.unknown not in values or key.unknown == scene.source.rig.reference_frame:
            continue
        unknown = scene.stand.estimate.problem.variables[key.unknown]
        step = np.zeros(unknown.dim)
        step[[each.dof for each in unknown.keys].index(key.dof)] = 1e-6
        moved = at(values | {key.unknown: values[key.unknown] + step})
        wanted = np.mean(np.sum(((moved - here) / 1e-6) ** 2, axis=1)) * known.unit[i] ** 2
        assert W[i, i] == pytest.approx(wanted, rel=1e-3, abs=1e-12)
        count += wanted > 0
    assert count > 15


def test_the_lidar_is_predicted_better_than_by_other_stops(narrow):
    planner = planner_of(narrow, "workspace")
    poses = planner.candidates(120, 0)
    each = planner.look(poses, 4)
    by = planner.criterion(each)
    mine = chosen(by, each, 4, silent)
    volume = criterion(planner.scene, planner_of(narrow, "all").aim, planner.lasting)
    rng = np.random.default_rng(0)
    others = [chosen(volume, each, 4, silent)]
    others += [rng.choice(120, 4, replace=False) for _ in range(40)]
    value = [by.of((by.start + each[list(d)].sum(axis=0))[None])[0] for d in (mine, *others)]
    assert value[0] > np.max(value[1:])
    # And so it is once all stops are linearised together, in which the mesh errs once.
    other = replace(planner.after(poses.some(others[1])))
    assert planner.after(poses.some(mine)).predicted_m < other.predicted_m
    assert planner.now.predicted_m > other.predicted_m


@pytest.mark.long
def test_it_is_told_how_well_the_place_is_known(narrow, rigcal):
    plan = calib.plan(narrow, 3, "workspace", candidates=60)
    told = plan.document()["predicted_mm"]
    assert 0 < told["after"] < told["now"]
    words = ["plan", narrow.folder, "--for", "workspace", "--stops", 3, "--candidates", 60]
    code, said, _ = rigcal(*words)
    said = " ".join(said.split())
    assert code == 0
    assert f"wherever it can go, to {told['after']:.3g} mm rms; now to {told['now']:.3g}." in said
    assert calib.plan(narrow, 2, "all", candidates=40).document()["predicted_mm"]["now"] is None
    with pytest.raises(InputError, match="targets tell nothing"):
        plan_targets(narrow, 2, "workspace")
