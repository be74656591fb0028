"""Commands in processes that start at once, and that can be killed at any step.

This program loads rigcal and then forks for each line that it reads: a request in JSON, answered by
the number of the process as soon as it runs, and by how it ended. A request says:

    argv, cwd   the command, and where
    at          kill it before its n-th step that changes a folder; None: let it end
    most        how many bytes a file may have; None: any number
    exchange    whether the system can exchange two folders in one step
    steps       a file that takes every such step, a line each
    told        a file for what it prints
"""

import importlib
import json
import os
import resource
import signal
import sys

LOADED = (
    *("calib.cli", "calib.runs.explain", "calib.simulation", "calib.intake", "calib.exporters"),
    *("calib.evaluation.apply", "calib.report", "calib.show.tables", "calib.results.check"),
    *("calib.show.diagnosis", "calib.show.comparison", "calib.show.evaluation"),
    *("gtsam", "open3d", "pyarrow.parquet", "scipy.spatial", "threadpoolctl", "typer", "rich"),
)
STEPS = {"os.rename", "os.remove", "os.rmdir", "os.mkdir", "os.link", "os.truncate"}


def watch(request: dict) -> None:
    """Count steps, and die before the one that was asked for."""
    here, steps = os.path.realpath(request["cwd"]), []

    def step(event: str, arguments: tuple) -> None:
        if event not in STEPS:
            return
        path = os.fsdecode(arguments[0]) if isinstance(arguments[0], str | bytes) else here
        inside = os.path.join(here, path)
        if not inside.startswith(here) or "/draft" in inside:  # nobody looks into a draft
            return
        if len(steps) == request["at"]:
            os.kill(os.getpid(), signal.SIGKILL)
        steps.append(event)
        if request.get("steps"):
            with open(request["steps"], "a", encoding="utf-8") as file:
                file.write(event + "\n")

    sys.addaudithook(step)


def run(request: dict) -> int:
    """The command's exit code."""
    from calib.cli import main
    from calib.outputs import moves

    os.chdir(request["cwd"])
    told = os.open(request["told"], os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(told, 1)
    os.dup2(told, 2)
    sys.argv = ["rigcal", *request["argv"]]
    if not request.get("exchange", True):
        moves.exchange = lambda one, other: False
    watch(request)
    if request.get("most") is not None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (request["most"], resource.RLIM_INFINITY))
    try:
        main()
    except SystemExit as exit_:
        return int(exit_.code or 0)
    return 1


def answer(text: object) -> None:
    """A line for the one who asked."""
    print(text, flush=True)


if __name__ == "__main__":
    for name in LOADED:
        importlib.import_module(name)
    answer("ready")
    for line in sys.stdin:
        request = json.loads(line)
        child = os.fork()
        if child == 0:
            code = 1
            try:
                code = run(request)
            finally:
                sys.stdout.flush()
                sys.stderr.flush()
                os._exit(code)
        answer(child)
        answer(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
