"""Work over stops in other processes: what those run, and what this one sends and takes.

Worker i of N has the stops i, i + N, …, so that what it keeps of a stop is asked for again. Results
are taken in the order of the stops, whoever is done first.
"""

from __future__ import annotations

import logging
import pickle
import traceback
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from typing import Any, Protocol

from calib.linear.parallel.parcels import (
    KEPT_PARCELS_BYTES,
    LackingError,
    Parcel,
    Parcels,
    Task,
)
from calib.residuals.store import share_memory
from chains.errors import CutShortError, InputError

AHEAD = 2  # stops of each worker: one that it works on, and one that waits
LIVES = 3  # of a worker, while it works on one stop; the next may be in want of the same memory
ATTEMPTS = 3  # to send what a worker has not let go, after which everything is sent

_LOG = logging.getLogger("rigcal")


class WorkerGoneError(Exception):
    """A worker ended before it answered; the argument says how."""


class Line(Protocol):
    """The way to one worker. `ask` raises `WorkerGoneError`; `renew` takes another in its place."""

    name: str

    def ask(self, message: bytes) -> bytes: ...

    def renew(self) -> None: ...

    def close(self) -> None: ...


# ------------------------------------------------------------------------------- in the worker


@cache
def _mine() -> Parcels:
    """What this process was sent. BLAS has one thread in it from now on, as everywhere; and other
    workers may have the other cores of this machine."""
    from threadpoolctl import threadpool_limits

    threadpool_limits(limits=1)
    share_memory()
    return Parcels(KEPT_PARCELS_BYTES)


def serve(message: bytes) -> bytes:
    """Do what a message asks, in a worker; its answer."""
    mine = _mine()
    sender, parcel = pickle.loads(message)
    try:
        task, arguments = mine.opened(Parcel(*parcel), sender)
        outcome = True, task.work(*arguments)
    except LackingError as lacking:
        return pickle.dumps((mine.name, None, lacking.args))
    except Exception as error:
        if not isinstance(error, InputError):  # which is a sentence for users
            error.add_note(f"in a worker:\n{traceback.format_exc()}")
        outcome = False, error
    try:
        answer = mine.packed(outcome, sender)
    except (pickle.PicklingError, TypeError, AttributeError):
        what = RuntimeError(f"cannot be sent: {outcome[1]!r}")
        answer = mine.packed((False, what), sender)
    mine.keep(answer)
    mine.held(sender, list(answer.along))
    return pickle.dumps((mine.name, tuple(answer), ()), pickle.HIGHEST_PROTOCOL)


# ---------------------------------------------------------------------------- in this process


@dataclass
class Traffic:
    """What went to workers and came back, in bytes; and how often a stop was asked for."""

    down: int = 0
    up: int = 0
    stops: int = 0

    def __str__(self) -> str:
        down, up = (sent / max(self.stops, 1) / 1e3 for sent in (self.down, self.up))
        return f"sent to workers: {self.stops} stops, each {down:.0f} kB down and {up:.0f} kB up"


class Crew:
    """Workers in other processes.

    Args:
        lines: to each of them.
    """

    def __init__(self, lines: Sequence[Line]) -> None:
        self.lines = lines
        self.parcels, self.traffic = Parcels(), Traffic()
        self._holders: dict[int, str] = {}  # line -> what the process at its end calls itself
        self._threads = [ThreadPoolExecutor(1) for _ in lines]
        self._closed = False

    def over(
        self, work: Callable[..., Any], scans: Sequence[Any], each: Sequence[Sequence[Any]]
    ) -> Iterator[Any]:
        """``work(scans[i], each[0][i], …)`` of every scan, in order."""
        task, count, ahead = Task(work), len(scans), AHEAD * len(self.lines)

        def begin(i: int) -> Future:
            line = i % len(self.lines)
            arguments = scans[i], *(some[i] for some in each)
            return self._threads[line].submit(self._done, line, task, arguments)

        waiting = deque(begin(i) for i in range(min(ahead, count)))
        try:
            for i in range(count):
                found = waiting.popleft().result()
                if i + ahead < count:
                    waiting.append(begin(i + ahead))
                yield found
        finally:
            for future in waiting:
                future.cancel()

    def close(self) -> None:
        """End the workers, whatever they do."""
        self._closed = True
        if self.traffic.stops:
            _LOG.info("%s", self.traffic)
        for line in self.lines:
            line.close()
        for thread in self._threads:
            thread.shutdown(cancel_futures=True)
        for line in self.lines:  # a thread may just have taken another
            line.close()

    def _done(self, at: int, task: Task, arguments: tuple[Any, ...]) -> Any:
        """What becomes of a task at a stop; by a new worker where one ends."""
        line = self.lines[at]
        for life in range(1, LIVES + 1):
            try:
                good, found = self._answer(at, (task, arguments))
                break
            except WorkerGoneError as gone:
                self._holders.pop(at, None)
                stop = f"at stop '{arguments[0].name}'"
                if not self._closed:
                    line.renew()
                if self._closed or life == LIVES:
                    raise CutShortError(
                        f"{line.name} {gone} {stop}, {life} times; where memory is short, take "
                        "fewer --workers"
                    ) from None
                _LOG.warning("%s %s %s; another goes on with it", line.name, gone, stop)
        self.traffic.stops += 1
        if not good:
            raise found
        return found

    def _answer(self, at: int, what: object) -> tuple[bool, Any]:
        """Whether a worker could do it, and its result or error."""
        for attempt in range(ATTEMPTS + 1):
            holder = self._holders.get(at) if attempt < ATTEMPTS else None
            parcel = self._packed(what, holder)
            message = pickle.dumps((self.parcels.name, tuple(parcel)), pickle.HIGHEST_PROTOCOL)
            answer = self.lines[at].ask(message)
            self.traffic.down += len(message)
            self.traffic.up += len(answer)
            name, found, lacking = pickle.loads(answer)
            self._holders[at] = name
            self.parcels.held(name, lacking, holds=False)
            if found is not None:
                self.parcels.held(name, list(parcel.along))
                return self.parcels.opened(Parcel(*found), name)
        raise RuntimeError("a worker lacks what it was sent")

    def _packed(self, what: object, holder: str | None) -> Parcel:
        try:
            return self.parcels.packed(what, holder)
        except (pickle.PicklingError, TypeError, AttributeError) as error:
            raise InputError(
                f"the model cannot be sent to another process: {error}; do without --workers and "
                "--scheduler"
            ) from error
