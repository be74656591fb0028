"""Where the CPU seconds of a fit and a diagnosis go, on one thread: a process of its own.

python tests/bench/loop_parts.py fit|diagnose RECORDING RUN
"""

from __future__ import annotations

import json
import sys
import time
from collections import defaultdict
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any
from unittest import mock

from calib.diagnosis import stand
from calib.linear import linearise
from calib.linear.assembly import Assembly
from calib.linear.parallel import workers
from calib.linear.rows import StopRows
from calib.linear.system import Linearisation
from calib.problem.model import Source
from calib.residuals.store import BeamStore
from calib.runs import calibrate, diagnose
from calib.runs.run import Run
from calib.solve.graph import Graph, KeptRows
from sensors.reference import Reference

STARTING, REST = "starting, importing", "all else"
# Stops are eliminated as they are added.
PARTS: dict[str, tuple[tuple[Any, str], ...]] = {
    "reading": ((Source, "open"), (BeamStore, "read"), (Run, "open")),
    "casting": ((Reference, "first_triangle"),),
    "depth edges": ((Reference, "near_edge"),),
    "placing": ((linearise, "lidars"), (linearise, "own_rows")),
    "rows": ((StopRows, "of"),),
    "sums": ((StopRows, "sums"), (StopRows, "gradient")),
    "eliminating": ((Assembly, "add"), (Assembly, "done")),
    "graph": (*((Graph, n) for n in ("__init__", "step", "solve", "error")), (KeptRows, "of")),
    "covariance": ((Graph, "covariance"), (Linearisation, "covariance")),
    "testing": (*((stand, n) for n in ("project", "screen")), (diagnose, "weak_directions")),
    "writing": tuple((calibrate, n) for n in ("write_residuals", "write_yaml", "write_json")),
}


class Clock:
    """CPU seconds that functions take by themselves, without others of them that they call."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self._part, self._since = REST, time.process_time()

    def switch(self, part: str) -> str:
        """Count for another part from now on; which it was."""
        before, now = self._part, time.process_time()
        self.seconds[before] += now - self._since
        self._part, self._since = part, now
        return before

    def timed(self, part: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """A function that counts for a part."""

        def run(*args: Any, **kwargs: Any) -> Any:
            before = self.switch(part)
            try:
                return function(*args, **kwargs)
            finally:
                self.switch(before)

        return run


def parts(verb: Callable[[], Any]) -> dict[str, float]:
    """CPU seconds by part. What is done twice takes less the second time: that much, and all until
    now, is what starting and importing take."""
    verb()
    once = time.process_time()
    with ExitStack() as stack:
        clock = Clock()
        for part, functions in PARTS.items():
            for owner, name in functions:
                timed = clock.timed(part, getattr(owner, name))
                stack.enter_context(mock.patch.object(owner, name, timed))
        verb()
        clock.switch(REST)
    return {STARTING: once - sum(clock.seconds.values())} | clock.seconds


def main() -> None:
    """Print the parts as JSON."""
    verb, recording, run = sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3])
    verbs = {
        "fit": lambda: calibrate.calibrate([recording], run),
        "diagnose": lambda: diagnose.diagnose(Run.open(run)),
    }
    with workers(1):
        print(json.dumps(parts(verbs[verb])))


if __name__ == "__main__":
    main()
