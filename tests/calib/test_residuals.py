"""Beams: every derivative against differences, every sum against the rows themselves."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from calib.effects import Effect, OneHot, Param, Site
from calib.forward import Term
from calib.linear.layout import Layout
from calib.linear.rows import StopRows
from calib.problem.build import build, effect_unknown
from calib.problem.model import Model, Source
from calib.problem.surfaces import with_surfaces
from calib.residuals.beams import Association
from calib.residuals.robust import tukey_weight
from calib.residuals.scan import turned
from calib.residuals.surfaces import PlaneSurface
from sensors.lidar import Beams, beams
from sensors.planes import Planes

from . import rigs
from .rescanned import rescanned


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
        normal=np.repeat(np.eye(3), 2, axis=0),
        distance_m=np.ravel([[0, size] for size in rigs.ROOM_M]),
        count=np.full(6, 100),
        cell_mean_m=vertices[triangles].mean(axis=1),
        cell_plane=walls,
        cell_m=1.0,
        tolerance_m=0.3,
    )
    met = {0: PlaneSurface(found, "planes")}
    return bent(build([source], Model(), meetings=met), surfaces=False)


def bent(problem, surfaces):
    """The problem with every kind of beam and surface error switched on, away from its start."""
    source = problem.sources[0]
    terms = [
        Term(e, e.name, np.arange(len(e.params(source.rig)))) for e in (Warp(), RingElevation())
    ]
    for term in terms:
        problem.add(effect_unknown(term, source))
    problem.scans = [replace(s, terms=[*s.terms, *terms]) for s in problem.scans]
    values = rigs.shaken(problem.variables, problem.initial, 0.01)
    association = [s.associate(values, near_edges=False) for s in problem.scans]
    if surfaces:
        pairs = zip(problem.scans, association, strict=True)
        views = [scan.rows(values, a).view for scan, a in pairs]
        patches = ({kind: view[kind] for kind in ("region", "patch")} for view in views)
        with_patches = [replace(a, patches=p) for a, p in zip(association, patches, strict=True)]
        problem, association = with_surfaces(problem, with_patches)
        cells = {name: problem.variables[name] for name in problem.cells}
        values |= rigs.shaken(cells, problem.initial, 0.01)
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
    cells = {f"0/reference_{kind}" for kind in ("surface", "region", "patch")}
    extra |= {"faro", *cells} if meeting == "on_mesh" else {"planes"}
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
    seeing = rescanned(scan, read)
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
    alone = rescanned(scan, single)
    quiet = on_mesh.values | {t.variable: np.zeros(len(t.free)) for t in scan.terms}
    quiet |= {name: np.zeros_like(quiet[name]) for name in on_mesh.problem.cells}
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
    wild = rescanned(scan, replace(read, xyz_m=xyz))
    after = wild.rows(on_mesh.values, on_mesh.association[0])
    others = np.arange(len(z)) != far
    assert after.weight[far] == 0
    np.testing.assert_allclose(after.weight[others], rows.weight[others], atol=0.02)


def test_a_stop_that_meets_nothing_says_nothing(on_mesh):
    """All its beams may graze, or pass close to edges; the other stops still count."""
    scan = on_mesh.problem.scans[0]
    nothing = Association(np.full(len(on_mesh.association[0].part), -1))
    rows = stop_rows(on_mesh, scan, nothing)
    assert not rows.sums().whole().any()
    assert not rows.gradient(np.zeros(len(rows.b), int), 1)[0].any()


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
    source, problem = on_mesh.problem.sources[0], on_mesh.problem
    far = problem.with_cells([effect_unknown(scan.terms[0], source)], problem.cells)
    case = SimpleNamespace(problem=far, values=values)
    assert np.isfinite(stop_rows(case, scan, Association(part)).sums().whole()).all()


@pytest.mark.filterwarnings("error")
def test_a_beam_that_meets_no_plane_says_nothing_and_divides_by_nothing(on_planes):
    part = on_planes.association[0].part.copy()
    part[:50] = -1
    rows = on_planes.problem.scans[0].rows(on_planes.values, Association(part))
    assert not rows.usable[:50].any() and not rows.weight[:50].any()
    assert all(np.isfinite(c.value).all() and not c.value[:50].any() for c in rows.sparse)


# ------------------------------------------------------------------------------------------- shifts


def test_a_shifted_surface_stands_off_along_its_normal(on_mesh):
    """true = mesh + d n, n towards the sensor: nearer, so what is measured reads longer."""
    scan, values = replace(on_mesh.problem.scans[0], terms=[]), on_mesh.values
    plain = replace(on_mesh.association[0], cells={})
    before = scan.rows(values, plain)
    surfaces, index = np.unique(before.view["surface"], return_inverse=True)
    theta = np.linspace(-0.02, 0.03, len(surfaces))
    after = scan.rows({**values, "shift": theta}, replace(plain, cells={"shift": index}))
    expected = before.residual_m + theta[index] / np.cos(before.view["incidence_rad"])
    np.testing.assert_allclose(after.residual_m, expected, atol=1e-9)


def test_a_part_that_no_unknown_names_stays(on_mesh):
    scan, values = on_mesh.problem.scans[0], on_mesh.values
    plain = replace(on_mesh.association[0], cells={})
    before = scan.rows(values, plain)
    surface = before.view["surface"]
    index = np.select([surface == 1, surface == 4], [0, 1], -1)
    moved = scan.rows({**values, "shift": np.ones(2)}, replace(plain, cells={"shift": index}))
    still = index < 0
    np.testing.assert_array_equal(moved.residual_m[still], before.residual_m[still])
    assert np.abs(moved.residual_m - before.residual_m)[~still].min() > 0.9
    (shift,) = (c for c in moved.sparse if c.variable == "shift")
    np.testing.assert_array_equal(shift.index, index)


def test_every_beam_moves_with_the_cells_that_it_meets_and_with_no_other(on_mesh):
    for scan, association in zip(on_mesh.problem.scans, on_mesh.association, strict=True):
        view = scan.rows(on_mesh.values, association).view
        for name, cells in on_mesh.problem.cells.items():
            index = association.cells[name]
            np.testing.assert_array_equal(cells.parts[index], view[cells.column])
            np.testing.assert_array_equal(cells.surface[index], view["surface"])


# --------------------------------------------------------------------------------------------- sums


def stop_rows(case, scan, association, newton=False):
    """One stop's linear rows over the unknowns of a case."""
    placed = scan.stops.in_reference("lidar", case.values)
    return StopRows.of(scan, Layout.of(case.problem), case.values, placed, association, newton)


def summed(case, stops, newton=False):
    """The normal equations (U + 1, U + 1) of some stops' sums; the right side is last."""
    size = sum(u.dim for u in case.problem.variables.values())
    total = np.zeros((size + 1, size + 1))
    for k in stops:
        rows = stop_rows(case, case.problem.scans[k], case.association[k], newton)
        sums, count = rows.sums(), 7 + len(rows.columns)
        through = np.zeros((count, size + 1))
        through[:6, sums.chain_columns] = sums.chain
        through[np.arange(6, count), np.append(size, sums.columns)] = 1.0
        total += through.T @ sums.whole() @ through
    return total


def whole(case, stop):
    """Derivative (N, U) of a stop's rows by all unknowns, minus their residuals (N,), and their
    weights over variance (N,)."""
    scan, association = case.problem.scans[stop], case.association[stop]
    rows = scan.rows(case.values, association)
    d = by_variable(scan, rows, case.values)
    count, unknowns = len(rows.residual_m), case.problem.variables.values()
    A = np.hstack([d.get(u.name, np.zeros((count, u.dim))) for u in unknowns])
    return A, -rows.residual_m, rows.weight / rows.sigma_m**2


@pytest.mark.parametrize("meeting", ["on_mesh", "on_planes"])
@pytest.mark.parametrize("stops", [[2], [0, 1, 2, 3]])
def test_sums_are_the_normal_equations_of_all_rows(meeting, stops, request):
    case = request.getfixturevalue(meeting)
    expected = 0.0
    for k in stops:
        A, b, weight = whole(case, k)
        rows = np.column_stack([A, b])
        expected = expected + rows.T @ (weight[:, None] * rows)
    size = np.sqrt(np.maximum(np.diag(expected), 1e-30))
    np.testing.assert_allclose(
        summed(case, stops) / np.outer(size, size), expected / np.outer(size, size), atol=1e-10
    )


@pytest.mark.parametrize("meeting", ["on_mesh", "on_planes"])
def test_gradients_by_cluster_are_those_of_their_rows(meeting, request):
    case = request.getfixturevalue(meeting)
    A, b, weight = whole(case, 1)
    rows = stop_rows(case, case.problem.scans[1], case.association[1])
    cluster = np.random.default_rng(0).integers(0, 5, len(b))
    found, columns = rows.gradient(cluster, 5)
    full = np.zeros((5, A.shape[1]))
    full[:, columns] = found
    expected = (cluster == np.arange(5)[:, None]) * (weight * b) @ A
    scale = np.maximum(np.sqrt(np.square(A).T @ weight), 1e-12)
    np.testing.assert_allclose(full / scale, expected / scale, atol=1e-9)


@pytest.mark.parametrize("meeting", ["on_mesh", "on_planes"])
def test_rows_along_directions_are_the_rows_times_these(meeting, request):
    case = request.getfixturevalue(meeting)
    A, b, weight = whole(case, 3)
    rows = stop_rows(case, case.problem.scans[3], case.association[3])
    directions = np.random.default_rng(0).standard_normal((A.shape[1], 3))
    felt = weight > 0
    np.testing.assert_allclose(rows.along(directions)[felt], (A @ directions)[felt], atol=1e-9)
    np.testing.assert_array_equal(rows.b, b)
    np.testing.assert_allclose(rows.weight, weight, rtol=1e-12)


@pytest.mark.parametrize("meeting", ["on_mesh", "on_planes"])
def test_newtons_curvature_leaves_the_gradient_as_it_is(meeting, request):
    case = request.getfixturevalue(meeting)
    A, B = (summed(case, [0, 2], newton) for newton in (False, True))
    size = np.sqrt(np.maximum(np.diag(A), 1e-30))[:-1]
    np.testing.assert_allclose(B[:-1, -1] / size, A[:-1, -1] / size, atol=1e-9 * A[-1, -1] ** 0.5)
    assert np.abs(B - A)[:-1, :-1].max() > 0.01 * np.abs(A).max()


def test_a_corridor_leaves_its_own_direction_open(on_mesh):
    """Beams that meet one kind of wall say three things of where the LiDAR is, and no more."""
    case = on_mesh
    scan = replace(case.problem.scans[0], terms=[])
    rows = scan.rows(case.values, case.association[0])
    wall = np.abs(rows.view["normal"] @ rows.view["normal"][0]) > 0.99
    association = Association(np.where(wall, case.association[0].part, -1))
    quiet = scan.rows(case.values, association)
    J = quiet.by_twist * (np.sqrt(quiet.weight) / quiet.sigma_m)[:, None]
    sums = stop_rows(case, scan, association).sums()
    size = np.linalg.norm(J, axis=0)
    unit = np.outer(size, size)
    np.testing.assert_allclose(sums.dense[:6, :6] / unit, J.T @ J / unit, atol=1e-12)
    assert np.linalg.matrix_rank(sums.dense[:6, :6] / unit, tol=1e-9) == 3
    placed = scan.stops.in_reference("lidar", case.values)
    np.testing.assert_array_equal(sums.chain, np.hstack([d[0] for d in placed.d.values()]))
