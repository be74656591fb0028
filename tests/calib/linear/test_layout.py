"""Which unknowns are a stop's own, which are cells, and which are kept."""

import numpy as np
import pytest

from calib.linear.layout import Layout
from calib.problem import build
from calib.problem.model import Model, Source
from calib.problem.unknowns import Role
from calib.simulation import Spec
from calib.solve.fit import preview

from .. import rigs, simulated

NO_NOISE = {"urdf": "arm.urdf", "base": "arm_base", "tip": "arm_end", "sigma_joint_rad": 0}
CELLS = ("0/reference_surface", "0/reference_region", "0/reference_patch")
TILTS = tuple(f"0/reference_{part}.tilt_{k}" for part in ("surface", "region") for k in (0, 1))
JOINTS = tuple(f"joints@s{k}" for k in range(4))


@pytest.fixture
def problem(tmp_path):
    def made(seen=True, **changes):
        found = build([Source.open(rigs.write(tmp_path / "box", **changes))], Model())
        return preview(found).problem if seen else found

    return made


def names_at(layout, columns):
    """Unknowns, all of whose columns are among those given."""
    return {n for n, at in layout.at.items() if np.isin(np.r_[at], columns).all()}


def own(layout):
    return {stop: names_at(layout, columns) for stop, columns in layout.own.items()}


def roots(*names):
    return {f"root@{name}" for name in names}


def assert_whole(layout):
    """Every column is one stop's own, a cell, or kept, and only one of these."""
    every = [*layout.own.values(), *layout.cells, layout.kept]
    np.testing.assert_array_equal(np.sort(np.concatenate(every)), np.arange(layout.size))
    sigma = np.concatenate([u.sigma for u in layout.unknowns.values()])
    np.testing.assert_array_equal(layout.sigma, sigma)
    assert names_at(layout, layout.kept) == set(layout.outer())
    assert set(layout.inner()) == set(layout.unknowns) - set(layout.outer())


def test_where_the_rig_moves_between_stops_root_and_joints_are_a_stops_own(problem):
    layout = Layout.of(problem(base={"moves": "stop"}))
    assert own(layout) == {k: {f"root@s{k}", f"joints@s{k}"} for k in range(4)}
    assert len(layout.bodies) == 2 and sum(len(b.blocks) for b in layout.bodies) == 8
    assert {block.kind for block in layout.others} == {"target"}
    assert_whole(layout)


def test_a_root_that_stops_share_is_kept_and_their_joints_are_their_own(problem):
    layout = Layout.of(problem())
    assert own(layout) == {k: {f"joints@s{k}"} for k in range(4)}
    assert roots("a", "b") <= set(layout.outer())
    assert layout.touched["root@a"] == {0, 1} and layout.touched["joints@s2"] == {2}
    assert_whole(layout)


def test_a_rig_that_never_moves_without_joint_noise_has_nothing_of_its_own(problem):
    layout = Layout.of(problem(base={"moves": "never"}, arm=NO_NOISE))
    assert own(layout) == {} and layout.bodies == []
    assert roots("all") <= set(layout.outer())
    assert {block.kind for block in layout.others} == {"tracker", "target"}
    assert_whole(layout)


def test_a_location_of_one_stop_is_that_stops_own(problem, monkeypatch):
    stops = {**rigs.STOPS, "s3": ("c", rigs.STOPS["s3"][1])}
    monkeypatch.setattr(rigs, "STOPS", stops)
    monkeypatch.setattr(rigs, "BASES", {**rigs.BASES, "c": rigs.BASES["b"]})
    layout = Layout.of(problem())
    assert own(layout)[2] == {"joints@s2", "root@b"} and own(layout)[3] == {"joints@s3", "root@c"}
    assert "root@a" in layout.outer()
    assert_whole(layout)


def surfaces_of(problem, columns):
    """Mesh and surface of the cells that stand in columns."""
    at = Layout.of(problem).at
    return {
        (cells.room, int(surface))
        for name, cells in problem.cells.items()
        for column, surface in enumerate(cells.surface, at[name].start)
        if column in columns
    }


@pytest.mark.parametrize("at_once", [1, 64])
def test_cells_of_a_surface_stand_together(problem, monkeypatch, at_once):
    monkeypatch.setattr("calib.linear.layout.CELLS_AT_ONCE", at_once)
    found = problem()
    layout = Layout.of(found)
    each = [surfaces_of(found, columns) for columns in layout.cells]
    assert len(set().union(*each)) == sum(map(len, each)) == 6
    assert (max(map(len, each)) == 1) == (at_once == 1)
    assert len(layout.cells) <= 1 + sum(map(len, layout.cells)) // at_once
    assert names_at(layout, np.concatenate(layout.cells)) == {*CELLS, *TILTS}
    assert not {*CELLS, *TILTS} & set(layout.outer())


def test_cells_of_one_mesh_are_those_of_all_recordings_in_it(tmp_path):
    same = [Source.open(rigs.write(tmp_path / str(k), seed=k)) for k in (1, 2)]
    moved = Source.open(rigs.write(tmp_path / "far", seed=3, offset_m=(5.0, 0.0, 0.0)))
    found = preview(build([*same, moved], Model())).problem
    layout = Layout.of(found)
    rooms = [{room for room, _ in surfaces_of(found, columns)} for columns in layout.cells]
    assert set().union(*rooms) == {0, 2}
    assert_whole(layout)


def test_unknowns_of_a_prior_are_kept_and_bodies_still_speak_of_the_rest(problem):
    found = problem(base={"moves": "stop"})
    layout = Layout.of(found, kept=["root@s1", "root@s2", "joints@s2", "mount"])
    assert own(layout) == {
        0: {"root@s0", "joints@s0"},
        1: {"joints@s1"},
        3: {"root@s3", "joints@s3"},
    }
    assert {*roots("s1", "s2"), "joints@s2"} <= set(layout.outer())
    others = [block.name for block in layout.others if block.kind == "tracker"]
    assert others == ["base_markers at s2", "mount_markers at s2"]
    assert_whole(layout)


def test_calibration_targets_and_planes_are_always_kept(tmp_path):
    """Even of one stop, which alone speaks of them."""
    spec = Spec(mesh=False, locations=2, stops_per_location=2, column_step=40)
    source, _ = simulated.made(tmp_path / "rec", spec)
    stop = source.recording.stops[1]
    found = build([source], Model(), [np.array([False, True, False, False])])
    layout = Layout.of(found)
    assert own(layout) == {0: {f"root@{stop}", f"joints@{stop}"}}
    always = (Role.CALIBRATION, Role.TARGET, Role.GRAVITY, Role.PLANE)
    names = {name for name, u in found.variables.items() if u.role in always}
    assert "planes" in names and "gravity" in names and names <= set(layout.outer())
    assert layout.touched["gravity"] == {-1}
    assert_whole(layout)


def test_what_has_no_prior_is_not_scaled(problem):
    layout = Layout.of(problem(), unbounded=["mount"])
    np.testing.assert_array_equal(layout.sigma[layout.at["mount"]], np.ones(6))
    assert layout.unbounded == {"mount"}
