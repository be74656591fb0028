"""Both sides of the benchmark of evaluations do the same work; memory is that of one stop."""

import sys
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

from calib import problem as problems
from calib.problem.model import Model, Source
from sensors.recording import read_table

HERE = Path(__file__).parent


@pytest.fixture(scope="module")
def work(tmp_path_factory):
    """The benchmark, and a small problem."""
    sys.path.insert(0, str(HERE))
    try:
        bench = import_module("bench_evaluate")
    finally:
        sys.path.remove(str(HERE))
    folder = bench.recorded(tmp_path_factory.mktemp("bench"), 40_000, 4)
    return bench, problems.build([Source.open(folder)], Model())


def test_the_other_side_writes_the_same_tables(work, tmp_path):
    bench, problem = work
    tables = [done.points for done in bench.each(problem)]
    bench.ours(problem, tmp_path / "ours")
    bench.theirs(problem, tables, tmp_path / "theirs")
    ours = sorted((tmp_path / "ours").rglob("*.parquet"))
    ours = [path for path in ours if path.is_file()]
    theirs = sorted((tmp_path / "theirs").glob("*.parquet"))
    assert len(ours) == len(theirs) == 4
    for a, b in zip(ours, theirs, strict=True):
        a, b = read_table(a), read_table(b)
        assert a.keys() == b.keys()
        for name in a:
            np.testing.assert_array_equal(a[name], b[name])


def test_more_stops_take_no_more_memory(work, tmp_path):
    bench, problem = work
    bench.ours(problem, tmp_path / "ours")  # what is built once
    once, thrice = (bench.peak(problem, tmp_path / "ours", copies) for copies in (1, 3))
    assert thrice < 1.1 * once
