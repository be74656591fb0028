"""Beams: every derivative against differences, every compression against the rows themselves."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from calib.effects import Effect, OneHot, Param, Site, SurfaceShift
from calib.forward import Term
from calib.problem.build import build, effect_variable
from calib.problem.model import Model, Source
from calib.residuals.beams import Association, SharedSum
from calib.residuals.rows import tukey_weight
from calib.residuals.scan import turned
from calib.residuals.surfaces import PlaneSurface
from sensors.lidar import Beams, beams
from sensors.planes import Planes

from . import rigs


class Warp(Effect):
    """Range, azimuth and elevation all lie, and in a way that turns with the beam."""

    name, site = "warp", Site.BEAM

    def params(self, rig):
        return tuple(Param(f"{what}_{k}", "", 0.01) for what in ("r", "a", "e") for k in (0, 1))

    def basis(self, view):
        turn = np.stack([np.ones(view.rows), np.cos(view["azimuth_rad"])], axis=1)
        basis = np.zeros((view.rows, 3, 6))
        for site in range(3):
            basis[:, site, 2 * site : 2 * site + 2] = turn
        return basis


class RingElevation(Effect):
    """Every other ring points too high: one parameter each, the rest right."""

    name, site = "ring_elevation", Site.BEAM

    def params(self, rig):
        return tuple(Param(f"ring_{k}", "rad", 0.01) for k in range(rigs.RINGS // 2))

    def basis(self, view):
        ring = view["ring"]
        index = np.where(ring % 2, -1, ring // 2)
        return OneHot(index, np.tile([0.0, 0.0, 1.0], (view.rows, 1)), rigs.RINGS // 2)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("residuals")


@pytest.fixture(scope="module")
def on_mesh(folder):
    return bent(build([Source.open(rigs.write(folder / "mesh"))], Model()), surfaces=True)


@pytest.fixture(scope="module")
def on_planes(folder):
    source = Source.open(rigs.write(folder / "planes", reference=None))
    walls = np.repeat(np.arange(6), rigs.WALL_STEPS**2 * 2)
    vertices, triangles = rigs.room()
    found = Planes(
        np.repeat(np.eye(3), 2, axis=0),
        np.ravel([[0, size] for size in rigs.ROOM_M]),
        np.full(6, 100),
        vertices[triangles].mean(axis=1),
        walls,
        cell_m=1.0,
        tolerance_m=0.3,
    )
    met = {0: PlaneSurface(found, "planes")}
    return bent(build([source], Model(), meetings=met), surfaces=False)


def bent(problem, surfaces):
    """The problem with every kind of beam and surface error switched on, away from its start."""
    source = problem.sources[0]
    chosen = [Warp(), RingElevation()]
    if surfaces:
        view = problem.scans[0].rows(problem.initial).view
        chosen += [
            SurfaceShift(column, column, np.unique(view[column]), 0.001)
            for column in ("surface", "region", "patch")
        ]
    terms = [Term(e, e.name, np.arange(len(e.params(source.rig)))) for e in chosen]
    for term in terms:
        problem.add(effect_variable(term, source))
    problem.scans = [replace(s, terms=[*s.terms, *terms]) for s in problem.scans]
    values = rigs.shaken(problem.variables, problem.initial, 0.01)
    association = [s.associate(values, near_edges=False) for s in problem.scans]
    return SimpleNamespace(problem=problem, values=values, association=association)


def dense(columns, count, dim):
    """Columns with one non-zero per row, in full."""
    out = np.zeros((count, dim))
    touched = np.flatnonzero(columns.index >= 0)
    out[touched, columns.components[columns.index[touched]]] = columns.value[touched]
    return out


def by_variable(scan, rows, values):
    """Derivative (N, dim) of a stop's residuals by everything they depend on."""
    placed = scan.stops.in_reference("lidar", values)
    d = {name: rows.by_twist @ columns[0] for name, columns in placed.d.items()} | dict(rows.dense)
    for c in rows.sparse:
        full = dense(c, len(rows.residual_m), len(values[c.variable]))
        d[c.variable] = d.get(c.variable, 0.0) + full
    return d


@pytest.mark.parametrize(("meeting", "stop"), [("on_mesh", 3), ("on_planes", 0)])
def test_beam_derivatives_by_everything(meeting, stop, request):
    case = request.getfixturevalue(meeting)
    scan, association = case.problem.scans[stop], case.association[stop]
    rows = scan.rows(case.values, association)
    assert np.mean(rows.weight > 0) > 0.5
    sure = rows.weight > 0
    found = by_variable(scan, rows, case.values)
    extra = {"warp", "ring_elevation", "ring_range_offset"}
    extra |= {"surface", "patch", "faro"} if meeting == "on_mesh" else {"planes"}
    assert extra <= set(found)
    for name, d in found.items():
        expected = rigs.differences(
            lambda v: scan.rows(v, association).residual_m,
            case.values,
            name,
            case.problem.variables[name].kind,
        )
        rigs.assert_derivative(d[sure], expected[sure], name)


def test_turned_beams_are_turned_as_their_names_say():
    rng = np.random.default_rng(8)
    azimuth, elevation = 0.3, 0.05
    ray = beams(rng.normal(size=(50, 3)), (0.03, 0.01))
    spin = rigs.Rotation.from_rotvec([0, 0, azimuth])
    left = np.stack(
        [-np.sin(ray.azimuth_rad), np.cos(ray.azimuth_rad), 0 * ray.azimuth_rad], axis=1
    )
    up = spin * rigs.Rotation.from_rotvec(-elevation * left)
    found = turned(ray, np.full(50, azimuth), np.full(50, elevation))
    np.testing.assert_allclose(found.origin_m, spin.apply(ray.origin_m), atol=1e-12)
    np.testing.assert_allclose(found.direction, up.apply(ray.direction), atol=1e-12)
    np.testing.assert_array_equal(found.range_m, ray.range_m)


def test_perfect_beams_on_the_walls_have_no_residual(on_mesh):
    """measured = true + effect, range, azimuth and elevation alike, by a box and scipy alone."""
    scan, problem = on_mesh.problem.scans[0], on_mesh.problem
    values = {**problem.initial, "warp": np.array([0.01, 0.004, 0.003, -0.002, 0.004, 0.001])}
    T = rigs.RigidTransform.from_matrix(scan.pose(values))
    origin, direction, ring, _ = rigs.fan()
    range_m = rigs.to_walls(T.apply(origin), T.rotation.apply(direction))
    true = Beams(origin, direction, range_m)
    # The basis looks at the measured azimuth: find the beam whose error, added, gives itself.
    measured = true
    for _ in range(20):
        by_turn = np.stack([np.ones(len(ring)), np.cos(measured.azimuth_rad)])
        reach_m, *turns = values["warp"].reshape(3, 2) @ by_turn
        measured = turned(true, *turns)
    xyz = measured.origin_m + (range_m + reach_m)[:, None] * measured.direction
    read = replace(scan.recording.scan(0), xyz_m=xyz, ring=ring)
    seeing = replace(scan, recording=SimpleNamespace(scan=lambda _: read))
    part = scan.meeting.associate(scan.pose(values), true, values, near_edges=True)
    rows = seeing.rows(values, part)
    assert rows.usable.sum() > 300
    assert np.abs(rows.residual_m[rows.usable]).max() < 1e-9


def test_sigma_is_that_of_the_data_sheet_the_angle_and_the_reference(on_mesh):
    """One return per direction, its spread unknown: the closed form, each part once."""
    scan = on_mesh.problem.scans[1]
    read = scan.recording.scan(1)
    single = replace(
        read, count=np.ones(len(read.ring)), range_std_m=np.full(len(read.ring), np.nan)
    )
    alone = replace(scan, recording=SimpleNamespace(scan=lambda _: single))
    quiet = on_mesh.values | {t.variable: np.zeros(len(t.free)) for t in scan.terms}
    rows = alone.rows(quiet, on_mesh.association[1])
    lidar, t, g = scan.lidar, rows.view["range_m"], rows.view["incidence_rad"]
    noise = lidar.sigma_range_m**2 + (lidar.sigma_range_incidence * t * np.tan(g)) ** 2
    angle = (lidar.sigma_angle_rad * t * np.tan(g)) ** 2
    reference = (0.0006 / np.cos(g)) ** 2
    total = rows.sigma_m**2 + rows.reference_sigma_m**2
    np.testing.assert_allclose(
        total, noise + lidar.quantum_m**2 / 12 + angle + reference, rtol=1e-9
    )


def test_a_wild_beam_loses_its_own_weight_and_no_others(on_mesh):
    scan = on_mesh.problem.scans[0]
    rows = scan.rows(on_mesh.values, on_mesh.association[0])
    z = rows.residual_m / rows.sigma_m
    np.testing.assert_allclose(rows.weight, tukey_weight(z, rows.scale), atol=1e-12)
    read = scan.recording.scan(0)
    far = np.flatnonzero(rows.weight > 0.9)[0]
    xyz = read.xyz_m.copy()
    xyz[far] *= 1.5
    wild = replace(scan, recording=SimpleNamespace(scan=lambda _: replace(read, xyz_m=xyz)))
    after = wild.rows(on_mesh.values, on_mesh.association[0])
    others = np.arange(len(z)) != far
    assert after.weight[far] == 0
    np.testing.assert_allclose(after.weight[others], rows.weight[others], atol=0.02)


def test_a_stop_that_meets_nothing_says_nothing(on_mesh):
    """All its beams may graze, or pass close to edges; the other stops still count."""
    scan = on_mesh.problem.scans[0]
    nothing = Association(np.full(len(on_mesh.association[0].part), -1))
    compressed = scan.compress(on_mesh.values, nothing)
    residual, d = compressed.pose.evaluate(on_mesh.values, True)
    assert not residual.any() and not any(column.any() for column in d.values())


class Far(Effect):
    """Grows with range, as an effect may."""

    name, site = "far", Site.BEAM

    def params(self, rig):
        return (Param("per_m", "", 0.01),)

    def basis(self, view):
        basis = np.zeros((view.rows, 3, 1))
        basis[:, 0, 0] = view["range_m"]
        return basis


def test_a_beam_whose_plane_fell_behind_it_is_left_out(on_mesh):
    """With its triangle kept, a beam may come to look away from it: as far off as a miss."""
    scan = replace(on_mesh.problem.scans[0], terms=[Term(Far(), "far", np.arange(1))])
    values = {**on_mesh.values, "far": np.array([0.01])}
    part = on_mesh.association[0].part.copy()
    rows = scan.rows(values, Association(part))
    behind = np.flatnonzero(rows.view["normal"] @ rows.view["normal"][0] < -0.99)[0]
    part[behind], part[1] = part[0], -1
    left = scan.rows(values, Association(part))
    assert np.isfinite(left.residual_m).all()
    assert left.weight[behind] == left.weight[1] == 0
    residual, d = scan.compress(values, Association(part)).pose.evaluate(values, True)
    assert np.isfinite(residual).all() and all(np.isfinite(column).all() for column in d.values())


# ------------------------------------------------------------------------------------- compression


def compressed(case, stops, newton=False):
    """What the graph sees of some stops."""
    poses, shared = [], SharedSum()
    for k in stops:
        scan = case.problem.scans[k].compress(case.values, case.association[k], newton)
        poses.append(scan.pose)
        shared.add(scan)
    return [*poses, *shared.rows()]


def normal_equations(blocks, names, values):
    """J^T J, J^T r and r^T r over the named variables."""
    sizes = {name: 6 if np.ndim(values[name]) == 2 else len(values[name]) for name in names}
    first = dict(zip(names, np.cumsum([0, *sizes.values()])[:-1], strict=True))
    A = np.zeros((sum(sizes.values()) + 1,) * 2)
    for residual, d in blocks:
        J = np.zeros((len(residual), len(A)))
        for name, columns in d.items():
            J[:, first[name] : first[name] + sizes[name]] += columns
        J[:, -1] = residual
        A += J.T @ J
    return A


@pytest.mark.parametrize("meeting", ["on_mesh", "on_planes"])
@pytest.mark.parametrize("stops", [[2], [0, 1, 2, 3]])
def test_compressed_rows_have_the_normal_equations_of_all_rows(meeting, stops, request):
    case = request.getfixturevalue(meeting)
    whole = []
    for k in stops:
        scan = case.problem.scans[k]
        rows = scan.rows(case.values, case.association[k])
        root = np.sqrt(rows.weight) / rows.sigma_m
        d = by_variable(scan, rows, case.values)
        whole.append(
            (root * rows.residual_m, {n: root[:, None] * columns for n, columns in d.items()})
        )
    names = list(dict.fromkeys(name for _, d in whole for name in d))
    expected = normal_equations(whole, names, case.values)
    blocks = compressed(case, stops)
    found = normal_equations([b.evaluate(case.values, True) for b in blocks], names, case.values)
    size = np.sqrt(np.maximum(np.diag(expected), 1e-30))
    np.testing.assert_allclose(
        found / np.outer(size, size), expected / np.outer(size, size), atol=1e-10
    )
    rows_few = sum(b.rows for b in blocks)
    assert rows_few <= 6 * len(stops) + 1 + sum(len(case.values[n]) for n in blocks[-1].variables)


@pytest.mark.parametrize("meeting", ["on_mesh", "on_planes"])
def test_newtons_curvature_leaves_the_gradient_as_it_is(meeting, request):
    case = request.getfixturevalue(meeting)
    plain, newton = (compressed(case, [0, 2], newton) for newton in (False, True))
    names = list(dict.fromkeys(name for block in plain for name in block.variables))
    A, B = (
        normal_equations([b.evaluate(case.values, True) for b in blocks], names, case.values)
        for blocks in (plain, newton)
    )
    size = np.sqrt(np.maximum(np.diag(A), 1e-30))[:-1]
    np.testing.assert_allclose(B[:-1, -1] / size, A[:-1, -1] / size, atol=1e-9 * A[-1, -1] ** 0.5)
    assert np.abs(B - A)[:-1, :-1].max() > 0.01 * np.abs(A).max()


@pytest.mark.parametrize("meeting", ["on_mesh", "on_planes"])
def test_compressed_rows_derivatives_hold_away_from_linearisation(meeting, request):
    case = request.getfixturevalue(meeting)
    away = rigs.shaken(case.problem.variables, case.values, 0.05, seed=9)
    for block in compressed(case, [3]):
        rigs.assert_block_derivatives(block, case.problem.variables, away)


def test_a_corridor_leaves_its_own_direction_open(on_mesh):
    """Rows of few directions compress too: rank 1 and 3, and no more rows than that say."""
    case = on_mesh
    scan = case.problem.scans[0]
    rows = scan.rows(case.values, case.association[0])
    wall = np.abs(rows.view["normal"] @ rows.view["normal"][0]) > 0.99
    association = Association(np.where(wall, case.association[0].part, -1))
    plain = replace(scan, terms=[])
    quiet = plain.rows(case.values, association)
    block = plain.compress(case.values, association).pose
    J = quiet.by_twist * (np.sqrt(quiet.weight) / quiet.sigma_m)[:, None]
    size = np.linalg.norm(J, axis=0)
    assert np.linalg.matrix_rank(J / size, tol=1e-9) == 3
    _, d = block.evaluate(case.values, True)
    placed = plain.stops.in_reference("lidar", case.values)
    for name, columns in placed.d.items():
        expected = columns[0].T @ J.T @ J @ columns[0]
        np.testing.assert_allclose(
            d[name].T @ d[name], expected, atol=1e-10 * np.abs(expected).max()
        )
