"""A refit, a diagnosis or a plan in a process of its own: the page stays alive, and a job can be
stopped.

The process does what ``rigcal add``, ``diagnose`` and ``plan`` do, and tells of it through a pipe.
"""

from __future__ import annotations

import multiprocessing
import signal
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal

from calib.effects import Trust
from chains.errors import InputError
from sensors.documents import write_yaml

if TYPE_CHECKING:
    from calib.problem.model import Model
    from calib.runs.run import Run
    from calib.solve.fit import Progress

JOB_ENDS = ("done", "failed", "stopped")  # kinds of message after which a job says no more
PATIENCE_S = 10.0  # for a process that was stopped to clean up


@dataclass(frozen=True)
class JobMessage:
    """What a job says of itself.

    Args:
        kind: "progress"; "run", a run folder stands; "plan", a plan does; "done"; "failed";
            "stopped".
        text: what is being done, the folder, what the plan is worth, or the sentence that says what
            is wrong.
        share: of the present step that is done, 0 to 1.
    """

    kind: Literal["progress", "run", "plan", "done", "failed", "stopped"]
    text: str = ""
    share: float = 0.0


@dataclass(frozen=True)
class Change:
    """What is to be another in the next run.

    Args:
        out: folder of the run to make.
        added: effects, as `Desk.addable` has them: names, or documents of formulas.
        dropped: names of effects that the model is to have no more.
        without: what to leave out, as ``--without`` takes it.
    """

    out: Path
    added: Sequence[str | Mapping[str, Any]] = ()
    dropped: Sequence[str] = ()
    without: Sequence[str] = ()


@dataclass(frozen=True)
class Report:
    """A report to be written.

    Args:
        out: the file.
    """

    out: Path


@dataclass(frozen=True)
class PlanStops:
    """Stops to be planned.

    Args:
        out: folder of the plan.
        purpose: what they are for, as ``--for`` takes it; None for what the diagnosis needs.
        stops: how many.
    """

    out: Path
    purpose: str | None
    stops: int


Task = Change | Report | PlanStops


class Job:
    """A run refitted with a change, and the result diagnosed; a run diagnosed, where nothing is to
    be changed; its report written; or stops planned for it.

    Args:
        run: folder of the run to start from.
        change: what is to be another, or the report, or the plan.
        trust: the Python files of effects that may run.
    """

    def __init__(
        self,
        run: Path,
        change: Task | None = None,
        trust: Trust = MappingProxyType({}),
    ) -> None:
        # Spawned: a process with threads and libraries such as these cannot be forked safely.
        context = multiprocessing.get_context("spawn")
        self._ear, mouth = context.Pipe(duplex=False)
        self._stopped = False
        task = (mouth, run, change, dict(trust))
        self._process = context.Process(target=_work, args=task, daemon=True, name="rigcal job")
        self._process.start()
        mouth.close()  # so that the pipe ends when the process does

    def listen(self) -> Iterator[JobMessage]:
        """All that the job says until it is over; the last is "done", "failed" or "stopped"."""
        last = JobMessage("progress")
        while last.kind not in ("done", "failed"):
            try:
                last = self._ear.recv()
            except (EOFError, OSError):
                break
            if not self._stopped:
                yield last
        self._process.join(PATIENCE_S)
        if self._stopped:
            yield JobMessage("stopped")
        elif last.kind not in ("done", "failed"):
            code = self._process.exitcode
            yield JobMessage(
                "failed", f"the process ended with code {code}; is there enough memory?"
            )

    def stop(self) -> None:
        """End the process; a run that is not whole by then leaves nothing."""
        self._stopped = True
        self._process.terminate()
        self._process.join(PATIENCE_S)
        if self._process.is_alive():
            self._process.kill()


def _work(mouth: Connection, run: Path, change: Task | None, trust: Trust) -> None:
    """What the process does."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the page, which ends its jobs
    signal.signal(signal.SIGTERM, _leave)
    try:
        _study(mouth, run, change, trust)
        mouth.send(JobMessage("done"))
    except InputError as error:
        mouth.send(JobMessage("failed", str(error)))
    except BrokenPipeError:
        pass  # the page is gone
    except Exception as error:
        mouth.send(JobMessage("failed", f"internal fault: {type(error).__name__}: {error}"))


def _study(mouth: Connection, folder: Path, change: Task | None, trust: Trust) -> None:
    from calib.runs.calibrate import grow
    from calib.runs.diagnose import diagnose
    from calib.runs.run import Run

    def progress(what: str, done: int, total: int) -> None:
        mouth.send(JobMessage("progress", what, (done + 1) / max(total, 1)))

    run = Run.open(folder, trust)
    if isinstance(change, Report):
        from calib.report import report

        report([run], change.out, progress)
        return
    if isinstance(change, PlanStops):
        mouth.send(JobMessage("plan", _planned(run, change, progress)))
        return
    if change is not None:
        run = grow(run, changed(run, change), change.out, progress)
        mouth.send(JobMessage("run", str(run.folder)))
    diagnose(run, progress)


def _planned(run: Run, wanted: PlanStops, progress: Progress) -> str:
    """Plan stops, and write them; what they are worth, in sentences."""
    from calib.planning import plan
    from calib.report.planned import write_plan
    from calib.show.plan import achieved

    found = plan(run, wanted.stops, wanted.purpose, progress=progress)
    write_plan(found, wanted.out, run)
    return " ".join(achieved(found))


def changed(run: Run, change: Change) -> Model:
    """The model of a run with a change.

    Raises:
        InputError: an effect is unknown, or is there already, or is not there.
    """
    from calib.runs.calibrate import grown_model

    with tempfile.TemporaryDirectory() as scratch:
        model = grown_model(run, list(_named(change.added, Path(scratch))))
    return model.minus(change.dropped).leaving_out(change.without)


def _named(added: Sequence[str | Mapping[str, Any]], scratch: Path) -> Iterator[str]:
    """Effects as ``rigcal add`` takes them: formulas are written to files."""
    for number, effect in enumerate(added):
        if isinstance(effect, Mapping):
            path = scratch / f"{number}.yaml"
            write_yaml(path, dict(effect))
            effect = str(path)
        yield effect


def _leave(number: int, frame: object) -> None:
    """Leave as an exception would, so that half-made folders are taken away."""
    raise SystemExit(128 + number)
