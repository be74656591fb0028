"""Programs run as their users run them: in this process where that loses nothing, none for ever."""

from __future__ import annotations

import os
import runpy
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import chdir, contextmanager, redirect_stdout
from io import StringIO
from pathlib import Path
from unittest.mock import patch

ROOT = Path(__file__).resolve().parents[1]
RIGCAL = (sys.executable, "-c", "from calib.cli import main; main()")
LIMIT_S = 90


# ------------------------------------------------------------------------------ in this process


@contextmanager
def _as(words: Sequence[object], folder: Path) -> Iterator[StringIO]:
    """Arguments, folder and output of this process are those of a program, which ends with 0."""
    said, words = StringIO(), list(map(str, words))
    with chdir(folder), redirect_stdout(said), patch.object(sys, "argv", words):
        try:
            yield said
        except SystemExit as exit_:
            assert not exit_.code, f"{words}: {exit_.code}\n{said.getvalue()}"


def rigcal(words: Sequence[object], folder: Path) -> str:
    """What a command of rigcal prints in a folder."""
    from calib.cli import main

    with _as(["rigcal", *words], folder) as said:
        main()
    return said.getvalue()


def script(path: Path, arguments: Sequence[object], folder: Path) -> str:
    """What a file of Python prints when it is run in a folder; its neighbours can be imported."""
    beside = patch.object(sys, "path", [str(path.parent), *sys.path])
    with _as([path, *arguments], folder) as said, beside:
        runpy.run_path(str(path), run_name="__main__")
    return said.getvalue()


# ---------------------------------------------------------------------------- in one of their own


def _how(folder: Path, variables: dict[str, str]) -> dict[str, object]:
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    return {"cwd": folder, "env": os.environ | {"PATH": path} | variables, "text": True}


def execute(
    command: Sequence[object], folder: Path = ROOT, limit_s: float = LIMIT_S, **variables: str
) -> subprocess.CompletedProcess[str]:
    """A program that has ended, and what it printed."""
    how = _how(folder, variables)
    return subprocess.run(list(map(str, command)), **how, capture_output=True, timeout=limit_s)


@contextmanager
def started(
    command: Sequence[object], folder: Path = ROOT, stderr: int = subprocess.PIPE
) -> Iterator[subprocess.Popen[str]]:
    """A program that runs, and does not outlive this."""
    command = list(map(str, command))
    process = subprocess.Popen(command, **_how(folder, {}), stdout=subprocess.PIPE, stderr=stderr)
    try:
        yield process
    finally:
        process.kill()
        process.communicate(timeout=LIMIT_S)
