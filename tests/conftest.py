"""What every test shares: one thread per BLAS call, real data, and the command line."""

import os
import sys
from pathlib import Path

import pytest

# Before any test imports numpy: several BLAS threads on few cores are far slower than one.
for library in ("MKL", "OMP", "OPENBLAS"):
    os.environ[f"{library}_NUM_THREADS"] = "1"

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of recordings, arms and tables that lies beside the repository, where it does."""
    if not SHARED.is_dir():
        pytest.skip(f"the shared data folder is not here: {SHARED}")
    return SHARED


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
