"""Beams: every derivative against differences, every sum against the rows themselves."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from calib.effects import Effect, Param, Site
from calib.forward import Term
from calib.problem.build import effect_unknown
from calib.residuals.beams import Association, CellNumbers
from calib.residuals.robust import tukey_weight
from calib.residuals.store import drawn_of_each
from calib.runs.calibrate import calibrate
from calib.runs.run import RESIDUALS
from sensors.lidar import Beams, beams

from . import bent, rigs
from .bent import by_variable, stop_rows
from .rescanned import rescanned
from .simulated import made


@pytest.fixture(scope="module")
def on_mesh(tmp_path_factory):
    return bent.on_mesh(tmp_path_factory.mktemp("mesh"))


@pytest.fixture(scope="module")
def on_planes(tmp_path_factory):
    return bent.on_planes(tmp_path_factory.mktemp("planes"))


@pytest.mark.parametrize(("meeting", "stop"), [("on_mesh", 3), ("on_planes", 0)])
def test_beam_derivatives_by_everything(meeting, stop, request):
    case = request.getfixturevalue(meeting)
    scan, association = case.problem.scans[stop], case.association[stop]
    rows = scan.rows(case.values, association)
    assert np.mean(rows.weight > 0) > 0.5
    sure = rows.weight > 0
    found = by_variable(scan, rows, case.values)
    extra = {"warp", "ring_elevation", "ring_range_offset"}
    kinds = "region", "region.tilt_0", "region.tilt_1", "patch"
    cells = {f"0/reference_{kind}" for kind in ("surface", *kinds)}
    of_planes = {"planes", "planes/region", "planes/patch"}
    extra |= {"faro", *cells} if meeting == "on_mesh" else of_planes
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
    found = ray.turned(np.full(50, azimuth), np.full(50, elevation))
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
        measured = true.turned(*turns)
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


def test_a_surface_that_is_elsewhere_is_no_rougher(on_mesh):
    """Else wide scatter of surfaces would take the weight of all beams on them."""
    scan = on_mesh.problem.scans[0]
    place = on_mesh.values, on_mesh.association[0]
    rows = scan.rows(*place)
    elsewhere = scan.scattering("surface", 0.02).rows(*place)
    rougher = scan.scattering("patch", 0.02).rows(*place)
    np.testing.assert_allclose(elsewhere.sigma_m, rows.sigma_m, rtol=1e-9)
    assert np.all(rougher.sigma_m[rows.usable] > 1.5 * rows.sigma_m[rows.usable])
    usable = rows.usable
    before, *after = (r.sigma_m**2 + r.reference_sigma_m**2 for r in (rows, elsewhere, rougher))
    grown = [(each - before)[usable] for each in after]
    np.testing.assert_allclose(*grown, rtol=1e-9)
    assert np.all(grown[0] >= 0.02**2 * (1 - 1e-9))  # more at a slant


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
    scan, met = replace(on_mesh.problem.scans[0], terms=[], cells={}), on_mesh.association[0]
    before = scan.rows(on_mesh.values, met)
    surface = before.view["surface"]
    cells = CellNumbers.of("surface", np.unique(surface[surface >= 0]))
    index = cells.of_beams(surface)
    theta = np.linspace(-0.02, 0.03, index.max() + 1)
    shifted = replace(scan, cells={"shift": cells})
    after = shifted.rows({**on_mesh.values, "shift": theta}, met)
    moved_m = np.where(index >= 0, theta[index] / np.cos(before.view["incidence_rad"]), 0.0)
    np.testing.assert_allclose(after.residual_m, before.residual_m + moved_m, atol=1e-9)


def test_a_part_that_no_unknown_names_stays(on_mesh):
    scan, met = replace(on_mesh.problem.scans[0], cells={}), on_mesh.association[0]
    before = scan.rows(on_mesh.values, met)
    surface = before.view["surface"]
    index = np.select([surface == 1, surface == 4], [0, 1], -1)
    some = replace(scan, cells={"shift": CellNumbers.of("surface", np.array([1, 4]))})
    moved = some.rows({**on_mesh.values, "shift": np.ones(2)}, met)
    still = index < 0
    np.testing.assert_array_equal(moved.residual_m[still], before.residual_m[still])
    assert np.abs(moved.residual_m - before.residual_m)[~still].min() > 0.9
    (shift,) = (c for c in moved.sparse if c.variable == "shift")
    np.testing.assert_array_equal(shift.index, index)


def test_every_beam_moves_with_the_cells_that_it_meets_and_with_no_other(on_mesh):
    for scan, association in zip(on_mesh.problem.scans, on_mesh.association, strict=True):
        view = scan.rows(on_mesh.values, association).view
        for name, cells in on_mesh.problem.cells.items():
            met = scan.parts(association, cells.column)
            index = scan.cells[name].of_beams(met)
            np.testing.assert_array_equal(cells.parts[index], view[cells.column])
            np.testing.assert_array_equal(cells.surface[index], view["surface"])


@pytest.mark.parametrize("most", [1, 40, 4000])
def test_of_each_group_some_are_drawn_that_stand_for_all_of_it(most):
    group = np.repeat([-1, 0, 2, 7], [50, 1, 700, 299])[np.random.default_rng(0).permutation(1050)]
    some, times = drawn_of_each(group, most, seed=3)
    assert (np.diff(some) > 0).all() and len(some) <= most + len(np.unique(group))
    stands_for = np.bincount(group[some], times, 8)
    np.testing.assert_array_equal(stands_for, np.bincount(group[group >= 0], minlength=8))
    if most == 4000:
        np.testing.assert_array_equal(some, np.flatnonzero(group >= 0))
    else:
        assert times.max() == min(-(-1000 // most), 700)


def test_a_scan_of_one_point_has_a_row_of_its_own(tmp_path):
    """Its columns of points are as long as those of stops, of which some are names."""
    source, _ = made(tmp_path / "rec", "tiny", 1)
    path = tmp_path / "rec" / "scans" / f"{source.recording.stops[3]}.parquet"
    pd.read_parquet(path).iloc[[100]].to_parquet(path)
    run = calibrate([tmp_path / "rec"], tmp_path / "run", hold_out="none")
    (row,) = pd.read_parquet(run.folder / RESIDUALS / path.name).to_dict("records")
    assert np.isfinite([row["residual_m"], row["range_m"]]).all()
