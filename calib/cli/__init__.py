"""The command line: arguments in, one call, results out. What is heavy is imported by the call."""

from __future__ import annotations

import gc
import logging
import os
import sys
from functools import cache
from typing import Any, NoReturn

import typer

# BLAS threads on shared cores cost many times what they save; set before numpy is imported.
for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
# Where memory is fragmented, the kernel spends more on making huge pages, as numpy asks for, than
# they save: 5 of the 45 s of CPU time of a LiDAR's diagnosis, 1 of 10 s of that of 1,000 poses.
os.environ.setdefault("NUMPY_MADVISE_HUGEPAGE", "0")
# A look at many stops makes thousands of arrays, and hardly any objects that refer to each other.
# With the usual 700, looking for such takes 9 % of the diagnosis of 1,000 poses; with this, none.
gc.set_threshold(20_000)

# Each of these registers its commands.
from calib.cli import (  # noqa: E402
    calibrating,  # noqa: F401
    evaluating,  # noqa: F401
    exporting,  # noqa: F401
    importing,  # noqa: F401
    planning,  # noqa: F401
    reporting,  # noqa: F401
)
from calib.cli.app import app, heeding_ctrl_c  # noqa: E402
from chains.errors import InputError  # noqa: E402
from chains.escape import terminal  # noqa: E402


class _OnStderr(logging.Handler):
    """What happened beside what was asked for, a sentence each; not an error."""

    def emit(self, record: logging.LogRecord) -> None:
        print(f"rigcal: {record.getMessage()}", file=sys.stderr)


logging.getLogger("rigcal").addHandler(_OnStderr())

INTERRUPTED = 130  # as shells have it: 128 and the signal's number


@cache
def _command() -> Any:
    """All commands as the parser has them: typer itself would build it anew at each call, 60 ms."""
    return typer.main.get_command(app)


def main() -> None:
    """Run the command line: exit code 0 done, 2 bad input or usage, 3 done but not
    converged, 1 a fault of the program."""
    try:
        with heeding_ctrl_c():
            code = _command()(sys.argv[1:] or ["--help"], prog_name="rigcal", standalone_mode=False)
    except InputError as error:
        _fail(str(error), 2)
    except MemoryError:
        _fail("there is not enough memory; 'rigcal check' shows how large the recording is", 2)
    except KeyboardInterrupt:
        code = INTERRUPTED
    except Exception as error:
        if hasattr(error, "format_message"):  # wrong usage: typer's click, wherever that lives
            _fail(error.format_message(), 2)
        if isinstance(error, OSError) and error.filename and error.strerror:
            _fail(f"{os.fsdecode(error.filename)}: {error.strerror}", 2)  # the machine's
        if not _interrupted(error):
            if os.environ.get("RIGCAL_TRACEBACK"):
                raise
            name = type(error).__name__
            _fail(f"internal fault: {name}: {error} (RIGCAL_TRACEBACK=1 says where)", 1)
        code = INTERRUPTED
    if code == INTERRUPTED:  # typer's answer to Ctrl-C, too
        _fail("interrupted; nothing was left half-written", code)
    raise SystemExit(code or 0)


def _interrupted(error: BaseException | None) -> bool:
    """Whether Ctrl-C is behind an error: a library that it hits while loading reports its own."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None


def _fail(message: str, code: int) -> NoReturn:
    print(f"rigcal: {terminal(message)}", file=sys.stderr)
    raise SystemExit(code)
