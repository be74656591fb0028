"""What every test shares: one thread per BLAS call, an end, real data, and the command line."""

import gc
import os
import signal
import sys
from collections import Counter
from collections.abc import Generator
from importlib import import_module
from pathlib import Path
from unittest.mock import patch

import pytest

from .once import Once

# Before any test imports numpy: several BLAS threads on few cores are far slower than one.
for library in ("MKL", "OMP", "OPENBLAS"):
    os.environ[f"{library}_NUM_THREADS"] = "1"

# A job that a shell starts in the background ignores Ctrl-C, and so would all its children, among
# them those that tests end by Ctrl-C. A handler is not inherited, and this one ignores it as well.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, lambda *_: None)

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"
# Heaviest first, by seconds of a core (150 to 11), browsers too: the last files should be short.
HEAVY = [
    "test_damage",
    "test_docs",
    "test_examples",
    "test_report",
    "test_search",
    "test_executors",
    "test_diagnoses",
    "test_cli",
    "test_components",
    "test_view_browser",
    "test_same_bytes",
    "test_converged",
    "test_arm_geometry",
    "test_own_effects",
    "test_linearise",
    "test_readme",
    "test_formulas",
    "test_systematic",
    "test_formulas_shown",
    "test_report_pointer",
    "test_rejects",
    "test_matters",
    "test_report_odd",
    "test_pose_shapes",
    "test_plan_found",
    "test_view_shown",
    "test_plan",
    "test_mishaps",
    "test_hidden_effects",
    "test_effects_hidden",
    "test_explain",
    "test_turned",
    "test_intervals",
    "test_torn",
    "test_hostile_names",
    "test_killed",
]
LIMIT_S = {"slow": 600, "long": 3600}  # of others: see pyproject.toml


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Give tests that take longer a longer time limit, and begin with files that hold most."""
    slow = Counter()
    for item in items:
        for mark, limit_s in LIMIT_S.items():
            if item.get_closest_marker(mark):
                item.add_marker(pytest.mark.timeout(limit_s), append=False)
                slow[item.path] += 1
    rank = {name: at - len(HEAVY) for at, name in enumerate(HEAVY)}
    items.sort(key=lambda item: (rank.get(item.path.stem, 0), -slow[item.path]))


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Look for no garbage while tests are collected: with 5,000 that took 3 s of 8."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()  # what was made so far stays to the end
        gc.set_threshold(20_000)  # as the command line has it
        gc.enable()


@pytest.fixture(scope="session", autouse=True)
def one_core() -> None:
    """A worker has a core for itself: more threads cost it a fifth of its time (measured on two
    cores, on check, fit and diagnose of 12 stops)."""
    if "PYTEST_XDIST_WORKER" in os.environ:
        from calib.linear import parallel

        parallel.cores = lambda: 1


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of recordings, arms and tables that lies beside the repository, where it does."""
    if not SHARED.is_dir():
        pytest.skip(f"the shared data folder is not here: {SHARED}")
    return SHARED


@pytest.fixture(scope="session")
def once(tmp_path_factory) -> Once:
    """Makes a folder once for all tests and workers of this session, and gives out copies."""
    base = tmp_path_factory.getbasetemp()
    shared = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    return Once(shared / "once", tmp_path_factory.mktemp)


@pytest.fixture(scope="module")
def diagnosed_once():
    """In this file a run that is diagnosed again, and asked the same, has its diagnosis at once.

    It is for tests of what is done with diagnoses, not of how they come about.
    """
    diagnose = import_module("calib.runs.diagnose")
    found, make = {}, diagnose._found

    def known(run, progress, refits, candidates):
        stored = [(run.folder / name).read_bytes() for name in ("solution.yaml", "state.npz")]
        key = repr((run.folder, run.model, run.summary, stored, refits, candidates))
        if key not in found:
            found[key] = make(run, progress, refits, candidates)
        return found[key]

    with patch.object(diagnose, "_found", known):
        yield


@pytest.fixture
def rigcal(monkeypatch, capfd):
    """A function that runs a command here, and returns its exit code, stdout and stderr."""

    from calib.cli import main

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["rigcal", *map(str, arguments)])
        with pytest.raises(SystemExit) as exit_:
            main()
        return exit_.value.code, *capfd.readouterr()

    return run
