"""What all browsers share: the runs, and the one fit that may run at a time."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from calib.runs.run import Run
from calib.view.desk import Desk
from calib.view.job import JOB_ENDS, Job, JobMessage, Task
from calib.view.scene import Scene
from chains.errors import InputError

MOST_SCENES = 3  # recordings that are kept open


class Bench:
    """The runs, whoever looks at them, and the job that makes the next one.

    Args:
        desk: the runs, and the one that a browser begins with.
    """

    def __init__(self, desk: Desk) -> None:
        self._desk = desk
        self._scenes: dict[Path, tuple[Run, Scene]] = {}
        self._hearers: set[Callable[[JobMessage, Any], None]] = set()
        self._lock = threading.RLock()
        self._job: Job | None = None

    def desk(self) -> Desk:
        """For one more browser: the same runs, a choice of its own."""
        return self._desk.another()

    def scene(self, run: Run) -> Scene:
        """What a run shows; read once for all browsers.

        Raises:
            InputError: as `Scene.of`.
        """
        with self._lock:
            known = self._scenes.pop(run.folder, None)
            scene = known[1] if known and known[0] is run else Scene.of(run)
            self._scenes[run.folder] = run, scene  # the last one is the youngest
            while len(self._scenes) > MOST_SCENES:
                self._scenes.pop(next(iter(self._scenes)))
            return scene

    def listen(self, hear: Callable[[JobMessage, Any], None]) -> None:
        """Have all that jobs say told to `hear`, with who started them."""
        self._hearers.add(hear)

    def forget(self, hear: Callable[[JobMessage, Any], None]) -> None:
        """Tell it no more."""
        self._hearers.discard(hear)

    @property
    def busy(self) -> bool:
        """Whether a job runs."""
        return self._job is not None

    def start(self, by: Any, run: Path, change: Task | None = None) -> None:
        """Begin a job, as `Job` takes it; `by` is told to those who listen.

        Raises:
            InputError: one is running.
        """
        with self._lock:
            if self.busy:
                raise InputError(
                    "a fit, a report or a plan is being made already; wait for it, or cancel it"
                )
            job = self._job = Job(run, change, self._desk.trust)
        threading.Thread(target=self._follow, args=(job, by), daemon=True).start()

    def stop(self) -> None:
        """End the job that runs, if there is one."""
        job = self._job
        if job is not None:
            job.stop()

    def _follow(self, job: Job, by: Any) -> None:
        """Pass on what a job tells, until it is over."""
        for told in job.listen():
            if told.kind == "run":
                self._desk.add(Path(told.text))
            elif told.kind in JOB_ENDS:
                self._job = None
            for hear in list(self._hearers):
                hear(told, by)
