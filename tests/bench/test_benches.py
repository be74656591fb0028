"""Both sides of a benchmark give the same answer; what they cost is for the benchmarks to say."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from calib.residuals.rows import gram

HERE = Path(__file__).parent
ROWS, STOPS = 8000, 4


@pytest.fixture(scope="module")
def bench() -> Iterator[SimpleNamespace]:
    """The benchmarks' modules, which import each other as scripts do."""
    names = (
        "workload",
        "point_factors",
        "sparse_rows",
        "bench_speed",
        "bench_memory",
        "bench_screen",
    )
    sys.path.insert(0, str(HERE))
    try:
        yield SimpleNamespace(**{name: import_module(name) for name in names})
    finally:
        sys.path.remove(str(HERE))


@pytest.fixture(scope="module")
def work(bench, tmp_path_factory):
    """A small workload."""
    folder = bench.workload.recorded(tmp_path_factory.mktemp("bench"), ROWS, STOPS)
    return bench.workload.Work.of(bench.workload.held(folder))


@pytest.mark.parametrize("given", [True, False], ids=["rows given", "rows computed"])
def test_point_factors_take_the_compressed_step(bench, work, given):
    ours, theirs = work.frozen_step(), bench.point_factors.PointFactors(work, given).step()
    assert ours.keys() == theirs.keys()
    moved = max(np.abs(ours[name] - work.start[name]).max() for name in ours)
    assert moved > 1e-3
    for name in ours:
        np.testing.assert_allclose(theirs[name], ours[name], rtol=0, atol=1e-9 * moved)


def test_scipy_gets_the_derivatives_of_its_rows(bench, work):
    sparse = bench.sparse_rows.SparseRows(bench.sparse_rows.FrozenRows(work))
    rng = np.random.default_rng(0)
    x, way = 1e-3 * rng.standard_normal((2, sparse.size))
    found = sparse.rows(x)[1] @ way
    ahead, behind = (sparse.rows(x + step * way)[0] for step in (1e-4, -1e-4))
    np.testing.assert_allclose(found, (ahead - behind) / 2e-4, rtol=0, atol=1e-6 * found.max())


def test_scipy_ends_where_the_compressed_steps_end(bench, work):
    frozen = bench.sparse_rows.FrozenRows(work)
    sparse = bench.sparse_rows.SparseRows(frozen)
    ours = frozen.optimum()
    moved = sparse.distance(np.zeros(sparse.size), ours)
    assert moved > 100
    assert sparse.distance(sparse.optimum(), ours) < 1.0  # scipy stops by relative cost


def test_the_casts_are_those_of_the_whole_step(bench, work):
    for scan, ray in zip(work.problem.scans, bench.bench_speed.rays(work), strict=True):
        hits = work.source.reference.cast(*ray)
        met = scan.rows(work.start).view
        np.testing.assert_array_equal(met["point_m"], hits.point_m)


def test_the_memory_of_a_stops_rows_is_counted(bench, work):
    rows = work.problem.scans[0].rows(work.start, work.associations[0])
    # residual, sigma, weight, six derivatives by the pose, index and value of the ring
    assert bench.bench_memory.size(rows) == 11 * 8 * len(work.associations[0].part)


def test_the_screen_adds_up_what_blas_does(bench, work):
    stand = bench.bench_screen.fitted(work.source.recording.folder)
    for _, beams in bench.bench_screen.captured(stand)[:2]:
        whole = bench.bench_screen.stacked(beams)
        ours = gram(beams.dense, list(beams.groups), beams.weight)
        scale = np.sqrt(np.maximum(np.diag(ours), 1e-30))
        np.testing.assert_allclose(
            ours / np.outer(scale, scale), whole.T @ whole / np.outer(scale, scale), atol=1e-9
        )
