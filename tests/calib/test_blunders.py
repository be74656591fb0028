"""Every group of rows against all others: by dense algebra, by leaving it out, and by chance."""

from dataclasses import replace

import numpy as np
import pytest

from calib.blunders.shifts import shifts
from calib.linear.clusters import Gradients
from calib.linear.layout import Layout
from calib.problem import build
from calib.problem.model import Model, Source
from calib.residuals.groups import CAD, MESH, Group
from calib.solve.fit import preview

from . import rigs
from .linear import cases
from .linear.dense import Dense
from .linear.groups import Groups

CASES = [name for name in cases.CASES if name != "an earlier estimate"]
WELL = 1e-3  # of what a group says, checked by others: rows can be left out without loss of digits
BY_STOP = {"base": {"moves": "stop"}}


@pytest.fixture(scope="module", params=CASES)
def both(request, tmp_path_factory):
    """A case, and the dense rows of each place with the full weight there."""
    case = cases.made(request.param, tmp_path_factory.mktemp("blunders"))
    where = {g.where for b in case.start.problem.blocks for g in b.groups}
    places = {*where, *(s.name for s in case.start.problem.scans), CAD, MESH}
    if not case.weighted:
        return case, dict.fromkeys(places, Groups(case.dense))
    return case, {place: Groups(case.dense, {place}) for place in places}


def found(case):
    """Group -> its shift, as the program has it."""
    linear = case.linear(gradients=Gradients(len(case.dense.sigma)))
    return {shift.group: shift for shift in shifts(linear, case.start.problem)}


def case_of(problem):
    """A problem where its fit would start, with the weights that it has."""
    start = preview(problem)
    return cases.Case(start, Dense(start.problem, start.values, start.associations), None)


def assert_same(shift, off, tolerance=1e-6):
    name = str(shift.group)
    assert shift.dof == off.dof, name
    assert shift.statistic == pytest.approx(off.statistic, rel=tolerance, abs=tolerance), name
    size = np.sqrt(np.maximum(np.diag(off.covariance), 1e-300))
    limit = tolerance * (1 + np.abs(off.offset / size).max(initial=0.0))
    np.testing.assert_allclose(shift.offset / size, off.offset / size, atol=limit, err_msg=name)
    unit = np.outer(size, size)
    np.testing.assert_allclose(
        shift.covariance / unit, off.covariance / unit, atol=tolerance, err_msg=name
    )


# ------------------------------------------------------------------------------------------ algebra


@pytest.mark.parametrize("stops_first", [False, True], ids=["cells first", "stops first"])
def test_every_group_is_off_as_dense_rows_say(both, stops_first, monkeypatch):
    monkeypatch.setattr(Layout, "stops_first", stops_first)
    case, there = both
    here = found(case)
    assert here.keys() == {*there[CAD].parts, *there[CAD].scans}
    for group, shift in here.items():
        assert_same(shift, there[group.where].off(group))
        axes, units = shift.axes, shift.units
        assert len(axes) == len(units) == len(shift.offset) == len(shift.information)


@pytest.mark.parametrize("name", ["stop by stop", "no lidar", "a stop without scan"])
def test_a_group_is_off_by_what_a_solution_without_its_rows_says(name, tmp_path):
    """Of each kind that which is furthest off."""
    case = cases.made(name, tmp_path)
    here, there, seen = found(case), Groups(case.dense), set()
    for group in sorted(here, key=lambda g: -here[g].statistic):
        kind = group.kind, group.what in ("rod", "upper"), len(here[group].axes)
        if kind not in seen and there.well(group) > WELL:
            seen.add(kind)
            assert_same(here[group], there.left_out(group))
    assert {kind for kind, _, _ in seen} >= {"body", "target", "frame", "joints"}


def test_rows_that_lost_weight_are_judged_as_if_they_had_not(tmp_path):
    """With all weights of a place at 1; those elsewhere stay, so that one wild row hides none."""
    source = Source.open(rigs.write(tmp_path / "box", seed=6, **BY_STOP))
    case = case_of(build([source], cases.MODEL))
    problem, plain = case.start.problem, found(case)
    weights = {("body", "s1"): [0.02], ("body", "s3"): [0.5], ("target", "t2"): [0.1, 1.0, 0.4]}
    at = [(b.groups[0].kind, b.groups[0].where) for b in problem.blocks]
    given = (weights.get(key) for key in at)
    blocks = [
        replace(b, weight=w and np.array(w)) for b, w in zip(problem.blocks, given, strict=True)
    ]
    lighter = {"joints@s1": 0.3, "joints@s2": 0.05, "lidar": 0.2, "arm_link_length": 0.6}
    unknowns = {n: replace(u, weight=lighter.get(n, 1.0)) for n, u in problem.variables.items()}
    problem = replace(problem, blocks=blocks, variables=unknowns)
    dense = Dense(problem, case.dense.values, case.dense.associations)
    case = cases.Case(replace(case.start, problem=problem), dense, None)
    here = found(case)
    assert here.keys() == plain.keys()
    for place in ("s0", "s1", "s2", "t2", CAD):
        there = Groups(case.dense, {place})
        for group in (g for g in here if g.where == place):
            assert_same(here[group], there.off(group))
    wild = Group("body", "s1", "mount_markers")
    assert here[wild].statistic != pytest.approx(plain[wild].statistic, rel=1e-3), (
        "others lost some"
    )


def test_what_nothing_contradicts_has_no_degree_of_freedom(tmp_path):
    """A body that alone says where the rig stands; a scan that alone does, planes known or not."""
    rig = {**BY_STOP, "arm": cases.PLAIN_ARM, "lidar": None, "target": None, "reference": None}
    tracker = rigs.drawing()["tracker"] | {"bodies": ["base_markers"]}
    folder = rigs.write(tmp_path / "one body", seed=2, **rig, tracker=tracker)
    (folder / "targets.csv").unlink()
    one = found(case_of(build([Source.open(folder)], Model(("arm_link_length",)))))
    bodies = [shift for group, shift in one.items() if group.kind == "body"]
    assert len(bodies) == 4
    blind = {"tracker": None, "target": None, **BY_STOP}
    folder = rigs.write(tmp_path / "no tracker", seed=2, **blind)
    alone = found(case_of(build([Source.open(folder)], Model())))
    scans = [shift for group, shift in alone.items() if group.kind == "scan"]
    assert len(scans) == 4
    for shift in (*bodies, *scans):
        assert (shift.dof, shift.statistic) == (0, 0.0), str(shift.group)
        assert not shift.offset.any() and not shift.information.any()


def test_groups_that_nothing_tells_apart_are_as_far_off(tmp_path):
    """Without scans, at a stop where only two bodies and the encoders meet, either body takes all
    of what contradicts the other."""
    folder = rigs.write(tmp_path / "box", seed=5, lidar=None, **BY_STOP)
    here = found(case_of(build([Source.open(folder)], Model(("arm_joint_offset",)))))
    for stop in rigs.STOPS:
        base, mount = (here[Group("body", stop, b)] for b in ("base_markers", "mount_markers"))
        assert base.dof == mount.dof == 6
        assert base.statistic == pytest.approx(mount.statistic, rel=1e-6)
        joints = here[Group("joints", stop, "joints")]
        assert joints.statistic < base.statistic - 1e-3, "three turns explain less than a pose"
