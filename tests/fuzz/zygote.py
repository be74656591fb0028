"""A process that has loaded every reader and used none, and does each task in a child of its own.

It reads a task from every line of its standard input, as JSON, and answers with a line:
``{"outcome": "read" | "refused" | "raised" | "killed", "said": ..., "mb": ..., "seconds": ...}``.
A child may take so much more memory than it begins with, and so much time on the processor.
"""

import json
import os
import resource
import signal
import sys
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))
LIMIT_S = 60  # of a task on the clock; one on the processor is given its own


def _import(kind: str, files: list[str], options: dict[str, Any]) -> None:
    """Everything that an import of these files would look at."""
    from sensors.readers import READERS
    from sensors.readers.base import Options

    if "metadata" in options:
        options["metadata"] = Path(options["metadata"])
    found = READERS[kind].read([Path(f) for f in files], Options(**options), lambda *_: None)
    for sweeps in found.sweeps:
        wanted = np.zeros(len(sweeps.time_s), bool)
        wanted[:2] = True
        for sweep in sweeps.read(wanted):
            assert {len(column) for column in sweep.points.values()} == {len(sweep.points["x"])}
    for track in found.tracks:
        assert track.values.shape == (len(track.time_s), len(track.names))


def _recording(kind: str, files: list[str], options: dict[str, Any]) -> None:
    """A recording as a fit opens it; `files` has one of its files."""
    from calib.problem.model import Source

    folder = next(p for p in Path(files[0]).parents if (p / "stops.csv").exists())
    source = Source.open(folder)
    for k in np.flatnonzero(source.recording.has_scan)[:2]:
        source.recording.scan(int(k))


def _run(kind: str, files: list[str], options: dict[str, Any]) -> None:
    """A run as all commands open it."""
    from calib.runs.reopen import model_of
    from calib.runs.run import Run

    run = Run.open(Path(files[0]).parent)
    model_of(run)
    run.state(), run.met(), run.diagnosis()


def _one(kind: str, files: list[str], options: dict[str, Any]) -> None:
    """A file that is read by a function of its own."""
    from calib.effects import load_effects
    from calib.simulation import load_spec
    from sensors.documents import read_text
    from sensors.lidar import load_lidar
    from sensors.meshes import read_cloud, read_mesh
    from sensors.readers.meshes.labels import read_palette
    from sensors.readers.packets.hesai import read_angles
    from sensors.readers.packets.ouster import read_metadata
    from sensors.recording import read_table

    {
        "cloud": read_cloud,
        "surface": read_mesh,
        "effects": load_effects,
        "lidar": load_lidar,
        "spec": load_spec,
        "table of points": read_table,
        "angles": lambda path: read_angles(Path(path)),
        "palette": lambda path: read_palette(Path(path)),
        "sensor": lambda path: read_metadata(Path(path).name, read_text(path)),
    }[kind](files[0])


TASKS: dict[str, Callable[..., None]] = {"recording": _recording, "run": _run}
ONES = ("cloud", "surface", "effects", "lidar", "spec", "table of points")
ONES += ("angles", "palette", "sensor")
TASKS |= dict.fromkeys(ONES, _one)


def _load() -> None:
    """Import what readers import late, so that no child pays for it."""
    import laspy
    import open3d
    import PIL.Image
    import pyarrow.parquet
    import pye57
    import rosbags.highlevel
    import rosbags.rosbag1
    import rosbags.rosbag2
    import trimesh
    import xacrodoc

    import calib.problem.model
    import calib.runs.reopen
    import calib.simulation
    from sensors.readers.bags.ros import _known_types

    pyarrow.set_cpu_count(1)
    _known_types()
    modules = (laspy, open3d, PIL.Image, pye57, pyarrow.parquet, trimesh, xacrodoc, calib)
    assert all(modules) and rosbags.highlevel and rosbags.rosbag1 and rosbags.rosbag2


def _child(task: dict[str, Any], answer: int) -> None:
    """Do a task, and write what came of it."""
    from chains.errors import InputError

    size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    most = size + task["mb"] * 2**20
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
    resource.setrlimit(resource.RLIMIT_CPU, (task["seconds"], task["seconds"] + 1))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    Path("/proc/self/clear_refs").write_text("5")  # the most that is held begins here
    before_kb = _kilobytes("VmRSS")
    nowhere = os.open(os.devnull, os.O_RDWR)
    for number in (0, 1, 2):
        os.dup2(nowhere, number)
    try:
        TASKS.get(task["kind"], _import)(task["kind"], task["files"], task["options"])
        outcome, said = "read", ""
    except InputError as error:
        outcome, said = "refused", str(error)
    except BaseException as error:
        frames = traceback.extract_tb(error.__traceback__)[-3:]
        last = "; ".join(f"{frame.filename}:{frame.lineno}" for frame in frames)
        outcome, said = "raised", f"{type(error).__name__}: {str(error)[:300]} ({last})"
    mb = (_kilobytes("VmHWM") - before_kb) / 1024
    os.write(answer, json.dumps({"outcome": outcome, "said": said[:5000], "mb": mb}).encode())
    os._exit(0)


def _kilobytes(what: str) -> int:
    lines = Path("/proc/self/status").read_text().splitlines()
    return int(next(line for line in lines if line.startswith(what)).split()[1])


def _do(task: dict[str, Any]) -> dict[str, Any]:
    """What comes of a task in a child."""
    ours, theirs = os.pipe()
    child = os.fork()
    if not child:
        os.close(ours)
        _child(task, theirs)
    os.close(theirs)
    signal.signal(signal.SIGALRM, lambda *_: os.kill(child, signal.SIGKILL))
    signal.alarm(LIMIT_S)
    said = b""
    while part := os.read(ours, 65536):
        said += part
    _, status, used = os.wait4(child, 0)
    signal.alarm(0)
    os.close(ours)
    told = (
        json.loads(said) if said else {"outcome": "killed", "said": f"by status {status}", "mb": 0}
    )
    told["seconds"] = used.ru_utime + used.ru_stime
    return told


if __name__ == "__main__":
    _load()
    for line in sys.stdin:
        print(json.dumps(_do(json.loads(line))), flush=True)
