"""Threads, processes, a Dask cluster: the same bytes, and no harm where a worker or a user ends it.

What each command writes, in `test_same_bytes`; here with all that is hard to send: effects of
users' own, from a formula and from a Python file, one that looks at the intensity of all scans,
noise, a recording given by a relative path.
"""

import os
import re
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import pytest

from .programs import LIMIT_S, RIGCAL, ROOT, execute
from .programs import rigcal as command

SPEC = "{lidar: hesai_pandarxt32, locations: 3, stops_per_location: 2, column_step: 200}"
MINE = "{name: mine, site: range, unit: '1', sigma: 0.01, basis: [(humidity - 0.45) * range]}"
BENT = """
import numpy as np
from calib.effects import Effect, Param, Site


class Bent(Effect):
    name, site, unit, covariates = "bent", Site.BEAM, "m", ("azimuth_rad",)

    def params(self, rig):
        return (Param("a", "m", 0.01),)

    def basis(self, view):
        out = np.zeros((view.rows, 3, 1))
        out[:, 0, 0] = np.sin(3 * view["azimuth_rad"])
        return out
"""
MODEL = "ring_range_offset,intensity_range_walk,noise_range,mine.yaml,bent.py"
COMMANDS = (
    f"fit rec -o run --effects {MODEL} {{how}}",
    "diagnose run --trust bent.py {how}",
    "evaluate run --trust bent.py {how}",
    "apply run rec -o corrected --trust bent.py {how}",
)
# Runs its arguments as commands in one process, as starting takes long.
PROGRAM = """
import shlex, sys
from calib.cli import main
for line in sys.argv[1:]:
    sys.argv[1:] = shlex.split(line)
    try:
        main()
    except SystemExit as end:
        assert end.code in (0, 3), line
"""
PATHS = {"PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
WAYS = {
    "one thread": "--workers 1",
    "threads": "",
    "two processes": "--workers 2",
    "cluster": "--scheduler {address}",
}


@contextmanager
def cluster():
    """A Dask cluster of two workers, processes of their own."""
    distributed = pytest.importorskip(
        "distributed", reason="the extra 'cluster' is not installed: no Dask cluster is tried"
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", PATHS["PYTHONPATH"])
        how = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": None}
        with distributed.LocalCluster(**how) as found:
            yield found


def program(how, folder):
    """The commands, run so in a folder; what they said on stderr."""
    lines = [line.format(how=how) for line in COMMANDS]
    done = execute([sys.executable, "-c", PROGRAM, *lines], folder, 4 * LIMIT_S, **PATHS)
    assert done.returncode == 0, done.stderr
    return done.stderr


def prepared(folder, recording):
    folder.mkdir()
    (folder / "rec").symlink_to(recording)
    (folder / "mine.yaml").write_text(MINE)
    (folder / "bent.py").write_text(BENT)
    return folder


def written(folder):
    """Every file of the outputs by its name, without what its `seconds` and folder say."""
    outputs = (folder / "run", folder / "corrected")
    files = {p.relative_to(folder): p for out in outputs for p in out.rglob("*") if p.is_file()}
    gone = rb'^ "seconds": [0-9.e-]+,?\n'
    return {
        str(name): re.sub(gone, b"", p.read_bytes(), flags=re.M).replace(bytes(folder), b"HERE")
        for name, p in files.items()
    }


def simulated(folder):
    """A small recording in a folder."""
    (folder / "spec.yaml").write_text(SPEC)
    command(["simulate", "spec.yaml", "-o", "rec", "--seed", "3"], folder)
    return folder / "rec"


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    return simulated(tmp_path_factory.mktemp("executors"))


@pytest.fixture(scope="module")
def alone(recording, tmp_path_factory):
    """What one thread writes."""
    folder = prepared(tmp_path_factory.mktemp("alone") / "here", recording)
    assert program(WAYS["one thread"], folder) == ""
    return written(folder)


@pytest.mark.long
@pytest.mark.parametrize("way", [way for way in WAYS if way != "one thread"])
def test_files_are_the_same_byte_by_byte(way, alone, recording, tmp_path):
    folder = prepared(tmp_path / "there", recording)
    if way == "cluster":
        with cluster() as found:
            program(WAYS[way].format(address=found.scheduler_address), folder)
    else:
        assert program(WAYS[way], folder) == ""
    here = written(folder)
    made = {
        "run/solution.yaml",
        "run/diagnosis.json",
        "run/evaluation.json",
        "corrected/rec/rig.yaml",
    }
    assert here.keys() == alone.keys() and made <= here.keys()
    assert [name for name in here if here[name] != alone[name]] == []


# -------------------------------------------------------------------- while a fit is at work


@contextmanager
def fitting(folder, *options):
    """A fit by two workers at its passes, in a session as of a terminal; and its processes."""
    options = options or ("--workers", "2")
    words = [*RIGCAL, "-v", "fit", "rec", "-o", "run", *options]
    how = {"cwd": folder, "text": True, "start_new_session": True, "env": os.environ | PATHS}
    process = subprocess.Popen(words, stderr=subprocess.PIPE, stdout=subprocess.PIPE, **how)
    try:
        for line in process.stderr:
            if "pass 2" in line:
                break
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children")
        yield process, [int(pid) for pid in children.read_text().split()]
    finally:
        process.kill()
        process.communicate(timeout=LIMIT_S)


def running(pid):
    """Whether a process runs; one that ended and was not asked for its end does not."""
    try:
        return "\nState:\tZ" not in Path(f"/proc/{pid}/status").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return False


needs_proc = pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="no /proc here")


@needs_proc
@pytest.mark.parametrize("ends", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
@pytest.mark.long
def test_no_worker_outlives_a_command_that_is_ended(ends, recording, tmp_path):
    """Ctrl-C goes to all processes of a terminal's session; workers are none of these."""
    prepared(tmp_path / "here", recording)
    with fitting(tmp_path / "here") as (process, workers):
        assert len(workers) == 2
        os.killpg(process.pid, ends)
        _, err = process.communicate(timeout=LIMIT_S)
        if ends is signal.SIGINT:
            assert process.returncode == 130
            assert err.splitlines()[-1] == "rigcal: interrupted; nothing was left half-written"
            assert "Traceback" not in err and not (tmp_path / "here" / "run").exists()
        until = time.monotonic() + LIMIT_S
        while any(map(running, workers)) and time.monotonic() < until:
            time.sleep(0.05)
        assert not any(map(running, workers))


@needs_proc
@pytest.mark.long
def test_a_fit_whose_workers_are_killed_ends_as_any_other(recording, tmp_path):
    """Both, one after the other."""
    here, there = (prepared(tmp_path / name, recording) for name in ("here", "there"))
    with fitting(here) as (process, workers):
        for worker in workers:
            os.kill(worker, signal.SIGKILL)
            time.sleep(0.5)
        _, err = process.communicate(timeout=LIMIT_S)
    assert process.returncode == 0, err
    ended = re.findall(r"worker [12] of 2 was ended by SIGKILL at stop '\w+'; another", err)
    assert len(ended) == 2
    said = r"^rigcal: sent to workers: \d+ stops, each \d+ kB down and \d+ kB up$"
    assert len(re.findall(said, err, re.M)) == 1
    command(["fit", "rec", "-o", "run", "--workers", "1"], there)
    assert written(here) == written(there)


@pytest.mark.long
def test_a_worker_of_a_cluster_that_is_killed_changes_nothing(recording, tmp_path):
    here, there = (prepared(tmp_path / name, recording) for name in ("here", "there"))
    with cluster() as found:
        pids = [worker.pid for worker in found.workers.values()]
        options = ("--hold-out", "none", "--scheduler", found.scheduler_address)
        with fitting(here, *options) as (process, _):
            os.kill(pids[0], signal.SIGKILL)
            _, err = process.communicate(timeout=LIMIT_S)
    assert process.returncode == 0, err
    command(["fit", "rec", "-o", "run", "--hold-out", "none", "--workers", "1"], there)
    assert written(here) == written(there)


@pytest.mark.long
def test_a_scheduler_that_ends_is_one_sentence(recording, tmp_path):
    """It was waited for without end, or called an internal fault."""
    folder = prepared(tmp_path / "here", recording)
    with cluster() as found:
        options = ("--hold-out", "none", "--scheduler", found.scheduler_address)
        with fitting(folder, *options) as (process, _):
            found.close()
            _, err = process.communicate(timeout=LIMIT_S)
    assert process.returncode == 2, err
    assert "the scheduler has ended" in err and "for the same command to go on from" in err
    assert "Traceback" not in err
    assert list(folder.glob(".run.rigcal/*"))


# ------------------------------------------------------------------------------- what is refused


def test_a_scheduler_that_does_not_answer_is_one_sentence(recording, rigcal, monkeypatch):
    pytest.importorskip("distributed", reason="the extra 'cluster' is not installed")
    monkeypatch.setattr("calib.linear.parallel.cluster.SECONDS_TO_ANSWER", 0.5)
    code, out, err = rigcal("fit", recording, "-o", "never", "--scheduler", "tcp://127.0.0.1:9")
    assert (code, out) == (2, "")
    assert "--scheduler tcp://127.0.0.1:9: no Dask scheduler answers there" in err
    assert err.count("\n") == 1


def test_without_distributed_it_is_said_what_to_install(recording, rigcal, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    code, _, err = rigcal("fit", recording, "-o", "never", "--scheduler", "tcp://127.0.0.1:9")
    assert code == 2 and err.endswith("pip install 'rigcal[cluster]'\n")


def test_workers_and_a_scheduler_are_not_given_together(recording, rigcal):
    words = ("fit", recording, "-o", "never", "--workers", "2", "--scheduler", "tcp://x:1")
    assert rigcal(*words)[0] == 2
