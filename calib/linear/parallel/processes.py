"""Workers as processes of this machine: a message and its answer at a time, through pipes.

They are started as programs and not forked, and import no script of the user's, as those of
`multiprocessing` do. Ctrl-C in a terminal reaches this process alone, which ends them; and where it
is killed, they find their pipe closed and end by themselves.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Mapping
from contextlib import suppress
from typing import BinaryIO

from calib.linear.parallel.crew import WorkerGoneError, serve

PROGRAM = """
import json, sys
sys.path[:] = json.loads(sys.argv[1])
from calib.linear.parallel.processes import own_pipes, serve_on
pipes = own_pipes()
import calib.linear.linearise  # while the first message is on its way
serve_on(*pipes)
"""
LENGTH_BYTES = 8  # before each message: how long it is
ONE_THREAD: Mapping[str, str] = {f"{x}_NUM_THREADS": "1" for x in ("MKL", "OMP", "OPENBLAS")}


class ProcessLine:
    """The way to a process.

    Args:
        name: for messages.
    """

    def __init__(self, name: str) -> None:
        self.name, self.closed = name, False
        self.process = self._started()

    def _started(self) -> subprocess.Popen[bytes]:
        path = json.dumps([os.path.abspath(folder) for folder in sys.path])
        return subprocess.Popen(
            [sys.executable, "-c", PROGRAM, path],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, **ONE_THREAD},
            start_new_session=True,
        )

    def ask(self, message: bytes) -> bytes:
        """Its answer to a message."""
        try:
            _send(self.process.stdin, message)
            answer = _received(self.process.stdout)
        except (OSError, ValueError):  # of a pipe that is broken or closed
            answer = None
        if answer is None:
            raise WorkerGoneError(_ended(self.process.wait()))
        return answer

    def renew(self) -> None:
        """Start another."""
        self._end()
        if not self.closed:
            self.process = self._started()

    def close(self) -> None:
        """End it, whatever it does."""
        self.closed = True
        self._end()

    def _end(self) -> None:
        self.process.kill()
        self.process.wait()


def _ended(code: int) -> str:
    """How a process ended."""
    if code >= 0:
        return f"ended with code {code}"
    with suppress(ValueError):
        return f"was ended by {signal.Signals(-code).name}"
    return f"was ended by signal {-code}"


def _send(pipe: BinaryIO, message: bytes) -> None:
    pipe.write(len(message).to_bytes(LENGTH_BYTES))
    pipe.write(message)
    pipe.flush()


def _received(pipe: BinaryIO) -> bytes | None:
    """The next message; None where there will be none."""
    length = pipe.read(LENGTH_BYTES)
    if len(length) < LENGTH_BYTES:
        return None
    message = pipe.read(size := int.from_bytes(length))
    return message if len(message) == size else None


def own_pipes() -> tuple[BinaryIO, BinaryIO]:
    """Where messages come from and answers go, in a worker. What libraries print goes to stderr."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # without sessions, as on Windows, it comes here
    source, sink = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.dup2(2, 1)
    return source, sink


def serve_on(source: BinaryIO, sink: BinaryIO) -> None:
    """Answer messages until the other end is closed."""
    with suppress(BrokenPipeError):
        while (message := _received(source)) is not None:
            _send(sink, serve(message))
