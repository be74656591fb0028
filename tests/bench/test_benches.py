"""Both sides of a benchmark give the same answer; what they cost is for the benchmarks to say."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

HERE = Path(__file__).parent
SMALLEST = "{lidar: hesai_pandarxt32, locations: 3, stops_per_location: 3, column_step: 100}"
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
        "bench_scale",
        "loop_parts",
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


def test_parts_of_the_loop_are_functions_that_there_are(bench):
    """The profile of a fit and a diagnosis puts clocks around them by name."""
    named = [each for functions in bench.loop_parts.PARTS.values() for each in functions]
    assert [(owner, name) for owner, name in named if not hasattr(owner, name)] == []


@pytest.mark.parametrize("given", [True, False], ids=["rows given", "rows computed"])
def test_point_factors_take_our_step(bench, work, given):
    ours, theirs = work.frozen_step(), bench.point_factors.PointFactors(work, given).step()
    assert ours.keys() == theirs.keys()
    moved = max(np.abs(ours[name] - work.start[name]).max() for name in ours)
    assert moved > 1e-3
    for name in ours:
        np.testing.assert_allclose(theirs[name], ours[name], rtol=0, atol=1e-9 * moved)


def test_scipy_gets_the_derivatives_of_its_rows(bench, work):
    sparse = bench.sparse_rows.SparseRows(bench.sparse_rows.frozen(work))
    rng = np.random.default_rng(0)
    x, way = 1e-3 * rng.standard_normal((2, sparse.size))
    found = sparse.rows(x)[1] @ (sparse._charts(x) @ way)
    ahead, behind = (sparse.rows(x + step * way)[0] for step in (1e-4, -1e-4))
    np.testing.assert_allclose(found, (ahead - behind) / 2e-4, rtol=0, atol=1e-6 * found.max())


@pytest.mark.long
def test_scipy_ends_where_our_steps_end(bench, work):
    frozen = bench.sparse_rows.frozen(work)
    sparse = bench.sparse_rows.SparseRows(frozen)
    ours = bench.sparse_rows.optimum(frozen)
    moved = sparse.distance(np.zeros(sparse.size), ours)
    assert moved > 100
    assert sparse.distance(sparse.optimum(), ours) < 1.0  # scipy stops by relative cost


def test_the_casts_are_those_of_the_whole_step(bench, work):
    for i, ray in enumerate(bench.bench_speed.rays(work)):
        hits = work.source.reference.cast(*ray)
        np.testing.assert_array_equal(work.cast(i).part, hits.triangle)


def test_the_memory_of_a_stops_sums_is_counted(bench, work):
    scan, *_ = work.problem.scans
    (placed,) = bench.bench_memory.lidars([scan], work.start)
    rows = bench.bench_memory.StopRows.of(
        scan, work.layout, work.start, placed, work.associations[0]
    )
    sums = rows.sums()
    # Twist and right side; rings and cells by these; the earlier groups by all; the diagonal.
    floats = 7 * 7 + 7 * rows.sparse + rows.last * rows.sparse + rows.sparse
    columns = len(sums.columns) + 7 * len(sums.chain_columns)
    assert bench.bench_memory.size(sums) == 8 * (floats + columns)


def test_the_screen_adds_up_what_blas_does(bench, work):
    stand = bench.bench_screen.fitted(work.source.recording.folder)
    for rows in bench.bench_screen.captured(stand)[:2]:
        whole, ours = bench.bench_screen.stacked(rows), rows.sums().whole()
        scale = np.sqrt(np.maximum(np.diag(ours), 1e-30))
        np.testing.assert_allclose(
            ours / np.outer(scale, scale), whole.T @ whole / np.outer(scale, scale), atol=1e-9
        )


@pytest.mark.long  # two sides of a whole loop, each command a process
def test_the_loop_agrees_with_itself(tmp_path):
    (tmp_path / "smallest.yaml").write_text(SMALLEST, encoding="utf-8")
    script = [sys.executable, HERE / "bench_loop.py", "--against", HERE.parents[1]]
    asked = ["--presets", tmp_path / "smallest.yaml", "--repeats", "1"]
    told = subprocess.check_output([*script, *asked], text=True)
    lines = {words[1]: line for line in told.splitlines() if len(words := line.split()) > 7}
    for verb in ("fit", "add"):
        assert lines[verb].endswith(" 0 sigma apart"), told
    for verb in ("diagnose", "explain"):
        assert lines[verb].endswith(" same verdict"), told
    for verb in ("fit", "diagnose", "add", "explain", "report"):
        assert 0.1 < float(lines[verb].split()[4]) < 10, told
    assert "eliminating" in told and "whole / its casts" in told


def test_costs_are_of_the_process_and_their_power_is_told(bench):
    scale = bench.bench_scale
    spent = [3.0 + 0.002 * size**1.3 for size in (100, 1000, 10_000)]
    assert scale.exponent((100, 1000, 10_000), spent, 3.0) == pytest.approx(1.3)
    found = scale.cost(["effects"])
    assert 20 < found.peak_mb < 2000 and 0 < found.cpu_s < 2 * found.wall_s
    with pytest.raises(RuntimeError, match="nowhere"):
        scale.cost(["check", "nowhere"])
