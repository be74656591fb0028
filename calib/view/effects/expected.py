"""What stops held out would make of a set of effects, from one linearisation, in a process of its
own: it keeps a run open, so that the next set is answered sooner."""

from __future__ import annotations

import multiprocessing
import signal
import threading
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path

from calib.effects import Trust
from calib.view.job import PATIENCE_S, Change, changed

Asked = tuple[Path, Change]


class Expected:
    """Asks a process that is started by the first question; of several that wait, the last is
    answered.

    Args:
        trust: the Python files of effects that may run.
        hear: called with a question, and the error in mm that is expected; None where there is no
            answer.
    """

    def __init__(self, trust: Trust, hear: Callable[[Asked, float | None], None]) -> None:
        self._trust, self._hear = trust, hear
        self._lock = threading.Lock()
        self._process: multiprocessing.process.BaseProcess | None = None
        self._pipe: Connection | None = None
        self._waiting: Asked | None = None
        self._busy = self._stopped = False

    def ask(self, run: Path, change: Change) -> None:
        """Have it worked out what a run with a change makes of stops held out."""
        with self._lock:
            self._waiting = run, change
            if self._stopped or self._busy:
                return
            self._busy = True
        threading.Thread(target=self._answer, daemon=True).start()

    def stop(self) -> None:
        """End the process; nothing more is told."""
        with self._lock:
            self._stopped = True
            if self._process is not None:
                self._process.terminate()
                self._process.join(PATIENCE_S)

    def _answer(self) -> None:
        """Put what waits to the process, until nothing does."""
        while True:
            with self._lock:
                asked, self._waiting = self._waiting, None
                if asked is None or self._stopped:
                    self._busy = False
                    return
                pipe = self._started()
            try:
                pipe.send(asked)
                answer = pipe.recv()
            except (EOFError, OSError):  # it was ended
                answer, self._process = None, None
            if not self._stopped:
                self._hear(asked, answer)

    def _started(self) -> Connection:
        if self._process is None:
            context = multiprocessing.get_context("spawn")
            self._pipe, theirs = context.Pipe()
            self._process = context.Process(
                target=_work, args=(theirs, dict(self._trust)), daemon=True, name="rigcal expected"
            )
            self._process.start()
            theirs.close()
        return self._pipe


def _work(pipe: Connection, trust: Trust) -> None:
    """What the process does, until the page is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the page, which ends it
    open_run: Callable[[Change], float | None] | None = None
    last: Path | None = None
    while True:
        try:
            run, change = pipe.recv()
        except EOFError:
            return
        try:
            if run != last:
                open_run, last = _opened(run, trust), run
            answer = open_run(change)
        except Exception:  # a refit tells what is wrong
            answer = None
        pipe.send(answer)


def _opened(folder: Path, trust: Trust) -> Callable[[Change], float | None]:
    """A run, to be asked what stops held out would make of a change, mm."""
    from calib.linear.parallel import one_blas_thread
    from calib.results.holdout import held_out
    from calib.runs.reopen import reopened, start_of
    from calib.runs.run import Run
    from calib.solve.fit import stepped

    run = Run.open(folder, trust)
    sources = reopened(run)
    start = start_of(run, sources)
    how = run.model["hold_out"], run.model["folds"], lambda what, done, total: None, start

    @one_blas_thread
    def expected(change: Change) -> float | None:
        return held_out(sources, changed(run, change), *how, fit=stepped).rms_mm

    return expected
