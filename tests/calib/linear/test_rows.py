"""Sums of a stop's rows, gradients and rows along directions, against the rows themselves."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from calib.residuals.beams import Association
from calib.residuals.store import BeamStore

from .. import bent
from ..bent import by_variable, stop_rows


@pytest.fixture(scope="module")
def on_mesh(tmp_path_factory):
    return bent.on_mesh(tmp_path_factory.mktemp("mesh"))


@pytest.fixture(scope="module")
def on_planes(tmp_path_factory):
    return bent.on_planes(tmp_path_factory.mktemp("planes"))


def summed(case, stops):
    """The normal equations (U + 1, U + 1) of some stops' sums; the right side is last."""
    size = sum(u.dim for u in case.problem.variables.values())
    total = np.zeros((size + 1, size + 1))
    for k in stops:
        rows = stop_rows(case, case.problem.scans[k], case.association[k])
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


@dataclass
class OtherColumns:
    """A store whose scans have more columns than were written."""

    store: BeamStore
    columns: dict

    def read(self, stop):
        scan, beams = self.store.read(stop)
        return replace(scan, extra={**scan.extra, **self.columns}), beams


def test_a_column_of_the_users_is_not_taken_for_what_beams_meet(on_planes):
    scan, association = on_planes.problem.scans[0], on_planes.association[0]
    columns = {"surface": np.linspace(-2.5, 3.5, len(association.part))}
    named = replace(scan, store=OtherColumns(scan.store, columns))
    expected = stop_rows(on_planes, scan, association).places()
    for mine, theirs in zip(
        stop_rows(on_planes, named, association).places(), expected, strict=True
    ):
        np.testing.assert_array_equal(mine, theirs)
