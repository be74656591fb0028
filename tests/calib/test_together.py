"""Stops taken together give what each alone gives: bodies, and where LiDARs are."""

from dataclasses import replace

import numpy as np
import pytest

from calib.effects import DEFAULT
from calib.forward import place_each
from calib.linear.linearise import lidars
from calib.problem import build
from calib.problem.model import Model, Source
from calib.residuals.seen import BodiesTogether
from calib.residuals.tracker import TrackedBody
from calib.simulation import Spec

from . import rigs, simulated

PLAIN_ARM = {"urdf": "arm.urdf", "base": "arm_base", "tip": "arm_end", "sigma_joint_rad": 0}
PLANES = Spec(mesh=False, targets=0, locations=2, stops_per_location=2, column_step=40)
GEOMETRY = ("arm_gravity_sag", "arm_thermal_growth", "arm_joint_scale", "mount_slip@90")
TRACKER = ("optitrack_scale", "optitrack_distortion")
BOXES = {
    "joint noise": ({}, Model()),
    "no joint noise": ({"arm": PLAIN_ARM, "base": {"moves": "stop"}}, Model()),
    "effects": ({}, Model((*DEFAULT, "arm_joint_scale", *TRACKER))),
}


@pytest.fixture(scope="module", params=[*BOXES, "simulated", "no reference", "two recordings"])
def case(request, tmp_path_factory):
    """A problem, and a state away from its start."""
    folder = tmp_path_factory.mktemp("together")
    if request.param == "simulated":
        sources = [simulated.made(folder / "rec", "tiny")[0]]
        model = Model((*DEFAULT, *GEOMETRY, *TRACKER))
    elif request.param == "no reference":
        sources, model = [simulated.made(folder / "rec", PLANES)[0]], Model()
    elif request.param == "two recordings":
        sources = [Source.open(rigs.write(folder / str(k), seed=k)) for k in (1, 2)]
        model = Model((*DEFAULT, *TRACKER))
    else:
        changes, model = BOXES[request.param]
        sources = [Source.open(rigs.write(folder / "box", **changes))]
    problem = build(sources, model)
    return problem, rigs.shaken(problem.variables, problem.initial, 0.05)


def assert_same(found, expected):
    """Residuals and derivatives, to 1e-12 of the largest entry of each."""
    assert set(found[1]) == set(expected[1])
    pairs = [(found[0], expected[0]), *((found[1][n], d) for n, d in expected[1].items())]
    for a, b in pairs:
        assert a.shape == b.shape
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-12 * max(np.abs(b).max(), 1.0))


@pytest.mark.parametrize("points", [False, True], ids=["poses", "points"])
def test_bodies_together_are_each_bodys_own_rows(case, points):
    problem, values = case
    blocks = [b for b in problem.blocks if isinstance(b, TrackedBody)]
    if points:  # every other one, so that both kinds come together
        blocks = [replace(b, is_point=bool(k % 2)) for k, b in enumerate(blocks)]
    groups = BodiesTogether.of(blocks)
    assert len(groups) < len(blocks)
    seen = {}
    for group in groups:
        for block, found in zip(group.blocks, group.evaluate(values), strict=True):
            seen[block.name, block.stops.root] = True
            assert_same(found, block.evaluate(values, True))
    assert len(seen) == len(blocks)


def test_effects_of_the_tracker_move_bodies(case):
    """Lest the comparison above compare nothing."""
    problem, _ = case
    bodies = [b for b in problem.bodies if b.by_place]
    names = {n for b in bodies for n in b.by_place.terms}
    assert names == (set(TRACKER) & set(problem.variables))


def test_lidars_together_are_each_lidars_own_place(case):
    problem, values = case
    scans = problem.scans
    assert len(scans) > 3
    expected = [s.stops.in_reference(s.stops.rig.lidar_frame, values) for s in scans]
    for found, alone in zip(lidars(scans, values), expected, strict=True):
        assert_same((found.T, found.d), (alone.T, alone.d))


@pytest.mark.parametrize("frame", ["base", "mount", "lidar"])
def test_any_frame_of_mixed_stops_comes_in_their_order(case, frame):
    problem, values = case
    stops = [scan.stops for scan in problem.scans]
    rng = np.random.default_rng(0)
    mixed = [stops[k] for k in rng.integers(0, len(stops), 7)]
    for each, found in zip(mixed, place_each(mixed, frame, values), strict=True):
        alone = each.in_reference(frame, values)
        assert_same((found.T, found.d), (alone.T, alone.d))
